"""Two calibrations of one rig: what changed beyond its uncertainty.

Every number that a fit states with a standard deviation is compared, found by its name: `x` beside `x_std`. The
numbers of a curve or a kernel share one row: that of the point with the largest difference, corrected for the number
of points (Sidak). Dark currents are compared at the sensor temperature of A (`lab.fit.noise.dark_current`). The
geometry of cameras is also compared by its effect: both calibrations project the same points, after the rigid motion
that they imply between each other is removed (`lab.observables.boards.projection`). Parameters that differ much may
project alike, and the reverse.

Rules by which changes fail a check (`calibench compare --fail-on`) name a figure and a tolerance: `FIGURE`, or
`FIGURE>AMOUNT` with the amount in the figure's own unit or in percent of A (`left:noise read_noise_e>5%`). `*` in
FIGURE stands for any text; `SIDE:` before it confines it to a camera. A change fails a rule where it is significant, as
the comparison decides, and larger than the amount.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.spatial.transform import Rotation

from lab.errors import InputError
from lab.fit.noise.dark_current import SensorTemperature
from lab.formats.results import (
    CameraFit,
    Change,
    ComparisonResult,
    DarkCurrentLaws,
    Emva1288Points,
    FitResult,
    GeometryFit,
    MakerDeparture,
    MtfCurve,
    NoiseFit,
    PhotonTransfer,
    ProjectionChange,
    RepeatDrift,
    Skipped,
    StereoFit,
)
from lab.formats.results.words import plain_name, unit_of
from lab.observables.boards.projection import CameraGeometry, difference, grid, grid_points, implied_motion, seen_points
from sim.camera import ProjectionKind, Side
from sim.parameters import Frozen
from sim.scene.projection import COUNT, Projection

Array = NDArray[np.floating[Any]]
FALSE_ALARM_RATE = 0.01
MIN_SEEN = 20  # fewest corners that determine an implied motion
ROUNDING = 1e-9  # relative standard deviation below which a value counts as exact
FEW = 9  # most numbers under one name with a row each; more are a curve
#: Models that aren't compared: points of plots, drifts of one session's repeats, and the bands in which a curve departs
#: from the maker's. Those are chosen where the departure is largest, so that each session has others; the curves that
#: they rest on are compared.
NOT_COMPARED = (PhotonTransfer, Emva1288Points, MakerDeparture, RepeatDrift)
#: Fields that aren't compared: properties of the set-up, and dark currents at the temperatures that a session happened
#: to have.
NOT_COMPARED_FIELDS = {(MtfCurve, "angle_deg")} | {
    (DarkCurrentLaws, field) for field in ("dark_current_e_per_s", "reference_current_e_per_s")
}
#: Standard deviation, percent, by which a calibration's curvature of the response differs from the last beyond what its
#: fit states: a stabilised lamp drifts by about a thousandth during a series of levels. No repeat of a level shows it,
#: and it bends the means of an ascending series by as much at saturation. `brighter_fatter_percent` has three times the
#: bend of the response in it.
LAMP_DRIFT_PERCENT = {"response_bend_percent": 0.1, "linearity_error_percent": 0.1, "brighter_fatter_percent": 0.3}
INTEGRAL = "integrated_efficiency_nm"
#: The numbers of a camera matrix that are fitted, and where they stand in it (row, column).
MATRIX_PLACES = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
AXES = ("wavelength_nm", "frequency_cy_per_px", "radius_px")

#: The name of the difference of two projections, in px, beside the figures of the fits.
PROJECTION = "projection"
_RULE = re.compile(r"(?:(?P<side>left|right):)?(?P<figure>[^>]+?)\s*(?:>\s*(?P<amount>[0-9.eE+-]+)\s*(?P<percent>%)?)?")


@dataclass(frozen=True)
class ComparedNumbers:
    """Values and standard deviations under one name, along `axis` where there is one. `sensor`: of a dark current."""

    name: str
    value: Array
    std: Array
    axis_name: str = ""
    axis: Array | None = None
    sensor: SensorTemperature | None = None

    def at_temperature_of(self, reference: ComparedNumbers) -> tuple[ComparedNumbers, Array]:
        """Return the numbers as they would be at the sensor temperature of `reference`, and the standard deviation of
        their difference from it: by the fits, by the lamps' drifts and by the conversion.

        The conversion's part is a share of the larger of both, so that it is as wide for a fall as for a rise.
        """
        scaled, share = self, 0.0
        if self.sensor is not None and reference.sensor is not None:
            doublings, std = self.sensor.doublings(reference.sensor)
            factor, share = 2.0**doublings, float(np.log(2.0)) * std
            scaled = replace(self, value=factor * self.value, std=factor * self.std, sensor=reference.sensor)
        larger = np.maximum(np.abs(scaled.value), np.abs(reference.value))
        drift = np.sqrt(2.0) * LAMP_DRIFT_PERCENT.get(self.name.rpartition(" ")[2], 0.0)
        return scaled, np.sqrt(scaled.std**2 + reference.std**2 + (share * larger) ** 2 + drift**2)


def compare(a: FitResult, b: FitResult, false_alarm_rate: float = FALSE_ALARM_RATE) -> ComparisonResult:
    """Compare two fits of one rig, number by number.

    a, b : the fits
    false_alarm_rate : probability of any `changed` between two calibrations of an unchanged rig

    The rate is shared among the n rows of the comparison (Sidak): each is `changed` beyond z sigma with
    2 (1 - Phi(z)) = 1 - (1 - rate)^(1/n), 4.1 for the 239 rows of a session with eight edges, 4.4 for 1000. Rows are
    taken as independent. They are not; the true rate is lower. `tests/recovery/test_compare_coverage.py` measures it on
    105 comparisons of an unchanged camera.

    >>> from lab.formats.results import CameraFit, NoiseFit
    >>> def fitted(read_noise_e):
    ...     noise = NoiseFit(read_noise_e=read_noise_e, read_noise_e_std=0.05)
    ...     return FitResult(source="my-camera", cameras={"left": CameraFit(noise=noise)})
    >>> change = compare(fitted(2.0), fitted(3.0)).changes[0]
    >>> round(change.significance_sigma, 1), change.changed  # 1 / (0.05 sqrt(2))
    (14.1, True)
    """
    skipped: list[Skipped] = []
    rows: list[Change] = []
    projections: list[ProjectionChange] = []
    for side in dict.fromkeys((*a.cameras, *b.cameras)):
        if side not in a.cameras or side not in b.cameras:
            only = "A" if side in a.cameras else "B"
            skipped.append(Skipped(step="camera", reason=f"only {only} has this side", side=side))
            continue
        camera_a, camera_b = a.cameras[side], b.cameras[side]
        skipped += _without_temperature(camera_a, camera_b, side)
        numbers_a, numbers_b = dict(numbers_of(camera_a, "")), dict(numbers_of(camera_b, ""))
        if (
            camera_a.spectral
            and camera_b.spectral
            and camera_a.spectral.wavelength_nm != camera_b.spectral.wavelength_nm
        ):
            numbers_a = {name: of for name, of in numbers_a.items() if INTEGRAL not in name}
            numbers_b = {name: of for name, of in numbers_b.items() if INTEGRAL not in name}
            reason = "the curves of A and B end at different wavelengths: their integrals aren't of one band"
            skipped.append(Skipped(step="integrated quantum efficiency", reason=reason, side=side))
        rows += _compare_numbers(numbers_a, numbers_b, side, skipped)
        if camera_a.geometry is not None and camera_b.geometry is not None:
            change = _projection(camera_a.geometry, camera_b.geometry, side)
            if isinstance(change, Skipped):
                skipped.append(change)
            else:
                projections.append(change)
    if a.stereo is not None and b.stereo is not None:
        rows += _compare_numbers(
            dict(numbers_of(a.stereo, "stereo ")), dict(numbers_of(b.stereo, "stereo ")), None, skipped
        )
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


def _without_temperature(a: CameraFit, b: CameraFit, side: Side) -> Iterator[Skipped]:
    """Say that dark currents are compared without their temperature, where one of both doesn't state it."""
    if (
        a.noise is None
        or b.noise is None
        or a.noise.dark_current_e_per_s is None
        or b.noise.dark_current_e_per_s is None
    ):
        return
    if unknown := [which for which, noise in (("A", a.noise), ("B", b.noise)) if noise.dark_temperature_c is None]:
        share = math.log(2.0) * sensor_temperature(a.noise).doublings(sensor_temperature(b.noise))[1]
        yield Skipped(
            step="dark current's temperature",
            reason=f"{' and '.join(unknown)} without a stated sensor temperature: the dark currents are taken as "
            f"uncertain by {100 * share:.0f} % "
            "for it; state temperature_c of the darks",
            side=side,
        )


def sigma_of_probability(p_value: float) -> float:
    """Express a probability as standard deviations of a normal distribution, two-sided.

    p_value : probability, 0..1

    >>> round(sigma_of_probability(0.0027), 2)
    3.0
    """
    return -float(special.ndtri(max(p_value, 1e-300) / 2.0))


def sidak_part(rate: float, number: int) -> float:
    """Return the probability allowed for each of `number` independent tests, so that any of them has `rate` (Sidak).

    rate : probability that one or more of the tests fail by chance, 0..1
    number : how many tests

    >>> each = sidak_part(0.01, 200)
    >>> round(1.0 - (1.0 - each) ** 200, 6)
    0.01
    """
    return float(-np.expm1(np.log1p(-rate) / max(number, 1)))


def _sidak_whole(p_value: float, number: int) -> float:
    """Return the probability of a value so small among `number` tests (Sidak)."""
    return float(-np.expm1(number * np.log1p(-min(p_value, 1.0 - 1e-16))))


def numbers_of(model: Frozen, prefix: str) -> Iterator[tuple[str, ComparedNumbers]]:
    """Yield every fitted number under `model`, by name, each name once. A model in a list is named by its text fields:
    capture, channel, board; by its number, too, where others have the same.
    """
    if isinstance(model, NOT_COMPARED):
        return
    sensor = sensor_temperature(model) if isinstance(model, NoiseFit) else None
    axis_name = next((name for name in AXES if name in type(model).model_fields), "")
    axis = np.array(getattr(model, axis_name), dtype=float) if axis_name else None
    for field in type(model).model_fields:
        value, std = getattr(model, field), getattr(model, f"{field}_std", None)
        if field == "camera_matrix" and std is not None:  # its other numbers are constants
            value, std = ([of[row][col] for row, col in MATRIX_PLACES.values()] for of in (value, std))
        name = f"{prefix}{field}"
        if field == "distortion" and isinstance(model, GeometryFit) and model.lens_projection != "pinhole":
            # Coefficients of another projection mean another thing; so does a spline that ends at another angle
            spline = "" if model.spline_angle_deg is None else f" to {model.spline_angle_deg:.3g} deg"
            name = f"{prefix}{model.lens_projection}{spline} {field}"
        if isinstance(value, Frozen):
            yield from numbers_of(value, f"{name} ")
        elif isinstance(value, tuple) and value and isinstance(value[0], Frozen):
            of = [_identity(item) for item in value]
            for k, item in enumerate(value):
                number = f"part {of[:k].count(of[k]) + 1} " if of.count(of[k]) > 1 else ""
                yield from numbers_of(item, f"{name} {of[k]} {number}")
        elif std is None or value is None or (type(model), field) in NOT_COMPARED_FIELDS:
            continue
        elif isinstance(value, dict):
            for key in value:
                if key in std:
                    yield _numbers_under(f"{name} {key}", value[key], std[key], axis_name, axis)
        else:
            yield _numbers_under(
                name, value, std, axis_name, axis, sensor if field.startswith("dark_current") else None
            )


def sensor_temperature(noise: NoiseFit) -> SensorTemperature:
    """Return the temperature at which the dark currents were measured, and their doubling temperature, fitted or else
    silicon's.
    """
    law = noise.dark_current_temperature
    if law is None or law.doubling_temperature_c is None or law.doubling_temperature_c_std is None:
        return SensorTemperature(temperature_c=noise.dark_temperature_c)
    return SensorTemperature(
        temperature_c=noise.dark_temperature_c,
        doubling_c=law.doubling_temperature_c,
        doubling_c_std=law.doubling_temperature_c_std,
    )


def _numbers_under(
    name: str, value: Any, std: Any, axis_name: str, axis: Array | None, sensor: SensorTemperature | None = None
) -> tuple[str, ComparedNumbers]:
    """Return a name and its numbers, along `axis` where they are as many as it has."""
    values, stds = np.atleast_1d(np.array(value, dtype=float)), np.atleast_1d(np.array(std, dtype=float))
    along = axis if axis is not None and values.shape == axis.shape else None
    return name, ComparedNumbers(name, values, stds, axis_name if along is not None else "", along, sensor)


def _identity(model: Frozen) -> str:
    """Return the name of a model in a list: its text fields."""
    return " ".join(str(value) for field in type(model).model_fields if isinstance(value := getattr(model, field), str))


def _compare_numbers(
    a: dict[str, ComparedNumbers], b: dict[str, ComparedNumbers], side: Side | None, skipped: list[Skipped]
) -> Iterator[Change]:
    """Yield the changes of the numbers that both fits have, by name; `skipped` gets the others."""
    alone = {"A": [name for name in a if name not in b], "B": [name for name in b if name not in a]}
    for which, names in alone.items():
        if names:
            shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
            skipped.append(Skipped(step="numbers", reason=f"only {which} has {shown}", side=side))
    for name, numbers in a.items():
        if name in b:
            numbers_a, numbers_b = _align(numbers, b[name])
            if numbers_a.value.shape != numbers_b.value.shape:
                skipped.append(
                    Skipped(step=name, reason=f"A has {numbers_a.value.shape}, B {numbers_b.value.shape}", side=side)
                )
            else:
                yield from _rows(numbers_a, numbers_b, side)


def _align(a: ComparedNumbers, b: ComparedNumbers) -> tuple[ComparedNumbers, ComparedNumbers]:
    """Bring both to the axis of A, where that of B covers it."""
    if a.axis is None or b.axis is None or np.array_equal(a.axis, b.axis) or not len(b.axis):
        return a, b
    inside = (a.axis >= b.axis[0]) & (a.axis <= b.axis[-1])
    axis = a.axis[inside]
    return (
        ComparedNumbers(a.name, a.value[inside], a.std[inside], a.axis_name, axis),
        ComparedNumbers(b.name, np.interp(axis, b.axis, b.value), np.interp(axis, b.axis, b.std), a.axis_name, axis),
    )


def _rows(a: ComparedNumbers, as_measured: ComparedNumbers, side: Side | None) -> Iterator[Change]:
    """Yield the rows of one name: one for each number, or that of the largest difference for a curve."""
    b, std_of_difference = as_measured.at_temperature_of(a)
    parts = (a.value, b.value, a.std, b.std, std_of_difference)
    value_a, value_b, std_a, std_b, std = (np.ravel(part) for part in parts)
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
        where = place_of(a, k)
        yield Change(
            name=a.name,
            title=title_of(a, k),
            unit=unit_of(a.name),
            side=side,
            where=where,
            temperature_c=None if a.sensor is None else a.sensor.temperature_c,
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


def title_of(numbers: ComparedNumbers, at: int) -> str:
    """Return the plain name of a number; of a curve or kernel, that of the whole."""
    name = plain_name(numbers.name, place_of(numbers, at) if numbers.value.size <= FEW else "")
    return name if numbers.sensor is None else f"{name} {numbers.sensor.text}"


def _projection_of(name: str) -> Projection:
    """Return the projection that the name of a distortion states (`numbers_of`); a pinhole where none is stated."""
    kind: ProjectionKind = next((kind for kind in get_args(ProjectionKind) if kind in name.split()), "pinhole")
    return Projection(kind, 90.0 if kind == "splined_stereographic" else None)  # its names don't depend on the angle


def place_of(numbers: ComparedNumbers, at: int) -> str:
    """Say which of the numbers under one name the one at index `at` is: on the axis, by its symbol, or by its index."""
    if numbers.axis is not None:
        quantity, unit = numbers.axis_name.split("_", 1)
        return f"{quantity} {numbers.axis[at]:.4g} {unit.replace('_per_', '/')}"
    if numbers.value.size == 1:
        return ""
    if numbers.name.endswith("camera_matrix"):
        return list(MATRIX_PLACES)[at]
    if numbers.name.endswith("distortion"):
        return _projection_of(numbers.name).coefficients[at]
    if numbers.name.endswith("translation_mm"):
        return "xyz"[at]
    place = ", ".join(str(int(k)) for k in np.unravel_index(at, numbers.value.shape))
    return f"[{place}]"


def _covariance(fit: GeometryFit) -> Array | None:
    """Return the covariance (12, 12) of the intrinsics, or None where the fit doesn't state it."""
    if fit.covariance is None:
        return None
    covariance = np.zeros((COUNT, COUNT))
    names = CameraGeometry.of_fit(fit).projection.names
    at = [names.index(name) for name in fit.parameters if name in names]
    covariance[np.ix_(at, at)] = np.array(fit.covariance)[: len(at), : len(at)]
    return covariance


def _projection(a: GeometryFit, b: GeometryFit, side: Side) -> ProjectionChange | Skipped:
    """Compare the projections of two fits over the corners of both, without the motion that they imply."""
    of_a, of_b = _covariance(a), _covariance(b)
    first, second = CameraGeometry.of_fit(a), CameraGeometry.of_fit(b)
    if of_a is None or of_b is None:
        which = "A" if of_a is None else "B"
        return Skipped(
            step="projection", reason=f"{which} states no covariance of its intrinsics: fit it again", side=side
        )
    # Corners of both calibrations in the frame of the first camera
    places = [seen_points(a)]
    corners_of_b = seen_points(b)
    if len(corners_of_b):
        points = first.at_depth(second.project(corners_of_b), corners_of_b[:, 2])
        places.append(points[np.isfinite(points).all(axis=1)])
    gauge = np.concatenate(places)
    if len(gauge) < MIN_SEEN:
        return Skipped(
            step="projection", reason=f"{len(gauge)} corners are stated, {MIN_SEEN} needed: fit again", side=side
        )
    rotation, shift = implied_motion(first, second, gauge)
    change = difference(first, second, (of_a, of_b), gauge, gauge)
    stated = second.project(gauge) - first.project(gauge)
    x, y = grid(_frame(a, b))
    points = first.at_depth(grid_points(x, y), float(np.median(gauge[:, 2])))
    vectors = np.nan_to_num(second.project(points @ rotation.T + shift) - first.project(points))
    return ProjectionChange(
        side=side,
        as_stated_px=float(np.sqrt(np.mean(np.sum(stated**2, axis=1)))),
        implied_turn_mrad=(1e3 * Rotation.from_matrix(rotation).as_rotvec()).tolist(),
        implied_shift_mm=shift.tolist(),
        difference_px=change.rms_px,
        expected_px=change.expected_px,
        significance_sigma=change.significance_sigma,
        changed=False,
        x_px=tuple(map(float, x)),
        y_px=tuple(map(float, y)),
        vectors_px=tuple(tuple((float(u), float(v)) for u, v in row) for row in vectors.reshape(len(y), len(x), 2)),
    )


def _frame(a: GeometryFit, b: GeometryFit) -> tuple[int, int]:
    """Return the rows and columns of the frame, from the maps over it."""
    fit = a if a.projection else b
    if fit.projection:
        return round(fit.projection[0].y_px[-1]) + 1, round(fit.projection[0].x_px[-1]) + 1
    corners = [(x, y) for view in (*a.residuals, *b.residuals) for x, y in zip(view.x_px, view.y_px, strict=True)]
    cols, rows = np.max(corners, axis=0)
    return int(rows) + 1, int(cols) + 1


def _rotation_changes(a: StereoFit, b: StereoFit) -> Iterator[Change]:
    """Return the rotation from the rig of A to that of B, about the axes of the right camera."""
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
            title=plain_name("stereo rotation_mrad", f"about {axis}"),
            unit=unit_of("stereo rotation_mrad"),
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


@dataclass(frozen=True)
class FailRule:
    """One rule. `amount`: the largest difference that passes, in the figure's unit, or as a share of A's value where
    `relative`.
    """

    figure: str
    side: str | None = None
    amount: float = 0.0
    relative: bool = False

    @classmethod
    def parse(cls, text: str) -> FailRule:
        """Parse a rule. Raises InputError where the text states none."""
        refused = InputError(f"--fail-on {text!r}: give FIGURE, or FIGURE>AMOUNT with an optional %, SIDE: before it")
        rule = _RULE.fullmatch(text.strip())
        if rule is None:
            raise refused
        try:
            amount = float(rule["amount"] or 0.0)
        except ValueError:
            raise refused from None
        if not 0.0 <= amount < float("inf"):
            raise refused
        relative = rule["percent"] is not None
        return cls(rule["figure"].strip(), rule["side"], amount / 100.0 if relative else amount, relative)

    def _names(self, name: str, side: str | None) -> bool:
        """Tell whether the rule names a figure of a side."""
        return fnmatchcase(name, self.figure) and self.side in (None, side)

    def _exceeds(self, row: Change) -> bool:
        """Tell whether a change is larger than the amount."""
        return abs(row.difference) > self.amount * (abs(row.a) if self.relative else 1.0)

    def concerns(self, comparison: ComparisonResult) -> bool:
        """Tell whether the comparison has any figure of this rule."""
        return any(self._names(row.name, row.side) for row in comparison.changes) or any(
            self._names(PROJECTION, item.side) for item in comparison.projection
        )

    def failures(self, comparison: ComparisonResult) -> list[str]:
        """Return the changes that fail this rule, by name."""
        rows = [
            " ".join(part for part in (row.side, row.name, row.where) if part)
            for row in comparison.changes
            if row.changed and self._names(row.name, row.side) and self._exceeds(row)
        ]
        projections = [
            f"{item.side} {PROJECTION}"
            for item in comparison.projection
            if item.changed
            and self._names(PROJECTION, item.side)
            and item.difference_px > (0.0 if self.relative else self.amount)
        ]
        return rows + projections


def failures(comparison: ComparisonResult, rules: Sequence[FailRule]) -> list[str]:
    """Return the changes that fail any rule, by name.

    comparison : of two fits
    rules : of `--fail-on`

    Raises InputError for a rule that concerns no figure of the comparison: a misspelt name, or a figure that one of the
    two fits lacks, would never fail.

    >>> from lab.formats.results import CameraFit, NoiseFit
    >>> def fitted(read_noise_e):
    ...     noise = NoiseFit(read_noise_e=read_noise_e, read_noise_e_std=0.05)
    ...     return FitResult(source="my-camera", cameras={"left": CameraFit(noise=noise)})
    >>> len(failures(compare(fitted(2.0), fitted(3.0)), [FailRule.parse("noise read_noise_e>10%")]))
    1
    """
    for rule in rules:
        if not rule.concerns(comparison):
            raise InputError(
                f"--fail-on {rule.figure!r}: no such figure in both; `calibench compare A B --all` lists those that "
                "are compared"
            )
    return list(dict.fromkeys(name for rule in rules for name in rule.failures(comparison)))
