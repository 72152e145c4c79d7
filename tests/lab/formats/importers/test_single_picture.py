"""One picture of a slanted edge or a ColorChecker: nothing is assumed, and known truths are recovered."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import erf

from lab.errors import InputError
from lab.fit.mtf import fit_mtf
from lab.foreign_recordings import read_slanted_edge
from lab.formats import recording_set as recording
from lab.formats.importers import ImportOptions, read_colour_chart
from lab.formats.importers.single_picture import locate_chart
from lab.formats.recording_set import DataSheet
from sim.scene.colorchecker import PATCHES, reflectances
from sim.sensor import mosaic

LLANOS = Path(__file__).resolve().parents[5] / "shared" / "data" / "llanos_colorchecker"
ANGLE_DEG, BLUR_PX = 5.0, 0.6
LINEAR = ImportOptions(exposure_s=0.01, transfer="linear")


def _edge(shape: tuple[int, int] = (160, 200), low: float = 0.1, high: float = 0.8) -> np.ndarray:
    """A blurred edge (Gaussian of BLUR_PX and the pixel) about the middle, 0..1."""
    row, col = np.indices(shape, float)
    angle = np.deg2rad(ANGLE_DEG)
    away = (col - shape[1] / 2) * np.cos(angle) + (row - shape[0] / 2) * np.sin(angle)
    return low + (high - low) * 0.5 * (1.0 + erf(away / np.sqrt(2.0) / np.hypot(BLUR_PX, 1.0 / np.sqrt(12.0))))


def _camera(path: Path, text: str = 'cfa = "MONO"\nbit_depth = 12\nblack_level_dn = 0\n') -> None:
    (path / "camera.toml").write_text(text)


def test_an_edge_picture_gives_its_transfer_function(tmp_path: Path) -> None:
    """Gaussian of s px: MTF(f) = exp(-2 pi^2 s^2 f^2); noise of 4 DN in 2800 moves it by less than 0.01 at 0.25
    cy/px."""
    rng = np.random.default_rng(0)
    codes = np.rint(4095 * _edge() + rng.normal(0.0, 4.0, (160, 200))).astype(np.uint16)
    assert cv2.imwrite(str(tmp_path / "edge.png"), codes)
    _camera(tmp_path)
    read = read_slanted_edge(tmp_path / "edge.png", LINEAR)
    recordings = recording.read(recording.write(read, tmp_path / "out"))
    np.testing.assert_array_equal(recordings.frame(recordings.captures()[0]), codes)
    (curve,) = fit_mtf(recordings, "left")
    at = float(np.interp(0.25, curve.frequency_cy_per_px, curve.mtf))
    width = np.hypot(BLUR_PX, 1.0 / np.sqrt(12.0))
    assert at == pytest.approx(float(np.exp(-2.0 * np.pi**2 * width**2 * 0.25**2)), abs=0.01)
    assert any("1 edges, at" in text for text in read.warnings)


def test_a_screens_picture_is_made_linear(tmp_path: Path) -> None:
    """sRGB codes of 8 bit: rounding moves a level by half a code, 0.5 / 255 x the curve's slope of 2.4 at most."""
    light = _edge() + np.random.default_rng(3).normal(0.0, 0.004, (160, 200))
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    picture = np.rint(255 * code).astype(np.uint8)
    assert cv2.imwrite(str(tmp_path / "edge.png"), picture)
    _camera(tmp_path, 'cfa = "MONO"\nblack_level_dn = 0\n')
    recordings = read_slanted_edge(tmp_path / "edge.png", ImportOptions(exposure_s=0.01, transfer="srgb"))
    frame = recordings.frame(recordings.captures()[0])
    assert recordings.camera("left").bit_depth == 16
    np.testing.assert_allclose(frame / 65535.0, light, atol=1.2 * 0.5 / 255 * 2.4)


def test_one_channel_of_a_colour_picture_is_a_monochrome_camera(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    parts = [255 * level * _edge() + rng.normal(0.0, 1.0, (160, 200)) for level in (0.5, 0.9, 0.7)]
    colours = np.dstack([np.rint(part).astype(np.uint8) for part in parts])  # B, G, R
    assert cv2.imwrite(str(tmp_path / "edge.png"), colours)
    _camera(tmp_path, "black_level_dn = 0\n")
    with pytest.raises(InputError, match="state --channel R, G or B"):
        read_slanted_edge(tmp_path / "edge.png", LINEAR)
    options = ImportOptions(exposure_s=0.01, transfer="linear", channel="G")
    recordings = read_slanted_edge(tmp_path / "edge.png", options)
    assert recordings.camera("left").cfa == "MONO"
    np.testing.assert_array_equal(recordings.frame(recordings.captures()[0]), colours[..., 1])


def test_everything_that_is_missing_is_said_at_once(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "edge.png"), np.rint(4095 * _edge()).astype(np.uint16))
    with pytest.raises(InputError) as caught:
        read_slanted_edge(tmp_path / "edge.png", ImportOptions())
    said = str(caught.value)
    assert "\n" not in said
    for word in ("cfa", "bit_depth", "black_level_dn", "--exposure-s", "--transfer"):
        assert word in said


@pytest.mark.parametrize(
    "picture",
    [np.full((160, 200), 700.0), 700.0 + np.random.default_rng(2).normal(0.0, 20.0, (160, 200))],
    ids=["uniform", "noise"],
)
def test_a_picture_without_an_edge_is_refused(tmp_path: Path, picture: np.ndarray) -> None:
    assert cv2.imwrite(str(tmp_path / "edge.png"), np.rint(picture).astype(np.uint16))
    _camera(tmp_path)
    with pytest.raises(InputError, match="no slanted edge"):
        read_slanted_edge(tmp_path / "edge.png", LINEAR)


# --- ColorChecker -----------------------------------------------------------------------------------------------------

CORNERS = np.array([[60.0, 70.0], [75.0, 400.0], [285.0, 390.0], [270.0, 62.0]])
RGB_NM = {"R": (600.0, 40.0), "G": (540.0, 40.0), "B": (460.0, 30.0)}


def _patch_colours() -> np.ndarray:
    """(24, 3): R, G, B of each patch in light of equal energy, over a perfect diffuser's."""
    wavelength = np.arange(400.0, 701.0, 5.0)
    seen = {c: np.exp(-0.5 * ((wavelength - peak) / width) ** 2) for c, (peak, width) in RGB_NM.items()}
    known = reflectances("ColorChecker24")
    return np.array([[float(np.average(r.at(wavelength), weights=seen[c])) for c in "RGB"] for r in known.values()])


def _chart() -> np.ndarray:
    """A chart in perspective on a dark frame, (rows, cols, 3) in R, G, B, 0..1; patches fill 84 % of their cells."""
    cell = 40
    board = np.full((4 * cell, 6 * cell, 3), 0.02)
    for k, colour in enumerate(_patch_colours()):
        i, j = divmod(k, 6)
        margin = round(0.08 * cell)
        board[i * cell + margin : (i + 1) * cell - margin, j * cell + margin : (j + 1) * cell - margin] = colour
    board = np.pad(board, ((12, 12), (12, 12), (0, 0)), constant_values=0.02)
    flat = (
        np.array([[12, 12], [6 * cell + 12, 12], [6 * cell + 12, 4 * cell + 12], [12, 4 * cell + 12]], np.float32) - 0.5
    )
    homography = cv2.getPerspectiveTransform(flat, CORNERS[:, ::-1].astype(np.float32))
    return cv2.warpPerspective(board, homography, (460, 340), flags=cv2.INTER_AREA, borderValue=(0.3, 0.3, 0.3))


def _mosaic(cfa: str) -> np.ndarray:
    colours = _chart()
    frame = np.empty(colours.shape[:2])
    for channel, places in mosaic.phases(cfa).items():
        for row, col in places:
            frame[row::2, col::2] = colours[row::2, col::2, "RGB".index(channel)]
    return np.rint(64 + 3000 * frame).astype(np.uint16)


@pytest.fixture
def light(tmp_path: Path) -> Path:
    (tmp_path / "light.csv").write_text("wavelength_nm,value\n400,0.01\n700,0.01\n")
    return tmp_path / "light.csv"


@pytest.mark.parametrize("cfa", ["RGGB", "GBRG"])
def test_the_patches_of_a_mosaic_are_located(cfa: str) -> None:
    """To a tenth of a patch, 5 px: inner halves of patches are averaged."""
    camera = DataSheet(rows=340, cols=460, cfa=cfa, bit_depth=12, black_level_dn=64.0)
    found = locate_chart(_mosaic(cfa), camera)
    assert found is not None
    np.testing.assert_allclose(np.array(found), CORNERS, atol=5.0)


def test_a_chart_picture_becomes_a_chart_capture(tmp_path: Path, light: Path) -> None:
    np.save(tmp_path / "chart.npy", _mosaic("RGGB"))
    _camera(tmp_path, 'cfa = "RGGB"\nbit_depth = 12\nblack_level_dn = 64\n')
    read = read_colour_chart(tmp_path / "chart.npy", ImportOptions(exposure_s=0.02, light=light))
    recordings = recording.read(recording.write(read, tmp_path / "out"))
    (capture,) = recordings.captures("chart")
    assert recordings.spectrum(capture.radiance).value == (0.01, 0.01)
    assert np.abs(np.array(capture.corners) - CORNERS).max() < 5.0
    assert any("the chart's corners were found at" in text for text in read.warnings)


def test_a_colour_picture_is_sampled_like_a_mosaic(tmp_path: Path, light: Path) -> None:
    """Each channel's pixels are the picture's own at the mosaic's places."""
    picture = np.rint(255 * _chart()).astype(np.uint8)
    assert cv2.imwrite(str(tmp_path / "chart.png"), picture[..., ::-1])
    _camera(tmp_path, "black_level_dn = 0\n")
    options = ImportOptions(exposure_s=0.02, light=light, transfer="linear")
    recordings = read_colour_chart(tmp_path / "chart.png", options)
    frame = recordings.frame(recordings.captures()[0])
    assert recordings.camera("left").cfa == "RGGB"
    np.testing.assert_array_equal(frame[0::2, 0::2], picture[0::2, 0::2, 0])
    np.testing.assert_array_equal(frame[1::2, 0::2], picture[1::2, 0::2, 1])
    np.testing.assert_array_equal(frame[1::2, 1::2], picture[1::2, 1::2, 2])


def test_the_white_patchs_radiance_gives_a_perfect_diffusers(tmp_path: Path) -> None:
    white = reflectances("ColorChecker24")[next(n for n in PATCHES if n.startswith("white"))]
    (tmp_path / "white.csv").write_text("wavelength_nm,value\n450,0.009\n550,0.009\n")
    np.save(tmp_path / "chart.npy", _mosaic("RGGB"))
    _camera(tmp_path, 'cfa = "RGGB"\nbit_depth = 12\nblack_level_dn = 64\n')
    options = ImportOptions(exposure_s=0.02, white_patch=tmp_path / "white.csv")
    recordings = read_colour_chart(tmp_path / "chart.npy", options)
    value = recordings.spectrum(recordings.captures()[0].radiance).value
    np.testing.assert_allclose(value, 0.009 / white.at(np.array([450.0, 550.0])))


def _turned(corners: np.ndarray) -> np.ndarray:
    return np.roll(corners, 2, axis=0)


@pytest.mark.parametrize(
    ("change", "words"),
    [(_turned, "the grey row doesn't fall"), (lambda corners: corners + 300.0, "outside the frame of 340 x 460")],
)
def test_wrong_corners_are_refused(
    tmp_path: Path, light: Path, change: Callable[[np.ndarray], np.ndarray], words: str
) -> None:
    np.save(tmp_path / "chart.npy", _mosaic("RGGB"))
    _camera(tmp_path, 'cfa = "RGGB"\nbit_depth = 12\nblack_level_dn = 64\n')
    corners = tuple((float(r), float(c)) for r, c in change(CORNERS))
    with pytest.raises(InputError, match=words):
        read_colour_chart(tmp_path / "chart.npy", ImportOptions(exposure_s=0.02, light=light, corners=corners))


def test_no_chart_and_no_light_are_one_line_each(tmp_path: Path, light: Path) -> None:
    np.save(tmp_path / "chart.npy", np.full((340, 460), 500, np.uint16))
    _camera(tmp_path, 'cfa = "RGGB"\nbit_depth = 12\nblack_level_dn = 64\n')
    with pytest.raises(InputError, match="no ColorChecker of 24 patches found; give its --corners"):
        read_colour_chart(tmp_path / "chart.npy", ImportOptions(exposure_s=0.02, light=light))
    with pytest.raises(InputError, match="--light or --white-patch"):
        read_colour_chart(tmp_path / "chart.npy", ImportOptions(exposure_s=0.02))


@pytest.mark.skipif(not LLANOS.is_dir(), reason="the ColorChecker's recordings aren't beside the checkout")
def test_the_chart_of_a_real_camera_is_located() -> None:
    """Behind the 550 nm filter; the patches' labels were drawn by the authors: each located patch centre lies in one
    label, in order."""
    (file,) = (LLANOS / "frames").glob("*_550nm_2000ms_*.tif")  # which the detector takes mirrored
    labels = cv2.imread(str(LLANOS / "labels_550nm.png"), cv2.IMREAD_UNCHANGED)
    frame = cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.uint16)
    found = locate_chart(frame, DataSheet(rows=frame.shape[0], cols=frame.shape[1], cfa="GBRG", bit_depth=8))
    assert found is not None
    corner = np.array(found)
    k = np.arange(24)
    u, v = ((k % 6 + 0.5) / 6)[:, None], ((k // 6 + 0.5) / 4)[:, None]
    at = (1 - v) * ((1 - u) * corner[0] + u * corner[1]) + v * ((1 - u) * corner[3] + u * corner[2])
    seen = [int(labels[round(r), round(c)]) for r, c in at]
    assert seen == list(range(1, 25))
