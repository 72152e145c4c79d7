"""Are the uncertainties of edges and kernels true? Draws of known truths: shares within two standard uncertainties.

Prints the coverage tables of docs/explanation/accuracy/blur.md.
"""

from __future__ import annotations

import os

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import j1, ndtr

from lab.fit.mtf import edge_mtf
from lab.fit.psf import estimate_kernel
from tests.lab.fit.psf.drawn_targets import blurred_target, by_area, four_spots, gaussian

DRAWS = int(os.environ.get("CALIBENCH_COVERAGE_DRAWS", "200"))
FREQUENCIES = np.arange(0.05, 1.0, 0.05)
pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]

#: Line spreads as sums of Gaussians: share, shift px, sigma px; a Cauchy's share has "sigma" as its half width, below
#: 0.
PROFILES = {
    "Gauss 0.3": [(1.0, 0.0, 0.3)],
    "Gauss 0.55": [(1.0, 0.0, 0.55)],
    "Gauss 0.9": [(1.0, 0.0, 0.9)],
    "Gauss 1.5": [(1.0, 0.0, 1.5)],
    "two spots, 1.4 px apart": [(0.5, -0.7, 0.4), (0.5, 0.7, 0.4)],
    "asymmetric": [(0.6, -0.3, 0.45), (0.25, 0.5, 0.6), (0.15, 1.6, 0.9)],
    "halo of 3 px, 10 %": [(0.9, 0.0, 0.5), (0.1, 0.0, 3.0)],
    "Gauss 3": [(1.0, 0.0, 3.0)],
    "wide, skewed": [(0.7, -0.4, 1.2), (0.3, 1.2, 2.0)],
    "Gauss 1.5, halo of 6 px, 5 %": [(0.95, 0.0, 1.5), (0.05, 0.0, 6.0)],
    "tail of diffraction": [(0.5, 0.0, -0.8), (0.5, 0.0, 0.5)],
}


def profile(parts, distance):
    return sum(
        share * (ndtr((distance - at) / width) if width > 0 else 0.5 - np.arctan((distance - at) / width) / np.pi)
        for share, at, width in parts
    )


def transfer(parts, f):
    return sum(
        share
        * np.exp(-2j * np.pi * f * at)
        * (np.exp(-2 * (np.pi * width * f) ** 2) if width > 0 else np.exp(2 * np.pi * width * np.abs(f)))
        for share, at, width in parts
    )


def test_edges_cover() -> None:
    print(
        "\n| line spread | MTF50 | MTF10 | curve, where above 1 % | angle | sd of error / stated, MTF50 |\n| --- | "
        "--- | --- | --- | --- | --- |"
    )
    rng = np.random.default_rng(1)
    pooled = {"mtf50": [], "mtf10": [], "curve": [], "angle": []}
    for name, parts in PROFILES.items():
        truth = np.abs(transfer(parts, FREQUENCIES))
        levels = {}
        grid = np.linspace(0.01, 2.0, 2000)
        for level in (0.5, 0.1):
            gap = np.abs(transfer(parts, grid)) - level
            first = int(np.flatnonzero(gap < 0)[0]) if (gap < 0).any() else 0
            levels[level] = (
                brentq(
                    lambda f, parts=parts, level=level: abs(transfer(parts, f)) - level, grid[first - 1], grid[first]
                )
                if first
                else np.nan
            )
        pulls = {key: [] for key in pooled}
        for _ in range(DRAWS):
            angle = rng.uniform(3.0, 12.0)
            row, col = np.indices((200, 200)) - 99.5
            a = np.radians(angle)
            electrons = 9000.0 * (0.1 + profile(parts, col * np.cos(a) + row * np.sin(a) - rng.uniform(-0.5, 0.5)))
            found = edge_mtf(np.round(0.4 * rng.normal(electrons, np.sqrt(electrons + 4.0))), FREQUENCIES)
            pulls["mtf50"].append((found.mtf50_cy_per_px - levels[0.5]) / found.mtf50_cy_per_px_std)
            if found.mtf10_cy_per_px is not None:
                pulls["mtf10"].append((found.mtf10_cy_per_px - levels[0.1]) / found.mtf10_cy_per_px_std)
            pulls["curve"].append(((found.mtf - truth) / found.mtf_std)[truth > 0.01])
            pulls["angle"].append((found.angle_deg - angle) / found.angle_deg_std)
        shares = {key: 100 * np.mean(np.abs(value) < 2) for key, value in pulls.items()}
        for key, kept in pooled.items():
            kept.append(shares[key])
        print(
            f"| {name} | {shares['mtf50']:.1f} | {shares['mtf10']:.1f} | {shares['curve']:.1f} | {shares['angle']:.1f} "
            f"| {np.std(pulls['mtf50']):.2f} |",
            flush=True,
        )
    means = {key: np.mean(value) for key, value in pooled.items()}
    print("| all | " + " | ".join(f"{means[key]:.1f}" for key in pooled) + " | |")
    # 200 draws of 11 profiles: 95.4 % +- 0.5 %; the wanted range is 93 to 97 %
    for key, value in means.items():
        assert 93.0 <= value <= 97.0, key


KERNELS = {
    "Gauss 1 (17)": gaussian(17, 1, 1),
    "Gauss 1.6 x 1.3 (15)": gaussian(15, 1.6, 1.3, 30),
    "diffraction x pixel (17)": by_area(
        lambda r, c: (2 * j1(np.hypot(r, c) * 2.2 + 1e-9) / (np.hypot(r, c) * 2.2 + 1e-9)) ** 2, 17, 16
    ),
    "4 spots (17)": by_area(four_spots, 17),
    "disc 2.5 (13)": by_area(lambda r, c: np.hypot(r, c) <= 2.5, 13),
}


def test_kernels_cover() -> None:
    print("\n| kernel (support) | elements above 1 % of the peak | rms of error / stated |\n| --- | --- | --- |")
    shares = []
    for name, truth in KERNELS.items():
        pulls = []
        for seed in range(DRAWS):
            found = estimate_kernel(*blurred_target(truth, 160, seed=1000 + seed), len(truth))
            pulls.append(((found.kernel - truth) / found.kernel_std)[truth > 0.01 * truth.max()])
        shares.append(100 * np.mean(np.abs(pulls) < 2))
        print(f"| {name} | {shares[-1]:.1f} | {np.sqrt(np.mean(np.square(pulls))):.2f} |", flush=True)
    print(f"| all | {np.mean(shares):.1f} | |")
    assert 93.0 <= np.mean(shares) <= 97.0
