"""Healthy sessions of the forward model itself, each of another camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evaluation.rig_errors import RigErrors
from lab.diagnose.reference_study import WAVELENGTH_NM, reference_camera, reference_study
from lab.formats.recording_set import RecordingSet
from sim.camera import Cfa, Lens
from sim.scene import colorchecker
from sim.spectrum import Spectrum


def healthy_session(seed: Sequence[int]) -> RecordingSet:
    """Return the session of a camera whose mosaic, depth, gain, noise and aperture are drawn, at a rig whose chart and
    radiometer are wrong within their tolerances."""
    rng = np.random.default_rng(seed)
    camera = reference_camera()
    bits = int(rng.choice([10, 12, 14]))
    white_dn, black_dn = float(2**bits - 1), float(round(2.0**bits * rng.uniform(0.01, 0.05)))
    full_well_e = float(rng.uniform(6e3, 4e4))
    mosaics: tuple[Cfa, ...] = ("RGGB", "BGGR", "GRBG", "GBRG")
    drawn = camera.model_copy(
        update={
            "cfa": mosaics[int(rng.integers(len(mosaics)))],
            "bit_depth": bits,
            "white_level_dn": white_dn,
            "black_level_dn": black_dn,
            "full_well_e": full_well_e,
            "conversion_gain_dn_per_e": 0.98 * (white_dn - black_dn) / full_well_e,
            "read_noise_e": float(np.exp(rng.uniform(np.log(1.5), np.log(12.0)))),
            "dark_current_doubling_c": None,  # of a healthy camera it stays: its change is an effect
            "dark_current_e_per_s": float(np.exp(rng.uniform(np.log(1.0), np.log(60.0)))),
            "dsnu_e": float(rng.uniform(0.3, 3.0)),
            "prnu_percent": float(rng.uniform(0.2, 1.0)),
            "lens": Lens(f_number=float(rng.choice([2.8, 4.0, 5.6])), focal_length_mm=camera.lens.focal_length_mm),
        }
    )
    rig = RigErrors(*seed)
    published = np.array([patch.at(WAVELENGTH_NM) for patch in colorchecker.reflectances("ColorChecker24").values()])
    own = tuple(Spectrum.of(WAVELENGTH_NM, patch) for patch in rig.reflectances(WAVELENGTH_NM, published))
    return reference_study(int(rng.integers(2**31)), drawn, reflectances=own, reading=rig.reading)
