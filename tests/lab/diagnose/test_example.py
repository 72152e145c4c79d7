"""The worked example of the documentation, on a camera of the second image former, and diagnoses of real recordings."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest
from scipy import stats

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from evaluation.independent_simulator import laws as concealed_laws
from lab.diagnose import diagnose, examine
from lab.foreign_recordings import read_foreign
from lab.formats.recording_set import inspect

ROOT = Path(__file__).parents[3]
DATA = ROOT.parent / "shared" / "data"
FLEA, CCD = DATA / "llanos_colorchecker", DATA / "emva1288_ccd"


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_mtf_that_fell_short_and_the_red_end_have_names_and_then_fit() -> None:
    """An anti-alias filter and an infrared filter, as in docs/explanation/examples/low-pass-and-infrared-filter.md:
    both named, edges and narrowband light within the 99.9 % quantile of noise on held-out captures, and nothing left
    where the improved model is the baseline."""
    law = [concealed_laws.OpticalLowPassFilterLaw(1.6), concealed_laws.InfraredCutFilterLaw(60.0)]
    recordings = recordings_of(
        ConcealedCamera(20751, law, cfa="RGGB", f_number=4.0, rows=180, cols=240),
        Plan(("dark", "flat", "narrowband", "slanted_edge")),
    )
    found = examine(recordings)
    assert {e.name for e in found.result.effects} == {"optical_low_pass_filter", "infrared_cut_filter"}
    assert found.result.verdict == "explained"
    fits = {m.measurement: m for m in found.result.measurements}
    for measurement in ("slanted_edge", "narrowband"):
        fit = fits[measurement]
        assert fit.held_out_before > 10.0 * fit.held_out_n
        assert fit.held_out_after < stats.chi2.ppf(0.999, fit.held_out_n)
    assert examine(recordings, baseline=found.improved).result.verdict == "no_mismatch"


@pytest.mark.skipif(not FLEA.is_dir(), reason="the shared recordings of a Flea3 aren't here")
def test_real_frames_show_defective_pixels_filters_off_their_names_and_what_cant_be_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["convert_llanos.py", str(FLEA), str(tmp_path)])
    runpy.run_path(str(ROOT / "docs" / "convert_llanos.py"), run_name="__main__")
    result = diagnose(read_foreign("raw-folder", tmp_path / "darks"))
    assert "defective_pixels" in {m.measurement for m in result.mismatches}
    assert {e.name for e in result.effects} <= {
        "hot_pixels",
        "defective_pixels",
    }  # nothing else may be named from these
    reasons = " ".join(item.reason for item in result.skipped)
    assert "codes are too coarse" in reasons
    assert "f-number or pixel pitch isn't stated" in reasons
    # the white patch behind filters: off their names, and greens that agree
    patch = read_foreign("raw-folder", tmp_path / "white")
    _, warnings = inspect(patch)
    assert any("4 narrowband lights are centred elsewhere than they are set (450 nm: 440.4 nm;" in w for w in warnings)
    assert diagnose(patch).verdict == "no_mismatch"


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.skipif(not CCD.is_dir(), reason="the shared EMVA 1288 recordings aren't here")
def test_a_real_emva_session_is_diagnosed() -> None:
    """Its lamp wasn't steady and its shading isn't symmetric: something has to be seen."""
    result = diagnose(read_foreign("emva1288", CCD))
    assert result.mismatches
    assert result.verdict != "no_mismatch"
