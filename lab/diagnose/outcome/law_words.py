"""Laws without a name in words: what they are of, their unit, and what physics may do that, as suspects."""

from __future__ import annotations

from sim.effects.empirical_law import PLACES

#: What a law may come from, by stage, index, and form where that matters ("": any): suspects, not names.
SUSPECTS: dict[tuple[str, str, str], str] = {
    ("codes", "code", "periodic"): (
        "converter bits of wrong weight do that, interleaved converters, or codes rescaled from another bit depth"
    ),
    ("codes", "code", "no power of two"): (
        "codes multiplied after the converter do that, or a last stage of the converter that has that many steps"
    ),
    ("codes", "code", ""): "a converter's own differential nonlinearity does that, or a look-up table after it",
    ("charge", "row", "step"): "halves of the sensor that are exposed or read apart do that, or a mask's shadow",
    ("charge", "column", "step"): "two or four read-outs (taps) of unequal gain do that",
    ("charge", "row", ""): "phase-detection rows do that, shared read-out of neighbouring rows, or light that pulses",
    ("charge", "column", ""): "column amplifiers of unequal gain do that, or phase-detection columns",
    ("charge", "row and column", ""): "pixels that share a floating diffusion do that, or phase-detection pixels",
    ("signal", "row", "step"): "read-outs of the halves with offsets of their own do that",
    ("signal", "column", "step"): "two or four read-outs (taps) with offsets of their own do that",
    ("signal", "row", "variance"): "rows that share an amplifier do that, or pick-up in step with the lines",
    ("signal", "column", "variance"): "column converters of unequal noise do that",
    ("signal", "row", ""): "shared read-out of neighbouring rows does that, or pick-up at a fraction of the line rate",
    ("signal", "column", ""): "interleaved column converters with offsets of their own do that",
    ("signal", "row and column", ""): "pixels that share a floating diffusion, with offsets of their own, do that",
    ("signal", "row", "covariance"): "rows that are read in pairs do that, or charge that is binned in part",
    ("signal", "column", "covariance"): "columns that share a converter do that, or an amplifier that settles slowly",
    ("signal", "row", "decay"): "a read-out that settles after the frame's beginning does that, or a frame's last rows",
    ("signal", "column", "decay"): "a read-out that settles after a line's beginning does that",
    ("charge", "row", "decay"): "rows that are exposed longer at the frame's end do that, or a mask's shadow",
    ("charge", "column", "decay"): "a mask's shadow does that, or charge that is lost at the array's end",
    ("signal", "radius", ""): "an amplifier's or a processor's light does that, or stress of the package",
    ("charge", "radius", ""): "a part below or beside the sensor that warms its middle or its corners does that",
    (
        "charge",
        "radius x exposure",
        "",
    ): "a leaf shutter that opens from the middle does that, or an iris that closes with it",
    ("image", "angle", ""): "a rectangular port of the sphere does that, a tilted mask, or a stop that isn't round",
    ("signal", "row x level", ""): "row drivers whose supply sags with the signal do that",
    ("signal", "column x level", ""): "column amplifiers that each bend in their own way do that",
    ("signal", "time", "variance"): "amplifiers that warm up do that, or pick-up that comes and goes",
    ("signal", "exposure", ""): "a reset that settles during the exposure does that, or a clamp that follows it",
    ("light", "plane x time", ""): "a lamp whose colour changes as it warms or ages does that",
    ("light", "wavelength", ""): "an uneven screw or a worn grating drive of the monochromator does that",
    ("signal", "level", "step"): "a change of gain within the range (dual gain) does that",
    ("signal", "level", "knee"): "companding, dual gain, or a well that begins to fill up do that",
    (
        "signal",
        "level",
        "",
    ): "a response that isn't straight does that: source follower, companding, or a look-up table",
    ("signal", "time", "step"): "a black-level clamp that was set anew does that",
    ("signal", "time", ""): "a black level that follows the electronics' temperature does that",
    (
        "charge",
        "level",
        "",
    ): "shot noise that neighbours share does that, gain by level, or noise reduction in the camera",
    ("charge", "exposure", ""): "a shutter's delay does that, reciprocity failure, or light that leaks in beside it",
    ("light", "time", "step"): "a lamp whose arc or current jumped does that, or a shutter that moved",
    ("light", "time", ""): "a lamp that warms up or ages does that",
    ("image", "radius", ""): "fall-off of lens or microlenses does that, tree rings, or fringes of a plate",
    ("image", "wavelength", "step"): "a grating's anomaly does that, or an order-sorting filter",
    ("image", "wavelength", ""): "absorption or interference in a glass does that, or a filter that nobody stated",
    ("image", "frequency", ""): "a blur that isn't listed does that, or processing on the chip",
}

#: What a law is of, by stage and index.
QUANTITIES: dict[tuple[str, str], str] = {
    ("codes", "code"): "code widths",
    ("charge", "level"): "shot noise",
    ("charge", "exposure"): "time in which light is collected",
    ("signal", "level"): "response",
    ("signal", "time"): "black level",
    ("light", "time"): "source",
    ("light", "plane x time"): "colour of the source",
    ("light", "wavelength"): "wavelength of narrowband light",
    ("charge", "radius"): "dark current",
    ("charge", "radius x exposure"): "time in which light is collected",
    ("signal", "radius"): "dark offset",
    ("signal", "row x level"): "bend of the response",
    ("signal", "column x level"): "bend of the response",
    ("signal", "exposure"): "black level",
    ("image", "angle"): "light on the sensor",
    ("image", "radius"): "light on the sensor",
    ("image", "wavelength"): "transmittance",
    ("image", "frequency"): "transfer function",
}
#: Units of departures that aren't shares, nor offsets.
UNITS: dict[tuple[str, str, str], str] = {
    ("charge", "radius", "mean"): "DN/s",
    ("charge", "radius x exposure", "mean"): "s",
    ("signal", "radius", "mean"): "DN",
    ("signal", "time", "variance"): "DN^2",
    ("light", "wavelength", "mean"): "nm",
}
BY_LINES = {"charge": "sensitivities", "signal": "dark offsets"}
#: What may do it where no suspect is listed.
NO_SUSPECT = "physics that no effect of the library has does that"


def quantity_of(stage: str, along: str, of: str) -> str:
    """Return what a law is of."""
    if stage == "signal" and of != "mean" and along != "level":
        return "covariances of the dark noise" if of == "covariance" else "variances of the dark noise"
    return QUANTITIES.get((stage, along)) or BY_LINES.get(stage) or QUANTITIES.get((stage, "frequency"), stage)


def suspects_of_place(stage: str, along: str, of: str, form: str) -> str:
    """Return what physics may do it; none of it is a name."""
    kinds = (of, form, "") if of != "mean" else (form, "")
    return next((SUSPECTS[stage, along, k] for k in kinds if (stage, along, k) in SUSPECTS), NO_SUSPECT)


def coordinate_unit(stage: str, along: str, of: str) -> str:
    """Return the unit of a curve's coordinate; "" where it has none."""
    said = {(str(s), str(a), str(o)): words for (s, a, o), (_, _, words) in PLACES.items()}.get((stage, along, of), "")
    return said.split(" after ")[0].split(" from ")[0]


def departure_unit(stage: str, along: str, of: str, is_curve: bool) -> str:
    """Return the unit of a law's departures from no change, "%" of shares."""
    unit = UNITS.get((stage, along, of))
    if unit is None and stage == "signal" and of == "mean" and not along.endswith("level"):
        unit = "e" if is_curve else "DN"
    return unit or "%"
