"""Signals and lights of the captures of one camera: electrons per second against photons per second."""

from __future__ import annotations

from typing import cast

import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.errors import NotDetermined
from lab.fit.spectral.channel_signals import RADIOMETER_RELATIVE_STD, ChannelSignals
from lab.fit.spectral.sensitivity import NEGATIVE_LIGHT, different_spectra, trapezoid_weights
from lab.fit.weighted_lines import DarkLine, dark_line
from lab.formats.recording_set import RecordingSet
from lab.formats.results import NoiseFit
from sim.camera import Side
from sim.optics.illumination import irradiance_factor
from sim.sensor.mosaic import phases, step
from sim.spectrum import FloatArray, photons_from_energy

CENTRAL_SHARE = 0.25  # of rows and columns: the region on axis over which signals are averaged
CLIPPED_LIMIT = 1e-4  # share of clipped pixels above which a mean is too low
SATURATED_SHARE = 0.98  # of the fitted full well
FLAT_RANGE = (0.2, 0.9)  # of saturation: flats that may help out
MIN_LIGHTS = 5


class SpectralCaptures:
    """The narrowband captures of one camera, or flats of known radiance where these are too few.

    `wave` (m,): wavelengths, nm, by 1; `lights`: spectral photon rates of a pixel, (m,), photons s^-1 nm^-1, by the
    path of the radiance; `region`: rows and columns over which signals are averaged; `pixels`: their number by
    channel; `photons`: photons per second at a pixel on axis per radiance.
    """

    def __init__(self, recordings: RecordingSet, side: Side, noise: NoiseFit | None) -> None:
        self.recordings, self.side, self.noise = recordings, side, noise
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
                    "no narrowband captures and no flats of known radiance: capture narrowband light over the visible by "
                    "10 nm or finer",
                )
        self.gain, self.gain_std = self._conversion_gain()
        self.region = self._central_region()
        self.pixels = {channel: self._pixel_count(channel) for channel in phases(self.camera.cfa)}
        self.photons = self._photons_per_radiance()
        self.darks: dict[tuple[float, str], DarkLine] = {}
        self.wave, self.lights = self._lights()

    @staticmethod
    def path(capture: NarrowbandCapture | FlatCapture) -> str:
        """Path of the radiance of a capture."""
        return cast(str, capture.radiance)

    def _conversion_gain(self) -> tuple[float, float]:
        """Conversion gain, DN/e, and its standard deviation: fitted, or else stated."""
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
        """Photons s^-1 at a pixel on axis per radiance in photons s^-1 m^-2 sr^-1, with the mean cos^4 of the
        region.
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

    def _central_region(self) -> tuple[slice, slice]:
        """Rows and columns of the region, whole periods of the mosaic."""
        period = step(self.camera.cfa)
        spans = []
        for size in (self.camera.rows, self.camera.cols):
            half = max(round(size * CENTRAL_SHARE / 2 / period), 1) * period
            middle = size // 2 // period * period
            spans.append(slice(max(middle - half, 0), min(middle + half, size)))
        return spans[0], spans[1]

    def _fall_off(self) -> float:
        """Mean cos^4 over the region, about the centre of the frame."""
        if self.camera.focal_length_mm is None or self.camera.pixel_pitch_um is None:
            return 1.0
        scale = self.camera.pixel_pitch_um * 1e-3 / self.camera.focal_length_mm
        rows, cols = (np.arange(s.start, s.stop) for s in self.region)
        y = (rows - 0.5 * (self.camera.rows - 1)) * scale
        x = (cols - 0.5 * (self.camera.cols - 1)) * scale
        return float(np.mean(1.0 / (1.0 + y[:, None] ** 2 + x**2) ** 2))

    def _pixel_values(self, capture: Capture) -> dict[str, FloatArray]:
        """DN of the pixels of each channel in the region."""
        frame = self.recordings.frame(capture)[self.region]
        period = step(self.camera.cfa)  # the region starts on whole periods
        return {
            channel: np.concatenate([frame[r::period, c::period].ravel() for r, c in at]).astype(float)
            for channel, at in phases(self.camera.cfa).items()
        }

    def _pixel_count(self, channel: str) -> int:
        rows, cols = (s.stop - s.start for s in self.region)
        return rows * cols // step(self.camera.cfa) ** 2 * len(phases(self.camera.cfa)[channel])

    def _dark(self, gain_db: float, channel: str, exposure_s: float) -> tuple[float, float]:
        """Dark mean in the region, DN, and its standard deviation."""
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
        found: dict[tuple[float, str], list[tuple[float, float, float]]] = {}
        for dark in self.recordings.captures(DarkCapture, self.side):
            for channel, values in self._pixel_values(dark).items():
                own = found.setdefault((dark.gain_db or 0.0, channel), [])
                own.append(
                    (dark.exposure_s, float(values.mean()), float(np.hypot(values.std(), 0.3) / np.sqrt(values.size)))
                )
        for key, rows in found.items():
            self.darks[key] = dark_line(*np.array(rows).T)

    def _dn_per_e(self, gain_db: float | None) -> float:
        return self.gain * 10.0 ** ((gain_db or 0.0) / 20.0)

    def _electron_rate(self, capture: Capture, channel: str, values: FloatArray) -> tuple[float, float, bool, float]:
        """Electrons per second, their standard deviation, whether the capture saturates, and its share of
        saturation.
        """
        gain = self._dn_per_e(capture.gain_db)
        dark, dark_std = self._dark(capture.gain_db or 0.0, channel, capture.exposure_s)
        signal = float(values.mean()) - dark
        limit = self.camera.saturation_dn - dark
        if self.noise is not None and self.noise.full_well_e is not None:
            limit = min(limit, self.noise.full_well_e * gain)
        clipped = (
            float(np.mean(values >= self.camera.saturation_dn)) > CLIPPED_LIMIT or signal > SATURATED_SHARE * limit
        )
        scale = 1.0 / (gain * capture.exposure_s)
        # The pixels differ by shot noise, read noise and PRNU
        std = float(np.hypot(np.hypot(values.std(), 0.3) / np.sqrt(values.size), dark_std))
        return signal * scale, std * scale, clipped, signal / limit

    def _lights(self) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Wavelengths at which the lights shine, and the photon rates of the usable lights on them."""
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
        """Photons on axis (m,), photons s^-1 nm^-1 a pixel, of the radiance at `path`."""
        return self._photon_rate_on(self.wave, path)

    def _photon_rate_on(self, wave: FloatArray, path: str) -> FloatArray:
        spectrum = self.recordings.spectrum(path)
        return self.photons * photons_from_energy(wave, np.clip(spectrum.at(wave), 0.0, None))

    def signals(self) -> dict[str, ChannelSignals]:
        """Signals of each channel: one for every light, lower limits where it saturates. Raises `NotDetermined` where
        too few lights are left.
        """
        lights = self.lights
        weights = trapezoid_weights(self.wave)
        rates: dict[tuple[str, str], list[tuple[float, float, bool, float]]] = {}
        for capture in self.narrowband:
            for channel, values in self._pixel_values(capture).items():
                rates.setdefault((channel, self.path(capture)), []).append(
                    self._electron_rate(capture, channel, values)
                )
        result = {}
        for channel in phases(self.camera.cfa):
            good: list[tuple[FloatArray, float, float]] = []
            seen: list[str] = []
            high: list[tuple[FloatArray, float]] = []
            for path, light in lights.items():
                if not np.any(light > 0):
                    continue
                found = rates[channel, path]
                usable = [(rate, std) for rate, std, clipped, _ in found if not clipped]
                if usable:
                    weight = 1.0 / np.array([std for _, std in usable]) ** 2
                    mean = float(np.sum(weight * [rate for rate, _ in usable]) / weight.sum())
                    mean_std = float(np.sqrt(1.0 / weight.sum()))
                    seen.append(path)
                    good.append((light * weights, mean, float(np.hypot(mean_std, RADIOMETER_RELATIVE_STD * mean))))
                else:
                    # A saturated mean is a lower limit, less 1 % for its noise
                    high.append((light * weights, 0.99 * max(rate for rate, *_ in found)))
            if len(good) < MIN_LIGHTS:
                found_so_many = (
                    f"only {len(good)} of {len(lights)} lights leave channel {channel} unsaturated, {MIN_LIGHTS} needed: expose shorter"
                    if high
                    else f"{len(good)} different lights, {MIN_LIGHTS} needed: capture narrowband light over the visible by 10 nm or finer"
                )
                raise NotDetermined("spectral", found_so_many)
            if (different := different_spectra(np.array([g[0] for g in good]))) < MIN_LIGHTS:
                raise NotDetermined(
                    "spectral",
                    f"the {len(good)} lights are of {different} different spectra, {MIN_LIGHTS} needed: capture narrowband light over "
                    "the visible by 10 nm or finer",
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
        """The signals with those of the flats of known radiance: one for each spectrum."""
        rates: dict[tuple[str, str], list[tuple[float, float]]] = {}
        used: dict[str, list[FlatCapture]] = {}
        for flat in self.recordings.captures(FlatCapture, self.side):
            if flat.radiance is not None and flat.exposure_s > 0:
                used.setdefault(flat.radiance, []).append(flat)
        for path, flats in used.items():
            for flat in flats:
                for channel, values in self._pixel_values(flat).items():
                    rate, std, clipped, share = self._electron_rate(flat, channel, values)
                    if not clipped and FLAT_RANGE[0] < share < FLAT_RANGE[1]:
                        rates.setdefault((channel, path), []).append((rate, std))
        weights = trapezoid_weights(self.wave)
        result = {}
        for channel, own in signals.items():
            rows, values_, stds, seen = [own.operator], [own.value], [own.std], list(own.light)
            for path in used:
                found = rates.get((channel, path))
                spectrum = self.recordings.spectrum(path)
                total = np.trapezoid(spectrum.value, spectrum.wavelength_nm)
                inside = float(np.trapezoid(spectrum.at(self.wave), self.wave))
                # Light beyond the narrowband range would count as light inside
                if not found or inside < 0.95 * total:
                    continue
                weight = 1.0 / np.array([std for _, std in found]) ** 2
                mean = float(np.sum(weight * [rate for rate, _ in found]) / weight.sum())
                outside = 1.0 - inside / total
                seen.append(path)
                rows.append((self.photon_rate(path) * weights)[None])
                values_.append(np.array([mean]))
                stds.append(np.array([mean * np.hypot(RADIOMETER_RELATIVE_STD, outside)]))
            result[channel] = ChannelSignals(
                np.concatenate(rows),
                np.concatenate(values_),
                np.concatenate(stds),
                tuple(seen),
                own.saturated,
                own.limit,
            )
        return result

    def maker_curves(self) -> dict[str, FloatArray] | None:
        """Curves (m,) of the maker by channel; None where one is missing or 0."""
        stated = self.camera.quantum_efficiency or {}
        if not all(channel in stated for channel in phases(self.camera.cfa)):
            return None
        curves = {
            c: np.clip(self.recordings.spectrum(stated[c]).at(self.wave), 0.0, None) for c in phases(self.camera.cfa)
        }
        return curves if all(curve.max() > 0 for curve in curves.values()) else None
