"""Base classes of capture kinds.

The file of a kind declares, where the kind needs its own:

- a `Capture`: the kind's entry in a recording set's manifest;
- a `Target`: the station file's description of the object before the cameras;
- a `Sequence`: the steps in which a station takes such captures.

`register` makes them known. Everything else (formats, store, sessions, service, command line, reports) reads
`CAPTURES`, `TARGETS` and `SEQUENCES` and names no kind, unless an estimator needs that very kind.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from typing import Annotated, Any, ClassVar, Generic, Literal, Protocol, Self, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, model_validator
from pydantic_core import CoreSchema, core_schema

from lab.capture_kinds.lamp import LampLight
from lab.errors import InputError
from sim.camera import Side
from sim.parameters import Frozen, Quantity
from sim.scene.scenes import Scene
from sim.spectrum import Spectrum

# Models of one family that a document's `kind` tells apart, as a type for a field of a pydantic model.


M = TypeVar("M", bound=BaseModel)
#: The registry's database keeps a kind in a column of so many characters.
LONGEST_NAME = 20


class ByKind(Generic[M]):
    """The models of one family, by the value of their field `kind`.

    As an annotation, `Annotated[Base, family]`, it validates a document by the model that its `kind` names. The family
    may grow after the annotated model was built.
    """

    def __init__(self, what: str) -> None:
        self.what = what
        self.models: dict[str, type[M]] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """All kinds, in the order in which they were added."""
        return tuple(self.models)

    def add(self, model: type[M]) -> None:
        """Add a model. Its field `kind` is a `Literal` of one name. Raises ValueError where that name is taken or too
        long."""
        names = get_args(model.model_fields["kind"].annotation)
        if len(names) != 1 or not isinstance(names[0], str) or not 0 < len(names[0]) <= LONGEST_NAME:
            raise ValueError(
                f'{model.__name__}: write kind: Literal["NAME"], a name of {LONGEST_NAME} characters at most'
            )
        if self.models.setdefault(names[0], model) is not model:
            raise ValueError(f"{model.__name__}: the {self.what} kind {names[0]!r} is taken; choose another name")

    def parse(self, document: Mapping[str, Any]) -> M:
        """Return the model of a document. Raises ValueError for an unknown kind and `ValidationError` for wrong
        keys."""
        kind = document.get("kind")
        if kind not in self.models:
            raise ValueError(f"unknown kind {kind!r} of {self.what}; the kinds are {', '.join(self.models)}")
        return self.models[kind].model_validate(document)

    def _validate(self, value: Any) -> BaseModel:
        if isinstance(value, BaseModel):
            if type(value) in self.models.values():
                return value
            raise ValueError(f"{type(value).__name__} is no registered kind of {self.what}; register it")
        if not isinstance(value, Mapping):
            raise ValueError(f"isn't an object; write the {self.what}'s keys")  # noqa: TRY004  (pydantic reports ValueError)
        return self.parse(value)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(
            self._validate, serialization=core_schema.simple_ser_schema("any")
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"oneOf": [handler(model.__pydantic_core_schema__) for model in self.models.values()]}


Cells = NDArray[np.uint8]
#: Longest exposure of a plan, and of a capture that was exposed in seconds.
LONGEST_EXPOSURE_S = 3600.0


class Open(BaseModel):
    """Base of the manifest's objects: immutable. Unknown keys are kept, as the format demands."""

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)

    def unknown_keys(self) -> dict[str, Any]:
        """Return the keys that the format doesn't know, with their values."""
        return dict(self.model_extra or {})


class Names(Enum):
    """What the string under a manifest's key names: a capture, a file, or a pose."""

    CAPTURE = "capture"
    FRAME = "frame"
    SPECTRUM = "spectrum"
    TARGET = "target"
    POSE = "pose"


CaptureId = Annotated[str, Names.CAPTURE]
FramePath = Annotated[str, Names.FRAME]
SpectrumPath = Annotated[str, Names.SPECTRUM]
TargetPath = Annotated[str, Names.TARGET]
PoseName = Annotated[str, Names.POSE]


@dataclass(frozen=True)
class Reading:
    """Marks a capture's key whose value is read from an instrument when the frame is taken; `key`: in
    `Device.readings`."""

    key: str


class Capture(Open):
    """The keys that every capture has. A kind adds its own, and overrides what differs for it."""

    shows: ClassVar[str]  # the scene, in words
    sequence: ClassVar[type[Sequence] | None] = (
        None  # the sequence that takes it on a station; None: it can only be imported
    )
    shares_frame: ClassVar[bool] = False  # several captures may describe one frame
    clipping_matters: ClassVar[bool] = True  # a clipped channel is worth a warning
    codes_are_fitted: ClassVar[bool] = True  # with those of other captures: all have to be of one gain and offset

    id: CaptureId
    kind: str
    side: Side
    frame: FramePath
    exposure_s: float = Field(ge=0)
    gain_db: float | None = None
    temperature_c: float | None = None
    time: datetime | None = None
    dummy_frames: int | None = Field(default=None, ge=0)  # of the same light and exposure, directly before; not kept
    lamp_levels: dict[str, Annotated[float, Field(ge=0, le=1)]] | None = None  # shares by channel of the light source
    colour_temperature_k: float | None = Field(default=None, gt=0)  # of the light source's light, as the lab states it

    def __hash__(self) -> int:
        """Of its id and its frame: equal captures have equal ones, and a capture may hold mappings."""
        return hash((self.id, self.side, self.frame))

    @classmethod
    def unsupported(cls, document: dict[str, Any]) -> str | None:
        """Return why this version skips a capture that the format allows; None if it is supported."""
        return None

    def problems(self, rows: int, cols: int) -> Iterator[str]:
        """Yield the errors in the keys of a capture from a camera of `rows` x `cols` pixels: value, limit, remedy."""
        return iter(())

    def remarks(self) -> Iterator[str]:
        """Yield warnings about the keys, with a remedy. The capture is used nevertheless."""
        if (self.exposure_s or 0.0) > LONGEST_EXPOSURE_S:
            yield (
                f"exposure_s is above {LONGEST_EXPOSURE_S:g} s: state it in seconds, not in milliseconds or "
                "microseconds"
            )

    def scene(self, spectrum: Callable[[str], Spectrum]) -> Scene | None:
        """Return the scene for the forward model; None where the manifest doesn't determine it.

        `spectrum` returns the spectrum at a path of the manifest.
        """
        return None


def _mark(annotation: Any) -> Names | None:
    """Return the `Names` in a field's annotation, at any depth of unions."""
    if isinstance(annotation, Names):
        return annotation
    return next((mark for part in get_args(annotation) if (mark := _mark(part)) is not None), None)


def names_in(item: Open) -> Iterator[tuple[str, Names, str]]:
    """Yield (dotted key, what it names, value) of every key of a manifest's object that names something.

    >>> from lab.capture_kinds.dark import DarkCapture
    >>> dark = DarkCapture(kind="dark", id="dark-1", side="left", frame="frames/dark-1.npy", exposure_s=0.1)
    >>> ("frame", "frames/dark-1.npy") in [(key, value) for key, _, value in names_in(dark)]
    True
    """
    for key, field in type(item).model_fields.items():
        value = getattr(item, key)
        if isinstance(value, Open):
            yield from ((f"{key}.{inner}", mark, name) for inner, mark, name in names_in(value))
        elif isinstance(value, str):
            mark = next(
                (item_of_metadata for item_of_metadata in field.metadata if isinstance(item_of_metadata, Names)), None
            ) or _mark(field.annotation)
            if mark is not None:
                yield key, mark, value


O = TypeVar("O", bound=Open)  # noqa: E741


def in_folder(item: O, folder: str) -> O:
    """Return the same object of a manifest, each name and path in it prefixed by `folder/`.

    >>> from lab.capture_kinds.dark import DarkCapture
    >>> dark = DarkCapture(kind="dark", id="dark-1", side="left", frame="frames/dark-1.npy", exposure_s=0.1)
    >>> in_folder(dark, "later").frame
    'later/frames/dark-1.npy'
    """
    paths = {key: f"{folder}/{name}" for key, _, name in names_in(item) if "." not in key}
    nested = {key: in_folder(value, folder) for key, value in item if isinstance(value, Open)}
    return item.model_copy(update=paths | nested)


CAPTURES: ByKind[Capture] = ByKind("capture")
AnyCapture = Annotated[Capture, CAPTURES]


class Target(Frozen):
    """An object that can be put before the cameras, described by `[targets.NAME]` of the station file."""

    kind: str

    @property
    def instruction(self) -> str:
        """What an operator has to do to put it there."""
        raise NotImplementedError

    @property
    def screen_px(self) -> tuple[int, int] | None:
        """Size (rows, cols) of the screen that the display has to have; None where the target is no screen."""
        return None


class Adjustment(Target):
    """A state of what only an operator's hand changes: the lenses' stop, the knife edge's direction, the sensors'
    temperature. He is asked for it as for a target. Each kind is a thing of its own; one of its states is the usual
    one, in which it stands where no step asks for another."""

    changes: ClassVar[str]  # the thing, in words

    def is_usual(self, station: Equipment) -> bool:
        """Return whether this is the state in which the thing stands between sessions."""
        raise NotImplementedError


TargetT = TypeVar("TargetT", bound=Target)
TARGETS: ByKind[Target] = ByKind("target")
AnyTarget = Annotated[Target, TARGETS]


class CaptureLimits(Frozen):
    """Limits of all sequences: the exposure (s), the gain (dB), the slit width (um) and the light of flats.

    Exposures that a search finds stay within them, and so do those that a sequence has without an operator's values.
    """

    exposure_min_s: float = Field(default=20e-6, gt=0)
    exposure_max_s: float = Field(default=10.0, gt=0)
    gain_db: float = 0.0
    slit_um: float | None = Field(default=None, gt=0)  # None: as the instrument stands
    flat_wavelength_nm: float | None = Field(default=None, gt=0)  # None: white light

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.exposure_min_s > self.exposure_max_s:
            raise ValueError(
                f"exposure_min_s: {self.exposure_min_s:g} s is above exposure_max_s, {self.exposure_max_s:g} s; "
                "exchange them"
            )
        return self


class Equipment(Protocol):
    """The part of a station that sequences use: sides, limits, targets, instruments."""

    @property
    def sides(self) -> tuple[Side, ...]: ...
    @property
    def limits(self) -> CaptureLimits: ...
    @property
    def f_number(self) -> float: ...
    def frame_px(self, side: Side) -> tuple[int, int]: ...
    def list_targets(self, kind: type[TargetT]) -> dict[str, TargetT]: ...
    def one(self, kind: type[Target]) -> str: ...
    def lacks(self, *families: str) -> tuple[str, ...]: ...
    @property
    def lights(self) -> Mapping[str, LampLight]: ...


class Setting(Frozen):
    """The bench's setting for a step. `target`, `slit_um` None: left as it is. `by_hand`: adjustments, by name.

    `wavelength_nm`: of the monochromator; 0 is zero order (white light), None keeps its shutter closed. `pattern`: path
    in the session of what the screen shows; None leaves the screen dark. `cell_px`: screen pixels per cell of the
    pattern. `gain_db`: of the cameras; None: the station's. `lamp`: share 0..1 by channel of the light source; what
    isn't named is dark."""

    target: str | None
    wavelength_nm: float | None = None
    slit_um: float | None = None
    pattern: str | None = None
    cell_px: int = 1
    by_hand: tuple[str, ...] = ()
    gain_db: float | None = None
    lamp: dict[str, float] = {}

    @model_validator(mode="before")
    @classmethod
    def _aperture_by_hand(cls, value: Any) -> Any:
        """Journals that were written before there were other adjustments have the lenses' stop as `aperture`."""
        if not isinstance(value, dict) or "aperture" not in value:
            return value
        kept = {key: part for key, part in value.items() if key != "aperture"}
        return kept if value["aperture"] is None else kept | {"by_hand": (value["aperture"],)}


class FixedExposure(Frozen):
    """The same exposure (s) for every camera."""

    kind: Literal["fixed"] = "fixed"
    exposure_s: float = Field(gt=0)


class RelativeExposure(Frozen):
    """`factor` times the exposure that the step `of` found for each camera."""

    kind: Literal["relative"] = "relative"
    of: str
    factor: float = Field(default=1.0, gt=0)


class FindExposure(Frozen):
    """A search, camera by camera, for the exposure at which the brightest channel reaches `level`.

    `level` and `tolerance` are shares of the range from the black level to saturation.
    """

    kind: Literal["find"] = "find"
    level: float = Field(default=0.75, gt=0.05, lt=0.95)
    tolerance: float = Field(default=0.05, gt=0)


class Step(Frozen):
    """The unit of the journal: all its files are kept, or none. Its `id` is stable, so that a session can be resumed.

    `radiance`: path of the spectrum that the spectroradiometer measures in the step; None: no measurement. `captures`:
    the captures of one trigger of all cameras, without the keys that are known only then (exposure, gain, temperature,
    time)."""

    id: str
    what: str
    setting: Setting
    radiance: str | None = None
    exposure: FixedExposure | RelativeExposure | FindExposure | None = Field(default=None, discriminator="kind")
    captures: tuple[AnyCapture, ...] = ()

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.captures and not isinstance(self.exposure, FixedExposure | RelativeExposure):
            raise ValueError(f"step {self.id}: captures need an exposure, fixed or relative to one that was found")
        return self

    @property
    def sequence(self) -> str:
        """The first part of the id."""
        return self.id.partition("/")[0]


Level = Annotated[
    float,
    Quantity(
        "1",
        "level that the exposure is found for, a share of the range from black to saturation",
        lower=0.06,
        upper=0.94,
    ),
]


class Sequence(Frozen):
    """What is captured to determine something. Its fields are its parameters, those with a `Quantity` an operator's to
    set; its steps follow from them."""

    name: ClassVar[str]
    purpose: ClassVar[str]  # what is determined with it, in words
    instruments: ClassVar[tuple[str, ...]] = ()  # families of the station file that it can't do without
    targets: ClassVar[tuple[type[Target], ...]] = ()  # kinds of target that it puts before the cameras
    adjustments: ClassVar[tuple[type[Adjustment], ...]] = ()  # kinds of what an operator's hand may change for it

    @classmethod
    def possible(cls, station: Equipment) -> bool:
        """Return whether the station has the sequence's instruments, and a target of each of its kinds."""
        return not station.lacks(*cls.instruments) and all(station.list_targets(kind) for kind in cls.targets)

    @classmethod
    @abstractmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        """Return the sequence in a full calibration on this station; `quick`: with fewer frames. None where the station
        can't take it."""

    @abstractmethod
    def steps(self, station: Equipment) -> tuple[Step, ...]:
        """Return the steps in the order in which they are taken. Raises InputError if the station lacks what they
        need."""

    def patterns(self, station: Equipment) -> dict[str, Cells]:
        """Return the patterns on the screen, arrays (rows, cols) of cells 0 (dark) or 1 (lit), by path in the
        session."""
        return {}

    @classmethod
    def check_instruments(cls, station: Equipment, families: tuple[str, ...] | None = None) -> None:
        """Raise InputError if the station lacks an instrument of the sequence; `families`: in place of those that it
        usually needs."""
        if missing := station.lacks(*(cls.instruments if families is None else families)):
            raise InputError(
                f"station: the sequence {cls.name!r} needs a {' and a '.join(missing)}; "
                f"add [{missing[0]}] to the station file or leave the sequence out"
            )


#: Steps of one sequence, at most: each is a row of the journal.
MOST_STEPS = 50_000


def check_number(steps: float) -> None:
    """Check how many steps a sequence has. Raises ValueError for more than `MOST_STEPS`.

    >>> check_number(100)
    """
    if steps > MOST_STEPS:
        raise ValueError(f"{steps:g} steps are more than the limit of {MOST_STEPS}; give fewer frames, or fewer places")


SEQUENCES: dict[str, type[Sequence]] = {}


def name_of(step_id: str) -> str:
    """Return a step's id as the stem of a file name.

    >>> name_of("dark/0.1s/1")
    'dark-0.1s-1'
    """
    return step_id.replace("/", "-")


def frame_path(step_id: str, side: str) -> str:
    """Return the path in the session of a step's frame of one side.

    >>> frame_path("dark/0.1s/1", "left")
    'frames/dark-0.1s-1-left.npy'
    """
    return f"frames/{name_of(step_id)}-{side}.npy"


def spectrum_path(step_id: str) -> str:
    """Return the path in the session of the spectrum that a step measures.

    >>> spectrum_path("narrowband/550")
    'spectra/narrowband-550.csv'
    """
    return f"spectra/{name_of(step_id)}.csv"


def planned_keys(step_id: str, side: Side) -> dict[str, Any]:
    """Return the keys that every capture of a step has before it is taken.

    >>> planned_keys("dark/0.1s/1", "left")["id"]
    'dark-0.1s-1-left'
    """
    return {"id": f"{name_of(step_id)}-{side}", "side": side, "frame": frame_path(step_id, side), "exposure_s": 0.0}


def usual_of(kind: type[Adjustment], station: Equipment) -> str:
    """Return the name of an adjustment's usual state. Raises InputError where the station has none, as nothing could
    be put back then."""
    for name, target in station.list_targets(kind).items():
        if target.is_usual(station):
            return name
    wanted = get_args(kind.model_fields["kind"].annotation)[0]
    raise InputError(
        f"station: no target of kind {wanted!r} is the usual state of {kind.changes}, so that it could be put back; "
        "add that one to the station file"
    )


def back_step(stem: str, kind: type[Adjustment], station: Equipment) -> Step:
    """Return the step `STEM/back`, in which an operator's hand puts an adjustment back. Raises InputError as
    `usual_of`."""
    usual = usual_of(kind, station)
    what = f"{kind.changes} back to {usual}"
    return Step(id=f"{stem}/back", what=what, setting=Setting(target=None, by_hand=(usual,)))


def exposure_step(stem: str, what: str, setting: Setting, level: float, *, measures_light: bool = True) -> Step:
    """Return the step `STEM/exposure`: with `measures_light` it measures the radiance (at `spectrum_path` of its id),
    then finds the exposure for `level`."""
    id = f"{stem}/exposure"
    return Step(
        id=id,
        what=f"{what}: finding the exposure{', measuring the light' if measures_light else ''}",
        setting=setting,
        radiance=spectrum_path(id) if measures_light else None,
        exposure=FindExposure(level=level),
    )


def register(kind: type[Capture]) -> None:
    """Make a kind of capture known, with its sequence and that sequence's targets.

    Raises ValueError if a name is taken by another class.
    """
    CAPTURES.add(kind)
    if kind.sequence is None:
        return
    if SEQUENCES.setdefault(kind.sequence.name, kind.sequence) is not kind.sequence:
        raise ValueError(f"{kind.__name__}: the sequence name {kind.sequence.name!r} is taken; choose another name")
    for target in (*kind.sequence.targets, *kind.sequence.adjustments):
        TARGETS.add(target)


@contextmanager
def registered(kind: type[Capture]) -> Iterator[None]:
    """Register the kind within the block."""
    tables: tuple[dict[str, Any], ...] = (CAPTURES.models, TARGETS.models, SEQUENCES)
    before = [dict(table) for table in tables]
    try:
        register(kind)
        yield
    finally:
        for table, content in zip(tables, before, strict=True):
            table.clear()
            table.update(content)
