"""Two calibrations of one rig: what changed beyond its uncertainty.

Every number that a fit states with a standard deviation is compared, found by its name: `x` beside `x_std`. The
numbers of a curve or a kernel share one row: that of the point with the largest difference, corrected for the number
of points (Sidak). The geometry of cameras is also compared by its effect: both calibrations project the same points,
after the rigid motion that they imply between each other is removed (`lab.fit.geometry.projection_errors`). Parameters
that differ much may project alike, and the reverse.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.spatial.transform import Rotation

from lab.fit.geometry.pinhole import COUNT, NAMES, intrinsics_of_fit, project, unproject
from lab.fit.geometry.projection_errors import difference, grid, grid_points, implied_motion, seen_points
from lab.fit.tuples import triple
from lab.formats.results import (
    Change,
    ComparisonResult,
    Emva1288Points,
    FitResult,
    GeometryFit,
    PhotonTransfer,
    ProjectionChange,
    Skipped,
    StereoFit,
)
from sim.camera import Side
from sim.parameters import Frozen

Array = NDArray[np.floating[Any]]

FALSE_ALARM_RATE = 0.01
MIN_SEEN = 20  # fewest corners that determine an implied motion
ROUNDING = 1e-9  # relative standard deviation below which a value counts as exact
FEW = 9  # most numbers under one name with a row each; more are a curve
POINTS = (PhotonTransfer, Emva1288Points)  # points of plots, which aren't compared
OF_THE_SET_UP = {"angle_deg"}  # properties of the set-up, which aren't compared
AXES = ("wavelength_nm", "frequency_cy_per_px", "radius_px")


@dataclass(frozen=True)
class Numbers:
    """Values and standard deviations under one name, along `axis` where there is one."""

    name: str
    value: Array
    std: Array
    axis_name: str = ""
    axis: Array | None = None
    labels: tuple[str, ...] = ()


def compare(a: FitResult, b: FitResult, false_alarm_rate: float = FALSE_ALARM_RATE) -> ComparisonResult:
    """Differences between two fits of one rig, number by number.

    `false_alarm_rate`: probability of any `changed` between two calibrations of an unchanged rig. Numbers are taken as
    independent. They are not; the true rate is lower.
    """
    skipped: list[Skipped] = []
    rows: list[Change] = []
    projections: list[ProjectionChange] = []
    for side in dict.fromkeys((*a.cameras, *b.cameras)):
        if side not in a.cameras or side not in b.cameras:
            only = "A" if side in a.cameras else "B"
            skipped.append(Skipped(step="camera", reason=f"only {only} has this side", side=side))
            continue
        one, two = a.cameras[side], b.cameras[side]
        rows += _compared(dict(numbers_of(one, "")), dict(numbers_of(two, "")), side, skipped)
        if one.geometry is not None and two.geometry is not None:
            found = _projection(one.geometry, two.geometry, side)
            if isinstance(found, Skipped):
                skipped.append(found)
            else:
                projections.append(found)
    if a.stereo is not None and b.stereo is not None:
        rows += _compared(dict(numbers_of(a.stereo, "stereo ")), dict(numbers_of(b.stereo, "stereo ")), None, skipped)
        rows += _rotation_changes(a.stereo, b.stereo)
    elif (a.stereo is None) != (b.stereo is None):
        skipped.append(Skipped(step="stereo", reason=f"only {'A' if a.stereo else 'B'} has it"))
    threshold = sigma_of_probability(sidak_part(false_alarm_rate, len(rows) + len(projections)))
    return ComparisonResult(
        a=a.source,
        b=b.source,
        false_alarm_rate=false_alarm_rate,
        threshold_sigma=threshold,
        changes=tuple(row.model_copy(update={"changed": row.significance_sigma > threshold}) for row in rows),
        projection=tuple(
            item.model_copy(update={"changed": item.significance_sigma > threshold}) for item in projections
        ),
        skipped=tuple(skipped),
    )


# --- significance ----------------------------------------------------------------------------------------------------


def sigma_of_probability(p_value: float) -> float:
    """A probability as standard deviations of a normal distribution, two-sided."""
    return -float(special.ndtri(max(p_value, 1e-300) / 2.0))


def sidak_part(rate: float, number: int) -> float:
    """Probability allowed for each of `number` tests, so that any of them has `rate` (Sidak)."""
    return float(-np.expm1(np.log1p(-rate) / max(number, 1)))


def _sidak_whole(p_value: float, number: int) -> float:
    """Probability of a value so small among `number` tests (Sidak)."""
    return float(-np.expm1(number * np.log1p(-min(p_value, 1.0 - 1e-16))))


# --- numbers, by their names -----------------------------------------------------------------------------------------


def numbers_of(model: Frozen, prefix: str) -> Iterator[tuple[str, Numbers]]:
    """Every fitted number under `model`, by name. A model in a list is named by its text fields: capture, channel,
    board.
    """
    if isinstance(model, POINTS):
        return
    axis_name = next((name for name in AXES if name in type(model).model_fields), "")
    axis = np.array(getattr(model, axis_name), dtype=float) if axis_name else None
    for field in type(model).model_fields:
        value, std = getattr(model, field), getattr(model, f"{field}_std", None)
        name = f"{prefix}{field}"
        if isinstance(value, Frozen):
            yield from numbers_of(value, f"{name} ")
        elif isinstance(value, tuple) and value and isinstance(value[0], Frozen):
            for item in value:
                yield from numbers_of(item, f"{name} {_identity(item)} ")
        elif std is None or value is None or field in OF_THE_SET_UP:
            continue
        elif isinstance(value, dict):
            for key in value.keys() & std.keys():
                yield _listed(f"{name} {key}", value[key], std[key], axis_name, axis)
        else:
            yield _listed(name, value, std, axis_name, axis)


def _listed(name: str, value: Any, std: Any, axis_name: str, axis: Array | None) -> tuple[str, Numbers]:
    values, stds = np.atleast_1d(np.array(value, dtype=float)), np.atleast_1d(np.array(std, dtype=float))
    along = axis if axis is not None and values.shape == axis.shape else None
    return name, Numbers(name, values, stds, axis_name if along is not None else "", along)


def _identity(model: Frozen) -> str:
    """Name of a model in a list: its text fields."""
    return " ".join(str(value) for field in type(model).model_fields if isinstance(value := getattr(model, field), str))


def _compared(
    a: dict[str, Numbers], b: dict[str, Numbers], side: Side | None, skipped: list[Skipped]
) -> Iterator[Change]:
    alone = {"A": [name for name in a if name not in b], "B": [name for name in b if name not in a]}
    for which, names in alone.items():
        if names:
            shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
            skipped.append(Skipped(step="numbers", reason=f"only {which} has {shown}", side=side))
    for name, numbers in a.items():
        if name in b:
            one, two = _aligned(numbers, b[name])
            if one.value.shape != two.value.shape:
                skipped.append(Skipped(step=name, reason=f"A has {one.value.shape}, B {two.value.shape}", side=side))
            else:
                yield from _rows(one, two, side)


def _aligned(a: Numbers, b: Numbers) -> tuple[Numbers, Numbers]:
    """Both on the axis of A, where that of B covers it."""
    if a.axis is None or b.axis is None or np.array_equal(a.axis, b.axis) or not len(b.axis):
        return a, b
    inside = (a.axis >= b.axis[0]) & (a.axis <= b.axis[-1])
    axis = a.axis[inside]
    return (
        Numbers(a.name, a.value[inside], a.std[inside], a.axis_name, axis),
        Numbers(b.name, np.interp(axis, b.axis, b.value), np.interp(axis, b.axis, b.std), a.axis_name, axis),
    )


def _rows(a: Numbers, b: Numbers, side: Side | None) -> Iterator[Change]:
    value_a, value_b, std_a, std_b = (np.ravel(part) for part in (a.value, b.value, a.std, b.std))
    std = np.hypot(std_a, std_b)
    # A normalised curve is 1 at frequency 0 by definition; its uncertainty and its difference there are rounding
    least = ROUNDING * np.maximum(np.abs(value_a), np.abs(value_b))
    known = np.flatnonzero(np.isfinite(value_a + value_b) & np.isfinite(std) & (std > least))
    if not len(known):
        return
    score = np.abs(value_b - value_a)[known] / std[known]
    chances = 2.0 * special.ndtr(-score)
    several = len(known) > FEW
    places = [int(np.argmax(score))] if several else range(len(known))
    for at in places:
        k = int(known[at])
        n = len(known) if several else 1
        p_value = _sidak_whole(float(chances[at]), n)
        yield Change(
            name=a.name,
            side=side,
            where=place_of(a, k),
            n=n,
            a=value_a[k],
            a_std=std_a[k],
            b=value_b[k],
            b_std=std_b[k],
            difference=value_b[k] - value_a[k],
            difference_std=std[k],
            significance_sigma=sigma_of_probability(p_value),
            changed=False,
        )


def place_of(numbers: Numbers, at: int) -> str:
    """Which of the numbers under one name the one at index `at` is: on the axis, by its symbol, or by its index."""
    if numbers.axis is not None:
        quantity, unit = numbers.axis_name.split("_", 1)
        return f"{quantity} {numbers.axis[at]:.4g} {unit.replace('_per_', '/')}"
    if numbers.value.size == 1:
        return ""
    if numbers.name.endswith("camera_matrix"):
        return {0: "fx", 4: "fy", 2: "cx", 5: "cy"}.get(at, str(at))
    if numbers.name.endswith("distortion"):
        return NAMES[4 + at]
    if numbers.name.endswith("translation_mm"):
        return "xyz"[at]
    place = ", ".join(str(int(k)) for k in np.unravel_index(at, numbers.value.shape))
    return f"[{place}]"


# --- geometry --------------------------------------------------------------------------------------------------------


def _covariance(fit: GeometryFit) -> Array | None:
    """Covariance (12, 12) of the intrinsics, or None where the fit doesn't state it."""
    if fit.covariance is None:
        return None
    found = np.zeros((COUNT, COUNT))
    at = [NAMES.index(name) for name in fit.parameters if name in NAMES]
    found[np.ix_(at, at)] = np.array(fit.covariance)[: len(at), : len(at)]
    return found


def _projection(a: GeometryFit, b: GeometryFit, side: Side) -> ProjectionChange | Skipped:
    of_a, of_b = _covariance(a), _covariance(b)
    first, second = intrinsics_of_fit(a), intrinsics_of_fit(b)
    if of_a is None or of_b is None:
        which = "A" if of_a is None else "B"
        return Skipped(
            step="projection", reason=f"{which} states no covariance of its intrinsics: fit it again", side=side
        )
    # Corners of both calibrations in the frame of the first camera
    places = [seen_points(a)]
    other = seen_points(b)
    if len(other):
        rays = unproject(project(other, second), first) * other[:, 2:]
        places.append(rays[np.isfinite(rays).all(axis=1)])
    gauge = np.concatenate(places)
    if len(gauge) < MIN_SEEN:
        return Skipped(
            step="projection", reason=f"{len(gauge)} corners are stated, {MIN_SEEN} needed: fit again", side=side
        )
    rotation, shift = implied_motion(first, second, gauge)
    found = difference(first, second, of_a + of_b, gauge, gauge)
    stated = project(gauge, second) - project(gauge, first)
    x, y = grid(_frame(a, b))
    points = unproject(grid_points(x, y), first) * float(np.median(gauge[:, 2]))
    vectors = np.nan_to_num(project(points @ rotation.T + shift, second) - project(points, first))
    return ProjectionChange(
        side=side,
        as_stated_px=float(np.sqrt(np.mean(np.sum(stated**2, axis=1)))),
        implied_turn_mrad=triple(1e3 * Rotation.from_matrix(rotation).as_rotvec()),
        implied_shift_mm=triple(shift),
        difference_px=found.rms_px,
        expected_px=found.expected_px,
        significance_sigma=found.significance_sigma,
        changed=False,
        x_px=tuple(map(float, x)),
        y_px=tuple(map(float, y)),
        vectors_px=tuple(tuple((float(u), float(v)) for u, v in row) for row in vectors.reshape(len(y), len(x), 2)),
    )


def _frame(a: GeometryFit, b: GeometryFit) -> tuple[int, int]:
    """Rows and columns of the frame, from the maps over it."""
    fit = a if a.projection else b
    if fit.projection:
        return round(fit.projection[0].y_px[-1]) + 1, round(fit.projection[0].x_px[-1]) + 1
    corners = [(x, y) for view in (*a.residuals, *b.residuals) for x, y in zip(view.x_px, view.y_px, strict=True)]
    cols, rows = np.max(corners, axis=0)
    return int(rows) + 1, int(cols) + 1


def _rotation_changes(a: StereoFit, b: StereoFit) -> Iterator[Change]:
    """Rotation from the rig of A to that of B, about the axes of the right camera."""
    if a.rotation_std_rad is None or b.rotation_std_rad is None:
        return
    rotation_mrad = 1e3 * Rotation.from_matrix(np.array(b.rotation) @ np.array(a.rotation).T).as_rotvec()
    for k, axis in enumerate("xyz"):
        std_a, std_b = 1e3 * a.rotation_std_rad[k], 1e3 * b.rotation_std_rad[k]
        std = float(np.hypot(std_a, std_b))
        if std <= 0:
            continue
        yield Change(
            name="stereo rotation_mrad",
            where=f"about {axis}, from A's",
            a=0.0,
            a_std=std_a,
            b=float(rotation_mrad[k]),
            b_std=std_b,
            difference=float(rotation_mrad[k]),
            difference_std=std,
            significance_sigma=sigma_of_probability(2.0 * float(special.ndtr(-abs(rotation_mrad[k]) / std))),
            changed=False,
        )
