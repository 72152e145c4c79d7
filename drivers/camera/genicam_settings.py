"""What every GenICam camera is told before it may measure: nothing automatic, nothing that bends its codes, and which lines trigger.

The names are those of EMVA's Standard Features Naming Convention (SFNC 2.7), and makers' own where they differ. The same settings
serve every library that reaches such cameras: `drivers.camera.genapi`, pypylon, Aravis.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection
from typing import Protocol

from drivers.errors import Disconnected, InstrumentError, NoAnswer

Setting = str | bool | int | float


class Features(Protocol):
    """A camera's features by name."""

    def has(self, name: str) -> bool:
        """Whether the camera has it, and it is available now."""

    def get(self, name: str) -> Setting:
        """Its value; an enumeration's as the entry's name."""

    def set(self, name: str, value: Setting) -> None:
        """Write it. Raises `InstrumentError`."""

    def entries(self, name: str) -> Collection[str]:
        """Names of an enumeration's entries."""


#: Features that change exposure or gain between frames, or codes after the converter, with the value that switches each off.
PROCESSING: tuple[tuple[str, Setting], ...] = (
    ("ExposureAuto", "Off"),
    ("GainAuto", "Off"),
    ("BalanceWhiteAuto", "Off"),
    ("BlackLevelAuto", "Off"),
    ("GammaEnable", False),
    ("GammaEnabled", False),
    ("Gamma", 1.0),
    ("BslBrightness", 0.0),
    ("BslContrast", 0.0),
    ("DigitalShift", 0),
    ("LUTEnable", False),
    ("SharpeningEnable", False),
    ("DefectCorrectStaticEnable", False),
    ("DefectCorrectDynamicEnable", False),
    ("BslDefectPixelCorrectionMode", "Off"),
)

#: Features that do nothing while a switch of theirs, one of `PROCESSING`, is off: those switches' names.
SWITCHES = {"Gamma": ("GammaEnable", "GammaEnabled")}


def set_if_there(features: Features, name: str, value: Setting) -> None:
    """Set a feature that the camera has, an enumeration's entry that it offers; some can't be written, and have the value already."""
    if not features.has(name) or (isinstance(value, str) and value not in features.entries(name)):
        return
    try:
        features.set(name, value)
    except (NoAnswer, Disconnected):
        raise
    except InstrumentError:
        if features.get(name) != value:
            raise


def switch_processing_off(features: Features, who: str) -> None:
    """Switch off everything automatic, gamma, look-up table, sharpening and defect correction.

    Raises `InstrumentError` that names what stays on: codes of such a camera aren't proportional to light.
    """
    for name, off in PROCESSING:
        if not features.has(name) or (isinstance(off, str) and off not in features.entries(name)):
            continue
        if features.get(name) == off or any(features.has(switch) for switch in SWITCHES.get(name, ())):
            continue
        refused: InstrumentError | None = None
        try:
            features.set(name, off)
        except (NoAnswer, Disconnected):
            raise
        except InstrumentError as error:
            refused = error
        if refused is not None or features.get(name) != off:
            raise InstrumentError(
                f"{who}: {name} is {features.get(name)} and can't be set to {off}: its codes aren't the converter's; "
                "switch it off with the maker's program and save that as the camera's default"
            ) from refused


def black_level(features: Features) -> float | None:
    """The black level as the camera counts it (its own unit, mostly codes); None where it doesn't tell."""
    with contextlib.suppress(InstrumentError):
        if features.has("BlackLevel"):
            return float(features.get("BlackLevel"))
    return None


def trigger_line(features: Features, who: str, wanted: str | None) -> str:
    """The line that triggers exposures: `wanted`, else Line0. Raises `InstrumentError` that names those the camera has."""
    lines = [name for name in features.entries("TriggerSource") if name.startswith("Line")]
    name = wanted or "Line0"
    if name in lines:
        return name
    raise InstrumentError(
        f"{who}: no trigger line {name}; it has {', '.join(lines) or 'none'}: name the one that is wired as trigger_line in the station file"
    )


def give_pulses(features: Features, who: str, line: str, source: str) -> None:
    """Let an output line follow the exposure, so that it triggers other cameras. Raises `InstrumentError`."""
    if not features.has("LineSelector"):
        raise InstrumentError(f"{who}: it has no line to give pulses on; trigger the cameras by a generator")
    lines = features.entries("LineSelector")
    if line not in lines:
        raise InstrumentError(
            f"{who}: no line {line}; it has {', '.join(lines)}: correct output_line in the station file"
        )
    features.set("LineSelector", line)
    if features.has("LineMode") and features.get("LineMode") != "Output":
        try:
            features.set("LineMode", "Output")
        except (NoAnswer, Disconnected):
            raise
        except InstrumentError as error:
            raise InstrumentError(
                f"{who}: {line} can't be an output; it has {', '.join(lines)}: correct output_line in the station file"
            ) from error
    offered = features.entries("LineSource")
    if source not in offered:
        raise InstrumentError(
            f"{who}: {line} can't follow {source}; it offers {', '.join(offered)}: correct output_source in the station file"
        )
    features.set("LineSource", source)
