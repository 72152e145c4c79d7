"""ISETCam's sensor file: read by SciPy, its numbers by ISETCam's own laws (pixelGet, signalCurrent, analog2digital)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat

from lab import cli
from lab.formats.camera_file import CameraFile, default_camera, write_camera
from lab.formats.isetcam_sensor import write_isetcam
from sim.effects.vignetting import Vignetting

CAMERA = default_camera()


def written(folder: Path, content: CameraFile) -> tuple[Any, tuple[str, ...]]:
    remarks = write_isetcam(folder / "s.mat", content)
    return loadmat(folder / "s.mat", simplify_cells=True)["sensor"], remarks


def test_a_sensors_electrons_and_codes_are_the_cameras(tmp_path: Path) -> None:
    camera = CAMERA.camera.model_copy(update={"fill_factor": 0.64})
    sensor, remarks = written(tmp_path, replace(CAMERA, camera=camera))
    pixel = sensor["pixel"]
    assert (sensor["type"], pixel["type"]) == ("sensor", "pixel")
    assert (sensor["rows"], sensor["cols"]) == (960, 1280)
    # pixelGet: fill factor, dark electrons, read noise electrons
    assert pixel["pdWidth"] * pixel["pdHeight"] / (pixel["width"] * pixel["height"]) == pytest.approx(0.64)
    assert pixel["pdXpos"] * 2 + pixel["pdWidth"] == pytest.approx(3.45e-6)
    assert pixel["darkVoltage"] / pixel["conversionGain"] == pytest.approx(camera.dark_current_e_per_s)
    assert pixel["readNoise"] / pixel["conversionGain"] == pytest.approx(camera.read_noise_e)
    assert sensor["sigmaOffsetFPN"] / pixel["conversionGain"] == pytest.approx(camera.dsnu_e)
    assert sensor["columnFPN"] / pixel["conversionGain"] == pytest.approx([camera.column_noise_e, 0.0])
    assert sensor["sigmaGainFPN"] == camera.prnu_percent
    # analog2digital: the step is the voltage swing over 2^bits
    step_v = pixel["voltageSwing"] / 2 ** sensor["quantization"]["bits"]
    codes = (1000.0 * pixel["conversionGain"] + sensor["analogOffset"]) / sensor["analogGain"] / step_v
    assert codes == pytest.approx(camera.black_level_dn + 1000.0 * camera.conversion_gain_dn_per_e)
    # the electrons of an even spectrum: filters x photodetector, both by wavelength
    wavelength_nm = sensor["spectrum"]["wave"]
    assert np.all(np.diff(wavelength_nm) == 5.0) and np.all(pixel["spectrum"]["wave"] == wavelength_nm)
    efficiency = sensor["color"]["filterSpectra"] * sensor["color"]["irFilter"][:, None] * pixel["spectralQE"][:, None]
    for place, channel in enumerate("RGB"):
        np.testing.assert_allclose(efficiency[:, place], camera.quantum_efficiency[channel].at(wavelength_nm))
    assert [line.partition(":")[0] for line in remarks] == ["full_well_e", "row_noise_e", "dark_current_doubling_c"]
    assert f"{4096 / 0.38:.6g} e" in remarks[0]


@pytest.mark.parametrize(
    ("cfa", "pattern"), [("RGGB", [[1, 2], [2, 3]]), ("GRBG", [[2, 1], [3, 2]]), ("BGGR", [[3, 2], [2, 1]])]
)
def test_colour_filters_lie_as_isetcam_numbers_them(tmp_path: Path, cfa: str, pattern: list[list[int]]) -> None:
    """The patterns of sensorCreate's `bayer (rggb)`, `(grbg)` and `(bggr)`."""
    content = replace(CAMERA, camera=CAMERA.camera.model_copy(update={"cfa": cfa}), effects=(Vignetting(),))
    sensor, remarks = written(tmp_path, content)
    assert sensor["cfa"]["pattern"].tolist() == pattern and list(sensor["color"]["filterNames"]) == ["r", "g", "b"]
    assert remarks[-1] == "effects: left out (vignetting)"


def test_a_mono_sensor_that_fits_has_no_remark(tmp_path: Path) -> None:
    fits = {
        "cfa": "MONO",
        "quantum_efficiency": {"Y": CAMERA.camera.quantum_efficiency["G"]},
        "full_well_e": 4096.0 / 0.38,
        "row_noise_e": 0.0,
        "dark_current_doubling_c": None,
    }
    sensor, remarks = written(tmp_path, replace(CAMERA, camera=CAMERA.camera.model_copy(update=fits)))
    assert remarks == () and sensor["cfa"]["pattern"] == 1 and sensor["color"]["filterNames"] == "w"


def test_the_command_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_camera(tmp_path / "c.toml", CAMERA)
    words = ["export", str(tmp_path / "c.toml"), "--as", "isetcam", "--to", str(tmp_path / "s.mat")]
    assert cli.main(words) == 0 and "full_well_e" in capsys.readouterr().err
    assert loadmat(tmp_path / "s.mat", simplify_cells=True)["sensor"]["name"] == "calibench default"
