"""Spectrometers of small laboratories through ArgyllCMS's `spotread`: i1 Pro, ColorMunki, i1 Studio, K-10's kin, JETI,
and whatever else it knows that gives a spectrum.

One `spotread` runs as long as the connection lasts: it connects to the instrument once, and a key takes a reading. With
ARGYLL_NOT_INTERACTIVE it reads keys as lines from a pipe. Sources: ArgyllCMS's pages on spotread and on its
environment variables; what spotread 2.3.1 prints, recorded with a JETI spectraval at the other end. The wording of
calibrations is that of the program's own strings, unverified on an instrument that asks for one.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np

from drivers.errors import Disconnected, Garbled, InstrumentError, InUse, NoAnswer, Refused
from drivers.instrument import Identity, Recorder, Setting
from drivers.program import Program, ProgramEnded
from drivers.spectroradiometer.base import RadianceMeasurement, Spectroradiometer
from drivers.transport import WireInstrument, shown
from sim.spectrum import Spectrum

#: Where it waits for a key; the saved readings of some instruments come before the menu.
PROMPTS = re.compile(
    rb"(?P<ready>any other key to take a reading: ?)"
    rb"|(?P<saved>any other key to use reading: ?)"
    rb"|(?P<retry>Hit (?:Esc or Q to give up, any other key to retry|any key to retry, or Esc or Q to abort): ?)"
    rb"|(?P<calibrate>or hit Esc or Q to abort(?:, or S to skip)?: ?)"
)
MODES = {"emissive": "-e", "telephoto": "-p"}
_FAILED = re.compile(r"Spot read failed (?:due to|because) (.*)")
_SPECTRUM = re.compile(r"Spectrum from (\S+) to (\S+) nm in (\d+) steps\s+([^A-Za-z]*?)\s*(?:\n|$)(?![-\d])")
_LISTED = re.compile(r"^\s+(\d+) = '(.*)'", re.MULTILINE)
_MW_PER_W = 1e3
#: `Refused.code`, as spotread has words and no numbers.
MISREAD, WRONG_POSITION, NEEDS_CALIBRATION, NO_SPECTRUM = 1, 2, 3, 4
_REMEDY = {
    "Overexposure": "dim the light or measure at a greater distance",
    "Saturated": "dim the light or measure at a greater distance",
    "Too much light": "dim the light or measure at a greater distance",
}


class Argyll(WireInstrument, Spectroradiometer):
    """An instrument that `spotread` knows. `address`: its number in the list of `spotread -?`, or a part of its name
    there ("i1 Pro").

    program : `spotread`, its file, or a command that ends in it
    mode : `emissive`, or `telephoto` for instruments that look through a lens
    high_resolution : spectra in finer steps, where the instrument has them (`-H`)
    timeout_s, measure_timeout_s : for connecting and for one reading, dark ones included
    retries : readings that are tried again after a misread
    """

    on_a_port: ClassVar[bool] = False
    _DEVICE: ClassVar[str] = "spotread"

    def __init__(
        self,
        address: str,
        *,
        program: str = "spotread",
        mode: Literal["emissive", "telephoto"] = "emissive",
        high_resolution: bool = False,
        timeout_s: float = 30.0,
        measure_timeout_s: float = 120.0,
        retries: int = 1,
        recorder: Recorder | None = None,
    ) -> None:
        if mode not in MODES:
            raise InstrumentError(f"spotread: mode {mode!r} isn't one of {', '.join(MODES)}: correct the station file")
        self._program, self._mode, self._high_resolution = shlex.split(program), mode, high_resolution
        self._environment = {"ARGYLL_NOT_INTERACTIVE": "1"}
        self._line = Program(
            self._command,
            address,
            self._DEVICE,
            environment=self._environment,
            farewell=b"q\nq\n",
            timeout_s=timeout_s,
            recorder=recorder,
        )
        super().__init__(self._line)
        self.measure_timeout_s, self.retries = measure_timeout_s, retries
        self._identity = Identity("", self._DEVICE)
        self._lacks: tuple[str, ...] = ()

    def identity(self) -> Identity:
        with self._conversation():
            return self._identity

    def settings(self) -> Mapping[str, Setting]:
        return {"mode": self._mode, "high_resolution": self._high_resolution}

    def departures(self) -> tuple[str, ...]:
        return self._lacks

    def measure(self) -> RadianceMeasurement:
        with self._conversation():
            for last in (*(False,) * self.retries, True):
                self._line.write(b" \n")
                said = self._until_ready("a reading", self.measure_timeout_s)
                if (failed := _FAILED.search(said)) is None:
                    break
                if last or "misread" not in failed[1]:
                    raise self._refused(failed[1].strip())
            return RadianceMeasurement(self._spectrum(said), None, self._identity.serial_number)

    # --- the program ------------------------------------------------------------------------------------------------

    def _command(self) -> list[str]:
        options = ["-v", MODES[self._mode], "-s", "-N", *(["-H"] if self._high_resolution else [])]
        return [*self._program, *options, "-c", self._number()]

    def _number(self) -> str:
        """Return the instrument's number in spotread's list. Raises `Disconnected` where the list doesn't have it."""
        wanted = self._line.address
        if wanted.isdecimal():
            return wanted
        try:
            done = subprocess.run(
                [*self._program, "-?"],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                timeout=self._line.timeout_s,
                env=os.environ | self._environment,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise NoAnswer(f"{self._line.name}: no list of instruments within {self._line.timeout_s:g} s") from error
        except OSError as error:
            raise Disconnected(
                f"{self._line.name}: {self._program[0]} can't be started ({error.strerror}); install ArgyllCMS, or "
                "name its file as `program` in the station file"
            ) from error
        listed = _LISTED.findall(done.stdout.decode("latin-1"))
        fitting = [number for number, name in listed if wanted.lower() in name.lower()]
        if len(fitting) != 1:
            there = ", ".join(f"{number} = {name}" for number, name in listed) or "nothing"
            raise Disconnected(
                f"{self._line.name}: {len(fitting)} of the instruments that it lists have that name ({there}); plug it "
                "in, or give its number as the address in the station file"
            )
        return str(fitting[0])

    def _establish(self) -> None:
        try:
            said = self._until_ready("its start", self._line.timeout_s)
        except ProgramEnded as error:
            raise self._not_started(error) from error
        model = _find(r"(?:Instrument Type|Identificat\w*):\s*(.+)", said)
        self._identity = Identity(
            "",
            model or self._DEVICE,
            _find(r"(?i)serial number:\s*(\S+)", said),
            _find(r"(?i)firmware(?: version)?:\s*(\S+)", said),
        )
        ignored = "high resolution ignored" in said
        self._lacks = ("it has no spectra in finer steps: high_resolution is ignored",) if ignored else ()

    def _not_started(self, error: ProgramEnded) -> Disconnected:
        who, said = self._line.name, " ".join(error.lines)
        if "No instrument at port" in said or "no instrument detected" in said or "paths failed" in said:
            return Disconnected(
                f"{who}: no instrument there; plug it in, and compare the address in the station file with the list of "
                "`spotread -?`"
            )
        if re.search(r"(?i)busy|in use|permission|access", said):
            return InUse(
                f"{who}: the instrument is in use or not permitted ({error.lines[-1]}); close the other program, or "
                "install Argyll's udev rules"
            )
        return error

    def _until_ready(self, asked: str, timeout_s: float) -> str:
        """Read until it waits for a key that takes a reading. Returns what it said.

        A calibration needs hands: the program is ended, so that the port is free for who calibrates. Raises `Refused`.
        """
        said = ""
        while True:
            data, prompt = self._line.read_until_prompt(PROMPTS, timeout_s, asked)
            said += data.decode("latin-1")
            if prompt == "ready":
                return said
            if prompt == "calibrate":
                wanted = re.findall(r"(?m)^(?:Do a|Place|Click|Set|Change|Use) .*", said) or ["of its own"]
                self._live = False
                self._line.close()
                raise Refused(
                    f"{self._line.name}: it needs a calibration ({wanted[-1].strip(' ,.')}); "
                    f"run `spotread {MODES[self._mode]}`, calibrate and end it, then resume",
                    NEEDS_CALIBRATION,
                )
            if "communication problem" in said:
                raise Disconnected(
                    f"{self._line.name}: the instrument doesn't answer its program; plug it in again, the next call "
                    "reconnects"
                )
            # whatever failed is read from what was said; a saved reading isn't wanted
            self._line.write(b"N\n" if prompt == "saved" else b" \n")

    def _refused(self, why: str) -> Refused:
        if "wrong position" in why:
            return Refused(
                f"{self._line.name}: its sensor is in the wrong position; turn it to where it measures", WRONG_POSITION
            )
        detail = (re.findall(r"\((.*)\)", why) or [why])[-1]
        remedy = _REMEDY.get(detail, "check that the light is steady and bright enough")
        return Refused(f"{self._line.name}: the reading failed: {why}; {remedy}", MISREAD)

    def _spectrum(self, said: str) -> Spectrum:
        """Return the spectrum that it printed, in mW sr^-1 m^-2 nm^-1 there."""
        match = _SPECTRUM.search(said)
        if match is None:
            if "Result is XYZ" in said or "didn't return spectral" in said:
                raise Refused(
                    f"{self._line.name}: it gives colours and no spectrum; a spectrometer is needed", NO_SPECTRUM
                )
            raise self._strange(said)
        try:
            first_nm, last_nm, steps = float(match[1]), float(match[2]), int(match[3])
            value = np.array([float(word) for word in match[4].replace(",", " ").split()])
        except ValueError:
            raise self._strange(match[0]) from None
        if value.size != steps or steps < 2 or not last_nm > first_nm or not np.all(np.isfinite(value)):
            raise self._strange(match[0])
        return Spectrum.of(np.linspace(first_nm, last_nm, steps), value / _MW_PER_W)

    def _make_safe(self) -> None:
        """It lights nothing in these modes and moves nothing."""

    def stop(self) -> None:
        """End a reading that another thread waits for."""
        self._line.interrupt()
        with self._lock:
            self._line.resume()

    def _strange(self, said: str) -> Garbled:
        return Garbled(
            f"{self._line.name}: printed {shown(said.strip().encode('latin-1'))} for a spectrum; check that `program` "
            "is ArgyllCMS's spotread"
        )


def _find(pattern: str, text: str) -> str:
    """Return the first group of the first place that fits, or nothing."""
    match = re.search(pattern, text)
    return match[1].strip() if match else ""
