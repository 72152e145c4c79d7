"""A camera of known quantum efficiency, and its data sheet."""

from __future__ import annotations

import numpy as np

from lab.formats.recording_set import DataSheet
from sim.camera import CameraModel, Lens
from sim.spectrum import Spectrum

WAVE = np.arange(380.0, 761.0, 2.0)
PEAKS = {"R": (600.0, 40.0, 0.45), "G": (535.0, 38.0, 0.5), "B": (455.0, 30.0, 0.4)}


def model() -> CameraModel:
    return CameraModel(
        rows=96,
        cols=128,
        pixel_pitch_um=4.0,
        fill_factor=0.8,
        cfa="RGGB",
        bit_depth=12,
        black_level_dn=64.0,
        white_level_dn=4095,
        conversion_gain_dn_per_e=0.4,
        full_well_e=20000.0,
        read_noise_e=3.0,
        dark_current_e_per_s=10.0,
        dsnu_e=1.0,
        prnu_percent=0.5,
        quantum_efficiency={
            c: Spectrum.of(WAVE, 0.02 + h * np.exp(-0.5 * ((WAVE - p) / w) ** 2)) for c, (p, w, h) in PEAKS.items()
        },
        lens=Lens(f_number=4.0, focal_length_mm=6.0, transmittance=0.9),
    )


def stated(**changes: object) -> DataSheet:
    m = model()
    known = {
        "rows": m.rows,
        "cols": m.cols,
        "pixel_pitch_um": m.pixel_pitch_um,
        "fill_factor": m.fill_factor,
        "cfa": m.cfa,
        "bit_depth": m.bit_depth,
        "f_number": m.lens.f_number,
        "focal_length_mm": m.lens.focal_length_mm,
        "lens_transmittance": m.lens.transmittance,
    }
    return DataSheet(**(known | changes))
