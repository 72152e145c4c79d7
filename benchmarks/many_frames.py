"""A recording set of many frames: what the memory and the time of a diagnosis are measured on.

`python -m benchmarks.many_frames write FOLDER [SIDE_PX [REPEATS]]` writes it: one camera without a mosaic, darks of
three exposures with `DARK_REPEATS` frames each and flats of ten levels with `FLAT_REPEATS` frames each (REPEATS: this
share of them). `python -m benchmarks.many_frames diagnose FOLDER` diagnoses it in this process and prints CPU time and
peak memory by step.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from lab.diagnose.side import diagnose_side
from lab.formats import recording_set as recording
from lab.formats.recording_set import Manifest
from sim.camera import CameraModel, Lens
from sim.frame import Exposure, dark_electrons, expected_electrons
from sim.scene.scenes import Darkness, UniformField
from sim.sensor.electrons import FixedPattern, sample_from
from sim.spectrum import Spectrum
from sim.uniform import electron_rate

SIDE_PX = 1024
DARK_S, DARK_REPEATS = (0.001, 0.1, 1.0), 100
LEVELS, FLAT_REPEATS = (0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9), 30  # shares of saturation


def camera(side_px: int = SIDE_PX) -> CameraModel:
    """A camera of 12 bits without a mosaic, `side_px` rows and columns."""
    return CameraModel(
        rows=side_px, cols=side_px, pixel_pitch_um=3.45, fill_factor=0.9, cfa="MONO", bit_depth=12, black_level_dn=64.0,
        white_level_dn=4095.0, conversion_gain_dn_per_e=0.4, full_well_e=10500.0, read_noise_e=4.0,
        dark_current_e_per_s=8.0, dsnu_e=1.0, prnu_percent=0.7,
        quantum_efficiency={"Y": Spectrum.of([400.0, 700.0], [0.5, 0.5])},
        lens=Lens(f_number=4.0, focal_length_mm=25.0),
    )  # fmt: skip


def write(folder: Path, side_px: int = SIDE_PX, repeats: float = 1.0) -> None:
    """Write the set; darks and flats have the share `repeats` of their usual number of repeats."""
    model, light = camera(side_px), Spectrum.of([400.0, 700.0], [0.01, 0.01])
    rng = np.random.default_rng(1288)
    pattern = FixedPattern.draw(model, rng)
    full_s = (
        (model.white_level_dn - model.black_level_dn)
        / model.conversion_gain_dn_per_e
        / electron_rate(model, "Y", light)
    )
    settings = [("dark", t, round(DARK_REPEATS * repeats)) for t in DARK_S]
    settings += [("flat", share * full_s, round(FLAT_REPEATS * repeats)) for share in LEVELS]
    (folder / "frames").mkdir(parents=True)
    captures: list[dict[str, Any]] = []
    for kind, exposure_s, count in settings:
        exposure = Exposure(Darkness() if kind == "dark" else UniformField(light, "flat"), exposure_s)
        electrons = expected_electrons(model, exposure)
        for _ in range(count):
            path = f"frames/{len(captures):03d}.npy"
            frame = sample_from(electrons, model, rng, pattern, dark_electrons=dark_electrons(model, exposure))
            np.save(folder / path, frame)
            one = {
                "id": f"{kind}-{len(captures):03d}",
                "kind": kind,
                "side": "left",
                "frame": path,
                "exposure_s": exposure_s,
            }
            captures.append(one | ({"radiance": "lamp.csv"} if kind == "flat" else {}))
    for path, curve in (("lamp.csv", light), ("efficiency.csv", model.quantum_efficiency["Y"])):
        rows = zip(curve.wavelength_nm, curve.value, strict=True)
        (folder / path).write_text("wavelength_nm,value\n" + "".join(f"{w:g},{v:g}\n" for w, v in rows))
    stated = model.model_dump(include={
        "rows", "cols", "pixel_pitch_um", "fill_factor", "cfa", "bit_depth", "black_level_dn", "white_level_dn",
        "full_well_e", "conversion_gain_dn_per_e", "read_noise_e",
    })  # fmt: skip
    stated |= {"f_number": 4.0, "focal_length_mm": 25.0, "quantum_efficiency": {"Y": "efficiency.csv"}}
    manifest = Manifest.model_validate({"cameras": {"left": stated}, "captures": captures})
    (folder / "manifest.json").write_text(recording.manifest_json(manifest))


def peak_bytes() -> int:
    """The most memory that this process has held."""
    line = next(one for one in Path("/proc/self/status").read_text().splitlines() if one.startswith("VmHWM"))
    return int(line.split()[1]) << 10


def diagnose(folder: Path) -> None:
    """Diagnose the set and print every step when it begins: CPU time so far and peak memory."""

    def report(step: str) -> None:
        print(f"{time.process_time():8.1f} CPU s  {peak_bytes() / 2**30:5.2f} GiB  {step}", flush=True)

    report("reading")
    recordings = recording.read(folder)
    found = diagnose_side(recordings, "left", None, None, report)
    named = ", ".join(one.candidate.name for one in found.named)
    report(f"done: {named or 'no effect'} named, {len(found.lists.mismatches)} mismatches")


if __name__ == "__main__":
    if sys.argv[1] == "write":
        write(Path(sys.argv[2]), *(int(v) for v in sys.argv[3:4]), *(float(v) for v in sys.argv[4:5]))
    else:
        diagnose(Path(sys.argv[2]))
