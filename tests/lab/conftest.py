"""A small recording set that holds every kind of capture, for the tests of `lab`."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lab.capture.store import Store
from lab.formats.recording_set import Manifest, RecordingSet, write
from sim.spectrum import Spectrum

ROWS, COLS = 24, 32


def _small(seed: int = 1, sides: tuple[str, ...] = ("left", "right")) -> RecordingSet:
    rng = np.random.default_rng(seed)
    frames: dict[str, np.ndarray[Any, Any]] = {}
    captures: list[dict[str, Any]] = []

    def add(kind: str, side: str, mean_dn: float, **keys: Any) -> None:
        number = len(captures)
        path = f"frames/{kind}-{number:03d}.{'tif' if number % 5 == 4 else 'npy'}"
        frames[path] = np.clip(rng.normal(mean_dn, 5.0, (ROWS, COLS)), 0, 4095).round().astype(np.uint16)
        captures.append(
            {
                "id": f"{kind}-{number:03d}",
                "kind": kind,
                "side": side,
                "frame": path,
                "exposure_s": keys.pop("exposure_s", 0.01),
                "time": f"2026-03-02T09:00:{number:02d}Z",
            }
            | keys
        )

    screen = {"pose": "p0", "cell_camera_px": 4.0, "radiance": "spectra/lamp.csv"}
    for side in sides:
        for _ in range(2):
            add("dark", side, 64, temperature_c=25.0)
            for level in range(1, 6):
                add("flat", side, 64 + 700 * level, exposure_s=0.002 * level, radiance="spectra/lamp.csv", gain_db=0.0)
        add("narrowband", side, 900, wavelength_nm=550, bandwidth_nm=10, radiance="spectra/nb550.csv")
        add(
            "chart",
            side,
            900,
            chart="ColorChecker24",
            corners=[[2, 2], [2, 29], [21, 29], [21, 2]],
            radiance="spectra/lamp.csv",
        )
        add(
            "slanted_edge",
            side,
            900,
            region=[2, 2, 22, 30],
            angle_deg=5.0,
            light_radiance="spectra/lamp.csv",
            field_mm=[0, 0],
        )
        add("white", side, 2000, screen=screen)
        add("black", side, 70, screen=screen)
        add("checkerboard", side, 1000, screen=screen, target="targets/checkerboard.npy")
        add("bernoulli", side, 1000, screen=screen, target="targets/bernoulli.npy")
        add(
            "charuco",
            side,
            1000,
            dictionary="DICT_4X4_50",
            squares=[6, 8],
            square_mm=20.0,
            marker_mm=15.0,
            pose="pose-1",
        )
    camera = {
        "rows": ROWS,
        "cols": COLS,
        "pixel_pitch_um": 3.0,
        "fill_factor": 0.9,
        "cfa": "RGGB",
        "bit_depth": 12,
        "black_level_dn": 64.0,
        "white_level_dn": 4095,
        "conversion_gain_dn_per_e": None,
        "quantum_efficiency": {channel: f"spectra/qe_{channel}.csv" for channel in "RGB"},
        "f_number": 4.0,
        "focal_length_mm": 6.0,
        "lens_transmittance": 0.9,
    }
    wavelength_nm = np.arange(400.0, 701.0, 10.0)
    spectra = {"spectra/lamp.csv": Spectrum.of(wavelength_nm, 1e-4 * rng.random(31))}
    spectra["spectra/nb550.csv"] = Spectrum.of([540, 550, 560], [0.0, 1 / 3e4, 0.0])
    spectra |= {f"spectra/qe_{channel}.csv": Spectrum.of(wavelength_nm, rng.random(31)) for channel in "RGB"}
    targets = {
        name: rng.integers(0, 2, (7, 9), dtype=np.uint8)
        for name in ("targets/checkerboard.npy", "targets/bernoulli.npy")
    }
    manifest = Manifest.model_validate(
        {
            "format": "calibench-recording",
            "version": 1,
            "name": "small",
            "notes": "ü",
            "cameras": dict.fromkeys(sides, camera),
            "captures": captures,
        }
    )
    return RecordingSet(manifest, frames, spectra, targets, source="small set")


@pytest.fixture
def small_set() -> Callable[..., RecordingSet]:
    """`small_set(seed=1, sides=("left", "right"))`: every kind of capture, frames of noise."""
    return _small


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """An empty store in the test's folder `data`."""
    opened = Store(tmp_path / "data")
    yield opened
    opened.close()


@pytest.fixture
def flats(tmp_path: Path) -> Path:
    """A MONO camera of 0.5 DN/e: darks and a series of flats, small and quick to fit."""
    rng = np.random.default_rng(7)
    frames, captures = {}, []
    for number, (kind, photons) in enumerate(
        [("dark", 0)] * 4 + [("flat", 800 * k) for k in range(1, 8) for _ in range(2)]
    ):
        electrons = rng.poisson(photons, (60, 80)) + rng.normal(0, 4, (60, 80))
        frames[f"frames/{number}.npy"] = np.clip(100 + 0.5 * electrons, 0, 4095).round().astype(np.uint16)
        light = {"photons_per_pixel": 2 * photons, "wavelength_nm": 530} if kind == "flat" else {}
        captures.append(
            {
                "id": f"{kind}-{number}",
                "kind": kind,
                "side": "left",
                "frame": f"frames/{number}.npy",
                "exposure_s": 0.01,
            }
            | light
        )
    camera = {"rows": 60, "cols": 80, "cfa": "MONO", "bit_depth": 12, "black_level_dn": 100}
    manifest = Manifest.model_validate({"name": "flats", "cameras": {"left": camera}, "captures": captures})
    return write(RecordingSet(manifest, frames), tmp_path / "flats")
