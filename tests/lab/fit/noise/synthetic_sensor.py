"""A synthetic camera of known truth: its frames, levels, recording sets and the scores of a fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lab.fit.noise.noise_fit import noise_fit
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet
from lab.formats.results import NoiseFit
from lab.observables.noise.levels import MeasuredLevel
from lab.observables.noise.stack import level_statistics
from sim.sensor.mosaic import planes


@dataclass(frozen=True)
class Sensor:
    """The truth of a synthetic camera; electrons unless said. Shot noise is drawn as a normal variable of the same
    moments."""

    shape: tuple[int, int] = (120, 160)
    cfa: str = "RGGB"
    gain: float = 0.5  # DN/e
    read: float = 3.0
    black: float = 100.0  # DN
    dark_rate: float = 20.0  # e/s
    dsnu: float = 1.5
    prnu: float = 0.008
    full: float = 7600.0  # e at light 1
    well: float = np.inf
    white: int = 4095
    bend: float = 0.0  # response e (1 - bend e / full)
    brighter_fatter: float = 0.0  # variance e (1 - bf e / full)
    channel: tuple[tuple[str, float], ...] = (("R", 0.7), ("G1", 1.0), ("G2", 1.0), ("B", 0.5), ("Y", 1.0))
    corner: float = 0.0  # loss of light in the corner, quadratic
    flicker: float = 0.0  # amplitude of the light's wave over 37 rows, of another phase in each frame

    def pattern(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        return self.prnu * rng.standard_normal(self.shape), self.dsnu * rng.standard_normal(self.shape)

    def frame(
        self, rng: np.random.Generator, light: float, exposure_s: float, pattern: tuple[np.ndarray, np.ndarray]
    ) -> np.ndarray:
        mean = np.full(self.shape, light * self.full)
        share = dict(self.channel)
        for name, plane in planes(mean, self.cfa).items():
            np.multiply(plane, share[name], out=plane)
        row, col = (np.linspace(-1, 1, n) for n in self.shape)
        mean *= 1.0 - self.corner * 0.5 * (row[:, None] ** 2 + col**2)
        if self.flicker:
            wave = np.sin(2.0 * np.pi * (np.arange(self.shape[0]) / 37.0 + rng.random()))
            mean *= 1.0 + self.flicker * wave[:, None]
        mean = mean * (1.0 + pattern[0]) + self.dark_rate * exposure_s
        variance = mean * (1.0 - self.brighter_fatter * mean / self.full)
        charge = np.minimum(mean + np.sqrt(variance) * rng.standard_normal(self.shape), self.well)
        charge = charge * (1.0 - self.bend * charge / self.full) + pattern[1]
        charge += self.read * rng.standard_normal(self.shape)
        return np.clip(np.rint(self.black + self.gain * charge), 0, self.white).astype(np.uint16)

    def camera(self) -> DataSheet:
        return DataSheet(rows=self.shape[0], cols=self.shape[1], cfa=self.cfa, bit_depth=12)


def levels(
    sensor: Sensor,
    rng: np.random.Generator,
    exposures: np.ndarray,
    repeats: int,
    *,
    dark: bool = False,
    drift: float = 0.0,
    pattern: tuple[np.ndarray, np.ndarray],
) -> list[MeasuredLevel]:
    found = []
    for exposure in exposures:
        frames = (
            sensor.frame(
                rng, 0.0 if dark else exposure * (1.0 + drift * rng.standard_normal()), float(exposure), pattern
            )
            for _ in range(repeats)
        )
        found.append(
            MeasuredLevel(
                float(exposure),
                0.0 if dark else float(exposure),
                "dark" if dark else "lamp",
                level_statistics(frames, sensor.cfa, sensor.white),
            )
        )
    return found


def measured(sensor: Sensor, rng: np.random.Generator, drift: float = 0.0) -> NoiseFit:
    pattern = sensor.pattern(rng)
    darks = levels(sensor, rng, np.array([0.001, 0.5, 2.0]), 4, dark=True, pattern=pattern)
    flats = levels(sensor, rng, np.linspace(0.04, 0.98, 12), 3, pattern=pattern, drift=drift)
    return noise_fit(darks, flats, sensor.camera())


TRUTHS = {
    "conversion_gain_dn_per_e": lambda s: s.gain,
    "read_noise_e": lambda s: s.read,
    "black_level_dn": lambda s: s.black,
    "dark_current_e_per_s": lambda s: s.dark_rate,
    "dsnu_e": lambda s: s.dsnu,
    "prnu_percent": lambda s: 100.0 * s.prnu,
}


def scores(fit: NoiseFit, sensor: Sensor) -> dict[str, float]:
    """Error over stated uncertainty of each figure."""
    return {key: (getattr(fit, key) - truth(sensor)) / getattr(fit, key + "_std") for key, truth in TRUTHS.items()}


def recording_set(
    sensor: Sensor, darks: list[tuple[float, int]], flats: list[tuple[float, int]], **extra: object
) -> RecordingSet:
    rng = np.random.default_rng(14)
    pattern = sensor.pattern(rng)
    captures, frames = [], {}
    for kind, wanted in (("dark", darks), ("flat", flats)):
        for exposure, repeats in wanted:
            for _ in range(repeats):
                name = f"{kind}-{len(captures)}"
                captures.append(
                    {"id": name, "kind": kind, "side": "left", "frame": name, "exposure_s": exposure, **extra}
                )
                frames[name] = sensor.frame(rng, exposure if kind == "flat" else 0.0, exposure, pattern)
    manifest = Manifest(cameras={"left": sensor.camera()}, captures=tuple(captures))
    return RecordingSet(manifest, frames)


LADDER = [(0.1, 2), (0.3, 2), (0.5, 2), (0.7, 2), (0.9, 2)]
