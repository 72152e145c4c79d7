"""EMVA 1288's reference implementation on one set of frames, in an environment of its own: it needs numpy < 2.

`python emva1288_reference.py PLAN.json` prints JSON. The plan: `{"temporal": {"EXPOSURE_NS": {"PHOTONS": [FILE.npy,
FILE.npy]}}, "spatial": ...}`, photons 0 for darks. Reading isn't in the time.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from pathlib import Path

import numpy as np
from emva1288.process.data import Data1288
from emva1288.process.loader import LoadImageData
from emva1288.process.results import Results1288

FIGURES = {
    "conversion_gain_dn_per_e": "K",
    "responsivity_dn_per_photon": "R",
    "quantum_efficiency_percent": "QE",
    "temporal_dark_noise_e": "sigma_d",
    "sensitivity_threshold_photons": "u_p_min",
    "saturation_capacity_photons": "u_p_sat",
    "dsnu_e": "DSNU1288",
    "dsnu_row_e": "DSNU1288_row",
    "dsnu_column_e": "DSNU1288_col",
    "dsnu_pixel_e": "DSNU1288_pixel",
    "prnu_percent": "PRNU1288",
    "prnu_row_percent": "PRNU1288_row",
    "prnu_column_percent": "PRNU1288_col",
    "prnu_pixel_percent": "PRNU1288_pixel",
    "dark_current_from_mean_e_per_s": "u_I_mean",
    "dark_current_from_variance_e_per_s": "u_I_var",
}


def main(plan_file: str) -> None:
    plan = json.loads(Path(plan_file).read_text())
    images = {
        kind: {
            float(exposure): {float(photons): files for photons, files in levels.items()}
            for exposure, levels in exposures.items()
        }
        for kind, exposures in plan.items()
    }
    frames = {
        file: np.load(file)
        for exposures in images.values()
        for levels in exposures.values()
        for files in levels.values()
        for file in files
    }
    began = time.process_time()
    loaded = LoadImageData(images, fload=frames.__getitem__, loglevel=logging.WARNING)
    results = Results1288(Data1288(loaded.data, loglevel=logging.WARNING).data, loglevel=logging.WARNING)
    with np.errstate(invalid="ignore"):
        found = {name: float(np.asarray(getattr(results, attribute)).item()) for name, attribute in FIGURES.items()}
    found["cpu_s"] = time.process_time() - began
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1])
