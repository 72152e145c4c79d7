"""ISO 13655:2017: colorimetry of the measured lights and their exchange as CGATS.17 text (ISO 28178).

The spectra themselves are exchanged by `lab.formats.cgats`; here are the figures that the standard computes from
them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from lab.capture_kinds.chart import ChartCapture
from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation, PlotCurve, StandardPlot
from lab.standards.iso17321 import GRID_NM, Colorimetry
from lab.standards.standard import ClauseFigure, MeasuredSide, NotDone, Standard
from sim.scene.light import colour_science, luminance_cd_m2
from sim.spectrum import Spectrum

#: Range and step of spectra that the standard asks for.
FIRST_NM, LAST_NM, WIDEST_STEP_NM = 400.0, 700.0, 10.0


class Iso13655(Standard):
    """ISO 13655:2017, of the repeated measurements of one light."""

    name: ClassVar[str] = "ISO 13655:2017"
    title: ClassVar[str] = "colorimetry of the light"
    target: ClassVar[str] = "the radiance of the light, measured twice or more"
    compared: ClassVar[str] = "colour-science 0.4.7: observer, correlated colour temperature"
    not_done: ClassVar[tuple[NotDone, ...]] = (
        NotDone(
            "5",
            "reflectance and density of samples",
            "no reflectances are measured; spectra go in and out as CGATS.17 text by `calibench import` and `export`",
        ),
    )

    def __init__(self, side: MeasuredSide, kind: str, spectra: list[Spectrum]) -> None:
        super().__init__(side, f"light of the {kind} captures")
        self.spectra = spectra

    def _mean(self, values: list[float], unit: str) -> Estimate:
        measured = np.array(values)
        if not np.all(np.isfinite(measured)):
            raise NotDetermined(self.name, "the light has no visible part")
        std = float(measured.std(ddof=1) / np.sqrt(measured.size)) if measured.size > 1 else None
        return Estimate(value=float(measured.mean()), std=std, unit=unit)

    def _chromaticities(self) -> list[np.ndarray]:
        colour = colour_science()
        chromaticities = []
        for spectrum in self.spectra:
            power = spectrum.at(GRID_NM)
            if not power.sum() > 0:
                raise NotDetermined(self.name, "the light has no visible part")
            white = Colorimetry.under(power, np.ones((1, GRID_NM.size))).white
            chromaticities.append(np.asarray(colour.XYZ_to_xy(white)))
        return chromaticities

    @ClauseFigure
    def luminance(self) -> Estimate:
        """Return the luminance.

        Clause: 5.2. Symbol: L_v. Unit: cd/m².
        Formula: 683 lm/W ∫ L(λ) V(λ) dλ, mean of the repeated measurements.
        """
        return self._mean([luminance_cd_m2(spectrum) for spectrum in self.spectra], "cd/m²")

    @ClauseFigure
    def chromaticity_x(self) -> Estimate:
        """Return the chromaticity coordinate x.

        Clause: 5.2. Symbol: x. Unit: 1.
        Formula: X / (X + Y + Z) of the CIE's observer of 1931.
        """
        return self._mean([float(xy[0]) for xy in self._chromaticities()], "1")

    @ClauseFigure
    def chromaticity_y(self) -> Estimate:
        """Return the chromaticity coordinate y.

        Clause: 5.2. Symbol: y. Unit: 1.
        Formula: Y / (X + Y + Z) of the CIE's observer of 1931.
        """
        return self._mean([float(xy[1]) for xy in self._chromaticities()], "1")

    @ClauseFigure
    def colour_temperature(self) -> Estimate:
        """Return the correlated colour temperature.

        Clause: 5.2. Symbol: T_cp. Unit: K.
        Formula: of the Planckian radiator nearest in u, v (McCamy's polynomial of x and y).
        """
        colour = colour_science()
        return self._mean([float(colour.temperature.xy_to_CCT_McCamy1992(xy)) for xy in self._chromaticities()], "K")

    def deviations(self) -> Iterator[Deviation]:
        wave = self.spectra[0].arrays[0]
        step = float(np.diff(wave).max())
        if wave[0] > FIRST_NM or wave[-1] < LAST_NM or step > WIDEST_STEP_NM:
            yield Deviation(
                clause="4.2",
                quantity="wavelengths of the measurement",
                found=f"{wave[0]:g} to {wave[-1]:g} nm by {step:g} nm",
                limit=f"{FIRST_NM:g} to {LAST_NM:g} nm by {WIDEST_STEP_NM:g} nm at most",
                remedy="measure over the whole visible range",
            )
        if len(self.spectra) < 2:
            yield Deviation(
                clause="4.2",
                quantity="measurements of the light",
                found="1",
                limit="2 at least for an uncertainty (not the standard's)",
                remedy="measure the light again",
            )

    def plots(self) -> Iterator[StandardPlot]:
        wave = self.spectra[0].arrays[0]
        value = np.mean([spectrum.at(wave) for spectrum in self.spectra], axis=0)
        yield StandardPlot(
            title="Radiance of the light",
            x_label="wavelength, nm",
            y_label="radiance, W sr⁻¹ m⁻² nm⁻¹",
            curves=(PlotCurve(label=f"mean of {len(self.spectra)}", x=tuple(wave.tolist()), y=tuple(value.tolist())),),
        )


def read(side: MeasuredSide) -> Iterator[Standard]:
    """Yield the standard for the white light of flats and of charts. Raises NotDetermined where none was measured."""
    flats = side.recordings.captures(FlatCapture, side.side)
    charts = side.recordings.captures(ChartCapture, side.side)
    lights = {
        "flat": [flat.radiance for flat in flats if flat.radiance is not None and flat.wavelength_nm is None],
        "chart": [chart.radiance for chart in charts],
    }
    has_reading = False
    for kind, paths in lights.items():
        spectra = [side.recordings.spectrum(path) for path in dict.fromkeys(paths)]
        if spectra:
            has_reading = True
            yield Iso13655(side, kind, spectra)
    if not has_reading:
        raise NotDetermined(Iso13655.name, "no white light was measured; measure its radiance by a spectroradiometer")
