"""Tables of channel means by wavelength give the relative sensitivities of their camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lab.errors import InputError, NotDetermined
from lab.fit.spectral.mean_table import fit_mean_table
from lab.formats.recording_set import DataSheet
from lab.formats.results import SpectralFit

CAMERA = DataSheet(rows=200, cols=200, cfa="RGGB", bit_depth=12)
BLACK_DN, EXPOSURE_S, STD_DN = 64.0, 0.1, 0.3
CURVES = {"R": (600.0, 35.0, 0.9), "G": (540.0, 40.0, 1.0), "B": (460.0, 30.0, 0.8)}
HEADER = "kind,channel,wavelength_nm,bandwidth_nm,exposure_s,mean_dn,mean_std_dn"


def _truth(channel: str, wavelength_nm: np.ndarray) -> np.ndarray:
    middle, width, height = CURVES[channel]
    return np.asarray(height * np.exp(-0.5 * ((wavelength_nm - middle) / width) ** 2))


def _table(path: Path, seed: int = 0, *, photodiode: bool = False, change: tuple[str, str] = ("", "")) -> Path:
    """Lines of 10 nm every 10 nm through triangles of that width, whose power falls to the blue by half; DN a photon as
    `CURVES`.
    """
    rng = np.random.default_rng(seed)
    rows = [f"{HEADER},{'photodiode_a,photodiode_a_per_w' if photodiode else 'radiance_w_per_sr_m2'}"]
    for channel in CURVES:
        black = BLACK_DN + rng.normal(0.0, 0.02)
        rows.append(f"dark,{channel},,,{EXPOSURE_S},{black:.4f},0.02,{',' if photodiode else ''}")
    fine = np.arange(-10.0, 10.01, 0.25)
    weight = 1.0 - np.abs(fine) / 10.0
    for line_nm in np.arange(400.0, 701.0, 10.0):
        power = 1e-3 * (0.5 + 0.5 * (line_nm - 400.0) / 300.0)
        read = power * (1.0 + rng.normal(0.0, 0.003))
        responsivity = 0.2 + 0.0005 * (line_nm - 400.0)
        light = f"{read * responsivity:.8g},{responsivity:.6g}" if photodiode else f"{read:.8g}"
        for channel in CURVES:
            # the table's light is a triangle in photons: its mean wavelength is that of the line
            mean = float(np.sum(weight * _truth(channel, line_nm + fine)) / weight.sum())
            signal = 3.0e3 * (power / 1e-3) * (line_nm / 700.0) * mean
            told = BLACK_DN + signal + rng.normal(0.0, STD_DN)
            rows.append(f"narrowband,{channel},{line_nm:g},10,{EXPOSURE_S},{told:.4f},{STD_DN},{light}")
    file = path / "table.csv"
    text = "\n".join(rows) + "\n"
    file.write_text(text.replace(*change) if change[0] else text)
    return file


def _spectral(file: Path) -> SpectralFit:
    found = fit_mean_table(file, CAMERA).cameras["left"].spectral
    assert found is not None
    return found


@pytest.mark.parametrize("photodiode", [False, True])
def test_the_relative_sensitivities_of_the_table_s_camera(tmp_path: Path, photodiode: bool) -> None:
    """The highest value of all channels is 1. Reading and noise leave some per mille at the peaks."""
    found = _spectral(_table(tmp_path, photodiode=photodiode))
    wave = np.array(found.wavelength_nm)
    assert (wave[0], wave[-1]) == (400.0, 700.0)
    peak = max(float(_truth(c, wave).max()) for c in CURVES)
    for channel in CURVES:
        value, std = (np.array(getattr(found, f"relative_sensitivity{part}")[channel]) for part in ("", "_std"))
        truth = _truth(channel, wave) / peak
        assert np.all(std < 0.02)
        # beside its uncertainty, a regularised curve is off by structure that lights of 10 nm don't resolve
        assert np.all(np.abs(value - truth) < 4.0 * np.hypot(std, 0.002))
    assert found.quantum_efficiency == {}
    assert any("relative" in remark for remark in found.remarks)


def _measured(path: Path, *, files: bool) -> Path:
    """The same lights with nominal wavelengths that are 4 nm too long and widths that are twice too large, and the
    lines as measured: centre and width, or files whose integral is the power.
    """
    lines = _table(path).read_text().splitlines()
    made = [lines[0] + (",spectrum" if files else ",measured_wavelength_nm,measured_bandwidth_nm")]
    for line in lines[1:]:
        cells = line.split(",")
        if cells[0] == "dark":
            made.append(line + ("," if files else ",,"))
            continue
        nm, power = float(cells[2]), float(cells[-1])
        cells[2:4] = [f"{nm + 4:g}", "20"]
        if files:
            wave = np.arange(nm - 12.0, nm + 12.25, 0.25)
            # photons are a triangle: power is that over the wavelength
            value = np.clip(1.0 - np.abs(wave - nm) / 10.0, 0.0, None) / wave
            value *= power / np.trapezoid(value, wave)
            rows = "".join(f"{w:g};{v:.8g}\n".replace(".", ",") for w, v in zip(wave, value, strict=True))
            (path / f"{nm:g}.csv").write_text("wavelength_nm;value\n" + rows)
            cells = [*cells[:-1], "", f"{nm:g}.csv"]
        else:
            cells += [f"{nm:g}", "10"]
        made.append(",".join(cells))
    file = path / "measured.csv"
    file.write_text("\n".join(made) + "\n")
    return file


@pytest.mark.parametrize("files", [False, True])
def test_measured_lines_stand_for_those_that_were_set(tmp_path: Path, files: bool) -> None:
    """With the measured lines the curves are those of `test_the_relative_sensitivities_of_the_table_s_camera`; with the
    stated ones they are moved by 4 nm, which is 8 % of the peak on the flanks.
    """
    file = _measured(tmp_path, files=files)
    file.write_text(file.read_text().replace(",404,20,", ",414,20,"))  # one is far off, which is told
    found = _spectral(file)
    off = "1 lines are centred elsewhere than they are set, by 14."
    assert any(off in remark for remark in found.remarks)
    wave = np.array(found.wavelength_nm)
    peak = max(float(_truth(c, wave).max()) for c in CURVES)
    for channel in CURVES:
        value, std = (np.array(getattr(found, f"relative_sensitivity{part}")[channel]) for part in ("", "_std"))
        assert np.all(np.abs(value - _truth(channel, wave) / peak) < 4.0 * np.hypot(std, 0.002))


def test_spectra_of_lines_that_cannot_be_used(tmp_path: Path) -> None:
    file = _measured(tmp_path, files=True)
    for text, words in (
        ("wavelength_nm,value\n390,0\n410,0\n", "no light in it"),
        ("wavelength_nm,value\n390,0\n400,1\n410,-0.2\n", "-0.2 at 410 nm, below the limit of -0.05"),
        ("nm,value\n390,0\n", "its first line is 'nm,value'"),
    ):
        name = f"{words[:4].strip()}.csv"
        (tmp_path / name).write_text(text)
        changed = tmp_path / "changed.csv"
        changed.write_text(file.read_text().replace(",400.csv", f",{name}"))
        with pytest.raises(InputError, match=words) as caught:
            fit_mean_table(changed, CAMERA)
        assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_standard_deviations_of_relative_sensitivities_are_true(tmp_path: Path) -> None:
    """20 draws, all values above a tenth of the peak: the mean square pull is within 1 +- 3 sqrt(2 / 20), as neighbours
    share their noise.
    """
    pulls = []
    for seed in range(20):
        found = _spectral(_table(tmp_path, seed))
        wave = np.array(found.wavelength_nm)
        peak = max(float(_truth(c, wave).max()) for c in CURVES)
        for channel in CURVES:
            truth = _truth(channel, wave) / peak
            value, std = (np.array(getattr(found, f"relative_sensitivity{part}")[channel]) for part in ("", "_std"))
            high = (truth > 0.1) & (std > 1e-6)
            pulls.append(np.mean(np.square((value - truth)[high] / std[high])))
    assert 0.2 < np.mean(pulls) < 1.0 + 3.0 * np.sqrt(2.0 / 20)


def test_means_near_the_highest_code_are_left_out(tmp_path: Path) -> None:
    found = fit_mean_table(_table(tmp_path), CAMERA.model_copy(update={"white_level_dn": 2000.0}))
    assert found.cameras["left"].spectral is not None
    assert any("near the highest code are left out" in r for r in found.cameras["left"].spectral.remarks)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("bandwidth_nm", "fwhm_nm"), "missing: bandwidth_nm; unknown: fwhm_nm"),
        (("narrowband,R,400", "flat,R,400"), "kind 'flat'; write dark or narrowband"),
        (("narrowband,R,400", "narrowband,Y,400"), "channel 'Y' of a RGGB sensor"),
        (("narrowband,R,400,10", "narrowband,R,400,wide"), "bandwidth_nm = 'wide' isn't a number"),
        (("narrowband,R,400,10,0.1,", "narrowband,R,400,10,0.1,-"), "more than 6 standard deviations below the dark"),
    ],
)
def test_what_cannot_be_used_is_one_line(tmp_path: Path, change: tuple[str, str], words: str) -> None:
    with pytest.raises(InputError) as caught:
        fit_mean_table(_table(tmp_path, change=change), CAMERA)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_channel_without_lights(tmp_path: Path) -> None:
    file = _table(tmp_path)
    file.write_text("\n".join(line for line in file.read_text().splitlines() if not line.startswith("narrowband,B")))
    with pytest.raises(NotDetermined, match="channel B has fewer than 3 lights"):
        fit_mean_table(file, CAMERA)
