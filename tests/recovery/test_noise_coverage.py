"""Are the noise figures' stated uncertainties true? Every figure over many draws of cameras with known truth.

`pytest -m slow -s tests/recovery/test_noise_coverage.py` prints the table of
docs/explanation/accuracy/noise.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy import stats

from lab.fit.noise.noise_fit import noise_fit
from lab.formats.recording_set import DataSheet
from lab.formats.results import NoiseFit
from lab.observables.darks.pixels import DarkPixels
from lab.observables.noise.levels import MeasuredLevel
from lab.observables.noise.stack import Stack
from lab.observables.weighted_lines import linearity
from sim.sensor.mosaic import planes

DRAWS = 300
#: Percentages that intervals which hold 93 % (97 %) of all draws fall below (exceed) by chance in one of a hundred
#: figures.
LOWEST = 100.0 * float(stats.binom.ppf(0.01, DRAWS, 0.93)) / DRAWS
HIGHEST = 100.0 * float(stats.binom.ppf(0.99, DRAWS, 0.97)) / DRAWS
pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


@dataclass(frozen=True)
class Truth:
    """A synthetic camera; electrons unless said. Light l (exposure s) gives `rate` l electrons in a plane of share
    1."""

    cfa: str = "MONO"
    shape: tuple[int, int] = (96, 128)
    gain: float = 0.45
    black: float = 100.0
    read: float = 3.2
    read_spread: float = 0.0  # relative standard deviation of the pixels' read-noise variances
    dark: float = 15.0  # e/s
    dsnu: tuple[float, float, float] = (0.5, 0.4, 1.2)  # rows, columns, pixels
    prnu: tuple[float, float, float] = (0.002, 0.0015, 0.006)
    rate: float = 7000.0
    well: float = 7600.0
    efficiency: float = 0.6
    bend: float = 0.0  # response e (1 - bend e / well)
    shared: float = 0.0  # share of a charge's noise that each of four neighbours takes at full well
    share: dict[str, float] = field(default_factory=lambda: {"R": 0.7, "G1": 1.0, "G2": 1.0, "B": 0.5, "Y": 1.0})
    flats: tuple[float, ...] = tuple(np.linspace(0.05, 1.25, 20))
    darks: tuple[float, ...] = (0.002, 0.5, 1.0, 2.0)
    flat_repeats: int = 3
    dark_repeats: int = 8


class Drawn:
    """One camera's pixels."""

    def __init__(self, truth: Truth, rng: np.random.Generator) -> None:
        self.truth, self.rng = truth, rng
        self.prnu, self.dsnu = np.zeros(truth.shape), np.zeros(truth.shape)
        for target, parts in ((self.prnu, truth.prnu), (self.dsnu, truth.dsnu)):
            for plane in planes(target, truth.cfa).values():
                m, n = plane.shape
                rows, columns = rng.standard_normal((m, 1)), rng.standard_normal((1, n))
                plane[...] = parts[0] * rows + parts[1] * columns + parts[2] * rng.standard_normal((m, n))
        for plane in planes(self.prnu, truth.cfa).values():
            plane[...] = plane - plane.mean()  # the responsivity is these pixels'
        self.read2 = truth.read**2 * np.maximum(1.0 + truth.read_spread * rng.standard_normal(truth.shape), 0.05)
        self.share = np.ones(truth.shape)
        for name, plane in planes(self.share, truth.cfa).items():
            plane[...] = truth.share[name]

    def frame(self, light_s: float, exposure_s: float, dark: float) -> np.ndarray:
        truth, rng = self.truth, self.rng
        mean = truth.rate * light_s * self.share * (1.0 + self.prnu) + dark * exposure_s
        noise = rng.poisson(mean) - mean
        if truth.shared:
            kappa = truth.shared * mean / truth.well
            padded = np.pad(noise, 1, mode="wrap")
            around = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
            noise = noise + kappa * (around - 4.0 * noise)
        charge = np.minimum(mean + noise, truth.well)
        charge = charge * (1.0 - truth.bend * charge / truth.well) + self.dsnu
        charge += np.sqrt(self.read2) * rng.standard_normal(truth.shape)
        return np.clip(np.rint(truth.black + truth.gain * charge), 0, 4095).astype(np.uint16)

    def level(
        self, exposure_s: float, light_s: float, repeats: int, dark: float, temperature_c: float | None = None
    ) -> tuple[MeasuredLevel, Stack]:
        stack = Stack(self.truth.cfa, 4095, None)
        for _ in range(repeats):
            stack.add(self.frame(light_s, exposure_s, dark))
        photons = self.truth.rate * light_s / self.truth.efficiency
        lamp = ("", True, 550.0) if light_s else "dark"
        return MeasuredLevel(exposure_s, photons, lamp, stack.statistics(), temperature_c), stack

    def fit(self, temperatures: tuple[float, ...] = ()) -> NoiseFit:
        truth = self.truth
        pixels = DarkPixels(truth.cfa)
        darks = []
        for exposure in sorted(truth.darks, reverse=True):
            level, stack = self.level(
                exposure, 0.0, truth.dark_repeats, truth.dark, temperatures[0] if temperatures else None
            )
            pixels.take(stack, exposure)
            darks.append(level)
        for temperature in temperatures[1:]:
            current = truth.dark * 2.0 ** ((temperature - temperatures[0]) / 6.0)
            darks += [self.level(t, 0.0, truth.dark_repeats, current, temperature)[0] for t in truth.darks]
        flats = [
            self.level(t, t, truth.flat_repeats, truth.dark, temperatures[0] if temperatures else None)[0]
            for t in truth.flats
        ]
        rows, cols = truth.shape
        return noise_fit(
            darks, flats, DataSheet(rows=rows, cols=cols, cfa=truth.cfa, bit_depth=12), pixels=pixels.figures()
        )


def quadratic_sum(parts: tuple[float, ...]) -> float:
    return float(np.sqrt(np.sum(np.square(parts))))


def general(t: Truth) -> dict[str, float]:
    """Figures whose truth doesn't depend on the definitions of EMVA 1288."""
    return {
        "conversion_gain_dn_per_e": t.gain,
        "conversion_gain_at_zero_dn_per_e": t.gain,
        "read_noise_e": t.read,
        "black_level_dn": t.black,
        "dark_current_e_per_s": t.dark,
        "dark_current_from_variance_e_per_s": t.dark,
        "dsnu_e": quadratic_sum(t.dsnu),
        "full_well_e": t.well * (1.0 - t.bend),
    }


def linear(t: Truth) -> dict[str, float]:
    """And those of a linear camera."""
    dark_dn = np.sqrt((t.gain * t.read) ** 2 + 1.0 / 12.0)
    threshold = float(np.sqrt((dark_dn / t.gain) ** 2 + 0.25) + 0.5)
    found = {
        "prnu_percent": 100.0 * quadratic_sum(t.prnu),
        "quantum_efficiency": t.efficiency,
        "emva1288.Y.responsivity_dn_per_photon": t.efficiency * t.gain,
        "emva1288.Y.quantum_efficiency": t.efficiency,
        "emva1288.Y.system_gain_dn_per_e": t.gain,
        "emva1288.Y.temporal_dark_noise_dn": float(dark_dn),
        "emva1288.Y.temporal_dark_noise_e": t.read,
        "emva1288.Y.sensitivity_threshold_e": threshold,
        "emva1288.Y.sensitivity_threshold_photons": threshold / t.efficiency,
        "emva1288.Y.dsnu_e": quadratic_sum(t.dsnu),
        "emva1288.Y.prnu_percent": 100.0 * quadratic_sum(t.prnu),
        "emva1288.Y.dark_current_from_mean_e_per_s": t.dark,
        "emva1288.Y.dark_current_from_variance_e_per_s": t.dark,
    }
    for number, part in enumerate(("row", "column", "pixel")):
        found[f"emva1288.Y.dsnu_{part}_e"] = t.dsnu[number]
        found[f"emva1288.Y.prnu_{part}_percent"] = 100.0 * t.prnu[number]
    return found


def bent(t: Truth) -> dict[str, float]:
    """Of a camera whose response bends and whose charge repels, in colour: percent at saturation (the full well's
    signal)."""
    saturation = t.well * (1.0 - t.bend)  # electrons' worth of signal
    response = -100.0 * t.bend * saturation / t.well
    missing = 100.0 * 8.0 * t.shared * saturation / t.well
    error = linearity_error(t)
    found = {
        "response_bend_percent": response,
        "variance_bend_percent": 3.0 * response - missing,
        "brighter_fatter_percent": missing,
        "neighbour_covariance_percent": missing,
        "linearity_error_percent": error,
    }
    for channel in "RGB":
        found[f"channels.{channel}.conversion_gain_dn_per_e"] = t.gain
        found[f"channels.{channel}.read_noise_e"] = t.read
        found[f"channels.{channel}.black_level_dn"] = t.black
        found[f"channels.{channel}.dark_current_e_per_s"] = t.dark
        found[f"channels.{channel}.dsnu_e"] = quadratic_sum(t.dsnu)
    return found


def linearity_error(t: Truth) -> float:
    """LE of noise-free means over the planes, by the definition."""
    errors = []
    for share in ("R", "G1", "G2", "B"):
        light = np.array([v for v in t.flats if t.rate * v * t.share[share] < 0.97 * t.well])
        dark = t.dark * light  # bends with the rest, and is taken off bent
        charge = t.rate * light * t.share[share] + dark
        signal = t.gain * (charge * (1.0 - t.bend * charge / t.well) - dark * (1.0 - t.bend * dark / t.well))
        share_of = signal / (t.gain * t.well * (1.0 - t.bend))
        chosen = (share_of >= 0.05) & (share_of <= 0.95)
        errors.append(linearity(light[chosen], signal[chosen], 1e-18 * np.eye(chosen.sum())).error_percent)
    return float(np.mean(errors))


def value_of(fit: NoiseFit, path: str) -> tuple[float | None, float | None]:
    *parents, name = path.split(".")
    place: object = fit
    for parent in parents:
        place = place[parent] if isinstance(place, dict) else getattr(place, parent)
    return getattr(place, name), getattr(place, f"{name}_std")


def table(name: str, fits: list[NoiseFit], truths: dict[str, float], draws: int) -> list[str]:
    """Print coverage by figure; give those out of 93..97 % by more than the standard deviation of so many draws, and
    their mean where it is out."""
    print(f"\n{name}, {draws} draws\n| figure | truth | mean | rms error | mean stated | 2-sigma coverage, % |")
    print("| --- | --- | --- | --- | --- | --- |")
    out, all_covered = [], []
    for path, truth in truths.items():
        pairs = np.array([value_of(fit, path) for fit in fits], float)
        assert np.isfinite(pairs).all(), path
        error, std = pairs[:, 0] - truth, pairs[:, 1]
        covered = 100.0 * float(np.mean(np.abs(error) <= 2.0 * std))
        print(
            f"| `{path}` | {truth:.5g} | {pairs[:, 0].mean():.5g} | {np.sqrt(np.mean(error**2)):.2g} | "
            f"{std.mean():.2g} | {covered:.1f} |"
        )
        all_covered.append(covered)
        if not LOWEST <= covered <= HIGHEST:
            out.append(f"{path}: {covered:.1f} %")
    print(f"all figures: {np.mean(all_covered):.1f} % (single ones may be {LOWEST:.1f} to {HIGHEST:.1f} %)")
    if not 93.0 <= np.mean(all_covered) <= 97.0:
        out.append(f"all figures: {np.mean(all_covered):.1f} %")
    return out


CASES: dict[str, tuple[Truth, Callable[[Truth], dict[str, float]], tuple[float, ...]]] = {
    "linear": (Truth(), lambda t: general(t) | linear(t), ()),
    "bent": (
        Truth(cfa="RGGB", shape=(128, 192), bend=0.015, shared=0.003, dsnu=(0.0, 0.0, 1.2), prnu=(0.0, 0.0, 0.006)),
        lambda t: general(t) | bent(t),
        (),
    ),
    "warm": (
        Truth(read_spread=0.3, flats=tuple(np.linspace(0.1, 1.0, 6)), darks=(0.01, 0.5, 2.0)),
        lambda t: {
            "dark_current_temperature.doubling_temperature_c": 6.0,
            # The shortest darks hold a little dark current, whose noise all pixels have alike.
            "read_noise_distribution.spread_percent": 100.0
            * t.read_spread
            * t.read**2
            / (t.read**2 + t.dark * t.darks[0]),
        },
        (20.0, 26.0, 32.0),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_two_sigma_intervals_cover(case: str) -> None:
    truth, expected, temperatures = CASES[case]
    rng = np.random.default_rng(list(CASES).index(case) + 40)
    fits = [Drawn(truth, rng).fit(temperatures) for _ in range(DRAWS)]
    out = table(case, fits, expected(truth), DRAWS)
    assert not out, out
