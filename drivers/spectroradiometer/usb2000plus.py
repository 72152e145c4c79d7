"""Ocean Optics USB2000+ through `seabreeze` (its pure-Python backend): counts, made a radiance by a calibration file.

The instrument has no radiometric calibration of its own. The file's two columns are
`wavelength_nm,counts_per_s_per_w_sr_m2_nm`: counts a second above dark, corrected for the instrument's nonlinearity, for a
radiance of 1 W sr^-1 m^-2 nm^-1 at the place where it is used (fibre, lens and distance included).
"""

from __future__ import annotations

import csv
import threading
from pathlib import Path
from typing import Any

import numpy as np
import usb.core
from numpy.typing import NDArray

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


class Usb2000Plus(Spectroradiometer):
    """A USB2000+ at `usb://SERIAL` or `usbip://HOST:PORT/SERIAL` (or an already found pyusb `device`).

    `calibration`: the file described above. `max_integration_s`: longest integration time it may choose. `averages`: scans
    that one measurement takes. The spectrum comes on whole nanometres from `from_nm` to `to_nm`, as far as the calibration
    reaches. `recorder` is taken for the sake of the station file; `seabreeze` keeps the wire to itself.
    """

    def __init__(
        self,
        address: str,
        *,
        calibration: str,
        from_nm: int = 350,
        to_nm: int = 1000,
        max_integration_s: float = 3.0,
        averages: int = 4,
        device: usb.core.Device | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        if averages < 1:
            raise InstrumentError(f"USB2000+: averages = {averages} is below the limit of 1: take one scan at least")
        if not max_integration_s >= _SHORTEST_S:
            raise InstrumentError(
                f"USB2000+: max_integration_s = {max_integration_s} s is below the limit of {_SHORTEST_S} s: allow it more"
            )
        self.address, self._given = address, device
        self._response = read_calibration(calibration)
        low, high = self._response.wavelength_nm[0], self._response.wavelength_nm[-1]
        self._grid_nm = np.arange(max(from_nm, int(np.ceil(low))), min(to_nm, int(high)) + 1, dtype=float)
        if self._grid_nm.size < 2:
            raise InstrumentError(
                f"USB2000+: {from_nm}..{to_nm} nm lies outside the calibration's {low:g}..{high:g} nm: ask for wavelengths inside"
            )
        self.max_integration_s, self.averages = max_integration_s, averages
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self._open: Any = None

    def connect(self) -> None:
        with self._lock:
            self.close()
            # Slow to import, and needed by few stations.
            from seabreeze.pyseabreeze.devices import SeaBreezeDevice
            from seabreeze.pyseabreeze.transport import USBTransportHandle

            device = self._given if self._given is not None else open_device(self.address)
            if (device.idVendor, device.idProduct) != (0x2457, 0x101E):
                raise InstrumentError(
                    f"spectrometer {self.address}: USB device {device.idVendor:04x}:{device.idProduct:04x} is no USB2000+ "
                    "(2457:101e): correct the address in the station file"
                )
            try:
                self._open = SeaBreezeDevice(USBTransportHandle(device))
                self._open.open()
                pixels = self._open.f.spectrometer
                self._wavelength_nm = np.asarray(pixels.get_wavelengths(), float)
                self._dark_pixels = np.array(pixels.get_electric_dark_pixel_indices())
                # The library stretches counts so that saturation is at 65535; calibrations and the bend are in raw counts.
                self._stretch = float(pixels._normalization_value)
                self._full_scale = float(pixels.get_maximum_intensity()) / self._stretch
                self._bend = np.array(self._open.f.nonlinearity_coefficients.get_nonlinearity_coefficients())
                pixels.set_trigger_mode(0)
            except Exception as error:
                self._drop()
                raise self._error(error, "connecting") from error
            if not (np.all(np.isfinite(self._wavelength_nm)) and np.all(np.diff(self._wavelength_nm) > 0)):
                self._drop()
                raise Garbled(
                    f"spectrometer {self.address}: its wavelength coefficients don't ascend: have its EEPROM restored"
                )

    def identity(self) -> Identity:
        with self._lock:
            return Identity("Ocean Optics", "USB2000+", str(self._connected().serial_number))

    def measure(self) -> RadianceMeasurement:
        """Spectral radiance: scans at an integration time of its own choice, dark pixels subtracted, corrected for
        nonlinearity, divided by the response."""
        with self._lock:
            self._stopped.clear()
            pixels = self._connected().f.spectrometer
            try:
                integration_s = self._choose_time(pixels)
                scans = [self._scan(pixels) for _ in range(self.averages)]
            except usb.core.USBError as error:
                self._drop()
                raise self._error(error, "measuring") from error
            signal = np.mean([self._signal(scan) for scan in scans], axis=0)
            rate = Spectrum.of(self._wavelength_nm, signal / integration_s)
            # The mean over every nanometre, so that the pixels' noise averages and no light is lost between the samples.
            mean_rate = np.asarray(rate.resampled(self._grid_nm).value)
            radiance = Spectrum.of(self._grid_nm, mean_rate / self._response.at(self._grid_nm))
            return RadianceMeasurement(radiance, integration_s, str(self._open.serial_number))

    def stop(self) -> None:
        """End a measurement after the current scan; the instrument emits nothing and moves nothing."""
        self._stopped.set()

    def close(self) -> None:
        with self._lock:
            self._drop()

    # --- inside -----------------------------------------------------------------------------------------------------------

    def _connected(self) -> Any:
        if self._open is None:
            self.connect()
        return self._open

    def _drop(self) -> None:
        opened, self._open = self._open, None
        if opened is not None:
            try:
                opened.close()
            except Exception:  # the library raises what it likes, and the device may be gone
                return

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
        counts = np.asarray(pixels.get_intensities(), float) / self._stretch
        if counts.shape != self._wavelength_nm.shape:
            raise Garbled(
                f"spectrometer {self.address}: sent {counts.size} pixels of {self._wavelength_nm.size}; measure again"
            )
        return counts

    def _choose_time(self, pixels: Any) -> float:
        """Set the integration time (s) at which the brightest pixel is near AIM of full scale."""
        seconds = min(_FIRST_S, self.max_integration_s)
        for _ in range(_TRIES):
            pixels.set_integration_time_micros(round(seconds * 1e6))
            for _ in range(_SETTLING_SCANS):
                self._scan(pixels)
            counts = self._scan(pixels)
            dark = float(np.median(counts[self._dark_pixels]))
            peak = float(np.max(counts)) - dark
            room = self._full_scale - dark
            if np.max(counts) >= SATURATED * self._full_scale:
                if seconds <= _SHORTEST_S:
                    raise InstrumentError(
                        f"spectrometer {self.address}: over-exposed at its shortest time of {_SHORTEST_S} s: dim the light"
                    )
                seconds = max(seconds / 5.0, _SHORTEST_S)
            elif peak >= LEAST * room:
                return seconds
            elif seconds >= self.max_integration_s:
                noise = float(np.std(counts[self._dark_pixels], ddof=1))
                if peak < _LEAST_OVER_NOISE * noise:
                    raise InstrumentError(
                        f"spectrometer {self.address}: under-exposed, {peak:.0f} counts above dark at {seconds:g} s with a noise of "
                        f"{noise:.0f}: give it more light or a longer `max_integration_s`"
                    )
                return seconds
            else:
                grow = AIM * room / max(peak, 1e-3 * room)
                seconds = min(seconds * min(grow, 10.0), self.max_integration_s)
        raise InstrumentError(
            f"spectrometer {self.address}: no integration time fits the light: check that it is steady"
        )

    def _signal(self, counts: FloatArray) -> FloatArray:
        """Counts above the covered pixels' dark, corrected by the maker's nonlinearity polynomial."""
        above = counts - np.median(counts[self._dark_pixels])
        return np.asarray(above / np.polynomial.polynomial.polyval(above, self._bend))


def read_calibration(path: str) -> Spectrum:
    """Counts a second per W sr^-1 m^-2 nm^-1 by wavelength, from the CSV file. Raises `InstrumentError`."""
    file = Path(path)
    try:
        with file.open(newline="", encoding="utf-8") as lines:
            head, *rows = [row for row in csv.reader(lines) if row]
        return _calibration([name.strip() for name in head], rows)
    except (OSError, ValueError) as error:
        raise InstrumentError(f"USB2000+: calibration file {file.name}: {' '.join(str(error).split())}") from error


def _calibration(head: list[str], rows: list[list[str]]) -> Spectrum:
    if head != COLUMNS:
        raise ValueError(f"the columns are {','.join(head)}, and have to be {','.join(COLUMNS)}")
    table = np.array(rows, float)
    if table.ndim != 2 or table.shape[1] != 2:
        raise ValueError(f"every row has {len(COLUMNS)} numbers")
    if not np.all(np.isfinite(table)) or np.any(table[:, 1] <= 0):
        raise ValueError("responses have to be finite and above 0")
    return Spectrum.of(table[:, 0], table[:, 1])
