"""The result of `calibench fit`."""

from __future__ import annotations

from typing import Literal

from lab.formats.results.blur import MtfCurve, PsfKernel, PsfSymmetry
from lab.formats.results.geometry import GeometryFit, StereoFit
from lab.formats.results.noise import NoiseFit
from lab.formats.results.skipped import Skipped
from lab.formats.results.spectral import SpectralFit
from sim.camera import Side
from sim.parameters import Frozen


class CameraFit(Frozen):
    """All that was fitted of one camera; None and empty: see `FitResult.skipped`."""

    noise: NoiseFit | None = None
    spectral: SpectralFit | None = None
    mtf: tuple[MtfCurve, ...] = ()
    psf: tuple[PsfKernel, ...] = ()
    #: Kernels of parts of the pattern, centre to edge, in the green (or only) channel, and the test of their symmetry.
    psf_field: tuple[PsfKernel, ...] = ()
    psf_symmetry: PsfSymmetry | None = None
    geometry: GeometryFit | None = None


class FitResult(Frozen):
    """All fits of a recording set."""

    format: Literal["calibench-fit"] = "calibench-fit"
    version: Literal[1] = 1
    source: str
    cameras: dict[Side, CameraFit]
    stereo: StereoFit | None = None
    skipped: tuple[Skipped, ...] = ()
