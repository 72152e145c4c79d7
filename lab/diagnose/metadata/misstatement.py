"""One misstatement, and how a result reports it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lab.formats.recording_set import RecordingSet
from lab.formats.results import Unexplained
from lab.observables.observable import Measurement
from sim.camera import Side

#: What the improved model says of captures that aren't used.
LEFT_OUT = "the captures are left out"


@dataclass(frozen=True)
class Misstatement:
    """A statement that the recordings contradict."""

    measurement: Measurement  # that shows it
    where: str
    shape: str  # which statement contradicts which recordings
    check: str  # stated and fitting value, as a sentence
    chi2_stated: float  # of `n` numbers, with the stated value
    chi2_corrected: float  # of these, with the value that fits
    n: int
    captures: tuple[str, ...]
    corrected: RecordingSet  # the recordings with the value that fits, or without the captures
    correction: str = "the value that fits is taken in its place"
    probability: float | None = None  # that it is wrong; None where it wasn't weighed

    def told(self, side: Side) -> Unexplained:
        """Return the misstatement as an item of a result."""
        return Unexplained(
            side=side,
            measurement=self.measurement.name,
            axis=self.measurement.axis,
            where=self.where,
            shape=self.shape,
            significance_sigma=round(max(self.chi2_stated - self.chi2_corrected, 0.0) ** 0.5, 2),
            chi2_before=self.chi2_stated,
            chi2_after=self.chi2_corrected,
            n=self.n,
            captures=self.captures,
            correction=self.correction,
            check=self.check,
            probability=self.probability,
        )


def restated_camera(recordings: RecordingSet, side: Side, **values: Any) -> RecordingSet:
    """Return the recordings with other values stated of the camera of `side`."""
    manifest = recordings.manifest
    camera = manifest.cameras[side].model_copy(update=values)
    return recordings.under(manifest.model_copy(update={"cameras": {**manifest.cameras, side: camera}}))
