"""The whole calibration: which sequences, in which order, and how much of each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lab.capture.sequences.dark import DarkSequence
from lab.capture.sequences.flat import FlatSequence
from lab.capture.sequences.narrowband import NarrowbandSequence
from lab.capture.sequences.steps import Sequence, Step
from lab.capture.sequences.stereo import StereoSequence
from lab.capture.sequences.targets import ChartSequence, EdgeSequence, ScreenSequence
from lab.capture.station import CharucoBoard, KnifeEdge, ReflectanceChart, ScreenTarget, Station
from sim.parameters import Frozen

DARK_S = (0.0005, 0.05, 0.5, 2.0, 5.0)
QUICK_DARK_S = (0.0005, 0.5, 2.0, 5.0)
#: Shares of the brightest channel's saturation: dense where its photon transfer bends, and beyond it, for the full well
#: (the corners of a frame get less light) and for the half and full ranges of the channels that a lamp lights less.
LEVELS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.15, 1.4, 1.8, 2.3)
QUICK_LEVELS = (0.03, 0.1, 0.25, 0.4, 0.55, 0.7, 0.87, 1.2, 1.6)


class Calibration(Frozen):
    """The sequences of one session, in their order."""

    dark: DarkSequence | None = None
    flat: FlatSequence | None = None
    narrowband: NarrowbandSequence | None = None
    chart: ChartSequence | None = None
    edge: EdgeSequence | None = None
    screen: ScreenSequence | None = None
    stereo: StereoSequence | None = None

    @property
    def sequences(self) -> tuple[Sequence, ...]:
        """Those that are asked for."""
        named = (self.dark, self.flat, self.narrowband, self.chart, self.edge, self.screen, self.stereo)
        return tuple(sequence for sequence in named if sequence is not None)

    def steps(self, station: Station) -> tuple[Step, ...]:
        """All steps. Raises InputError if the station lacks what one of them needs."""
        return tuple(step for sequence in self.sequences for step in sequence.steps(station))

    def patterns(self, station: Station) -> dict[str, NDArray[np.uint8]]:
        """All patterns that the screen is to show, by path."""
        return {path: cells for sequence in self.sequences for path, cells in sequence.patterns(station).items()}


def full_calibration(station: Station, quick: bool = False) -> Calibration:
    """What a station can do: every sequence whose instruments and targets it has. `quick` takes fewer of each."""
    light = station.monochromator is not None and station.spectroradiometer is not None
    screen = station.display is not None and station.spectroradiometer is not None
    board = bool(station.having(CharucoBoard)) and station.monochromator is not None
    return Calibration(
        dark=DarkSequence(exposures_s=QUICK_DARK_S if quick else DARK_S, frames=4),
        flat=FlatSequence(levels=QUICK_LEVELS if quick else LEVELS, frames=4) if light else None,
        narrowband=NarrowbandSequence() if light else None,
        chart=ChartSequence(frames=2 if quick else 4) if light and station.having(ReflectanceChart) else None,
        edge=EdgeSequence(frames=2 if quick else 4) if light and station.having(KnifeEdge) else None,
        screen=ScreenSequence(frames=2 if quick else 4) if screen and station.having(ScreenTarget) else None,
        stereo=StereoSequence() if board else None,
    )
