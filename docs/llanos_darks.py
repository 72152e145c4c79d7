"""Makes a folder for `calibench import --from raw-folder` of the dark frames that were published with bllanos/chromatic-aberration:
`python docs/llanos_darks.py DATA OUT` (the day's date in the names says which session: 2019-02-18). Nothing is changed but the place."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

#: What is known of the camera: Point Grey Flea3 with Sony's ICX655AQ, frames down-sampled Bayer-aware to 342 x 408 of 8 bit, so that a
#: pixel's pitch and noise are no more those of the sensor's data sheet.
CAMERA = 'cfa = "GBRG"\nbit_depth = 8\n'


def main(data: Path, out: Path) -> None:
    """Copies the frames and writes `index.csv` and `camera.toml` beside them."""
    out.mkdir(parents=True, exist_ok=True)
    lines = ["frame,kind,side,exposure_s"]
    for file in sorted((data / "dark").glob("d2_dark_*.tif")):
        exposure = re.search(r"_(\d+)ms_", file.name)
        if exposure is None:
            raise SystemExit(f"{file.name}: its name doesn't say how long it was exposed")
        shutil.copy(file, out / file.name)
        lines.append(f"{file.name},dark,left,{int(exposure[1]) / 1000:g}")
    (out / "index.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (out / "camera.toml").write_text(CAMERA, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
