"""Settings of every GenICam camera before it may measure: nothing automatic, nothing that changes its codes, and which
lines trigger.

The names are those of EMVA's Standard Features Naming Convention (SFNC 2.7), and makers' own where they differ. The
same settings serve every library that reaches such cameras: `drivers.camera.genapi`, pypylon, Aravis.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from drivers.errors import Disconnected, InstrumentError, NoAnswer
from drivers.instrument import Setting


class Features(Protocol):
    """A camera's features by name."""

    def has(self, name: str) -> bool:
        """Return whether the camera has it, and it is available now."""

    def get(self, name: str) -> Setting:
        """Return its value; an enumeration's as the entry's name."""

    def set(self, name: str, value: Setting) -> None:
        """Write it. Raises `InstrumentError`."""

    def entries(self, name: str) -> Collection[str]:
        """Return the names of an enumeration's entries."""


class CameraFeatures(Features, Protocol):
    """A camera's features, with limits and commands."""

    def limits(self, name: str) -> tuple[float, float]:
        """Return least and greatest value of a number."""

    def execute(self, name: str) -> None:
        """Run a command."""


class AskedFeatures:
    """A camera's features in another process: `ask(method, *arguments)` answers for each method."""

    def __init__(self, ask: Callable[..., Any]) -> None:
        self._ask = ask

    def has(self, name: str) -> bool:
        return bool(self._ask("has", name))

    def get(self, name: str) -> Setting:
        setting: Setting = self._ask("get", name)
        return setting

    def set(self, name: str, value: Setting) -> None:
        self._ask("set", name, value)

    def entries(self, name: str) -> Collection[str]:
        entries: Collection[str] = self._ask("entries", name)
        return entries

    def limits(self, name: str) -> tuple[float, float]:
        limits: tuple[float, float] = self._ask("limits", name)
        return limits

    def execute(self, name: str) -> None:
        self._ask("execute", name)


@dataclass(frozen=True)
class Neutral:
    """A feature that changes exposure, gain or codes, and the value at which it leaves the converter's codes alone.

    `selector`: the feature that chooses which of several is meant; all of its entries are set, or those that begin as
    one of `entries`. `switch`: features that switch it off: where the camera has one, its own value doesn't matter.
    `must`: a camera on which it stays on is refused, as its frames can't be compared, or aren't proportional to light;
    otherwise that is reported, and stored with its frames."""

    name: str
    value: Setting
    must: bool = False
    selector: str = ""
    entries: tuple[str, ...] = ("",)
    switch: tuple[str, ...] = ()


#: Entries of `GainSelector` that multiply codes after the converter, or channel by channel.
_NOT_THE_GAIN = ("Digital", "Red", "Green", "Blue")

#: In the order in which they are set: what is automatic first, for it locks the others.
NEUTRAL: tuple[Neutral, ...] = (
    Neutral("ExposureAuto", "Off", must=True),
    Neutral("GainAuto", "Off", must=True),
    Neutral("GainAutoBalance", "Off", must=True),
    Neutral("BalanceWhiteAuto", "Off", must=True),
    Neutral("BlackLevelAuto", "Off", must=True),
    Neutral("BlackLevelAutoBalance", "Off", must=True),
    Neutral("BlackLevelClampingEnable", False),
    Neutral("GammaEnable", False, must=True),
    Neutral("GammaEnabled", False, must=True),
    Neutral("Gamma", 1.0, must=True, switch=("GammaEnable", "GammaEnabled")),
    Neutral("LUTEnable", False, must=True, selector="LUTSelector"),
    Neutral("BslContrastMode", "Linear", must=True),
    Neutral("BslContrast", 0.0, must=True),
    Neutral("BslBrightness", 0.0, must=True),
    Neutral("TestPattern", "Off", must=True, selector="TestPatternGeneratorSelector"),
    Neutral("TestImageSelector", "Off", must=True),
    Neutral("IspEnable", False),
    Neutral("ProcessedRawEnable", False),
    Neutral("LightSourcePreset", "Off"),
    Neutral("BslLightSourcePreset", "Off"),
    Neutral("LightSourceSelector", "Off"),
    Neutral("BalanceRatio", 1.0, selector="BalanceRatioSelector"),
    Neutral("BalanceRatioAbs", 1.0, selector="BalanceRatioSelector"),
    Neutral("BalanceWhiteEnable", False),
    Neutral("Gain", 0.0, selector="GainSelector", entries=_NOT_THE_GAIN),
    Neutral("DigitalShift", 0),
    Neutral("BslColorSpace", "Off"),
    Neutral("BslColorSpaceMode", "RGB"),
    Neutral("ColorTransformationEnable", False, selector="ColorTransformationSelector"),
    Neutral("ColorCorrectionMatrixEnable", False),
    Neutral("CCMEnable", False),
    Neutral("ColorAdjustmentEnable", False),
    Neutral("RgbTransformLightSource", "General"),
    Neutral("HueEnable", False),
    Neutral("SaturationEnable", False),
    Neutral("BslHue", 0.0),
    Neutral("BslSaturation", 1.0),
    Neutral("SharpnessEnable", False),
    Neutral("SharpeningEnable", False),
    Neutral("SharpnessAuto", "Off", must=True),
    Neutral("SharpnessEnhancement", 0.0),
    Neutral("BslSharpnessEnhancement", 0.0),
    Neutral("NoiseReduction", 0.0),
    Neutral("NoiseReductionEnable", False),
    Neutral("BslNoiseReduction", 0.0),
    Neutral("DenoiseEnable", False),
    Neutral("PgiMode", "Off"),
    Neutral("DefectCorrectStaticEnable", False),
    Neutral("DefectCorrectDynamicEnable", False),
    Neutral("DefectPixelCorrectionEnable", False),
    Neutral("BslDefectPixelCorrectionMode", "Off"),
    Neutral("DefectCorrectionMode", "Off"),
    Neutral("ShadingEnable", False),
    Neutral("ShadingCorrectionMode", "Off"),
    Neutral("LensShadingCorrectionEnable", False),
    Neutral("BslVignettingCorrectionMode", "Off"),
    Neutral("FlatFieldCorrectionEnable", False),
    Neutral("FlatFieldCorrection", "Off"),
    Neutral("ImageCompressionMode", "Off"),
    Neutral("BinningHorizontal", 1),
    Neutral("BinningVertical", 1),
    Neutral("DecimationHorizontal", 1),
    Neutral("DecimationVertical", 1),
)

#: Features whose value depends on a selector's.
SELECTORS = {neutral.name: neutral.selector for neutral in NEUTRAL if neutral.selector} | {
    "BlackLevel": "BlackLevelSelector",
    "TriggerMode": "TriggerSelector",
    "TriggerSource": "TriggerSelector",
    "LineMode": "LineSelector",
    "LineSource": "LineSelector",
}

#: What else belongs to a frame: identity, sensor, region, exposure, trigger. `snapshot` reads these and all of
#: `NEUTRAL`.
RECORDED = (
    "DeviceVendorName",
    "DeviceModelName",
    "DeviceSerialNumber",
    "DeviceID",
    "DeviceVersion",
    "DeviceFirmwareVersion",
    "DeviceUserID",
    "DeviceTemperature",
    "SensorWidth",
    "SensorHeight",
    "SensorPixelWidth",
    "SensorShutterMode",
    "SensorReadoutMode",
    "Width",
    "Height",
    "OffsetX",
    "OffsetY",
    "ReverseX",
    "ReverseY",
    "PixelFormat",
    "PixelSize",
    "AcquisitionMode",
    "AcquisitionFrameRateEnable",
    "AcquisitionFrameRate",
    "ExposureMode",
    "ExposureTime",
    "ExposureTimeAbs",
    "GainRaw",
    "BlackLevel",
    "BlackLevelRaw",
    "ConversionGainMode",
    "TriggerSelector",
    "TriggerMode",
    "TriggerSource",
    "TriggerActivation",
    "TriggerDelay",
    "DeviceLinkThroughputLimit",
)


def set_if_there(features: Features, name: str, value: Setting) -> None:
    """Set a feature that the camera has, an enumeration's entry that it offers; some can't be written, and have the
    value already.

    features : of the camera
    name, value : of the feature
    """
    if not features.has(name) or (isinstance(value, str) and value not in features.entries(name)):
        return
    try:
        features.set(name, value)
    except (NoAnswer, Disconnected):
        raise
    except InstrumentError:
        if features.get(name) != value:
            raise


def make_neutral(features: Features, who: str) -> tuple[str, ...]:
    """Switch off all that changes the converter's codes, and read it back. Returns what stays on, `Feature = value`
    each.

    Raises `InstrumentError` that names what stays on and must not: codes of such a camera aren't proportional to light.
    """
    stays: list[str] = []
    for neutral in NEUTRAL:
        if not _is_offered(features, neutral) or any(features.has(switch) for switch in neutral.switch):
            continue
        for where in _places(features, neutral):
            refused = _neutralise(features, neutral)
            setting = features.get(neutral.name)
            if _is_neutral(setting, neutral.value):
                continue
            if neutral.must:
                raise InstrumentError(
                    f"{who}: {neutral.name} is {setting} and can't be set to {neutral.value}: its codes aren't the "
                    "converter's; switch it off with the maker's program and save that as the camera's default"
                ) from refused
            stays.append(f"{neutral.name}{where} = {setting}")
    return tuple(stays)


def _is_offered(features: Features, neutral: Neutral) -> bool:
    return features.has(neutral.name) and not (
        isinstance(neutral.value, str) and neutral.value not in features.entries(neutral.name)
    )


def _places(features: Features, neutral: Neutral) -> Iterator[str]:
    """Each entry of the selector in turn, selected, as `[Entry]`; nothing where there is no selector. The one that was
    selected is so again."""
    if not neutral.selector or not features.has(neutral.selector):
        if neutral.entries == ("",):
            yield ""
        return
    selected = features.get(neutral.selector)
    try:
        for entry in features.entries(neutral.selector):
            if (
                entry.startswith(neutral.entries)
                and _selects(features, neutral.selector, entry)
                and features.has(neutral.name)
            ):
                yield f"[{entry}]"
    finally:
        _selects(features, neutral.selector, str(selected))


def _selects(features: Features, selector: str, entry: str) -> bool:
    """Return whether the entry could be selected: a camera may list some that it doesn't have now."""
    if features.get(selector) == entry:
        return True
    try:
        features.set(selector, entry)
    except (NoAnswer, Disconnected):
        raise
    except InstrumentError:
        return False
    return True


def _neutralise(features: Features, neutral: Neutral) -> InstrumentError | None:
    """Set the feature unless it is neutral; why that failed."""
    if _is_neutral(features.get(neutral.name), neutral.value):
        return None
    try:
        features.set(neutral.name, neutral.value)
    except (NoAnswer, Disconnected):
        raise
    except InstrumentError as error:
        return error
    return None


def _is_neutral(setting: Setting, neutral: Setting) -> bool:
    """Return whether a value is the neutral one, but for a register's rounding: a thousandth."""
    if isinstance(neutral, float) and isinstance(setting, int | float):
        return abs(setting - neutral) <= 1e-3
    return setting == neutral


def snapshot(features: Features) -> dict[str, Setting]:
    """Return all settings that bear on a frame, as the camera reports them, without those that it can't tell now."""
    settings: dict[str, Setting] = {}
    for name in (*RECORDED, "Gain"):
        _note(features, name, name, settings)
    for neutral in NEUTRAL:
        if features.has(neutral.name):
            for where in _places(features, neutral):
                _note(features, neutral.name, f"{neutral.name}{where}", settings)
    return settings


def _note(features: Features, name: str, key: str, settings: dict[str, Setting]) -> None:
    try:
        if features.has(name):
            settings[key] = features.get(name)
    except (NoAnswer, Disconnected):
        raise
    except InstrumentError:
        return  # it has the feature, and doesn't tell its value now


def black_level(features: Features) -> float | None:
    """Return the black level as the camera counts it (its own unit, mostly codes); None where it doesn't tell."""
    with contextlib.suppress(InstrumentError):
        if features.has("BlackLevel"):
            return float(features.get("BlackLevel"))
    return None


def trigger_line(features: Features, who: str, wanted: str | None) -> str:
    """Return the input line that triggers exposures. Nothing is set.

    features : of the camera
    who : beginning of the message
    wanted : name of the line of the station file; by default Line0

    Raises `InstrumentError` that names the lines that the camera has.

    >>> class Camera:
    ...     def entries(self, name):
    ...         return ["Software", "Line0", "Line2"]
    >>> trigger_line(Camera(), "camera", None), trigger_line(Camera(), "camera", "Line2")
    ('Line0', 'Line2')
    """
    lines = [name for name in features.entries("TriggerSource") if name.startswith("Line")]
    name = wanted or "Line0"
    if name in lines:
        return name
    raise InstrumentError(
        f"{who}: no trigger line {name}; it has {', '.join(lines) or 'none'}: name the one that is wired as "
        "trigger_line in the station file"
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
            f"{who}: {line} can't follow {source}; it offers {', '.join(offered)}: correct output_source in the "
            "station file"
        )
    features.set("LineSource", source)
