"""Lateral colour of boards: displacement of the corners in red and blue from those in green."""

from __future__ import annotations

import numpy as np

from lab.diagnose.measurements.block import Block, Effects, Label, Measurement, Prediction
from lab.diagnose.measurements.boards import FEWEST_CORNERS, views_of
from lab.diagnose.measurements.lateral_colour import COLOUR_FLOOR_PX, colour_shift_px
from lab.diagnose.measurements.study import Study
from lab.errors import NotDetermined
from lab.fit.geometry.board_detection import channel_corners
from sim.spectrum import FloatArray

COLOUR_VIEWS = 8  # of more views, evenly spaced ones are used, at least as many: every corner is fitted once a channel
COLOUR_RINGS = (0.3, 0.6, 1.0)  # outer radii of the rings, half diagonals; the last ring has no end


def board_colour_block(study: Study) -> Block:
    """Radial displacement (px) of the corners in red and blue from those in green, by rings about the frame's middle.

    Raises NotDetermined for a camera without a green channel, without charuco captures, and with too few corners.
    """
    if "G" not in study.channels:
        raise NotDetermined("board_colour", "one channel: nothing to hold it against")
    views, missed = views_of(study, study.side)
    if not views and not missed:
        raise NotDetermined("board_colour", "no charuco captures")
    views = views[:: max(1, len(views) // COLOUR_VIEWS)]
    camera = study.camera
    half = camera.half_diagonal_px
    points: dict[str, list[FloatArray]] = {c: [] for c in study.channels if c != "G"}
    for k, view in enumerate(views):
        fits = channel_corners(study.recordings.frame(view.capture), camera.cfa, view)
        away = view.image_px - 0.5 * (np.array([camera.cols, camera.rows]) - 1.0)
        radius = np.hypot(*away.T)
        for channel, gathered in points.items():
            use = fits[channel].trusted & fits["G"].trusted & (radius > 0.05 * half)
            gap = (fits[channel].points - fits["G"].points)[use]
            unit = (away / np.maximum(radius, 1e-9)[:, None])[use]
            n = int(use.sum())
            gathered.append(np.column_stack([radius[use] / half, unit, gap, np.full(n, k)]))
    values, variances, labels = [], [], []
    for channel, parts in points.items():
        for held_out in (False, True):
            table = np.concatenate(
                [p for i, p in enumerate(parts) if (i % 3 == 1 and len(parts) >= 3) == held_out] or [np.zeros((0, 6))]
            )
            found = _rings(table)
            ids = tuple(v.capture.id for i, v in enumerate(views) if (i % 3 == 1 and len(views) >= 3) == held_out)
            for r, value, variance in found:
                values.append(value)
                variances.append(variance + COLOUR_FLOOR_PX**2)
                labels.append(Label(r, channel, "outwards", ids, held_out))
    if not values:
        raise NotDetermined("board_colour", "too few corners are clear in every colour")
    light = None

    def predict(effects: Effects) -> Prediction:
        mean = np.zeros(len(labels))
        if effects:
            mean = np.array(
                [colour_shift_px(study, label.channel, label.x, light, effects, "charuco") for label in labels]
            )
        return Prediction(mean, {})

    return Block(
        measurement=BOARD_COLOUR, reach=0.5, value=np.array(values),
        covariance=np.diag(variances), labels=tuple(labels), reads=frozenset({"image.shift"}), predict=predict,
        scale=np.ones(len(values)),
    )  # fmt: skip


def _rings(table: FloatArray) -> list[tuple[float, float, float]]:
    """Of each ring with corners enough: mean distance (half diagonals), outward displacement (px) and its variance (px^2).

    `table` (corners, 6): distance, outward unit vector (x, y), displacement (x, y) in px, number of the view. Least squares of
    displacement = common shift + outward unit vector x displacement of the ring. The common shift, as of a prism, is no lateral
    colour and isn't returned. Outliers beyond 6 robust standard deviations are left out. The variance is the larger of that of
    independent corners and of the sandwich estimate clustered by view.
    """
    if len(table) < 4 * FEWEST_CORNERS:
        return []
    radius, unit, gap, view = table[:, 0], table[:, 1:3], table[:, 3:5], table[:, 5]

    edges = (0.0, *COLOUR_RINGS[:-1], np.inf)
    which = np.digitize(radius, edges[1:-1])
    used = [k for k in range(len(COLOUR_RINGS)) if (which == k).sum() >= FEWEST_CORNERS]
    keep = np.isin(which, used)
    columns = [
        np.column_stack([np.ones(len(table)), np.zeros(len(table))]),
        np.column_stack([np.zeros(len(table)), np.ones(len(table))]),
    ]
    columns += [np.where((which == k)[:, None], unit, 0.0) for k in used]
    design = np.array([c[keep].ravel() for c in columns]).T
    seen = gap[keep].ravel()
    solution, *_ = np.linalg.lstsq(design, seen, rcond=None)
    rest = seen - design @ solution
    inside = np.abs(rest) < 6.0 * 1.4826 * float(np.median(np.abs(rest))) + 1e-9
    solution, *_ = np.linalg.lstsq(design[inside], seen[inside], rcond=None)
    rest = np.where(inside, seen - design @ solution, 0.0)
    inverse = np.linalg.pinv(design[inside].T @ design[inside])
    # corners of one view share errors
    groups = np.repeat(view[keep], 2)
    meat = np.zeros_like(inverse)
    for k in np.unique(groups):
        score = design[groups == k].T @ rest[groups == k]
        meat += np.outer(score, score)
    plain = float(np.mean(rest[inside] ** 2)) * inverse
    spread = inverse @ meat @ inverse
    found = []
    for i, k in enumerate(used):
        at = 2 + i
        found.append((float(radius[which == k].mean()), float(solution[at]), float(max(spread[at, at], plain[at, at]))))
    return found


BOARD_COLOUR = Measurement(
    "board_colour",
    title="lateral colour of boards",
    order=510,
    axis="field",
    unit="half diagonals",
    make=board_colour_block,
    quantity="displacement from green, px",
)
