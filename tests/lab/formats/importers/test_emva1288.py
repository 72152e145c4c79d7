"""Variants of EMVA 1288 descriptors; damaged, missing and unusual images."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.errors import InputError
from lab.fit.noise.noise_fit import fit_noise
from lab.foreign_recordings import read_foreign
from lab.formats import recording_set as recording
from lab.formats.importers.emva1288 import parse_descriptor, read_emva1288

DATA = Path(__file__).resolve().parents[5] / "shared" / "data" / "emva1288_ccd"


def image(file: Path, mean_dn: float, bits: int = 12, seed: int = 0, shape: tuple[int, int] = (20, 30)) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    values = (
        np.clip(rng.normal(mean_dn, 3.0, shape), 0, 2**bits - 1).round().astype(np.uint8 if bits <= 8 else np.uint16)
    )
    assert cv2.imwrite(str(file), values)


def make(folder: Path, header: str = "v 4.0\nn 12 30 20\n", name: str = "data.txt", suffix: str = "png") -> Path:
    """Four bright levels and four dark ones, two images each."""
    lines = [header]
    for level in range(1, 5):
        lines.append(f"b {1000.0 * level} {500.0 * level}\n")
        for snap in range(2):
            image(folder / f"images/b_{level}_{snap}.{suffix}", 100 + 500 * level, seed=10 * level + snap)
            lines.append(f"i images\\b_{level}_{snap}.{suffix}\n")
    for level in range(1, 5):
        lines.append(f"d {1000.0 * level}\n")
        for snap in range(2):
            image(folder / f"images/d_{level}_{snap}.{suffix}", 100, seed=100 * level + snap)
            lines.append(f"i images\\d_{level}_{snap}.{suffix}\n")
    (folder / name).write_text("".join(lines), encoding="latin-1", newline="\r\n")
    return folder


def test_a_measurement_becomes_a_recording_set(tmp_path: Path) -> None:
    recordings = recording.read(recording.write(read_emva1288(make(tmp_path / "in")), tmp_path / "out"))
    flats, darks = recordings.captures("flat"), recordings.captures("dark")
    assert [flat.photons_per_pixel for flat in flats] == [500, 500, 1000, 1000, 1500, 1500, 2000, 2000]
    assert [dark.exposure_s for dark in darks[::2]] == pytest.approx([1e-6, 2e-6, 3e-6, 4e-6])
    assert flats[0].wavelength_nm is None
    camera = recordings.camera("left")
    assert (camera.rows, camera.cols, camera.cfa, camera.bit_depth) == (20, 30, "MONO", 12)
    assert camera.pixel_pitch_um is None
    stored = cv2.imread(str(tmp_path / "in/images/b_3_1.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(recordings.frame(recordings.capture("b_3_1")), stored)


@pytest.mark.parametrize("suffix", ["png", "tif", "pgm"])
@pytest.mark.parametrize("name", ["EMVA1288_Data.txt", "messung", "list.emva"])
def test_descriptor_of_any_name_and_images_of_several_formats(tmp_path: Path, name: str, suffix: str) -> None:
    folder = make(tmp_path, name=name, suffix=suffix)
    (folder / "readme.txt").write_text("Nothing of this kind.\nb is a letter\n")
    assert len(read_emva1288(folder).captures()) == 16
    assert len(read_emva1288(folder / name).captures()) == 16


def test_descriptor_one_folder_deeper_none_and_two(tmp_path: Path) -> None:
    make(tmp_path / "deep" / "set")
    assert len(read_emva1288(tmp_path / "deep").captures()) == 16
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no EMVA 1288 descriptor"):
        read_emva1288(tmp_path / "empty")
    (tmp_path / "deep/set/second.txt").write_bytes((tmp_path / "deep/set/data.txt").read_bytes())
    with pytest.raises(InputError, match="2 descriptor files"):
        read_emva1288(tmp_path / "deep/set")


def test_variants_of_the_lines() -> None:
    found = parse_descriptor(
        "\ufeff# comment\n\n  v 3.1 \nN\t8  2048 512 Mono8\nl Vendor Some One\nB 000.00 000.35 # first\ni a\\b c.png\n"
        "b 40.5\nd 1e3\ni x.png\nz what\n"
    )
    assert (found.release, found.bits, found.width, found.height) == ("3.1", 8, 2048, 512)
    assert [(level.bright, level.photons_per_pixel) for level in found.levels] == [
        (True, 0.35),
        (True, None),
        (False, None),
    ]
    assert found.levels[0].images == ["a\\b c.png"]
    assert found.levels[2].exposure_s == pytest.approx(1e-6)
    assert any("'z'" in remark for remark in found.remarks)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("n 12 640\n", "line 1"),
        ("n 24 640 480\n", "24 bits"),
        ("i a.png\n", "before the first level"),
        ("b x 3\n", "line 1"),
        ("d -5\n", "line 1"),
        ("b nan 3\n", "line 1"),
    ],
)
def test_lines_that_cannot_be_understood(text: str, word: str) -> None:
    with pytest.raises(InputError, match=word):
        parse_descriptor(text)


@given(st.text(st.sampled_from("vnbdi#l 0123456789.e-\\/\n\t\"'äx"), max_size=200))
def test_arbitrary_text_is_understood_or_refused_on_one_line(text: str) -> None:
    try:
        parse_descriptor(text)
    except InputError as error:
        assert "\n" not in str(error)


def test_missing_images_are_counted_and_left_out(tmp_path: Path) -> None:
    folder = make(tmp_path)
    for name in ("b_1_0", "d_4_1", "d_4_0"):
        (folder / f"images/{name}.png").unlink()
    recordings = read_emva1288(folder)
    assert len(recordings.captures()) == 13
    assert "3 of 16 listed images are missing" in recordings.warnings[0]
    for file in (folder / "images").iterdir():
        file.unlink()
    with pytest.raises(InputError, match="none of its 16 images"):
        read_emva1288(folder)


def test_paths_in_other_case_and_images_converted_to_another_format(tmp_path: Path) -> None:
    folder = make(tmp_path)
    text = (folder / "data.txt").read_text()
    (folder / "data.txt").write_text(text.replace("images\\b", "IMAGES\\B").replace(".png", ".TIF"))
    assert len(read_emva1288(folder).captures()) == 16


def test_a_path_out_of_the_folder_finds_nothing(tmp_path: Path) -> None:
    folder = make(tmp_path / "in")
    image(tmp_path / "outside.png", 300)
    (folder / "images/link.png").symlink_to(tmp_path / "outside.png")
    with (folder / "data.txt").open("a") as file:
        file.write("d 5000\ni ..\\outside.png\ni images\\link.png\n")
    assert "2 of 18 listed images are missing" in read_emva1288(folder).warnings[0]


def test_damaged_image_and_another_size_are_named(tmp_path: Path) -> None:
    folder = make(tmp_path / "in")
    whole = (folder / "images/b_2_0.png").read_bytes()
    (folder / "images/b_2_0.png").write_bytes(whole[: len(whole) // 2])
    (folder / "images/b_2_1.png").write_bytes(whole[:200] + b"\0" + whole[201:])
    image(folder / "images/d_1_0.png", 100, shape=(20, 28))
    with pytest.raises(InputError) as caught:
        recording.write(read_emva1288(folder), tmp_path / "out")
    lines = str(caught.value).splitlines()
    assert len(lines) == 3
    assert "b_2_0.png" in lines[0]
    assert "ends too early" in lines[0]
    assert "checksum" in lines[1]
    assert "20 x 28" in lines[2]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


def test_left_aligned_values_are_shifted_down_and_real_excess_is_refused(tmp_path: Path) -> None:
    folder = make(tmp_path / "in")
    plain = read_emva1288(folder)
    frames = {capture.id: plain.frame(capture) for capture in plain.captures()}
    for id, frame in frames.items():
        cv2.imwrite(str(folder / f"images/{id}.png"), frame << 4)
    shifted = read_emva1288(folder)
    assert any("shifted up by 4" in line for line in shifted.warnings)
    for capture in shifted.captures():
        np.testing.assert_array_equal(shifted.frame(capture), frames[capture.id])
    cv2.imwrite(str(folder / "images/b_1_0.png"), np.full((20, 30), 5001, np.uint16))
    with pytest.raises(InputError, match="5001 DN is above the 12 bits"):
        read_emva1288(folder)


def test_colour_pictures_are_refused_and_grey_ones_in_colour_are_not(tmp_path: Path) -> None:
    folder = make(tmp_path, header="n 8 30 20\n")
    rng = np.random.default_rng(1)
    for file in (folder / "images").iterdir():
        grey = rng.integers(20, 90, (20, 30), dtype=np.uint8)
        cv2.imwrite(str(file), np.stack([grey] * 3, axis=-1))
    recordings = read_emva1288(folder)
    recordings.frame(recordings.captures()[0])
    cv2.imwrite(str(folder / "images/b_1_0.png"), rng.integers(0, 255, (20, 30, 3), dtype=np.uint8))
    with pytest.raises(InputError, match="colour picture"):
        read_emva1288(folder)


def test_line_n_that_contradicts_the_images(tmp_path: Path) -> None:
    recordings = read_emva1288(make(tmp_path, header="n 12 656 494\n"))
    assert any("494 x 656, the images are 20 x 30" in line for line in recordings.warnings)


def test_camera_file_tells_what_the_descriptor_does_not(tmp_path: Path) -> None:
    folder = make(tmp_path)
    (folder / "camera.toml").write_text(
        'pixel_pitch_um = 9.9\nblack_level_dn = 90\nwavelength_nm = 525\ncfa = "GBRG"\n'
    )
    recordings = read_emva1288(folder)
    assert recordings.warnings == ()
    assert recordings.camera("left").pixel_pitch_um == 9.9
    assert recordings.camera("left").cfa == "GBRG"
    assert recordings.camera("left").unknown_keys() == {}
    assert recordings.captures("flat")[0].wavelength_nm == 525
    (folder / "camera.toml").write_text("pixel_pitch_um = -1\n")
    with pytest.raises(InputError, match="pixel_pitch_um"):
        read_emva1288(folder)


def test_unknown_format_and_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="choose emva1288, raw-folder"):
        read_foreign("exif", tmp_path)
    with pytest.raises(InputError, match="no such file or folder"):
        read_foreign("emva1288", tmp_path / "nowhere")


def test_a_real_camera(tmp_path: Path) -> None:
    if not DATA.is_dir():
        pytest.skip("the shared data are not here")
    recordings: Any = read_emva1288(DATA)
    assert "76 of 300" in recordings.warnings[0]
    noise = fit_noise(recording.read(recording.write(recordings, tmp_path / "out")), "left")
    # The demands on this camera: an independent evaluation gives 0.280 DN/e, 10.9 e, 0.453.
    assert noise.conversion_gain_dn_per_e == pytest.approx(0.280, rel=0.02)
    assert noise.read_noise_e == pytest.approx(10.9, rel=0.10)
    assert noise.quantum_efficiency == pytest.approx(0.453, rel=0.03)
    assert any("lamp drifted" in remark for remark in noise.remarks)


@pytest.mark.parametrize("photons", [150.0, 12000.0], ids=["too few", "too many"])
@pytest.mark.parametrize("level", [2, 7])
def test_a_wrong_photon_number_at_one_level_does_not_refuse_the_set(tmp_path: Path, photons: float, level: int) -> None:
    """Seven levels of 500 DN for each 500 photons, the last two saturated at 2047 DN; one states a wrong number."""
    lines = ["v 4.0\nn 11 30 20\n"]
    for number in range(1, 8):
        lines.append(f"b {1000 * number} {photons if number == level else 500.0 * number}\n")
        for snap in range(2):
            image(tmp_path / f"in/images/b_{number}_{snap}.png", 100 + 380 * number, bits=11, seed=10 * number + snap)
            lines.append(f"i images\\b_{number}_{snap}.png\n")
    (tmp_path / "in/data.txt").write_text("".join(lines))
    recordings = recording.read(recording.write(read_emva1288(tmp_path / "in"), tmp_path / "out"))
    assert len(recordings.captures("flat")) == 14
    named = [line for line in recordings.warnings if "photon number" in line]
    # A saturated level may have any light above that of saturation
    assert len(named) == (0 if (level, photons) == (7, 12000.0) else 1)
    assert all(f"b_{level}_0" in line for line in named)


@pytest.mark.parametrize(
    ("bits", "gain", "exposures_us", "said"),
    [(12, 0.25, range(20, 260, 20), 2000.0), (14, 1.1, (5, 10, 40, 90, 160), 1e5), (10, 0.05, (1e3, 3e3, 7e3), 7.0)],
)
def test_one_number_of_photons_for_all_exposures_is_taken_as_unknown(
    tmp_path: Path, bits: int, gain: float, exposures_us: Any, said: float
) -> None:
    """Two thirds of the range at the longest exposure. K within 4 of its standard deviations; no quantum efficiency,
    and one line that names value, exposures and captures."""
    rng, shape = np.random.default_rng(4), (60, 80)
    lines = [f"n {bits} {shape[1]} {shape[0]}"]
    for number, us in enumerate(exposures_us):
        for key, level in (("b", us / max(exposures_us)), ("d", 0.0)):
            lines.append(f"{key} {1e3 * us:g}" + (f" {said:g}" if key == "b" else ""))
            for snap in range(2):
                charge = rng.poisson(level * 0.65 * 2**bits / gain, shape) + 9.0 * rng.standard_normal(shape)
                code = np.clip(np.rint(40.0 + gain * charge), 0, 2**bits - 1).astype(np.uint16)
                name = f"{key}{number}_{snap}.png"
                assert cv2.imwrite(str(tmp_path / name), code)
                lines.append(f"i {name}")
    (tmp_path / "data.txt").write_text("\n".join(lines))
    recordings = read_emva1288(tmp_path)
    (line,) = (one for one in recordings.warnings if "state " in one and "photons a pixel" in one)
    assert f"({recordings.captures('flat')[0].id} .. " in line and f"state {said:g} photons a pixel" in line
    assert "state the photons of each exposure" in line
    assert {flat.photons_per_pixel for flat in recordings.captures("flat")} == {None}
    noise = fit_noise(recordings, "left")
    assert noise.quantum_efficiency is None and noise.conversion_gain_dn_per_e_std is not None
    assert abs((noise.conversion_gain_dn_per_e or 0.0) - gain) < 4.0 * noise.conversion_gain_dn_per_e_std


def test_one_number_of_photons_at_one_or_two_exposures_stays(tmp_path: Path) -> None:
    """Levels of a lamp that is dimmed, or a repeated level, may have one exposure or two."""
    folder = make(tmp_path)
    text = (folder / "data.txt").read_text(encoding="latin-1")
    for level in (3, 4):
        text = text.replace(f"b {1000.0 * level} {500.0 * level}", "b 2000.0 1000.0")
    text = text.replace("b 1000.0 500.0", "b 1000.0 1000.0")
    (folder / "data.txt").write_text(text, encoding="latin-1")
    recordings = read_emva1288(folder)
    assert {flat.photons_per_pixel for flat in recordings.captures("flat")} == {1000.0}
