"""Laws that no effect has: found with axis, stage and size where they are, and not on healthy cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lab.challenge.recordings import recording_set, recordings_of
from lab.diagnose import diagnose, examine
from lab.diagnose.discovery import PredictiveTable, discover, law_of
from lab.diagnose.measurements.blocks import study_of
from lab.diagnose.policy import DecisionPolicy
from lab.fit import FOR_DIAGNOSIS, fit_recording_set
from lab.formats.importers import ImportOptions, read_foreign
from lab.formats.recording_set import RecordingSet, read, write
from mocks.former import ConcealedCamera, Law, Plan, record
from mocks.former.laws import DigitalGainLaw, LossyCodesLaw
from sim.effects.column_noise import ColumnNoise

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
LIT_AND_DARK = Plan(("dark", "flat", "narrowband"))
Frame = NDArray[np.floating]


def _changed(seed: int, change: Callable[[Frame, str, float], Frame], cfa: str = "MONO") -> RecordingSet:
    """A healthy camera's recordings whose frames were changed: `change` takes frame, kind and black level, DN."""
    camera = ConcealedCamera(seed, (), cfa=cfa, rows=96, cols=128)
    session = record(camera, LIT_AND_DARK)
    kinds = {capture["frame"]: capture["kind"] for capture in session.manifest["captures"]}
    rng = np.random.default_rng(seed)
    for path, frame in session.frames.items():
        value = change(frame.astype(float), kinds[path], camera.black_level_dn)
        value = np.floor(value + rng.random(value.shape)) if kinds[path] != "dark" else value  # keeps means
        session.frames[path] = np.clip(value, 0, 4095).astype(frame.dtype)
    return recording_set(session)


def _found(recordings: RecordingSet) -> tuple[PredictiveTable, ...]:
    return discover(study_of(recordings, "left"), (), DecisionPolicy())


@pytest.mark.parametrize("seed", [772011, 772012, 772013])
@pytest.mark.parametrize("cfa", ["MONO", "RGGB"])
def test_a_healthy_camera_has_no_law(seed: int, cfa: str) -> None:
    recordings = recordings_of(ConcealedCamera(seed, (), cfa=cfa, rows=96, cols=128), LIT_AND_DARK)
    assert not _found(recordings)


@pytest.mark.slow
def test_at_most_one_of_a_hundred_healthy_cameras_has_a_law() -> None:
    with_one = [
        seed
        for seed in range(772100, 772200)
        if _found(recordings_of(ConcealedCamera(seed, (), rows=96, cols=128), LIT_AND_DARK))
    ]
    assert len(with_one) <= 1, with_one


def test_a_gain_after_the_converter_shows_by_code() -> None:
    """A gain of 1.1 leaves one code of eleven out and makes the others 1.1 wide: the table repeats every 11 codes."""
    laws: Sequence[Law] = (DigitalGainLaw(10.0),)
    (one,) = _found(recordings_of(ConcealedCamera(772302, laws, rows=96, cols=128), LIT_AND_DARK))
    assert (one.look.stage, one.look.along) == ("codes", "code")
    base = (*one.shorter, one)[0]
    assert base.period == 11
    assert np.sort(base.departure)[0] < -0.8
    assert np.sort(base.departure)[1:] == pytest.approx(np.full(10, 0.1), abs=0.05)
    before, after, n = one.chi2
    assert before - after > 0.9 * (before - n)


def test_codes_without_a_period_are_a_table_by_code() -> None:
    """Codes in equal steps of their square root: which of them occur follows no period, and is alike in all frames."""
    (one,) = _found(recordings_of(ConcealedCamera(772021, (LossyCodesLaw(0.05),), rows=96, cols=128), LIT_AND_DARK))
    assert (one.look.stage, one.period) == ("codes", 0)
    held_out = one.look.held_out
    assert held_out is not None
    counted = held_out.part(np.isin(held_out.index, one.look.seen.index))  # of other codes no frame tells anything
    before, after, n = counted.chi2(np.zeros(1)), counted.chi2(one.departure), len(counted.index)
    assert before - after > 0.9 * (before - n)


def test_dim_rows_are_found_with_period_and_size() -> None:
    """Every eighth row sees 2 % less: each entry within 4 standard deviations by the pixels that it is the mean of.

    A flat's pixels scatter by 2 % at most; of 96 rows of 128 pixels 12 are of a class.
    """

    def dim(frame: Frame, kind: str, black_dn: float) -> Frame:
        if kind != "dark":
            frame[3::8] = black_dn + 0.98 * (frame[3::8] - black_dn)
        return frame

    (one,) = _found(_changed(772012, dim))
    assert (one.look.stage, one.look.along, one.period) == ("charge", "row", 8)
    expected = np.where(np.arange(8) == 3, -0.02, 0.0)
    tolerance = 4.0 * 0.02 / np.sqrt(12 * 128)
    assert one.departure == pytest.approx(expected - expected.mean(), abs=tolerance)
    assert np.abs(one.departure - expected + expected.mean()).max() < 4.0 * one.std.max()
    assert one.std.max() < tolerance


def test_offsets_of_columns_are_told_from_gains() -> None:
    """Four interleaved converters with offsets of +-2 DN, dark or lit: found in the dark, in electrons of the
    camera."""
    offset = np.array([2.0, -2.0, 1.0, -1.0])

    def shifted(frame: Frame, kind: str, black_dn: float) -> Frame:
        return frame + np.resize(offset, frame.shape[1])

    recordings = _changed(772012, shifted)
    found = {(one.look.stage, one.look.along): one for one in _found(recordings)}
    assert set(found) == {("signal", "column")}
    one = found["signal", "column"]
    assert one.period == 4
    assert one.departure == pytest.approx(offset, abs=0.1)  # darks of 96 rows, rounded to 1 DN
    study = study_of(recordings, "left")
    assert np.array(law_of(one, study).table) * study.noise.gain == pytest.approx(one.departure)


def test_what_a_named_effect_does_is_no_law() -> None:
    """Odd columns 2 DN above even ones: a law by itself, and none beside the column noise that has this step."""

    def shifted(frame: Frame, kind: str, black_dn: float) -> Frame:
        return frame + np.resize([-1.0, 1.0], frame.shape[1])

    study = study_of(_changed(772012, shifted), "left")
    assert [one.period for one in discover(study, (), DecisionPolicy())] == [2]
    named = ColumnNoise(odd_even_e=2.0 / study.noise.gain)
    assert not discover(study, (named,), DecisionPolicy())


def test_one_bright_line_is_no_law() -> None:
    def bright(frame: Frame, kind: str, black_dn: float) -> Frame:
        frame[41] += 0.3 * (frame[41] - black_dn)
        return frame

    assert not [one for one in _found(_changed(772012, bright)) if one.look.stage != "codes"]


def test_a_law_is_told_and_stands_in_the_improved_model() -> None:
    """The improved model predicts the held-out counts of a converter after whose codes a gain acts."""
    recordings = recordings_of(ConcealedCamera(772302, (DigitalGainLaw(10.0),), rows=96, cols=128), LIT_AND_DARK)
    found = examine(recordings)
    (law,) = found.result.discovered
    assert "repeat every 11 codes" in law.statement
    assert law.statement in found.result.summary
    assert found.result.verdict in {"unexplained", "partly_explained"}
    assert "empirical_law" in [effect.name for effect in found.improved["left"].effects]
    again = diagnose(recordings, None)
    assert again.discovered == found.result.discovered
    with_it = examine(recordings, baseline=found.improved)
    assert not with_it.result.discovered


@pytest.mark.skipif(not DATA.is_dir(), reason="../shared isn't beside the project")
def test_the_codes_of_a_real_ccd_repeat_every_four(tmp_path: Path) -> None:
    """An independent look: four numbers take most off chi2 of codes left out, a table by code more (to 2.7)."""
    recordings = read(write(read_foreign("emva1288", DATA / "emva1288_ccd", ImportOptions()), tmp_path / "set"))
    fit = fit_recording_set(recordings, None, FOR_DIAGNOSIS)
    found = discover(study_of(recordings, "left", fit), (), DecisionPolicy())
    codes = next(one for one in found if one.look.stage == "codes")
    assert codes.shorter[0].period == 4
    before, after, n = codes.chi2
    assert before / n > 20.0
    assert after / n < 3.0
