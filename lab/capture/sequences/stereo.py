"""Poses of a ChArUco board before both cameras: intrinsics of each, and where one stands to the other."""

from __future__ import annotations

from pydantic import Field

from lab.capture.sequences.steps import FindExposure, RelativeExposure, Sequence, Setting, Step, common, needs
from lab.capture.station import CharucoBoard, Station
from lab.formats.recording_set import Charuco


class StereoSequence(Sequence):
    """`frames` of every pose at hand (the first `poses` of them, None: all), both cameras at once.

    The exposure is found at the first pose and kept for the others: the board is the same and so is the light.
    """

    poses: int | None = Field(default=None, ge=1)
    frames: int = Field(default=1, ge=1)
    level: float = 0.7

    def steps(self, station: Station) -> tuple[Step, ...]:
        """See `Sequence.steps`."""
        needs(station, "stereo", "monochromator")
        boards = list(station.having(CharucoBoard).items())[: self.poses]
        if not boards:
            station.one(CharucoBoard)
        made: list[Step] = []
        for target, board in boards:
            lit = Setting(target=target, wavelength_nm=0.0)
            if not made:
                made.append(
                    Step(
                        id="stereo/exposure",
                        what="ChArUco board: finding the exposure",
                        setting=lit,
                        exposure=FindExposure(level=self.level),
                    )
                )
            for frame in range(1, self.frames + 1):
                id = f"stereo/{target}/{frame}"
                keys = {
                    "kind": "charuco",
                    "dictionary": board.dictionary,
                    "squares": board.squares,
                    "square_mm": board.square_mm,
                    "marker_mm": board.marker_mm,
                    "pose": board.pose,
                }
                made.append(
                    Step(
                        id=id,
                        what=f"ChArUco pose {board.pose}, frame {frame} of {self.frames}",
                        setting=lit,
                        exposure=RelativeExposure(of="stereo/exposure"),
                        captures=tuple(Charuco.model_validate(common(id, side) | keys) for side in station.sides),
                    )
                )
        return tuple(made)
