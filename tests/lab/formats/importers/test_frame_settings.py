"""Settings that differ between the frames of one import: grouped by what separates them, or refused in one line."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from lab.errors import InputError
from lab.fit.noise.noise_fit import fit_noise
from lab.foreign_recordings import read_foreign
from lab.formats import recording_set as recording
from lab.formats.importers import read_fits_folder, read_raw_folder
from lab.formats.importers.frame_settings import ALL_FRAMES, KEYWORDS, SETTINGS, SharedBy, is_same, parse_choice
from lab.formats.importers.single_picture import ImportOptions
from lab.formats.recording_set import RecordingError

SHAPE = (64, 96)
OFFSET_DN, READ_E = 1000.0, 8.0


def _write(file: Path, rng: np.random.Generator, electrons: float, gain: float, header: Mapping[str, object]) -> None:
    """A frame of `gain` DN/e and a read noise of `READ_E`."""
    codes = OFFSET_DN + gain * (rng.poisson(electrons, SHAPE) + rng.normal(0, READ_E, SHAPE))
    file.parent.mkdir(parents=True, exist_ok=True)
    hdu = fits.PrimaryHDU(np.clip(np.rint(codes), 0, 65535).astype(np.uint16))
    hdu.header.update(header)
    hdu.writeto(file)


def _darks_and_flats(path: Path, gains: Mapping[object, float], rates: Mapping[object, float], key: str) -> Path:
    """Two bias frames and five levels of flats at each value of a keyword, two frames each. `gains`: DN/e by value;
    `rates`: electrons a second."""
    rng = np.random.default_rng(3)
    for value, gain in gains.items():
        for k in range(2):
            head = {key: value, "EXPTIME": 0.0, "IMAGETYP": "Bias Frame"}
            _write(path / f"bias-{value}-{k}.fits", rng, 0.0, gain, head)
            for s in (1, 2, 3, 4, 5):
                head = {key: value, "EXPTIME": float(s), "IMAGETYP": "Flat Field"}
                _write(path / f"flat-{value}-{s}-{k}.fits", rng, rates[value] * s, gain, head)
    (path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\n')
    return path


def _assert_noise(recordings: recording.RecordingSet, gain: float) -> None:
    fitted = fit_noise(recordings, "left")
    assert fitted.conversion_gain_dn_per_e == pytest.approx(gain, abs=3 * fitted.conversion_gain_dn_per_e_std)
    assert fitted.read_noise_e == pytest.approx(READ_E, abs=3 * fitted.read_noise_e_std)


def test_frames_at_two_gains_are_refused_and_imported_one_by_one(tmp_path: Path) -> None:
    folder = _darks_and_flats(tmp_path / "in", {100: 0.5, 40: 0.25}, {100: 8000.0, 40: 16000.0}, "GAIN")
    with pytest.raises(RecordingError) as caught:
        read_fits_folder(folder)
    (line,) = caught.value.problems
    assert line == (
        f"{folder}: GAIN (gain) differs between frames that are fitted together: 100 in 12 frames (bias-100-0.fits, "
        "bias-100-1.fits .. flat-100-5-1.fits), 40 in 12 frames (bias-40-0.fits, bias-40-1.fits .. flat-40-5-1.fits); "
        "import one group, --only GAIN=100, or give each group its own gain_db (dB) in index.csv; where the header is "
        "wrong, --ignore GAIN"
    )
    for setting, gain in (("GAIN=100", 0.5), ("GAIN=40", 0.25)):
        read = read_foreign("fits", folder, ImportOptions(only=setting))
        assert f"{folder}: --only {setting}: 12 of 24 frames left out: bias-" in "\n".join(read.warnings)
        _assert_noise(read, gain)
    with pytest.raises(InputError, match=r"--only GAIN=70: no frame's header states that, they state 100, 40; correct"):
        read_foreign("fits", folder, ImportOptions(only="GAIN=70"))


def test_a_bias_at_another_gain_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    for k in range(2):
        _write(tmp_path / f"bias{k}.fits", rng, 0.0, 0.25, {"GAIN": 40, "EXPTIME": 0.0, "IMAGETYP": "BIAS"})
        _write(tmp_path / f"flat{k}.fits", rng, 9000.0, 0.5, {"GAIN": 100, "EXPTIME": 1.0, "IMAGETYP": "FLAT"})
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\n')
    with pytest.raises(RecordingError, match=r"40 in 2 frames \(bias0.fits, bias1.fits\), 100 in 2 frames"):
        read_fits_folder(tmp_path)


def test_filters_concern_flats_of_one_stated_light_alone(tmp_path: Path) -> None:
    """Darks are shared by the filters; monochromatic light of a known number of photons is compared through any."""
    folder = _darks_and_flats(tmp_path / "in", {"L": 0.5, "R": 0.5}, {"L": 8000.0, "R": 6800.0}, "FILTER")
    with pytest.raises(RecordingError) as caught:
        read_fits_folder(folder)
    (line,) = caught.value.problems
    assert "FILTER (filter) differs between frames that are fitted together: L in 10 frames (flat-L-1-0.fits" in line
    assert (
        "--only FILTER=L, or state the light of each frame (photons_per_pixel and wavelength_nm) in index.csv" in line
    )
    alone = read_foreign("fits", folder, ImportOptions(only="FILTER=R"))
    assert (len(alone.captures("dark")), len(alone.captures("flat"))) == (4, 10)
    _assert_noise(alone, 0.5)
    rows = ["frame,kind,exposure_s,photons_per_pixel,wavelength_nm"]
    for value, rate in (("L", 8000.0), ("R", 6800.0)):
        for k in range(2):
            rows.append(f"bias-{value}-{k}.fits,dark,0,,")
            rows += [f"flat-{value}-{s}-{k}.fits,flat,{s},{2 * rate * s},530" for s in (1, 2, 3, 4, 5)]
    (folder / "index.csv").write_text("\n".join(rows))
    known = read_raw_folder(folder)
    _assert_noise(known, 0.5)
    fitted = fit_noise(known, "left")
    assert fitted.quantum_efficiency == pytest.approx(0.5, abs=3 * fitted.quantum_efficiency_std)


def test_gains_in_db_are_fitted_apart_and_what_is_left_out_is_reported(tmp_path: Path) -> None:
    folder = _darks_and_flats(tmp_path / "in", {200: 1.0, 0: 0.5}, {200: 4000.0, 0: 9000.0}, "GAIN")
    rows = ["frame,kind,gain_db"]
    for file in sorted(folder.glob("*.fits")):
        kind, value, *_ = file.stem.split("-")
        if file.stem != "flat-200-5-1":
            rows.append(
                f"{file.name},{'dark' if kind == 'bias' else 'flat'},{20.0 * np.log10(2.0) if value == '200' else 0.0}"
            )
    (folder / "index.csv").write_text("\n".join(rows))
    read = read_fits_folder(folder)
    _assert_noise(read, 0.5)
    (remark,) = [line for line in fit_noise(read, "left").remarks if "left out" in line]
    assert remark == (
        "fitted at 0 dB, the gain of most flats: 9 flats at 6.0206 dB (flat-200-1-0 .. flat-200-5-0), 2 darks at "
        "6.0206 dB (bias-200-0 .. bias-200-1) left out; fit them in a set of their own"
    )
    rows[1] = rows[1].rpartition(",")[0] + ","
    (folder / "index.csv").write_text("\n".join(rows))
    (line,) = [line for line in read_fits_folder(folder).warnings if "no gain_db" in line]
    assert line.startswith(f"{folder}/bias-0-0.fits: no gain_db, where others state 0, 6.0206 dB: taken as 0 dB")


#: Keyword, the value of most frames, another one, and words of the line. Drawn after the list was declared.
DIFFERENCES = [
    ("OFFSET", 10, 50, "OFFSET (offset) differs"),
    ("BLKLEVEL", 64.0, 128.0, "BLKLEVEL (offset) differs"),
    ("EGAIN", 0.2447, 1.002, "EGAIN (gain) differs"),
    ("ISOSPEED", 800, 1600, "ISOSPEED (ISO speed) differs"),
    ("READOUTM", "High Gain Mode", "Low Noise", "High Gain Mode in 3 frames"),
    ("PREAMP", "4.0x", "1.0x", "PREAMP (gain) differs"),
    ("READTIME", 1e-06, 3.33e-07, "1e-06 in 3 frames"),
    ("XBINNING", 2, 1, "import one group, --only XBINNING=2; where"),
    ("CCDSUM", "1 1", "2 2", "CCDSUM (binning) differs"),
    ("ROWORDER", "TOP-DOWN", "BOTTOM-UP", "ROWORDER (orientation) differs"),
    ("INSTRUME", "ASI294MM", "ASI183MM", "give each camera its own side in index.csv"),
]


@pytest.mark.parametrize(("key", "usual", "other", "words"), DIFFERENCES)
def test_every_setting_is_compared(tmp_path: Path, key: str, usual: object, other: object, words: str) -> None:
    rng = np.random.default_rng(6)
    for k, value in enumerate((usual, usual, other, usual)):
        _write(tmp_path / f"d{k}.fits", rng, 50.0, 1.0, {key: value, "EXPTIME": 10.0, "IMAGETYP": "DARK"})
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\n')
    with pytest.raises(RecordingError) as caught:
        read_fits_folder(tmp_path)
    (line,) = caught.value.problems
    assert words in line
    assert line.endswith(f"where the header is wrong, --ignore {key}")
    ignored = read_fits_folder(tmp_path, choice=parse_choice("", key))
    assert len(ignored.captures()) == 4
    assert f"{tmp_path}: {key} of the headers ignored (--ignore)" in ignored.warnings


def test_settings_that_are_alike_pass_and_go_into_the_set(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    for k, egain in enumerate((0.24471, 0.24466)):  # rounded differently
        head = {
            "INSTRUME": "QHY600M",
            "EGAIN": egain,
            "GAIN": 26,
            "OFFSET": 40,
            "READOUTM": "Photographic",
            "CCD-TEMP": -9.9,
        }
        _write(tmp_path / f"d{k}.fits", rng, 50.0, 1.0, head | {"EXPTIME": 10.0, "IMAGETYP": "DARK"})
    _write(tmp_path / "x.fits", rng, 50.0, 1.0, {"EXPTIME": 10.0, "IMAGETYP": "DARK", "GAIN": 26})
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\n')
    read = recording.read(recording.write(read_fits_folder(tmp_path), tmp_path / "set"))
    camera = read.manifest.instruments["camera left"]
    assert (camera.model, camera.settings["GAIN"], camera.settings["READOUTM"]) == ("QHY600M", 26, "Photographic")
    assert "EGAIN" not in camera.settings  # not one value
    (line,) = [line for line in read_fits_folder(tmp_path).warnings if "unlike the others'" in line]
    missing = "no EGAIN, OFFSET, READOUTM, INSTRUME in the header, unlike the others': taken as theirs"
    assert line == f"{tmp_path}: x.fits: {missing}"


def test_boards_at_other_gains_are_a_warning_and_at_other_binnings_refused(tmp_path: Path) -> None:
    """No fit joins the codes of boards; their pixels are one camera's."""
    rng = np.random.default_rng(8)
    for k in range(2):
        _write(tmp_path / f"b{k}.fits", rng, 50.0, 1.0, {"GAIN": 100 * k})
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\n')
    options = ImportOptions(checkerboard=(3, 4), square_mm=10.0)
    (line,) = [line for line in read_foreign("checkerboard", tmp_path, options).warnings if "GAIN" in line]
    assert (
        "GAIN (gain) differs between frames: 0 in 1 frame (b0.fits), 100 in 1 frame (b1.fits); each is fitted by"
        in line
    )
    for k in range(2):
        fits.setval(tmp_path / f"b{k}.fits", "YBINNING", value=k + 1)
    with pytest.raises(RecordingError, match="YBINNING"):
        read_foreign("checkerboard", tmp_path, options)


@pytest.mark.parametrize(
    ("key", "values", "warns"),
    [
        ("HSPEED", (1.0, 5.0), True),
        ("CMOSGAIN", (0, 120), True),
        ("FILTNAM", ("g", "r"), True),
        ("WINDSPED", (1.0, 5.0), False),
        ("AIRMASS", (1.0, 5.0), False),
    ],
)
def test_a_keyword_that_is_not_listed_but_seems_a_setting_is_a_warning(
    tmp_path: Path, key: str, values: tuple[object, object], warns: bool
) -> None:
    rng = np.random.default_rng(5)
    for k in range(4):
        head = {key: values[k // 2], "EXPTIME": 1.0 + k // 2, "IMAGETYP": "FLAT"}
        _write(tmp_path / f"flat{k}.fits", rng, 9000.0, 0.5, head)
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\n')
    lines = [line for line in read_fits_folder(tmp_path).warnings if key in line]
    assert len(lines) == warns
    if warns:
        assert (
            f"{key} differs between frames that are fitted together: {values[0]:} in 2 frames".replace(".0", "")
            in (lines[0])
        )
        one = f"{key}={values[0]}"
        kept = read_foreign("fits", tmp_path, ImportOptions(only=one))
        assert len(kept.captures()) == 2 and not any("differs" in line for line in kept.warnings)
        read = read_foreign("fits", tmp_path, ImportOptions(ignore=key))
        assert len(read.captures()) == 4 and not any("differs" in line for line in read.warnings)


def test_a_measurement_of_each_frame_is_no_setting(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for k in range(3):
        _write(tmp_path / f"f{k}.fits", rng, 9000.0, 0.5, {"GAINMEAS": 0.5 + 0.01 * k, "EXPTIME": 1.0, "FRAME": "flat"})
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 16\n')
    assert not any("GAINMEAS" in line for line in read_fits_folder(tmp_path).warnings)


def test_the_list_is_declared_once() -> None:
    assert len(KEYWORDS) == sum(len(setting.keywords) for setting in SETTINGS)
    assert all(setting.factor >= 1.0 for setting in SETTINGS)
    assert {setting.changes for setting in SETTINGS} == set(SharedBy)
    assert is_same("ISO", 100.0, 110.0)  # within half of a third of a stop
    assert not is_same("ISO", 100.0, 125.0)
    assert is_same("FILTER", "ha", "Ha")
    assert not is_same("OFFSET", 0.0, 1.0)
    assert parse_choice("", "") == ALL_FRAMES
    assert parse_choice("GAIN=100, FILTER=H alpha", "EGAIN").only == (("GAIN", "100"), ("FILTER", "H alpha"))
    with pytest.raises(InputError, match="--only GAIN: give KEY=VALUE, as in GAIN=100"):
        parse_choice("GAIN", "")
    with pytest.raises(InputError, match="--only OBJECT=M31: OBJECT isn't compared; give one of GAIN, "):
        parse_choice("OBJECT=M31", "")
