"""Formats that other programs read and write: round trips, those programs' own readers, and refusals in one line."""

from __future__ import annotations

import importlib
import json
import math
import os
import shutil
import struct
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
import rawpy
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from lab import cli
from lab.errors import InputError
from lab.formats.camera_file import CameraFile, default_camera, read_camera, write_camera
from lab.formats.cgats import CgatsSpectra, Quantity, parse_cgats, read_cgats, write_cgats
from lab.formats.colour_profile import colour_matrices, energy_sensitivities, write_dcp, write_icc, write_rawtoaces
from lab.formats.lensfun import read_lensfun, with_lens, write_lensfun
from lab.formats.pyxel_file import VOLT_PER_DN, write_pyxel
from lab.formats.scene_file import exr_lights, light, read_cube, read_light, scene
from lab.interface import simulate, write_frame
from sim.camera import Geometry
from sim.effects.lateral_chromatic_aberration import LateralChromaticAberration
from sim.effects.vignetting import Vignetting
from sim.optics.illumination import relative_illumination
from sim.scene.catalogue import scene_by_name
from sim.scene.light import illuminant
from sim.scene.scenes import ReflectanceChart
from sim.scene.warp import Warp
from sim.spectrum import Spectrum
from tests.peers import missing

CAMERA = default_camera()


def library(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError:
        missing(f"{name} isn't installed (calibench's extra dev has it)")


def program(*words: str) -> str:
    """What a program prints; the test is skipped where it isn't installed."""
    if shutil.which(words[0]) is None:
        missing(f"{words[0]} isn't installed (the distribution's argyll has it)")
    return subprocess.run(
        words, check=True, capture_output=True, text=True, timeout=60, stdin=subprocess.DEVNULL
    ).stdout


def distorted(k1: float, k2: float, right_px: float = 0.0) -> CameraFile:
    camera = CAMERA.camera
    f = camera.lens.focal_length_mm * 1e3 / camera.pixel_pitch_um
    matrix = ((f, 0.0, 0.5 * (camera.cols - 1) + right_px), (0.0, f, 0.5 * (camera.rows - 1)), (0.0, 0.0, 1.0))
    geometry = Geometry(camera_matrix=matrix, distortion=(k1, k2, 0.0, 0.0, 0.0))
    return replace(CAMERA, camera=camera.model_copy(update={"geometry": geometry}))


# --- CGATS ------------------------------------------------------------------------------------------------------------

QUANTITIES: tuple[Quantity, ...] = ("radiance", "reflectance", "transmittance", "sensitivity")


@settings(max_examples=40, deadline=None)
@given(
    st.integers(300, 500),
    st.sampled_from([1.0, 2.0, 2.5, 5.0, 10.0]),
    st.lists(st.lists(st.floats(0, 1e3), min_size=5, max_size=5), min_size=1, max_size=3),
    st.sampled_from(QUANTITIES),
    st.sampled_from([".sp", ".ti3"]),
)
def test_spectra_come_back(
    first_nm: int, step_nm: float, values: list[list[float]], quantity: Quantity, ending: str
) -> None:
    grid = [first_nm + k * step_nm for k in range(5)]
    spectra = {f"s {k}": Spectrum.of(grid, of) for k, of in enumerate(values)}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"x{ending}"
        assert write_cgats(file, CgatsSpectra(spectra, quantity)) == ()
        found = read_cgats(file)
    assert found.quantity == quantity and len(found.spectra) == len(spectra)
    if len(spectra) > 1 or ending == ".ti3":
        assert list(found.spectra) == list(spectra)
    for one, other in zip(spectra.values(), found.spectra.values(), strict=True):
        np.testing.assert_allclose(other.wavelength_nm, one.wavelength_nm, rtol=1e-12)
        np.testing.assert_allclose(other.value, one.value, rtol=1e-12)  # two products by a power of ten


def test_uneven_spectra_are_resampled_and_told(tmp_path: Path) -> None:
    spectra = {"a": Spectrum.of([400, 410, 430], [1.0, 2.0, 4.0]), "b": Spectrum.of([400, 440], [0.0, 4.0])}
    (remark,) = write_cgats(tmp_path / "x.ti3", CgatsSpectra(spectra, "radiance"))
    assert "resampled to 5 even steps of 10 nm" in remark
    found = read_cgats(tmp_path / "x.ti3").spectra
    np.testing.assert_allclose(found["a"].value, [1.0, 2.0, 3.0, 4.0, 0.0])
    np.testing.assert_allclose(found["b"].value, [0.0, 1.0, 2.0, 3.0, 4.0])
    with pytest.raises(InputError, match="40001 bands"):
        write_cgats(tmp_path / "y.sp", CgatsSpectra({"a": Spectrum.of([400, 400.01, 800], [1, 1, 1])}, "radiance"))


def test_argyll_reads_a_radiance_in_its_unit(tmp_path: Path) -> None:
    """Argyll's luminance of our 100 cd/m^2: its sum over steps of 5 nm and ours over lines differ by some 1e-5."""
    grid = np.arange(380.0, 781.0, 5.0)
    lamp = Spectrum.of(grid, light("D65", 100.0).at(grid))
    write_cgats(tmp_path / "d65.sp", CgatsSpectra({"d65": lamp}, "radiance"))
    told = program("specplot", "-s", str(tmp_path / "d65.sp"))
    (line,) = [line for line in told.splitlines() if line.startswith("Abs. Y")]
    assert float(line.split("=")[1]) == pytest.approx(100.0, rel=1e-3)
    assert read_light(tmp_path / "d65.sp").value == pytest.approx(lamp.value, rel=1e-12)


SP = """SPECT
# made by hand
KEYWORD "SPECTRAL_BANDS"
SPECTRAL_BANDS "3"
SPECTRAL_START_NM "400"
SPECTRAL_END_NM "420"
SPECTRAL_NORM "100"
NUMBER_OF_FIELDS 3
BEGIN_DATA_FORMAT
SPEC_400 SPEC_410 SPEC_420
END_DATA_FORMAT
NUMBER_OF_SETS 1
BEGIN_DATA
10 20 30
END_DATA
"""


def test_a_file_without_a_quantity_and_makers_fields_are_read() -> None:
    found = parse_cgats(SP)
    assert found.quantity is None and "MEAS_TYPE" in found.remarks[0]
    assert found.spectra["1"].value == pytest.approx((0.1, 0.2, 0.3))
    maker = SP.replace("SPEC_", "nm").replace('SPECTRAL_BANDS "3"', "").replace('KEYWORD "SPECTRAL_BANDS"', "")
    assert parse_cgats(maker).spectra["1"].wavelength_nm == (400.0, 410.0, 420.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("END_DATA\n", ""), "no END_DATA"),
        (("10 20 30", "10 20"), "2 values for 3 fields"),
        (("10 20 30", "10 x 30"), "row 1, SPEC_410 is 'x', not a number"),
        (('"100"', '"0"'), "SPECTRAL_NORM is 0"),
        (('"3"', '"4"'), "SPECTRAL_BANDS is 4, and 3 fields"),
        (('"420"', '"520"'), "the field of 410 nm is at 460 nm"),
        (("SPEC_", "XYZ_"), "no fields SPEC_nnn"),
        (("10 20 30", '10 "20 30'), "close its quotes"),
    ],
)
def test_bad_cgats_is_refused_in_one_line(change: tuple[str, str], said: str, tmp_path: Path) -> None:
    file = tmp_path / "x.sp"
    file.write_text(SP.replace(*change))
    with pytest.raises(InputError, match=said) as told:
        read_cgats(file)
    assert str(told.value).startswith(str(file)) and "\n" not in str(told.value)


# --- lensfun ----------------------------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(
    st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(-5, 5), st.floats(-3, 3), st.floats(0, 40), st.integers(-9, 9)
)
def test_a_lens_comes_back(k1: float, k2: float, slope: float, curve: float, loss: float, right_px: int) -> None:
    """Distortion to 1e-6: nine digits are written. Light to what pa leaves of cos^4, told above 0.2 %."""
    content = distorted(k1, k2, right_px)
    tca = LateralChromaticAberration(slope_um=slope, curvature_um=curve)
    content = replace(content, effects=(tca, Vignetting(corner_loss_percent=loss)))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "lens.xml"
        assert write_lensfun(file, content) == ()
        back, remarks = with_lens(content, read_lensfun(file, content.camera))
    assert remarks == () and back.camera.geometry is not None and content.camera.geometry is not None
    np.testing.assert_allclose(back.camera.geometry.distortion[:2], (k1, k2), atol=1e-6)
    np.testing.assert_allclose(back.camera.geometry.camera_matrix, content.camera.geometry.camera_matrix)
    (found,) = back.effects
    assert isinstance(found, LateralChromaticAberration)
    assert (found.slope_um, found.curvature_um) == pytest.approx((slope, curve), abs=1e-4)
    row, col = np.linspace(0, 959, 7), np.linspace(0, 1279, 7)
    axis_col = 0.5 * 1279 + right_px
    r2 = ((row - 479.5) ** 2 + (col - axis_col) ** 2) / content.camera.half_diagonal_px**2
    wanted = relative_illumination(content.camera, row, col) * (1.0 - loss / 100.0 * r2)
    np.testing.assert_allclose(relative_illumination(back.camera, row, col), wanted, atol=0.005)


def test_lensfun_itself_applies_the_lens_as_we_mean_it(tmp_path: Path) -> None:
    """lensfunpy against OpenCV and our own laws: 0.05 px of 8 px; a pixel's half is lensfun's other convention."""
    lensfunpy = library("lensfunpy")
    content = replace(distorted(-0.12, 0.05, 12.0), name="cam")
    tca = LateralChromaticAberration(slope_um=2.0, curvature_um=1.0)
    content = replace(content, effects=(tca, Vignetting(corner_loss_percent=10.0)))
    camera, geometry = content.camera, content.camera.geometry
    assert geometry is not None
    write_lensfun(tmp_path / "lens.xml", content)
    database = lensfunpy.Database(paths=[str(tmp_path / "lens.xml")], load_common=False, load_bundled=False)
    (body,) = database.find_cameras("calibench", "cam")
    (lens,) = database.find_lenses(body, "calibench", "cam")
    modifier = lensfunpy.Modifier(lens, body.crop_factor, camera.cols, camera.rows)
    modifier.initialize(8.0, 4.0, 1000.0, scale=1.0, pixel_format=np.float32)
    matrix = np.array(geometry.camera_matrix)
    row, col = np.mgrid[0 : camera.rows : 96, 0 : camera.cols : 128]
    rays = np.stack([(col - matrix[0, 2]) / matrix[0, 0], (row - matrix[1, 2]) / matrix[0, 0], np.ones(row.shape)], -1)
    wanted, _ = cv2.projectPoints(
        rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, np.array(geometry.distortion)
    )
    found = modifier.apply_geometry_distortion()[::96, ::128].reshape(-1, 2)
    assert np.abs(wanted.reshape(-1, 2) - np.stack([col, row], -1).reshape(-1, 2)).max() > 5.0
    np.testing.assert_allclose(found, wanted.reshape(-1, 2), atol=0.05)
    corrected = np.ones((camera.rows, camera.cols, 3), np.float32)
    modifier.apply_color_modification(corrected)
    r2 = ((row - matrix[1, 2]) ** 2 + (col - matrix[0, 2]) ** 2) / camera.half_diagonal_px**2
    dark = relative_illumination(camera, row, col) * (1.0 - 0.1 * r2)
    np.testing.assert_allclose(corrected[::96, ::128, 1] * dark, 1.0, atol=0.003)
    by_colour = modifier.apply_subpixel_distortion()[5, 5] - matrix[:2, 2]
    radius = np.linalg.norm(by_colour, axis=-1)
    kept = read_lensfun(tmp_path / "lens.xml", camera).tca
    assert kept is not None
    over_green = [float(one[0]) for one in kept(np.array([1.0]))]
    assert (radius[0] / radius[1], radius[2] / radius[1]) == pytest.approx(over_green, abs=1e-6)


def test_what_lensfun_has_no_law_for_is_told(tmp_path: Path) -> None:
    content = distorted(-0.2, 0.1)
    assert content.camera.geometry is not None
    geometry = content.camera.geometry.model_copy(update={"distortion": (-0.2, 0.1, 0.01, 0.0, 0.0)})
    content = replace(content, camera=content.camera.model_copy(update={"geometry": geometry}))
    (remark,) = write_lensfun(tmp_path / "lens.xml", content)
    assert remark.startswith("distortion: poly5 leaves") and "p1" in remark


LENSES = """<lensdatabase version="1">
<lens><maker>M</maker><model>A</model><cropfactor>1.5</cropfactor><calibration>
<distortion model="ptlens" focal="8" a="0.01" b="-0.03" c="0.005"/></calibration></lens>
<lens><maker>M</maker><model>B</model><cropfactor>7.8</cropfactor><calibration>
<distortion model="poly3" focal="8" k1="-0.02"/><tca model="linear" focal="8" kr="1.0004" kb="0.9998"/>
<distortion model="poly3" focal="50" k1="0.2"/></calibration></lens></lensdatabase>"""


def test_lensfuns_other_laws_are_read(tmp_path: Path) -> None:
    file = tmp_path / "db.xml"
    file.write_text(LENSES)
    poly3 = read_lensfun(file, CAMERA.camera, "B")
    assert poly3.distortion is not None and poly3.tca is not None
    half_short_mm = 0.5 * math.hypot(36.0, 24.0) / 7.8 / math.hypot(1.5, 1.0)
    radius_mm = np.array([0.0, half_short_mm])
    np.testing.assert_allclose(poly3.distortion(radius_mm), [1.02, 1.0])
    np.testing.assert_allclose(poly3.tca(radius_mm), [[1.0004, 1.0004], [0.9998, 0.9998]])
    made, _ = with_lens(CAMERA, poly3)
    assert made.camera.geometry is not None
    f = CAMERA.camera.lens.focal_length_mm * 1e3 / CAMERA.camera.pixel_pitch_um
    assert made.camera.geometry.camera_matrix[0][0] == pytest.approx(1.02 * f)
    assert made.camera.geometry.distortion[0] < 0
    ptlens = read_lensfun(file, CAMERA.camera, "A")
    assert ptlens.distortion is not None
    half_short_mm = 0.5 * math.hypot(36.0, 24.0) / 1.5 / math.hypot(1.5, 1.0)
    np.testing.assert_allclose(ptlens.distortion(np.array([0.0, half_short_mm])), [1.0 - 0.01 + 0.03 - 0.005, 1.0])


@pytest.mark.parametrize(
    ("text", "model", "said"),
    [
        (LENSES, "", "holds 2 lenses; choose one by --lens: 'A', 'B'"),
        (LENSES, "C", "holds no lens 'C'"),
        ("<lensdatabase/>", "", "holds no lens with a calibration"),
        ("<a", "", "isn't lensfun's XML"),
        (LENSES.replace("ptlens", "fov1"), "A", "distortion of model 'fov1' isn't known"),
        (LENSES.replace('a="0.01"', 'a="x"'), "A", "a of <distortion> is 'x', not a number"),
        (LENSES.replace('focal="8" a', 'focal="0" a'), "A", "focal of <distortion> is '0'"),
    ],
)
def test_bad_lensfun_is_refused_in_one_line(tmp_path: Path, text: str, model: str, said: str) -> None:
    file = tmp_path / "db.xml"
    file.write_text(text)
    with pytest.raises(InputError, match=said) as told:
        read_lensfun(file, CAMERA.camera, model)
    assert str(told.value).startswith(str(file)) and "\n" not in str(told.value)


# --- colour -----------------------------------------------------------------------------------------------------------


def test_rawtoaces_has_sensitivities_to_energy(tmp_path: Path) -> None:
    assert write_rawtoaces(tmp_path / "c.json", CAMERA) == ()
    document = json.loads((tmp_path / "c.json").read_text())
    assert document["spectral_data"]["index"]["main"] == ["R", "G", "B"]
    data = document["spectral_data"]["data"]["main"]
    assert [int(nm) for nm in data] == list(range(380, 781, 5))
    assert max(max(row) for row in data.values()) == 1.0
    green = CAMERA.camera.quantum_efficiency["G"]
    # the ratio at two wavelengths: of the efficiencies, and of the photons in a joule
    assert data["600"][1] / data["500"][1] == pytest.approx(600 * green.at(600) / (500 * green.at(500)))


def test_matrices_keep_white_and_predict_colours() -> None:
    """Of white exactly; of the training set, the fit is no worse than a plain least-squares fit by more than white
    costs. A camera that sees as the eye does has no error at all."""
    to_camera, to_pcs = colour_matrices(CAMERA.camera, "D65")
    np.testing.assert_allclose(to_pcs.sum(axis=1), [0.9642, 1.0, 0.8249], rtol=1e-9)
    white = to_camera @ np.array([0.95047, 1.0, 1.08883])
    assert white.max() == pytest.approx(1.0, abs=2e-3)  # D65's XYZ, summed over 380 to 780 nm by 5
    colour = library("colour")
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    grid = np.arange(380.0, 781.0, 5.0)
    eye = np.array([observer[nm] for nm in grid]) / grid[:, None]  # per photon
    mix = np.array([[0.6, 0.2, 0.0], [0.3, 0.7, 0.1], [0.1, 0.1, 0.9]])
    mixed = eye @ mix.T
    curves = {name: Spectrum.of(grid, mixed[:, k] / mixed.max()) for k, name in enumerate("RGB")}
    seen = CAMERA.camera.model_copy(update={"quantum_efficiency": curves})
    for name in ("A", "D65"):
        to_camera, _ = colour_matrices(seen, name)
        scale = to_camera[0, 0] / 0.6
        np.testing.assert_allclose(to_camera, scale * mix, atol=1e-9)


def test_a_dcp_is_a_tiff_with_our_matrices(tmp_path: Path) -> None:
    tifffile = library("tifffile")
    write_dcp(tmp_path / "c.dcp", CAMERA)
    data = (tmp_path / "c.dcp").read_bytes()
    assert data[:4] == b"IIRC"
    (tmp_path / "c.tif").write_bytes(data[:2] + struct.pack("<H", 42) + data[4:])
    with tifffile.TiffFile(tmp_path / "c.tif") as opened:
        tags: dict[int, Any] = {tag.code: tag.value for tag in opened.pages[0].tags.values()}
    assert (tags[50778], tags[50779]) == (17, 21)
    for codes, name in (((50721, 50964), "A"), ((50722, 50965), "D65")):
        for code, matrix in zip(codes, colour_matrices(CAMERA.camera, name), strict=True):
            numbers = np.array(tags[code], float).reshape(9, 2)
            np.testing.assert_allclose(numbers[:, 0] / numbers[:, 1], matrix.ravel(), atol=1e-6)


#: RawTherapee as it develops without a will of its own: the camera's white balance, the DCP's matrix for D65, sRGB.
NEUTRAL = """[Version]
AppVersion=5.9
Version=349
[Exposure]
Auto=false
Compensation=0
HistogramMatching=false
Curve=0;
Curve2=0;
[HLRecovery]
Enabled=false
[White Balance]
Enabled=true
Setting=Camera
[Color Management]
InputProfile=file:{profile}
ToneCurve=false
ApplyLookTable=false
ApplyBaselineExposureOffset=false
ApplyHueSatMap=false
DCPIlluminant=2
WorkingProfile=ProPhoto
OutputProfile=RTv4_sRGB
OutputProfileIntent=Relative
OutputBPC=false
[Sharpening]
Enabled=false
"""
#: XYZ of the PCS (D50) to linear sRGB, by Bradford's adaptation.
D50_TO_SRGB = np.array(
    [
        [3.1338561, -1.6168667, -0.4906146],
        [-0.9787684, 1.9161415, 0.0334540],
        [0.0719453, -0.2289914, 1.4052427],
    ]
)


def test_rawtherapee_develops_with_the_dcp(tmp_path: Path) -> None:
    """A raw converter puts the ColorChecker's 24 patches where the DCP's matrix does."""
    if shutil.which("rawtherapee-cli") is None:
        missing("RawTherapee isn't installed (scripts/install-peers)")
    tifffile = library("tifffile")
    small = replace(CAMERA, camera=CAMERA.camera.model_copy(update={"rows": 320, "cols": 480}))
    made = simulate("colorchecker24", small, exposure_s=0.02, illuminant="D65", expected=True, progress=False)
    write_frame(made, tmp_path / "chart.dng")
    write_dcp(tmp_path / "c.dcp", small)
    (tmp_path / "neutral.pp3").write_text(NEUTRAL.format(profile=tmp_path / "c.dcp"))
    subprocess.run(
        ["rawtherapee-cli", "-o", tmp_path / "out.tif", "-b16", "-t", "-Y", "-p", tmp_path / "neutral.pp3",
         "-c", tmp_path / "chart.dng"],
        check=True, capture_output=True, timeout=120, env=os.environ | {"HOME": str(tmp_path)},
    )  # fmt: skip
    code = tifffile.imread(tmp_path / "out.tif") / 65535.0
    linear = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    border = (320 - code.shape[0]) // 2
    with rawpy.imread(str(tmp_path / "chart.dng")) as raw:
        signal, balance = raw.raw_image_visible - 64.0, np.array(raw.camera_whitebalance[:3])
    chart = scene_by_name("colorchecker24", small.camera, illuminant("D65", 100.0))
    assert isinstance(chart, ReflectanceChart)
    to_camera = Warp.from_corners(6 - chart.gap, 4 - chart.gap, chart.corners).to_camera
    developed, balanced = np.empty((24, 3)), np.empty((24, 3))
    for k in range(24):
        row, col = (2 * (int(at[0]) // 2) for at in to_camera([k % 6 + 0.435], [k // 6 + 0.435]))
        patch = signal[row - 10 : row + 10, col - 10 : col + 10]
        green = 0.5 * (patch[::2, 1::2].mean() + patch[1::2, ::2].mean())
        balanced[k] = balance * (patch[::2, ::2].mean(), green, patch[1::2, 1::2].mean())
        there = slice(row - 10 - border, row + 10 - border), slice(col - 10 - border, col + 10 - border)
        developed[k] = linear[there].mean(axis=(0, 1))
    _, forward = colour_matrices(small.camera, "D65")
    predicted = balanced @ forward.T @ D50_TO_SRGB.T
    predicted *= developed[18:22].sum() / predicted[18:22].sum()  # the converter's scale
    within = np.all((predicted > 0) & (developed < 0.999), axis=1)  # sRGB holds no others
    assert within.sum() >= 20
    # RawTherapee's tables of its working space and of sRGB's curve: seen are 0.5 % of white at most.
    np.testing.assert_allclose(developed[within], predicted[within], rtol=0, atol=0.01 * developed[18].mean())


def test_argyll_reads_the_icc_profile(tmp_path: Path) -> None:
    write_icc(tmp_path / "c.icc", CAMERA)
    told = program("iccdump", str(tmp_path / "c.icc"))
    assert "Device Class = Input" in told and "Conn. Space  = XYZ" in told
    _, forward = colour_matrices(CAMERA.camera, "D65")
    made = subprocess.run(
        ["icclu", "-ff", "-ir", "-px", "-v0", str(tmp_path / "c.icc")],
        input="1 1 1\n1 0 0\n0.25 0.5 0.5\n", capture_output=True, text=True, timeout=60, check=True,
    ).stdout  # fmt: skip
    found = np.array([[float(word) for word in line.split()] for line in made.splitlines() if line.strip()])
    signals = np.array([[1, 1, 1], [1, 0, 0], [0.25, 0.5, 0.5]])
    np.testing.assert_allclose(found, signals @ forward.T, atol=5e-5)  # s15Fixed16, and six digits


def test_a_mono_camera_has_no_colour_profile(tmp_path: Path) -> None:
    mono = {"cfa": "MONO", "quantum_efficiency": {"Y": CAMERA.camera.quantum_efficiency["G"]}}
    content = replace(CAMERA, camera=CAMERA.camera.model_copy(update=mono))
    for write in (write_rawtoaces, write_dcp, write_icc):
        with pytest.raises(InputError, match="no colour filters"):
            write(tmp_path / "x", content)
    assert energy_sensitivities(CAMERA.camera).shape == (81, 3)


# --- Pyxel ------------------------------------------------------------------------------------------------------------

PHOTONS, EXPOSURE_S = 6000.0, 0.5


def _for_pyxel(tmp_path: Path) -> tuple[Path, float, float]:
    """A camera's file for Pyxel, and the mean and variance (DN) by its laws: EMVA 1288, release 4, (9) to (15)."""
    noisy = {"rows": 500, "cols": 500, "read_noise_e": 6.0, "dark_current_e_per_s": 500.0}
    camera = CAMERA.camera.model_copy(update=noisy)
    file = tmp_path / "p.yaml"
    remarks = write_pyxel(file, replace(CAMERA, camera=camera), exposure_s=EXPOSURE_S, photons_per_pixel=PHOTONS)
    assert [line.partition(":")[0] for line in remarks] == ["dsnu_e", "prnu_percent", "row_noise_e", "column_noise_e"]
    electrons = float(camera.quantum_efficiency["G"].at(550.0)) * PHOTONS + 500.0 * EXPOSURE_S
    gain = camera.conversion_gain_dn_per_e
    return file, camera.black_level_dn + gain * electrons, gain**2 * (electrons + 36.0) + 1.0 / 12.0


def test_pyxels_file_has_the_laws_of_the_camera(tmp_path: Path) -> None:
    """The mean and the variance by the file's own numbers, as Pyxel's models use them."""
    file, mean, variance = _for_pyxel(tmp_path)
    document = yaml.safe_load(file.read_text())
    detector, models = document["cmos_detector"], {}
    for group, listed in document["pipeline"].items():
        for model in listed:
            assert model["func"] == f"pyxel.models.{group}.{model['name']}"
            models[model["name"]] = model.get("arguments", {})
    of = detector["characteristics"]
    low, high = of["adc_voltage_range"]
    dn_per_v = (2 ** of["adc_bit_resolution"] - 1) / (high - low)
    time_s = document["exposure"]["readout"]["times"][0]
    electrons = (
        models["illumination"]["level"] * time_s / models["illumination"]["time_scale"] * of["quantum_efficiency"]
        + models["simple_dark_current"]["dark_rate"] * time_s
    )
    volt = of["charge_to_volt_conversion"] * of["pre_amplification"]
    # its converter truncates: half a code is lost on average
    found = (electrons * volt + models["dc_offset"]["offset"] - low) * dn_per_v - 0.5
    noise = (electrons * volt**2 + models["output_node_noise"]["std_deviation"] ** 2) * dn_per_v**2 + 1.0 / 12.0
    assert (found, noise) == pytest.approx((mean, variance), rel=1e-9)
    assert (low, high) == pytest.approx((-0.5 * VOLT_PER_DN, 4094.5 * VOLT_PER_DN))


@pytest.mark.filterwarnings("default")  # its own
def test_pyxel_itself_agrees(tmp_path: Path) -> None:
    """To 0.2 % of the variance: 16 frames of 250,000 pixels leave 0.07 % of it to chance, and 1e-5 of the mean."""
    pyxel = pytest.importorskip("pyxel", reason="pyxel-sim isn't installed; its laws are compared by formula above")
    file, mean, variance = _for_pyxel(tmp_path)
    run = pyxel.load(file)
    np.random.seed(1288)  # noqa: NPY002  (Pyxel draws from it)
    means, variances = [], []
    for _ in range(16):
        pyxel.run_mode(mode=run.running_mode, detector=run.detector, pipeline=run.pipeline)
        frame = np.asarray(run.detector.image.array, float)
        means.append(frame.mean())
        variances.append(frame.var())
    assert np.mean(means) == pytest.approx(mean, rel=2e-3)
    assert np.mean(variances) == pytest.approx(variance, rel=2e-3 + 3 * 0.0007)


# --- OpenEXR ----------------------------------------------------------------------------------------------------------

BANDS = (400.0, 500.0, 600.0, 700.0)


def _lit(OpenEXR: ModuleType, file: Path) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    lights = {name: rng.random((6, 8, 4)).astype(np.float32) for name in ("lamp", "sky")}
    channels = {
        f"{n}.S0.{nm:g},000000nm": cube[..., k].copy() for n, cube in lights.items() for k, nm in enumerate(BANDS)
    }
    with OpenEXR.File({}, channels) as made:
        made.write(str(file))
    return lights


def test_lights_of_an_exr_add_up_by_their_weights(tmp_path: Path) -> None:
    file = tmp_path / "s.exr"
    lights = _lit(library("OpenEXR"), file)
    found = exr_lights(file)
    assert set(found) == {"lamp", "sky"} and found["lamp"].wavelength_nm == BANDS
    np.testing.assert_array_equal(found["sky"].radiance, lights["sky"])
    np.testing.assert_allclose(read_cube(file).radiance, lights["lamp"] + lights["sky"], rtol=1e-6)
    white = light("D65")
    camera = CAMERA.camera.model_copy(update={"rows": 6, "cols": 8})
    dim = scene(str(file), camera, white, parameters={"light.sky": 0.5, "light.lamp": 0.0, "fill": 1.0})
    np.testing.assert_allclose(dim.radiance, 0.5 * lights["sky"], rtol=1e-6)  # type: ignore[attr-defined]
    for wrong, said in (
        ({"light.moon": 1.0}, "no light 'moon'; its lights are"),
        ({"light.sky": -1.0}, "light.sky is -1"),
    ):
        with pytest.raises(InputError, match=said) as told:
            scene(str(file), camera, white, parameters=wrong)
        assert str(told.value).startswith(str(file)) and "\n" not in str(told.value)


def test_parts_and_numbered_channels_are_read_and_others_refused(tmp_path: Path) -> None:
    OpenEXR = library("OpenEXR")
    numbered = {f"Radiance.C{k:02d}": np.full((4, 5), k, np.float32) for k in range(1, 32)}
    parts = [OpenEXR.Part({}, dict(numbered), name=name) for name in ("head", "street")]
    with OpenEXR.File(parts) as made:
        made.write(str(tmp_path / "parts.exr"))
    found = exr_lights(tmp_path / "parts.exr")
    assert set(found) == {"head", "street"} and found["head"].wavelength_nm == tuple(np.arange(400.0, 701.0, 10.0))
    assert found["head"].radiance[0, 0, 2] == 3.0
    with OpenEXR.File({}, {"R": np.ones((3, 3), np.float32)}) as made:
        made.write(str(tmp_path / "rgb.exr"))
    (tmp_path / "torn.exr").write_bytes((tmp_path / "parts.exr").read_bytes()[:200])
    for name, said in (("rgb.exr", "no radiance by wavelength"), ("torn.exr", "can't be read as OpenEXR")):
        with pytest.raises(InputError, match=said) as told:
            read_cube(tmp_path / name)
        assert "\n" not in str(told.value)


# --- the commands -----------------------------------------------------------------------------------------------------


def test_commands_write_and_read_each_format(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def said(*words: object, code: int = 0) -> str:
        assert cli.main([str(word) for word in words]) == code, words
        return capsys.readouterr().err

    camera = tmp_path / "camera.toml"
    write_camera(camera, distorted(-0.1, 0.0))
    for kind, name in (
        ("lensfun", "l.xml"),
        ("rawtoaces", "c.json"),
        ("dcp", "c.dcp"),
        ("icc", "c.icc"),
        ("pyxel", "p.yaml"),
    ):
        said("export", camera, "--as", kind, "--to", tmp_path / name)
        assert (tmp_path / name).stat().st_size > 100
    said("import", tmp_path / "l.xml", "--from", "lensfun", "--camera", camera, "--out", tmp_path / "again.toml")
    again = read_camera(tmp_path / "again.toml").camera.geometry
    assert again is not None and again.distortion[0] == pytest.approx(-0.1, abs=1e-6)
    (tmp_path / "s.csv").write_text("wavelength_nm,value\n400.0,0.1\n410.0,0.2\n")
    said("export", tmp_path / "s.csv", "--as", "spectra", "--quantity", "reflectance", "--to", tmp_path / "s.sp")
    said("import", tmp_path / "s.sp", "--from", "spectra", "--out", tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text() == (tmp_path / "s.csv").read_text()
    for words in (
        ("export", camera, "--as", "jpeg", "--to", "x"),
        ("export", tmp_path / "s.csv", "--as", "dcp", "--to", "x"),
        ("export", tmp_path / "s.csv", "--as", "spectra", "--to", "x.csv"),
        ("import", tmp_path / "s.csv", "--from", "spectra", "--out", tmp_path / "u.csv"),
        ("import", tmp_path / "l.xml", "--from", "lensfun", "--out", tmp_path / "u.toml"),
        ("import", tmp_path / "s.sp", "--from", "spectra", "--lens", "A", "--out", tmp_path / "u.csv"),
    ):
        assert said(*words, code=2).count("calibench:") == 1
