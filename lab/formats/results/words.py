"""Figures and findings in words: names of figures, and sentences of parameters."""

from __future__ import annotations

import math

from sim.camera import ProjectionKind

#: Field -> plain name.
NAMES = {
    "conversion_gain_dn_per_e": "system gain K",
    "read_noise_e": "temporal dark noise (read noise)",
    "black_level_dn": "black level",
    "dark_current_e_per_s": "dark current",
    "full_well_e": "saturation capacity (full well)",
    "dsnu_e": "DSNU",
    "prnu_percent": "PRNU",
    "linearity_error_percent": "linearity error",
    "response_bend_percent": "response curvature at saturation",
    "brighter_fatter_percent": "variance loss at saturation",
    "neighbour_covariance_percent": "noise covariance with neighbours",
    "quantum_efficiency": "quantum efficiency",
    "integrated_efficiency_nm": "quantum efficiency, integrated over wavelength",
    "conversion_gain_at_zero_dn_per_e": "system gain K at zero signal",
    "variance_bend_percent": "variance curvature at saturation",
    "dark_current_from_variance_e_per_s": "dark current, from variances",
    "spread_percent": "spread of the pixels' read noise",
    "doubling_temperature_c": "rise in temperature that doubles the dark current",
    "activation_energy_ev": "activation energy of the dark current",
    "relative_sensitivity": "relative sensitivity",
    "mtf": "MTF",
    "mtf50_cy_per_px": "MTF50",
    "mtf10_cy_per_px": "MTF10",
    "psf": "PSF",
    "camera_matrix": "camera matrix",
    "distortion": "distortion",
    "centre_shift_px": "shift of the centre from green",
    "radial_shift_px": "radial shift from green",
    "bend_x_mm": "bend of the board along x",
    "bend_y_mm": "bend of the board along y",
    "twist_mm": "twist of the board",
    "translation_mm": "stereo translation",
    "rotation_mrad": "stereo rotation",
    "baseline_mm": "stereo baseline",
}
#: (field, place) -> plain name of one number of several.
PLACES = {
    ("camera_matrix", "fx"): "focal length x",
    ("camera_matrix", "fy"): "focal length y",
    ("camera_matrix", "cx"): "principal point x",
    ("camera_matrix", "cy"): "principal point y",
    ("distortion", "k1"): "radial distortion k1",
    ("distortion", "k2"): "radial distortion k2",
    ("distortion", "p1"): "tangential distortion p1",
    ("distortion", "p2"): "tangential distortion p2",
    ("distortion", "k3"): "radial distortion k3",
    ("distortion", "k4"): "radial distortion k4",
    **{("distortion", f"s{k}"): f"radial distortion s{k}" for k in range(1, 7)},
}
PROJECTION_NAMES: dict[ProjectionKind, str] = {
    "pinhole": "a pinhole with Brown's distortion",
    "equidistant": "an equidistant fisheye (OpenCV's fisheye)",
    "splined_stereographic": "a splined stereographic fisheye (radial spline)",
}
#: End of a field's name -> unit.
_UNITS = {
    "_dn_per_e": "DN/e",
    "_e_per_s": "e/s",
    "_cy_per_px": "cy/px",
    "_percent": "%",
    "_mrad": "mrad",
    "_nm": "nm",
    "_dn": "DN",
    "_ev": "eV",
    "_mm": "mm",
    "_px": "px",
    "_c": "C",
    "_e": "e",
    "camera_matrix": "px",
}
#: Words of a path that only say where a field stands.
_SECTIONS = {"noise", "spectral", "mtf", "psf", "geometry", "stereo", "channels", "board_warp",
"read_noise_distribution"} | {
    "dark_current_temperature"
}  # fmt: skip


def _parts(figure: str) -> tuple[str, list[str]]:
    """Return the field of a figure (empty where its path has none that is declared), and what tells it from others of
    that field."""
    words = figure.split()
    at = max((k for k, word in enumerate(words) if word in NAMES), default=-1)
    if at < 0:
        return "", []
    first = next((k for k, word in enumerate(words[:at]) if word not in _SECTIONS), at)
    return words[at], [*words[first:at], *words[at + 1 :]]


def plain_name(figure: str, place: str = "") -> str:
    """Return the plain name of a figure. A path without a declared field is its own name.

    figure : its path in a fit, words with blanks
    place : which number, of a figure of several

    >>> plain_name("noise channels G read_noise_e")
    'temporal dark noise (read noise), G'
    """
    field, of = _parts(figure)
    if not field:
        return " ".join(part for part in (figure.replace("_", " "), place) if part)
    text = PLACES.get((field, place))
    if text is None:
        text = f"{NAMES[field]} {place}".rstrip()
    return ", ".join(part for part in (text, " ".join(of)) if part)


def unit_of(figure: str) -> str:
    """Return the unit of a figure, "1" for a ratio.

    figure : its path in a fit, words with blanks

    >>> unit_of("noise read_noise_e")
    'e'
    """
    field = _parts(figure)[0]
    return next((unit for end, unit in _UNITS.items() if field.endswith(end)), "1")


#: Units whose printed form differs from their form in names.
SHOWN_UNITS = {"um": "µm", "us": "µs", "deg": "°", "C": "°C", "percent": "%", "1": ""}
#: From this size on, numbers are written with a power of ten, and from this one on with commas.
POWER_FROM, COMMAS_FROM = 1e6, 1e4
MOST_DECIMALS = 9
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def format_unit(unit: str) -> str:
    """Return a unit as it is printed; empty for a ratio.

    >>> format_unit("um"), format_unit("1")
    ('µm', '')
    """
    return SHOWN_UNITS.get(unit, unit)


def plain_number(value: float, digits: int) -> str:
    """Return a number with `digits` significant digits at most, and without a power of ten where it is from 1e-9 to
    1e6.

    >>> plain_number(0.38214, 3), plain_number(12345.6, 4)
    ('0.382', '12,350')
    """
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    size = float(f"{abs(value):.{digits - 1}e}")
    decimals = digits - 1 - math.floor(math.log10(size))
    if size >= POWER_FROM or decimals > MOST_DECIMALS + digits:
        power = math.floor(math.log10(size))
        return f"{float(f'{value / 10.0**power:.{digits - 1}f}'):g}{_ten_to(power)}"
    text = f"{_to_place(value, decimals):{',' if size >= COMMAS_FROM else ''}.{max(decimals, 0)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def format_value(
    value: float, std: float | None = None, unit: str = "", interval: tuple[float, float] | None = None
) -> str:
    """Return `value ± std unit`, the standard deviation to two digits and the value to the same place.

    value, std : in `unit`; without a standard deviation the value has four digits
    interval : 95 % interval; with one it reads `value (low to high) unit`

    Source: GUM, 7.2.6: two digits of an uncertainty suffice.

    >>> format_value(0.38214, 0.0082, "DN/e")
    '0.3821 ± 0.0082 DN/e'
    >>> format_value(2.0, interval=(1.5, 3.25), unit="um")
    '2 (1.5 to 3.25) µm'
    """
    if interval is not None:
        low, high = (plain_number(end, 3) for end in interval)
        return f"{plain_number(value, 3)} ({low} to {high}) {format_unit(unit)}".rstrip()
    if std is None or not math.isfinite(std) or std <= 0 or not math.isfinite(value):
        number = plain_number(value, 4)
    else:
        place = 1 - math.floor(math.log10(float(f"{std:.1e}")))
        if abs(value) < POWER_FROM and place <= MOST_DECIMALS:
            decimals, commas = max(place, 0), "," if abs(value) >= COMMAS_FROM else ""
            number = f"{_to_place(value, place):{commas}.{decimals}f} ± {_to_place(std, place):{commas}.{decimals}f}"
        else:
            power = math.floor(math.log10(max(abs(value), std)))
            decimals = max(place + power, 0)
            number = f"({value / 10.0**power:.{decimals}f} ± {std / 10.0**power:.{decimals}f}){_ten_to(power)}"
    return f"{number} {format_unit(unit)}".rstrip()


def _to_place(value: float, place: int) -> float:
    """Round to a decimal place; a negative one is left of the point."""
    return round(value, place) + 0.0


def _ten_to(power: int) -> str:
    return f" × 10{str(power).translate(_SUPERSCRIPTS)}"
