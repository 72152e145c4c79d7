"""The range of a figure, and the ranges of what data sheets and captures state."""

from __future__ import annotations

from dataclasses import dataclass

from lab.formats.results.words import format_unit, format_value

#: Standard deviations: a figure whose true value is on a limit is outside by chance in 0.13 % of all fits.
OUTSIDE_SIGMA = 3.0
#: What a length far outside its range suggests.
LENGTH_UNIT = "a length in another unit, as metres? give it in mm"


@dataclass(frozen=True)
class Plausible:
    """The range of a figure. `below`, `above`: likely causes of a figure outside it, and the remedy."""

    lower: float | None
    upper: float | None
    below: str = ""
    above: str = ""

    def is_below(self, value: float, std: float | None) -> bool:
        """Whether the figure lies below the range by more than its uncertainty."""
        return self.lower is not None and value + OUTSIDE_SIGMA * (std or 0.0) < self.lower

    def is_above(self, value: float, std: float | None) -> bool:
        """Whether the figure lies above the range by more than its uncertainty."""
        return self.upper is not None and value - OUTSIDE_SIGMA * (std or 0.0) > self.upper

    def sentence(self, name: str, value: float, std: float | None = None, unit: str = "1") -> str | None:
        """Return one line with quantity, value, limit, likely cause and remedy; None where the figure is plausible.

        >>> print(Plausible(0.0, 1.0, above="check it").sentence("share", 2.0, 0.1))
        share 2.00 ± 0.10 is above the limit of 1: check it
        """
        for outside, place, limit, cause in (
            (self.is_below(value, std), "below", self.lower, self.below),
            (self.is_above(value, std), "above", self.upper, self.above),
        ):
            if outside and limit is not None:
                bound = f"{limit:.4g} {format_unit(unit)}".rstrip()
                return f"{name} {format_value(value, std, unit)} is {place} the limit of {bound}: {cause}"
        return None


#: Key of a data sheet or a capture -> range, in the unit of its name.
STATED: dict[str, Plausible] = {
    # the smallest pixels: 0.5 um; those of X-ray panels: 400 um
    "pixel_pitch_um": Plausible(0.3, 1e3, "a pitch in mm? give it in um", "a pitch in nm? give it in um"),
    # the cone of f/0.5 fills half of space; pinholes: f/100 and more
    "f_number": Plausible(0.5, 1e3, "no lens in air is faster; correct it", "correct it"),
    "focal_length_mm": Plausible(0.1, 2e4, LENGTH_UNIT, LENGTH_UNIT),
    # boards of 25 to 150 mm a square in metres: 0.025 to 0.15; finer ones are targets of microscopes; walls: 1 m
    "square_mm": Plausible(0.2, 1e3, LENGTH_UNIT, LENGTH_UNIT),
    # liquid helium: -269. Above 70 a dark current hides the signal of silicon; 77 to 125 are usual in kelvin
    "temperature_c": Plausible(
        -273.15, 70.0, "no temperature in degree C is lower; correct it", "a temperature in kelvin? give it in degree C"
    ),
    # share of the codes of bit_depth: converters reach most of their codes
    "white_level_dn over the highest code": Plausible(
        0.4, 1.0, "bit_depth may be that of the file, not of the converter; correct it", "correct bit_depth"
    ),
}
