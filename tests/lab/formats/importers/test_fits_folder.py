"""FITS frames: what their headers say, what an index adds, and one line for each that can't be used."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from lab.errors import InputError
from lab.formats import recording_set as recording
from lab.formats.importers import read_fits_folder
from lab.formats.importers.fits_file import load_fits
from lab.formats.recording_set import RecordingError

ROWS, COLS = 24, 32


def _write(file: Path, frame: np.ndarray, **header: object) -> None:
    hdu = fits.PrimaryHDU(frame)
    for key, value in header.items():
        hdu.header[key.replace("_", "-")] = value
    hdu.writeto(file, checksum=True)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two darks, two flats and an object frame of a 16-bit camera."""
    rng = np.random.default_rng(5)
    path = tmp_path / "in"
    path.mkdir()
    for k in range(2):
        dark = rng.integers(990, 1010, (ROWS, COLS)).astype(np.uint16)
        flat = rng.integers(39000, 41000, (ROWS, COLS)).astype(np.uint16)  # above 32767: stored with BZERO
        _write(path / f"dark{k}.fits", dark, IMAGETYP="Dark Frame", EXPTIME=2.5, CCD_TEMP=-10.0)
        _write(path / f"flat{k}.fit", flat, IMAGETYP="FLAT", EXPOSURE=0.02, DATE_OBS="2026-03-02T10:00:00.5")
    _write(path / "m31.fits", dark, IMAGETYP="Light Frame", EXPTIME=60.0)
    (path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\n')
    return path


def test_headers_become_captures_and_frames_stay_bit_exact(folder: Path, tmp_path: Path) -> None:
    read = read_fits_folder(folder)
    recordings = recording.read(recording.write(read, tmp_path / "out"))
    darks, flats = recordings.captures("dark"), recordings.captures("flat")
    assert [c.exposure_s for c in (*darks, *flats)] == [2.5, 2.5, 0.02, 0.02]
    assert {c.temperature_c for c in darks} == {-10.0}
    assert flats[0].time is not None
    assert flats[0].time.isoformat().startswith("2026-03-02T10:00:00.5")
    for capture, file in ((darks[1], "dark1.fits"), (flats[0], "flat0.fit")):
        np.testing.assert_array_equal(recordings.frame(capture), fits.getdata(folder / file))
    (said,) = [text for text in read.warnings if "left out" in text]
    assert "IMAGETYP Light Frame: m31.fits" in said


def test_an_index_says_what_headers_cannot(folder: Path) -> None:
    (folder / "index.csv").write_text("frame,kind,exposure_s\nm31.fits,flat,\nflat0.fit,flat,0.5\n")
    captures = read_fits_folder(folder).captures()
    assert [(c.kind, c.exposure_s) for c in captures] == [("flat", 60.0), ("flat", 0.5)]  # the index wins


def test_what_cannot_be_used_is_one_line_each(folder: Path) -> None:
    whole = (folder / "dark0.fits").read_bytes()
    (folder / "dark0.fits").write_bytes(whole[: len(whole) - 2880])  # the last block is gone
    changed = bytearray((folder / "dark1.fits").read_bytes())
    changed[2880 + 100] ^= 0xFF  # a bit of the data, which the checksum covers
    (folder / "dark1.fits").write_bytes(changed)
    _write(folder / "x.fits", np.zeros((ROWS, COLS), np.uint16), IMAGETYP="dark")
    _write(folder / "y.fits", np.zeros((ROWS, COLS), np.uint16), IMAGETYP="dark", EXPTIME="long")
    with pytest.raises(RecordingError) as caught:
        read_fits_folder(folder)
    lines = str(caught.value).splitlines()
    assert len(lines) == 4
    assert "dark0.fits: damaged FITS" in lines[0]
    assert "dark1.fits: damaged FITS" in lines[1]
    assert "x.fits: its header has no EXPTIME" in lines[2]
    assert "EXPTIME = 'long' isn't a number" in lines[3]


def test_frames_that_gzip_has_packed(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = read_fits_folder(folder)
    for file in list(folder.glob("*.fit*")):
        (folder / f"{file.name}.gz").write_bytes(gzip.compress(file.read_bytes()))
        file.unlink()
    recordings = recording.read(recording.write(read_fits_folder(folder), tmp_path / "out"))
    assert [(c.id, c.kind, c.exposure_s) for c in recordings.captures()] == [
        (c.id, c.kind, c.exposure_s) for c in plain.captures()
    ]
    np.testing.assert_array_equal(recordings.frame(recordings.captures("flat")[1]), load_fits(folder / "flat1.fit.gz"))
    monkeypatch.setattr("lab.formats.importers.fits_file.LARGEST_BYTES", 2000)
    with pytest.raises(InputError, match="holds more than the limit of 2000 bytes; save one frame a file"):
        load_fits(folder / "flat1.fit.gz")
    packed = (folder / "flat1.fit.gz").read_bytes()
    for damaged in (packed[:-20], b"\x1f\x8bnothing", b""):
        (folder / "flat1.fit.gz").write_bytes(damaged)
        with pytest.raises(InputError, match=r"damaged FITS \(.*\); copy it again"):
            load_fits(folder / "flat1.fit.gz")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.zeros((2, 4, 4), np.uint16), "has the shape (2, 4, 4)"),
        (np.full((4, 4), -3, np.int16), "raw DN are 0 .. 65535"),
        (np.full((4, 4), 70000, np.int32), "raw DN are 0 .. 65535"),
        (np.full((4, 4), 0.5, np.float32), "with fractions"),
    ],
)
def test_frames_that_are_no_raw_codes_are_refused(tmp_path: Path, values: np.ndarray, words: str) -> None:
    _write(tmp_path / "a.fits", values)
    with pytest.raises(InputError) as caught:
        load_fits(tmp_path / "a.fits")
    assert words in str(caught.value)


def test_several_images_in_a_file_are_refused(tmp_path: Path) -> None:
    image = np.zeros((4, 4), np.uint16)
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(image), fits.ImageHDU(image)]).writeto(tmp_path / "a.fits")
    with pytest.raises(InputError, match="holds 2 images, not 1"):
        load_fits(tmp_path / "a.fits")
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(image + 7)]).writeto(tmp_path / "b.fits")
    assert load_fits(tmp_path / "b.fits").max() == 7


def test_a_folder_without_a_statement_asks_for_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no FITS frames"):
        read_fits_folder(tmp_path)
    _write(tmp_path / "a.fits", np.zeros((ROWS, COLS), np.uint16), EXPTIME=1.0)
    with pytest.raises(InputError, match=r"no frame says that it is dark or flat .*write index\.csv"):
        read_fits_folder(tmp_path)
    (tmp_path / "index.csv").write_text("frame,kind\na.fits,dark\n")
    with pytest.raises(InputError, match=r"camera\.toml: missing"):
        read_fits_folder(tmp_path)
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\n')
    with pytest.raises(InputError, match="bit_depth"):  # 16-bit files may hold 10 to 16
        read_fits_folder(tmp_path)
