"""Darks and flats that contradict their own names or places: more light without light than with it, and frames moved
against their rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.formats.recording_set.manifest import DataSheet

Array = NDArray[np.floating]

#: Share of the range above black by which a dark's mean has to be above a flat's to contradict it: drifts of a black
#: level are smaller.
ABOVE_SHARE = 0.01
#: Difference of temperature beyond which a dark says nothing of a flat, degree C: the dark current doubles in 6 to 8.
ALIKE_C = 5.0
#: Share of the comparable pairs (or, of one dark, of its flats) that have to contradict their names.
MOST_PAIRS = 0.5
#: Fewest rows of a series, and fewest of them with another light after a move by one row.
FEWEST_ROWS, FEWEST_CHANGED = 8, 3
#: Largest ratio of the departures from a line after the move to those before, and least departure before, a share of
#: the signals' range.
BETTER, LEAST_DEPARTURE = 1.0 / 3.0, 0.002


@dataclass(frozen=True)
class FrameLevel:
    """The mean of a dark or a flat. `light`: proportional to its photons, 0 in the dark; comparable between levels of
    one `scale`."""

    id: str
    where: str
    gain_db: float | None
    exposure_s: float
    temperature_c: float | None
    mean_dn: float
    light: float
    scale: str | None  # None: dark
    is_clipped: bool = False


def exchanged_kinds(levels: Sequence[FrameLevel], camera: DataSheet) -> tuple[list[str], list[str]]:
    """(problems, warnings) for darks that are brighter than flats of as long an exposure: light adds, so that none can
    be.

    A problem where that holds of most pairs (the kinds are exchanged), a warning that names the darks where it holds of
    few of them."""
    problems, warnings = [], []
    least_dn = ABOVE_SHARE * (camera.saturation_dn - (camera.black_level_dn or 0.0))
    for gain_db in dict.fromkeys(level.gain_db for level in levels):
        darks = [level for level in levels if level.scale is None and level.gain_db == gain_db]
        flats = [level for level in levels if level.scale is not None and level.gain_db == gain_db]
        if not darks or not flats:
            continue
        alike = np.array([[_comparable(dark, flat) for flat in flats] for dark in darks])
        above = np.subtract.outer([dark.mean_dn for dark in darks], [flat.mean_dn for flat in flats])
        wrong = alike & (above > least_dn)
        if not wrong.any():
            continue
        d, f = np.unravel_index(int(np.argmax(np.where(wrong, above, -np.inf))), above.shape)
        dark, flat = darks[d], flats[f]
        told = (
            f"{dark.where}: a dark of {dark.exposure_s:g} s has {dark.mean_dn:.4g} DN, and the flat {flat.id} of "
            f"{flat.exposure_s:g} s has "
            f"{flat.mean_dn:.4g} DN"
        )
        if wrong.sum() > MOST_PAIRS * alike.sum():
            problems.append(
                f"{told}, as {wrong.sum()} of {alike.sum()} pairs do: darks and flats are exchanged; correct their "
                "kinds"
            )
            continue
        lit = wrong.sum(axis=1) > MOST_PAIRS * np.maximum(alike.sum(axis=1), 1)
        if lit.any():
            names = [one.id for one, is_lit in zip(darks, lit, strict=True) if is_lit]
            more = f" and {len(names) - 3} more" if len(names) > 3 else ""
            warnings.append(
                f"{told}: light in {len(names)} of {len(darks)} darks ({', '.join(names[:3])}{more}); correct their "
                "kind or take them out"
            )
    return problems, warnings


def _comparable(dark: FrameLevel, flat: FrameLevel) -> bool:
    """Return whether the flat has to be as bright as the dark: as long an exposure at about the same temperature."""
    warmer = (dark.temperature_c is not None and flat.temperature_c is not None) and abs(
        dark.temperature_c - flat.temperature_c
    ) > ALIKE_C
    return flat.exposure_s >= dark.exposure_s * (1.0 - 1e-6) and not warmer


def moved_rows(levels: Sequence[FrameLevel]) -> Iterator[str]:
    """One line for each series of darks and flats whose frames fit the lights of the rows beside them, from one row on
    to the end.

    `levels` in the order of their rows, darks with a light of 0. Means are fitted by a line in the light, as listed and
    with the frames of the last rows moved by one. Series whose light grows by equal steps or factors fit either way
    without darks and repeats; nothing is told of them."""
    for gain_db, scale in dict.fromkeys((level.gain_db, level.scale) for level in levels if level.scale is not None):
        own = [
            level
            for level in levels
            if level.gain_db == gain_db and level.scale in (scale, None) and not level.is_clipped
        ]
        light, mean = np.array([level.light for level in own]), np.array([level.mean_dn for level in own])
        if len(own) < FEWEST_ROWS or np.ptp(light) == 0 or np.ptp(mean) == 0:
            continue
        light, mean = light / np.ptp(light), mean / np.ptp(mean)
        before = float(_departures(light, mean, light, mean)[-1])
        moves = [(_departures(light[:-1], mean[:-1], light[1:], mean[:-1]), light[1:] != light[:-1], 0, "below")]
        moves += [(_departures(light[1:], mean[1:], light[:-1], mean[1:]), light[1:] != light[:-1], 1, "above")]
        for after, changes, first, where in moves:
            enough = np.cumsum(changes[::-1])[::-1] >= FEWEST_CHANGED  # rows from here on with another light
            enough = np.append(enough, False)
            start = int(np.argmin(np.where(enough, after, np.inf)))
            if enough[start] and before > LEAST_DEPARTURE and after[start] < BETTER * before:
                level = own[start + first]
                yield (
                    f"{level.where}: from this row on, frames have the levels of the rows {where} theirs (departures "
                    "from a line in the light "
                    f"{100 * before:.1f} % of the range as listed, {100 * after[start]:.1f} % moved by one row): "
                    "correct the order of the frames"
                )
                break


def _departures(light: Array, mean: Array, moved_light: Array, moved_mean: Array) -> Array:
    """Rms departure (n + 1,) of means from a line in the light, where the first k pairs are `light` and `mean` and
    those from k on are moved."""

    def sums(x: Array, y: Array) -> Array:
        return np.cumsum(
            np.vstack([np.zeros(6), np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])]), axis=0
        )

    first, later = sums(light, mean), sums(moved_light, moved_mean)
    n, x, y, xx, xy, yy = (first + later[-1] - later).T
    across, along = xx - x * x / n, xy - x * y / n
    left = yy - y * y / n - along**2 / np.maximum(across, 1e-300)
    return np.sqrt(np.maximum(left, 0.0) / n)
