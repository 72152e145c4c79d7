"""Sensitivities of measured cameras recovered from lights, beside division, the pseudo-inverse, plain Tikhonov, and the bound.

Twelve curves of four cameras, measured every 5 nm. Relative RMS error over 400..720 nm. "Signal": noise of 0.2 % of each signal, as
shot noise and radiometer give it; "peak": of the highest signal, at every wavelength.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks.peers.tikhonov import divided, pseudo_inverse, tikhonov
from benchmarks.table import Row, show
from lab.fit.spectral import estimate_sensitivity

FOLDER = Path(__file__).parents[2] / "shared" / "data" / "rawtoaces_sensitivities"
DRAWS = int(os.environ.get("CALIBENCH_BENCH_DRAWS", "8"))
pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


def curves() -> list[tuple[np.ndarray, np.ndarray]]:
    if not FOLDER.exists():
        pytest.skip("the shared sensitivities aren't here")
    found = []
    for file in sorted(FOLDER.glob("*.json")):
        rows = json.loads(file.read_text())["spectral_data"]["data"]["main"]
        wavelength = np.array(sorted(map(float, rows)))
        values = np.array([rows[f"{w:.0f}"] for w in wavelength])
        found += [(wavelength, values[:, channel]) for channel in range(3)]
    return found


def bound_percent(operator: np.ndarray, std: np.ndarray, truth: np.ndarray, inside: np.ndarray) -> float | None:
    """Cramer-Rao: the least relative RMS that an unbiased estimate without a prior can have, the curve beyond the lights known.
    None where the lights don't determine it (fewer lights than wavelengths)."""
    scaled = operator[:, inside] / std[:, None]
    if scaled.shape[0] < scaled.shape[1]:
        return None
    variance = np.diag(np.linalg.inv(scaled.T @ scaled))
    return float(100.0 * np.sqrt(variance.mean() / np.mean(truth[inside] ** 2)))


@pytest.mark.parametrize("noise", ["signal", "peak"])
@pytest.mark.parametrize(
    ("grid_nm", "width_nm", "step_nm", "relative"),
    [(5.0, 5.0, 5.0, 0.002), (1.0, 5.0, 5.0, 0.002), (1.0, 10.0, 10.0, 0.002), (1.0, 10.0, 10.0, 0.01)],
)
def test_measured_curves(grid_nm: float, width_nm: float, step_nm: float, relative: float, noise: str) -> None:
    wave = np.arange(380.0, 780.1, grid_nm)
    centre = np.arange(400.0, 721.0, step_nm)
    light = np.exp(-0.5 * ((wave - centre[:, None]) * 2.3548 / width_nm) ** 2)
    operator = light * grid_nm
    operator[:, [0, -1]] *= 0.5
    inside = (wave >= 400.0) & (wave <= 720.0)
    names = ("ours", "division", "pseudo-inverse", "Tikhonov, GCV, S >= 0")
    errors: dict[str, list[float]] = {name: [] for name in names}
    bounds, covered, seconds = [], [], []
    for draw in range(DRAWS):
        rng = np.random.default_rng(draw)
        for wavelength, value in curves():
            truth = np.interp(wave, wavelength, value)
            clean = operator @ truth
            std = relative * (clean if noise == "signal" else np.full(clean.size, clean.max()))
            signal = clean + std * rng.standard_normal(std.size)
            begun = time.process_time()
            found = estimate_sensitivity(wave, light, signal, std)
            seconds.append(time.process_time() - begun)
            results = [found.sensitivity, divided(wave, operator, signal), pseudo_inverse(operator, signal)]
            # The peer's GCV takes long on a fine grid: two draws tell its median.
            results += [tikhonov(operator, signal, std)] if draw < 2 else []
            for name, curve in zip(names, results, strict=False):
                rest = (curve - truth)[inside]
                errors[name].append(100.0 * np.sqrt(np.mean(rest**2) / np.mean(truth[inside] ** 2)))
            covered.append(np.mean(np.abs(found.sensitivity - truth)[inside] <= 2.0 * found.std[inside]))
            bounds.append(bound_percent(operator, std, truth, inside))
    ours = errors["ours"]
    rows = []
    for name in names[1:]:
        rows += [
            Row("median", float(np.median(ours)), float(np.median(errors[name])), "%", name),
            Row("max", float(np.max(ours)), float(np.max(errors[name])), "%", name),
        ]
    known = [bound for bound in bounds if bound is not None]
    if known:
        rows += [
            Row("median", float(np.median(ours)), float(np.median(known)), "%", "Cramer-Rao"),
            Row("max", float(np.max(ours)), float(np.max(known)), "%", "Cramer-Rao, of the worst curve"),
        ]
    rows += [
        Row("2-sd band covers", 100.0 * float(np.mean(covered)), 95.4, "%", "a normal law"),
        Row("CPU a curve", float(np.median(seconds)), None, "s"),
    ]
    show(f"{width_nm:g} nm wide every {step_nm:g} nm, {100 * relative:g} % of the {noise}, on {grid_nm:g} nm", rows)
    assert np.median(ours) < np.median(errors["division"]) and np.median(ours) < np.median(
        errors["Tikhonov, GCV, S >= 0"]
    )
    assert 0.93 <= np.mean(covered) <= 0.985
