"""An Ocean Optics USB2000+ on USB: a fibre spectrometer of 2048 pixels that gives raw counts, by the OOI commands.

What it sees is the bench's radiance through a slit of 1.5 nm and its own response, with dark counts, noise, a full
scale and a bend of the response; EEPROM slots hold what the maker measured of these. The response itself is in no slot:
it is a calibration file's (`calibration_csv`), as it is for the instrument.

Source: Ocean Optics, USB2000+ data sheet (command list, EEPROM slots, status packet, spectrum packet with sync byte
0x69)."""

from __future__ import annotations

import struct
from collections import deque

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from mocks.usb_device import Cancelled, Stalled, UsbDevice, UsbEndpoint, UsbIdentity, UsbInterface
from mocks.wire import MeasuredLight

OUT, SPECTRUM_IN, UNUSED_IN, ANSWER_IN = 0x01, 0x82, 0x86, 0x81
PIXELS = 2048
DARK_PIXELS = slice(6, 21)
SYNC = 0x69
#: Wavelength of pixel i: the sum of these times i^k (EEPROM slots 1..4).
WAVELENGTH_NM = (339.82, 0.37951, -1.5263e-5, -2.2034e-9)
#: Measured over true counts above dark, a polynomial in the measured ones (slots 6..13).
NONLINEARITY = (0.9612, 5.9e-7, 1.1e-11, -1.7e-16)
DARK_COUNTS, NOISE_COUNTS, SATURATION_COUNTS = 1450.0, 22.0, 62000
SLIT_FWHM_NM = 1.5
_FPGA_VERSION = 0x1031  # 1.3.1
_LENGTHS = {0x01: 1, 0x02: 5, 0x03: 3, 0x05: 2, 0x09: 1, 0x0A: 3, 0x6A: 4, 0x6B: 2, 0xFE: 1}


def wavelength_nm() -> NDArray[np.float64]:
    """Return the wavelength of every pixel, (2048,), nm.

    >>> wavelength_nm().shape
    (2048,)
    """
    return np.asarray(np.polynomial.polynomial.polyval(np.arange(PIXELS), WAVELENGTH_NM), float)


def response(wavelength: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the counts a second for a radiance of 1 W sr^-1 m^-2 nm^-1: grating and silicon.

    wavelength : (m,), nm

    >>> bool(response(np.array([540.0]))[0] > response(np.array([900.0]))[0])
    True
    """
    blaze = np.exp(-0.5 * ((wavelength - 540.0) / 170.0) ** 2)
    return 4.0e7 * (blaze + 0.03) * (1.0 + 0.02 * np.sin(wavelength / 23.0))


def calibration_csv(departure_percent: float = 0.0) -> str:
    """Return the calibration that a laboratory would have sent with the instrument, as its driver reads it.

    departure_percent : by how much it is off, smoothly over the spectrum; real ones are good to about 2 % (half of the
        expanded uncertainty that calibration laboratories state for spectral radiance)

    >>> calibration_csv().splitlines()[0]
    'wavelength_nm,counts_per_s_per_w_sr_m2_nm'
    """
    at = np.arange(350.0, 1001.0, 2.0)
    certified = response(at) * (1.0 + departure_percent / 100.0 * np.sin(at / 90.0))
    rows = [f"{w:.1f},{r:.6e}" for w, r in zip(at, certified, strict=True)]
    return "\n".join(["wavelength_nm,counts_per_s_per_w_sr_m2_nm", *rows]) + "\n"


class MockUsb2000Plus(UsbDevice):
    """The instrument; `light` is what it looks at, `seed` that of its noise."""

    def __init__(self, light: MeasuredLight, serial_number: str = "USB2+F00001", seed: int = 2000) -> None:
        endpoints = (UsbEndpoint(OUT), UsbEndpoint(SPECTRUM_IN), UsbEndpoint(UNUSED_IN), UsbEndpoint(ANSWER_IN))
        super().__init__(
            UsbIdentity(0x2457, 0x101E, (0, 0, 0), "Ocean Optics Inc.", "USB2000+", serial_number),
            (UsbInterface(0, (0xFF, 0, 0), endpoints),),
        )
        self._light = light
        self._rng = np.random.default_rng(seed)
        self._queues: dict[int, deque[bytes]] = {ANSWER_IN: deque(), SPECTRUM_IN: deque()}
        self._registers: dict[int, int] = {0x04: _FPGA_VERSION}
        self.on_reset()

    def on_reset(self) -> None:
        with self.changed:
            self.integration_us = 100_000
            self.trigger_mode = 0
            for queue in self._queues.values():
                queue.clear()

    # --- the wire -----------------------------------------------------------------------------------------------------

    def bulk_out(self, endpoint: int, data: bytes, cancelled: Cancelled) -> None:
        if endpoint != OUT:
            super().bulk_out(endpoint, data, cancelled)
        if not data or len(data) != _LENGTHS.get(data[0], -1):
            return  # as the instrument: what it doesn't know it passes over
        code = data[0]
        if code == 0x01:
            self.on_reset()
        elif code == 0x02:
            self.integration_us = min(max(int(struct.unpack_from("<I", data, 1)[0]), 1000), 655_350_000)
        elif code == 0x05:
            self._say(ANSWER_IN, bytes([0x05, data[1]]) + self._slot(data[1]).ljust(15, b"\0"))
        elif code == 0x09:
            self._say(SPECTRUM_IN, self._spectrum())
        elif code == 0x0A:
            self.trigger_mode = int(struct.unpack_from("<H", data, 1)[0])
        elif code == 0x6A:
            if data[1] != 0x04:
                self._registers[data[1]] = int(struct.unpack_from("<H", data, 2)[0])
        elif code == 0x6B:
            self._say(ANSWER_IN, struct.pack("<BH", data[1], self._registers.get(data[1], 0)))
        elif code == 0xFE:
            ready = len(self._queues[SPECTRUM_IN])
            status = struct.pack(
                "<HIBBBBBBBBBB", PIXELS, self.integration_us, 0, self.trigger_mode, int(ready > 0), 8, 0, 8 * ready, 0,
                0, 0x80, 0
            )  # fmt: skip
            self._say(ANSWER_IN, status)

    def bulk_in(self, endpoint: int, length: int, cancelled: Cancelled) -> bytes:
        queue = self._queues.get(endpoint)
        if queue is None:
            return super().bulk_in(endpoint, length, cancelled)
        with self.changed:
            self.wait_for(lambda: bool(queue), cancelled)
            whole = queue.popleft()
            if len(whole) > length:
                queue.appendleft(whole[length:])
            return whole[:length]

    def _say(self, endpoint: int, data: bytes) -> None:
        data = self.broken(data)
        with self.changed:
            if not data:
                return
            self._queues[endpoint].append(data)
            self.changed.notify_all()

    def _slot(self, number: int) -> bytes:
        """Return an EEPROM slot, at most 15 bytes."""
        if number > 30:
            raise Stalled(f"no EEPROM slot {number}")
        if number == 17:  # autonulling: enabled, temperature compensation, dark, saturation
            return struct.pack("<BBHH", 1, 0, int(DARK_COUNTS), SATURATION_COUNTS)
        bend = [*NONLINEARITY, *[0.0] * (8 - len(NONLINEARITY))]
        texts = {0: self.identity.serial_number, 5: "0", 14: str(len(NONLINEARITY) - 1), 15: "2 25 0 0"}
        texts |= {1 + k: f"{value:.7g}" for k, value in enumerate(WAVELENGTH_NM)}
        texts |= {6 + k: f"{value:.7g}" for k, value in enumerate(bend)}
        return texts.get(number, "").encode("ascii")[:15]

    # --- the light ----------------------------------------------------------------------------------------------------

    def _spectrum(self) -> bytes:
        seconds = self.integration_us * 1e-6
        self._light.clock.sleep(seconds)
        at = wavelength_nm()
        radiance = self._light.radiance()
        fine = np.arange(at[0] - 10.0, at[-1] + 10.0, 0.25)
        blurred = gaussian_filter1d(radiance.at(fine), SLIT_FWHM_NM / 2.3548 / 0.25)
        true = np.interp(at, fine, blurred) * response(at) * seconds
        true[: DARK_PIXELS.stop] = 0.0  # covered by metal
        measured = true
        for _ in range(20):  # measured = true x bend(measured) has one solution; each turn brings it ten times as near
            measured = true * np.polynomial.polynomial.polyval(
                np.minimum(measured, 2.0 * SATURATION_COUNTS), NONLINEARITY
            )
        counts = measured + DARK_COUNTS + NOISE_COUNTS * self._rng.standard_normal(PIXELS)
        raw = np.clip(np.round(counts), 0, SATURATION_COUNTS).astype("<u2")
        return bytes(raw.tobytes()) + bytes([SYNC])
