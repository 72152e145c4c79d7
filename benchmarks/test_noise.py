"""Photon transfer beside EMVA 1288's reference implementation, on the same frames with known truth: accuracy and CPU
time.

The peer is measured in an environment of its own (`.venv-peers`), built on the first run; without it its column is
empty."""

from __future__ import annotations

import json
import os
import subprocess
import time
import venv
from pathlib import Path

import numpy as np
import pytest

from lab.fit.noise.noise_fit import fit_noise
from lab.fit.noise.transfer import fit_transfer
from lab.formats.importers.emva1288 import read_emva1288
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet
from lab.formats.results import NoiseFit

ROOT = Path(__file__).parents[1]
CCD = ROOT.parent / "shared" / "data" / "emva1288_ccd"
PEER = "emva1288==1.0.2"
ROWS, COLS, LEVELS, STACK = 480, 640, 50, 16
GAIN, FULL, READ, BLACK, EFFICIENCY, DARK = 0.5, 7800.0, 3.0, 100.0, 0.5, 20.0
#: Bend of the response and share of the variance that is missing, both at full well: noise 2 % low is variance 4 % low.
CASES = {"ideal": (0.0, 0.0), "1 % nonlinear": (0.01, 0.0), "2 % brighter-fatter": (0.0, 0.04)}
DRAWS = int(os.environ.get("CALIBENCH_BENCH_DRAWS", "8"))
pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


@pytest.fixture(scope="module")
def peer_python() -> Path | None:
    """The Python of the peer's environment; None where it can't be installed."""
    folder = ROOT / ".venv-peers" / PEER.replace("==", "-")
    python = folder / "bin" / "python"
    ready = folder / ".ready"
    if ready.exists():
        return python
    try:
        venv.create(folder, with_pip=True, clear=True)
        command = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", PEER, "numpy<2"]
        subprocess.run(command, check=True, capture_output=True, timeout=600)
    except (OSError, subprocess.SubprocessError) as error:
        print(f"\n{PEER} can't be installed ({error}): its figures are left out")
        return None
    ready.touch()
    return python


class Bench:
    """Frames of one synthetic camera, drawn as they are asked for."""

    def __init__(self, bend: float, fat: float, seed: int) -> None:
        self.bend, self.fat = bend, fat
        self.rng = np.random.default_rng(seed)
        self.dsnu = 1.0 * self.rng.standard_normal((ROWS, COLS), dtype=np.float32)
        self.prnu = 1.0 + 0.005 * self.rng.standard_normal((ROWS, COLS), dtype=np.float32)

    def frame(self, light: float, exposure_s: float) -> np.ndarray:
        mean = FULL * light * self.prnu + DARK * exposure_s
        charge = mean + np.sqrt(mean * (1.0 - self.fat * mean / FULL)) * self.rng.standard_normal(
            (ROWS, COLS), dtype=np.float32
        )
        charge = charge * (1.0 - self.bend * charge / FULL) + self.dsnu
        charge += READ * self.rng.standard_normal((ROWS, COLS), dtype=np.float32)
        return np.clip(np.rint(BLACK + GAIN * charge), 0, 4095).astype(np.uint16)

    def recordings(self) -> RecordingSet:
        captures: list[dict[str, object]] = []
        frames: dict[str, np.ndarray] = {}
        for number, light in enumerate(np.linspace(0.02, 1.05, LEVELS)):
            exposure = 0.02 * float(light)
            repeats = STACK if number == LEVELS // 2 - 1 else 2
            for kind in ("dark", "flat"):
                for _ in range(repeats):
                    name = f"{kind}-{len(captures)}"
                    capture = {"id": name, "kind": kind, "side": "left", "frame": name, "exposure_s": exposure}
                    if kind == "flat":
                        capture |= {"photons_per_pixel": FULL * float(light) / EFFICIENCY, "wavelength_nm": 550.0}
                    captures.append(capture)
                    frames[name] = self.frame(float(light) if kind == "flat" else 0.0, exposure)
        camera = DataSheet(rows=ROWS, cols=COLS, cfa="MONO", bit_depth=12)
        return RecordingSet(Manifest(cameras={"left": camera}, captures=tuple(captures)), frames)


def peer_figures(python: Path, recordings: RecordingSet, folder: Path) -> dict[str, float]:
    """What the reference implementation says of the same frames."""
    plan: dict[str, dict[str, dict[str, list[str]]]] = {"temporal": {}, "spatial": {}}
    for capture in recordings.captures():
        file = folder / f"{capture.id}.npy"
        np.save(file, recordings.frame(capture))
        exposure = repr(round(capture.exposure_s * 1e9))
        photons = repr(getattr(capture, "photons_per_pixel", None) or 0.0)
        plan["temporal"].setdefault(exposure, {}).setdefault(photons, []).append(str(file))
    for exposure, levels in plan["temporal"].items():
        if min(map(len, levels.values())) > 2:
            plan["spatial"][exposure] = {photons: list(files) for photons, files in levels.items()}
            for photons in levels:
                levels[photons] = levels[photons][:2]
    described = folder / "plan.json"
    described.write_text(json.dumps(plan))
    script = ROOT / "benchmarks" / "peers" / "emva1288_reference.py"
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run([python, script, described], check=True, capture_output=True, text=True, env=environment)
    return json.loads(done.stdout.splitlines()[-1])


def bound_percent() -> float:
    """Cramer-Rao bound on K with a free curvature and dark variance: variances of two frames of N pixels are known to v
    sqrt(2 / N)."""
    x = GAIN * FULL * np.linspace(0.02, 1.05, LEVELS)
    x = x[x <= 0.9 * (4095.0 - BLACK)]
    floor = (GAIN * READ) ** 2 + 1.0 / 12.0
    signal = np.concatenate([x, np.zeros(LEVELS)])
    variance = floor + GAIN * signal
    basis = np.stack([signal, signal**2 / 4000.0, np.ones_like(signal)], axis=1)
    design = basis / (variance * np.sqrt(2.0 / (ROWS * COLS)))[:, None]
    return 100.0 * float(np.sqrt(np.linalg.inv(design.T @ design)[0, 0])) / GAIN


def test_gain_beside_the_reference(peer_python: Path | None, tmp_path: Path) -> None:
    print(f"\n{LEVELS} levels of {COLS} x {ROWS}, {DRAWS} draws; Cramer-Rao bound on K {bound_percent():.3f} %")
    print("| case | K here: mean, rms % | stated % | K emva1288: mean, rms % | CPU here, s | CPU emva1288, s |")
    print("| --- | --- | --- | --- | --- | --- |")
    for case, (bend, fat) in CASES.items():
        ours: list[NoiseFit] = []
        theirs: list[dict[str, float]] = []
        seconds = []
        for draw in range(DRAWS):
            recordings = Bench(bend, fat, 100 + draw).recordings()
            for capture in recordings.captures():
                recordings.frame(capture)
            if draw == 0:
                fit_noise(recordings, "left")  # compiles, where no cache is there yet
            began = time.process_time()
            ours.append(fit_noise(recordings, "left"))
            seconds.append(time.process_time() - began)
            if peer_python is not None:
                theirs.append(peer_figures(peer_python, recordings, tmp_path))
        error = 100.0 * (np.array([fit.conversion_gain_dn_per_e for fit in ours], float) / GAIN - 1.0)
        stated = 100.0 * np.mean([fit.conversion_gain_dn_per_e_std or np.nan for fit in ours]) / GAIN
        peer = 100.0 * (np.array([one["conversion_gain_dn_per_e"] for one in theirs]) / GAIN - 1.0)
        told = f"{peer.mean():+.3f}, {np.sqrt(np.mean(peer**2)):.3f}" if theirs else "not installed"
        theirs_s = f"{np.median([one['cpu_s'] for one in theirs]):.2f}" if theirs else "-"
        rms = float(np.sqrt(np.mean(error**2)))
        print(
            f"| {case} | {error.mean():+.3f}, {rms:.3f} | {stated:.3f} | {told} | {np.median(seconds):.2f} | "
            f"{theirs_s} |"
        )
        # An rms over n draws is itself known to 1 / sqrt(2 n); two of these.
        assert rms < 0.1 * (1.0 + 2.0 / np.sqrt(2.0 * DRAWS)), case


def test_gain_is_at_the_bound() -> None:
    """Thousands of draws of what the frames would give: variances by their sampling law, means as they are."""
    draws, rng = 2000, np.random.default_rng(11)
    print(f"\n{draws} draws of the {LEVELS} levels' variances; Cramer-Rao bound on K {bound_percent():.3f} %")
    print("| case | mean error of K, % | rms, % | stated, % | 2-sigma coverage, % |\n| --- | --- | --- | --- | --- |")
    for case, (bend, fat) in CASES.items():
        charge = np.concatenate([np.zeros(LEVELS), FULL * np.linspace(0.02, 1.05, LEVELS)])
        light = np.arange(charge.size) >= LEVELS
        signal = GAIN * charge * (1.0 - bend * charge / FULL)
        slope = 1.0 - 2.0 * bend * charge / FULL
        variance = GAIN**2 * (slope**2 * charge * (1.0 - fat * charge / FULL) + READ**2) + 1.0 / 12.0
        inside = signal < 4095.0 - BLACK - 5.0 * np.sqrt(variance)
        charge, light, signal, variance = (values[inside] for values in (charge, light, signal, variance))
        fits = []
        for _ in range(draws):
            drawn = variance * rng.chisquare(ROWS * COLS - 1, variance.size) / (ROWS * COLS - 1)
            std = drawn * np.sqrt(2.0 / (ROWS * COLS))
            fits.append(fit_transfer(signal, drawn, std, np.zeros(drawn.size, int), light, 4095.0 - BLACK))
        error = 100.0 * (np.array([fit.gain for fit in fits]) / GAIN - 1.0)
        stated = 100.0 * np.array([fit.gain_std for fit in fits]) / GAIN
        rms, covered = float(np.sqrt(np.mean(error**2))), 100.0 * float(np.mean(np.abs(error) < 2.0 * stated))
        print(f"| {case} | {error.mean():+.4f} | {rms:.4f} | {stated.mean():.4f} | {covered:.1f} |")
        assert rms <= 0.1, case
        assert 93.0 <= covered <= 97.0, case


def test_figures_beside_the_reference(peer_python: Path | None, tmp_path: Path) -> None:
    """EMVA 1288's own figures, by the same definitions on the same frames: they agree far better than their
    uncertainties."""
    if peer_python is None:
        pytest.skip(f"{PEER} can't be installed here")
    recordings = Bench(0.0, 0.0, 7).recordings()
    own = fit_noise(recordings, "left").emva1288["Y"]
    peer = peer_figures(peer_python, recordings, tmp_path)
    peer["quantum_efficiency"] = peer.pop("quantum_efficiency_percent") / 100.0
    peer["system_gain_dn_per_e"] = peer.pop("conversion_gain_dn_per_e")
    print("\n| figure | here | ± | emva1288 | off, of its uncertainty |\n| --- | --- | --- | --- | --- |")
    # The peer keeps release 3's approximation, sigma / K + 1/2; release 4 has sqrt(sigma^2 / K^2 + 1/4) + 1/2.
    dark_e = own.temporal_dark_noise_dn / own.system_gain_dn_per_e
    peer["sensitivity_threshold_photons"] += (np.hypot(dark_e, 0.5) - dark_e) / own.quantum_efficiency
    del peer["cpu_s"]
    for name, value in peer.items():
        if not np.isfinite(value):
            continue  # it has the root of a negative variance
        ours, std = getattr(own, name), getattr(own, f"{name}_std")
        assert ours is not None, name
        print(f"| `{name}` | {ours:.6g} | {std:.2g} | {value:.6g} | {(ours - value) / std:+.2f} |")
        # The temporal figures may take more repeats in here than the standard's two: they differ by noise.
        assert abs(ours - value) < 3.0 * std, name


def test_the_reference_set(peer_python: Path | None, tmp_path: Path) -> None:
    """The real CCD of the standard's working group."""
    if not CCD.exists():
        pytest.skip("the shared recordings aren't here")
    recordings = read_emva1288(CCD)
    for capture in recordings.captures():
        recordings.frame(capture)
    fit_noise(recordings, "left")
    began = time.process_time()
    fit = fit_noise(recordings, "left")
    seconds = time.process_time() - began
    own = fit.emva1288["Y"]
    print(
        f"\nK {fit.conversion_gain_dn_per_e:.4f} (by the letter {own.system_gain_dn_per_e:.4f}, at zero signal "
        f"{fit.conversion_gain_at_zero_dn_per_e:.4f} ± {fit.conversion_gain_at_zero_dn_per_e_std:.4f}) DN/e, dark "
        "noise "
        f"{fit.read_noise_e:.2f} e, QE {fit.quantum_efficiency:.4f}, {seconds:.2f} s CPU"
    )
    if peer_python is not None:
        peer = peer_figures(peer_python, recordings, tmp_path)
        print(", ".join(f"{name} {value:.5g}" for name, value in peer.items()))
        assert own.system_gain_dn_per_e == pytest.approx(peer["conversion_gain_dn_per_e"], rel=0.005)
        assert own.prnu_percent == pytest.approx(peer["prnu_percent"], rel=0.01)
