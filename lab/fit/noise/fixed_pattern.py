"""Fixed pattern: DSNU, PRNU, and the symmetry of the shading."""

from __future__ import annotations

import numpy as np

from lab.fit.noise.dark_current import dark_signal_hidden
from lab.fit.noise.evaluation import Evaluation, in_electrons
from lab.measure.levels import DEFECT_SIGMA, MeasuredLevel
from lab.measure.rounding import HIDDEN_DN2, QUANTISATION_DN2
from lab.measure.weighted_lines import chi2_factor, root

ASYMMETRY = 0.002  # difference of the light on opposite edges, of the mean, above which it is reported


def dsnu(e: Evaluation) -> tuple[float | None, float | None]:
    """DSNU, e, and its standard deviation: the spatial standard deviation of the dark pattern over K."""
    pattern = dark_pattern(e)
    if pattern is None or dark_signal_hidden(e):
        return None, None
    level, square, std = pattern
    if min(level.plane[name].temporal_variance for name in e.levels.names) < HIDDEN_DN2:
        std = float(np.hypot(std, QUANTISATION_DN2))  # the mean of each pixel is rounded
    return in_electrons(e, *root(square, std))


def prnu(e: Evaluation) -> tuple[float | None, float | None]:
    """PRNU, %, and its standard deviation: sqrt(pattern variance - dark pattern variance) / signal, of the flat
    nearest to half of saturation, mean over the planes.
    """
    dark = dark_pattern(e)
    dark_variance = max(dark[1], 0.0) if dark else 0.0
    values, stds, levels = [], [], []
    for name in e.levels.names:
        candidates = []
        for level, clipped in zip(e.levels.flats, e.saturation.clipped[name], strict=True):
            plane = level.plane[name]
            signal = plane.mean - e.dark.mean_dn(name, level.exposure_s)
            share = signal / e.saturation.signal_dn[name]
            if clipped or plane.repeats < 2 or share < 0.1:
                continue
            candidates.append((0.3 <= share <= 0.7, plane.repeats, -abs(share - 0.5), signal, plane))
        if not candidates:
            continue
        _, _, distance, signal, plane = max(candidates, key=lambda c: c[:3])
        spread, spread_std = root(plane.pattern_variance - dark_variance, plane.pattern_variance_std)
        values.append(100.0 * spread / signal)
        stds.append(100.0 * spread_std / signal)
        levels.append((distance, plane.defects))
    if not values:
        e.remarks.add("no unsaturated flats above 10 % of saturation: the PRNU isn't determined; expose longer")
        return None, None
    farthest = -min(levels)[0]
    if farthest > 0.2:
        e.remarks.add(
            f"PRNU comes from flats as far as {100 * farthest:.0f} % from half of saturation, where it should be taken"
        )
    outliers = sum(count for _, count in levels) - e.levels.defects
    if outliers > 0:
        e.remarks.add(f"{outliers} pixels respond more than {DEFECT_SIGMA:g} standard deviations off: left out of PRNU")
    weight = 1.0 / np.maximum(np.array(stds), 1e-9) ** 2
    value = float(np.sum(weight * values) / weight.sum())
    chi2 = float(np.sum(weight * (np.array(values) - value) ** 2))
    return value, float(np.sqrt(chi2_factor(chi2, len(values) - 1) / weight.sum()))


def dark_pattern(e: Evaluation) -> tuple[MeasuredLevel, float, float] | None:
    """The darks that determine the fixed pattern best (most repeats, then shortest), its variance, DN^2, and the
    standard deviation of that.
    """
    repeated = [level for level in e.levels.darks if level.repeats > 1]
    if not repeated:
        return None
    level = max(repeated, key=lambda level: (level.repeats, -level.exposure_s))
    own = [level.plane[name] for name in e.levels.names]
    pixels = np.array([plane.pixels for plane in own], float)
    pixels /= pixels.sum()
    value = float(pixels @ [plane.spatial_variance for plane in own])
    return level, value, float(np.sqrt(np.sum((pixels * [plane.spatial_variance_std for plane in own]) ** 2)))


def remark_on_shading(e: Evaluation) -> None:
    """Report light that differs between opposite edges: cos^4 doesn't, a lamp off the axis or a decentred lens does."""
    edges: list[tuple[float, ...]] = []
    for level in e.levels.flats:
        for name in e.levels.names:
            plane = level.plane[name]
            share = (plane.mean - e.dark.lines[name].black) / e.saturation.signal_dn[name]
            if 0.3 <= share <= 0.7 and not e.saturation.clipped[name][e.levels.flats.index(level)]:
                lift = plane.mean / (plane.mean - e.dark.lines[name].black)
                edges.append(tuple(1.0 + lift * (e - 1.0) for e in (*plane.shading_rows, *plane.shading_columns)))
    if not edges:
        return
    first_row, last_row, first_col, last_col = np.mean(edges, axis=0)
    found = [
        f"{axis} from {first:.3f} in their first tenth to {last:.3f} in their last"
        for axis, first, last in (("rows", first_row, last_row), ("columns", first_col, last_col))
        if abs(last - first) > ASYMMETRY
    ]
    if found:
        e.remarks.add(f"the flats' shading is asymmetric: {'; '.join(found)}, of the mean")
