"""Makes folders for `calibench import --from raw-folder` of what was published with bllanos/chromatic-aberration (a
Flea3 before a ColorChecker behind band-pass filters, 2019-02-18): `python docs/convert_llanos.py DATA OUT` writes
OUT/darks, the dark frames as they are, and OUT/white, the chart's white patch cut out of the frames behind every
filter, and the same pixels of the dark frames."""

from __future__ import annotations

import csv
import re
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np

#: What is known of the camera: Point Grey Flea3 with Sony's ICX655AQ, frames down-sampled Bayer-aware to 342 x 408 of 8
#: bit, so that a pixel's pitch and noise are no more those of the sensor's data sheet.
CAMERA = 'cfa = "GBRG"\nbit_depth = 8\n'
#: Of the white patch (label 19), a margin of it left out; even, so that the mosaic starts as the frame's does.
WHITE = np.s_[200:236, 54:92]
#: The filter that is called so in the frames' names, by its name among the measured spectra.
MEASURED_AS = {450: "442 nm"}


def darks(data: Path, out: Path) -> None:
    """The dark frames as they are, with `index.csv` and `camera.toml` beside them."""
    out.mkdir(parents=True, exist_ok=True)
    lines = ["frame,kind,side,exposure_s"]
    for file in sorted((data / "dark").glob("d2_dark_*.tif")):
        shutil.copy(file, out / file.name)
        lines.append(f"{file.name},dark,left,{_exposure_s(file):g}")
    _write(out, lines)


def white(data: Path, out: Path) -> None:
    """The white patch behind every filter as narrowband light, with the filters' measured transmittance for its
    spectrum: of the lamp nothing is known, so its level means nothing."""
    out.mkdir(parents=True, exist_ok=True)
    lines = ["frame,kind,side,exposure_s,wavelength_nm,radiance"]
    for file in sorted((data / "dark").glob("d2_dark_*.tif")):
        lines.append(f"{_cut(file, out)},dark,left,{_exposure_s(file):g},,")
    with (data / "spectra" / "spectra_averaged.csv").open(newline="", encoding="utf-8") as text:
        measured = list(csv.DictReader(text))
    for file in sorted((data / "frames").glob("*.tif")):
        named_nm = int(re.findall(r"_(\d+)nm_", file.name)[0])
        column = MEASURED_AS.get(named_nm, f"{named_nm} nm")
        rows = [
            f"{w},{max(float(t), 0.0):g}"
            for w, t in ((row["Wavelength"], row[column]) for row in measured)
            if 380 <= int(w) <= 780
        ]
        (out / f"{named_nm}nm.csv").write_text("\n".join(["wavelength_nm,value", *rows]) + "\n", encoding="utf-8")
        lines.append(f"{_cut(file, out)},narrowband,left,{_exposure_s(file):g},{named_nm},{named_nm}nm.csv")
    _write(out, lines)


def _exposure_s(file: Path) -> float:
    return int(re.findall(r"_(\d+)ms_", file.name)[0]) / 1000.0


def _cut(file: Path, out: Path) -> str:
    cv2.imwrite(str(out / file.name), cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[WHITE])
    return file.name


def _write(out: Path, lines: list[str]) -> None:
    (out / "index.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (out / "camera.toml").write_text(CAMERA, encoding="utf-8")


if __name__ == "__main__":
    darks(Path(sys.argv[1]), Path(sys.argv[2]) / "darks")
    white(Path(sys.argv[1]), Path(sys.argv[2]) / "white")
