"""Lights of a station's light source: its channels lit together, chosen by colour temperature or wavelength."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Self

from pydantic import Field, model_validator

from lab.errors import InputError
from sim.parameters import Frozen, Quantity

LampLevel = Annotated[
    float,
    Quantity(
        "1",
        "level of the light source, a share of its brightest; 0: the monochromator's light",
        lower=0.0,
        upper=1.0,
    ),
]
ColourTemperature = Annotated[
    float | None,
    Quantity("K", "colour temperature of the light source's light", lower=500.0, upper=50_000.0),
]
#: What a sequence needs in place of a monochromator where the light source lights it.
LAMP_INSTRUMENTS = ("light_source", "spectroradiometer")


class LampLight(Frozen):
    """A light of the station's `[light_source]`: `channels` lit together, each at a share 0..1 of its most.

    `colour_temperature_k` or `wavelength_nm`, as the lab states it: what a sequence asks for it by.
    """

    channels: dict[str, float] = Field(min_length=1)
    colour_temperature_k: float | None = Field(default=None, ge=500.0, le=50_000.0)
    wavelength_nm: float | None = Field(default=None, gt=0.0)

    @model_validator(mode="after")
    def _usable(self) -> Self:
        if wrong := [f"{name} = {share:g}" for name, share in self.channels.items() if not 0.0 < share <= 1.0]:
            raise ValueError(f"channels: {wrong[0]} is outside 0..1, 0 excluded; state a share of its brightest")
        if self.colour_temperature_k is not None and self.wavelength_nm is not None:
            raise ValueError("colour_temperature_k and wavelength_nm exclude one another; state one of them")
        return self


def check_lamp(level: float, colour_temperature_k: float | None) -> None:
    """Check the light that is asked for. Raises ValueError for a colour temperature of a light source that is dark.

    level : share of its most, 0..1
    colour_temperature_k : None where it isn't asked for

    >>> check_lamp(0.5, 3000.0)
    """
    if level == 0.0 and colour_temperature_k is not None:
        raise ValueError(
            f"colour_temperature_k: {colour_temperature_k:g} K with lamp_level = 0, at which the light source is dark; "
            "give a lamp_level up to 1"
        )


def lamp_channels(
    lights: Mapping[str, LampLight], level: float, colour_temperature_k: float | None, wavelength_nm: float = 0.0
) -> dict[str, float]:
    """Return the share 0..1 of its most at which each channel is to be lit, by name.

    lights : of the station, by name
    level : share of the light
    colour_temperature_k, wavelength_nm : of the light; with neither (None, 0), it is the first of the station file

    Raises InputError where there is no such light.

    >>> lights = {"white": LampLight(colour_temperature_k=3000.0, channels={"warm": 1.0, "cold": 0.2})}
    >>> lamp_channels(lights, 0.5, 3000.0)
    {'warm': 0.5, 'cold': 0.1}
    """
    if colour_temperature_k is not None:
        fit = [light for light in lights.values() if light.colour_temperature_k == colour_temperature_k]
        wanted = f"colour_temperature_k = {colour_temperature_k:g}"
        have = [
            f"{light.colour_temperature_k:g} K" for light in lights.values() if light.colour_temperature_k is not None
        ]
    elif wavelength_nm:
        fit = [light for light in lights.values() if light.wavelength_nm == wavelength_nm]
        wanted = f"wavelength_nm = {wavelength_nm:g}"
        have = [f"{light.wavelength_nm:g} nm" for light in lights.values() if light.wavelength_nm is not None]
    else:
        fit, wanted, have = list(lights.values()), "any colour", []
    if not fit:
        raise InputError(
            f"station: [light_source.lights] has no light of {wanted}; it has {', '.join(have) or 'none'}: ask for one "
            "of these, or add it to the station file"
        )
    return {name: level * share for name, share in fit[0].channels.items()}


def lamp_words(level: float, colour_temperature_k: float | None) -> str:
    """Return a part of a step's id that says how the light source is set.

    level : share of its most, 0..1
    colour_temperature_k : None where it isn't asked for

    >>> lamp_words(0.5, 3000.0)
    'lamp0.5-3000K'
    """
    return f"lamp{level:g}" + ("" if colour_temperature_k is None else f"-{colour_temperature_k:g}K")
