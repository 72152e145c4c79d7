"""Boards: their corners against the geometry, and the lateral colour of boards and patterns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from lab.errors import NotDetermined
from lab.formats.results import Skipped
from lab.observables.boards.bundle_adjustment import BundleAdjustment, Solution
from lab.observables.boards.calibration import (
    PROJECTIONS,
    Calibration,
    calibrate_robustly,
    free_intrinsics,
    observations_of,
)
from lab.observables.boards.detection import BoardView, channel_corners, find_boards
from lab.observables.boards.projection import CameraGeometry
from lab.observables.dataset import Study
from lab.observables.observable import Block, Label, Measurement, Prediction
from lab.observables.reads import SHIFT
from lab.observables.screens.pattern_fit import ACROSS, RADIAL, RADIAL3, Pattern, patterns
from sim.camera import Side
from sim.effects.base import Effects
from sim.point import displaced_um
from sim.scene.projection import Projection
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import Uniform

ROWS, COLS = 3, 4  # cells of the frame
FEWEST_CORNERS = 6  # of a cell
CELL_FLOOR_PX = 0.006  # standard deviation of a cell's displacement beside noise
#: Prior standard deviation of a known distortion, at the frame's corner, of each of its terms.
CALIBRATED_STD_PX = 0.05
HELD_OUT_FROM = 6  # views; of as many or more, every third is held out
REFERENCE_NM = 550.0  # light in which effects displace corners: green


def views_of(study: Study, side: Side) -> tuple[list[BoardView], list[Skipped]]:
    """Return the boards found in the charuco captures of a side, and the captures in which none was found. Computed
    once a study."""
    kept: dict[Side, tuple[list[BoardView], list[Skipped]]] = study.once(_no_views)
    if side not in kept:
        kept[side] = find_boards(study.recordings, side)
    return kept[side]


def _no_views(_: Study) -> dict[Side, tuple[list[BoardView], list[Skipped]]]:
    return {}


def calibration_of(study: Study) -> Calibration:
    """Return the side's camera, calibrated by its boards. Raises NotDetermined where they don't determine it."""
    views, missed = views_of(study, study.side)
    if not views and not missed:
        raise NotDetermined("boards", "no charuco captures")
    try:
        return calibrate_robustly(views, (study.camera.rows, study.camera.cols), study.side)
    except NotDetermined as refused:
        raise NotDetermined("boards", refused.reason) from refused


@dataclass(frozen=True)
class _Corners:
    """The n corners of all views, linearised about the solution of the bundle adjustment."""

    place: FloatArray  # (n, 2), (x, y) px
    left: FloatArray  # (n, 2), residuals: measured less predicted, px
    taken: FloatArray  # (2 n, k), orthonormal: spans the shifts that the fitted parameters can make
    noise_px: float  # standard deviation of a coordinate
    view: FloatArray  # (n,) number of the corner's view

    @staticmethod
    def of(views: Sequence[BoardView], solution: Solution, bundle: BundleAdjustment) -> _Corners:
        shared, by_pose = bundle.jacobian(solution.state)
        n = len(shared)
        free = shared.reshape(2 * n, -1)
        poses = np.zeros((2 * n, 6 * len(views)))
        for k, part in enumerate(bundle.parts):
            poses[2 * part.start : 2 * part.stop, 6 * k : 6 * k + 6] = by_pose[part].reshape(-1, 6)
        whole = np.concatenate([free, poses], axis=1)
        size = np.linalg.norm(whole, axis=0)
        u, s, _ = linalg.svd(whole[:, size > 0] / size[size > 0], full_matrices=False)
        return _Corners(
            place=np.concatenate([v.image_px for v in views]),
            left=np.asarray(bundle.residuals(solution.state), float),
            taken=np.asarray(u[:, s > 1e-9 * s[0]]),
            noise_px=solution.noise_px,
            view=np.concatenate([np.full(len(v.index), k) for k, v in enumerate(views)]),
        )


def board_block(study: Study) -> Block:
    """Mean residual of the corners (px), along and across the radius, by cell of the frame.

    Raises NotDetermined without charuco captures, where they don't determine the camera, and where no cell holds
    `FEWEST_CORNERS` corners.
    """
    found = calibration_of(study)
    known = study.camera.geometry
    views, state, shape = found.views, found.solution.state, found.shape
    if known is None:
        own = found.camera.projection
        free = found.solution.free[0] | free_intrinsics(PROJECTIONS[own.kind], own)
    else:
        free = free_intrinsics(())
        # focal length and principal point as of these boards, distortion as of the earlier calibration
        fixed = CameraGeometry.of(known.camera_matrix, known.distortion, Projection.of(known))
        start = np.array([np.concatenate([state.intrinsics[0, :4], fixed.intrinsics[4:]])])
        state = replace(state, projections=(fixed.projection,), intrinsics=start)
    bundle = BundleAdjustment(observations_of(views), free[None, :], shape)
    solution = bundle.solve(state)
    corners = _Corners.of(views, solution, bundle)
    noise_px = min(corners.noise_px, found.solution.noise_px)
    cells = _cells(study, corners, len(views))
    if not cells:
        raise NotDetermined("boards", f"no part of the frame holds {FEWEST_CORNERS} corners")
    mean, labels, views_of_cell = _averages(study, corners, cells)
    projected = mean - (mean @ corners.taken) @ corners.taken.T
    covariance = noise_px**2 * projected @ projected.T
    covariance += np.diag(np.full(len(labels), CELL_FLOOR_PX**2))
    covariance += np.diag(_between_views(corners, mean, noise_px) / np.maximum(views_of_cell, 1.0))
    jacobian = {} if known is None else _calibrated(corners, projected, solution, shape)
    captures = [v.capture.id for v in views]

    def predict(effects: Effects) -> Prediction:
        shifts = shifts_px(study, corners.place, effects)
        return Prediction(projected @ shifts.ravel(), jacobian)

    return Block(
        measurement=BOARDS, reach=0.4, value=mean @ corners.left.ravel(),
        covariance=covariance,
        labels=tuple(Label(r, "Y", way, tuple(captures[k] for k in used), out) for r, way, used, out in labels),
        reads=frozenset({"image.shift"}), predict=predict, scale=np.ones(len(labels)),
    )  # fmt: skip


def shifts_px(study: Study, place: FloatArray, effects: Effects) -> FloatArray:
    """Displacement (n, 2) of the image by the effects, px, at `place` (n, 2), (x, y) px, at `REFERENCE_NM`."""
    camera = study.camera
    pitch = camera.pixel_pitch_um
    x, y = ((place[:, k] - 0.5 * (n - 1)) * pitch for k, n in ((0, camera.cols), (1, camera.rows)))
    shift = displaced_um(camera, x, y, REFERENCE_NM, effects)
    return np.zeros_like(place) if shift is None else np.column_stack(shift) / pitch


def _cells(study: Study, corners: _Corners, views: int) -> list[tuple[np.ndarray, bool]]:
    """(mask of its corners (n,), whether held out) of each cell of the frame with corners enough, seen and held-out
    views apart."""
    camera = study.camera
    row = np.clip((corners.place[:, 1] + 0.5) / camera.rows * ROWS, 0, ROWS - 1e-9).astype(int)
    col = np.clip((corners.place[:, 0] + 0.5) / camera.cols * COLS, 0, COLS - 1e-9).astype(int)
    out = (corners.view % 3 == 1) & (views >= HELD_OUT_FROM)
    found = []
    for cell in range(ROWS * COLS):
        for held_out in (False, True):
            use = (row * COLS + col == cell) & (out == held_out)
            if use.sum() >= FEWEST_CORNERS:
                found.append((use, held_out))
    return found


def _averages(
    study: Study, corners: _Corners, cells: Sequence[tuple[np.ndarray, bool]]
) -> tuple[FloatArray, list[tuple[float, str, list[int], bool]], FloatArray]:
    """Weights (2 cells, 2 n) that average shifts along and across the radius; (radius, direction, views, held out) and
    the number of views of each."""
    camera = study.camera
    away = corners.place - 0.5 * (np.array([camera.cols, camera.rows]) - 1.0)
    radius = np.hypot(*away.T)
    unit = away / np.maximum(radius, 1e-9)[:, None]
    half = camera.half_diagonal_px
    rows, labels, counts = [], [], []
    for use, held_out in cells:
        seen = sorted({int(k) for k in corners.view[use]})
        for way, direction in (("along the radius", unit), ("across it", unit[:, ::-1] * [-1.0, 1.0])):
            rows.append(np.where(use[:, None], direction / use.sum(), 0.0).ravel())
            labels.append((float(radius[use].mean() / half), way, seen, held_out))
            counts.append(float(len(seen)))
    return np.array(rows), labels, np.array(counts)


def _between_views(corners: _Corners, mean: FloatArray, noise_px: float) -> float:
    """Variance (px^2) of a view's mean residual over a cell beyond that of independent corners: imperfect prints,
    motion, shading.

    The mean over views of (mean residual)^2 - noise^2 / n, of views with n >= 4 corners in the cell; at least 0.
    """
    excess, count = 0.0, 0
    for weight in mean:
        members = weight.reshape(-1, 2)
        for k in np.unique(corners.view[np.any(members != 0, axis=1)]):
            part = np.where((corners.view == k)[:, None], members, 0.0)
            total = float(np.linalg.norm(part, axis=1).sum())
            n = int(np.any(part != 0, axis=1).sum())
            if n >= 4:
                excess += float(np.sum(part * corners.left) / total) ** 2 - noise_px**2 / n
                count += 1
    return max(excess / count, 0.0) if count else 0.0


def _calibrated(
    corners: _Corners, projected: FloatArray, solution: Solution, shape: tuple[int, int]
) -> dict[str, FloatArray]:
    """Jacobian by the terms of a known distortion, as nuisance parameters: name -> (2 cells,), px per
    `CALIBRATED_STD_PX` at the frame's corner."""
    intrinsics = solution.state.intrinsics[0]
    focal = float(intrinsics[0])
    x, y = ((corners.place[:, k] - intrinsics[2 + k]) / focal for k in (0, 1))
    r2 = x * x + y * y
    corner = 0.25 * float(np.hypot(*shape)) ** 2 / focal**2
    terms = {
        "k1": (x * r2, y * r2, corner**1.5),
        "k2": (x * r2**2, y * r2**2, corner**2.5),
        "k3": (x * r2**3, y * r2**3, corner**3.5),
        "p1": (2 * x * y, r2 + 2 * y * y, 3 * corner),
        "p2": (r2 + 2 * x * x, 2 * x * y, 3 * corner),
    }
    return {
        f"boards:{name}": CALIBRATED_STD_PX / size * projected @ np.column_stack([dx, dy]).ravel()
        for name, (dx, dy, size) in terms.items()
    }


BOARDS = Measurement(
    "boards",
    title="corners of boards",
    order=500,
    axis="field",
    unit="half diagonals",
    make=board_block,
    quantity="shift of corners, px",
    conditions="direction",
    conditions_words="corners",
)


# ----------------------------------------------------------------------------------------------------------------------
# Lateral colour of boards: displacement of the corners in red and blue from those in green, and between wavelengths.


# --- lateral colour --------------------------------------------------------------------------------------------------
# Lateral colour of a pattern on a screen: displacement of its red and blue images from the green one.


# standard deviation beside noise: where cells are whole pixels, errors of the drawn pattern don't average out
COLOUR_FLOOR_PX = 0.012


def colour_block(study: Study) -> Block:
    """Displacement (px) of a pattern's red and blue images from the green one: radial at two distances from the frame's
    middle, and tangential at one.

    Raises NotDetermined for a camera without a green channel, and where no pattern is fitted.
    """
    if "G" not in study.channels:
        raise NotDetermined("lateral_colour", "one channel: nothing to hold it against")
    points: list[tuple[Pattern, Pattern]] = []
    for group in patterns(study):
        for p in group:
            if p.channel != "G":
                green = next(q for q in group if q.channel == "G" and q.held_out == p.held_out)
                points.append((p, green))
    values, labels, places = [], [], []
    n = len(points)
    covariance = np.zeros((3 * n, 3 * n))
    for i, (p, green) in enumerate(points):
        near, far = 0.5 * p.reach, p.reach
        table = np.array([[near, near**3, 0.0], [far, far**3, 0.0], [0.0, 0.0, far]])
        at = np.array([len(p.bands) + k for k in (RADIAL, RADIAL3, ACROSS)])
        values.append(table @ (p.value[at] - green.value[at]))
        for j, (q, other) in enumerate(points):
            if p.channel != q.channel or p.light is not q.light:
                continue
            # only these coefficients: channels may have different numbers of parts beyond the bands
            own = np.ix_(at, at)
            both = 0.5 * np.sum([one.common[own] for one in (p, q, green, other)], axis=0)
            if i == j:
                both = both + p.shown[own] + green.shown[own]
            covariance[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = table @ both @ table.T
        for k, (distance, way) in enumerate(((near, "outwards"), (far, "outwards"), (far, "around"))):
            labels.append(Label(distance, p.channel, way, p.captures, p.held_out))
            places.append((p, distance, k < 2))

    def predict(effects: Effects) -> Prediction:
        mean = np.zeros(len(places))
        if effects:
            for k, (p, distance, outwards) in enumerate(places):
                if outwards:
                    mean[k] = colour_shift_px(study, p.channel, distance, p.light, effects)
        return Prediction(mean, {})

    return Block(
        measurement=LATERAL_COLOUR, reach=0.5, value=np.concatenate(values),
        covariance=covariance + np.diag(np.full(3 * n, COLOUR_FLOOR_PX**2)), labels=tuple(labels),
        reads=SHIFT, predict=predict, scale=np.ones(3 * n),
    )  # fmt: skip


def colour_shift_px(
    study: Study, channel: str, distance: float, light: Spectrum | None, effects: Effects, kind: str = "bernoulli"
) -> float:
    """Predicted radial displacement of a channel's image from the green one, px, at `distance` (half diagonals) from
    the middle.

    It is the mean over four directions of the displacement by the effects, weighted over wavelengths by the photons
    that each channel detects. `light` None: a flat spectrum; `kind`: of the capture.
    """
    wavelength = np.arange(400.0, 721.0, 10.0)
    outwards = outward_shifts_px(study, distance, wavelength, effects)
    if not outwards.any():
        return 0.0
    radiance = np.ones_like(wavelength) if light is None else light.at(wavelength)
    model = Uniform(study.camera, effects)
    radiance = model.radiance(wavelength, radiance, kind) * model.transmittance(wavelength)
    seen = [radiance * wavelength * study.camera.quantum_efficiency[c].at(wavelength) for c in (channel, "G")]
    own, green = (float(s @ outwards / max(s.sum(), 1e-300)) for s in seen)
    return own - green


def outward_shifts_px(study: Study, distance: float, wavelength_nm: FloatArray, effects: Effects) -> FloatArray:
    """Predicted displacement outwards (n,), px, of light of n wavelengths at `distance` (half diagonals) from the
    middle: the mean over four directions."""
    camera = study.camera
    turn = np.pi / 4.0 + np.pi / 2.0 * np.arange(4)
    x, y = (distance * camera.half_diagonal_um * way for way in (np.cos(turn), np.sin(turn)))
    outwards = np.zeros(len(wavelength_nm))
    for i, w in enumerate(wavelength_nm):
        shift = displaced_um(camera, x, y, float(w), effects)
        if shift is not None:
            outwards[i] = float(np.mean(shift[0] * np.cos(turn) + shift[1] * np.sin(turn)))
    return outwards / camera.pixel_pitch_um


LATERAL_COLOUR = Measurement(
    "lateral_colour",
    title="lateral colour of patterns",
    order=440,
    axis="field",
    unit="half diagonals",
    make=colour_block,
    quantity="displacement from green, px",
    conditions="direction",
)


# --- board colour ------------------------------------------------------------


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
    views, missed = views_of(study, study.side)
    if not views:
        raise NotDetermined("board_colour", "no board is found" if missed else "no charuco captures")
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
            "under "
            "one `pose`",
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
        fits = channel_corners(study.recordings.frame(view.capture), study.camera.cfa, view)
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
