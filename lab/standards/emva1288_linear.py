"""EMVA Standard 1288, release 4.0 Linear: the figures that the noise fit has by the standard's definitions, with the
requirements of the standard on the recordings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.formats.results import Emva1288
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation
from lab.formats.results.words import format_value
from lab.standards.standard import ClauseFigure, MeasuredSide, NotDone, Standard

LEAST_LEVELS = 50
LEAST_STACK_IMAGES = 16
#: Highest less lowest irradiance over its mean.
LARGEST_NONUNIFORMITY_PERCENT = 3.0
#: Standard deviations by which a requirement has to be missed: one that is met within noise counts as met.
SIGNIFICANT_SIGMA = 2.0
#: Relative difference of two exposures that the standard takes as equal.
SAME_EXPOSURE = 1e-3
#: In remarks of the fit whose matter is a deviation here.
OF_DEVIATIONS = (
    "the standard asks for",
    "the standard means",
    "no flat lies beyond the largest temporal variance",
    "have no dark of their exposure",
    "above the standard's limit",
    "no PRNU1288",
)
SPATIAL = ("dsnu", "prnu", "row_dsnu", "column_dsnu", "pixel_dsnu", "row_prnu", "column_prnu", "pixel_prnu")


class Emva1288Linear(Standard):
    """EMVA 1288 release 4.0 Linear, of one plane of the mosaic."""

    name: ClassVar[str] = "EMVA 1288 R4.0 Linear"
    title: ClassVar[str] = "sensitivity, noise, linearity and nonuniformity of a linear camera"
    target: ClassVar[str] = (
        "flats of 50 levels up to saturation with darks of the same exposures, stacks of 16 dark images and "
        "of 16 at half of saturation"
    )
    compared: ClassVar[str] = (
        "emva1288 1.0.2 (`benchmarks/test_noise.py`), on the real CCD set K within 0.5 % and PRNU within 1 %"
    )
    not_done: ClassVar[tuple[NotDone, ...]] = (
        NotDone(
            "3.2",
            "dependence of the dark current on temperature",
            "of the fit (`dark_current_temperature`), not read here",
        ),
        NotDone("9", "spectral sensitivity", "of the spectral fit, not read here"),
        NotDone(
            "4.4",
            "defect pixel characterisation",
            "histograms are drawn; no thresholds of an application are stated",
        ),
    )

    def __init__(self, side: MeasuredSide, plane: str, figures: Emva1288) -> None:
        super().__init__(side, f"plane {plane}")
        self.own = figures

    def _of(self, field: str, unit: str, factor: float = 1.0) -> Estimate:
        value, std = getattr(self.own, field), getattr(self.own, f"{field}_std")
        if value is None:
            raise NotDetermined(self.name, self._why_not(field))
        return Estimate(value=factor * value, std=None if std is None else factor * std, unit=unit)

    def _why_not(self, field: str) -> str:
        """Say why the recordings don't determine a field."""
        words = field.split("_")
        of_photons = {"photons", "photon"} & set(words) or field == "quantum_efficiency"
        if of_photons and self.own.points.light_unit != "photons":
            return "the flats state no photons; measure the irradiance, or state photons_per_pixel"
        if field.startswith(("saturation", "snr", "dynamic")):
            return "no level lies beyond the maximum of the temporal variance; expose the brightest longer"
        if field.startswith(("temporal_dark_noise", "sensitivity")):
            return "rounding hides the dark noise, or the darks have no repeats"
        if field.startswith("dark_current"):
            return "darks of fewer than three exposures, or a dark current that rounding hides"
        if field.startswith(("dsnu", "prnu")):
            return "no spatial stack of the dark, or none near half of saturation"
        return "the recordings don't determine it"

    def _decibels(self, field: str) -> Estimate:
        ratio = self._of(field, "1")
        if not ratio.value > 0:
            raise NotDetermined(self.name, f"{field} is {ratio.value:g}: a ratio of 0 has no decibels")
        std = None if ratio.std is None else 20.0 / np.log(10.0) * ratio.std / ratio.value
        return Estimate(value=float(20.0 * np.log10(ratio.value)), std=std, unit="dB")

    @ClauseFigure
    def quantum_efficiency(self) -> Estimate:
        """Return the quantum efficiency.

        Clause: 6.6. Symbol: η. Unit: %.
        Formula: R / K.
        """
        return self._of("quantum_efficiency", "%", 100.0)

    @ClauseFigure
    def responsivity(self) -> Estimate:
        """Return the responsivity.

        Clause: 6.6. Symbol: R. Unit: DN/photon.
        Formula: slope of μ_y − μ_y.dark against μ_p through the origin, up to 70 % of saturation.
        """
        return self._of("responsivity_dn_per_photon", "DN/photon")

    @ClauseFigure
    def system_gain(self) -> Estimate:
        """Return the overall system gain.

        Clause: 6.6. Symbol: K. Unit: DN/e.
        Formula: slope of σ²_y − σ²_y.dark against μ_y − μ_y.dark through the origin, up to 70 % of saturation.
        """
        return self._of("system_gain_dn_per_e", "DN/e")

    @ClauseFigure
    def temporal_dark_noise(self) -> Estimate:
        """Return the temporal dark noise.

        Clause: 6.6. Symbol: σ_d. Unit: e.
        Formula: sqrt(σ²_y.dark − σ²_q) / K at zero exposure, σ²_q = 1/12 DN².
        """
        return self._of("temporal_dark_noise_e", "e")

    @ClauseFigure
    def temporal_dark_noise_output(self) -> Estimate:
        """Return the temporal dark noise of the digital signal.

        Clause: 6.6. Symbol: σ_y.dark. Unit: DN.
        Formula: root of the temporal variance of dark images at zero exposure.
        """
        return self._of("temporal_dark_noise_dn", "DN")

    @ClauseFigure
    def snr_max(self) -> Estimate:
        """Return the maximum signal-to-noise ratio.

        Clause: 6.6. Symbol: SNR_max. Unit: dB.
        Formula: 20 log10 sqrt(μ_e.sat).
        """
        return self._decibels("snr_max")

    @ClauseFigure
    def sensitivity_threshold_photons(self) -> Estimate:
        """Return the absolute sensitivity threshold in photons.

        Clause: 6.6. Symbol: μ_p.min. Unit: photons.
        Formula: (sqrt(σ²_y.dark / K² + 1/4) + 1/2) / η.
        """
        return self._of("sensitivity_threshold_photons", "photons")

    @ClauseFigure
    def sensitivity_threshold(self) -> Estimate:
        """Return the absolute sensitivity threshold in electrons.

        Clause: 6.6. Symbol: μ_e.min. Unit: e.
        Formula: sqrt(σ²_y.dark / K² + 1/4) + 1/2.
        """
        return self._of("sensitivity_threshold_e", "e")

    @ClauseFigure
    def saturation_capacity_photons(self) -> Estimate:
        """Return the saturation capacity in photons.

        Clause: 6.6. Symbol: μ_p.sat. Unit: photons.
        Formula: μ_p at the maximum of the temporal variance σ²_y.
        """
        return self._of("saturation_capacity_photons", "photons")

    @ClauseFigure
    def saturation_capacity(self) -> Estimate:
        """Return the saturation capacity in electrons.

        Clause: 6.6. Symbol: μ_e.sat. Unit: e.
        Formula: η μ_p.sat.
        """
        return self._of("saturation_capacity_e", "e")

    @ClauseFigure
    def dynamic_range(self) -> Estimate:
        """Return the dynamic range.

        Clause: 6.6. Symbol: DR. Unit: dB.
        Formula: 20 log10 (μ_p.sat / μ_p.min).
        """
        return self._decibels("dynamic_range")

    @ClauseFigure
    def linearity_error(self) -> Estimate:
        """Return the linearity error.

        Clause: 6.7. Symbol: LE. Unit: %.
        Formula: mean modulus of the deviation from the line that minimises relative deviations, 5 to 95 % of
        saturation.
        """
        return self._of("linearity_error_percent", "%")

    @ClauseFigure
    def dark_current_from_mean(self) -> Estimate:
        """Return the dark current from means.

        Clause: 7.1. Symbol: μ_I.mean. Unit: e/s.
        Formula: slope of μ_y.dark against the exposure time, over K.
        """
        return self._of("dark_current_from_mean_e_per_s", "e/s")

    @ClauseFigure
    def dark_current_from_variance(self) -> Estimate:
        """Return the dark current from variances.

        Clause: 7.1. Symbol: μ_I.var. Unit: e/s.
        Formula: slope of σ²_y.dark against the exposure time, over K².
        """
        return self._of("dark_current_from_variance_e_per_s", "e/s")

    @ClauseFigure
    def dsnu(self) -> Estimate:
        """Return the dark signal nonuniformity.

        Clause: 8.2. Symbol: DSNU1288. Unit: e.
        Formula: s_y.dark / K.
        """
        return self._of("dsnu_e", "e")

    @ClauseFigure
    def row_dsnu(self) -> Estimate:
        """Return the row part of the dark signal nonuniformity.

        Clause: 8.2. Symbol: DSNU1288.row. Unit: e.
        Formula: s_y.dark.row / K.
        """
        return self._of("dsnu_row_e", "e")

    @ClauseFigure
    def column_dsnu(self) -> Estimate:
        """Return the column part of the dark signal nonuniformity.

        Clause: 8.2. Symbol: DSNU1288.col. Unit: e.
        Formula: s_y.dark.col / K.
        """
        return self._of("dsnu_column_e", "e")

    @ClauseFigure
    def pixel_dsnu(self) -> Estimate:
        """Return the pixel part of the dark signal nonuniformity.

        Clause: 8.2. Symbol: DSNU1288.pixel. Unit: e.
        Formula: s_y.dark.pixel / K.
        """
        return self._of("dsnu_pixel_e", "e")

    @ClauseFigure
    def prnu(self) -> Estimate:
        """Return the photo response nonuniformity.

        Clause: 8.2. Symbol: PRNU1288. Unit: %.
        Formula: sqrt(s²_y.50 − s²_y.dark) / (μ_y.50 − μ_y.dark).
        """
        return self._of("prnu_percent", "%")

    @ClauseFigure
    def row_prnu(self) -> Estimate:
        """Return the row part of the photo response nonuniformity.

        Clause: 8.2. Symbol: PRNU1288.row. Unit: %.
        Formula: sqrt(s²_y.50.row − s²_y.dark.row) / (μ_y.50 − μ_y.dark).
        """
        return self._of("prnu_row_percent", "%")

    @ClauseFigure
    def column_prnu(self) -> Estimate:
        """Return the column part of the photo response nonuniformity.

        Clause: 8.2. Symbol: PRNU1288.col. Unit: %.
        Formula: sqrt(s²_y.50.col − s²_y.dark.col) / (μ_y.50 − μ_y.dark).
        """
        return self._of("prnu_column_percent", "%")

    @ClauseFigure
    def pixel_prnu(self) -> Estimate:
        """Return the pixel part of the photo response nonuniformity.

        Clause: 8.2. Symbol: PRNU1288.pixel. Unit: %.
        Formula: sqrt(s²_y.50.pixel − s²_y.dark.pixel) / (μ_y.50 − μ_y.dark).
        """
        return self._of("prnu_pixel_percent", "%")

    def deviations(self) -> Iterator[Deviation]:
        yield from level_deviations(self.own)
        yield from uniformity_deviations(self.own)
        yield from stack_deviations(self.own)

    def conditions(self) -> Iterator[str]:
        camera, points = self.measured.camera, self.own.points
        yield f"{camera.cols} × {camera.rows} pixels, {camera.bit_depth} bit, mosaic {camera.cfa}"
        flats = self.measured.recordings.captures(FlatCapture, self.measured.side)
        darks = self.measured.recordings.captures(DarkCapture, self.measured.side)
        yield f"{len(points.light)} levels of light from {len(flats)} flats, {len(darks)} darks"
        if self.own.wavelength_nm is not None:
            yield f"light of {self.own.wavelength_nm:g} nm"

    def remarks(self) -> Iterator[str]:
        yield from (remark for remark in self.own.remarks if not any(phrase in remark for phrase in OF_DEVIATIONS))
        yield from self._gain_bias()

    def _gain_bias(self) -> Iterator[str]:
        """Yield by how much the standard's line for K differs from the joint fit of the photon-transfer curve."""
        noise = self.measured.fit.noise
        if noise is None or noise.conversion_gain_at_zero_dn_per_e is None:
            return
        scale = 10.0 ** ((noise.gain_db or 0.0) / 20.0)
        joint = scale * noise.conversion_gain_at_zero_dn_per_e
        share = 100.0 * (self.own.system_gain_dn_per_e / joint - 1.0)
        std = 100.0 * float(
            np.hypot(self.own.system_gain_dn_per_e_std, scale * (noise.conversion_gain_at_zero_dn_per_e_std or 0.0))
            / joint
        )
        yield (
            f"the standard's straight line gives a K that differs by {format_value(share, std, '%')} from the slope at "
            "zero signal of the measured photon-transfer curve, which nonlinearity and the brighter-fatter effect bend"
        )


def level_deviations(figures: Emva1288) -> Iterator[Deviation]:
    """Yield the requirements on the series of levels that a plane's recordings don't meet."""
    points = figures.points
    levels = len(points.light)
    if levels < LEAST_LEVELS:
        yield Deviation(
            clause="6.5",
            quantity="levels of light",
            found=f"{levels}",
            limit=f"{LEAST_LEVELS} at least",
            remedy="capture more levels between the dark and saturation",
        )
    if figures.saturation_capacity_e is None:
        yield Deviation(
            clause="6.5",
            quantity="range of the levels",
            found="no level beyond the maximum of the temporal variance",
            limit="levels up to saturation",
            remedy="expose the brightest levels longer",
            figures=("snr_max", "saturation_capacity", "saturation_capacity_photons", "dynamic_range"),
        )
    if points.light_unit != "photons":
        yield Deviation(
            clause="6.4",
            quantity="irradiation",
            found="not stated in photons",
            limit="a measured number of photons per pixel of one wavelength",
            remedy="measure the irradiance by a photodiode in the plane of the sensor",
            figures=("quantum_efficiency", "responsivity", "dynamic_range", "saturation_capacity"),
        )
    elif figures.wavelength_nm is None:
        yield Deviation(
            clause="6.2",
            quantity="wavelength of the light",
            found="not stated",
            limit="one wavelength, at most 50 nm wide",
            remedy="state wavelength_nm of the flats",
            figures=("quantum_efficiency", "responsivity"),
        )
    darks = np.array(points.dark_exposure_s)
    missing = [
        exposure_s
        for exposure_s in set(points.exposure_s)
        if not np.any(np.abs(darks - exposure_s) <= SAME_EXPOSURE * exposure_s)
    ]
    if missing:
        yield Deviation(
            clause="6.5",
            quantity="dark images",
            found=f"none at {len(missing)} of {len(set(points.exposure_s))} exposure times of the levels",
            limit="a pair at each exposure time",
            remedy="capture darks at the flats' exposures",
        )


def uniformity_deviations(figures: Emva1288) -> Iterator[Deviation]:
    """Yield the requirement on the homogeneity of the light, where the spatial stack shows that it isn't met."""
    span, std = figures.light_nonuniformity_percent, figures.light_nonuniformity_percent_std or 0.0
    if span is None:
        yield Deviation(
            clause="6.1",
            quantity="nonuniformity of the light (ΔE)",
            found="not known, as no spatial stack has a smooth surface",
            limit=f"{LARGEST_NONUNIFORMITY_PERCENT:g} % at most",
            remedy="capture several flats and darks at half of saturation, frames of 16 × 16 pixels or more",
            figures=("prnu", "row_prnu", "column_prnu", "pixel_prnu"),
        )
    elif span - SIGNIFICANT_SIGMA * std > LARGEST_NONUNIFORMITY_PERCENT:
        yield Deviation(
            clause="6.1",
            quantity="nonuniformity of the light (ΔE, highest less lowest over the mean)",
            found=format_value(span, std, "%"),
            limit=f"{LARGEST_NONUNIFORMITY_PERCENT:g} % at most",
            remedy="light the bare sensor evenly, without a lens, at 8 times the diameter of the light's disc",
        )


def stack_deviations(figures: Emva1288) -> Iterator[Deviation]:
    """Yield the requirements on the spatial stacks that aren't met."""
    points = figures.points
    images = [n for n in (points.stack_images, points.stack_dark_images) if n is not None]
    if points.stack_images is None:
        yield Deviation(
            clause="8.1",
            quantity="bright spatial stack",
            found="no level between 30 and 70 % of saturation",
            limit="a stack at 50 % of saturation",
            remedy="capture a stack of flats at half of saturation",
            figures=SPATIAL,
        )
    if images and min(images) < LEAST_STACK_IMAGES:
        yield Deviation(
            clause="8.1",
            quantity="images of a spatial stack",
            found=f"{min(images)}",
            limit=f"{LEAST_STACK_IMAGES} at least",
            remedy="capture more repeats of the dark and of half of saturation",
            figures=SPATIAL,
        )
    bright, dark = points.stack_exposure_s, points.stack_dark_exposure_s
    if bright is not None and dark is not None and abs(bright - dark) > SAME_EXPOSURE * bright:
        yield Deviation(
            clause="8.1",
            quantity="exposures of the spatial stacks",
            found=f"{1e3 * bright:.4g} ms bright, {1e3 * dark:.4g} ms dark",
            limit="the same exposure",
            remedy="capture the dark stack at the bright one's exposure",
            figures=SPATIAL,
        )


def read(side: MeasuredSide) -> Iterator[Standard]:
    """Yield the standard for each plane whose figures the noise fit has. Raises NotDetermined where none has."""
    if side.fit.noise is None or not side.fit.noise.emva1288:
        raise NotDetermined(Emva1288Linear.name, "no flats and darks in repeats; capture a photon-transfer series")
    for plane, figures in side.fit.noise.emva1288.items():
        yield Emva1288Linear(side, plane, figures)
