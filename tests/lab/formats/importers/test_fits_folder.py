"""FITS frames: what their headers say, what an index adds, and one line for each that can't be used."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from lab.errors import InputError
from lab.fit.noise.noise_fit import fit_noise
from lab.formats import recording_set as recording
from lab.formats.importers import read_fits_folder, read_raw_folder
from lab.formats.importers.fits_file import FitsHeader, fits_header, load_fits
from lab.formats.importers.frame_settings import parse_choice
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
        (np.zeros((2, 4, 4), np.uint16), "holds 2 frames, not 1"),
        (np.zeros((3, 4, 4), np.uint16), "its 3 planes may be colours or frames"),
        (np.zeros((2, 2, 4, 4), np.uint16), "has the shape (2, 2, 4, 4)"),
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


# --- Flavours of FITS headers -----------------------------------------------------------------------------------------


def _header(tmp_path: Path, *cards: tuple[str, object, str]) -> FitsHeader:
    """The header of a file with these cards (keyword, value, comment)."""
    hdu = fits.PrimaryHDU(np.zeros((4, 6), np.uint16))
    hdu.header.extend(cards)
    hdu.writeto(tmp_path / "a.fits", overwrite=True)
    return fits_header(tmp_path / "a.fits")


@pytest.mark.parametrize(
    ("card", "exposure_s", "remark"),
    [
        (("EXPTIME", 2.0, "seconds"), 2.0, None),
        (("EXPTIME", 2.0, "[s] Exposure duration"), 2.0, None),
        (("EXPOSURE", 2.0, "Total Exposure Time (s)"), 2.0, None),
        (("EXPTIME", 2000.0, "[ms] exposure time"), 2.0, "EXPTIME = 2000.0 is in units of 0.001 s by its comment"),
        (("EXPTIME", 1500, "exposure time in milliseconds"), 1.5, "read as 1.5 s"),
        (("EXPOSURE", 250, "Exposure (us)"), 250e-6, "units of 1e-06 s"),
        (("EXPOINUS", 32000, "Exposure time in us"), 0.032, "in us by its name: read as 0.032 s"),
        (("EXPTIME", "1.0 s", ""), 1.0, None),
        (("EXPTIME", "40 ms", ""), 0.04, "by its value: read as 0.04 s"),
        (("EXPOSURE", "0,25", ""), 0.25, None),
    ],
)
def test_exposures_have_the_unit_that_their_header_states(
    tmp_path: Path, card: tuple[str, object, str], exposure_s: float, remark: str | None
) -> None:
    header = _header(tmp_path, card)
    assert header.exposure_s == pytest.approx(exposure_s, rel=1e-12)
    assert (len(header.remarks) == 0) if remark is None else (remark in header.remarks[0])


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ([("EXPTIME", "1.0 parsec", "")], "EXPTIME = '1.0 parsec' isn't a number"),
        ([("EXPTIME", "1,250", "")], "isn't a number"),  # perhaps a thousand
        ([("EXPTIME", 1.0, ""), ("EXPOSURE", 1000.0, "")], "two exposures (EXPTIME = 1 s, EXPOSURE = 1000 s)"),
        ([("EXPTIME", 5.0, "ms or seconds")], "states several units"),
        ([("EXPTIME", "5 ms", "[s]")], "states several units"),
    ],
)
def test_exposures_of_no_clear_unit_are_problems(
    tmp_path: Path, cards: list[tuple[str, object, str]], words: str
) -> None:
    header = _header(tmp_path, *cards)
    ((key, line),) = header.problems
    assert (key, header.exposure_s) == ("exposure_s", None)
    assert words in line


@pytest.mark.parametrize(
    ("card", "temperature_c", "words"),
    [
        (("CCD-TEMP", -10.0, ""), -10.0, ""),
        (
            ("CCD-TEMP", 263.15, ""),
            None,
            "263.15 is outside the -273.15 .. 125 degree C of a sensor, -10 degree C",
        ),
        (("DET-TEMP", 168.0, "detector"), None, "-105.15 degree C if in kelvin"),
        (
            ("CCD-TEMP", 263.15, "[K] sensor"),
            -10.0,
            "263.15 is in kelvin by its comment: read as -10 degree C",
        ),
        (("CCD-TEMP", 14.0, "[F] sensor"), -10.0, "14 is in degree F by its comment: read as -10 degree C"),
        (("CCD-TEMP", 14.0, "deg F"), -10.0, "14 is in degree F by its comment: read as -10 degree C"),
        (("CCD-TEMP", 14.0, "Filter housing"), 14.0, ""),
        (("TEMPERAT", -999.0, ""), None, "TEMPERAT = -999 is outside"),
        (("SET-TEMP", -20.0, ""), -20.0, "no measured temperature: the set point SET-TEMP = -20 degree C is used"),
        (("TEMP", "-65 C", ""), -65.0, ""),
    ],
)
def test_temperatures_are_in_degree_c_or_asked_for(
    tmp_path: Path, card: tuple[str, object, str], temperature_c: float | None, words: str
) -> None:
    header = _header(tmp_path, card)
    assert header.temperature_c == temperature_c
    assert words in "".join([*header.remarks, *(line for _, line in header.problems)])
    assert bool(words) == bool(header.remarks or header.problems)


@pytest.mark.parametrize(
    ("cards", "time"),
    [
        ([("DATE-OBS", "2026-01-02", ""), ("TIME-OBS", "10:03:01.5", "")], "2026-01-02T10:03:01.500000+00:00"),
        ([("DATE-OBS", "2026-01-02", ""), ("UT", "23:59:59", "")], "2026-01-02T23:59:59+00:00"),
        ([("DATE-OBS", "2026-01-02T03:04:05", ""), ("TIME-OBS", "10:03:01", "")], "2026-01-02T03:04:05+00:00"),
        ([("FRAME", "2017-07-14T00:00:58.642", "Start of Frame Exposure")], "2017-07-14T00:00:58.642000+00:00"),
        ([("DATE-OBS", "2026-01-02", "")], None),  # no midnight
        ([("DATE-OBS", "02/01/26", ""), ("TIME-OBS", "10:03:01", "")], None),
        ([("DATE-OBS", "2026-01-02T03:04:05", ""), ("TIMESYS", "TAI", "")], None),
    ],
)
def test_times_need_a_date_and_a_time_of_day(
    tmp_path: Path, cards: list[tuple[str, object, str]], time: str | None
) -> None:
    header = _header(tmp_path, *cards)
    assert (header.time.isoformat() if header.time else None) == time
    assert (time is None) == any("left out" in remark for remark in header.remarks)


@pytest.mark.parametrize(
    ("cards", "cfa"),
    [
        ([("BAYERPAT", "RGGB", "")], "RGGB"),
        ([("BAYERPAT", "GRBG", ""), ("ROWORDER", "TOP-DOWN", "")], "GRBG"),
        (
            [("BAYERPAT", "RGGB", ""), ("ROWORDER", "BOTTOM-UP", "")],
            "GBRG",
        ),  # 4 rows: the last row of the pattern first
        ([("BAYERPAT", "RGGB", ""), ("XBAYROFF", 1, "")], "GRBG"),
        ([("BAYERPAT", "RGGB", ""), ("YBAYROFF", 1, "")], "GBRG"),
        ([("BAYERPAT", "BGGR", ""), ("XBAYROFF", 1, ""), ("ROWORDER", "BOTTOM-UP", "")], "RGGB"),
        ([("BAYERPAT", "RGGB", ""), ("XBINNING", 2, "")], None),  # binning has mixed it
        ([("BAYERPAT", "TRUE", "")], None),
        ([], None),
    ],
)
def test_mosaics_begin_at_the_first_stored_pixel(
    tmp_path: Path, cards: list[tuple[str, object, str]], cfa: str | None
) -> None:
    assert _header(tmp_path, *cards).cfa == cfa


@pytest.mark.parametrize(
    ("image_type", "kind"),
    [
        ("Flat Field", "flat"),
        ("SKYFLAT", "flat"),
        ("DARKFLAT", "dark"),
        ("Bias Frame", "dark"),
        ("zero", "dark"),
        ("Offset", "dark"),
        ("Light Frame", None),
        ("Master Dark", None),
    ],
)
def test_image_types(tmp_path: Path, image_type: str, kind: str | None) -> None:
    header = _header(tmp_path, ("IMAGETYP", image_type, ""))
    assert (header.kind if header.stacked is None else None) == kind
    assert _header(tmp_path, ("FRAME", image_type, "")).image_type == (image_type if header.kind else None)


ELECTRONS, GAIN, READ_E = 4000.0, 0.5, 8.0


def _shot(rng: np.random.Generator, electrons: float, shape: tuple[int, ...] = (80, 120)) -> np.ndarray:
    return np.rint(1000 + GAIN * (rng.poisson(electrons, shape) + rng.normal(0, READ_E, shape))).astype(np.uint16)


def _flavour(path: Path, flavour: str) -> Path:
    """A set of flats of 1 to 5 s and bias frames, two each, in one flavour of FITS."""
    rng = np.random.default_rng(3)
    for s in range(6):
        codes = _shot(rng, ELECTRONS * s, (2, 80, 120))
        header = fits.Header([("IMAGETYP", "FLAT" if s else "BIAS"), ("EXPTIME", float(s)), ("CCD-TEMP", -10.0)])
        for k in range(2):
            file = path / ("flats" if s else "biases") / f"{s if flavour != 'folders' else max(s - 1, 0)}_{k}.fits"
            file = file if flavour == "folders" else path / file.name
            file.parent.mkdir(parents=True, exist_ok=True)
            if flavour == "axis":
                fits.PrimaryHDU(codes[k][None], header).writeto(file)
            elif flavour == "extension":
                fits.HDUList([fits.PrimaryHDU(header=header), fits.ImageHDU(codes[k])]).writeto(file)
            elif flavour == "packed":
                fits.HDUList([fits.PrimaryHDU(header=header), fits.CompImageHDU(codes[k])]).writeto(f"{file}.fz")
            elif flavour == "cube" and k == 0:
                fits.PrimaryHDU(codes, header).writeto(file)
            elif flavour == "scaled":
                halved = fits.PrimaryHDU((codes[k] // 2).astype(np.int16), header)
                halved.header["BSCALE"], halved.header["BZERO"] = 2.0, 0.0
                halved.writeto(file)
            elif flavour != "cube":
                fits.PrimaryHDU(codes[k], header).writeto(file)
    (path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\n')
    return path


@pytest.mark.parametrize("flavour", ["plain", "axis", "extension", "packed", "cube", "scaled", "folders"])
def test_flavours_of_files_are_read_alike(tmp_path: Path, flavour: str) -> None:
    read = read_fits_folder(_flavour(tmp_path / "in", flavour))
    recordings = recording.read(recording.write(read, tmp_path / "out"))
    assert len({capture.id for capture in recordings.captures()}) == len(recordings.captures()) == 12
    assert {capture.temperature_c for capture in recordings.captures()} == {-10.0}
    assert sorted(capture.exposure_s for capture in recordings.captures("flat")) == [1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    fitted = fit_noise(recordings, "left")
    assert fitted.conversion_gain_dn_per_e == pytest.approx(GAIN, abs=3 * fitted.conversion_gain_dn_per_e_std)
    assert fitted.read_noise_e == pytest.approx(READ_E, abs=3 * fitted.read_noise_e_std)
    said = "\n".join(read.warnings)
    assert ("BSCALE = 2: codes are multiples of it" in said) == (flavour == "scaled")
    assert ("each page of 0_0.fits (2), 1_0.fits (2), 2_0.fits (2) and 3 more" in said) == (flavour == "cube")
    assert ("the frames are those of its subfolders: biases (2), flats (10)" in said) == (flavour == "folders")


def test_frames_beside_subfolders_are_read_alone(tmp_path: Path) -> None:
    folder = _flavour(tmp_path / "in", "plain")
    (folder / "rejected").mkdir()
    (folder / "5_1.fits").rename(folder / "rejected" / "5_1.fits")
    read = read_fits_folder(folder)
    assert len(read.captures()) == 11
    assert f"{folder}: frames in its subfolders are left out: rejected (1); move them here, or write index.csv" in (
        read.warnings
    )


def test_two_images_of_a_file_are_refused_with_both_remedies(tmp_path: Path) -> None:
    for k in range(2):
        image = np.full((4, 6), 7 + k, np.uint16)
        header = fits.Header([("IMAGETYP", "FLAT"), ("EXPTIME", 1.0)])
        parts = [fits.PrimaryHDU(header=header), fits.ImageHDU(image, name="AMP1"), fits.ImageHDU(image)]
        fits.HDUList(parts).writeto(tmp_path / f"a{k}.fits")
    with pytest.raises(RecordingError) as caught:
        read_fits_folder(tmp_path)
    (line,) = caught.value.problems
    assert line == (
        f"{tmp_path}/a0.fits and 1 more: holds 2 images, not 1 (AMP1, extension 2); where they are the outputs of one "
        "sensor, join them to one image and describe them by [[taps]] in camera.toml; where they are frames, save one "
        "file a frame"
    )


@pytest.mark.parametrize(
    ("stated", "order", "taken"),
    [
        ("", "TOP-DOWN", "RGGB"),
        ("", "BOTTOM-UP", "GBRG"),
        ('cfa = "GBRG"', "BOTTOM-UP", "GBRG"),
        ('cfa = "RGGB"', "BOTTOM-UP", None),
        ('cfa = "BGGR"', "TOP-DOWN", None),
    ],
)
def test_a_mosaic_that_contradicts_the_header_is_refused(
    tmp_path: Path, stated: str, order: str, taken: str | None
) -> None:
    _write(tmp_path / "a.fits", _shot(np.random.default_rng(1), 50.0, (6, 8)), IMAGETYP="DARK", EXPTIME=1.0)
    fits.setval(tmp_path / "a.fits", "BAYERPAT", value="RGGB")
    fits.setval(tmp_path / "a.fits", "ROWORDER", value=order)
    (tmp_path / "camera.toml").write_text(f"bit_depth = 16\n{stated}\n")
    if taken is not None:
        assert read_fits_folder(tmp_path).camera("left").cfa == taken
        return
    with pytest.raises(InputError, match=rf"the file's own mosaic is .*ROWORDER = {order}; where that is wrong, --ign"):
        read_fits_folder(tmp_path)
    assert read_fits_folder(tmp_path, choice=parse_choice("", "BAYERPAT")).camera("left").cfa == stated[7:11]


def test_temperatures_and_problems_of_headers_reach_the_set(tmp_path: Path) -> None:
    """An index that has the value needs no header; one of raws takes the temperatures from the headers."""
    rng = np.random.default_rng(2)
    for k, kelvin in enumerate((263.15, 263.2)):
        frame = _shot(rng, 50.0, (24, 32))
        _write(tmp_path / f"a{k}.fits", frame, IMAGETYP="DARK", EXPTIME=2.0, CCD_TEMP=kelvin, XPIXSZ=3.76)
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\npixel_pitch_um = 2.4\n')
    with pytest.raises(RecordingError) as caught:
        read_fits_folder(tmp_path)
    (line,) = caught.value.problems
    assert "a0.fits and 1 more: CCD-TEMP = 263.15 is outside" in line
    assert {c.temperature_c for c in read_fits_folder(tmp_path, choice=parse_choice("", "CCD-TEMP")).captures()} == {
        None
    }
    (tmp_path / "index.csv").write_text("frame,kind,temperature_c\na0.fits,dark,-10\na1.fits,dark,-9.9\n")
    read = read_fits_folder(tmp_path)
    assert [c.temperature_c for c in read.captures()] == [-10.0, -9.9]
    assert "CCD-TEMP" not in "".join(read.warnings)
    assert any("pixel_pitch_um = 2.4 um, its FITS header says 3.76 um" in line for line in read.warnings)
    for k in range(2):
        fits.setval(tmp_path / f"a{k}.fits", "CCD-TEMP", value=20.0 + k)
    (tmp_path / "index.csv").write_text("frame,kind,exposure_s\na0.fits,dark,2\na1.fits,dark,2\n")
    read = read_raw_folder(tmp_path)
    assert [c.temperature_c for c in read.captures()] == [20.0, 21.0]
    assert any("temperature_c = 20 .. 21 degree C by its FITS header" in line for line in read.warnings)


def test_frames_that_are_made_of_several_are_no_frames(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    _write(tmp_path / "a.fits", _shot(rng, 50.0, (24, 32)), IMAGETYP="DARK", EXPTIME=2.0)
    _write(tmp_path / "b.fits", _shot(rng, 50.0, (24, 32)), IMAGETYP="DARK", EXPTIME=2.0, NCOMBINE=20)
    _write(tmp_path / "c.fits", _shot(rng, 50.0, (24, 32)), IMAGETYP="Master Bias", EXPTIME=0.0)
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\n')
    read = read_fits_folder(tmp_path)
    assert [capture.id for capture in read.captures()] == ["a"]
    assert "left out: NCOMBINE = 20 (made of several frames): b.fits; image type Master Bias" in read.warnings[-1]
    (tmp_path / "index.csv").write_text("frame,kind\na.fits,dark\nb.fits,dark\n")
    with pytest.raises(RecordingError, match=r"b.fits: NCOMBINE = 20: made of several frames, whose noise isn't one"):
        read_fits_folder(tmp_path)


def test_a_line_for_many_files_says_where_their_values_differ(tmp_path: Path) -> None:
    for k, set_point in enumerate((-10.0, -10.0, -20.0)):
        hdu = fits.PrimaryHDU(np.full((24, 32), 1000 + k, np.uint16))
        hdu.header.update({"IMAGETYP": "Bias Frame", "EXPTIME": 0.0, "SET-TEMP": set_point})
        hdu.writeto(tmp_path / f"b{k}.fits")
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\n')
    recordings = read_fits_folder(tmp_path)
    assert [capture.temperature_c for capture in recordings.captures()] == [-10.0, -10.0, -20.0]
    assert any(
        "b0.fits and 2 more: no measured temperature: the set point SET-TEMP = -10 degree C is used (others have other "
        "values)" in line
        for line in recordings.warnings
    )
