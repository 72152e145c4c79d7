"""The reflectances of charts, by name: the ColorCheckers', and those of other packages."""

from __future__ import annotations

import warnings
from functools import cache

import numpy as np
from scipy.optimize import lsq_linear

from sim.scene.chart import added_charts
from sim.scene.light import colour_science
from sim.spectrum import FloatArray, Spectrum

#: Rows and columns of the patches.
GRID = (4, 6)
GRID_SG = (10, 14)
KNOWN = {"ColorChecker24": GRID, "ColorCheckerSG": GRID_SG}

#: Patches in the chart's order: rows from dark skin to bluish green down to white to black.
PATCHES = (
    "dark skin", "light skin", "blue sky", "foliage", "blue flower", "bluish green",
    "orange", "purplish blue", "moderate red", "purple", "yellow green", "orange yellow",
    "blue", "green", "red", "yellow", "magenta", "cyan",
    "white", "neutral 8", "neutral 6.5", "neutral 5", "neutral 3.5", "black",
)  # fmt: skip

#: The frame between and around the patches: a flat matt black.
FRAME_REFLECTANCE = Spectrum(wavelength_nm=(200.0, 1200.0), value=(0.03, 0.03))


def grid(chart: str = "ColorChecker24") -> tuple[int, int]:
    """Return the numbers of rows and columns of a chart's patches. Raises ValueError for a chart that isn't known.

    >>> grid("ColorChecker24")
    (4, 6)
    """
    known = {name: (added.rows, added.cols) for name, added in added_charts().items()} | KNOWN
    if chart not in known:
        raise ValueError(
            f"chart {chart!r} is not known: there are {', '.join(known)}; name one of them or leave the capture out"
        )
    return known[chart]


@cache
def reflectances(chart: str = "ColorChecker24") -> dict[str, Spectrum]:
    """Patch name -> reflectance (0..1) of a chart, row by row: in the order of `PATCHES`, or A1 B1 ... N1 A2 ... N10
    of the SG.

    ColorChecker24: measured; colour-science, "BabelColor Average" (380..730 nm in steps of 10), the mean of 30 charts
    (Pascale 2006). Ohta's curves (1997) are of a single chart, 3 % rms from this mean.

    ColorCheckerSG: not measured but recovered from colours, as no spectra of the SG's 140 patches are available. The
    curves have exactly the XYZ that X-Rite publishes (charts after November 2014, D50, 2 degrees), and the shape of
    measured materials of such a colour (see `recover_reflectances`). They are metamers: on the 24 patches with known
    curves, this recovery has an error of 0.04 rms of reflectance. Don't calibrate a spectral response with them.

    Charts of other packages (`calibench.charts`): as they state them.

    Beyond their ends the end values hold. Raises ValueError for a chart that isn't known.
    """
    grid(chart)
    if chart not in KNOWN:
        return added_charts()[chart].reflectances
    colour = colour_science()
    if chart == "ColorChecker24":
        return {
            name: _hold_ends(curve.wavelengths, curve.values)
            for name, curve in zip(PATCHES, colour.SDS_COLOURCHECKERS["BabelColor Average"].values(), strict=True)
        }
    data = colour.CCS_COLOURCHECKERS["ColorCheckerSG - After November 2014"].data
    xyz = np.array([colour.xyY_to_XYZ(xyy) for xyy in data.values()])
    wavelength_nm, curves = recover_reflectances(xyz)
    return {name: _hold_ends(wavelength_nm, curve) for name, curve in zip(data, curves, strict=True)}


def recover_reflectances(xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Wavelengths (nm) and reflectances (n, wavelengths) of surfaces with CIE 1931 `xyz` (n, 3) under D50, Y of white
    1.

    Otsu, Yamamoto and Hachisuka (2018): principal components of 1269 measured Munsell and other papers, clustered by
    colour (colour-science). Then the closest bounded curve with the XYZ: least sum of squared differences between
    neighbouring values of the correction, subject to 0 <= reflectance <= 1, XYZ met to 1e-5. Raises ValueError for XYZ
    that no reflectance has.
    """
    colour = colour_science()
    shape = colour.SpectralShape(380, 730, 10)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape)
    light = colour.SDS_ILLUMINANTS["D50"].copy().align(shape)
    to_xyz = observer.values * light.values[:, None]
    to_xyz = to_xyz / np.sum(to_xyz[:, 1])
    size = len(to_xyz)
    slope = np.diff(np.eye(size), axis=0)
    weight = 1e4  # of XYZ against the slope
    system = np.vstack([slope, weight * to_xyz.T])
    curves = []
    for wanted in np.atleast_2d(xyz):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it says that it takes its own wavelengths, which are these
            start = colour.recovery.XYZ_to_sd_Otsu2018(wanted, cmfs=observer, illuminant=light).values
        solution = lsq_linear(system, np.append(slope @ start, weight * wanted), bounds=(0.0, 1.0), method="bvls")
        left = float(np.max(np.abs(solution.x @ to_xyz - wanted)))
        if left > 1e-5:
            raise ValueError(
                f"XYZ {np.round(wanted, 4).tolist()} under D50 is {left:.2g} beyond any reflectance between 0 and 1: "
                "check the values, and that Y of white is 1"
            )
        curves.append(np.clip(solution.x, 0.0, 1.0))
    return np.asarray(observer.wavelengths), np.array(curves)


def _hold_ends(wavelength_nm: FloatArray, value: FloatArray) -> Spectrum:
    return Spectrum.of((300.0, *wavelength_nm, 1100.0), (value[0], *value, value[-1]))
