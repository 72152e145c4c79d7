"""Lateral colour of boards: displacement of corners in red and blue from those in green, and between wavelengths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.errors import NotDetermined
from lab.observables.boards.corners import board_corners, channel_corners, plane_corners
from lab.observables.boards.residuals import FEWEST_CORNERS
from lab.observables.boards.shift_fit import fit_shift
from lab.observables.boards.views import BoardView
from lab.observables.colour_shift import REFERENCE_NM, colour_shift_px, outward_shifts_px
from lab.observables.dataset import Dataset
from lab.observables.observable import Label, Measurement, Observable, Prediction
from sim.effects.base import Effects
from sim.spectrum import FloatArray

COLOUR_VIEWS = 8  # of more views, evenly spaced ones are used, at least as many: every corner is fitted once a plane
COLOUR_RINGS = (0.3, 0.6, 1.0)  # outer radii of the rings, half diagonals; the last ring has no end
LEAST_RADIUS = 0.05  # half diagonals: nearer to the middle, no direction is outwards


@dataclass(frozen=True)
class _Gaps:
    """Displacements of n corners of one view, of one colour against another.

    `radius` (n,), half diagonals; `unit` (n, 2): outwards; `gap` (n, 2), (x, y) px. `corner` (n,): of the view against
    which they are displaced; gaps of different colours at one corner share the noise of that.
    """

    radius: FloatArray
    unit: FloatArray
    gap: FloatArray
    corner: list[tuple[str, int]]

    @staticmethod
    def of(dataset: Dataset, view: BoardView, gap: FloatArray, use: NDArray[np.bool_]) -> _Gaps:
        """Return those of the corners of `view` that `use` (n,) marks, without those near the middle."""
        camera = dataset.camera
        away = view.image_px - 0.5 * (np.array([camera.cols, camera.rows]) - 1.0)
        radius = np.hypot(*away.T) / camera.half_diagonal_px
        use = use & (radius > LEAST_RADIUS)
        unit = away[use] / (radius[use, None] * camera.half_diagonal_px)
        corner = [(view.capture.id, int(number)) for number in view.index[use]]
        return _Gaps(radius[use], unit, gap[use], corner)


@dataclass(frozen=True)
class _Shift:
    """What is displaced from what: the gaps of each view, and the captures of each.

    `pair`: wavelength (nm) and the one that it is compared with, of pictures of one pose in light of one wavelength
    each; None: `channel` against green within pictures in white light.
    """

    channel: str
    pair: tuple[float, float] | None
    gaps: list[_Gaps]
    captures: list[tuple[str, ...]]

    @property
    def condition(self) -> str:
        """The light in words."""
        return "white light" if self.pair is None else f"light of {self.pair[0]:g} nm against {self.pair[1]:g} nm"


@dataclass(frozen=True)
class _Ring:
    """One ring: mean distance of its corners (half diagonals), their displacement outwards (px), and what each corner's
    residual contributes to it (px), by corner."""

    radius: float
    outwards_px: float
    influence: dict[tuple[str, int], float]


def measure_board_colour(dataset: Dataset) -> Observable:
    """Radial displacement (px) of corners or dots, by rings about the frame's middle: in red and blue from those in
    green, and of pictures of one pose in light of single wavelengths from the one nearest `REFERENCE_NM`.

    Raises NotDetermined without boards, where there is neither a green channel nor a pose in light of two wavelengths,
    and with too few corners.
    """
    boards = board_corners(dataset.recordings, dataset.side)
    views = boards.views
    if not views:
        raise NotDetermined("board_colour", "no board is found" if boards.missed else "no charuco captures")
    white = [view for view in views if view.capture.wavelength_nm is None] if "G" in dataset.channels else []
    shifts = _within_pictures(dataset, white) + _between_pictures(dataset, views)
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
    rings: list[_Ring] = []
    labels: list[Label] = []
    pairs: list[tuple[float, float] | None] = []
    for shift in shifts:
        n = len(shift.gaps)
        for held_out in (False, True):
            use = [i for i in range(n) if (i % 3 == 1 and n >= 3) == held_out]
            ids = tuple(name for i in use for name in shift.captures[i])
            for ring in _rings([shift.gaps[i] for i in use]):
                rings.append(ring)
                labels.append(Label(ring.radius, shift.channel, shift.condition, ids, held_out))
                pairs.append(shift.pair)
    if not rings:
        raise NotDetermined("board_colour", "too few corners are clear in every colour")

    def predict(effects: Effects) -> Prediction:
        mean = np.zeros(len(labels))
        for k, (label, pair) in enumerate(zip(labels, pairs, strict=True) if effects else ()):
            if pair is None:
                mean[k] = colour_shift_px(dataset, label.channel, label.x, None, effects, "charuco")
            else:
                own, other = outward_shifts_px(dataset, label.x, np.array(pair), effects)
                mean[k] = own - other
        return Prediction(mean, {})

    return Observable(
        measurement=BOARD_COLOUR, reach=0.5, value=np.array([ring.outwards_px for ring in rings]),
        covariance=_covariance(rings), labels=tuple(labels),
        reads=frozenset({"image.shift"}), predict=predict, scale=np.ones(len(rings)),
    )  # fmt: skip


def _within_pictures(dataset: Dataset, views: Sequence[BoardView]) -> list[_Shift]:
    """Of each channel but green, in pictures in white light."""
    views = views[:: max(1, len(views) // COLOUR_VIEWS)]
    found = {c: _Shift(c, None, [], []) for c in dataset.channels if c != "G"} if views else {}
    for view in views:
        fits = channel_corners(plane_corners(dataset.recordings, view), dataset.camera.cfa)
        for channel, shift in found.items():
            use = fits[channel].trusted & fits["G"].trusted
            shift.gaps.append(_Gaps.of(dataset, view, fits[channel].points - fits["G"].points, use))
            shift.captures.append((view.capture.id,))
    return [*found.values()]


def _between_pictures(dataset: Dataset, views: Sequence[BoardView]) -> list[_Shift]:
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
            gap, seen = np.zeros(other.image_px.shape), np.zeros(len(other.index), bool)
            gap[of_other], seen[of_other] = view.image_px[own] - other.image_px[of_other], True
            shift.gaps.append(_Gaps.of(dataset, other, gap, seen))
            shift.captures.append((view.capture.id, other.capture.id))
    return [*found.values()]


def _rings(gaps: Sequence[_Gaps]) -> list[_Ring]:
    """Return the rings with corners enough.

    Robust least squares (`fit_shift`) of displacement = shift of the view + outward unit vector x displacement of the
    ring. The shift of a view is no lateral colour and isn't returned: a prism shifts all views, and where a board is
    aligned with the pixels, a plane's samples meet all its edges at one phase, which shifts the view by tenths of a px.
    """
    if sum(len(one.radius) for one in gaps) < 4 * FEWEST_CORNERS:
        return []
    radius, unit, gap = (np.concatenate([getattr(one, name) for one in gaps]) for name in ("radius", "unit", "gap"))
    corner = [key for one in gaps for key in one.corner]
    which = np.digitize(radius, COLOUR_RINGS[:-1])
    used = [k for k in range(len(COLOUR_RINGS)) if (which == k).sum() >= FEWEST_CORNERS]
    keep = np.flatnonzero(np.isin(which, used))
    jacobian = np.zeros((len(keep), 2, len(used) + 2 * len(gaps)))
    for i, k in enumerate(used):
        jacobian[:, :, i] = np.where((which == k)[:, None], unit, 0.0)[keep]
    view = np.concatenate([np.full(len(one.radius), n) for n, one in enumerate(gaps)])[keep]
    for way in (0, 1):
        jacobian[np.arange(len(keep)), way, len(used) + 2 * view + way] = 1.0
    fit = fit_shift(gap[keep], jacobian)
    return [
        _Ring(
            float(radius[which == k].mean()),
            float(fit.values[i]),
            {corner[n]: float(fit.influence[m, i]) for m, n in enumerate(keep)},
        )
        for i, k in enumerate(used)
    ]


def _covariance(rings: Sequence[_Ring]) -> FloatArray:
    """Covariance (n, n), px^2, of the rings' displacements: of independent corners, some of which several colours
    share, enlarged where the corners of a view have errors in common, which a sandwich clustered by view shows."""
    corners = list(dict.fromkeys(key for ring in rings for key in ring.influence))
    influence = np.array([[ring.influence.get(key, 0.0) for key in corners] for ring in rings])
    covariance = influence @ influence.T
    views = np.array([name for name, _ in corners])
    by_view = np.stack([influence[:, views == name].sum(axis=1) for name in dict.fromkeys(views)], axis=1)
    larger = np.sqrt(np.maximum(np.sum(by_view**2, axis=1) / np.maximum(np.diag(covariance), 1e-300), 1.0))
    return np.asarray(covariance * np.outer(larger, larger))


BOARD_COLOUR = Measurement(
    "board_colour",
    title="lateral colour of boards",
    order=510,
    axis="field",
    unit="half diagonals",
    make=measure_board_colour,
    quantity="displacement from green, or from the reference wavelength, px",
    conditions="light",
    conditions_words="in",
)
