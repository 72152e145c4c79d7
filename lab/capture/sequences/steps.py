"""One step of a calibration as data: what stands in front of the cameras, how it is lit, and what is taken.

A step is the unit of the journal: all of it is kept, or none. Its `id` is stable, so a session that was cut short knows
what is still to do. Sequences are frozen specifications that list their steps; one plan (`lab.capture.devices.take`) runs any step.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from lab.capture.station import Station
from lab.errors import InputError
from lab.formats.recording_set import AnyCapture
from sim.parameters import Frozen


class Setting(Frozen):
    """How the bench is set. None: whatever it is, it doesn't matter here.

    `wavelength_nm` 0 is zero order (white light); None keeps the monochromator's shutter closed. `pattern` is the path
    (in the session) of what the screen shows, `cell_px` screen pixels a cell; None leaves the screen dark.
    """

    target: str | None
    wavelength_nm: float | None = None
    slit_um: float | None = None
    pattern: str | None = None
    cell_px: int = 1


class FixedExposure(Frozen):
    """The same exposure for every camera, in seconds."""

    kind: Literal["fixed"] = "fixed"
    exposure_s: float = Field(gt=0)


class RelativeExposure(Frozen):
    """`factor` times what the step `of` found for each camera."""

    kind: Literal["relative"] = "relative"
    of: str
    factor: float = Field(default=1.0, gt=0)


class FindExposure(Frozen):
    """Find, camera by camera, the exposure at which the brightest channel reaches `level` of its range (white less black)."""

    kind: Literal["find"] = "find"
    level: float = Field(default=0.75, gt=0.05, lt=0.95)
    tolerance: float = Field(default=0.05, gt=0)


class Step(Frozen):
    """A step of the journal.

    `radiance` is the path at which this step's measurement by the spectroradiometer is kept, None for none. `captures`
    are what one trigger of all cameras gives: complete but for what only the trigger tells (exposure, gain, temperature,
    time). They may share a frame, which carries the path of each side.
    """

    id: str
    what: str
    setting: Setting
    radiance: str | None = None
    exposure: FixedExposure | RelativeExposure | FindExposure | None = Field(default=None, discriminator="kind")
    captures: tuple[AnyCapture, ...] = ()

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.captures and not isinstance(self.exposure, FixedExposure | RelativeExposure):
            raise ValueError(f"step {self.id}: captures need an exposure, fixed or relative to one that was found")
        return self

    @property
    def sequence(self) -> str:
        """The sequence that the step belongs to."""
        return self.id.partition("/")[0]


class Sequence(Frozen):
    """Base of the specifications: the axes of a measurement, as data."""

    @abstractmethod
    def steps(self, station: Station) -> tuple[Step, ...]:
        """The steps in the order in which they are taken. Raises InputError if the station lacks what they need."""

    def patterns(self, station: Station) -> dict[str, NDArray[np.uint8]]:
        """What the screen shows, cells of 0 and 1, by its path in the session."""
        return {}


def name_of(step_id: str) -> str:
    """A step's id as the stem of a file's name."""
    return step_id.replace("/", "-")


def frame_path(step_id: str, side: str) -> str:
    """Where the frame of one side lies in the session."""
    return f"frames/{name_of(step_id)}-{side}.npy"


def spectrum_path(step_id: str) -> str:
    """Where the spectrum that a step measures lies in the session."""
    return f"spectra/{name_of(step_id)}.csv"


def common(step_id: str, side: str) -> dict[str, object]:
    """What every capture of a step has before it is taken."""
    return {"id": f"{name_of(step_id)}-{side}", "side": side, "frame": frame_path(step_id, side), "exposure_s": 0.0}


def needs(station: Station, sequence: str, *families: str) -> None:
    """Raises InputError, naming what is missing, if the station lacks an instrument that a sequence needs."""
    missing = [family for family in families if getattr(station, family) is None]
    if missing:
        raise InputError(
            f"station: the sequence {sequence!r} needs a {' and a '.join(missing)}; "
            f"add [{missing[0]}] to the station file or leave the sequence out"
        )
