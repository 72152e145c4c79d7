"""Sensitivities of measured cameras recovered from lights, beside division, the pseudo-inverse, plain Tikhonov, and the
bound.

Twelve curves of four cameras, measured every 5 nm; between the samples, straight lines or a cubic spline. Relative RMS
error over
400..720 nm, of each curve over its draws: median and maximum are over curves. "Signal": noise of 0.2 % of each signal,
as shot noise and radiometer give it; "peak": of the highest signal, at every wavelength.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from benchmarks.peers.tikhonov import divided, pseudo_inverse, tikhonov
from benchmarks.table import Row, show
from lab.fit.spectral import estimate_sensitivity

FOLDER = Path(__file__).parents[2] / "shared" / "data" / "rawtoaces_sensitivities"
DRAWS = int(os.environ.get("CALIBENCH_BENCH_DRAWS", "8"))
pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


def curves() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By camera and channel: wavelengths and values."""
    if not FOLDER.exists():
        pytest.skip("the shared sensitivities aren't here")
    found = {}
    for file in sorted(FOLDER.glob("*.json")):
        rows = json.loads(file.read_text())["spectral_data"]["data"]["main"]
        wavelength = np.array(sorted(map(float, rows)))
        values = np.array([rows[f"{w:.0f}"] for w in wavelength])
        found |= {f"{file.stem} {channel}": (wavelength, values[:, k]) for k, channel in enumerate("RGB")}
    return found


#: Which curves figures are stated over. The red and blue ones of the two Canons, with a spline and noise of the peak,
#: give division errors near those of "four measured Canon curves" that the targets were set beside.
GROUPS = {
    "all": lambda name: True,
    "Canon": lambda name: name.startswith("Canon"),
    "Canon R, B": lambda name: name.startswith("Canon") and name[-1] in "RB",
}


def bound_percent(operator: np.ndarray, std: np.ndarray, truth: np.ndarray, inside: np.ndarray) -> float | None:
    """Cramer-Rao: the least relative RMS that an unbiased estimate without a prior can have, the curve beyond the
    lights known. None where the lights don't determine it (fewer lights than wavelengths)."""
    scaled = operator[:, inside] / std[:, None]
    if scaled.shape[0] < scaled.shape[1]:
        return None
    variance = np.diag(np.linalg.inv(scaled.T @ scaled))
    return float(100.0 * np.sqrt(variance.mean() / np.mean(truth[inside] ** 2)))


@pytest.mark.parametrize("noise", ["signal", "peak"])
@pytest.mark.parametrize(
    ("grid_nm", "between", "width_nm", "relative"),
    [
        (5.0, "", 5.0, 0.002),
        (1.0, "lines", 5.0, 0.002),
        (1.0, "spline", 5.0, 0.002),
        (1.0, "lines", 10.0, 0.002),
        (1.0, "spline", 10.0, 0.002),
        (1.0, "spline", 10.0, 0.01),
    ],
)
def test_measured_curves(grid_nm: float, between: str, width_nm: float, relative: float, noise: str) -> None:
    wave = np.arange(380.0, 780.1, grid_nm)
    centre = np.arange(400.0, 721.0, width_nm)
    light = np.exp(-0.5 * ((wave - centre[:, None]) * 2.3548 / width_nm) ** 2)
    operator = light * grid_nm
    operator[:, [0, -1]] *= 0.5
    inside = (wave >= 400.0) & (wave <= 720.0)
    names = ("ours", "division", "pseudo-inverse", "Tikhonov, GCV, S >= 0")
    squares: dict[str, dict[str, list[float]]] = {name: {} for name in names}
    bounds, covered, seconds = {}, [], []
    for curve, (wavelength, value) in curves().items():
        truth = np.interp(wave, wavelength, value)
        if between == "spline":
            truth = np.clip(CubicSpline(wavelength, value)(wave), 0.0, None)
        clean = operator @ truth
        std = relative * (clean if noise == "signal" else np.full(clean.size, clean.max()))
        bounds[curve] = bound_percent(operator, std, truth, inside)
        for draw in range(DRAWS):
            signal = clean + std * np.random.default_rng(draw).standard_normal(std.size)
            begun = time.process_time()
            found = estimate_sensitivity(wave, light, signal, std)
            seconds.append(time.process_time() - begun)
            results = [found.sensitivity, divided(wave, operator, signal), pseudo_inverse(operator, signal)]
            # The peer's GCV takes long on a fine grid: two draws tell its median.
            results += [tikhonov(operator, signal, std)] if draw < 2 else []
            for name, estimate in zip(names, results, strict=False):
                rest = (estimate - truth)[inside]
                squares[name].setdefault(curve, []).append(float(np.mean(rest**2) / np.mean(truth[inside] ** 2)))
            covered.append(np.mean(np.abs(found.sensitivity - truth)[inside] <= 2.0 * found.std[inside]))
    errors = {
        name: {curve: 100.0 * float(np.sqrt(np.mean(own))) for curve, own in of.items()} for name, of in squares.items()
    }
    rows = []
    for group, belongs in GROUPS.items():
        ours = [error for curve, error in errors["ours"].items() if belongs(curve)]
        peers = {name: [error for curve, error in errors[name].items() if belongs(curve)] for name in names[1:]}
        known = [bound for curve, bound in bounds.items() if belongs(curve) and bound is not None]
        peers |= {"Cramer-Rao, without a prior": known} if known else {}
        for name, theirs in peers.items():
            rows += [
                Row(f"{group}: median", float(np.median(ours)), float(np.median(theirs)), "%", name),
                Row(f"{group}: max", max(ours), max(theirs), "%", name),
            ]
    worst = 100.0 * float(np.sqrt(max(max(own) for own in squares["ours"].values())))
    rows += [
        Row("worst single draw of all", worst, None, "%"),
        Row("2-sd band covers", 100.0 * float(np.mean(covered)), 95.4, "%", "a normal law"),
        Row("CPU a curve", float(np.median(seconds)), None, "s"),
    ]
    grid = f"on {grid_nm:g} nm" + (f" ({between})" if between else "")
    show(f"{width_nm:g} nm wide every {width_nm:g} nm, {100 * relative:g} % of the {noise}, {grid}", rows)
    median = {name: np.median(list(of.values())) for name, of in errors.items()}
    assert median["ours"] < median["division"]
    # A spline is the curve of least second difference through its samples: what plain Tikhonov takes for granted, and
    # smoother than a measured curve. There it is hardly to be beaten, and bands may be too wide.
    assert median["ours"] < (1.1 if between == "spline" else 1.0) * median["Tikhonov, GCV, S >= 0"]
    assert 0.93 <= np.mean(covered) <= (1.0 if between == "spline" else 0.985)
