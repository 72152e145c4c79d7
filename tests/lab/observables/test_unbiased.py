"""Every measurement of healthy cameras: its numbers scatter about their prediction as their covariance says, whatever
the frames' size, number, mosaic and depth. Where frames are too small for that, a measurement is skipped. Measurements
are taken from their library: a new one is covered.

Cameras are the second image former's: it shares no code with the measurements.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtri

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from lab.errors import NotDetermined
from lab.formats.camera_model import camera_model
from lab.observables.dataset import Dataset
from lab.observables.noise.line_spectra import Bands, log_mean_bias, log_mean_variance, periodogram
from lab.observables.observable import Observable, measurements

#: Probability that a healthy measurement fails a whole test, over all its comparisons (Bonferroni).
CHANCE = 1e-3
#: Covariances are estimated from the same frames: of about 100 degrees of freedom they are known to 2 / sqrt(200) = 14
#: %.
COVARIANCE_SHARE = 0.15
#: A mean pull of that size moves chi2 of a number by 0.01 and no decision: laws that are linear to first order leave as
#: much.
NEGLIGIBLE_PULL = 0.1
EVEN = ("dark", "flat")
SPECTRAL = (*EVEN, "narrowband")
EDGES = (*EVEN, "slanted_edge")
SMALL_SCENES = (*EDGES, "screen")
SCENES = (*SPECTRAL, "chart", "slanted_edge", "charuco", "screen")
#: Measurements of two cameras: this contract draws one (test_boards.py has pairs).
OF_PAIRS = {"stereo_gain", "stereo_time"}


@dataclass(frozen=True)
class Healthy:
    """Recordings of healthy cameras, one a draw."""

    side_px: int
    repeats: int
    cfa: str
    bit_depth: int
    draws: int
    kinds: tuple[str, ...] = EVEN

    def __str__(self) -> str:
        return f"{self.side_px}px-{self.repeats}x-{self.cfa}-{self.bit_depth}bit-{self.kinds[-1]}"


@dataclass
class Pulls:
    """Pulls of one measurement's numbers."""

    one: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))  # by number
    together: dict[str, list[float]] = field(
        default_factory=lambda: defaultdict(list)
    )  # of a channel's mean, by channel
    chi2_share: list[float] = field(default_factory=list)  # by draw: chi2 over its degrees of freedom
    numbers: list[int] = field(default_factory=list)  # by draw


#: Small, quick recordings for every day: where biases were.
FEW = (
    Healthy(16, 6, "RGGB", 12, 8),
    Healthy(16, 2, "MONO", 8, 8),
    Healthy(24, 3, "GBRG", 14, 4),
    Healthy(40, 8, "MONO", 12, 3),
    Healthy(24, 3, "MONO", 14, 6, EDGES),
)
#: Sizes by mosaics, depths and repeats where frames are small, and whole sessions where they are large.
GRID = (
    *(Healthy(side, 3, cfa, 12, 40) for side in (16, 24, 32, 64) for cfa in ("MONO", "RGGB", "BGGR", "GRBG", "GBRG")),
    *(Healthy(side, 10, cfa, bits, 20) for side in (16, 32) for cfa in ("MONO", "RGGB") for bits in (8, 10, 14, 16)),
    *(Healthy(side, repeats, "RGGB", 12, 12) for side in (16, 32, 64) for repeats in (2, 50, 200)),
    *(Healthy(side, 3, cfa, 12, 10, SPECTRAL) for side in (32, 128) for cfa in ("MONO", "RGGB", "GRBG")),
    *(Healthy(side, 3, cfa, 12, 20, SMALL_SCENES) for side in (24, 32, 48, 64) for cfa in ("MONO", "RGGB")),
    *(Healthy(side, 3, cfa, 12, 6, SCENES) for side in (256, 384, 512) for cfa in ("MONO", "RGGB", "BGGR")),
)


def _dataset(case: Healthy, seed: int) -> Dataset:
    camera = ConcealedCamera(seed, cfa=case.cfa, rows=case.side_px, cols=case.side_px, bit_depth=case.bit_depth)
    recordings = recordings_of(camera, Plan(case.kinds, repeats=case.repeats))
    return Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))


def _drawn(case: Healthy) -> dict[str, Pulls]:
    """Pulls by measurement; a measurement may be skipped, and nothing else."""
    found: dict[str, Pulls] = defaultdict(Pulls)
    for draw in range(case.draws):
        looked_at = _dataset(case, 1000 + draw)
        for measurement in measurements():
            try:
                block = measurement.make(looked_at)
            except NotDetermined as refused:
                assert refused.reason, measurement.name
                continue
            _add(found[measurement.name], block)
    return found


def _add(pulls: Pulls, block: Observable) -> None:
    prediction = block.predict(())
    jacobian = np.reshape(list(prediction.jacobian.values()), (-1, len(block.value)))
    covariance = block.covariance + jacobian.T @ jacobian
    away = block.value - prediction.mean
    assert np.all(np.isfinite(away)), f"{block.measurement.name}: a number isn't finite"
    assert np.all(np.isfinite(covariance)), f"{block.measurement.name}: a covariance isn't finite"
    std = np.sqrt(np.diag(covariance))
    assert np.all(std > 0), f"{block.measurement.name}: a number without uncertainty"
    place: Counter[str] = Counter()
    channels = np.array([label.channel for label in block.labels])
    for channel, pull in zip(channels, away / std, strict=True):
        pulls.one[f"{channel} {place[channel]}"].append(float(pull))
        place[channel] += 1
    for channel in dict.fromkeys(channels):
        pull = np.where(channels == channel, 1.0 / std, 0.0)
        pulls.together[channel].append(float(pull @ away / np.sqrt(pull @ covariance @ pull)))
    correlation = covariance / np.outer(std, std)
    # directions in which rounding of the covariance is all there is don't count
    size, direction = np.linalg.eigh(correlation)
    use = size > 1e-6
    chi2 = np.sum(np.square(direction.T[use] @ (away / std)) / size[use])
    pulls.chi2_share.append(float(chi2) / int(use.sum()))
    pulls.numbers.append(int(use.sum()))


def _faults(drawn: dict[str, Pulls]) -> list[str]:
    """What departs from its prediction by more than chance, one line each."""
    tests = sum(len(p.one) + len(p.together) + 1 for p in drawn.values())
    limit = float(-ndtri(CHANCE / (2.0 * max(tests, 1))))
    faults = []
    for name, pulls in drawn.items():
        for label, values in (*pulls.one.items(), *pulls.together.items()):
            z = np.array(values)
            # a pull has variance 1 at most where the covariance is right: its own spread counts where that is larger
            tolerance = limit * max(1.0, _spread(z)) / np.sqrt(len(z))
            if abs(z.mean()) > tolerance + NEGLIGIBLE_PULL:
                faults.append(f"{name} {label}: mean pull {z.mean():+.2f} of {len(z)} draws, limit {tolerance:.2f}")
        share, numbers = np.array(pulls.chi2_share), np.array(pulls.numbers)
        # chi2 / n has the variance 2 / n in a draw; heavier tails show in its spread from draw to draw
        tolerance = limit * max(float(np.sqrt(np.mean(2.0 / numbers))), _spread(share)) / np.sqrt(len(share))
        if share.mean() > 1.0 + COVARIANCE_SHARE + tolerance:
            faults.append(
                f"{name}: chi2 over its degrees of freedom {share.mean():.2f}, limit "
                f"{1 + COVARIANCE_SHARE + tolerance:.2f}"
            )
    return faults


def _spread(values: NDArray[np.float64]) -> float:
    return float(values.std(ddof=1)) if len(values) > 1 else 0.0


@pytest.mark.parametrize("case", FEW, ids=str)
def test_small_healthy_frames_are_predicted(case: Healthy) -> None:
    drawn = _drawn(case)
    assert "noise_neighbours" in drawn
    assert not _faults(drawn)


@pytest.mark.parametrize("cfa", ["MONO", "RGGB"])
@pytest.mark.parametrize("side_px", [4, 8, 10, 12])
def test_frames_too_small_are_skipped_saying_so(side_px: int, cfa: str) -> None:
    """What is left is finite, which `_drawn` checks; what isn't there says how many px it needs."""
    case = Healthy(side_px, 3, cfa, 12, 1)
    drawn = _drawn(case)
    looked_at = _dataset(case, 1000)
    for measurement in measurements():
        if measurement.name == "noise_neighbours" and side_px < 8 and cfa != "MONO":
            with pytest.raises(NotDetermined, match=r"4 x 4 px.*8 px a side"):
                measurement.make(looked_at)
    assert ("noise_neighbours" in drawn) == (side_px >= (4 if cfa == "MONO" else 8))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("case", GRID, ids=str)
def test_healthy_frames_are_predicted(case: Healthy) -> None:
    drawn = _drawn(case)
    assert drawn
    assert not _faults(drawn)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_contract_reaches_every_measurement() -> None:
    """A new measurement whose captures no case takes would escape it."""
    drawn = _drawn(Healthy(256, 3, "RGGB", 12, 1, SCENES))
    assert {m.name for m in measurements()} - set(drawn) == OF_PAIRS


def test_line_spectra_of_white_noise_are_unbiased_on_16_rows() -> None:
    """Logarithm of the power in bands over the level of 18 modes, mean of eight images."""
    rng, sets, images, found = np.random.default_rng(2), 1000, 8, []
    for _ in range(sets):
        lines = [periodogram(rng.standard_normal((16, 16)).astype(np.float32)).line("rows") for _ in range(images)]
        bands, level = Bands.of(lines[0][0], 8, 1.5), images * lines[0][2]
        power = np.mean([relative for _, relative, _ in lines], axis=0)
        modes = bands.modes * images
        found.append(np.log(bands.mean(power)) - log_mean_bias(modes) - log_mean_bias(level))
    std = np.sqrt(log_mean_variance(modes) + 1.0 / level)
    # 4 sigma of the mean: 0.13; without the level's own bias 0.25 are left
    assert np.all(np.abs(np.mean(found, axis=0) / std) < 4.0 / np.sqrt(sets))


def test_a_bias_and_an_understated_variance_are_faults() -> None:
    rng = np.random.default_rng(3)
    for shift, scale, expected in ((0.0, 1.0, 0), (1.5, 1.0, 1), (0.0, 2.0, 1)):
        pulls = Pulls()
        z = shift + scale * rng.standard_normal(40)
        pulls.together["all"] = list(z)
        pulls.chi2_share, pulls.numbers = list(np.square(z - shift)), [1] * len(z)
        assert len(_faults({"made_up": pulls})) == expected
