"""ISO 14524:2009: the opto-electronic conversion function (OECF) of the focal plane, from a series of even levels."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from lab.errors import NotDetermined
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation, PlotCurve, StandardPlot
from lab.standards.standard import ClauseFigure, MeasuredSide, NotDone, Standard
from lab.standards.tone_steps import ToneSteps, tone_steps

LEAST_STEPS = 12
LEAST_TRIALS = 10
#: Share of the largest signal above which a level counts as saturated.
SATURATED = 0.98
#: Two levels whose ratio the slope of the log-log curve is taken over, shares of saturation.
LOW, HIGH = 0.1, 0.7


class Iso14524(Standard):
    """ISO 14524:2009, the focal-plane OECF of one plane of the mosaic."""

    name: ClassVar[str] = "ISO 14524:2009"
    title: ClassVar[str] = "opto-electronic conversion function (OECF) of the focal plane"
    target: ClassVar[str] = "flats of 12 levels in 10 repeats"
    compared: ClassVar[str] = "no peer on the package index; closed forms in the tests"
    not_done: ClassVar[tuple[NotDone, ...]] = (
        NotDone(
            "5.3",
            "camera OECF of a chart of grey steps",
            "needs a chart of 12 steps or more; a ColorChecker has six",
        ),
        NotDone("6.4", "OECF by colour temperature", "needs light of two illuminants"),
    )

    def __init__(self, side: MeasuredSide, steps: ToneSteps) -> None:
        super().__init__(side, f"plane {steps.plane}")
        self.steps = steps

    @ClauseFigure
    def oecf_slope(self) -> Estimate:
        """Return the slope of the logarithmic OECF.

        Clause: 6.3. Symbol: γ. Unit: 1.
        Formula: Δ log10 (output above dark) / Δ log10 H between the levels next to 10 and 70 % of saturation; 1 of a
        linear camera.
        """
        steps = self.steps
        share = steps.signal / steps.signal.max()
        low, high = int(np.argmin(np.abs(share - LOW))), int(np.argmin(np.abs(share - HIGH)))
        if low == high or share[low] <= 0:
            raise NotDetermined(self.name, "no two levels between 10 and 70 % of saturation")
        span = float(np.log(steps.exposure[high] / steps.exposure[low]))
        value = float(np.log(steps.signal[high] / steps.signal[low])) / span
        std = float(np.hypot(*(steps.signal_std[k] / steps.signal[k] for k in (low, high)))) / span
        return Estimate(value=value, std=std, unit="1")

    @ClauseFigure
    def incremental_gain(self) -> Estimate:
        """Return the incremental gain at 18 % of saturation.

        Clause: 6.3. Symbol: g. Unit: DN.
        Formula: H dDN/dH, change of the output for a relative change of the exposure, at the level next to 18 %.
        """
        steps = self.steps
        k = int(np.argmin(np.abs(steps.signal / steps.signal.max() - 0.18)))
        gain, std = steps.gain
        return Estimate(value=float(steps.exposure[k] * gain[k]), std=float(steps.exposure[k] * std[k]), unit="DN")

    @ClauseFigure
    def saturation_level(self) -> Estimate:
        """Return the largest output above the dark.

        Clause: 6.3. Symbol: DN_sat. Unit: DN.
        Formula: mean of the level of largest output.
        """
        k = int(np.argmax(self.steps.signal))
        return Estimate(value=float(self.steps.signal[k]), std=float(self.steps.signal_std[k]), unit="DN")

    @ClauseFigure
    def saturation_ratio(self) -> Estimate:
        """Return the range of exposure that the function covers.

        Clause: 6.3. Symbol: log H_sat − log H_min. Unit: 1.
        Formula: log10 of the exposure at which the output reaches 98 % of its largest value over the least exposure.
        """
        steps = self.steps
        reached = np.flatnonzero(steps.signal >= SATURATED * steps.signal.max())
        first, before = reached[0], max(reached[0] - 1, 0)
        if steps.signal[-1] < (1.0 + 1e-4) * steps.signal[before] and reached.size < 2:
            raise NotDetermined(self.name, "the levels don't reach saturation")
        if reached.size < 2:
            raise NotDetermined(self.name, "the levels don't reach saturation; expose the brightest longer")
        low, high = (float(np.log10(steps.exposure[k] / steps.exposure[0])) for k in (before, first))
        return Estimate(value=0.5 * (low + high), std=(high - low) / float(np.sqrt(12.0)), unit="1")

    def deviations(self) -> Iterator[Deviation]:
        steps = self.steps
        if steps.exposure.size < LEAST_STEPS:
            yield Deviation(
                clause="5.2",
                quantity="steps of the function",
                found=f"{steps.exposure.size}",
                limit=f"{LEAST_STEPS} at least",
                remedy="capture more levels",
            )
        if steps.frames < LEAST_TRIALS:
            yield Deviation(
                clause="5.2",
                quantity="trials of a step",
                found=f"{steps.frames}",
                limit=f"{LEAST_TRIALS} at least",
                remedy="capture more repeats",
            )
        yield from steps.unevenness("4.2")

    def conditions(self) -> Iterator[str]:
        yield f"{self.steps.exposure.size} levels, {self.steps.frames} images of each at least, raw data"
        yield (
            "exposure in photons a pixel"
            if self.steps.exposure_unit == "photons"
            else "exposure relative: in seconds of one lamp's light"
        )

    def plots(self) -> Iterator[StandardPlot]:
        kept = self.steps.signal > 0
        yield StandardPlot(
            title="OECF",
            x_label="exposure, " + ("photons/pixel" if self.steps.exposure_unit == "photons" else "s"),
            y_label="output above dark, DN",
            curves=(
                PlotCurve(
                    label="measured",
                    x=tuple(self.steps.exposure[kept].tolist()),
                    y=tuple(self.steps.signal[kept].tolist()),
                    y_std=tuple(self.steps.signal_std[kept].tolist()),
                    style="points",
                    channel=self.steps.plane,
                ),
            ),
            logarithmic=(True, True),
        )


def read(side: MeasuredSide) -> Iterator[Standard]:
    """Yield the OECF of each plane. Raises NotDetermined where the recordings hold no series of levels."""
    for steps in tone_steps(side, Iso14524.name):
        yield Iso14524(side, steps)
