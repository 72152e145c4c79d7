"""Results of the spectral fit: quantum efficiency per channel."""

from __future__ import annotations

from sim.parameters import Frozen


class MakerDeparture(Frozen):
    """A band in which the fitted quantum efficiency differs from the data sheet's curve times `maker_scale`.

    `difference`: mean of fitted less stated over the band, electrons per photon. `significance_sigma`: corrected for
    the number of bands tested.
    """

    channel: str
    from_nm: float
    to_nm: float
    difference: float
    difference_std: float
    difference_percent: float | None  # of the mean of the scaled data-sheet curve over the band
    significance_sigma: float


class SpectralFit(Frozen):
    """Absolute quantum efficiency per channel, electrons per photon; the lens's stated transmittance is divided out.
    Empty where no scale is known, as of a table of means: `relative_sensitivity` stands then."""

    wavelength_nm: tuple[float, ...]
    quantum_efficiency: dict[str, tuple[float, ...]]
    quantum_efficiency_std: dict[str, tuple[float, ...]]
    #: Scaled so that the highest value of all channels is 1; its uncertainty excludes that of the common scale.
    relative_sensitivity: dict[str, tuple[float, ...]] = {}
    relative_sensitivity_std: dict[str, tuple[float, ...]] = {}
    #: Integral of the quantum efficiency over `wavelength_nm`, by channel: the sensitivity to light that has as many
    #: photons at each. Errors of single lights average out in it.
    integrated_efficiency_nm: dict[str, float] = {}
    integrated_efficiency_nm_std: dict[str, float] = {}
    #: Bands (first, last) by channel without light: the curve and its uncertainty there are the prior's.
    not_determined_nm: dict[str, tuple[tuple[float, float], ...]] = {}
    #: Factor from the data sheet's curves to the fitted ones, and the bands in which they differ beyond it. None: the
    #: data sheet has no curves, or the fit uses them.
    maker_scale: float | None = None
    maker_departures: tuple[MakerDeparture, ...] = ()
    #: Times the standard uncertainty: an interval of about 95 %.
    coverage_factor: float = 2.0
    #: Assumptions of the fit, in sentences.
    remarks: tuple[str, ...] = ()
