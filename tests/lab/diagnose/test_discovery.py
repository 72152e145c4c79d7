"""Laws that no effect has: found with axis, stage and size where they are, and not on healthy cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from evaluation.draw import recording_set, recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan, record
from evaluation.independent_simulator.laws import (
    AbsorptionBandLaw,
    DigitalGainLaw,
    LampJumpLaw,
    LossyCodesLaw,
    TapGainLaw,
    TapOffsetLaw,
    TreeRingsLaw,
)
from evaluation.independent_simulator.unlisted import (
    BankNoiseLaw,
    CoarseTopLaw,
    ColumnAmplifiersLaw,
    FirstRowsLaw,
    LeafShutterLaw,
    RingCodesLaw,
    RowBanksLaw,
    SaddleShadingLaw,
    SharedCellLaw,
    SharedReadLaw,
    WarmCentreLaw,
    WarmingNoiseLaw,
    WavyColumnsLaw,
)
from lab.diagnose import diagnose, discovery, examine
from lab.diagnose.discovery import PredictiveTable, discover, law_of
from lab.diagnose.discovery.profile import Profile, curve_forms, description_length, fitted, formulas
from lab.diagnose.inference.side_model import dataset_of
from lab.diagnose.policy import DecisionPolicy
from lab.fit import FOR_DIAGNOSIS, fit_recording_set
from lab.foreign_recordings import read_foreign
from lab.formats.importers import ImportOptions
from lab.formats.recording_set import RecordingSet, read, write
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
    return discover(dataset_of(recordings, "left"), (), DecisionPolicy())


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
    dataset = dataset_of(recordings, "left")
    assert np.array(law_of(one, dataset).table) * dataset.noise.gain == pytest.approx(one.departure)


def test_what_a_named_effect_does_is_no_law() -> None:
    """Odd columns 2 DN above even ones: a law by itself, and none beside the column noise that has this step."""

    def shifted(frame: Frame, kind: str, black_dn: float) -> Frame:
        return frame + np.resize([-1.0, 1.0], frame.shape[1])

    dataset = dataset_of(_changed(772012, shifted), "left")
    assert [one.period for one in discover(dataset, (), DecisionPolicy())] == [2]
    named = ColumnNoise(odd_even_e=2.0 / dataset.noise.gain)
    assert not discover(dataset, (named,), DecisionPolicy())


def test_one_bright_line_is_no_law() -> None:
    def bright(frame: Frame, kind: str, black_dn: float) -> Frame:
        frame[41] += 0.3 * (frame[41] - black_dn)
        return frame

    assert not [one for one in _found(_changed(772012, bright)) if one.look.stage != "codes"]


@pytest.mark.parametrize("cfa", ["MONO", "GRBG"])
def test_the_step_where_two_read_outs_meet_is_found_with_its_size(cfa: str) -> None:
    """A gain of 1 % and an offset of 3 e right of the middle: to 4 standard deviations of 48 columns of 96 pixels.

    Pixels scatter by 1 % in light and by 5 e in the dark at most; three darks of each of three exposures.
    """
    laws = (TapGainLaw(1.0), TapOffsetLaw(3.0))
    camera = ConcealedCamera(772021, laws, cfa=cfa, rows=96, cols=128)
    recordings = recordings_of(camera, LIT_AND_DARK)
    found = {one.look.stage: one for one in _found(recordings)}
    assert {(one.look.along, one.form.name) for one in found.values()} == {("column", "step")}
    light, dark = found["charge"].departure, found["signal"].departure / camera.gain_dn_per_e
    per_column = 4.0 * np.sqrt(2.0 / (48 * 96))
    assert np.flatnonzero(np.diff(light)).tolist() == [63]
    assert light[-1] - light[0] == pytest.approx(0.01, abs=0.01 * per_column + 1e-3)  # taken at a mean of unlike halves
    assert dark[-1] - dark[0] == pytest.approx(3.0, abs=5.0 * per_column)
    law = law_of(found["charge"], dataset_of(recordings, "left"))
    assert law.at == pytest.approx((63.5 / 128, 64.5 / 128))


def test_waves_are_no_steps() -> None:
    """Tree rings bend the light smoothly, strong beside the noise, over some ten columns."""
    camera = ConcealedCamera(772302, (TreeRingsLaw(3.0),), cfa="MONO", rows=96, cols=128)
    assert not [one for one in _found(recordings_of(camera, LIT_AND_DARK)) if one.form.name == "step"]


def test_pixels_that_differ_within_a_cell_are_found() -> None:
    """A checkerboard of +-0.5 % has no rows and no columns of its own."""
    board = 0.005 * np.array([[1.0, -1.0], [-1.0, 1.0]])

    def shaded(frame: Frame, kind: str, black_dn: float) -> Frame:
        change = np.tile(board, (frame.shape[0] // 2, frame.shape[1] // 2))
        return frame if kind == "dark" else black_dn + (frame - black_dn) * (1.0 + change)

    recordings = _changed(772012, shaded)
    (one,) = _found(recordings)
    assert (one.look.stage, one.look.along) == ("charge", "row and column")
    law = law_of(one, dataset_of(recordings, "left"))
    cell = np.array(law.table).reshape(law.period, law.columns) - 1.0
    # pixels scatter by 1 %, 96 x 128 of them in two classes
    assert cell[:2, :2] == pytest.approx(board, abs=4.0 * 0.01 / np.sqrt(96 * 128 / 4))


def test_rows_of_unequal_noise_in_the_dark_are_found() -> None:
    """Every fourth row has the variance of the others and 25 DN^2 besides: a table of variances, and none of means."""
    rng = np.random.default_rng(7)

    def noisier(frame: Frame, kind: str, black_dn: float) -> Frame:
        frame[1::4] += np.round(5.0 * rng.standard_normal(frame[1::4].shape))
        return frame

    recordings = _changed(772012, noisier)
    (one,) = _found(recordings)
    assert (one.look.stage, one.look.along, one.look.of, one.period) == ("signal", "row", "variance", 4)
    dataset = dataset_of(recordings, "left")
    added_dn2 = dataset.noise.gain**2 * np.array(law_of(one, dataset).table)
    assert int(np.argmax(added_dn2)) == 1
    # variances of 24 rows of 128 pixels by two contrasts are known to sqrt(2 / 6144) = 1.8 %, of some 30 DN^2
    assert added_dn2[1] - np.delete(added_dn2, 1).mean() == pytest.approx(25.0, rel=0.15)


def test_beyond_a_number_of_codes_none_are_tabled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixteen bits would put 65,536 numbers on a page: the periodic table says so, and one by code alone isn't made."""
    monkeypatch.setattr(discovery, "MOST_BY_CODE", 1000)
    recordings = recordings_of(ConcealedCamera(772302, (DigitalGainLaw(10.0),), rows=96, cols=128), LIT_AND_DARK)
    (one,) = _found(recordings)
    assert one.period == 11
    (law,) = discovery.told("left", dataset_of(recordings, "left"), (one,))
    assert "Single codes aren't tabled: more than 1000 were counted" in law.statement
    assert max(len(law.table), len(law.shown_departure)) == 11
    assert not _found(recordings_of(ConcealedCamera(772021, (LossyCodesLaw(0.05),), rows=96, cols=128), LIT_AND_DARK))


@pytest.mark.parametrize(
    ("name", "said", "law"),
    [
        ("line", "a straight line, +3 % over the range", lambda x: 0.03 * (x - 100.0) / 900.0),
        ("step", "a step of +3 % at", lambda x: 0.03 * (x > 420.0)),
        ("knee", "a knee at", lambda x: 0.05 * np.maximum(x - 450.0, 0.0) / 900.0),
        ("bump", "a bump of -3 % at 52", lambda x: -0.03 * np.exp(-0.5 * ((x - 520.0) / 40.0) ** 2)),
        ("formula", "cos(2 pi (u", lambda x: 0.03 * np.cos(2.0 * np.pi * x / 225.0)),
        ("formula", "ln u", lambda x: 0.03 * np.log(x / 1000.0)),
        ("formula", "exp(-(u", lambda x: 0.03 * np.exp(-(x - 100.0) / 112.5)),
    ],
)
def test_a_law_is_found_in_its_own_form(name: str, said: str, law: Callable[[Frame], Frame]) -> None:
    """The shortest description of a law in noise of a thirtieth of its size is its own form."""
    x = np.linspace(100.0, 1000.0, 41)
    three = np.repeat(np.eye(len(x)), 3, axis=0)  # repeats of each
    residual = three @ law(x) + 0.001 * np.random.default_rng(2).standard_normal(len(three))
    profile = Profile(np.arange(len(three)) % 2, residual, np.full(len(three), 1e-6), three)
    forms = [
        *curve_forms(profile, x, x, "nm", lambda value: f"{100.0 * value:+.1g} %"),
        *formulas(profile, x, "nm", by_inverse=False),
    ]
    best = min((fitted(profile, form) for form in forms), key=lambda table: description_length(profile, table))
    assert best.form.name == name
    assert said in best.said
    assert np.sqrt(np.mean(np.square(best.departure - best.departure.mean() - law(x) + law(x).mean()))) < 0.001


@pytest.mark.extra  # a whole diagnosis
@pytest.mark.parametrize(
    ("law", "place", "name", "words"),
    [
        (LampJumpLaw(2.0), ("light", "time"), "step", "a step of +2 % at"),
        pytest.param(
            AbsorptionBandLaw(10.0),
            ("image", "wavelength"),
            "bump",
            "a bump of -9.9 % at 516.2 nm, 8.28 nm wide",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_mismatch_without_a_name_gets_a_law_along_its_coordinate(
    law: Law, place: tuple[str, str], name: str, words: str
) -> None:
    """Nine tenths of what held-out captures depart by are gone with it, and it stands in the improved model.

    The former's band is at 516.2 nm, 8.34 nm wide; its lamp jumps once, by 2 %.
    """
    found = examine(recordings_of(ConcealedCamera(772302, (law,), cfa="MONO", rows=96, cols=128), LIT_AND_DARK))
    one = found.result.discovered[0]
    assert ((one.stage, one.along), one.form) == (place, name)
    assert words in one.statement
    assert one.chi2_before - one.chi2_after > 0.9 * (one.chi2_before - one.n)
    held = found.result.held_out
    assert held is not None and held.chi2_discovered is not None
    assert held.chi2_before - held.chi2_discovered > 0.9 * (held.chi2_before - held.n)
    assert "empirical_law" in [effect.name for effect in found.improved["left"].effects]
    assert [item.shape for item in found.result.unexplained if item.measurement in one.measurements] == [
        f"as the law of the {'source by time' if name == 'step' else 'transmittance by wavelength'}, which has no name"
    ]


@pytest.mark.extra
def test_a_mismatch_that_nothing_predicts_says_what_would_help() -> None:
    camera = ConcealedCamera(772302, (TreeRingsLaw(3.0),), cfa="MONO", rows=128, cols=192)
    found = diagnose(recordings_of(camera, LIT_AND_DARK), None)
    assert "code_density" not in {item.measurement for item in found.unexplained}
    (alone,) = [item for item in found.unexplained if item.measurement == "flat_pattern"]
    assert alone.shape.startswith("irregular")
    assert alone.would_help.startswith("Nothing that was tried predicts it")
    assert "Repeat the flat captures" in alone.would_help
    assert any(alone.would_help in line for line in found.summary)


def _gain_by_code() -> RecordingSet:
    """A gain acts after the converter's codes."""
    return recordings_of(ConcealedCamera(772302, (DigitalGainLaw(10.0),), rows=96, cols=128), LIT_AND_DARK)


@pytest.mark.extra  # a whole diagnosis, twice decided
def test_a_table_of_codes_stands_in_the_improved_model_in_the_place_of_a_family() -> None:
    """A gain after the converter is none of its listed laws: the family, named for the nearest one, gives way to a
    table by code, which is reported and stands in the improved model."""
    found = examine(_gain_by_code())
    (law,) = found.result.discovered
    assert "repeat every 11 codes" in law.statement
    assert law.statement in found.result.summary
    assert found.result.verdict in {"unexplained", "partly_explained"}
    assert "empirical_law" in [effect.name for effect in found.improved["left"].effects]
    assert "converter" not in {effect.name for effect in found.result.effects}
    withdrawn = [one for one in found.result.vetoed if "in its place" in one.statement]
    assert [one.name for one in withdrawn] == ["converter"]
    assert withdrawn[0].chi2_before < withdrawn[0].chi2_after


@pytest.mark.slow
def test_a_law_is_found_alike_at_every_call_and_not_once_it_is_in_the_model() -> None:
    recordings = _gain_by_code()
    found = examine(recordings)
    again = diagnose(recordings, None)
    assert again.discovered == found.result.discovered
    with_it = examine(recordings, baseline=found.improved)
    assert not with_it.result.discovered


@pytest.mark.extra
@pytest.mark.skipif(not DATA.is_dir(), reason="../shared isn't beside the project")
def test_the_codes_of_a_real_ccd_repeat_with_the_bits(tmp_path: Path) -> None:
    """Independent histograms of all levels, each over a normal curve with a polynomial: tables of 4, 8, 64, 128 and 256
    codes take 78, 81, 85, 89 and 90 % off chi2 of single codes; beyond 128 held-out codes gain nothing. Of what 128
    takes, 4 codes take 88 % and 8 codes 91 %. What is left at held-out codes are dips of 5 % over eight codes (3256,
    1256), the same in both frames and all halves of them, at codes that no other level has."""
    recordings = read(write(read_foreign("emva1288", DATA / "emva1288_ccd", ImportOptions()), tmp_path / "set"))
    fit = fit_recording_set(recordings, None, FOR_DIAGNOSIS)
    found = discover(dataset_of(recordings, "left", fit), (), DecisionPolicy())
    codes = next(one for one in found if one.look.stage == "codes")
    assert (codes.period, codes.shorter[0].period) == (128, 8)
    before, after, n = codes.chi2
    assert before / n > 20.0
    assert after / n < 2.5


@pytest.mark.parametrize(
    ("law", "place", "period"),
    [
        (WavyColumnsLaw(0.5), ("charge", "column", "mean"), None),
        (SharedCellLaw(0.5), ("charge", "row and column", "mean"), None),
        (RowBanksLaw(0.5), ("signal", "row", "mean"), 8),
        (FirstRowsLaw(2.0), ("signal", "row", "mean"), None),
        (BankNoiseLaw(3.0), ("signal", "column", "variance"), 2),
        (SharedReadLaw(3.0), ("signal", "row", "covariance"), 2),
        (WarmCentreLaw(20.0), ("charge", "radius", "mean"), None),
        (SaddleShadingLaw(2.0), ("image", "angle", "mean"), None),
        (LeafShutterLaw(20.0), ("charge", "radius x exposure", "mean"), None),
        (RingCodesLaw(0.2), ("codes", "code", "mean"), 10),
        (CoarseTopLaw(0.5), ("codes", "code", "mean"), 2),
    ],
    ids=lambda value: value.name if isinstance(value, Law) else None,
)
@pytest.mark.parametrize("cfa", ["MONO", pytest.param("RGGB", marks=pytest.mark.slow)])
def test_a_law_of_the_former_is_found_at_its_place(
    law: Law, place: tuple[str, str, str], period: int | None, cfa: str
) -> None:
    """Strong laws that no list has: each along its own index, first of all that is told."""
    first = _found(recordings_of(ConcealedCamera(772302, (law,), cfa=cfa, rows=96, cols=128), LIT_AND_DARK))[0]
    assert (first.look.stage, first.look.along, first.look.of) == place
    assert period is None or (*first.shorter, first)[0].period == period
    before, after, n = first.own
    assert before - after > 0.8 * (before - n)


def test_noise_that_grows_with_the_time_is_found() -> None:
    """Read noise whose variance grows by 16 e^2 in ten minutes: within four standard deviations of the line."""
    camera = ConcealedCamera(772302, (WarmingNoiseLaw(4.0),), cfa="MONO", rows=96, cols=128)
    recordings = recordings_of(camera, Plan())
    one = _found(recordings)[0]
    assert (one.look.stage, one.look.along, one.look.of) == ("signal", "time", "variance")
    law = law_of(one, dataset_of(recordings, "left"))
    slope = (law.table[-1] - law.table[0]) / (law.at[-1] - law.at[0])
    std = 4.0 * float(one.std.max()) / dataset_of(recordings, "left").noise.gain ** 2 / (law.at[-1] - law.at[0])
    assert slope == pytest.approx(16.0 / 600.0, abs=max(std, 0.1 * 16.0 / 600.0))


@pytest.mark.extra
def test_unequal_columns_of_a_mosaic_tell_the_greens_difference_too() -> None:
    """Four amplifiers in turn, each within 0.1 % by flats of a shot noise below 0.05 % a class: the difference of even
    and odd columns shows in the two greens alone, and one law tells both.
    """
    camera = ConcealedCamera(772302, (ColumnAmplifiersLaw(1.0),), cfa="RGGB", rows=96, cols=128)
    found = diagnose(recordings_of(camera, LIT_AND_DARK), None)
    assert not found.effects
    (law,) = [one for one in found.discovered if one.stage == "charge"]
    assert (law.along, law.period) == ("column", 4)
    (hidden,) = camera.laws
    assert isinstance(hidden, ColumnAmplifiersLaw)
    assert np.array(law.table) == pytest.approx(1.0 + 0.01 * hidden.balanced(4), abs=1e-3)
