"""What frames' own files state, compared with what is stated for them; pages of stacks; ids."""

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from lab.errors import InputError
from lab.fit.noise.noise_fit import fit_noise
from lab.foreign_recordings import read_foreign
from lab.formats.importers import ImportOptions
from lab.formats.importers.own_statements import sensor_facts
from lab.formats.raw_file import RawMetadata, write_raw
from sim.camera import CameraModel, Cfa, Lens
from sim.spectrum import Spectrum
from tests.lab.formats.test_pictures import packed_tiff

WAVE = np.arange(400.0, 701.0, 50.0)
ORIENTATION, SHORT, RATIONAL = 274, 3, 5


def folder(path: Path, frames: dict[str, np.ndarray | bytes], camera: str, rows: str = "", column: str = "") -> Path:
    """A folder of frames (an array is written by its name's ending) with an index of darks, or of `rows`."""
    path.mkdir(exist_ok=True)
    index = [f"frame,kind,side,exposure_s{column}"]
    for name, frame in frames.items():
        (path / name).parent.mkdir(exist_ok=True)
        if isinstance(frame, bytes):
            (path / name).write_bytes(frame)
        else:
            assert cv2.imwrite(str(path / name), frame)
        index.append(f"{name},dark,left,0.01")
    (path / "index.csv").write_text(rows or "\n".join(index) + "\n")
    (path / "camera.toml").write_text(camera)
    return path


def noise(seed: int = 0, shape: tuple[int, ...] = (24, 32), dtype: Any = np.uint16) -> np.ndarray:
    return np.random.default_rng(seed).normal(100.0, 5.0, shape).round().astype(dtype)


def series(write: Any, path: Path, full: int, gain: float, black: float, read_e: float) -> Path:
    """A photon-transfer series to 0.8 of `full`, two frames a level, 100 x 120 px."""
    rng, index = np.random.default_rng(4), ["frame,kind,side,exposure_s"]
    path.mkdir()
    for light in range(8):
        for repeat in range(2):
            electrons = rng.poisson(0.8 * full / gain * light / 7.0, (100, 120)) + rng.normal(0, read_e, (100, 120))
            name = f"s{light}_{repeat}.tif"
            frame = np.clip(np.rint(black + gain * electrons), 0, full).astype(np.uint16)
            write(path / name, frame)
            index.append(f"{name},{'flat' if light else 'dark'},left,{0.01 * max(light, 1):g}")
    (path / "index.csv").write_text("\n".join(index) + "\n")
    return path


@pytest.mark.parametrize(
    ("bits", "gain", "black", "read_e", "dim"),
    [(14, 1.0, 100, 10.0, 4), (12, 0.25, 64, 8.0, 1), (10, 0.1, 40, 30.0, 1)],
)
def test_packed_samples_give_the_gain_of_their_own_codes(
    tmp_path: Path, bits: int, gain: float, black: float, read_e: float, dim: int
) -> None:
    """Shifted up to 16 bits, they gave 4 and 16 times the gain. Without a stated bit depth, it is the file's."""
    path = series(
        lambda file, frame: file.write_bytes(packed_tiff(frame, bits)),
        tmp_path / "in", 2**bits // dim - 1, gain, black, read_e,
    )  # fmt: skip
    (path / "camera.toml").write_text('cfa = "MONO"\n')
    recordings = read_foreign("raw-folder", path)
    assert recordings.camera("left").bit_depth == bits
    assert any(f"bit_depth = {bits}: not stated, and taken from this file" in line for line in recordings.warnings)
    fit = fit_noise(recordings, "left")
    assert abs(fit.conversion_gain_dn_per_e - gain) < 3.0 * fit.conversion_gain_dn_per_e_std
    assert fit.black_level_dn == pytest.approx(black, abs=0.3)
    assert abs(fit.read_noise_e - read_e) < 3.0 * fit.read_noise_e_std
    (path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\n')
    (line,) = [line for line in read_foreign("raw-folder", path).warnings if "bits a sample" in line]
    assert line.endswith(f"and 15 more: its file states {bits} bits a sample, bit_depth is 16; correct what is wrong")


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_a_mosaic_stays_as_stored_whatever_its_orientation(tmp_path: Path, orientation: int) -> None:
    """Turned by its tag, a mosaic exchanged red and blue, or moved them into the greens."""
    frame = noise()
    frame[::2, ::2] += 300
    frame[1::2, 1::2] += 900

    def write(file: Path) -> bytes:
        tags = [(ORIENTATION, SHORT, 1, orientation, True)]
        tifffile.imwrite(file, frame, photometric="minisblack", metadata=None, extratags=tags)
        return file.read_bytes()

    path = folder(tmp_path / "in", {"a.tif": write(tmp_path / "x.tif")}, 'cfa = "RGGB"\nbit_depth = 12\n')
    recordings = read_foreign("raw-folder", path)
    np.testing.assert_array_equal(recordings.frame(recordings.captures()[0]), frame)
    assert any(f"a.tif: its Orientation is {orientation}" in line for line in recordings.warnings)


def test_exif_of_jpeg_and_png_turns_nothing(tmp_path: Path) -> None:
    exif = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    frame = np.zeros((40, 64), np.uint8)
    frame[:16, :24] = 200
    jpeg = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    block = b"Exif\0\0" + exif
    files = {"a.jpg": jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + jpeg[2:]}
    path = folder(tmp_path / "in", files, 'cfa = "MONO"\nbit_depth = 8\n')
    recordings = read_foreign("raw-folder", path)
    # in its lightest quality, JPEG rounds by a code or two
    np.testing.assert_allclose(recordings.frame(recordings.captures()[0]).astype(int), frame, atol=3)
    assert any("a.jpg: its Orientation is 6" in line for line in recordings.warnings)
    assert any("a.jpg: is a JPEG" in line for line in recordings.warnings)


@pytest.mark.parametrize("imagej", [False, True])
def test_pages_of_a_stack_are_frames(tmp_path: Path, imagej: bool) -> None:
    path = folder(tmp_path / "in", {}, 'cfa = "MONO"\nbit_depth = 12\n')
    stack = noise(shape=(5, 24, 32))
    for name in ("s0.tif", "s1.ome.tif"):
        how = {"metadata": {"axes": "TYX"}} | ({} if imagej else {"ome": "ome" in name})
        tifffile.imwrite(path / name, stack + 200 * ("1" in name), imagej=imagej, photometric="minisblack", **how)
    assert cv2.imwrite(str(path / "one.png"), stack[0])
    (path / "index.csv").write_text(
        "frame,kind,side,exposure_s,id,time\ns0.tif,dark,left,0.01,,2026-01-01T00:00:00Z\n"
        "s1.ome.tif,flat,left,0.01,lit,\none.png,dark,left,0.01,,\n"
    )
    recordings = read_foreign("raw-folder", path)
    assert [c.id for c in recordings.captures()] == [
        *(f"s0-p{k}" for k in range(1, 6)), *(f"lit-p{k}" for k in range(1, 6)), "one",
    ]  # fmt: skip
    for capture, frame in zip(recordings.captures(), [*stack, *(stack + 200), stack[0]], strict=True):
        np.testing.assert_array_equal(recordings.frame(capture), frame)
    (line,) = [line for line in recordings.warnings if "each page" in line]
    assert "s0.tif (5), s1.ome.tif (5)" in line


def test_pages_of_an_emva_image_are_images_of_its_level(tmp_path: Path) -> None:
    lines = ["n 12 32 24"]
    for level in range(4):
        tifffile.imwrite(tmp_path / f"b{level}.tif", noise(level, (3, 24, 32)) + 500 * level, photometric="minisblack")
        tifffile.imwrite(tmp_path / f"d{level}.tif", noise(10 + level, (3, 24, 32)), photometric="minisblack")
        lines += [f"b {level + 1} {100 * (level + 1)}", f"i b{level}.tif", f"d {level + 1}", f"i d{level}.tif"]
    (tmp_path / "data.txt").write_text("\n".join(lines) + "\n")
    recordings = read_foreign("emva1288", tmp_path)
    assert len(recordings.captures("flat")) == len(recordings.captures("dark")) == 12
    np.testing.assert_array_equal(recordings.frame(recordings.capture("b3-p3")), noise(3, (3, 24, 32))[2] + 1500)
    assert any("each page of b0.tif (3), d0.tif (3), b1.tif (3) and 5 more" in line for line in recordings.warnings)


def test_codes_of_an_emva_set_are_shifted_by_its_brightest_image(tmp_path: Path) -> None:
    """The first image is dark, and below the stated bits even when it is shifted up."""
    for name, mean in (("d", 40), ("b", 3000)):
        assert cv2.imwrite(str(tmp_path / f"{name}.png"), (noise() - 100 + mean) << 4)
    (tmp_path / "data.txt").write_text("n 12 32 24\nd 1\ni d.png\nb 1 100\ni b.png\n")
    recordings = read_foreign("emva1288", tmp_path)
    np.testing.assert_array_equal(recordings.frame(recordings.capture("d")), noise() - 60)
    (tmp_path / "data.txt").write_text("n 12 32 24\nd 1\ni d.png\ni e.png\nb 1 100\ni b.png\n")
    assert cv2.imwrite(str(tmp_path / "e.png"), noise())  # not shifted: it would lose four bits
    recordings = read_foreign("emva1288", tmp_path)
    with pytest.raises(InputError, match="its codes aren't multiples of 16"):
        recordings.frame(recordings.capture("e"))


def test_ids_of_one_name_in_several_folders_are_unique(tmp_path: Path) -> None:
    frames = {"cam0/00.png": noise(0), "cam1/00.png": noise(1), "01.png": noise(2), "cam1/01.png": noise(3)}
    path = folder(tmp_path / "in", frames, 'cfa = "MONO"\nbit_depth = 12\n')
    recordings = read_foreign("raw-folder", path)
    assert [c.id for c in recordings.captures()] == ["cam0-00", "cam1-00", "01", "cam1-01"]
    for capture, frame in zip(recordings.captures(), frames.values(), strict=True):
        np.testing.assert_array_equal(recordings.frame(capture), frame)
    with (path / "index.csv").open("a") as index:  # the same file for two captures
        index.write("01.png,dark,left,0.02\n")
    assert [c.id for c in read_foreign("raw-folder", path).captures()][-3:] == ["01", "cam1-01", "01-2"]


def raw(file: Path, cfa: Cfa, black: float = 64.0) -> None:
    bell = Spectrum.of(WAVE, 0.5 * np.exp(-0.5 * ((WAVE - 550.0) / 60.0) ** 2))
    camera = CameraModel(
        rows=24, cols=32, pixel_pitch_um=3.45, fill_factor=1.0, cfa=cfa, bit_depth=12, black_level_dn=black,
        white_level_dn=4000.0, conversion_gain_dn_per_e=0.4, full_well_e=1e4, read_noise_e=2.0,
        dark_current_e_per_s=5.0, dsnu_e=0.0, prnu_percent=0.0,
        quantum_efficiency=dict.fromkeys("Y" if cfa == "MONO" else "RGB", bell),
        lens=Lens(f_number=4.0, focal_length_mm=8.0),
    )  # fmt: skip
    write_raw(file, noise(), camera, RawMetadata(exposure_s=0.01))


@pytest.mark.parametrize(("own", "stated"), [("GBRG", "RGGB"), ("RGGB", "BGGR"), ("GRBG", "GBRG")])
@pytest.mark.parametrize("ending", ["dng", "tif"])
def test_a_mosaic_that_the_file_contradicts_is_refused(tmp_path: Path, own: Cfa, stated: Cfa, ending: str) -> None:
    raw(tmp_path / f"a.{ending}", own)
    (tmp_path / "index.csv").write_text(f"frame,kind,exposure_s\na.{ending},dark,0.01\n")
    (tmp_path / "camera.toml").write_text(f'cfa = "{stated}"\nbit_depth = 12\n')
    with pytest.raises(InputError, match=f"cfa = {stated} is stated, but the file's own mosaic is {own}"):
        read_foreign("raw-folder", tmp_path)
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 12\n')  # its filters may have been taken off
    assert any(
        f"the file's own mosaic is {own}; the former" in s for s in read_foreign("raw-folder", tmp_path).warnings
    )


@pytest.mark.parametrize(("pattern", "own"), [(b"\x01\x02\x00\x01", "GBRG"), (b"\x02\x01\x01\x00", "BGGR")])
def test_a_tiffs_own_mosaic_is_compared(tmp_path: Path, pattern: bytes, own: str) -> None:
    """CFARepeatPatternDim and CFAPattern of TIFF/EP, colours by number: R 0, G 1, B 2."""

    def write(dim: tuple[int, int], colours: bytes) -> None:
        tags = [(33421, SHORT, 2, dim, True), (33422, 1, len(colours), colours, True)]
        tifffile.imwrite(tmp_path / "a.tif", noise(), photometric="cfa", metadata=None, extratags=tags)

    write((2, 2), pattern)
    (tmp_path / "index.csv").write_text("frame,kind,exposure_s\na.tif,dark,0.01\n")
    (tmp_path / "camera.toml").write_text('cfa = "RGGB"\nbit_depth = 12\n')
    with pytest.raises(InputError, match=f"cfa = RGGB is stated, but the file's own mosaic is {own}"):
        read_foreign("raw-folder", tmp_path)
    (tmp_path / "camera.toml").write_text("bit_depth = 12\n")
    assert read_foreign("raw-folder", tmp_path).camera("left").cfa == own
    write((6, 6), bytes([1, 1, 0, 1, 1, 2] * 6))
    with pytest.raises(InputError, match="has a mosaic of 6 x 6 pixels in the colours GRB, not one of RGGB"):
        read_foreign("raw-folder", tmp_path)


@pytest.mark.parametrize("own", ["RGGB", "GBRG", "MONO"])
def test_a_raw_states_what_camera_toml_leaves_out(tmp_path: Path, own: Cfa) -> None:
    raw(tmp_path / "a.dng", own, black=72.0)
    (tmp_path / "index.csv").write_text("frame,kind,exposure_s\na.dng,dark,0.01\n")
    (tmp_path / "camera.toml").write_text("bit_depth = 12\n")
    recordings = read_foreign("raw-folder", tmp_path)
    assert (recordings.camera("left").cfa, recordings.camera("left").black_level_dn) == (own, 72.0)
    said = "\n".join(recordings.warnings)
    assert f"a.dng: cfa = {own}, black_level_dn = 72: not stated, and taken from this file" in said
    assert "the highest code is taken as 4095 DN (bit_depth), its file states 4000: state white_level_dn" in said
    (tmp_path / "camera.toml").write_text(
        f'cfa = "{own}"\nbit_depth = 12\nblack_level_dn = 64\nwhite_level_dn = 4095\n'
    )
    said = "\n".join(read_foreign("raw-folder", tmp_path).warnings)
    assert "black_level_dn = 64, its file states 72; the former is used" in said
    assert "white_level_dn = 4095, its file states 4000; the former is used" in said


def test_the_mosaic_counts_from_the_frame_as_it_is_read(tmp_path: Path) -> None:
    """The visible area of this DNG begins at an odd place of the sensor, and LibRaw makes it an even one: the letters
    follow the pixels, and the file's turn is reported."""
    sensor = np.full((40, 50), 500, np.uint16)
    visible = sensor[1:, 3:]
    visible[0::2, 0::2], visible[1::2, 1::2] = 100, 900
    tags: list[Any] = [(50706, 1, 4, (1, 4, 0, 0)), (33421, 3, 2, (2, 2)), (33422, 1, 4, (0, 1, 1, 2))]
    tags += [(50710, 1, 3, (0, 1, 2)), (50829, 4, 4, (1, 3, 40, 50)), (ORIENTATION, SHORT, 1, 6)]
    tags += [(50721, 10, 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1)), (50708, 2, 0, "x")]
    file = tmp_path / "a.dng"
    tifffile.imwrite(file, sensor, photometric=32803, metadata=None, extratags=[(*tag, True) for tag in tags])
    (tmp_path / "index.csv").write_text("frame,kind,exposure_s\na.dng,dark,0.01\n")
    (tmp_path / "camera.toml").write_text("bit_depth = 12\n")
    recordings = read_foreign("raw-folder", tmp_path)
    frame, cfa = recordings.frame(recordings.captures()[0]), recordings.camera("left").cfa
    level = {100: "R", 500: "G", 900: "B"}
    assert cfa == "".join(level[int(value)] for value in frame[:2, :2].ravel())
    assert any("its Orientation is 6" in line for line in recordings.warnings)
    assert sensor_facts(file, (40, 50)).cfa == cfa  # of the whole sensor: two rows and four columns more


@pytest.mark.parametrize(("bits", "shift"), [(12, 4), (10, 6), (14, 2)])
def test_codes_above_the_bit_depth_are_no_saturation(tmp_path: Path, bits: int, shift: int) -> None:
    y, x = np.mgrid[0:120, 0:140]
    edge = 1.0 / (1.0 + np.exp(-(x - 70 + 0.09 * (y - 60)) / 1.2))
    noisy = 0.1 + 0.5 * edge + np.random.default_rng(2).normal(0.0, 0.01, edge.shape)
    frame = np.rint(noisy * 2**bits).astype(np.uint16)
    assert cv2.imwrite(str(tmp_path / "edge.png"), frame << shift)
    (tmp_path / "camera.toml").write_text(f'cfa = "MONO"\nbit_depth = {bits}\nblack_level_dn = 0\n')
    options = ImportOptions(exposure_s=0.01, transfer="linear")
    words = f"multiples of {1 << shift}, as codes of {bits} bits shifted up by {shift} .* state bit_depth = 16"
    with pytest.raises(InputError, match=words):
        read_foreign("slanted-edge", tmp_path / "edge.png", options)
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\nblack_level_dn = 0\n')
    recordings = read_foreign("slanted-edge", tmp_path / "edge.png", options)
    np.testing.assert_array_equal(recordings.frame(recordings.captures()[0]), frame << shift)


def test_a_subsampled_jpeg_has_no_channel_of_its_own(tmp_path: Path) -> None:
    y, x = np.mgrid[0:120, 0:140]
    rng = np.random.default_rng(6)
    soft = [1.0 / (1.0 + np.exp(-(x - 70 + 0.09 * (y - 60)) / width)) for width in (2.0, 1.2, 0.8)]  # B, G, R
    colours = np.dstack([np.rint(30 + 150 * part + rng.normal(0.0, 2.0, part.shape)).astype(np.uint8) for part in soft])
    (tmp_path / "camera.toml").write_text("black_level_dn = 0\n")
    for factor, is_refused in ((0x221111, True), (0x211111, True), (0x111111, False)):
        how = [cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, factor]
        assert cv2.imwrite(str(tmp_path / "e.jpg"), colours, how)
        for channel in "RB":
            options = ImportOptions(exposure_s=0.01, transfer="linear", channel=channel)
            if is_refused:
                with pytest.raises(InputError, match="one sample of colour difference for 2 x"):
                    read_foreign("slanted-edge", tmp_path / "e.jpg", options)
            else:
                said = read_foreign("slanted-edge", tmp_path / "e.jpg", options).warnings
                assert any("is a JPEG" in line for line in said)
