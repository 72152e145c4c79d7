"""Wrong statements as hypotheses: their predictions, their odds, and what is found in recordings of the independent
simulator."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.special import expit, logit

import lab.inference.recordings
from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator.laws import BlackLevelDriftLaw, InfraredCutFilterLaw
from lab.diagnose.inference.side_model import APERTURE_DIRECTIONS, any_aperture
from lab.formats.recording_set import RecordingSet
from lab.inference.hypotheses import Alternative, Hypothesis, SetPrior
from lab.inference.model import Point
from lab.inference.posterior import NAMED, read_table
from lab.inference.recordings import SideProblem, measure_side, search_side
from lab.inference.restated import examine_side
from lab.inference.search import Search
from lab.inference.statements.found import inclusion, wrong_statements
from lab.inference.statements.statement import statements
from lab.inference.statements.structure import exposure_unit_log_odds, weigh_beforehand
from lab.observables.flats.linearity import measure_photon_transfer
from sim.effects.library import effect
from tests.lab.diagnose.metadata.lies import restated, with_dark_exposures, with_exchanged_wavelengths
from tests.lab.inference.on_blocks import judge
from tests.lab.inference.toys import Toy, linear

#: Effects that the searches here try beside wrong statements: rivals on dark levels and on spectra.
HYPOTHESES = (
    "black_level_drift",
    "dark_current_temperature",
    "infrared_cut_filter",
    "wavelength_offset",
    "stray_light",
)
STATEMENTS = {"wrong_exposure", "wrong_black_level", "exchanged_lights"}


@pytest.fixture(scope="module", autouse=True)
def few_hypotheses() -> Iterator[None]:
    """Search a few effects in the place of all."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lab.inference.recordings, "candidates", lambda: tuple(effect(name) for name in HYPOTHESES))
        yield


@pytest.fixture(scope="module")
def right(few_hypotheses: None) -> RecordingSet:
    """Return darks and narrowband lights of a healthy camera, as they were."""
    return _recorded()


def _recorded(*laws: Law) -> RecordingSet:
    return recordings_of(ConcealedCamera(11, laws, cfa="RGGB", rows=96, cols=128), Plan(("dark", "narrowband")))


def _problem(recordings: RecordingSet) -> SideProblem:
    problem = measure_side(recordings, "left", None)
    assert problem is not None
    return problem


# --- alternatives that act as a whole ---------------------------------------------------------------------------------


def test_alternatives_without_a_size_have_their_exact_odds() -> None:
    """Of the changes d1, d2 of unit noise, equally probable given that one acts: p(y | A) / p(y | none) is the mean of
    exp(d'y - d'd / 2). Beside them a size whose signature is orthogonal: its evidence is a factor, in closed form."""
    rng = np.random.default_rng(3)
    d = np.zeros((2, 40))
    d[0, :10], d[1, 5:20] = 0.8, 0.5
    y = 0.6 * d[0] + rng.standard_normal(40)
    toy = Toy(y, {"whole": lambda u: 0.0 * y, "size": lambda u: u[0] * (np.arange(40) == 39)}, np.zeros((40, 0)))

    class Discrete(Toy):
        """A toy whose hypothesis `whole` is one of two changes, by its template."""

        def mean(self, state: Any) -> Any:
            found = super().mean(state)
            return found + d[state["whole"].template] if "whole" in state else found

    discrete = Discrete(toy.value, toy.changes, toy.nuisance)
    points = [Point(np.zeros(0), k) for k in (0, 1)]
    whole = Hypothesis(
        "whole", "statements", (), tuple(Alternative((p,), (1.0,), is_whole=True) for p in points),
        log_prior=lambda point: -float(np.log(2.0)),
    )  # fmt: skip
    hypotheses = {"whole": whole, "size": linear("size", "sizes", 1.0)}
    prior = SetPrior({"whole": "statements", "size": "sizes"}, number=(0.5, 0.5))
    table = Search(discrete, hypotheses, prior).run()
    ratio = float(np.mean(np.exp(d @ y - 0.5 * np.square(d).sum(axis=1))))
    found = inclusion(table)["whole"]
    nothing = read_table(table, hypotheses).nothing
    # p(A) is 0.25 of `whole`, 0.5 of none
    assert found / nothing == pytest.approx(0.5 * ratio, rel=0.02)


# --- predictions by the value that is right ---------------------------------------------------------------------------


def _changed_mean(problem: SideProblem, statement: str, number: int) -> dict[tuple[str, str], float]:
    """Prediction of narrowband numbers, by capture and channel, with one restatement of a kind."""
    (declared,) = (one for one in statements() if one.name == statement)
    numbers = problem.numbers(problem.measured)
    change = declared.restatements(numbers)[number].on(numbers)(np.zeros(0))
    mean = change.on_mean(problem.measured.mean())
    labels = [label for b in problem.measured.blocks for label in b.labels]
    spread = np.zeros(len(mean))
    if change.spread is not None:
        spread[change.rows] = change.spread
    return {
        (label.captures[0], label.channel): float(m)
        for label, m, s in zip(labels, mean, spread, strict=True)
        if label.condition.endswith(" nm") and s == 0.0
    }


def test_an_exchange_predicts_what_the_right_statement_does(right: RecordingSet) -> None:
    """Every narrowband number of the exchanged statement, with 500 and 600 nm exchanged back. No number that is used
    differs: y has none of what is stated in it."""
    wrong = _problem(with_exchanged_wavelengths(right, 500.0, 600.0))
    true = _problem(right)
    expected = {
        (label.captures[0], label.channel): float(m)
        for label, m in zip(
            (label for b in true.measured.blocks for label in b.labels), true.measured.mean(), strict=True
        )
        if label.condition.endswith(" nm")
    }
    numbers = wrong.numbers(wrong.measured)
    lights = list(dict.fromkeys(c[0].wavelength_nm for _, label, c in _narrowband(numbers)))
    pairs = [(a, b) for k, a in enumerate(lights) for b in lights[k + 1 :]]
    (number,) = (k for k, pair in enumerate(pairs) if set(pair) == {500.0, 600.0})
    found = _changed_mean(wrong, "exchanged_lights", number)
    assert len(found) > 60
    for key, mean in found.items():
        assert mean == pytest.approx(expected[key], rel=1e-4, abs=1e-3), key
    np.testing.assert_array_equal(np.sort(wrong.measured.value), np.sort(true.measured.value))


def _narrowband(numbers: Any) -> list[Any]:
    from lab.observables.spectra.narrowband import NARROWBAND

    return [*numbers.of(NARROWBAND)]


def test_held_out_numbers_have_the_apertures_of_those_that_are_used() -> None:
    """Changes by an aperture that are linear in two of its functions: the columns of the first numbers are theirs
    alone, and those of the others the same apertures' changes."""
    rng = np.random.default_rng(0)
    shape = rng.standard_normal((12, 2))

    def mean(effects: Any = ()) -> Any:
        side = effects[0].side_change_um if effects else 0.0
        return shape @ np.array([side, side**2])

    model = cast("Any", SimpleNamespace(mean=mean, camera=SimpleNamespace(pixel_pitch_um=3.0)))
    first = cast("Any", SimpleNamespace(mean=lambda e=(): mean(e)[:7], camera=model.camera))
    whole, used = any_aperture(model, 7), any_aperture(first)
    assert 2 <= len(used) <= APERTURE_DIRECTIONS
    for k in range(2):
        np.testing.assert_allclose(whole[f"aperture:{k}"][:7], used[f"aperture:{k}"], atol=1e-12)
    table = np.column_stack([whole["aperture:0"], whole["aperture:1"]])
    np.testing.assert_allclose(shape @ np.linalg.lstsq(shape, table, rcond=None)[0], table, atol=1e-9)


# --- what is found ----------------------------------------------------------------------------------------------------


def test_right_statements_are_not_doubted(right: RecordingSet) -> None:
    search, table = search_side(_problem(right))
    assert set(search.hypotheses) >= STATEMENTS
    found = inclusion(table)
    assert all(found.get(name, 0.0) < 0.1 for name in STATEMENTS)
    assert not read_table(table, search.hypotheses).named


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_a_wrong_exposure_of_darks_is_found(right: RecordingSet, factor: float) -> None:
    """2 s stated as 1.6 or 2.5 s: the true one within three standard deviations of what is told."""
    wrong = with_dark_exposures(right, 2.0, factor)
    (found,) = wrong_statements(wrong, "left", *search_side(_problem(wrong)))
    assert found.probability is not None
    assert found.probability >= NAMED
    fits_s, std_s = found.check.split("have the level of ")[1].split(" s")[0].split(" ± ")
    assert abs(float(fits_s) - 2.0) < 3.0 * float(std_s)
    assert set(found.captures) == {c.id for c in right.captures("dark") if c.exposure_s == 2.0}


class _WrongShutter(ConcealedCamera):
    """Frames `wrong` are exposed `factor` times as long as is noted."""

    wrong: range = range(0)
    factor = 1.1

    def expose(self, images: Any, exposure_s: float, k: int, temperature_c: float = 25.0) -> Any:
        """Return the frame of capture k."""
        return super().expose(images, exposure_s * (self.factor if k in self.wrong else 1.0), k, temperature_c)


#: Numbers of captures after nine darks: a level of three repeats, and the second of a level's two passes.
@pytest.mark.parametrize(("wrong", "shuttle"), [(range(18, 21), False), (range(31, 33), True)], ids=["level", "pass"])
def test_a_wrong_shutter_of_flats_is_found(wrong: range, shuttle: bool) -> None:
    """1.1 within three standard deviations of what is told; what is measured with it names nothing."""
    camera = _WrongShutter(3, cfa="MONO", rows=96, cols=128)
    camera.wrong = wrong
    recordings = recordings_of(camera, Plan(("dark", "flat"), shuttle=shuttle))
    examined = examine_side(recordings, "left", None)
    (found,) = examined.wrong
    assert found.captures == tuple(f"c{k:04d}" for k in wrong)
    stated_s = next(c.exposure_s for c in recordings.captures() if c.id == found.captures[0])
    fits_s, std_s = found.check.split("have the level of ")[1].split(" s")[0].split(" ± ")
    assert abs(float(fits_s) - 1.1 * stated_s) < 3.0 * float(std_s)
    assert examined.searched is not None
    assert not read_table(examined.searched.table, examined.searched.search.hypotheses).named


@pytest.mark.parametrize(("wrong", "shuttle", "factor"), [(range(18, 21), False, 1.03), (range(31, 33), True, 0.9)])
def test_levels_alone_tell_a_wrong_shutter_from_other_causes(wrong: range, shuttle: bool, factor: float) -> None:
    """A step of a converter and its opposite once promised 50 nats beyond their best fit, where a refit ended beside
    its mode; and of sixteen places of a shutter those were kept that fit best as longer exposures."""
    camera = _WrongShutter(3, cfa="MONO", rows=96, cols=128)
    camera.wrong, camera.factor = wrong, factor
    found = judge(recordings_of(camera, Plan(("dark", "flat"), shuttle=shuttle)), measure_photon_transfer)
    assert found.names == ["wrong_exposure"]
    size = found.size("wrong_exposure", "factor")
    assert abs(size.mean - factor) < 4.0 * size.std
    (statement,) = wrong_statements(found.reading.recordings, "left", found.reading.search, found.reading.table)
    assert statement.captures == tuple(f"c{k:04d}" for k in wrong)


def test_a_wrong_black_level_is_found(right: RecordingSet) -> None:
    """Half of the true 168 DN, as another setting has it: thirteen standard deviations of 3 % and 2 DN."""
    true_dn = right.camera("left").black_level_dn
    assert true_dn is not None
    wrong = restated(right, black_level_dn=0.5 * true_dn)
    (found,) = wrong_statements(wrong, "left", *search_side(_problem(wrong)))
    assert f"black_level_dn = {0.5 * true_dn:g} is stated" in found.check
    corrected_dn = found.corrected.camera("left").black_level_dn
    # the baseline's own tolerance of 3 %, of 84 DN, is not told apart from the error
    assert corrected_dn == pytest.approx(true_dn, abs=3.0 * (0.03 * true_dn + 3.0))


def test_exchanged_lights_are_found_and_left_out(right: RecordingSet) -> None:
    wrong = with_exchanged_wavelengths(right, 450.0, 460.0)
    examined = examine_side(wrong, "left", None)
    (found,) = examined.wrong
    assert set(found.where.split(" and ")) == {"450 nm", "460 nm"}
    assert {c.wavelength_nm for c in wrong.captures("narrowband") if c.id in found.captures} == {450.0, 460.0}
    assert found.correction == "the captures are left out"
    assert examined.searched is not None
    assert not read_table(examined.searched.table, examined.searched.search.hypotheses).named


@pytest.mark.parametrize(("stated", "curves"), [("BGGR", True), ("GRBG", True), ("GBRG", False)])
def test_a_wrong_mosaic_is_found_and_the_camera_read_as_it_is(
    right: RecordingSet, stated: str, curves: bool
) -> None:  # fmt: skip
    """By the four planes, so that RGGB is told from BGGR where GRBG is stated; also by typical curves."""
    values = {} if curves else {"quantum_efficiency": None}
    examined = examine_side(restated(right, cfa=stated, **values), "left", None)
    (found,) = examined.wrong
    assert "correct cfa to RGGB" in found.check
    assert found.probability is not None
    assert found.probability >= NAMED
    assert examined.recordings.camera("left").cfa == "RGGB"
    assert examined.searched is not None
    assert not read_table(examined.searched.table, examined.searched.search.hypotheses).named


@pytest.mark.parametrize("law", [InfraredCutFilterLaw, BlackLevelDriftLaw], ids=lambda law: law.name)
def test_effects_are_no_wrong_statements(law: type[Law]) -> None:
    recordings = _recorded(law(law.nominal, 0))
    assert wrong_statements(recordings, "left", *search_side(_problem(recordings))) == ()


# --- statements that decide what can be measured ----------------------------------------------------------------------


def test_the_unit_of_exposures_has_the_odds_of_the_longest() -> None:
    """ln t normal about ln 1 s with ln 10: 2e6 s are 6.3 standard deviations off, 2 s 0.3. 20 s stay seconds."""
    assert exposure_unit_log_odds(7.0, 1.0) == 0.0
    assert exposure_unit_log_odds(2e6, 1e-6) == pytest.approx(0.5 * (np.log10(2e6) ** 2 - np.log10(2.0) ** 2))
    assert exposure_unit_log_odds(1e3, 1e-3) == pytest.approx(0.5 * 9.0)
    assert expit(logit(0.005) + exposure_unit_log_odds(20.0, 1e-3)) < 0.01


def test_a_bit_depth_that_is_stated_too_large_is_found_before_anything_is_measured() -> None:
    recordings = recordings_of(ConcealedCamera(13, cfa="MONO", rows=96, cols=128), Plan(("dark", "flat")))
    frames = {c.frame: np.minimum(recordings.frame(c), 1023) for c in recordings.manifest.captures}
    clipped = RecordingSet(recordings.manifest, frames, source="clipped")
    corrected, (found,) = weigh_beforehand(clipped, "left")
    assert found.probability == pytest.approx(1.0)
    assert corrected.camera("left").bit_depth == 10
    assert weigh_beforehand(recordings, "left")[1] == ()
