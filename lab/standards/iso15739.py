"""ISO 15739:2023: noise, signal-to-noise ratios and dynamic range, from even levels and darks; visual noise stands in
`lab.standards.visual_noise`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from lab.errors import NotDetermined
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation, PlotCurve, StandardPlot
from lab.standards.standard import ClauseFigure, MeasuredSide, NotDone, Standard
from lab.standards.tone_steps import ToneSteps, tone_steps

LEAST_IMAGES = 8
#: Luminance at which signal-to-noise ratios are stated, over that of saturation: 18 % of a diffuser that is at 140/100
#: of white.
REFERENCE_SHARE = 0.13


class Iso15739(Standard):
    """ISO 15739:2023, of one plane of the mosaic."""

    name: ClassVar[str] = "ISO 15739:2023"
    title: ClassVar[str] = "noise, signal-to-noise ratios and dynamic range"
    target: ClassVar[str] = "flats in 8 repeats, and darks"
    compared: ClassVar[str] = "no peer on the package index; closed forms in the tests"
    not_done: ClassVar[tuple[NotDone, ...]] = (
        NotDone(
            "Annex B",
            "visual noise",
            "the annex's text was not at hand; the normalisation of its contrast sensitivities sets the scale",
        ),
    )

    def __init__(self, side: MeasuredSide, steps: ToneSteps) -> None:
        super().__init__(side, f"plane {steps.plane}")
        self.steps = steps

    def _at_reference(self, values: np.ndarray, stds: np.ndarray) -> tuple[float, float]:
        """Return values (n,) and their standard deviations (n,) between the two levels about the reference, by a
        straight line."""
        steps = self.steps
        wanted = REFERENCE_SHARE * float(steps.signal.max())
        order = np.argsort(steps.signal, kind="stable")
        signal = steps.signal[order]
        k = int(np.searchsorted(signal, wanted))
        if k in (0, signal.size):
            raise NotDetermined(
                self.name, "the levels don't enclose 13 % of saturation; capture one below and one above"
            )
        share = (wanted - signal[k - 1]) / (signal[k] - signal[k - 1])
        pair = order[[k - 1, k]]
        weight = np.array([1.0 - share, share])
        return float(weight @ values[pair]), float(np.sqrt(weight**2 @ stds[pair] ** 2))

    def _ratio(self, variance: np.ndarray, variance_std: np.ndarray) -> Estimate:
        steps = self.steps
        square, square_std = self._at_reference(variance, variance_std)
        gain, gain_std = steps.gain
        # L g of the reference: the signal of a linear camera
        signal, signal_std = self._at_reference(steps.exposure * gain, steps.exposure * gain_std)
        if not signal > 2.0 * signal_std:
            raise NotDetermined(self.name, "the OECF doesn't rise at the reference level; capture more levels about it")
        if not square > 2.0 * square_std:
            raise NotDetermined(self.name, "the noise isn't significant at the reference level; capture more repeats")
        value = signal / float(np.sqrt(square))
        return Estimate(
            value=value, std=value * float(np.hypot(signal_std / signal, 0.5 * square_std / square)), unit="1"
        )

    @ClauseFigure
    def total_snr(self) -> Estimate:
        """Return the signal-to-total-noise ratio.

        Clause: 6.3.3. Symbol: Q_total. Unit: 1.
        Formula: L_ref g(L_ref) / sqrt(σ²_temporal + σ²_fp) at L_ref = 0.13 L_sat.
        """
        steps = self.steps
        return self._ratio(steps.temporal + steps.fixed, np.hypot(steps.temporal_std, steps.fixed_std))

    @ClauseFigure
    def temporal_snr(self) -> Estimate:
        """Return the signal-to-temporal-noise ratio.

        Clause: 6.3.4. Symbol: Q_temp. Unit: 1.
        Formula: L_ref g(L_ref) / σ_temporal at L_ref = 0.13 L_sat.
        """
        return self._ratio(self.steps.temporal, self.steps.temporal_std)

    @ClauseFigure
    def fixed_pattern_snr(self) -> Estimate:
        """Return the signal-to-fixed-pattern-noise ratio.

        Clause: 6.3.5. Symbol: Q_fp. Unit: 1.
        Formula: L_ref g(L_ref) / σ_fp at L_ref = 0.13 L_sat, shading removed.
        """
        return self._ratio(self.steps.fixed, self.steps.fixed_std)

    @ClauseFigure
    def black_temporal_noise(self) -> Estimate:
        """Return the temporal noise of the dark.

        Clause: 6.4. Symbol: σ_temporal(black). Unit: DN.
        Formula: root of the mean temporal variance of dark images.
        """
        dark = self.steps.dark
        noise = float(np.sqrt(max(dark.temporal_variance, 0.0)))
        if noise <= 0.0:
            raise NotDetermined(self.name, "the dark has no temporal noise: it is clipped or rounded away")
        return Estimate(value=noise, std=0.5 * dark.temporal_variance_std / noise, unit="DN")

    @ClauseFigure
    def dynamic_range(self) -> Estimate:
        """Return the dynamic range.

        Clause: 6.4. Symbol: D. Unit: 1.
        Formula: L_sat g(black) / σ_temporal(black): L_sat over the luminance with a signal-to-temporal-noise ratio
        of 1.
        """
        steps = self.steps
        gain, gain_std = steps.gain
        noise = self.black_temporal_noise
        if not gain[0] > 2.0 * gain_std[0]:
            raise NotDetermined(self.name, "the OECF doesn't rise at its darkest levels; capture more of them")
        top = steps.signal.max()
        reached = np.flatnonzero(steps.signal >= 0.99 * top)
        if reached.size < 2:
            raise NotDetermined(self.name, "the levels don't reach saturation; expose the brightest longer")
        # exposure at which the straight line through the levels below meets the largest signal
        saturated = float(top / gain[0])
        inside = (steps.signal > 0.3 * top) & (steps.signal < 0.9 * top)
        if np.any(inside):
            saturated = float(top * np.mean(steps.exposure[inside] / steps.signal[inside]))
        value = saturated * float(gain[0]) / noise.value
        relative = float(np.hypot((noise.std or 0.0) / noise.value, gain_std[0] / gain[0]))
        return Estimate(value=value, std=value * relative, unit="1")

    def deviations(self) -> Iterator[Deviation]:
        steps = self.steps
        if min(steps.frames, steps.dark.repeats) < LEAST_IMAGES:
            yield Deviation(
                clause="5.2",
                quantity="images of a level",
                found=f"{min(steps.frames, steps.dark.repeats)}",
                limit=f"{LEAST_IMAGES} at least",
                remedy="capture more repeats of flats and darks",
            )
        yield from steps.unevenness("4.2.4")

    def conditions(self) -> Iterator[str]:
        yield f"{self.steps.exposure.size} levels, {self.steps.frames} images of each at least, raw data of one plane"

    def remarks(self) -> Iterator[str]:
        yield (
            "noise of the raw plane, in place of the luminance of the finished image: demosaicing and tone curves "
            "would change it"
        )

    def plots(self) -> Iterator[StandardPlot]:
        steps = self.steps
        kept = (steps.signal > 0) & (steps.temporal > 0)
        total = np.sqrt(steps.temporal + steps.fixed)
        spread = 0.5 * np.hypot(steps.temporal_std, steps.fixed_std) / np.maximum(total, 1e-12)
        yield StandardPlot(
            title="Noise against the signal",
            x_label="signal above dark, DN",
            y_label="noise, DN",
            curves=(
                PlotCurve(
                    label="total",
                    x=tuple(steps.signal[kept].tolist()),
                    y=tuple(total[kept].tolist()),
                    y_std=tuple(spread[kept].tolist()),
                    style="points",
                    channel=steps.plane,
                ),
                PlotCurve(
                    label="temporal",
                    x=tuple(steps.signal[kept].tolist()),
                    y=tuple(np.sqrt(steps.temporal[kept]).tolist()),
                ),
                PlotCurve(
                    label="fixed pattern",
                    x=tuple(steps.signal[kept].tolist()),
                    y=tuple(np.sqrt(steps.fixed[kept]).tolist()),
                    style="dashed",
                ),
            ),
        )


def read(side: MeasuredSide) -> Iterator[Standard]:
    """Yield the standard for each plane. Raises NotDetermined where the recordings hold no series of levels."""
    for steps in tone_steps(side, Iso15739.name):
        yield Iso15739(side, steps)
