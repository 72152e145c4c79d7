"""The ColorChecker's reflectances, by name of the chart."""

from __future__ import annotations

import warnings
from functools import cache

from sim.spectrum import Spectrum

#: Rows and columns of the patches.
GRID = (4, 6)

#: Patches in the chart's order: rows from dark skin to bluish green down to white to black.
PATCHES = (
    "dark skin", "light skin", "blue sky", "foliage", "blue flower", "bluish green",
    "orange", "purplish blue", "moderate red", "purple", "yellow green", "orange yellow",
    "blue", "green", "red", "yellow", "magenta", "cyan",
    "white", "neutral 8", "neutral 6.5", "neutral 5", "neutral 3.5", "black",
)  # fmt: skip

#: The frame between and around the patches: a flat matt black.
FRAME_REFLECTANCE = Spectrum(wavelength_nm=(200.0, 1200.0), value=(0.03, 0.03))


@cache
def reflectances(chart: str = "ColorChecker24") -> dict[str, Spectrum]:
    """Patch name -> reflectance (0..1) of a chart, in the order of `PATCHES`.

    Source: colour-science, "BabelColor Average" (380..730 nm by 10), the mean of 30 charts (Pascale 2006); beyond its ends the
    end values hold. Ohta's curves (1997) are of one chart, 3 % rms beside this mean.
    Raises ValueError for a chart that isn't known.
    """
    if chart != "ColorChecker24":
        raise ValueError(f"chart {chart!r} is not known: only ColorChecker24 is, name that or leave the capture out")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # colour-science warns at import that it can't draw
        from colour import SDS_COLOURCHECKERS  # here, as it takes a second and few need it
    curves = list(SDS_COLOURCHECKERS["BabelColor Average"].values())
    return {
        name: Spectrum.of((300.0, *c.wavelengths, 1100.0), (c.values[0], *c.values, c.values[-1]))
        for name, c in zip(PATCHES, curves, strict=True)
    }
