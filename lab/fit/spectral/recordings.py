"""The quantum efficiency of a camera from its narrowband captures, as it stands in the results.

Signals are electrons per second, lights photons per second (`SpectralCaptures`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.errors import NotDetermined
from lab.fit.spectral.maker_curves import compare_curves, solve_with_maker
from lab.fit.spectral.sensitivity import (
    COVERAGE_FACTOR,
    NEGATIVE_LIGHT,
    ChannelSignals,
    Sensitivity,
    different_spectra,
    joint_covariance,
    scatter_remarks,
    solve_sensitivities,
    trapezoid_weights,
)
from lab.formats.recording_set import RecordingSet
from lab.formats.results import MakerDeparture, NoiseFit, RepeatDrift, SpectralFit
from lab.observables.codes.step import find_code_step
from lab.observables.noise.levels import darks_near
from lab.observables.plane_means import ChannelMean, central_codes, central_part, channel_means
from lab.observables.spectra.light_readings import RADIOMETER_STD
from lab.observables.weighted_lines import DarkLine, dark_line
from lab.one_blas_thread import one_blas_thread
from sim.camera import Side
from sim.optics.illumination import irradiance_factor
from sim.sensor.mosaic import phases, step
from sim.spectrum import FloatArray, photons_from_energy

CLIPPED_LIMIT = 1e-4  # share of clipped pixels above which a mean is too low
SATURATED_SHARE = 0.98  # of the fitted full well
FLAT_RANGE = (0.2, 0.9)  # of saturation: flats that may help out
MIN_LIGHTS = 5

# A curve is stated every 10 nm, mostly at the wavelengths of the lights, where structure finer than these is largest.
FINE_SHARE = 0.13  # chosen so that bands contain measured curves at the stated wavelengths
OUTPUT_STEP_NM = 10.0
SEEN_SIGMA = 5.0  # standard deviations that one signal at least has to be above the dark
CENTROID_MARGIN_NM = 1.0  # beyond the centroids of the outer lights up to which the curve is stated


class SpectralCaptures:
    """The narrowband captures of one camera, or flats of known radiance where these are too few.

    `wave` (m,): wavelengths, nm, by 1; `lights`: spectral photon rates of a pixel, (m,), photons s^-1 nm^-1, by the
    path of the radiance; `region`: rows and columns over which signals are averaged; `pixels`: their number by
    channel; `photons`: photons per second at a pixel on axis per radiance.
    """

    def __init__(
        self, recordings: RecordingSet, side: Side, noise: NoiseFit | None, drifts: Sequence[RepeatDrift] = ()
    ) -> None:
        self.recordings, self.side, self.noise = recordings, side, noise
        #: Standard deviation of the mean of each repeat by a drift, DN: in the mean over the n repeats, where these
        #: count as independent, the drift's uncertainty is left whole.
        self.drift_dn = {
            name: drift.level_dn_std * len(drift.mean_dn) ** 0.5 for drift in drifts for name in drift.captures
        }
        self.camera = recordings.camera(side)
        self.remarks: list[str] = []
        self.narrowband: list[NarrowbandCapture | FlatCapture] = [
            c for c in recordings.captures(NarrowbandCapture, side) if c.exposure_s > 0
        ]
        if len({self.path(c) for c in self.narrowband}) < MIN_LIGHTS:
            # Broadband lights of known radiance: LEDs, lamps behind filters
            flats = [f for f in recordings.captures(FlatCapture, side) if f.exposure_s > 0 and f.radiance is not None]
            self.narrowband.extend(flats)
            if not self.narrowband:
                raise NotDetermined(
                    "spectral",
                    "no narrowband captures and no flats of known radiance: capture narrowband light over the "
                    "visible by 10 nm or finer",
                )
        self.gain, self.gain_std = self._conversion_gain()
        self.region = central_part((self.camera.rows, self.camera.cols))
        self._step_dn = find_code_step(self.recordings, self.side).step_dn
        self.pixels = {channel: self._pixel_count(channel) for channel in phases(self.camera.cfa)}
        self.photons = self._photons_per_radiance()
        self.darks: dict[tuple[float, str], DarkLine] = {}
        self.wave, self.lights = self._lights()

    @staticmethod
    def path(capture: NarrowbandCapture | FlatCapture) -> str:
        """Return the path of the radiance of a capture."""
        return cast(str, capture.radiance)

    def _conversion_gain(self) -> tuple[float, float]:
        """Return the conversion gain, DN/e, and its standard deviation: fitted, or else stated."""
        if self.noise is not None and self.noise.conversion_gain_dn_per_e is not None:
            return self.noise.conversion_gain_dn_per_e, self.noise.conversion_gain_dn_per_e_std or 0.0
        if self.camera.conversion_gain_dn_per_e is not None:
            self.remarks.append(
                "the conversion gain is the maker's: the scale of the quantum efficiency stands with it"
            )
            return self.camera.conversion_gain_dn_per_e, 0.0
        raise NotDetermined(
            "spectral", "the conversion gain isn't known: capture flats with repeats, or state conversion_gain_dn_per_e"
        )

    def _photons_per_radiance(self) -> float:
        """Return the photons s^-1 at a pixel on axis per radiance in photons s^-1 m^-2 sr^-1, with the mean cos^4 of
        the region.
        """
        camera = self.camera
        missing = [key for key in ("f_number", "pixel_pitch_um") if getattr(camera, key) is None]
        if missing:
            raise NotDetermined(
                "spectral", f"{' and '.join(missing)} unknown: state it, the photons at a pixel follow from it"
            )
        for key, what in (
            ("lens_transmittance", "the lens's losses are part of the quantum efficiency"),
            ("fill_factor", "the quantum efficiency is that of the whole pixel"),
        ):
            if getattr(camera, key) is None:
                self.remarks.append(f"{key} is unknown and taken as 1: {what}")
        pitch_m = cast(float, camera.pixel_pitch_um) * 1e-6
        return (
            irradiance_factor(cast(float, camera.f_number))
            * (camera.lens_transmittance or 1.0)
            * (camera.fill_factor or 1.0)
            * pitch_m**2
            * self._fall_off()
        )

    def _fall_off(self) -> float:
        """Return the mean cos^4 over the region, about the centre of the frame."""
        if self.camera.focal_length_mm is None or self.camera.pixel_pitch_um is None:
            return 1.0
        scale = self.camera.pixel_pitch_um * 1e-3 / self.camera.focal_length_mm
        rows, cols = (np.arange(s.start, s.stop) for s in self.region)
        y = (rows - 0.5 * (self.camera.rows - 1)) * scale
        x = (cols - 0.5 * (self.camera.cols - 1)) * scale
        return float(np.mean(1.0 / (1.0 + y[:, None] ** 2 + x**2) ** 2))

    def _means(self, capture: Capture) -> dict[str, ChannelMean]:
        """Return the mean of each channel in the region."""
        return channel_means(central_codes(self.recordings, capture), self.camera.cfa)

    def _pixel_count(self, channel: str) -> int:
        """Count the pixels of a channel in the region."""
        rows, cols = (s.stop - s.start for s in self.region)
        return rows * cols // step(self.camera.cfa) ** 2 * len(phases(self.camera.cfa)[channel])

    def _dark(self, gain_db: float, channel: str, exposure_s: float) -> tuple[float, float]:
        """Return the dark mean in the region, DN, and its standard deviation."""
        if not self.darks:
            self._read_darks()
        line = self.darks.get((gain_db, channel))
        if line is not None:
            basis = np.array([1.0, exposure_s])
            return line.at(exposure_s), float(np.sqrt(basis @ line.covariance @ basis))
        black = self.noise.black_level_dn if self.noise is not None else None
        black = self.camera.black_level_dn if black is None else black
        if black is None:
            raise NotDetermined(
                "spectral", "neither darks nor a black level: capture darks at the narrowband exposures"
            )
        rate = (self.noise.dark_current_e_per_s or 0.0) if self.noise is not None else 0.0
        return black + rate * exposure_s * self._dn_per_e(gain_db), 0.0

    def _read_darks(self) -> None:
        """Fit the dark means of the region against exposure, by gain and channel, of the temperature at which most
        narrowband captures were taken."""
        means_of_key: dict[tuple[float, str], list[tuple[float, float, float]]] = {}
        for dark in darks_near(self.recordings.captures(DarkCapture, self.side), self.narrowband):
            for channel, channel_mean in self._means(dark).items():
                means = means_of_key.setdefault((dark.gain_db or 0.0, channel), [])
                std = float(np.hypot(channel_mean.mean_std_dn(self._step_dn), self.drift_dn.get(dark.id, 0.0)))
                means.append((dark.exposure_s, channel_mean.mean_dn, std))
        for key, rows in means_of_key.items():
            self.darks[key] = dark_line(*np.array(rows).T)

    def _dn_per_e(self, gain_db: float | None) -> float:
        """Return the conversion gain, DN/e, at a gain in dB."""
        return self.gain * 10.0 ** ((gain_db or 0.0) / 20.0)

    def _electron_rate(
        self, capture: Capture, channel: str, channel_mean: ChannelMean
    ) -> tuple[float, float, bool, float]:
        """Return the electrons per second, their standard deviation, whether the capture saturates, and its share of
        saturation.

        `channel_mean`: the channel's mean in the region.
        """
        gain = self._dn_per_e(capture.gain_db)
        dark, dark_std = self._dark(capture.gain_db or 0.0, channel, capture.exposure_s)
        signal = channel_mean.mean_dn - dark
        limit = self.camera.saturation_dn - dark
        if self.noise is not None and self.noise.full_well_e is not None:
            limit = min(limit, self.noise.full_well_e * gain)
        clipped = (
            channel_mean.clipped_share(self.camera.saturation_dn) > CLIPPED_LIMIT or signal > SATURATED_SHARE * limit
        )
        scale = 1.0 / (gain * capture.exposure_s)
        # The pixels differ by shot noise, read noise and PRNU
        noise = channel_mean.mean_std_dn(self._step_dn)
        std = float(np.sqrt(noise**2 + dark_std**2 + self.drift_dn.get(capture.id, 0.0) ** 2))
        return signal * scale, std * scale, clipped, signal / limit

    def _lights(self) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Return the wavelengths at which the lights shine, and the photon rates of the usable lights on them."""
        paths = dict.fromkeys(self.path(capture) for capture in self.narrowband)
        spectra = {path: self.recordings.spectrum(path) for path in paths}
        for path in paths:
            value = spectra[path].arrays[1]
            if not np.all(np.isfinite(value)) or value.min() < -NEGATIVE_LIGHT * value.max():
                self.remarks.append(
                    f"the light {path} is left out: its radiance is negative or not a number "
                    f"(lowest {value.min():.3g}, highest {value.max():.3g}); measure it again"
                )
                del spectra[path]
        low, high = np.inf, -np.inf
        for spectrum in spectra.values():
            wave, value = np.array(spectrum.wavelength_nm), np.array(spectrum.value)
            lit = wave[value > 1e-3 * value.max()] if value.max() > 0 else wave[:0]
            if lit.size:
                low, high = min(low, lit[0]), max(high, lit[-1])
        if not low < high:
            raise NotDetermined("spectral", "all spectra are dark or unusable: measure them with the light on")
        grid = np.arange(np.floor(low), np.ceil(high) + 0.5)
        return grid, {path: self._photon_rate_on(grid, path) for path in spectra}

    def photon_rate(self, path: str) -> FloatArray:
        """Return the photons on axis (m,), photons s^-1 nm^-1 a pixel, of the radiance at `path`."""
        return self._photon_rate_on(self.wave, path)

    def _photon_rate_on(self, wave: FloatArray, path: str) -> FloatArray:
        """Return the photon rate on axis (m,) at the wavelengths `wave`, photons s^-1 nm^-1 a pixel."""
        spectrum = self.recordings.spectrum(path)
        return self.photons * photons_from_energy(wave, np.clip(spectrum.at(wave), 0.0, None))

    def signals(self) -> dict[str, ChannelSignals]:
        """Measure the signals of each channel: one for every light, lower limits where it saturates. Raises
        `NotDetermined` where too few lights are left.
        """
        lights = self.lights
        weights = trapezoid_weights(self.wave)
        rates: dict[tuple[str, str], list[tuple[float, float, bool, float]]] = {}
        for capture in self.narrowband:
            for channel, channel_mean in self._means(capture).items():
                rates.setdefault((channel, self.path(capture)), []).append(
                    self._electron_rate(capture, channel, channel_mean)
                )
        result = {}
        for channel in phases(self.camera.cfa):
            good: list[tuple[FloatArray, float, float]] = []
            seen: list[str] = []
            high: list[tuple[FloatArray, float]] = []
            for path, light in lights.items():
                if not np.any(light > 0):
                    continue
                captures_of_light = rates[channel, path]
                usable = [(rate, std) for rate, std, clipped, _ in captures_of_light if not clipped]
                if usable:
                    weight = 1.0 / np.array([std for _, std in usable]) ** 2
                    mean = float(np.sum(weight * [rate for rate, _ in usable]) / weight.sum())
                    mean_std = float(np.sqrt(1.0 / weight.sum()))
                    seen.append(path)
                    good.append((light * weights, mean, float(np.hypot(mean_std, RADIOMETER_STD * mean))))
                else:
                    # A saturated mean is a lower limit, less 1 % for its noise
                    high.append((light * weights, 0.99 * max(rate for rate, *_ in captures_of_light)))
            if len(good) < MIN_LIGHTS:
                reason = (
                    f"only {len(good)} of {len(lights)} lights leave channel {channel} unsaturated, {MIN_LIGHTS} "
                    "needed: expose shorter"
                    if high
                    else f"{len(good)} different lights, {MIN_LIGHTS} needed: capture narrowband light over the "
                    "visible by 10 nm or finer"
                )
                raise NotDetermined("spectral", reason)
            if (different := different_spectra(np.array([g[0] for g in good]))) < MIN_LIGHTS:
                raise NotDetermined(
                    "spectral",
                    f"the {len(good)} lights are of {different} different spectra, {MIN_LIGHTS} needed: capture "
                    "narrowband light over the visible by 10 nm or finer",
                )
            size = self.wave.size
            result[channel] = ChannelSignals(
                np.array([g[0] for g in good]),
                np.array([g[1] for g in good]),
                np.array([g[2] for g in good]),
                tuple(seen),
                np.array([h[0] for h in high]).reshape(-1, size),
                np.array([h[1] for h in high]),
            )
        return result

    def with_flats(self, signals: dict[str, ChannelSignals]) -> dict[str, ChannelSignals]:
        """Add the signals of the flats of known radiance: one for each spectrum."""
        rates: dict[tuple[str, str], list[tuple[float, float]]] = {}
        used: dict[str, list[FlatCapture]] = {}
        for flat in self.recordings.captures(FlatCapture, self.side):
            if flat.radiance is not None and flat.exposure_s > 0:
                used.setdefault(flat.radiance, []).append(flat)
        for path, flats in used.items():
            for flat in flats:
                for channel, channel_mean in self._means(flat).items():
                    rate, std, clipped, share = self._electron_rate(flat, channel, channel_mean)
                    if not clipped and FLAT_RANGE[0] < share < FLAT_RANGE[1]:
                        rates.setdefault((channel, path), []).append((rate, std))
        weights = trapezoid_weights(self.wave)
        result = {}
        for channel, narrowband in signals.items():
            rows, values_, stds, seen = (
                [narrowband.operator],
                [narrowband.value],
                [narrowband.std],
                list(narrowband.light),
            )
            for path in used:
                flat_rates = rates.get((channel, path))
                spectrum = self.recordings.spectrum(path)
                total = np.trapezoid(spectrum.value, spectrum.wavelength_nm)
                inside = float(np.trapezoid(spectrum.at(self.wave), self.wave))
                # Light beyond the narrowband range would count as light inside
                if not flat_rates or inside < 0.95 * total:
                    continue
                weight = 1.0 / np.array([std for _, std in flat_rates]) ** 2
                mean = float(np.sum(weight * [rate for rate, _ in flat_rates]) / weight.sum())
                outside = 1.0 - inside / total
                seen.append(path)
                rows.append((self.photon_rate(path) * weights)[None])
                values_.append(np.array([mean]))
                stds.append(np.array([mean * np.hypot(RADIOMETER_STD, outside)]))
            result[channel] = ChannelSignals(
                np.concatenate(rows),
                np.concatenate(values_),
                np.concatenate(stds),
                tuple(seen),
                narrowband.saturated,
                narrowband.limit,
            )
        return result

    def maker_curves(self) -> dict[str, FloatArray] | None:
        """Return the curves (m,) of the maker by channel; None where one is missing or 0."""
        stated = self.camera.quantum_efficiency or {}
        if not all(channel in stated for channel in phases(self.camera.cfa)):
            return None
        curves = {
            c: np.clip(self.recordings.spectrum(stated[c]).at(self.wave), 0.0, None) for c in phases(self.camera.cfa)
        }
        return curves if all(curve.max() > 0 for curve in curves.values()) else None


@one_blas_thread
def fit_spectral(
    recordings: RecordingSet, side: Side, noise: NoiseFit | None = None, drifts: Sequence[RepeatDrift] = ()
) -> SpectralFit:
    """Fit the absolute quantum efficiency of every channel to the narrowband captures, electrons per photon at the
    pixel.

    Irradiance on axis: pi T L / (1 + 4 N^2). The stated transmittance of the lens T and the fill factor are divided
    out, and the mean cos^4 of the region. Signals are means over the central quarter of rows and columns. Saturated
    captures are left out. Where a channel has no other light, the curves of the maker (times a smooth factor common to
    the channels, and a smooth factor of a few per cent of each) and the flats with a stated radiance stand in; without
    these, smoothness alone. `drifts`: of the side's repeats over time. Raises `NotDetermined` where the scale or the
    light is missing. The method: `lab.fit.spectral`.
    """
    captures = SpectralCaptures(recordings, side, noise, drifts)
    signals = captures.signals()
    gaps = {c: s.limit.size for c, s in signals.items() if s.has_gaps}
    maker = captures.maker_curves() if gaps else None
    if gaps:
        listed = ", ".join(f"{channel} under {count}" for channel, count in gaps.items())
        filled = (
            "there the curve rests on the maker's, times a smooth factor that the channels share, and on the flats"
            if maker
            else "there the curve is known from below and by its smoothness alone"
        )
        captures.remarks.append(
            f"saturated narrowband captures are left out ({listed} lights): {filled}; expose shorter to measure it"
        )
    if maker:
        signals = captures.with_flats(signals)
        solved = dict(
            zip(
                signals,
                solve_with_maker(captures.wave, list(signals.values()), [maker[c] for c in signals]),
                strict=True,
            )
        )
    else:
        solved, scatter = solve_sensitivities(captures.wave, signals, FINE_SHARE)
        captures.remarks += scatter_remarks(scatter)
    return _result(captures, solved, signals, maker_is_prior=bool(maker))


def _span(captures: SpectralCaptures) -> tuple[float, float]:
    """Return the first and last wavelength that the lights determine: narrowband by the centroids of their measured
    spectra (their nominal ones may be some nm off), broadband wholly.
    """
    if any(isinstance(capture, FlatCapture) for capture in captures.narrowband):
        return float(captures.wave[0]), float(captures.wave[-1])
    paths = {captures.path(capture) for capture in captures.narrowband}
    centroids = []
    for rate in (captures.photon_rate(path) for path in paths):
        if rate.max() > 0:
            centroids.append(float(np.sum(rate * captures.wave) / rate.sum()))
    margin = CENTROID_MARGIN_NM
    return max(min(centroids) - margin, captures.wave[0]), min(max(centroids) + margin, captures.wave[-1])


def _result(
    captures: SpectralCaptures,
    solved: dict[str, Sensitivity],
    signals: dict[str, ChannelSignals],
    *,
    maker_is_prior: bool,
) -> SpectralFit:
    """State the curves every 10 nm, with their standard deviations, where they are determined, and beside those of the
    maker.
    """
    low, high = _span(captures)
    out = np.arange(np.ceil(low / OUTPUT_STEP_NM), np.floor(high / OUTPUT_STEP_NM) + 1) * OUTPUT_STEP_NM
    known = {
        c: np.interp(out, captures.wave, sensitivity.determined.astype(float)) > 0.5
        for c, sensitivity in solved.items()
    }
    any_channel = np.flatnonzero(np.any(list(known.values()), axis=0))
    inside = slice(any_channel[0], any_channel[-1] + 1) if any_channel.size else slice(0, 0)
    out = out[inside]
    highest = max(float(np.max(channel_signals.value / channel_signals.std)) for channel_signals in signals.values())
    if highest < SEEN_SIGMA and not any(channel_signals.has_gaps for channel_signals in signals.values()):
        raise NotDetermined(
            "spectral",
            f"the captures show no light: the strongest signal is {highest:.1f} standard uncertainties above the "
            f"dark, {SEEN_SIGMA:g} needed: open the shutter, or expose longer",
        )
    if out.size < 2:
        raise NotDetermined(
            "spectral",
            f"the lights within {low:.0f}..{high:.0f} nm don't span the spectrum: capture narrowband light over the "
            "visible by 10 nm or finer",
        )
    gaps = {c: _intervals(out, ~k[inside]) for c, k in known.items()}
    for channel, runs in gaps.items():
        if runs:
            where = ", ".join(f"{a:g}..{b:g} nm" for a, b in runs)
            captures.remarks.append(
                f"{channel} isn't identifiable at {where}: no light that was measured tells it there; capture "
                "narrowband light there"
            )
    channels = list(solved)
    at = np.stack([np.interp(out, captures.wave, row) for row in np.eye(captures.wave.size)], axis=1)
    joint = joint_covariance(at, solved)
    value = np.concatenate([np.interp(out, captures.wave, solved[c].sensitivity) for c in channels])
    # PRNU of the region differs between channels; the conversion gain is common
    prnu = (captures.noise.prnu_percent if captures.noise is not None else None) or 0.0
    for k, channel in enumerate(channels):
        span = slice(k * out.size, (k + 1) * out.size)
        joint[span, span] += (prnu / 100.0) ** 2 / captures.pixels[channel] * np.outer(value[span], value[span])
    absolute = np.sqrt(np.diag(joint) + (captures.gain_std / captures.gain * value) ** 2)
    peak = int(np.argmax(value))
    ratio = value / value[peak]
    variance_of_ratio = np.diag(joint) - 2.0 * ratio * joint[peak] + ratio**2 * joint[peak, peak]
    relative = np.sqrt(np.clip(variance_of_ratio, 0.0, None)) / value[peak]

    def by_channel(array: FloatArray) -> dict[str, tuple[float, ...]]:
        return {c: tuple(row.tolist()) for c, row in zip(channels, array.reshape(len(channels), -1), strict=True)}

    integral, integral_std = _integrals(out, value, joint, captures.gain_std / captures.gain)
    scale, departures = _departures(captures, out, channels, value, joint) if not maker_is_prior else (None, ())
    return SpectralFit(
        wavelength_nm=tuple(out.tolist()),
        quantum_efficiency=by_channel(value),
        quantum_efficiency_std=by_channel(absolute),
        relative_sensitivity=by_channel(ratio),
        relative_sensitivity_std=by_channel(relative),
        integrated_efficiency_nm=dict(zip(channels, integral, strict=True)),
        integrated_efficiency_nm_std=dict(zip(channels, integral_std, strict=True)),
        not_determined_nm={c: runs for c, runs in gaps.items() if runs},
        maker_scale=scale,
        maker_departures=departures,
        coverage_factor=COVERAGE_FACTOR,
        remarks=tuple(captures.remarks),
    )


def _integrals(
    out: FloatArray, value: FloatArray, joint: FloatArray, gain_error: float
) -> tuple[list[float], list[float]]:
    """Integrate the curves `value` (channels x k,) at `out` (k,), nm, over wavelength. Returns the integrals and their
    standard deviations, by channel.

    `joint`: covariance of `value` without the relative error of the gain, `gain_error`.
    """
    weights = np.kron(np.eye(value.size // out.size), trapezoid_weights(out))
    total = weights @ value
    std = np.sqrt(np.diag(weights @ joint @ weights.T) + (gain_error * total) ** 2)
    return total.tolist(), std.tolist()


def _departures(
    captures: SpectralCaptures, out: FloatArray, channels: Sequence[str], value: FloatArray, joint: FloatArray
) -> tuple[float | None, tuple[MakerDeparture, ...]]:
    """Compare the fitted curves with those of the maker; None where there are none.

    `out` (k,), nm; `value` (channels x k,), channel after channel, with covariance `joint`.
    """
    maker = captures.maker_curves()
    if maker is None:
        return None, ()
    ends = [
        captures.recordings.spectrum((captures.camera.quantum_efficiency or {})[c]).arrays[0][[0, -1]] for c in channels
    ]
    covered = (out >= max(low for low, _ in ends)) & (out <= min(high for _, high in ends))
    if not covered.any():
        return None, ()
    every = np.tile(covered, len(channels))
    stated = np.concatenate([np.interp(out[covered], captures.wave, maker[c]) for c in channels])
    return compare_curves(out[covered], channels, value[every], joint[np.ix_(every, every)], stated)


def _intervals(wave: FloatArray, where: NDArray[np.bool_]) -> tuple[tuple[float, float], ...]:
    """Return the first and last wavelength of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], where.astype(int), [0]])))
    return tuple((float(wave[a]), float(wave[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True))
