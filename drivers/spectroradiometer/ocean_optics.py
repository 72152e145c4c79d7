"""Ocean Optics spectrometers through `seabreeze` (its pure-Python backend): counts, made a radiance by a calibration
file.

Every model on USB that the library knows; only the USB2000+ was tried, on its mock. The instruments have no radiometric
calibration of their own. The file's two columns are `wavelength_nm,counts_per_s_per_w_sr_m2_nm`: counts a second above
dark, corrected for the instrument's nonlinearity, for a radiance of 1 W sr^-1 m^-2 nm^-1 at the place where it is used
(fibre, lens and distance included)."""

from __future__ import annotations

import contextlib
import threading
from typing import Any

import numpy as np
import usb.core
import usb.util
from numpy.typing import NDArray

from drivers.calibration_file import read_calibration
from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted
from drivers.instrument import Identity, Recorder
from drivers.spectroradiometer.base import RadianceMeasurement, Spectroradiometer
from drivers.usbip import open_device, translate
from sim.spectrum import Spectrum

COLUMNS = ["wavelength_nm", "counts_per_s_per_w_sr_m2_nm"]
#: Share of full scale that a measurement aims at, and the least that it takes where a longer time would give more.
AIM, LEAST = 0.7, 0.35
#: Share of full scale from which on a pixel counts as saturated.
SATURATED = 0.985
_TRIES = 12
_FIRST_S, _SHORTEST_S = 0.1, 0.001
_SETTLING_SCANS = 1  # the scan under way when the time is set still has the old one
_LEAST_OVER_NOISE = 5.0

FloatArray = NDArray[np.float64]


class OceanOptics(Spectroradiometer):
    """A spectrometer at `usb://SERIAL` or `usbip://HOST:PORT/SERIAL` (or an already found pyusb `device`).

    `calibration`: the file described above. `max_integration_s`: longest integration time it may choose. `averages`:
    scans that one measurement takes. `dark_counts`: counts without light, needed for models that have no covered
    pixels. The spectrum comes on whole nanometres from `from_nm` to `to_nm`, as far as the calibration reaches.
    `recorder` is taken for the sake of the station file; `seabreeze` keeps the wire to itself."""

    def __init__(
        self,
        address: str,
        *,
        calibration: str,
        from_nm: int = 350,
        to_nm: int = 1000,
        max_integration_s: float = 3.0,
        averages: int = 4,
        dark_counts: float | None = None,
        device: usb.core.Device | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        if averages < 1:
            raise InstrumentError(
                f"spectrometer: averages = {averages} is below the limit of 1: take one scan at least"
            )
        if not max_integration_s >= _SHORTEST_S:
            raise InstrumentError(
                f"spectrometer: max_integration_s = {max_integration_s} s is below the limit of {_SHORTEST_S} s: "
                "allow it more"
            )
        self.address, self._given = address, device
        self._response = read_calibration(calibration, COLUMNS, "spectrometer")
        low, high = self._response.wavelength_nm[0], self._response.wavelength_nm[-1]
        self._grid_nm = np.arange(max(from_nm, int(np.ceil(low))), min(to_nm, int(high)) + 1, dtype=float)
        if self._grid_nm.size < 2:
            raise InstrumentError(
                f"spectrometer: {from_nm}..{to_nm} nm lies outside the calibration's {low:g}..{high:g} nm: ask for "
                "wavelengths inside"
            )
        self.max_integration_s, self.averages, self.dark_counts = max_integration_s, averages, dark_counts
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self._open: Any = None
        self._device: usb.core.Device | None = None

    def connect(self) -> None:
        with self._lock:
            self.close()
            # Slow to import, and needed by few stations.
            from seabreeze.pyseabreeze.devices import SeaBreezeDevice
            from seabreeze.pyseabreeze.transport import USBTransport, USBTransportHandle

            device = self._given if self._given is not None else open_device(self.address)
            self._device = device
            self._model = USBTransport.vendor_product_ids.get((device.idVendor, device.idProduct), "")
            if not self._model:
                raise InstrumentError(
                    f"spectrometer {self.address}: USB device {device.idVendor:04x}:{device.idProduct:04x} is no "
                    "spectrometer that "
                    "seabreeze knows: correct the address in the station file"
                )
            try:
                self._open = SeaBreezeDevice(USBTransportHandle(device))
                self._open.open()
                pixels = self._open.f.spectrometer
                self._wavelength_nm = np.asarray(pixels.get_wavelengths(), float)
                self._dark_pixels = np.array(pixels.get_electric_dark_pixel_indices())
                # The library stretches counts so that saturation is at 65535; calibrations and the bend are in raw
                # counts.
                self._stretch = float(pixels._normalization_value)
                self._full_scale = float(pixels.get_maximum_intensity()) / self._stretch
                self._bend = self._nonlinearity()
                self._shortest_s, longest_s = (limit * 1e-6 for limit in pixels.get_integration_time_micros_limits())
                self._longest_s = min(self.max_integration_s, longest_s)
                pixels.set_trigger_mode(0)
            except Exception as error:
                self._drop()
                raise self._error(error, "connecting") from error
            if self._dark_pixels.size == 0 and self.dark_counts is None:
                self._drop()
                raise InstrumentError(
                    f"spectrometer {self.address}: a {self._model} has no covered pixels: give dark_counts in the "
                    "station file"
                )
            if not (np.all(np.isfinite(self._wavelength_nm)) and np.all(np.diff(self._wavelength_nm) > 0)):
                self._drop()
                raise Garbled(
                    f"spectrometer {self.address}: its wavelength coefficients don't ascend: have its EEPROM restored"
                )

    def _nonlinearity(self) -> FloatArray:
        """Return the maker's polynomial; 1 where the model keeps none."""
        coefficients = getattr(self._open.f, "nonlinearity_coefficients", None)
        bend = np.array([] if coefficients is None else coefficients.get_nonlinearity_coefficients(), float)
        return bend if bend.size and np.any(bend != 0) else np.ones(1)

    def _dark(self, counts: FloatArray) -> float:
        if self._dark_pixels.size:
            return float(np.median(counts[self._dark_pixels]))
        assert self.dark_counts is not None
        return self.dark_counts

    def identity(self) -> Identity:
        with self._lock:
            serial_number = str(self._connect_once().serial_number)
            return Identity("Ocean Optics", self._model.replace("PLUS", "+"), serial_number)

    def measure(self) -> RadianceMeasurement:
        """Return the spectral radiance: scans at an integration time of its own choice, dark pixels subtracted,
        corrected for nonlinearity, divided by the response.
        """
        with self._lock:
            self._stopped.clear()
            pixels = self._connect_once().f.spectrometer
            try:
                integration_s = self._choose_time(pixels)
                scans = [self._scan(pixels) for _ in range(self.averages)]
            except (usb.core.USBError, Garbled) as error:
                self._drop()  # what it sends next may belong to this
                raise self._error(error, "measuring") from error
            signal = np.mean([self._signal(scan) for scan in scans], axis=0)
            rate = Spectrum.of(self._wavelength_nm, signal / integration_s)
            # The mean over every nanometre, so that the pixels' noise averages and no light is lost between the
            # samples.
            mean_rate = np.asarray(rate.resample(self._grid_nm).value)
            radiance = Spectrum.of(self._grid_nm, mean_rate / self._response.at(self._grid_nm))
            return RadianceMeasurement(radiance, integration_s, str(self._open.serial_number))

    def stop(self) -> None:
        """End a measurement after the current scan; the instrument emits nothing and moves nothing."""
        self._stopped.set()

    def close(self) -> None:
        with self._lock:
            self._drop()

    # --- inside -------------------------------------------------------------------------------------------------------

    def _connect_once(self) -> Any:
        if self._open is None:
            self.connect()
        return self._open

    def _drop(self) -> None:
        opened, self._open = self._open, None
        device, self._device = self._device, None
        if opened is not None:
            with contextlib.suppress(Exception):  # the library raises what it likes, and the device may be gone
                opened.close()
        if device is not None:  # the library keeps it where closing failed
            with contextlib.suppress(usb.core.USBError):
                usb.util.dispose_resources(device)

    def _error(self, error: Exception, doing: str) -> InstrumentError:
        who = f"spectrometer {self.address}"
        if isinstance(error, InstrumentError):
            return error
        if isinstance(error, usb.core.USBError):
            return translate(error, who, doing)
        return Disconnected(f"{who}: {doing} failed ({error}); unplug it, plug it in and try again")

    def _scan(self, pixels: Any) -> FloatArray:
        """Counts of all pixels, dark ones included, (2048,)."""
        if self._stopped.is_set():
            raise Interrupted(f"spectrometer {self.address}: the measurement was stopped")
        try:
            counts = np.asarray(pixels.get_intensities(), float) / self._stretch
        except ValueError as error:  # the library's, where bytes are missing
            raise Garbled(
                f"spectrometer {self.address}: sent a spectrum that isn't whole ({' '.join(str(error).split())}); "
                "measure again"
            ) from error
        if counts.shape != self._wavelength_nm.shape:
            raise Garbled(
                f"spectrometer {self.address}: sent {counts.size} pixels of {self._wavelength_nm.size}; measure again"
            )
        covered = counts[self._dark_pixels]
        if covered.size > 1 and np.ptp(covered) == 0 and covered[0] < SATURATED * self._full_scale:
            raise Garbled(
                f"spectrometer {self.address}: sent {covered[0]:.0f} counts for each of its {covered.size} covered "
                "pixels, without any noise; "
                "measure again"
            )
        return counts

    def _choose_time(self, pixels: Any) -> float:
        """Set the integration time (s) at which the brightest pixel is near AIM of full scale."""
        seconds = min(max(_FIRST_S, self._shortest_s), self._longest_s)
        for _ in range(_TRIES):
            pixels.set_integration_time_micros(round(seconds * 1e6))
            for _ in range(_SETTLING_SCANS):
                self._scan(pixels)
            counts = self._scan(pixels)
            dark = self._dark(counts)
            peak = float(np.max(counts)) - dark
            room = self._full_scale - dark
            if np.max(counts) >= SATURATED * self._full_scale:
                if seconds <= self._shortest_s:
                    raise InstrumentError(
                        f"spectrometer {self.address}: over-exposed at its shortest time of {self._shortest_s:g} s: "
                        "dim the light"
                    )
                seconds = max(seconds / 5.0, self._shortest_s)
            elif peak >= LEAST * room:
                return seconds
            elif seconds >= self._longest_s:
                noise = float(np.std(counts[self._dark_pixels], ddof=1)) if self._dark_pixels.size > 1 else 0.0
                if peak < _LEAST_OVER_NOISE * noise:
                    raise InstrumentError(
                        f"spectrometer {self.address}: under-exposed, {peak:.0f} counts above dark at {seconds:g} s "
                        "with a noise of "
                        f"{noise:.0f}: give it more light or a longer `max_integration_s`"
                    )
                return seconds
            else:
                grow = AIM * room / max(peak, 1e-3 * room)
                seconds = min(seconds * min(grow, 10.0), self._longest_s)
        raise InstrumentError(
            f"spectrometer {self.address}: no integration time fits the light: check that it is steady"
        )

    def _signal(self, counts: FloatArray) -> FloatArray:
        """Counts above the dark, corrected by the maker's nonlinearity polynomial."""
        above = counts - self._dark(counts)
        return np.asarray(above / np.polynomial.polynomial.polyval(above, self._bend))
