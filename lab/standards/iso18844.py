"""ISO 18844:2017: image flare, as the light in the dark parts of a bright chart on the screen."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from lab.errors import NotDetermined
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation
from lab.observables.observable import Observable
from lab.observables.screens.dark_squares import measure_screen
from lab.standards.standard import Figure, MeasuredSide, Standard
from sim.spectrum import FloatArray


class Iso18844(Standard):
    """ISO 18844:2017, of one channel."""

    name: ClassVar[str] = "ISO 18844:2017"
    title: ClassVar[str] = "image flare"

    def __init__(self, side: MeasuredSide, channel: str, share: FloatArray, covariance: FloatArray) -> None:
        super().__init__(side, f"channel {channel}")
        self.share, self.covariance = share, covariance

    @Figure
    def flare(self) -> Estimate:
        """Return the image flare.

        Clause: 6. Symbol: F. Unit: %.
        Formula: 100 (Y_black in the lit chart − Y of the dark chart) / (Y_white − Y of the dark chart), mean over the
        patterns, weighted by their covariance.
        """
        inverse = np.linalg.pinv(self.covariance)
        ones = np.ones(len(self.share))
        norm = float(ones @ inverse @ ones)
        value = float(ones @ inverse @ self.share) / norm
        rest = self.share - value
        chi2 = float(rest @ inverse @ rest) / max(len(ones) - 1, 1)
        return Estimate(value=100.0 * value, std=100.0 * float(np.sqrt(max(chi2, 1.0) / norm)), unit="%")

    def deviations(self) -> Iterator[Deviation]:
        yield Deviation(
            clause="4.2",
            quantity="chart",
            found="dark squares of a pattern that is half lit",
            limit="a black area of 5 % at most on white that exceeds the field of view by 41 %",
            remedy="show white with one black square on a larger screen",
        )

    def remarks(self) -> Iterator[str]:
        yield (
            "the light of a chart that fills the field would be about twice that of a pattern that is half lit, as a "
            "veil is proportional to it; the wings of the point spread function are part of the flare"
        )


def read(side: MeasuredSide) -> Iterator[Standard]:
    """Yield the standard for each channel. Raises NotDetermined without white, black and patterned captures of one
    pose of a screen."""
    found: Observable = measure_screen(side.dataset)
    white = np.asarray(found.scale)
    usable = [k for k, label in enumerate(found.labels) if not label.held_out and white[k] > 0]
    if not usable:
        raise NotDetermined(Iso18844.name, "no lit screen; capture white, black and a pattern of one pose")
    share = found.value / white
    covariance = found.covariance / np.outer(white, white)
    for channel in side.dataset.channels:
        own = [k for k in usable if found.labels[k].channel == channel]
        if own:
            yield Iso18844(side, channel, share[own], covariance[np.ix_(own, own)])
