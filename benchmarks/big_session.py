"""A whole session of two cameras of 1280 x 960, written as a recording set: what the fits' time and memory are measured
on.

`python -m benchmarks.big_session FOLDER`. The mock bench with cameras of twice the pixels behind lenses of twice the
focal length, so that its targets stand where they stood in the frame, and every sequence of a full calibration: some
190 frames of each camera."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import mocks.bench
import mocks.conceal
import mocks.truth
from lab.capture.plan import full_plan
from lab.capture.station import Station
from lab.capture_kinds.base import Capture, FindExposure, FixedExposure, RelativeExposure, Step
from lab.formats.recording_set import Manifest
from sim.camera import Geometry, Side
from sim.sensor.electrons import FixedPattern
from sim.spectrum import Spectrum

SCALE = 2
ROWS, COLS = SCALE * mocks.truth.ROWS, SCALE * mocks.truth.COLS


def enlarged(camera: mocks.truth.HiddenCamera, rng: np.random.Generator) -> mocks.truth.HiddenCamera:
    """The same camera with `SCALE` times the rows, columns and focal length."""
    model, (fx, fy, centre) = camera.model, np.array(camera.geometry.camera_matrix)
    matrix = SCALE * np.array([fx, fy, centre])
    matrix[:2, 2] += 0.5 * (SCALE - 1)
    matrix[2] = centre
    focal_mm = SCALE * (model.lens.focal_length_mm or 0.0)
    larger = model.model_copy(
        update={
            "rows": ROWS,
            "cols": COLS,
            "lens": model.lens.model_copy(update={"focal_length_mm": focal_mm}),
            "geometry": Geometry(
                camera_matrix=tuple(map(tuple, matrix.tolist())), distortion=camera.geometry.distortion
            ),
        }
    )
    known = dict(camera.datasheet) | {"rows": ROWS, "cols": COLS, "focal_length_mm": focal_mm}
    return replace(camera, model=larger, pattern=FixedPattern.draw(larger, rng), datasheet=known)


def bench() -> mocks.bench.Bench:
    """The mock bench with the enlarged cameras."""
    made = mocks.bench.Bench()
    rng = np.random.default_rng(0)
    cameras = {side: enlarged(camera, rng) for side, camera in made._truth.cameras.items()}
    made._truth = mocks.truth.Truth(cameras)
    return made


class Session:
    """Takes a calibration's steps on a bench in this process, and keeps frames and spectra on disk."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.bench = bench()
        self.found: dict[tuple[str, Side], float] = {}
        self.captures: list[Capture] = []
        for name in ("frames", "spectra", "targets"):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def run(self) -> None:
        def entry(name: str) -> dict[str, str]:
            return {"driver": "none", "address": name}

        sheets = self.bench.station_cameras()
        station = Station.model_validate(
            {name: entry(name) for name in ("monochromator", "spectroradiometer", "display", "stage")}
            | {"cameras": {side: entry(side) | {"datasheet": sheet} for side, sheet in sheets.items()}}
            | {"targets": self.bench.station_targets()}
        )
        calibration = full_plan(station)
        self.patterns = calibration.patterns(station)
        for path, cells in self.patterns.items():
            np.save(self.folder / path, cells)
        for step in calibration.steps(station):
            self._take(step)
        cameras = {}
        for side, sheet in sheets.items():
            curves = {channel: f"spectra/maker-{channel}.csv" for channel in sheet["quantum_efficiency"]}
            for channel, path in curves.items():
                self._keep_spectrum(path, Spectrum.of(**sheet["quantum_efficiency"][channel]))
            cameras[side] = sheet | {"quantum_efficiency": curves}
        manifest = Manifest.model_validate({"cameras": cameras, "captures": self.captures})
        (self.folder / "manifest.json").write_text(manifest.model_dump_json(exclude_none=True))

    def _take(self, step: Step) -> None:
        self._set(step)
        if step.radiance is not None:
            self._keep_spectrum(step.radiance, self.bench.radiance())
        if isinstance(step.exposure, FindExposure):
            for side in mocks.conceal.SIDES:
                self.found[step.id, side] = self._find(side, step.exposure.level)
        exposure_s = {side: self._exposure_s(step, side) for side in mocks.conceal.SIDES}
        taken: dict[str, float] = {}
        for capture in step.captures:
            if capture.frame not in taken:
                np.save(self.folder / capture.frame, frame := self.bench.expose(capture.side, exposure_s[capture.side]))
                assert frame.shape == (ROWS, COLS)
                taken[capture.frame] = self.bench.sensor_temperature_c(capture.side)
            known = {"exposure_s": exposure_s[capture.side], "temperature_c": taken[capture.frame]}
            self.captures.append(capture.model_copy(update=known))

    def _set(self, step: Step) -> None:
        wanted = step.setting
        if wanted.target is not None:
            self.bench.place(wanted.target)
        self.bench.set_shutter(wanted.wavelength_nm is not None)
        self.bench.set_wavelength(wanted.wavelength_nm or 0.0)
        self.bench.show(self.patterns[wanted.pattern] if wanted.pattern is not None else None, wanted.cell_px)

    def _find(self, side: Side, level: float) -> float:
        """The exposure at which the brightest channel reaches `level` of its range, from trials that don't saturate."""
        camera = self.bench.station_cameras()[side]
        black, white = camera["black_level_dn"], camera["white_level_dn"]
        exposure_s = 1e-4
        for _ in range(30):
            frame = self.bench.expose(side, exposure_s).astype(float)
            reached = max(
                float(np.percentile(frame[row::2, col::2], 99.0)) - black for row in range(2) for col in range(2)
            )
            share = reached / (white - black)
            if share > 0.9:
                exposure_s /= 8.0
            elif abs(share - level) < 0.03:
                return exposure_s
            else:
                exposure_s = min(exposure_s * level / max(share, 0.05 * level), 20.0)
        return exposure_s

    def _exposure_s(self, step: Step, side: Side) -> float:
        if isinstance(step.exposure, FixedExposure):
            return step.exposure.exposure_s
        if isinstance(step.exposure, RelativeExposure):
            return self.found[step.exposure.of, side] * step.exposure.factor
        return 0.0

    def _keep_spectrum(self, path: str, spectrum: Spectrum) -> None:
        rows = zip(spectrum.wavelength_nm, spectrum.value, strict=True)
        lines = "".join(f"{wavelength:g},{value:.6g}\n" for wavelength, value in rows)
        (self.folder / path).write_text("wavelength_nm,value\n" + lines)


if __name__ == "__main__":
    Session(Path(sys.argv[1])).run()
