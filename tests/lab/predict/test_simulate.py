"""`calibench simulate`: files, figures that hold, and one clear line for what can't be used."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rawpy

from lab import cli
from lab.errors import InputError
from lab.formats.camera_file import CameraFile, default_camera, read_camera, write_camera
from lab.formats.recording_set import load_frame
from lab.predict.simulate import SimulateOptions, automatic_exposure_s, preview, simulate
from sim.camera import CameraModel, Cfa, Geometry, Lens
from sim.optics.imaging import MeasuredOtf, MeasuredPsf, TracedLens, ZernikePupil
from sim.parameters import Quantity, read_quantities
from sim.scene.catalogue import SCENES, NamedScene
from sim.sensor.electrons import capacity_e
from sim.spectrum import Spectrum

LENSES = Path(__file__).parents[3].parent / "shared" / "data" / "lenses"
Run = Callable[..., int]


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """The default camera cut to 66 x 97 px, quick to simulate; odd columns, so that the mosaic has no whole period."""
    file = tmp_path / "camera.toml"
    content = default_camera()
    write_camera(file, CameraFile("small", content.camera.model_copy(update={"rows": 66, "cols": 97})))
    return file


def _run(*arguments: object) -> int:
    return cli.main(["simulate", *map(str, arguments)])


@pytest.mark.parametrize("ending", ["npy", "tif", "dng"])
def test_a_frame_a_preview_and_a_record(
    small: Path, tmp_path: Path, ending: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / f"frame.{ending}"
    assert _run("colorchecker24", "--camera", small, "--out", file) == 0
    frame = load_frame(file)
    assert frame.shape == (66, 97)
    picture = cv2.imread(str(tmp_path / "frame.preview.png"))
    assert picture.shape == (66, 97, 3)
    record = json.loads((tmp_path / "frame.json").read_text())
    assert record["options"]["scene"] == "colorchecker24"
    assert record["summary"]["automatic_exposure"] is True
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        ["camera.toml", file.name, "frame.preview.png", "frame.json"]
    )
    printed = capsys.readouterr().out
    assert "SNR" in printed and "saturated 0 %" in printed and "brightest 1 % at 70 % of a full pixel" in printed
    if ending == "dng":
        with rawpy.imread(str(file)) as raw:
            assert (raw.white_level, raw.black_level_per_channel[0]) == (4095, 64)
            assert raw.camera_whitebalance[0] > 0


def test_the_automatic_exposure_is_what_it_says(small: Path) -> None:
    """The brightest 1 % at 70 % of full well, to the three digits that the exposure has."""
    camera = read_camera(small)
    made = simulate(SimulateOptions(scene="checkerboard"), camera)
    bright = made.record.summary.brightest_percent_electrons
    assert bright == pytest.approx(0.7 * 10_500, rel=0.006)
    assert capacity_e(camera.camera) == 10_500
    assert capacity_e(camera.camera, 6.0) == pytest.approx(4031 / 0.38 / 10**0.3)
    assert automatic_exposure_s(np.full((4, 4), 1000.0), camera.camera) == 7.35


def test_frames_can_be_made_again(small: Path, tmp_path: Path) -> None:
    """From the record's own options: to the last code, at the exposure found; another seed is another frame of the same
    camera."""
    file = tmp_path / "a.npy"
    assert _run("slanted-edge", "--camera", small, "--out", file, "--seed", 5, "--set", "contrast=0.4") == 0
    record = json.loads((tmp_path / "a.json").read_text())
    again = simulate(SimulateOptions.model_validate(record["options"]), read_camera(small))
    np.testing.assert_array_equal(again.frame, load_frame(file))
    assert (again.record.camera_sha256, again.record.frame_sha256) == (record["camera_sha256"], record["frame_sha256"])
    options = again.record.options
    other = simulate(options.model_copy(update={"seed": 6}), read_camera(small))
    assert np.any(other.frame != again.frame)
    assert other.record.camera_sha256 == record["camera_sha256"]


def test_noise_has_the_size_that_the_model_says(small: Path) -> None:
    """Frames of one camera differ by temporal noise alone: half the variance of their difference is the model's, of two
    frames at one level within 4.5 sqrt(2 / n); fixed patterns cancel. Against `--expected` they don't."""
    from sim.sensor.electrons import dn_moments

    camera = read_camera(small)
    options = SimulateOptions(scene="uniform", exposure_s=0.01, gain_db=6.0)
    first, second = (
        simulate(options.model_copy(update={"seed": k}), camera).frame.astype(float)[::2, ::2] for k in (1, 2)
    )
    mean = simulate(options.model_copy(update={"expected": True}), camera).frame.astype(float)[::2, ::2]
    gain = camera.camera.conversion_gain_dn_per_e * 10 ** (6 / 20)
    variance = dn_moments((mean - 64.0) / gain, camera.camera, 6.0)[1].mean()
    # rows share 0.2 e of noise: 1 % of the variance, alike in half as many pixels
    assert (first - second).var() / 2 == pytest.approx(variance, rel=4.5 * np.sqrt(2 / mean.size) + 0.01)
    assert (first - mean).std() > 0


def test_without_noise_a_uniform_field_is_even(small: Path, tmp_path: Path) -> None:
    file = tmp_path / "mean.npy"
    assert _run("uniform", "--camera", small, "--out", file, "--expected", "--exposure-s", "0.02") == 0
    green = load_frame(file)[0::2, 1::2].astype(float)
    # cos^4 at 97 px of 3.45 um before 8 mm: 1 - 4 (0.2 / 8)^2 = 0.25 % in the corners, and half a code of rounding
    assert np.ptp(green) <= 0.003 * green.max() + 1.0


def test_measured_light_and_temperature_count(small: Path, tmp_path: Path) -> None:
    csv = tmp_path / "lamp.csv"
    csv.write_text("wavelength_nm,radiance_w_sr_m2_nm\n400,0.00001\n700,0.00001\n")
    double = tmp_path / "double.csv"
    double.write_text("wavelength_nm,radiance_w_sr_m2_nm\n400,0.00002\n700,0.00002\n")
    camera = read_camera(small)
    options = SimulateOptions(scene="uniform", illuminant=str(csv), exposure_s=1.0, expected=True)
    one, two = (simulate(options.model_copy(update={"illuminant": str(file)}), camera) for file in (csv, double))
    dark = 5.0
    ratio = (two.record.summary.mean_electrons - dark) / (one.record.summary.mean_electrons - dark)
    assert ratio == pytest.approx(2.0, rel=1e-9)
    warm = simulate(options.model_copy(update={"temperature_c": 39.0}), camera)
    # two doublings: 20 e/s in place of 5
    gained = warm.record.summary.mean_electrons - one.record.summary.mean_electrons
    assert gained == pytest.approx(15.0, rel=1e-6)


def test_dark_frames_are_asked_for_by_no_light(small: Path) -> None:
    made = simulate(SimulateOptions(scene="uniform", luminance_cd_m2=0.0, exposure_s=2.0), read_camera(small))
    assert made.record.summary.mean_electrons == 10.0  # 5 e/s
    # 10 e of 0.38 DN on 64 DN; noise of sqrt(10 + 2.4^2) e in 66 x 97 pixels, and of 66 rows and 97 columns
    assert made.frame.mean() == pytest.approx(67.8, abs=4.5 * 0.38 * np.sqrt(15.8 / 6402 + 0.04 / 66 + 0.09 / 97))


def test_effects_of_the_camera_file_act(small: Path, tmp_path: Path) -> None:
    glare = tmp_path / "glare.toml"
    glare.write_text(small.read_text() + '\n[[effects]]\nname = "veiling_glare"\nshare_percent = 10.0\n')
    options = SimulateOptions(
        scene="checkerboard", exposure_s=0.02, expected=True, parameters={"contrast": 1.0, "cell_px": 16}
    )
    plain, veiled = (simulate(options, read_camera(file)).frame for file in (small, glare))
    assert veiled.min() > plain.min() + 20
    assert veiled.max() < plain.max()


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_the_preview_is_grey_where_the_scene_is(cfa: Cfa) -> None:
    """White in any light, through any mosaic: three equal values; a red patch stays red."""
    camera = default_camera().camera.model_copy(update={"cfa": cfa, "rows": 40, "cols": 60})
    content = CameraFile("one", camera)
    for illuminant in ("A", "D65", "FL2"):
        made = simulate(SimulateOptions(scene="uniform", illuminant=illuminant), content)
        shown = preview(made.frame, camera, made.white)[8:-8, 8:-8].reshape(-1, 3).mean(axis=0)
        # three codes of 255: noise of 1 % of a pixel, averaged, and rounding
        assert np.ptp(shown) < 3.0 and shown.mean() > 100
    red = Spectrum.of([400.0, 600.0, 601.0, 700.0], [0.0, 0.0, 1.0, 1.0])
    frame = np.full((40, 60), 64, np.uint16)
    for index, letter in enumerate(cfa):
        frame[index // 2 :: 2, index % 2 :: 2] = {"R": 2000, "G": 500, "B": 200}[letter]
    shown = preview(frame, camera, Spectrum.of([400.0, 700.0], [1.0, 1.0]))[10:-10, 10:-10].reshape(-1, 3).mean(axis=0)
    assert shown[0] > 1.5 * shown[1]
    assert preview(frame, camera, red).shape == (40, 60, 3)


def test_mono_cameras_have_grey_previews(tmp_path: Path, small: Path) -> None:
    content = read_camera(small)
    curves = {"Y": content.camera.quantum_efficiency["G"]}
    mono = tmp_path / "mono.toml"
    camera = content.camera.model_copy(update={"cfa": "MONO", "quantum_efficiency": curves})
    write_camera(mono, CameraFile("mono", camera))
    assert _run("zone-plate", "--camera", mono, "--out", tmp_path / "z.dng") == 0
    picture = cv2.imread(str(tmp_path / "z.preview.png"))
    assert np.array_equal(picture[..., 0], picture[..., 2])


def test_a_camera_file_to_start_from(tmp_path: Path) -> None:
    file = tmp_path / "camera.toml"
    assert _run("--write-camera", file) == 0
    assert read_camera(file) == default_camera()


def test_pictures_are_scenes(small: Path, tmp_path: Path) -> None:
    codes = np.zeros((20, 30, 3), np.uint8)
    codes[:, 15:] = 255
    cv2.imwrite(str(tmp_path / "half.png"), codes)
    assert _run(tmp_path / "half.png", "--camera", small, "--out", tmp_path / "half.npy") == 0
    frame = load_frame(tmp_path / "half.npy").astype(float)
    assert frame[:, 70:].mean() > 10 * (frame[:, :30].mean() - 64)


@pytest.mark.slow
@pytest.mark.skipif(not LENSES.is_dir(), reason="no lens prescriptions beside this repository")
def test_a_lens_is_traced_once_and_kept(small: Path, tmp_path: Path) -> None:
    lens, cache = LENSES / "EO54852_glassfixed.zmx", tmp_path / "cache"
    assert _run("slanted-edge", "--camera", small, "--lens", lens, "--cache", cache, "--out", tmp_path / "a.npy") == 0
    (table,) = cache.iterdir()
    made = table.stat().st_mtime_ns
    assert _run("slanted-edge", "--camera", small, "--lens", lens, "--cache", cache, "--out", tmp_path / "b.npy") == 0
    assert table.stat().st_mtime_ns == made
    np.testing.assert_array_equal(load_frame(tmp_path / "a.npy"), load_frame(tmp_path / "b.npy"))
    assert _run("--camera", small, "--lens", lens, "--cache", cache, "--write-camera", tmp_path / "traced.toml") == 0
    content = read_camera(tmp_path / "traced.toml", cache)
    assert isinstance(content.camera.lens.imaging, TracedLens)
    assert content.camera.lens.f_number == content.camera.lens.imaging.table.f_number


def parameter_row(key: str, quantity: Quantity) -> str:
    """A parameter's line in the documentation."""
    low, high = ("" if limit is None else f"{limit:g}" for limit in (quantity.lower, quantity.upper))
    return f"| `{key}` | {quantity.unit} | {quantity.meaning} | {f'{low} .. {high}'.strip() if low or high else ''} |"


def scene_row(scene: type[NamedScene]) -> str:
    """A scene's line in the documentation."""
    keys = ", ".join(f"`{key}={scene.model_fields[key].default}`" for key in scene.quantities())
    return f"| `{scene.name}` | {scene.shows} | {keys} |"


def test_the_documentation_is_what_the_declarations_say() -> None:
    pages = Path(__file__).parents[3] / "docs" / "reference"
    text = (pages / "camera-file.md").read_text(encoding="utf-8")
    lines = text.splitlines()
    for model in (CameraModel, Lens):
        for key, quantity in read_quantities(model).items():
            assert parameter_row(key, quantity) in lines
    for model in (CameraModel, Lens, ZernikePupil, MeasuredPsf, MeasuredOtf):
        for key in model.model_fields:
            assert key in text, f"{model.__name__}.{key} isn't described"
    lines = (pages / "simulate.md").read_text(encoding="utf-8").splitlines()
    for scene in SCENES.values():
        assert scene_row(scene) in lines


ERRORS: list[tuple[tuple[str, ...], str]] = [
    (("nonsense", "--out", "{}/a.npy"), "scene 'nonsense' is not known: name one of uniform, colorchecker24"),
    (("uniform", "--out", "{}/a.png"), "a raw frame can't be .png; end it in .npy, .tif or .dng"),
    (("uniform", "--out", "{}/none/a.npy"), "can't be written"),
    (("uniform",), "no --out"),
    (("--out", "{}/a.npy"), "no SCENE"),
    (("uniform", "--out", "{}/a.npy", "--illuminant", "D66"), "illuminant 'D66' is not known"),
    (("uniform", "--out", "{}/a.npy", "--illuminant", "{}/bad.csv"), "bad.csv: "),
    (("uniform", "--out", "{}/a.npy", "--illuminant", "{}/down.csv"), "700 nm"),
    (("uniform", "--out", "{}/a.npy", "--illuminant", "{}/negative.csv"), "is -1 at 500 nm, below the limit of 0"),
    (("uniform", "--out", "{}/a.npy", "--illuminant", "{}/infrared.csv"), ("the scene's light lies at 900 to 1000 nm, "
        "outside the limits")),
    (("uniform", "--out", "{}/a.npy", "--exposure-s", "100"), ("exposure 100 s saturates all pixels: the darkest "
        "collects")),
    (("uniform", "--out", "{}/a.npy", "--exposure-s", "-1"), ": -1.0 s is below the lower limit 0.0 s"),
    (("uniform", "--out", "{}/a.npy", "--luminance-cd-m2", "1e9"), "beyond the limits of 1e-06 and 3600 s"),
    (("uniform", "--out", "{}/a.npy", "--distance-mm", "5"), ("distance 5.0 mm is not above the limit of the focal "
        "length")),
    (("slanted-edge", "--out", "{}/a.npy", "--set", "contrast=2"), ": 2.0 is above the upper limit"),
    (("slanted-edge", "--out", "{}/a.npy", "--set", "size=2"), "has no parameter 'size': it has angle_deg"),
    (("slanted-edge", "--out", "{}/a.npy", "--set", "contrast"), "isn't KEY=VALUE"),
    (("uniform", "--out", "{}/a.npy", "--lens", "{}/none.zmx"), "none.zmx: can't be read"),
    (("uniform", "--out", "{}/a.npy", "--camera", "{}/none.toml"), "none.toml: can't be read"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "message"), ERRORS, ids=lambda value: value if isinstance(value, str) else None)
def test_what_cannot_be_used_is_one_line(
    arguments: tuple[str, ...], message: str, small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.csv").write_text("nm;radiance\n")
    (tmp_path / "down.csv").write_text("wavelength_nm,radiance_w_sr_m2_nm\n700,1\n400,1\n")
    (tmp_path / "negative.csv").write_text("wavelength_nm,radiance_w_sr_m2_nm\n400,1\n500,-1\n600,1\n")
    (tmp_path / "infrared.csv").write_text("wavelength_nm,radiance_w_sr_m2_nm\n900,1\n1000,1\n")
    before = sorted(path.name for path in tmp_path.iterdir())
    given = [argument.format(tmp_path) for argument in arguments]
    if "--camera" not in given:
        given += ["--camera", str(small)]
    assert _run(*given) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1 and "Traceback" not in said
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_the_geometrys_distortion_bends_what_a_pinhole_placed() -> None:
    """Pincushion of 5 % in the corner: the outermost squares move out, the middle ones stay."""
    content = default_camera()
    camera = content.camera.model_copy(update={"rows": 96, "cols": 128})
    focal = 1e3 * camera.lens.focal_length_mm / camera.pixel_pitch_um
    corner = np.hypot(64.0, 48.0) / focal
    geometry = Geometry(
        camera_matrix=((focal, 0.0, 63.5), (0.0, focal, 47.5), (0.0, 0.0, 1.0)), distortion=(0.05 / corner**2,)
    )
    options = SimulateOptions(scene="checkerboard", expected=True)
    plain, bent = (
        simulate(options, replace(content, camera=camera.model_copy(update={"geometry": g}))).frame.astype(float)
        for g in (None, geometry)
    )
    assert np.abs(plain - bent)[40:56, 56:72].max() < 0.1 * np.ptp(plain)
    assert np.abs(plain - bent).max() > 0.3 * np.ptp(plain)


def test_a_fisheye_moves_what_a_pinhole_placed_and_a_wider_one_is_refused() -> None:
    """The bright squares of a checkerboard through an equidistant lens of 38 deg at the corner: straight ahead they
    stay, and the corner of the frame holds more of them, since f tan 38 deg is 1.18 times f 38 deg.
    """
    content = default_camera()
    options = SimulateOptions(scene="checkerboard", expected=True)

    def frame(corner_deg: float | None) -> np.ndarray:
        camera = content.camera.model_copy(update={"rows": 96, "cols": 128})
        if corner_deg is not None:
            focal = float(np.hypot(63.5, 47.5) / np.deg2rad(corner_deg))
            matrix = ((focal, 0.0, 63.5), (0.0, focal, 47.5), (0.0, 0.0, 1.0))
            geometry = Geometry(camera_matrix=matrix, projection="equidistant")
            camera = camera.model_copy(update={"geometry": geometry})
        return simulate(options, replace(content, camera=camera)).frame.astype(float)

    plain, bent = frame(None), frame(38.0)
    assert np.abs(plain - bent)[44:52, 60:68].max() < 0.1 * np.ptp(plain)
    assert np.abs(plain - bent).max() > 0.3 * np.ptp(plain)
    with pytest.raises(InputError, match=r"sees 70 deg off the axis \(equidistant projection\).*up to 40 deg"):
        frame(70.0)


def test_a_camera_whose_focal_length_nobody_stated_asks_for_it(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No length that was taken for it ("5000 mm") is shown; with the length in the file, the scene is drawn."""
    content = read_camera(small)
    lens = content.camera.lens.model_copy(update={"focal_length_mm": None})
    write_camera(small, replace(content, camera=content.camera.model_copy(update={"lens": lens})))
    out = tmp_path / "u.npy"
    assert _run("uniform", "--camera", small, "--out", out) == 2
    told = capsys.readouterr().err
    assert "focal_length_mm of the camera's lens is not set" in told and "below [lens]" in told and "5000" not in told
    assert not out.exists()
    small.write_text(small.read_text().replace("[lens]", "[lens]\nfocal_length_mm = 8.0", 1))
    assert _run("uniform", "--camera", small, "--out", out) == 0
