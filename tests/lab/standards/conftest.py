"""A small monochrome recording set whose truth is stated: flats, darks and a slanted edge."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from lab.formats.recording_set import Manifest, RecordingSet
from tests.lab.standards.edges import gaussian_edge

ROWS, COLS = 64, 96
GAIN, BLACK, READ_E, EFFICIENCY, FULL_E, PRNU = 0.5, 64.0, 4.0, 0.6, 7600.0, 0.01
#: Of the edge: levels in electrons of its dark and light side.
EDGE_E = (1000.0, 4000.0)
EDGE_SIGMA_PX = 0.9


def _codes(rng: np.random.Generator, electrons: np.ndarray, variance_loss: float) -> np.ndarray:
    mean = np.minimum(electrons, FULL_E)
    if variance_loss:
        # pixels of thousands of electrons: normal, of a variance that falls behind the mean's as charge repels charge
        shot = np.sqrt(mean * (1.0 - variance_loss * mean / FULL_E)) * rng.standard_normal((ROWS, COLS))
    else:
        shot = rng.poisson(mean) - mean
    noisy = mean + shot + READ_E * rng.standard_normal((ROWS, COLS))
    return np.clip(np.rint(BLACK + GAIN * np.minimum(noisy, FULL_E)), 0, 3800).astype(np.uint16)


def mono_set(
    falloff: float = 0.0, levels: int = 12, repeats: int = 4, seed: int = 1, variance_loss: float = 0.0
) -> RecordingSet:
    """Return a set of `levels` from 2 % of saturation to beyond it, in `repeats`, darks and one edge.

    `falloff`: by how much the light of the flats is lower in the corners than in the middle. `variance_loss`: of the
    shot noise's variance at saturation, as the brighter-fatter effect has it.
    """
    rng = np.random.default_rng(seed)
    pattern = 1.0 + PRNU * rng.standard_normal((ROWS, COLS))
    row, col = np.mgrid[-1 : 1 : ROWS * 1j, -1 : 1 : COLS * 1j]
    light = pattern * (1.0 - falloff * 0.5 * (row**2 + col**2))
    light /= light.mean()
    frames: dict[str, np.ndarray] = {}
    captures: list[dict[str, object]] = []

    def add(kind: str, electrons: np.ndarray, exposure_s: float, **keys: object) -> None:
        name = f"{kind}-{len(captures):03d}"
        frames[f"frames/{name}.npy"] = _codes(rng, electrons, variance_loss)
        captures.append(
            {"id": name, "kind": kind, "side": "left", "frame": f"frames/{name}.npy", "exposure_s": exposure_s} | keys
        )

    for share in [*np.linspace(0.02, 0.9, levels - 2), 1.15, 1.3]:
        for _ in range(repeats):
            add("dark", np.zeros((ROWS, COLS)), 0.01 * share)
            photons = share * FULL_E / EFFICIENCY
            add("flat", EFFICIENCY * photons * light, 0.01 * share, photons_per_pixel=photons, wavelength_nm=530.0)
    edge = gaussian_edge(EDGE_SIGMA_PX, 5.0, (ROWS, COLS), EDGE_E)
    for _ in range(2):
        add("slanted_edge", edge, 0.01, region=[0, 0, ROWS, COLS], angle_deg=5.0, field_mm=[0.0, 0.0])
    camera = {
        "rows": ROWS, "cols": COLS, "pixel_pitch_um": 3.0, "cfa": "MONO", "bit_depth": 12, "black_level_dn": BLACK,
        "white_level_dn": 3800, "f_number": None,
    }  # fmt: skip
    manifest = Manifest.model_validate(
        {
            "format": "calibench-recording", "version": 1, "name": "known camera", "cameras": {"left": camera},
            "captures": captures,
        }
    )  # fmt: skip
    return RecordingSet(manifest, frames)


@pytest.fixture(scope="session")
def make_mono_set() -> Callable[..., RecordingSet]:
    return mono_set
