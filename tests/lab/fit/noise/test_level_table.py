"""Tables of means and variances give the same figures as their frames, and nothing that needs frames."""

from pathlib import Path

import numpy as np
import pytest

from lab.errors import InputError
from lab.fit.noise.level_table import fit_level_table
from lab.formats.recording_set import DataSheet

K, READ_E, BLACK, DARK_E_PER_S, QE = 0.35, 6.0, 64.0, 40.0, 0.45
PIXELS, REPEATS = 40000, 4
CAMERA = DataSheet(rows=200, cols=200, cfa="MONO", bit_depth=12)
HEADER = "kind,exposure_s,photons_per_pixel,mean_dn,variance_dn2,pixels,repeats"


def _table(path: Path, seed: int = 0, change: tuple[str, str] = ("", "")) -> Path:
    """Darks and flats of a linear camera, means and variances drawn with their sampling noise."""
    rng = np.random.default_rng(seed)
    rows = [HEADER]
    for kind in ("dark", "flat"):
        for step in range(1, 16):
            exposure_s = 0.01 * step
            photons = 1500.0 * step if kind == "flat" else 0.0
            electrons = QE * photons + DARK_E_PER_S * exposure_s
            variance = K**2 * (electrons + READ_E**2) + 1.0 / 12.0
            mean = BLACK + K * electrons + rng.normal(0.0, np.sqrt(variance / PIXELS / REPEATS))
            variance *= 1.0 + rng.normal(0.0, np.sqrt(2.0 / PIXELS / (REPEATS - 1)))
            rows.append(
                f"{kind},{exposure_s:g},{photons if kind == 'flat' else ''},{mean:.5f},{variance:.5f},{PIXELS},{REPEATS}"  # noqa: E501
            )
    file = path / "table.csv"
    file.write_text("\n".join(rows).replace(*change) + "\n" if change[0] else "\n".join(rows) + "\n")
    return file


def test_a_table_gives_the_figures_of_its_camera(tmp_path: Path) -> None:
    """Within 4 of the standard deviations that the fit states, which are below 1 % of the values."""
    fit = fit_level_table(_table(tmp_path), CAMERA).cameras["left"].noise
    assert fit is not None
    for value, std, truth in (
        (fit.conversion_gain_dn_per_e, fit.conversion_gain_dn_per_e_std, K),
        (fit.read_noise_e, fit.read_noise_e_std, READ_E),
        (fit.quantum_efficiency, fit.quantum_efficiency_std, QE),
        (fit.black_level_dn, fit.black_level_dn_std, BLACK),
    ):
        assert value is not None
        assert std is not None
        assert abs(value - truth) < 4.0 * std
        assert 0.0 < std < 0.01 * truth
    assert fit.emva1288["Y"].remarks is not None


def test_what_needs_frames_stays_unknown(tmp_path: Path) -> None:
    result = fit_level_table(_table(tmp_path), CAMERA)
    fit = result.cameras["left"].noise
    assert fit is not None
    assert (fit.dsnu_e, fit.prnu_percent, fit.dsnu_e_std, fit.prnu_percent_std) == (None,) * 4
    figures = fit.emva1288["Y"].model_dump()
    assert not any(value is not None for name, value in figures.items() if name.startswith(("dsnu", "prnu")))
    assert any("holds no frames" in one.reason for one in result.skipped)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("exposure_s", "exposure_ms"), "missing: exposure_s; unknown: exposure_ms"),
        ((",repeats", ",frames"), "missing: repeats; unknown: frames"),
        (("dark,0.01,", "black,0.01,"), "row 2: kind 'black'; write dark or flat"),
        (("dark,0.01,", "dark,short,"), "row 2: exposure_s = 'short' isn't a number"),
        (("dark,0.02,", "dark,0.01,"), "row 3: channel Y of this level stands twice"),
        ((f",{PIXELS},{REPEATS}", f",{PIXELS}"), "row 2: 6 cells under 7 columns"),
    ],
)
def test_what_cannot_be_used_is_one_line(tmp_path: Path, change: tuple[str, str], words: str) -> None:
    with pytest.raises(InputError) as caught:
        fit_level_table(_table(tmp_path, change=change), CAMERA)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
