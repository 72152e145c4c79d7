"""Charge that single particles leave in the silicon while a frame is exposed: tracks of muons, and points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sim.spectrum import FloatArray

#: Electrons that a minimum ionising particle most probably leaves a um of silicon, and the relative width of that
#: (Moyal's approximation of Landau's distribution).
TRACK_E_PER_UM, TRACK_WIDTH = 80.0, 0.15
#: Mean of the standard Moyal distribution: Euler's constant + ln 2.
MOYAL_MEAN = 1.2703628454614782
#: Least cosine of a track's angle: a flatter one leaves through the sensor's side.
LEAST_COSINE = 0.05
#: Places along a track a pixel's side.
STEPS_A_PIXEL = 4
#: Events of the fixed sample from which moments and distributions are taken.
SAMPLE = 2000
#: Classes of the charge of hit pixels.
CLASSES = 24


@dataclass(frozen=True)
class Particles:
    """Events at random: a Poisson number a frame, `rate_per_cm2_s` a second and cm2.

    A share `point_share` of them leaves its charge in one pixel, gamma distributed with the mean `point_e` and the
    relative standard deviation `point_spread` (1: exponentially). The others are straight tracks through the depth
    `depth_um` of the silicon, of directions whose cosine c with the normal has the density 4 c^3: a flux as
    cos^2 of the zenith's angle, through a level area.
    """

    rate_per_cm2_s: float
    depth_um: float
    point_share: float
    point_e: float
    point_spread: float = 1.0

    def during(self, exposure_s: float, pitch_um: float) -> ParticlesOfFrame:
        """Return what a frame of that exposure gets, on pixels of that pitch."""
        return ParticlesOfFrame(self, exposure_s, pitch_um)

    def expected_number(self, pixels: int, pitch_um: float, exposure_s: float) -> float:
        """Mean number of events on that many pixels."""
        return self.rate_per_cm2_s * exposure_s * pixels * (1e-4 * pitch_um) ** 2

    def draw_event(
        self, rng: np.random.Generator, pitch_um: float
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
        """Return rows and columns of one event's pixels, counted from that where it enters, and their electrons."""
        if rng.random() < self.point_share:
            return (
                np.zeros(1, np.intp),
                np.zeros(1, np.intp),
                np.array([rng.gamma(self.point_spread**-2, self.point_e * self.point_spread**2)]),
            )
        cosine = max(rng.random() ** 0.25, LEAST_COSINE)
        turn, enters = rng.uniform(0.0, 2.0 * np.pi), rng.random(2)
        long_px = self.depth_um * np.sqrt(1.0 - cosine**2) / cosine / pitch_um
        along = (np.arange(int(STEPS_A_PIXEL * long_px) + 1) + 0.5) / (int(STEPS_A_PIXEL * long_px) + 1) * long_px
        loss = 1.0 - TRACK_WIDTH * np.log(np.square(rng.standard_normal()))
        electrons = TRACK_E_PER_UM * self.depth_um / cosine * max(loss, 0.2)
        rows = np.floor(enters[0] + along * np.sin(turn)).astype(np.intp)
        cols = np.floor(enters[1] + along * np.cos(turn)).astype(np.intp)
        first, wide = cols.min(), int(np.ptp(cols)) + 1
        places, which = np.unique(rows * wide + (cols - first), return_inverse=True)
        share = np.bincount(which.ravel()) / along.size
        return places // wide, places % wide + first, electrons * share

    def brightest_e(self, pitch_um: float) -> FloatArray:
        """Electrons of the brightest pixel of each event of a fixed sample, ascending, (`SAMPLE`,)."""
        return _sample(replace(self, rate_per_cm2_s=1.0), pitch_um)[0]

    def pixels_e(self, pitch_um: float) -> tuple[FloatArray, FloatArray]:
        """Return the distribution of the charge of hit pixels: their number an event in each of `CLASSES` classes of
        equal number, and the mean charge of each, e."""
        return _sample(replace(self, rate_per_cm2_s=1.0), pitch_um)[3:]

    def moments_e(self, pitch_um: float) -> tuple[float, float]:
        """Means over events of the sum of their electrons, and of the sum of the squares of their pixels' (e, e^2)."""
        return _sample(replace(self, rate_per_cm2_s=1.0), pitch_um)[1:3]


@lru_cache(maxsize=256)
def _sample(law: Particles, pitch_um: float) -> tuple[FloatArray, float, float, FloatArray, FloatArray]:
    rng = np.random.default_rng(2001)
    events = [law.draw_event(rng, pitch_um)[2] for _ in range(SAMPLE)]
    classes = np.array_split(np.sort(np.concatenate(events)), CLASSES)
    return (
        np.sort([float(e.max()) for e in events]),
        float(np.mean([e.sum() for e in events])),
        float(np.mean([np.square(e).sum() for e in events])),
        np.array([part.size for part in classes]) / SAMPLE,
        np.array([float(part.mean()) for part in classes]),
    )


@dataclass(frozen=True)
class ParticlesOfFrame:
    """The particles of one frame: a `sim.stages.Disturbance`."""

    law: Particles
    exposure_s: float
    pitch_um: float

    def draw(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Draw the electrons of one frame; what a track leaves beyond the rim is lost."""
        electrons_of_frame = np.zeros(shape)
        number = rng.poisson(self.law.expected_number(shape[0] * shape[1], self.pitch_um, self.exposure_s))
        for _ in range(int(number)):
            rows, cols, electrons = self.law.draw_event(rng, self.pitch_um)
            rows, cols = rows + rng.integers(shape[0]), cols + rng.integers(shape[1])
            inside = (rows >= 0) & (rows < shape[0]) & (cols >= 0) & (cols < shape[1])
            np.add.at(electrons_of_frame, (rows[inside], cols[inside]), electrons[inside])
        return electrons_of_frame

    def mean_e(self, shape: tuple[int, ...]) -> float:
        """Mean of every pixel, without the rim's loss."""
        return self.law.expected_number(1, self.pitch_um, self.exposure_s) * self.law.moments_e(self.pitch_um)[0]

    def variance_e2(self, shape: tuple[int, ...]) -> float:
        """Variance of every pixel: of a compound Poisson variable the mean number times the mean square."""
        return self.law.expected_number(1, self.pitch_um, self.exposure_s) * self.law.moments_e(self.pitch_um)[1]
