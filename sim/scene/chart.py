"""Reflectance charts of other packages: entry points of the group `calibench.charts`."""

from __future__ import annotations

from functools import cache

import numpy as np

from sim.extensions import extensions, refuse
from sim.spectrum import Spectrum

#: A chart's reflectances are needed over these wavelengths at least, as those of the ColorChecker are known.
FIRST_NM, LAST_NM = 380.0, 730.0


class PatchChart:
    """A flat chart of diffuse patches in even rows and columns, on a matt black frame of 3 % reflectance.

    shows : what it is, in a few words
    rows, cols : of the patches
    reflectances : patch name -> reflectance (0..1) over nm, row by row from the upper left; 380 to 730 nm at least;
        beyond its ends the end values hold
    gap : share of the patches' distance that the frame between them takes, 0 to 0.9

    Raises ValueError, in one line, where these don't agree.

    >>> chart = PatchChart("a grey card", 1, 1, {"grey": Spectrum.of([380.0, 730.0], [0.2, 0.2])})
    >>> float(chart.reflectances["grey"].at(1000.0))
    0.2
    """

    def __init__(
        self, shows: str, rows: int, cols: int, reflectances: dict[str, Spectrum], *, gap: float = 0.13
    ) -> None:
        if not shows.strip():
            raise ValueError("the chart doesn't say what it shows: write a few words")
        if rows < 1 or cols < 1 or rows * cols != len(reflectances):
            raise ValueError(
                f"{len(reflectances)} reflectances for {rows} rows of {cols} patches: give one of each, row by row"
            )
        if not 0.0 <= gap <= 0.9:
            raise ValueError(
                f"the gap between patches is {gap} of their distance, outside 0..0.9: a ColorChecker has 0.13"
            )
        self.shows, self.rows, self.cols, self.gap = shows, rows, cols, gap
        self.reflectances = {name: _hold_ends(name, curve) for name, curve in reflectances.items()}


def _hold_ends(patch: str, curve: Spectrum) -> Spectrum:
    """Return a patch's reflectance over 300 to 1100 nm. Raises ValueError where it isn't one."""
    wavelength_nm, value = curve.arrays
    if wavelength_nm[0] > FIRST_NM or wavelength_nm[-1] < LAST_NM:
        raise ValueError(
            f"patch {patch}: reflectance over {wavelength_nm[0]:g}..{wavelength_nm[-1]:g} nm: {FIRST_NM:g}.."
            f"{LAST_NM:g} nm are needed"
        )
    worst = value[np.argmax(np.abs(value - 0.5))]
    if not 0.0 <= worst <= 1.0:
        raise ValueError(f"patch {patch}: reflectance {worst:g} is outside 0..1: percent are to be divided by 100")
    inside = (wavelength_nm > 300.0) & (wavelength_nm < 1100.0)
    ends = curve.arrays[1][0], curve.arrays[1][-1]
    low = ends[0] if wavelength_nm[0] >= 300.0 else float(curve.at(300.0))
    high = ends[1] if wavelength_nm[-1] <= 1100.0 else float(curve.at(1100.0))
    return Spectrum.of((300.0, *wavelength_nm[inside], 1100.0), (low, *value[inside], high))


@cache
def added_charts() -> dict[str, PatchChart]:
    """Return the charts of other packages, by name: entry points of `calibench.charts` that are a `PatchChart`."""
    charts = {}
    for name, chart in extensions("charts"):
        if isinstance(chart, PatchChart):
            charts[name] = chart
        else:
            refuse("charts", name, f"{chart!r} is no sim.scene.chart.PatchChart")
    return charts
