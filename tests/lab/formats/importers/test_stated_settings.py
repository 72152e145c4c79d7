"""What an index states against the frames' own files: EXIF of JPEG, PNG and TIFF, FITS headers, raws; units, moved
rows, and times."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from astropy.io import fits

from lab.errors import InputError
from lab.foreign_recordings import read_foreign
from lab.formats import recording_set as recording
from lab.formats.importers import read_raw_folder
from lab.formats.importers.frame_settings import parse_choice
from lab.formats.importers.single_picture import ImportOptions
from lab.formats.importers.stated_settings import frame_header
from lab.formats.recording_set import RecordingError

EXPOSURE, F_NUMBER, ISO, EXIF_IFD = 33434, 33437, 34855, 34665


def _exif(exposure_s: tuple[int, int], f_number: tuple[int, int] = (28, 10), iso: int = 100) -> bytes:
    """EXIF (big-endian TIFF): the pointer to its directory, exposure and f-number as fractions, ISO speed."""
    outer = struct.pack(">2sHIHHHIII", b"MM", 42, 8, 1, EXIF_IFD, 4, 1, 26, 0)
    entries = struct.pack(">HHII", EXPOSURE, 5, 1, 68) + struct.pack(">HHII", F_NUMBER, 5, 1, 76)
    entries += struct.pack(">HHIHH", ISO, 3, 1, iso, 0)
    return outer + struct.pack(">H", 3) + entries + struct.pack(">I", 0) + struct.pack(">IIII", *exposure_s, *f_number)


def _jpeg(file: Path, exif: bytes, level: int = 90) -> None:
    data = cv2.imencode(".jpg", np.full((16, 24), level, np.uint8))[1].tobytes()
    block = b"Exif\0\0" + exif
    file.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + data[2:])


def _png(file: Path, exif: bytes) -> None:
    data = cv2.imencode(".png", np.full((16, 24), 90, np.uint8))[1].tobytes()
    chunk = b"eXIf" + exif
    packed = struct.pack(">I", len(exif)) + chunk + struct.pack(">I", zlib.crc32(chunk))
    file.write_bytes(data[:33] + packed + data[33:])


def _tiff(file: Path, exposure_s: tuple[int, int], frame: np.ndarray | None = None) -> None:
    tags = [(EXPOSURE, 5, 1, exposure_s, True), (F_NUMBER, 5, 1, (28, 10), True)]
    frame = np.full((16, 24), 90, np.uint16) if frame is None else frame
    tifffile.imwrite(file, frame, photometric="minisblack", metadata=None, extratags=tags)


def _fits(file: Path, exposure_s: float) -> None:
    hdu = fits.PrimaryHDU(np.full((16, 24), 90, np.uint16))
    hdu.header["EXPTIME"], hdu.header["CCD-TEMP"] = exposure_s, -10.0
    hdu.writeto(file, overwrite=True)


def _folder(path: Path, rows: list[str], camera: str = "", columns: str = "frame,kind,exposure_s") -> Path:
    path.mkdir(exist_ok=True)
    (path / "index.csv").write_text(f"{columns}\n" + "".join(f"{row}\n" for row in rows))
    (path / "camera.toml").write_text(f'cfa = "MONO"\nbit_depth = 8\n{camera}')
    return path


@pytest.mark.parametrize(
    ("name", "write", "source"),
    [
        ("a.jpg", lambda file: _jpeg(file, _exif((1, 60))), "EXIF"),
        ("a.png", lambda file: _png(file, _exif((1, 60))), "EXIF"),
        ("a.tif", lambda file: _tiff(file, (1, 60)), "EXIF"),
        ("a.fits", lambda file: _fits(file, 1 / 60), "FITS header"),
    ],
)
def test_headers_of_all_formats(tmp_path: Path, name: str, write: Callable[[Path], None], source: str) -> None:
    write(tmp_path / name)
    header = frame_header(tmp_path / name)
    assert header is not None
    assert (header.source, header.exposure_s) == (source, pytest.approx(1 / 60))
    assert header.f_number == (2.8 if source == "EXIF" else None)
    assert header.temperature_c == (None if source == "EXIF" else -10.0)
    assert header.iso == (100 if name in ("a.jpg", "a.png") else None)


def test_damaged_headers_are_unknown(tmp_path: Path) -> None:
    """Each file is cut or changed at random; what can't be read states nothing, and nothing is raised."""
    rng = np.random.default_rng(3)
    for name, write in (("a.jpg", _jpeg), ("a.png", _png)):
        write(tmp_path / name, _exif((1, 60)))
        whole = (tmp_path / name).read_bytes()
        for _ in range(25):
            changed = bytearray(whole[: rng.integers(2, 200)])
            changed[rng.integers(len(changed))] = rng.integers(256)
            (tmp_path / name).write_bytes(changed)
            frame_header(tmp_path / name)
    (tmp_path / "a.dng").write_bytes(b"II*\0nothing")
    assert frame_header(tmp_path / "a.dng") is None
    _jpeg(tmp_path / "b.jpg", _exif((0, 1), (0, 0), 0))  # as a camera without the lens's contacts writes it
    header = frame_header(tmp_path / "b.jpg")
    assert header is not None
    assert (header.exposure_s, header.f_number, header.iso) == (None, None, None)


@pytest.mark.parametrize(
    ("stated_s", "contradicts"),
    [("0.0166667", False), ("0.015625", False), ("0.0181", False), ("0.02", True), ("0.0125", True)],
)
def test_a_marked_shutter_is_half_of_a_third_of_a_stop_wide(tmp_path: Path, stated_s: str, contradicts: bool) -> None:
    """1/60 s is 1/64 s. The next markings, 1/50 and 1/80 s, are others."""
    folder = _folder(tmp_path, [f"a.jpg,flat,{stated_s}"])
    _jpeg(folder / "a.jpg", _exif((1, 60)))
    said = [line for line in read_raw_folder(folder).warnings if "EXIF" in line]
    assert bool(said) == contradicts
    if contradicts:
        assert said == [
            (
                f"{folder}/a.jpg: exposure_s = {float(stated_s):g} s, its EXIF says 0.0166667 s; the former is used: "
                "correct what is wrong"
            )
        ]


@pytest.mark.parametrize(("stated_s", "contradicts"), [("0.509", False), ("0.512", True)])
def test_a_fits_exposure_is_measured(tmp_path: Path, stated_s: str, contradicts: bool) -> None:
    """Beyond 2 %: 0.51 s of 0.5 s."""
    folder = _folder(tmp_path, [f"a.fits,dark,{stated_s},20"], columns="frame,kind,exposure_s,temperature_c")
    _fits(folder / "a.fits", 0.5)
    warnings = read_raw_folder(folder).warnings
    assert any("its FITS header says 0.5 s" in line for line in warnings) == contradicts
    assert any("temperature_c = 20 degree C, its FITS header says -10 degree C" in line for line in warnings)


def test_apertures_and_gains_are_held_against_exif(tmp_path: Path) -> None:
    folder = _folder(
        tmp_path,
        ["a.jpg,flat,0.1,", "b.jpg,flat,0.1,12", "c.jpg,flat,0.1,"],
        "f_number = 2.83\n",
        "frame,kind,exposure_s,gain_db",
    )
    for name, f_number, iso in (("a", (28, 10), 100), ("b", (28, 10), 400), ("c", (4, 1), 400)):
        _jpeg(folder / f"{name}.jpg", _exif((1, 10), f_number, iso))
    with pytest.raises(RecordingError) as caught:
        read_raw_folder(folder)
    gain, aperture = caught.value.problems
    assert gain == (
        f"{folder}/index.csv: ISO (ISO speed) differs between frames that are fitted together: 100 in 1 frame (a.jpg), "
        "400 in 1 frame (c.jpg); import one group, --only ISO=100, or give each group its own gain_db (dB) in "
        "index.csv; where the header is wrong, --ignore ISO"
    )
    assert "FNumber (f-number) differs between frames that are fitted together: 2.8 in 2 frames" in aperture
    alone = read_raw_folder(folder, choice=parse_choice("FNumber=2.8", ""))  # b is 12 dB above a, as its ISO speed
    assert [capture.id for capture in alone.captures()] == ["a", "b"]
    (told,) = [
        line
        for line in read_raw_folder(folder, choice=parse_choice("ISO=400,FNumber=4", "")).warnings
        if "EXIF" in line
    ]
    assert told == f"{folder}/c.jpg: f_number = 2.83, its EXIF says 4; the former is used: correct what is wrong"
    rows = ["a.jpg,flat,0.1,0", "b.jpg,flat,0.1,6"]
    (told,) = [
        line
        for line in read_raw_folder(_folder(tmp_path, rows, "", "frame,kind,exposure_s,gain_db")).warnings
        if "ISO" in line
    ]
    assert told == (
        f"{folder}/b.jpg: its EXIF says ISO 400 and that of a.jpg ISO 100, +12.0 dB, but gain_db is 6 dB; write the "
        "gain of each into the column gain_db"
    )


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds")])
def test_exposures_in_another_unit_are_refused(tmp_path: Path, factor: float, unit: str) -> None:
    folder = _folder(tmp_path, [f"a{k}.jpg,flat,{factor * 0.0001 * k:g}" for k in (1, 2)])
    for k in (1, 2):
        _jpeg(folder / f"a{k}.jpg", _exif((k, 10000)))
    with pytest.raises(InputError) as caught:
        read_raw_folder(folder)
    assert str(caught.value) == (
        f"{folder}/a1.jpg: exposure_s = {factor * 0.0001:g} s, its EXIF says 0.0001 s (so do 1 more): it seems to be "
        f"in {unit}; write seconds"
    )


def test_exposures_that_no_frame_has_are_refused_or_told(tmp_path: Path) -> None:
    folder = _folder(tmp_path, ["a.png,dark,10000", "b.png,flat,20000"])
    for name in "ab":
        cv2.imwrite(str(folder / f"{name}.png"), np.full((16, 24), 90, np.uint8))
    with pytest.raises(
        InputError, match=r"a\.png: exposure_s = 10000 is beyond the limit of 3600 s, and 1 more, and no header"
    ):
        read_raw_folder(folder)
    _folder(tmp_path, ["a.png,dark,100", "b.png,flat,200"])
    said = [line for line in read_raw_folder(folder).warnings if "exposure_s" in line]
    assert said == [
        (
            f"{folder}/b.png: exposure_s = 200 of a flat, beyond 60 s of light: check that it is in seconds, not in "
            "milliseconds or microseconds"
        )
    ]
    columns = "frame,kind,exposure_s,time"
    _folder(tmp_path, ["a.png,dark,100,2026-01-01T10:00:00Z", "b.png,dark,50,2026-01-01T10:00:03Z"], columns=columns)
    said = [line for line in read_raw_folder(folder).warnings if "exposure_s" in line]
    assert said == [
        (
            f"{folder}/a.png: exposure_s = 100, but b.png of 50 s was taken 3 s later; check that exposures are in "
            "seconds, and the times"
        )
    ]
    _folder(tmp_path, ["a.png,dark,3.9,2026-01-01T10:00:00Z", "b.png,dark,50,2026-01-01T10:00:03Z"], columns=columns)
    assert not [line for line in read_raw_folder(folder).warnings if "exposure_s" in line]


def test_a_long_exposure_that_its_header_states_is_taken(tmp_path: Path) -> None:
    folder = _folder(tmp_path, ["a.fits,dark,7200", "b.fits,flat,100"])
    for name, exposure_s in (("a", 7200.0), ("b", 100.0)):
        _fits(folder / f"{name}.fits", exposure_s)
    assert not [line for line in read_raw_folder(folder).warnings if "exposure_s" in line]


@pytest.mark.parametrize("by", [1, -1])
def test_rows_that_are_moved_against_their_frames_are_refused(tmp_path: Path, by: int) -> None:
    exposures = [(1, 100), (1, 100), (1, 50), (1, 50), (1, 25), (1, 25)]
    rows = [
        f"a{k}.jpg,flat,{exposures[min(max(k + by, 0), 5)][0] / exposures[min(max(k + by, 0), 5)][1]}" for k in range(6)
    ]
    folder = _folder(tmp_path, rows)
    for k, exposure_s in enumerate(exposures):
        _jpeg(folder / f"a{k}.jpg", _exif(exposure_s))
    with pytest.raises(InputError) as caught:
        read_raw_folder(folder)
    where = "the rows before" if by < 0 else "the next rows"
    assert "2 of 6 exposures contradict their frames" in str(caught.value)
    assert f"fit those of the frames of {where}: move the column of the frames by one row" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_picture_is_held_against_its_exif(tmp_path: Path) -> None:
    """The picture is a blurred edge at 5 degrees with noise."""
    row, col = np.mgrid[0:160, 0:200]
    across = (col - 100) * np.cos(0.087) + (row - 80) * np.sin(0.087)
    lit = 400 + 3000 / (1 + np.exp(-across / 0.6)) + np.random.default_rng(2).normal(0, 8, across.shape)
    _tiff(tmp_path / "edge.tif", (1, 60), np.rint(lit).astype(np.uint16))
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 12\nblack_level_dn = 64\n')
    options = ImportOptions(exposure_s=0.1, transfer="linear")
    read = read_foreign("slanted-edge", tmp_path / "edge.tif", options)
    told = "edge.tif: exposure_s = 0.1 s, its EXIF says 0.0166667 s; the former is used: correct what is wrong"
    assert any(line.endswith(told) for line in read.warnings)
    written = recording.read(recording.write(read, tmp_path / "out"))
    assert told in written.manifest.notes.splitlines()  # kept, without the folder it came from


def _named(file: Path, serial: str, balance: int = 1) -> None:
    tags = [(271, 2, 0, "NIKON CORPORATION", True), (272, 2, 0, "NIKON D810", True), (42033, 2, 0, serial, True)]
    tags.append((41987, 3, 1, balance, True))
    frame = np.full((16, 24), 90, np.uint8)
    tifffile.imwrite(file, frame, photometric="minisblack", metadata=None, software=False, extratags=tags)


def test_the_cameras_that_the_frames_name_go_into_the_set(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "d", ["a.tif,dark,0.1", "b.tif,dark,0.1"])
    for name in "ab":
        _named(folder / f"{name}.tif", "6001234")
    recordings = read_foreign("raw-folder", folder)
    camera = recordings.manifest.instruments["camera left"]
    assert (camera.maker, camera.model, camera.serial_number) == ("NIKON CORPORATION", "NIKON D810", "6001234")
    assert camera.settings == {"WhiteBalance": "manual"}
    assert recording.read(recording.write(recordings, tmp_path / "set")).manifest.instruments == {"camera left": camera}
    _named(folder / "b.tif", "6009999")
    with pytest.raises(RecordingError) as caught:
        read_foreign("raw-folder", folder)
    (line,) = caught.value.problems
    assert (
        "BodySerialNumber (camera) differs between frames that are fitted together: 6001234 in 1 frame (a.tif)" in line
    )
    assert "give each camera its own side in index.csv" in line
