"""A screen: conversion of digital codes to light by three primaries, each with its gamma, and a leaking black."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from sim.parameters import Frozen, Quantity
from sim.spectrum import FloatArray, Spectrum

Three = tuple[float, float, float]


class SubPixels(Frozen):
    """Upright stripes of red, green and blue side by side, each centred in its third of the screen's pixel."""

    width: Annotated[float, Quantity("1", "a stripe's width over the pixel's", lower=0.01, upper=1 / 3)] = 0.28
    height: Annotated[float, Quantity("1", "a stripe's height over the pixel's", lower=0.01, upper=1.0)] = 0.9
    order: Literal["RGB", "BGR"] = "RGB"

    @property
    def share(self) -> float:
        """Share of the pixel's area that one stripe fills."""
        return self.width * self.height

    def locate_stripe(self, channel: int) -> tuple[float, float, float, float]:
        """(u0, u1, v0, v1) of the stripe of channel 0, 1 or 2 (red, green, blue), in pixels of the screen."""
        middle = (self.order.index("RGB"[channel]) + 0.5) / 3.0
        return (
            middle - 0.5 * self.width,
            middle + 0.5 * self.width,
            0.5 - 0.5 * self.height,
            0.5 + 0.5 * self.height,
        )


class Screen(Frozen):
    """A screen's radiance along its normal: black + sum over red, green, blue of primary x drive.

    drive = ((c - b) / (1 - b))^gamma for a code c = code / 255 above the black code b, 0 below (gain-offset-gamma
    model, Berns 1996). At the angle theta from the normal all of it is multiplied by cos(theta)^falloff_exponent.
    `primaries`: radiance (W sr^-1 m^-2 nm^-1) of each at full drive, mean over the pixel, whatever the sub-pixels;
    `black_radiance`: radiance at code 0. Full drive and none don't depend on gamma: a pattern of 0 and 255 is a
    `ScreenPattern` between black and white.
    """

    primaries: tuple[Spectrum, Spectrum, Spectrum]
    black_radiance: Spectrum
    gamma: Annotated[Three, Quantity("1", "exponent of red, green, blue", lower=0.2, upper=5.0)] = (2.2, 2.2, 2.2)
    black_code: Annotated[Three, Quantity("1", "code / 255 up to which a primary is off", lower=0.0, upper=0.9)] = (
        0.0,
        0.0,
        0.0,
    )
    falloff_exponent: Annotated[
        float, Quantity("1", "power of the view angle's cosine; 0 is Lambertian", lower=0.0, upper=20.0)
    ] = 0.0
    sub_pixels: SubPixels | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        for what, curve in (
            ("black", self.black_radiance),
            *zip(("red", "green", "blue"), self.primaries, strict=True),
        ):
            lowest = min(curve.value)
            if lowest < 0:
                raise ValueError(
                    f"the screen's {what} has a radiance of {lowest:g} W sr^-1 m^-2 nm^-1, below the limit of 0: "
                    "subtract the radiometer's dark reading"
                )
        return self

    def drives(self, codes: NDArray[np.uint8]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Share 0..1 of each primary's full radiance, (rows, cols) each, of codes (rows, cols, 3)."""
        code = np.arange(256) / 255.0
        red, green, blue = (
            (np.maximum((code - black) / (1.0 - black), 0.0) ** gamma)[codes[:, :, k]]
            for k, (black, gamma) in enumerate(zip(self.black_code, self.gamma, strict=True))
        )
        return red, green, blue

    @property
    def white_radiance(self) -> Spectrum:
        """Radiance of code 255 in all three, along the normal."""
        parts = (*self.primaries, self.black_radiance)
        knots = np.unique(np.concatenate([part.arrays[0] for part in parts]))
        return Spectrum.of(knots, sum(part.at(knots) for part in parts))
