"""Settings of a camera that its frames' headers state: one declared list, and their comparison between frames that are
fitted together.

Frames are fitted together where they are of one side and one `gain_db`. Those that a difference concerns are refused:
`gain_db`, the stated light of the flats, or an import of one group alone (`--only GAIN=100`) separates them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.errors import InputError

#: A setting's value as a header states it.
Value = str | float


class SharedBy(Enum):
    """What a setting changes, and so which frames have to share it."""

    CODES = "codes"  # gain and offset between charge and code: frames whose codes are fitted together, darks included
    CAMERA = "camera"  # which camera it is: all frames of a side
    PIXELS = "pixels"  # which pixels a frame holds: all frames of a side
    LIGHT = "light"  # light on the sensor at one radiance: frames of one kind and one stated light, darks not
    VIEW = "view"  # the image that the lens makes: all frames but darks


@dataclass(frozen=True)
class FrameSetting:
    """A setting of a camera.

    `keywords`: of FITS headers, or names of EXIF tags, that state it. Each is compared with itself alone: programs
    differ in the unit. `factor`: ratio of two numbers, 1 or more, up to which they are one setting, as written."""

    name: str
    changes: SharedBy
    keywords: tuple[str, ...]
    factor: float = 1.001  # headers round measured settings to three digits or more


#: Ratio of ISO speeds up to which they are one marking, half of a third of a stop (1 dB); of f-numbers, its square
#: root; of focal lengths, which EXIF rounds to 1 mm and lenses of 25 mm or more are zoomed by more.
ISO_FACTOR, F_NUMBER_FACTOR, FOCAL_LENGTH_FACTOR = 2.0 ** (1.0 / 6.0), 2.0 ** (1.0 / 12.0), 1.02

#: All settings that are compared. The keywords are those of Andor Solis, ASCOM and MaxIm DL, INDI and KStars, N.I.N.A.,
#: SharpCap, ZWO, observatories (NOAO's CCDSUM), and of EXIF.
SETTINGS = (
    FrameSetting("gain", SharedBy.CODES, ("GAIN", "CAMGAIN", "EGAIN", "PREAMP", "EMGAIN", "EMREALGN", "GAMMA")),
    FrameSetting("ISO speed", SharedBy.CODES, ("ISO", "ISOSPEED"), ISO_FACTOR),
    FrameSetting("offset", SharedBy.CODES, ("OFFSET", "BLKLEVEL", "BLACKLVL", "CAMOFFS", "PEDESTAL")),
    FrameSetting(
        "read-out mode",
        SharedBy.CODES,
        ("READOUTM", "READMODE", "READOUT", "OUTPTAMP", "READTIME", "VSHIFT", "CONVGAIN", "BITPIX"),
    ),
    FrameSetting("camera", SharedBy.CAMERA, ("INSTRUME", "SERNO", "Model", "BodySerialNumber")),
    FrameSetting(
        "binning",
        SharedBy.PIXELS,
        (
            *("XBINNING", "YBINNING", "BINNING", "CCDSUM", "CCDBINX", "CCDBINY", "CCDXBIN", "CCDYBIN"),
            *("BINX", "BINY", "HBIN", "VBIN"),
        ),
    ),
    FrameSetting("window", SharedBy.PIXELS, ("XORGSUBF", "YORGSUBF", "IMGRECT", "SUBRECT")),
    FrameSetting("orientation", SharedBy.PIXELS, ("ROWORDER", "FLIPX", "FLIPY", "FLIPSTAT")),
    FrameSetting("mosaic", SharedBy.PIXELS, ("BAYERPAT", "XBAYROFF", "YBAYROFF")),
    FrameSetting("filter", SharedBy.LIGHT, ("FILTER", "FILTER1", "FILTER2", "INSFLNAM")),
    FrameSetting("f-number", SharedBy.LIGHT, ("FNumber",), F_NUMBER_FACTOR),
    FrameSetting("focal length", SharedBy.VIEW, ("FocalLength", "FOCALLEN"), FOCAL_LENGTH_FACTOR),
)
KEYWORDS = {keyword: setting for setting in SETTINGS for keyword in setting.keywords}
#: Parts of the names of other keywords, which tell that they may be settings too, and what these would change.
PARTS = {"GAIN": SharedBy.CODES, "SPEED": SharedBy.CODES, "FILT": SharedBy.LIGHT}
#: Parts of the names of keywords that are no settings of a camera: speed of the wind, of the telescope's motors.
OTHER_PARTS = ("WIND", "GUIDE", "MOTOR", "SLEW")


def setting_of(keyword: str) -> FrameSetting | None:
    """Return the setting that a header's keyword states, by the list or by a part of its name; None where it states
    none.

    >>> setting_of("GAIN").keywords[0], setting_of("OBSERVER")
    ('GAIN', None)
    """
    if keyword in KEYWORDS:
        return KEYWORDS[keyword]
    name = keyword.upper()
    if any(part in name for part in OTHER_PARTS):
        return None
    return next((FrameSetting("", changes, (keyword,)) for part, changes in PARTS.items() if part in name), None)


def text_of(value: Value) -> str:
    """Return a setting's value as it is written; whole numbers without a decimal point.

    >>> text_of(100.0), text_of("HIGH")
    ('100', 'HIGH')
    """
    return value if isinstance(value, str) else f"{value:.6g}"


def is_same(keyword: str, first: Value, second: Value) -> bool:
    """Return whether two values of a keyword are one setting: equal, of texts but for case, or within the setting's
    factor.

    keyword : of the header
    first, second : numbers or texts

    >>> is_same("READMODE", "Low noise", "LOW NOISE"), is_same("GAIN", 100.0, 200.0)
    (True, False)
    """
    if isinstance(first, str) or isinstance(second, str):
        return text_of(first).casefold() == text_of(second).casefold()
    low, high = sorted((first, second))
    setting = setting_of(keyword)
    return low == high or (setting is not None and low > 0 and high <= low * setting.factor)


@dataclass(frozen=True)
class StatedFrame:
    """A capture with its file and the settings that its header states, by keyword."""

    capture: Capture
    file: Path
    settings: Mapping[str, Value]


def compare_settings(frames: Sequence[StatedFrame], where: str) -> tuple[list[str], list[str]]:
    """Return (problems, warnings), a line each: settings that differ between frames that are fitted together, and
    settings that some of these frames don't state.

    Of captures whose codes aren't fitted with others' (boards, edges), another gain is a warning."""
    problems: list[str] = []
    warnings: list[str] = []
    for side in dict.fromkeys(frame.capture.side for frame in frames):
        frames_of_side = [frame for frame in frames if frame.capture.side == side]
        for setting in SETTINGS:
            line, is_problem = _first_difference(setting, frames_of_side, where)
            if line:
                (problems if is_problem else warnings).append(line)
        warnings += [*_unstated(frames_of_side, where), *_unlisted(frames_of_side, where)]
    return problems, warnings


def _first_difference(setting: FrameSetting, frames_of_side: Sequence[StatedFrame], where: str) -> tuple[str, bool]:
    """Return the line for the first keyword of a setting that differs within a group of frames, and whether it is a
    problem; an empty line where none does."""
    for keyword in setting.keywords:
        for group in _groups(setting, frames_of_side):
            fitted = [frame for frame in group if _is_bound(setting, frame)]
            for frames in (fitted, group):
                values = _values(keyword, frames)
                if len(values) > 1:
                    return _difference(setting, keyword, values, where, frames is fitted), frames is fitted
    return "", False


def _unlisted(frames_of_side: Sequence[StatedFrame], where: str) -> Iterator[str]:
    """Yield a line for each keyword that isn't listed, seems to be a setting by its name, and differs within a group of
    frames. Where each frame has a value of its own, it is a measurement."""
    for keyword in dict.fromkeys(key for frame in frames_of_side for key in frame.settings if key not in KEYWORDS):
        setting = setting_of(keyword)
        for group in _groups(setting, frames_of_side) if setting is not None else ():
            values = _values(keyword, group)
            if 1 < len(values) < sum(map(len, values.values())):
                yield (
                    f"{where}: {keyword} differs between frames that are fitted together: {_format_values(values)}; "
                    f"where it is a setting of the camera, import one group, "
                    f"--only {keyword}={text_of(next(iter(values)))}"
                )
                break


def _is_bound(setting: FrameSetting, frame: StatedFrame) -> bool:
    """Return whether a difference of the setting makes the frame's fit wrong."""
    return setting.changes not in (SharedBy.CODES, SharedBy.LIGHT) or frame.capture.codes_are_fitted


def _groups(setting: FrameSetting, frames_of_side: Sequence[StatedFrame]) -> list[list[StatedFrame]]:
    """Return the frames of one side that have to share a setting, in groups."""
    keys: dict[SharedBy, Callable[[Capture], object]] = {
        SharedBy.CODES: lambda capture: round(capture.gain_db or 0.0, 6),
        SharedBy.LIGHT: _light,
    }
    groups: dict[object, list[StatedFrame]] = {}
    for frame in frames_of_side:
        is_dark = isinstance(frame.capture, DarkCapture)
        if is_dark and setting.changes in (SharedBy.LIGHT, SharedBy.VIEW):
            continue
        key = keys.get(setting.changes)
        groups.setdefault(key(frame.capture) if key is not None else None, []).append(frame)
    return list(groups.values())


def _light(capture: Capture) -> object:
    """Return what captures share whose light is compared by their exposures alone. Photons of one wavelength at the
    sensor are known whatever is before it: each such capture is alone."""
    radiance, wavelength_nm = (getattr(capture, key, None) for key in ("radiance", "wavelength_nm"))
    if wavelength_nm is not None and getattr(capture, "photons_per_pixel", None) is not None:
        return capture.id
    return capture.kind, radiance, wavelength_nm


def _values(keyword: str, frames: Sequence[StatedFrame]) -> dict[Value, list[StatedFrame]]:
    """Return the frames by the value that they state, that of most frames first."""
    frames_of_value: dict[Value, list[StatedFrame]] = {}
    for frame in frames:
        value = frame.settings.get(keyword)
        if value is not None:
            first = next((known for known in frames_of_value if is_same(keyword, known, value)), value)
            frames_of_value.setdefault(first, []).append(frame)
    return dict(sorted(frames_of_value.items(), key=lambda item: -len(item[1])))


def _difference(
    setting: FrameSetting, keyword: str, values: Mapping[Value, Sequence[StatedFrame]], where: str, is_problem: bool
) -> str:
    listed = _format_values(values)
    if not is_problem:
        return (
            f"{where}: {keyword} ({setting.name}) differs between frames: {listed}; each is fitted by itself, and all "
            f"are compared as of one setting: import one group, --only {keyword}={text_of(next(iter(values)))}"
        )
    apart = {
        SharedBy.CODES: ", or give each group its own gain_db (dB) in index.csv",
        SharedBy.CAMERA: ", or give each camera its own side in index.csv",
        SharedBy.LIGHT: ", or state the light of each frame (photons_per_pixel and wavelength_nm) in index.csv",
    }.get(setting.changes, "")
    return (
        f"{where}: {keyword} ({setting.name}) differs between frames that are fitted together: {listed}; import one "
        f"group, --only {keyword}={text_of(next(iter(values)))}{apart}; where the header is wrong, --ignore {keyword}"
    )


def _format_values(values: Mapping[Value, Sequence[StatedFrame]]) -> str:
    return ", ".join(f"{text_of(value)} in {_name_frames(frames)}" for value, frames in values.items())


def _name_frames(frames: Sequence[StatedFrame]) -> str:
    names = [frame.file.name for frame in frames]
    listed = ", ".join(names[:2]) + (f" .. {names[-1]}" if len(names) > 2 else "")
    return f"{len(names)} frame{'s' if len(names) > 1 else ''} ({listed})"


def _unstated(frames_of_side: Sequence[StatedFrame], where: str) -> Iterator[str]:
    """Yield a line for settings that some of the frames that are fitted together state and others don't."""
    missing: dict[tuple[str, ...], list[str]] = {}
    for setting in SETTINGS:
        for group in _groups(setting, frames_of_side):
            bound = [frame for frame in group if _is_bound(setting, frame)]
            for keyword in setting.keywords:
                without = tuple(frame.file.name for frame in bound if keyword not in frame.settings)
                if 0 < len(without) < len(bound):
                    missing.setdefault(without, []).append(keyword)
    for names, keywords in missing.items():
        some = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
        yield f"{where}: {some}: no {', '.join(keywords)} in the header, unlike the others': taken as theirs"


@dataclass(frozen=True)
class HeaderChoice:
    """What an import uses of headers: frames of these settings `only` (keyword, value), and `ignored` keywords."""

    only: tuple[tuple[str, str], ...] = ()
    ignored: tuple[str, ...] = ()


#: An import of all frames, with all that headers state.
ALL_FRAMES = HeaderChoice()


def parse_choice(only: str, ignored: str) -> HeaderChoice:
    """Return which frames to import by their headers, and which keywords to ignore.

    only : `KEY=VALUE,...` of `--only`
    ignored : `KEY,...` of `--ignore`

    Raises InputError, which names the option.

    >>> parse_choice("GAIN=100", "OFFSET").only
    (('GAIN', '100'),)
    """
    pairs = []
    for part in filter(None, (text.strip() for text in only.split(","))):
        keyword, equals, value = (text.strip() for text in part.partition("="))
        if not (keyword and equals and value):
            raise InputError(f"--only {part}: give KEY=VALUE, as in GAIN=100")
        if setting_of(keyword) is None:
            raise InputError(f"--only {part}: {keyword} isn't compared; give one of {', '.join(KEYWORDS)}")
        pairs.append((keyword, value))
    return HeaderChoice(tuple(pairs), tuple(filter(None, (text.strip() for text in ignored.split(",")))))


def is_chosen(choice: HeaderChoice, kind: str, settings: Mapping[str, Value]) -> bool:
    """Return whether a frame of a kind is one of those that `only` asks for. A dark needs no setting of the light."""
    for keyword, wanted in choice.only:
        setting = setting_of(keyword)
        if kind == "dark" and setting is not None and setting.changes in (SharedBy.LIGHT, SharedBy.VIEW):
            continue
        if not states(settings, keyword, wanted):
            return False
    return True


def states(settings: Mapping[str, Value], keyword: str, wanted: str) -> bool:
    """Return whether settings hold a value that is written as `wanted`.

    >>> states({"GAIN": 100.0}, "GAIN", "100")
    True
    """
    try:
        value: Value = float(wanted)
    except ValueError:
        value = wanted
    return keyword in settings and is_same(keyword, settings[keyword], value)
