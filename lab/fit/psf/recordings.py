"""Kernels of a recording set: of every screen pose, Bernoulli target and channel, and over the field."""

from __future__ import annotations

from dataclasses import dataclass

from lab.errors import NotDetermined
from lab.fit.psf.levelled_captures import screen_pictures
from lab.fit.psf.radial_symmetry import radial_symmetry
from lab.fit.psf.screen_kernel import ScreenKernel, measure_field
from lab.formats.recording_set import DataSheet, RecordingSet
from lab.formats.results import PsfKernel, PsfSymmetry
from sim.camera import Side


@dataclass(frozen=True)
class PsfFit:
    """`kernels`: one for every pose, Bernoulli target and channel. `parts`: of the green (or only) channel, over the
    field. `symmetry`: the test of radial symmetry of the parts, None where they don't determine it.
    """

    kernels: tuple[PsfKernel, ...]
    parts: tuple[PsfKernel, ...]
    symmetry: PsfSymmetry | None


def fit_psf_field(recordings: RecordingSet, side: Side, patches: int = 3) -> PsfFit:
    """Kernels of every pose of the screen, Bernoulli target and channel of `side`; of `patches` x `patches` parts of
    every pattern; and the test of radial symmetry.

    `field_mm` of a kernel is the middle of the pattern from the middle of the frame. The noise is the residual of the
    levelled picture, which includes the photo response non-uniformity of all four captures. Raises `NotDetermined`
    where captures are missing or no pose can be registered.
    """
    camera = recordings.camera(side)
    kernels: list[PsfKernel] = []
    parts: list[PsfKernel] = []
    measured: list[ScreenKernel] = []
    reason = ""
    for pictures in screen_pictures(recordings, side):
        try:
            field = measure_field(pictures, camera.cfa, patches=patches)
        except NotDetermined as refused:
            reason = f"{pictures.first.id}: {refused.reason}"
            continue
        kernels += [_result(camera, pictures.first.id, found) for found in field.kernels.values()]
        parts += [_result(camera, pictures.first.id, found) for found in field.parts]
        measured += field.parts
    if not kernels:
        raise NotDetermined("psf", reason)
    try:
        symmetry = radial_symmetry(measured, ((camera.rows - 1) / 2.0, (camera.cols - 1) / 2.0))
    except NotDetermined:
        symmetry = None
    return PsfFit(tuple(kernels), tuple(parts), symmetry)


def _result(camera: DataSheet, capture: str, found: ScreenKernel) -> PsfKernel:
    """A kernel as it stands in the results."""
    return PsfKernel(
        capture=capture,
        channel=found.channel,
        field_mm=_field_mm(camera, found.centre_px),
        sample_pitch_px=1.0,
        psf=tuple(tuple(float(v) for v in values) for values in found.kernel),
        psf_std=tuple(tuple(float(v) for v in values) for values in found.kernel_std),
    )


def _field_mm(camera: DataSheet, at_px: tuple[float, float]) -> tuple[float, float] | None:
    """Place on the sensor, (row, col) from the middle of the frame, mm; None without a pixel pitch."""
    if camera.pixel_pitch_um is None:
        return None
    pitch_mm = 1e-3 * camera.pixel_pitch_um
    return pitch_mm * (at_px[0] - (camera.rows - 1) / 2.0), pitch_mm * (at_px[1] - (camera.cols - 1) / 2.0)
