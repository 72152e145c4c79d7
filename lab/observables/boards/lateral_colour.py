"""Lateral colour of boards: displacement of corners in red and blue from those in green, and between wavelengths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.errors import NotDetermined
from lab.observables.boards.corners import board_corners, channel_corners, plane_corners
from lab.observables.boards.residuals import FEWEST_CORNERS
from lab.observables.boards.views import BoardView
from lab.observables.colour_shift import COLOUR_FLOOR_PX, REFERENCE_NM, colour_shift_px, outward_shifts_px
from lab.observables.dataset import Study
from lab.observables.observable import Block, Label, Measurement, Prediction
from sim.effects.base import Effects
from sim.spectrum import FloatArray

Array = NDArray[np.floating[Any]]

COLOUR_VIEWS = 8  # of more views, evenly spaced ones are used, at least as many: every corner is fitted once a channel
COLOUR_RINGS = (0.3, 0.6, 1.0)  # outer radii of the rings, half diagonals; the last ring has no end


@dataclass(frozen=True)
class _Shift:
    """What is displaced from what: `table` of `_rings` of each view, and the captures of each.

    `pair`: wavelength (nm) and the one that it is held against, of pictures of one pose in light of one wavelength
    each; None: `channel` against green within pictures in white light.
    """

    channel: str
    pair: tuple[float, float] | None
    tables: list[FloatArray]
    captures: list[tuple[str, ...]]

    @property
    def condition(self) -> str:
        """The light in words."""
        return "white light" if self.pair is None else f"light of {self.pair[0]:g} nm against {self.pair[1]:g} nm"


def board_colour_block(study: Study) -> Block:
    """Radial displacement (px) of corners or dots, by rings about the frame's middle: in red and blue from those in
    green, and of pictures of one pose in light of single wavelengths from the one nearest `REFERENCE_NM`.

    Raises NotDetermined without boards, where there is neither a green channel nor a pose in light of two wavelengths,
    and with too few corners.
    """
    boards = board_corners(study.recordings, study.side)
    views = boards.views
    if not views:
        raise NotDetermined("board_colour", "no board is found" if boards.missed else "no charuco captures")
    white = [view for view in views if view.capture.wavelength_nm is None] if "G" in study.channels else []
    shifts = _within_pictures(study, white) + _between_pictures(study, views)
    if not shifts:
        lit = len({view.capture.wavelength_nm for view in views} - {None})
        raise NotDetermined(
            "board_colour",
            f"boards in light of {lit} wavelengths, but no pose in two of them: nothing to hold them against; give the "
            "pictures of one pose the same `pose`"
            if lit > 1
            else "one channel or one wavelength: nothing to hold it against; take a pose in light of two wavelengths, "
            "under one `pose`",
        )
    values, variances, labels, pairs = [], [], [], []
    for shift in shifts:
        n = len(shift.tables)
        for held_out in (False, True):
            use = [i for i in range(n) if (i % 3 == 1 and n >= 3) == held_out]
            ids = tuple(name for i in use for name in shift.captures[i])
            for r, value, variance in _rings(np.concatenate([shift.tables[i] for i in use] or [np.zeros((0, 6))])):
                values.append(value)
                variances.append(variance + COLOUR_FLOOR_PX**2)
                labels.append(Label(r, shift.channel, shift.condition, ids, held_out))
                pairs.append(shift.pair)
    if not values:
        raise NotDetermined("board_colour", "too few corners are clear in every colour")

    def predict(effects: Effects) -> Prediction:
        mean = np.zeros(len(labels))
        for k, (label, pair) in enumerate(zip(labels, pairs, strict=True) if effects else ()):
            if pair is None:
                mean[k] = colour_shift_px(study, label.channel, label.x, None, effects, "charuco")
            else:
                own, other = outward_shifts_px(study, label.x, np.array(pair), effects)
                mean[k] = own - other
        return Prediction(mean, {})

    return Block(
        measurement=BOARD_COLOUR, reach=0.5, value=np.array(values),
        covariance=np.diag(variances), labels=tuple(labels), reads=frozenset({"image.shift"}), predict=predict,
        scale=np.ones(len(values)),
    )  # fmt: skip


def _within_pictures(study: Study, views: Sequence[BoardView]) -> list[_Shift]:
    """Of each channel but green, in pictures in white light."""
    views = views[:: max(1, len(views) // COLOUR_VIEWS)]
    found = {c: _Shift(c, None, [], []) for c in study.channels if c != "G"} if views else {}
    for k, view in enumerate(views):
        fits = channel_corners(plane_corners(study.recordings, view), study.camera.cfa)
        for channel, shift in found.items():
            use = fits[channel].trusted & fits["G"].trusted
            shift.tables.append(_table(study, view.image_px[use], (fits[channel].points - fits["G"].points)[use], k))
            shift.captures.append((view.capture.id,))
    return [*found.values()]


def _between_pictures(study: Study, views: Sequence[BoardView]) -> list[_Shift]:
    """Of each wavelength but the reference, in pictures of one pose: the first of each wavelength."""
    poses: dict[str, dict[float, BoardView]] = {}
    for view in views:
        if view.capture.wavelength_nm is not None:
            poses.setdefault(view.capture.pose, {}).setdefault(view.capture.wavelength_nm, view)
    found: dict[tuple[float, float], _Shift] = {}
    for by_wavelength in poses.values():
        reference_nm = min(by_wavelength, key=lambda w: abs(w - REFERENCE_NM))
        other = by_wavelength[reference_nm]
        for wavelength_nm, view in sorted(by_wavelength.items()):
            if wavelength_nm == reference_nm:
                continue
            pair = (wavelength_nm, reference_nm)
            shift = found.setdefault(pair, _Shift("Y", pair, [], []))
            _, own, of_other = np.intersect1d(view.index, other.index, return_indices=True)
            gap = view.image_px[own] - other.image_px[of_other]
            shift.tables.append(_table(study, other.image_px[of_other], gap, len(shift.tables)))
            shift.captures.append((view.capture.id, other.capture.id))
    return [*found.values()]


def _table(study: Study, place: Array, gap: Array, number: int) -> FloatArray:
    """Return the `table` of `_rings` of one view, from places and displacements (n, 2), (x, y) px, without those near
    the middle."""
    camera = study.camera
    half = camera.half_diagonal_px
    away = place - 0.5 * (np.array([camera.cols, camera.rows]) - 1.0)
    radius = np.hypot(*away.T)
    use = radius > 0.05 * half
    unit = away[use] / radius[use, None]
    return np.column_stack([radius[use] / half, unit, gap[use], np.full(int(use.sum()), number)])


def _rings(table: FloatArray) -> list[tuple[float, float, float]]:
    """Of each ring with corners enough: mean distance (half diagonals), outward displacement (px) and its variance
    (px^2).

    `table` (corners, 6): distance, outward unit vector (x, y), displacement (x, y) in px, number of the view. Least
    squares of displacement = common shift + outward unit vector x displacement of the ring. The common shift, as of a
    prism, is no lateral colour and isn't returned. Outliers beyond 6 robust standard deviations are left out. The
    variance is the larger of that of independent corners and of the sandwich estimate clustered by view.
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
    quantity="displacement from green, or from the reference wavelength, px",
    conditions="light",
    conditions_words="in",
)
