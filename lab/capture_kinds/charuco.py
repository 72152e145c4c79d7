"""Poses of a ChArUco board before both cameras: the intrinsics of each camera, and the pose of one to the other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from lab.capture_kinds.base import (
    Capture,
    Equipment,
    Level,
    PoseName,
    RelativeExposure,
    Sequence,
    Setting,
    Step,
    Target,
    exposure_step,
    planned_keys,
)
from sim.parameters import Quantity


class BoardTarget(Target):
    """One pose of a ChArUco board."""

    kind: Literal["charuco"]
    dictionary: str
    squares: tuple[int, int]
    square_mm: float = Field(gt=0)
    marker_mm: float = Field(gt=0)
    pose: str

    @property
    def instruction(self) -> str:
        return f"hold the ChArUco board of {self.square_mm:g} mm squares in pose {self.pose}, in view of both cameras"


class StereoSequence(Sequence):
    """`frames` of each pose at hand (the first `poses` of them; None: all), both cameras at once.

    The exposure is found at the first pose and kept for the others: board and light stay the same.
    """

    name: ClassVar[str] = "stereo"
    purpose: ClassVar[str] = "camera matrix, distortion, pose of one camera to the other"
    instruments: ClassVar[tuple[str, ...]] = ("monochromator",)
    targets: ClassVar[tuple[type[Target], ...]] = (BoardTarget,)

    poses: Annotated[
        int | None,
        Quantity("1", "poses of the board, the first ones of the station; without it all", lower=1, upper=1000),
    ] = None
    frames: Annotated[int, Quantity("1", "frames of each pose", lower=1, upper=1000)] = 1
    level: Level = 0.7

    @classmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        return cls() if cls.possible(station) else None

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        self.check_instruments(station)
        station.one(BoardTarget)
        made: list[Step] = []
        for target, board in list(station.list_targets(BoardTarget).items())[: self.poses]:
            lit = Setting(target=target, wavelength_nm=0.0)
            if not made:
                made.append(exposure_step("stereo", "ChArUco board", lit, self.level, measures_light=False))
            for frame in range(1, self.frames + 1):
                id = f"stereo/{target}/{frame}"
                keys = {"kind": "charuco"} | board.model_dump(exclude={"kind"})
                made.append(
                    Step(
                        id=id,
                        what=f"ChArUco pose {board.pose}, frame {frame} of {self.frames}",
                        setting=lit,
                        exposure=RelativeExposure(of="stereo/exposure"),
                        captures=tuple(
                            CharucoCapture.model_validate(planned_keys(id, side) | keys) for side in station.sides
                        ),
                    )
                )
        return tuple(made)


class CharucoCapture(Capture):
    """A ChArUco board. The same `pose` in captures of both sides makes a stereo pair."""

    shows: ClassVar[str] = "a ChArUco board"
    sequence: ClassVar[type[Sequence] | None] = StereoSequence
    clipping_matters: ClassVar[bool] = False
    codes_are_fitted: ClassVar[bool] = False

    kind: Literal["charuco"]
    # An imported photograph may not say how long it was exposed; the geometry doesn't need it.
    exposure_s: float | None = Field(ge=0)  # type: ignore[assignment]
    # OpenCV's name; "none": a plain checkerboard of `squares`, without markers; "dots": a grid of (rows - 1) x (cols -
    # 1) dots
    dictionary: str
    squares: tuple[int, int]  # rows, cols
    square_mm: float = Field(gt=0)
    marker_mm: float | None = Field(
        default=None, gt=0
    )  # None only where there are no markers; a stated 0 says that there are none
    pose: PoseName
    wavelength_nm: float | None = Field(default=None, gt=0)  # of light of one wavelength; None: white, or not known

    @model_validator(mode="before")
    @classmethod
    def _without_markers(cls, stated: Any) -> Any:
        """Take a marker of 0 mm for none: the board is a plain checkerboard, unless its dictionary is `dots`."""
        try:
            none = isinstance(stated, dict) and float(stated["marker_mm"]) == 0.0
        except (KeyError, TypeError, ValueError):
            return stated
        if not none:
            return stated
        dictionary = stated.get("dictionary")
        return stated | {"marker_mm": None, "dictionary": "dots" if dictionary == "dots" else "none"}

    @property
    def has_markers(self) -> bool:
        """Whether the board has markers that tell its corners apart."""
        return self.dictionary not in ("none", "dots")

    def problems(self, rows: int, cols: int) -> Iterator[str]:
        if self.marker_mm is None and self.has_markers:
            yield "marker_mm is missing; give the markers' side, or dictionary 'none' for a plain checkerboard"
        if self.marker_mm is not None and self.marker_mm >= self.square_mm and self.has_markers:
            yield f"markers of {self.marker_mm:g} mm don't fit squares of {self.square_mm:g} mm; correct one"
        if min(self.squares) < 2:
            yield f"squares {list(self.squares)} make no board; give [rows, cols] of squares, 2 at least"


KIND = CharucoCapture
