"""Results of the noise fit: photon transfer, dark current, defective pixels, EMVA 1288 figures."""

from __future__ import annotations

from typing import Literal

from sim.parameters import Frozen


class ChannelNoise(Frozen):
    """Photon transfer of one colour channel."""

    conversion_gain_dn_per_e: float | None = None
    conversion_gain_dn_per_e_std: float | None = None
    read_noise_e: float | None = None
    read_noise_e_std: float | None = None
    black_level_dn: float | None = None
    black_level_dn_std: float | None = None
    dark_current_e_per_s: float | None = None
    dark_current_e_per_s_std: float | None = None
    dsnu_e: float | None = None
    dsnu_e_std: float | None = None
    prnu_percent: float | None = None
    prnu_percent_std: float | None = None
    full_well_e: float | None = None
    full_well_e_std: float | None = None
    linearity_error_percent: float | None = None
    linearity_error_percent_std: float | None = None


class NoiseFit(ChannelNoise):
    """Photon transfer of the whole sensor by the definitions of EMVA 1288 release 4.0; `channels`: of each channel."""

    #: EMVA's total quantum efficiency, of a mono camera whose flats state `photons_per_pixel`, or have a photodiode's
    #: irradiance. `_systematic_std`: by the photodiode's calibration, apart from `_std`.
    quantum_efficiency: float | None = None
    quantum_efficiency_std: float | None = None
    quantum_efficiency_systematic_std: float | None = None
    quantum_efficiency_wavelength_nm: float | None = None
    #: Slope at zero signal of the curve of variance against mean. `conversion_gain_dn_per_e` is this slope, or that of
    #: EMVA's line where the bend of the curve isn't significant.
    conversion_gain_at_zero_dn_per_e: float | None = None
    conversion_gain_at_zero_dn_per_e_std: float | None = None
    #: Standard deviation of the temporal variances about their curve beyond the sampling error, percent of the
    #: variance.
    variance_model_error_percent: float | None = None
    #: At saturation, in percent. `response_bend`: departure of the mean from its tangent at zero. `variance_bend`:
    #: departure of the variance from its tangent at zero. `brighter_fatter`: the part of the variance's bend that the
    #: response doesn't explain. `neighbour_covariance`: covariance with the eight neighbours over the shot noise's
    #: variance, where brighter-fatter puts it.
    response_bend_percent: float | None = None
    response_bend_percent_std: float | None = None
    variance_bend_percent: float | None = None
    variance_bend_percent_std: float | None = None
    brighter_fatter_percent: float | None = None
    brighter_fatter_percent_std: float | None = None
    neighbour_covariance_percent: float | None = None
    neighbour_covariance_percent_std: float | None = None
    #: From the growth of the dark variance with exposure.
    dark_current_from_variance_e_per_s: float | None = None
    dark_current_from_variance_e_per_s_std: float | None = None
    #: Sensor temperature at which the dark currents were measured: the mean over the darks, weighted by exposure.
    dark_temperature_c: float | None = None
    dark_current_temperature: DarkCurrentLaws | None = None
    read_noise_distribution: ReadNoiseDistribution | None = None
    defects: PixelDefects | None = None
    #: Flats whose stated light contradicts the others: left out of responsivity, linearity and gain.
    inconsistent_levels: tuple[InconsistentLevel, ...] = ()
    #: Standard deviation of the levels' means about a smooth response beyond noise, percent of the signal; 0 where
    #: noise explains them. It is part of the uncertainties of responsivity, quantum efficiency and linearity.
    response_scatter_percent: float | None = None
    channels: dict[str, ChannelNoise] = {}
    #: By plane of the mosaic (`R`, `G1`, `G2`, `B`, or `Y`), by the letter of the standard.
    emva1288: dict[str, Emva1288] = {}
    photon_transfer: PhotonTransfer | None = None
    #: What the recordings show of the bench, in sentences ("the lamp drifted by ...").
    remarks: tuple[str, ...] = ()


class InconsistentLevel(Frozen):
    """A flat level whose stated light contradicts the other levels; signals are above dark, means over the planes.

    `light`: as stated, in `light_unit`; `expected_light`: at which the others have its signal; `expected_signal_dn`:
    that they have at its stated light, at most saturation.
    """

    captures: tuple[str, ...]
    exposure_s: float
    light: float
    light_unit: Literal["photons", "s"]
    expected_light: float
    signal_dn: float
    expected_signal_dn: float


class DarkCurrentLaws(Frozen):
    """Dark current at each temperature, and two laws fitted to it.

    Arrhenius: I = I_ref exp(-E / k (1/T - 1/T_ref)). EMVA 1288: I = I_ref 2^((T - T_ref) / T_d).
    """

    temperature_c: tuple[float, ...]
    dark_current_e_per_s: tuple[float, ...]
    dark_current_e_per_s_std: tuple[float, ...]
    doubling_temperature_c: float | None = None
    doubling_temperature_c_std: float | None = None
    activation_energy_ev: float | None = None
    activation_energy_ev_std: float | None = None
    reference_temperature_c: float | None = None
    reference_current_e_per_s: float | None = None
    reference_current_e_per_s_std: float | None = None


class ReadNoiseDistribution(Frozen):
    """Temporal noise of single pixels in the dark, with `degrees_of_freedom` per pixel.

    `spread_percent`: standard deviation of the pixels' variances over their mean, less the sampling error of the few
    repeats. `noisy_pixels`: number of pixels above the level that chance exceeds anywhere on the sensor with 1 %."""

    degrees_of_freedom: int
    rms_e: float
    median_e: float
    percentile_95_e: float
    percentile_99_e: float
    spread_percent: float
    spread_percent_std: float
    noisy_pixels: int
    noise_e: tuple[float, ...]  # edges of the histogram's bins
    pixels: tuple[int, ...]


class Defect(Frozen):
    """One defective pixel."""

    row: int
    col: int
    dark_dn: float  # above the mean of its plane, in the longest dark
    dark_current_e_per_s: float | None = None  # above the mean of its plane


class PixelDefects(Frozen):
    """Defective pixels: more than 8 standard deviations above (`hot`) or below (`cold`) their plane in the longest
    dark.

    All fits leave them out; EMVA's own figures include them. `listed`: the strongest.
    """

    exposure_s: float
    hot: int
    cold: int
    listed: tuple[Defect, ...] = ()


class Emva1288(Frozen):
    """Figures of EMVA 1288 release 4.0 (linear) of one plane of the mosaic: all pixels counted, shading not removed."""

    #: Slope of the signal against photons, through the origin, up to 70 % of saturation.
    responsivity_dn_per_photon: float | None = None
    responsivity_dn_per_photon_std: float | None = None
    quantum_efficiency: float | None = None
    quantum_efficiency_std: float | None = None
    #: By the calibration of the photodiode that measured the irradiance, apart from `_std`: a factor common to every
    #: figure in photons, `photons_systematic_std_percent` of it. `None` where the numbers of photons are stated.
    quantum_efficiency_systematic_std: float | None = None
    photons_systematic_std_percent: float | None = None
    wavelength_nm: float | None = None
    #: Slope of the temporal variance against the signal, both less dark, through the origin, up to 70 % of saturation.
    system_gain_dn_per_e: float
    system_gain_dn_per_e_std: float
    #: At zero exposure. `None` below 0.24 DN^2, where quantisation hides it; `_limit_e` is then the upper limit 0.40 /
    #: K.
    temporal_dark_noise_dn: float | None = None
    temporal_dark_noise_dn_std: float | None = None
    temporal_dark_noise_e: float | None = None
    temporal_dark_noise_e_std: float | None = None
    temporal_dark_noise_limit_e: float | None = None
    #: Signal at which SNR is 1: sqrt(sigma_y.dark^2 / K^2 + 1/4) + 1/2.
    sensitivity_threshold_e: float | None = None
    sensitivity_threshold_e_std: float | None = None
    sensitivity_threshold_photons: float | None = None
    sensitivity_threshold_photons_std: float | None = None
    #: At the level of the largest temporal variance.
    saturation_capacity_e: float | None = None
    saturation_capacity_e_std: float | None = None
    saturation_capacity_photons: float | None = None
    saturation_capacity_photons_std: float | None = None
    snr_max: float | None = None
    snr_max_std: float | None = None
    dynamic_range: float | None = None
    dynamic_range_std: float | None = None
    linearity_error_percent: float | None = None
    linearity_error_percent_std: float | None = None
    dsnu_e: float | None = None
    dsnu_e_std: float | None = None
    dsnu_row_e: float | None = None
    dsnu_row_e_std: float | None = None
    dsnu_column_e: float | None = None
    dsnu_column_e_std: float | None = None
    dsnu_pixel_e: float | None = None
    dsnu_pixel_e_std: float | None = None
    prnu_percent: float | None = None
    prnu_percent_std: float | None = None
    prnu_row_percent: float | None = None
    prnu_row_percent_std: float | None = None
    prnu_column_percent: float | None = None
    prnu_column_percent_std: float | None = None
    prnu_pixel_percent: float | None = None
    prnu_pixel_percent_std: float | None = None
    dark_current_from_mean_e_per_s: float | None = None
    dark_current_from_mean_e_per_s_std: float | None = None
    dark_current_from_variance_e_per_s: float | None = None
    dark_current_from_variance_e_per_s_std: float | None = None
    points: Emva1288Points
    #: Figures that are missing, and why; where the recordings differ from what the standard asks for.
    remarks: tuple[str, ...] = ()


class Emva1288Points(Frozen):
    """The measured points, one entry per level; dark values are at the level's exposure.

    `light` is in `light_unit`: photons per pixel, or the exposure where the flats don't state photons.
    """

    light_unit: Literal["photons", "s"]
    light: tuple[float, ...]
    exposure_s: tuple[float, ...]
    mean_dn: tuple[float, ...]
    variance_dn2: tuple[float, ...]
    dark_mean_dn: tuple[float, ...]
    dark_variance_dn2: tuple[float, ...]
    linearity_deviation_percent: tuple[float | None, ...]
    dark_exposure_s: tuple[float, ...] = ()
    dark_exposure_mean_dn: tuple[float, ...] = ()
    dark_exposure_variance_dn2: tuple[float, ...] = ()
    #: The pair of stacks that the spatial figures come from, and how many images each has.
    stack_dark_exposure_s: float | None = None
    stack_dark_images: int | None = None
    stack_light: float | None = None
    stack_exposure_s: float | None = None
    stack_images: int | None = None


class PhotonTransfer(Frozen):
    """The points of the photon-transfer and linearity plots, one per level: means over the channel."""

    channel: tuple[str, ...]
    exposure_s: tuple[float, ...]
    signal_dn: tuple[float, ...]  # mean less dark
    signal_dn_std: tuple[float, ...]
    variance_dn2: tuple[float, ...]  # temporal, less dark
    variance_dn2_std: tuple[float, ...]
    used: tuple[bool, ...]
    linearity_residual_percent: tuple[float | None, ...]
