"""Argyll's `spotread` with an i1 Pro: a line of options, then a key a line, and the words of spotread 2.3.1.

`mocks.spotread_program` makes a program of it. The menu, readings, misreads and the list of ports are recorded from
spotread itself; the start with -v and the calibration follow the strings in it.
"""

from __future__ import annotations

import numpy as np

from mocks.lamp import tristimulus
from mocks.spotread_program import END
from mocks.wire import LONGEST_LINE, Grammar, MeasuredLight, Reply

MISREAD, WRONG_POSITION, NEEDS_CALIBRATION, COMMUNICATION = 1, 2, 3, 4
FAILURES = {
    MISREAD: "due to misread (Measurement misread)",
    WRONG_POSITION: "due to the sensor being in the wrong position",
    NEEDS_CALIBRATION: "because instruments needs calibration.",
    COMMUNICATION: "due to communication problem.",
}
OVEREXPOSED = "due to misread (Overexposure)"
MENU = (
    "\nPlace instrument on spot to be measured,\n"
    "and hit [A-Z] to read white and setup FWA compensation (keyed to letter)\n"
    "[a-z] to read and make FWA compensated reading from keyed reference\n"
    "'r' to set reference, 's' to save spectrum,\n"
    "'h' to toggle high res., 'k' to do a calibration\n"
    "Hit ESC or Q to exit, instrument switch or any other key to take a reading: "
)
RETRY = "Hit Esc or Q to give up, any other key to retry:"
LISTING = (
    "Measure spot values, Version 2.3.1\n"
    "Author: Graeme W. Gill, licensed under the GPL Version 2 or later\n"
    "Diagnostic: Usage requested\n"
    "usage: spotread [-options] [logfile]\n"
    " -c listno            Set instrument port from the following list (default 1)\n"
    "    1 = 'usb:/bus1/dev5 (GretagMacbeth i1 Pro)'\n"
    " -t                   Use transmission measurement mode\n"
)
#: First and last wavelength (nm) and number of values of a reading, usual and with -H.
USUAL, HIGH = (380.0, 730.0, 36), (380.0, 730.0, 106)
FLAGS = {"-v", "-e", "-p", "-s", "-N", "-H"}
#: Luminance (cd/m2) above which it is over-exposed, and how long (virtual s) a reading takes.
BRIGHTEST_CD_M2, READING_S = 2e4, 2.0


class MockSpotread(Grammar):
    """The program; it looks at `light` when a reading ends. `calibrated`: whether it asks for its white tile first."""

    line_end = b"\n"
    fault_code = MISREAD

    def __init__(self, light: MeasuredLight, serial_number: str = "310427", calibrated: bool = True) -> None:
        super().__init__(light.clock)
        self._light, self._serial_number, self._calibrated = light, serial_number, calibrated
        self._heard = bytearray()
        self._options: list[str] = []
        self._waits = "nothing"
        self._failing: int | None = None

    def receive(self, data: bytes) -> list[bytes]:
        out: list[bytes] = []
        for value in data:
            if value == 0x0A:
                line = self._heard.decode("latin-1")
                self._heard.clear()
                out += self._obey(line)
            elif len(self._heard) < LONGEST_LINE:
                self._heard.append(value)
        return out

    def _obey(self, line: str) -> list[bytes]:
        if line.startswith("spotread "):
            self._done_at = None
            return [self._start(line.split()[1:])]
        if self._waits == "nothing" or self._done_at is not None:
            return []
        waited, self._waits = self._waits, "menu"
        if line[:1] in ("q", "Q", "\x1b"):
            return [self._leave(waited)]
        if waited == "calibration":
            self._calibrated = True
            return [_said("\nCalibration complete\n" + MENU)]
        if waited == "retry":
            return [_said("\n" + MENU)]
        self._failing = self._failure()
        self._done_at = self.clock.now() + READING_S
        return []

    def _leave(self, waited: str) -> Reply:
        if waited == "menu":
            self._waits = "retry"
            return _said("\n\nSpot read stopped at user request!\n" + RETRY)
        self._waits = "nothing"
        if waited == "calibration":
            return _said("\n\nSpot read got abort or error from calibrate\n", END)
        return _said("\n", END)

    def _start(self, options: list[str]) -> Reply:
        if options[:1] == ["-?"]:
            self._waits = "nothing"
            return _said(LISTING, END)
        port = "1"
        if "-c" in options:
            at = options.index("-c")
            port = (options[at + 1 : at + 2] or [""])[0]
            options = options[:at] + options[at + 2 :]
        for option in options:
            if option not in FLAGS:
                return _said(f"Diagnostic: Flag {option} not recognised\n", END)
        if port != "1":
            return _said(f"spotread: Error - No instrument at port {port}\n", END)
        self._options = options
        self._waits = "menu"
        started = ""
        if "-v" in options:
            started = (
                "Connecting to the instrument ..\n"
                f"Instrument Type:   i1 Pro\nSerial Number:     {self._serial_number}\nFirmware version:  301\n"
                "Init instrument success !\n"
            )
        if self._calibrated:
            return _said(started + MENU)
        return _said(started + self._ask_calibration("Spot read needs a calibration before continuing\n"))

    def _ask_calibration(self, why: str) -> str:
        self._waits = "calibration"
        return (
            f"{why}\nPlace the instrument on its reflective white reference S/N {self._serial_number},\n"
            " and then hit any key to continue,\n or hit Esc or Q to abort: "
        )

    def _end(self) -> list[bytes]:
        radiance = self._light.radiance()
        xyz = tristimulus(radiance)
        failed = None if self._failing is None else FAILURES.get(self._failing, FAILURES[MISREAD])
        if failed is None and xyz[1] > BRIGHTEST_CD_M2:
            failed = OVEREXPOSED
        if self._failing == NEEDS_CALIBRATION:
            self._calibrated = False
            return [_said(self._ask_calibration(f"\nSpot read failed {failed}\n"))]
        if failed is not None:
            self._waits = "retry"
            return [_said(f"\n\n\nSpot read failed {failed}\n{RETRY}")]
        text = ""
        if "-s" in self._options:
            first_nm, last_nm, steps = HIGH if "-H" in self._options else USUAL
            value = 1e3 * radiance.at(np.linspace(first_nm, last_nm, steps))  # mW there
            text = f"\nSpectrum from {first_nm:.3f} to {last_nm:.3f} nm in {steps} steps\n"
            text += ", ".join(f"{sample:.6g}" for sample in value)
            peak = int(np.argmax(value))
            text += f"\nPeak value {value[peak]:f} at (aprox.) {np.linspace(first_nm, last_nm, steps)[peak]:.1f} nm\n"
        result = "\n Result is XYZ: {:f} {:f} {:f}, D50 Lab: {:f} {:f} {:f}\n".format(*xyz, *_lab(xyz))
        return [_said(text + result + MENU)]


def _lab(xyz: tuple[float, float, float]) -> list[float]:
    """Return CIE L*a*b* of a colour in cd/m2, on a white of D50 and 100 cd/m2."""
    ratio = np.asarray(xyz) / (96.42, 100.0, 82.49)
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    return [116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])]


def _said(text: str, end: bytes = b"") -> Reply:
    return Reply(text.encode("ascii") + end)
