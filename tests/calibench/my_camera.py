"""A folder of raw frames as a user has it: darks, flats and edges of one camera, with an index and a camera file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import calibench

#: Of the camera of `simulate`, which nobody changes here.
GAIN_DN_PER_E = 0.38
SHEET = """cfa = "RGGB"
bit_depth = 12
black_level_dn = 64
white_level_dn = 4095
pixel_pitch_um = 3.45
fill_factor = 1.0
f_number = 4.0
focal_length_mm = 8.0
"""


def make_folder(folder: Path) -> Path:
    """Write the frames, 240 x 320 px, `index.csv` and `camera.toml`; returns the folder."""
    folder.mkdir(parents=True)
    default = calibench.default_camera()
    camera = replace(default, camera=default.camera.model_copy(update={"rows": 240, "cols": 320}))
    lines = ["frame,kind,side,exposure_s"]
    dark = {"luminance_cd_m2": 0.0}
    takes = [("dark", "uniform", s, 4, dark) for s in (0.01, 1.0)]
    takes += [("flat", "uniform", s, 4, {}) for s in (0.01, 0.02, 0.04, 0.06)]
    takes.append(("slanted_edge", "slanted-edge", 0.06, 2, {}))
    for kind, scene, exposure_s, repeats, light in takes:
        for _ in range(repeats):
            name, seed = f"{len(lines):02d}-{kind}.npy", len(lines)
            frame = calibench.simulate(scene, camera, exposure_s=exposure_s, seed=seed, progress=False, **light)
            calibench.write_frame(frame, folder / name)
            lines.append(f"{name},{kind},left,{exposure_s}")
    (folder / "index.csv").write_text("\n".join(lines) + "\n")
    (folder / "camera.toml").write_text(SHEET)
    return folder
