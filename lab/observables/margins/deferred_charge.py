"""Charge that packets leave behind the last lines of flats: what overscan reads of it, over the signal there (extended
pixel edge response)."""

from __future__ import annotations

import numpy as np

from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.observables.dataset import Dataset
from lab.observables.margins.frames import (
    LEAST_LINES,
    LEAST_NOISE_STEPS,
    MarginFrame,
    MarginFrames,
    Strip,
    deferred_shares,
    margin_frames,
)
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import TRAILS
from sim.effects.base import Effects
from sim.spectrum import FloatArray

#: Lines of overscan, next to the active area, that are measured.
MOST_LAGS = 6
#: Fewest frames of a part, which a line is fitted to.
LEAST_FRAMES = 6


def measure_overscan_charge(dataset: Dataset) -> Observable:
    """Signal in each line of overscan next to the active area over that of the last active lines: the slope of a line
    over dark frames and unsaturated flats, behind the last and before the first rows and columns.

    The offset of a frame is that of the overscan far from the active area; what is fixed in the lines, as offsets of
    columns, is in the intercept. Raises NotDetermined where no end has `LEAST_LINES` lines of overscan, and where noise
    doesn't dither the codes."""
    made = dataset.once(margin_frames)
    if made.pixel_dn < LEAST_NOISE_STEPS * dataset.step_dn:
        raise NotDetermined(
            "overscan_charge",
            f"noise of overscan is {made.pixel_dn / dataset.step_dn:.2g} steps of the codes, below the limit of "
            f"{LEAST_NOISE_STEPS:g}: rounding hides what charge it holds; raise the gain",
        )
    values: list[FloatArray] = []
    blocks: list[FloatArray] = []
    labels: list[Label] = []
    places: list[tuple[int, int]] = []  # strip, its line
    for number, strip in enumerate(made.strips):
        if strip.overscan < LEAST_LINES:
            continue
        for held_out in (False, True):
            part = [f for f in made.frames if f.is_held_out == held_out]
            found = _slopes(dataset, made, part, number)
            if found is None:
                continue
            slope, covariance = found
            values.append(slope)
            blocks.append(covariance)
            captures = tuple(f.capture.id for f in part)
            for line in _lines(strip):
                labels.append(Label(float(line + 1), "all", strip.name, captures, held_out))
                places.append((number, line))
    if not values:
        raise NotDetermined(
            "overscan_charge",
            f"no end of the frames has {LEAST_LINES} lines of overscan, with dark frames and flats of several levels",
        )

    def predict(effects: Effects) -> Prediction:
        shares = deferred_shares(dataset, made, effects)
        above = [share - np.mean(share[-strip.base :]) for share, strip in zip(shares, made.strips, strict=True)]
        return Prediction(np.array([above[number][line] for number, line in places]), {})

    size = len(places)
    covariance, start = np.zeros((size, size)), 0
    for block in blocks:
        end = start + len(block)
        covariance[start:end, start:end] = block
        start = end
    return Observable(
        measurement=OVERSCAN_CHARGE, reach=2.0, value=np.concatenate(values), covariance=covariance,
        labels=tuple(labels), reads=TRAILS, predict=predict, scale=np.full(size, 0.01),
    )  # fmt: skip


def _lines(strip: Strip) -> range:
    """Return the lines of a strip that are measured, counted from the active area."""
    return range(strip.masked, strip.masked + min(MOST_LAGS, strip.overscan - strip.base))


def _slopes(
    dataset: Dataset, made: MarginFrames, part: list[MarginFrame], number: int
) -> tuple[FloatArray, FloatArray] | None:
    """Return the slopes (k,) of a strip's lines over the signal, and their covariance; None where the frames of a part
    are too few or all dark.

    A line's mean above the offset has the variance v of a line and of the offset's mean, v / b of b lines, and the shot
    noise of its charge. v is taken from the lines of the offset in all frames; where the residuals of the fits are
    larger, from these.
    """
    strip, lines = made.strips[number], list(_lines(made.strips[number]))
    if len(part) < LEAST_FRAMES or not any(isinstance(f.capture, FlatCapture) for f in part):
        return None
    signal = np.array([f.signal_dn(made.strips, number) for f in part])
    away = signal - signal.mean()
    weight = away / float(away @ away)
    base = np.array([f.lines[number][-strip.base :] for f in made.frames])
    base = base - base.mean(axis=1, keepdims=True)
    base = base - base.mean(axis=0)
    freedom = (len(base) - 1) * (strip.base - 1)
    line_dn2 = float(np.sum(np.square(base))) / freedom
    above = np.array([f.lines[number][lines] - f.offset_dn(made.strips, number) for f in part])
    slope = weight @ above
    fitted = above.mean(axis=0) + np.multiply.outer(away, slope)
    across = len(part[0].active[1 - strip.axis])
    shot_dn2 = dataset.noise.gain * np.maximum(fitted - fitted.min(axis=0), 0.0) / across
    own_dn2 = line_dn2 + shot_dn2  # (frames, k)
    residual = np.square(above - fitted) / (own_dn2 + line_dn2 / strip.base)
    excess = max(1.0, float(residual.sum()) / ((len(part) - 2) * len(lines)))
    covariance = np.full((len(lines), len(lines)), line_dn2 / strip.base * float(weight @ weight))
    covariance[np.diag_indices(len(lines))] += np.square(weight) @ own_dn2
    return slope, excess * covariance


OVERSCAN_CHARGE = Measurement(
    "overscan_charge",
    title="charge deferred into overscan",
    order=199,
    axis="distance",
    unit="px",
    make=measure_overscan_charge,
    quantity="signal of a line of overscan over that of the last lines",
    conditions="end of the frame",
)
