"""The key figures of a calibration with their uncertainties, as rows for a table: on the page and on the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from lab.formats.recording_set import DataSheet
from lab.formats.results import CameraFit, FitResult, GeometryFit, MtfCurve, NoiseFit, StereoFit
from lab.formats.results.words import format_value, plain_name, unit_of
from sim.camera import Side
from sim.scene.projection import Projection

#: Fields of `NoiseFit` in the order of the table; the maker's value has the same field name.
_NOISE = (
    "conversion_gain_dn_per_e",
    "read_noise_e",
    "black_level_dn",
    "dark_current_e_per_s",
    "full_well_e",
    "dsnu_e",
    "prnu_percent",
    "linearity_error_percent",
    "response_bend_percent",
    "brighter_fatter_percent",
    "neighbour_covariance_percent",
    "quantum_efficiency",
)
#: Field of `NoiseFit` -> (name, unit).
NOISE = {field: (plain_name(field), unit_of(field)) for field in _NOISE}
#: Names of the distortion's coefficients, in OpenCV's order.


@dataclass(frozen=True)
class KeyFigure:
    """One quantity with its standard deviation (None: not stated) and the maker's value (None: not stated)."""

    name: str
    unit: str
    value: float
    std: float | None = None
    stated: float | None = None
    note: str = ""
    may_be_zero: bool = False  # zero is as good a value as others: a part of a displacement or of a turn

    @property
    def is_determined(self) -> bool:
        """Whether the uncertainty is below the value."""
        return self.may_be_zero or self.std is None or self.std < abs(self.value)

    @property
    def text(self) -> str:
        """The value and its standard deviation with unit and note: `0.383 ± 0.008 at 610 nm`."""
        text = f"{format_value(self.value, self.std, self.unit)} {self.note}".rstrip()
        return text if self.is_determined else f"not determined ({text})"


def noise_figures(noise: NoiseFit, camera: DataSheet | None = None) -> Iterator[KeyFigure]:
    """Yield results of the photon transfer, with the maker's values.

    noise : of one camera
    camera : its data sheet, for what the maker states

    >>> from lab.formats.results import NoiseFit
    >>> noise = NoiseFit(read_noise_e=2.0, read_noise_e_std=0.05)
    >>> [figure.text for figure in noise_figures(noise) if "read noise" in figure.name][0]
    '2.000 ± 0.050 e'
    """
    for field, (name, unit) in NOISE.items():
        value = getattr(noise, field)
        if value is None:
            continue
        stated = getattr(camera, field, None) if field != "quantum_efficiency" else None
        at_nm = noise.quantum_efficiency_wavelength_nm if field == "quantum_efficiency" else None
        note = f"at {at_nm:g} nm" if at_nm is not None else ""
        if field == "dark_current_e_per_s" and noise.dark_temperature_c is not None:
            note = f"at {noise.dark_temperature_c:.1f} °C"
        yield KeyFigure(name, unit, value, getattr(noise, f"{field}_std"), stated, note)


def mtf50_range(curves: tuple[MtfCurve, ...], channel: str) -> tuple[float, float, int] | None:
    """Return (lowest, highest, number) of one channel's MTF50 over all edges, cy/px; None where no edge has one.

    >>> mtf50_range((), "G") is None
    True
    """
    mtf50 = [
        curve.mtf50_cy_per_px for curve in curves if curve.channel == channel and curve.mtf50_cy_per_px is not None
    ]
    return (min(mtf50), max(mtf50), len(mtf50)) if mtf50 else None


def camera_figures(fit: CameraFit, camera: DataSheet | None = None) -> Iterator[KeyFigure]:
    """Yield all key figures of one camera."""
    if fit.noise is not None:
        yield from noise_figures(fit.noise, camera)
    if fit.spectral is not None:
        quantity, curves, stds = (
            "quantum efficiency",
            fit.spectral.quantum_efficiency,
            fit.spectral.quantum_efficiency_std,
        )
        if not curves:  # of lights and signals whose scale isn't known
            quantity, curves = "relative sensitivity", fit.spectral.relative_sensitivity
            stds = fit.spectral.relative_sensitivity_std
        for channel, curve in curves.items():
            peak = max(range(len(curve)), key=lambda k: curve[k])
            std = stds.get(channel)
            at = fit.spectral.wavelength_nm[peak]
            yield KeyFigure(
                f"peak {quantity} {channel}", "1", curve[peak], std[peak] if std else None, note=f"at {at:g} nm"
            )
    for channel in ("R", "G", "B", "Y"):
        if (span := mtf50_range(fit.mtf, channel)) is not None:
            lowest, highest, number = span
            middle, half = (lowest + highest) / 2, (highest - lowest) / 2
            note = f"(middle and half range of {number} edges)" if number > 1 else ""
            yield KeyFigure(f"MTF50 {channel}", "cy/px", middle, half or None, note=note)
    if fit.geometry is not None:
        yield from geometry_figures(fit.geometry)


def geometry_figures(geometry: GeometryFit) -> Iterator[KeyFigure]:
    """Yield camera matrix and distortion of the fitted projection."""
    matrix, matrix_std = geometry.camera_matrix, geometry.camera_matrix_std
    for place, row, col in (("fx", 0, 0), ("fy", 1, 1), ("cx", 0, 2), ("cy", 1, 2)):
        yield KeyFigure(
            plain_name("camera_matrix", place), "px", matrix[row][col], matrix_std[row][col] if matrix_std else None
        )
    names = Projection(geometry.lens_projection, geometry.spline_angle_deg).coefficients
    for number, value in enumerate(geometry.distortion):
        name = plain_name("distortion", names[number])
        yield KeyFigure(name, "1", value, geometry.distortion_std[number] if geometry.distortion_std else None)
    yield KeyFigure("reprojection error, rms", "px", geometry.rms_px)


def stereo_figures(stereo: StereoFit) -> Iterator[KeyFigure]:
    """Yield baseline, translation and rotation of the pair."""
    yield KeyFigure("stereo baseline", "mm", stereo.baseline_mm, stereo.baseline_mm_std)
    for name, value, number in zip("xyz", stereo.translation_mm, range(3), strict=True):
        std = stereo.translation_mm_std
        yield KeyFigure(f"stereo translation {name}", "mm", value, std[number] if std else None, may_be_zero=True)
    for name, value, number in zip("xyz", rotation_vector_mrad(stereo.rotation), range(3), strict=True):
        turns = stereo.rotation_std_rad
        yield KeyFigure(
            f"stereo rotation about {name}", "mrad", value, 1e3 * turns[number] if turns else None, may_be_zero=True
        )
    yield KeyFigure("stereo reprojection error, rms", "px", stereo.rms_px)


def rotation_vector_mrad(rotation: tuple[tuple[float, float, float], ...]) -> tuple[float, float, float]:
    """Return the rotation vector (axis times angle, mrad) of a rotation matrix (3, 3), for small rotations of a stereo
    pair.

    >>> rotation_vector_mrad(((1.0, -0.001, 0.0), (0.001, 1.0, 0.0), (0.0, 0.0, 1.0)))
    (0.0, 0.0, 1.0)
    """
    cosine = min(1.0, max(-1.0, (rotation[0][0] + rotation[1][1] + rotation[2][2] - 1) / 2))
    angle = math.acos(cosine)
    scale = 500.0 if angle < 1e-8 else 500.0 * angle / math.sin(angle)
    return (
        scale * (rotation[2][1] - rotation[1][2]),
        scale * (rotation[0][2] - rotation[2][0]),
        scale * (rotation[1][0] - rotation[0][1]),
    )


def by_side(fit: FitResult, cameras: dict[Side, DataSheet]) -> list[tuple[str, dict[Side, KeyFigure]]]:
    """Return the rows of the table of key figures: name and figure of each side, in the order of the first side that
    has it.

    fit : of all cameras
    cameras : their data sheets

    >>> from lab.formats.results import CameraFit, NoiseFit
    >>> camera = CameraFit(noise=NoiseFit(read_noise_e=2.0, read_noise_e_std=0.05))
    >>> rows = by_side(FitResult(source="my-camera", cameras={"left": camera}), {})
    >>> [figures["left"].text for name, figures in rows if "read noise" in name]
    ['2.000 ± 0.050 e']
    """
    names: list[str] = []
    rows: dict[str, dict[Side, KeyFigure]] = {}
    for side, camera_fit in fit.cameras.items():
        place = 0
        for figure in camera_figures(camera_fit, cameras.get(side)):
            if figure.name not in rows:
                names.insert(place, figure.name)
            rows.setdefault(figure.name, {})[side] = figure
            place = names.index(figure.name) + 1
    return [(name, rows[name]) for name in names]
