"""The search over sets of effects, on small made-up models whose effects act in known ways."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
import pytest
from pydantic import Field

from lab.diagnose.inference.decide import _still_certain, _with_equal_choices, _with_every_mode, decide, named_members
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.score import prototype_changes, signatures_of
from lab.diagnose.inference.search import Search
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.policy import DecisionPolicy
from lab.observables.gaussian import BlockCovariance
from lab.observables.observable import Label, Observable, Prediction
from sim.camera import CameraModel, Lens
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.effects.library import candidates, effect
from sim.parameters import Quantity
from sim.spectrum import FloatArray, Spectrum
from sim.stages import Signal
from sim.uniform import Uniform
from tests.lab.diagnose.inference.made_up import contrast_model
from tests.lab.diagnose.on_blocks import declared

X = np.linspace(0.0, 1.0, 60)
NOISE = 0.01
THRESHOLD = 12.0


class _Curve(Effect):
    """Adds `size` times a shape to the line that is measured; it borrows the law for offsets."""

    family: ClassVar[Family] = Family.DARK_SIGNAL
    reference: ClassVar[str] = "made up"
    sentence: ClassVar[str] = "Made up."
    form_tolerance: ClassVar[float] = 0.01
    size_dn: Annotated[float, Quantity("DN", "size", prior=(0.0, 0.1), absent=0.0)] = 0.0

    def on_signal(self, signal: Signal) -> Signal:
        if self.size_dn == 0.0:
            return signal
        return signal.add_laws(offset_dn=lambda elapsed_s, temperature_c: self.added_dn(elapsed_s))

    def added_dn(self, elapsed_s: float) -> float:
        return self.size_dn * float(self.shape(np.asarray(elapsed_s)))

    def shape(self, x: FloatArray) -> FloatArray:
        raise NotImplementedError


class _Up(_Curve):
    name: ClassVar[str] = "up"

    def shape(self, x: FloatArray) -> FloatArray:
        return np.asarray(x)


class _Bend(_Curve):
    name: ClassVar[str] = "bend"

    def shape(self, x: FloatArray) -> FloatArray:
        return np.asarray(x**2)


class _Wave(_Curve):
    name: ClassVar[str] = "wave"

    def shape(self, x: FloatArray) -> FloatArray:
        return np.sin(6.0 * np.pi * x)


class _Ripple(_Curve):
    name: ClassVar[str] = "ripple"

    def shape(self, x: FloatArray) -> FloatArray:
        return np.asarray(np.sin(6.0 * np.pi * x) + 0.4 * np.sin(14.0 * np.pi * x))


class _Arch(_Curve):
    """Nearly what `up` less `bend` amount to: alone the best of all, and yet not what is there."""

    name: ClassVar[str] = "arch"

    def shape(self, x: FloatArray) -> FloatArray:
        return np.sin(np.pi * x) * (1.0 + 0.3 * x)


KINDS: tuple[type[Effect], ...] = (_Up, _Bend, _Wave, _Ripple, _Arch)


def _camera() -> CameraModel:
    flat = Spectrum.of([400.0, 700.0], [0.5, 0.5])
    return CameraModel(
        rows=8, cols=8, pixel_pitch_um=3.0, fill_factor=1.0, cfa="MONO", bit_depth=12, black_level_dn=64.0,
        white_level_dn=4095.0,
        conversion_gain_dn_per_e=0.5, full_well_e=8000.0, read_noise_e=2.0, dark_current_e_per_s=1.0, dsnu_e=0.0,
        prnu_percent=0.0,
        quantum_efficiency={"Y": flat}, lens=Lens(f_number=4.0, focal_length_mm=8.0),
    )  # fmt: skip


def _model(truth: Sequence[Effect], rng: np.random.Generator) -> MeasurementModel:
    camera = _camera()

    def line(acting: Sequence[Effect]) -> FloatArray:
        return np.array([Uniform(camera, acting).offset_dn(float(x), None, 0.01) for x in X])

    block = Observable(
        measurement=declared("dark", "time", "s"), reach=0.2, value=line(truth) + NOISE * rng.standard_normal(X.size),
        covariance=NOISE**2 * np.eye(X.size), labels=tuple(Label(float(x), "all", "", (f"c{i}",), False) for i,
        x in enumerate(X)),
        reads=frozenset({"signal.offset_dn"}), predict=lambda acting: Prediction(line(acting), {}),
        scale=np.ones(X.size),
    )  # fmt: skip
    return MeasurementModel((block,), camera)


def _search(
    truth: Sequence[Effect],
    seed: int,
    policy: DecisionPolicy | None = None,
    clock: Callable[[], float] = time.process_time,
) -> Search:
    model = _model(truth, np.random.default_rng(seed))
    changes = prototype_changes(model, model.camera, (), KINDS)
    return Search(model, KINDS, changes, THRESHOLD, policy or DecisionPolicy(), clock=clock)


def _best(truth: Sequence[Effect], seed: int) -> set[str]:
    return set(_search(truth, seed).best().names)


def test_a_pair_is_found_that_a_third_effect_hides() -> None:
    """x - x^2 is within 3 % of an arch: the arch alone has the highest score, and only the pair is right to the
    noise."""
    truth = (_Up(size_dn=1.2), _Bend(size_dn=-1.2))
    search = _search(truth, 1)
    problem = search.problem(search.fitted((), converged=True))
    singles, pairs = problem.best(1), problem.best(2)
    assert [problem.owners[m] for m in singles[0].members] == ["arch"]
    assert {problem.owners[m] for m in pairs[0].members} == {"up", "bend"}
    assert pairs[0].score > singles[0].score
    assert _best(truth, 1) == {"up", "bend"}


def test_two_effects_of_different_shapes_are_both_found() -> None:
    assert _best((_Up(size_dn=0.1), _Wave(size_dn=0.05)), 2) == {"up", "wave"}


def test_a_search_that_keeps_few_signatures_finds_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = (_Up(size_dn=1.2), _Bend(size_dn=-1.2), _Wave(size_dn=0.05))
    many, few = (_search(truth, 3) for _ in range(2))
    best = many.best()
    monkeypatch.setattr("lab.diagnose.inference.search.MOST_SIGNATURES", 1)
    assert few.best().effects == best.effects
    assert few.models() == many.models()
    assert len(few._signatures) == 1 < len(many._signatures)


def test_scores_beside_a_law_that_holds_are_by_the_tolerance_that_it_needs() -> None:
    """A line of 5 DN may be wrong by 0.05 DN, smoothly: with the whole of that, a bend of 0.04 DN beside it scores
    nothing."""
    search = _search((_Up(size_dn=5.0), _Bend(size_dn=0.04)), 60)
    fit = search.fitted((_Up(size_dn=5.0),), converged=True)
    assert fit.tolerated < 1.0
    whole = signatures_of(search.model, fit.effects, [c for c in search.changes if c[0] is _Bend], fit.jacobian)
    needed = {score.effect: score.value for score in search.signatures(fit).scores()}
    assert needed[_Bend] > 1.0 > 10.0 * whole.scores()[0].value


def test_what_a_strong_law_may_lack_is_no_second_effect() -> None:
    """A line of 5 DN and an arch of 0.1 DN, where a law may lack 5 % of its own change: the arch fits, and isn't told.
    Without the strong line beside it, the same arch is."""
    truth, policy = (_Up(size_dn=5.0), _Arch(size_dn=0.1)), DecisionPolicy(beside_tolerance=0.05)
    search = _search(truth, 60, policy)
    fit = search.fitted(truth, converged=True)
    gain = fit.log_posterior - search.without(fit, 1).log_posterior
    assert gain > search.needed_log_odds > search.member_log_odds(fit, 1)
    named, given_up = named_members(search, fit, lambda _: None)
    assert "arch" not in [c.effect.name for c in (*named, *given_up)]
    alone = _search(truth[1:], 60, policy)
    named, _ = named_members(alone, alone.fitted(truth[1:], converged=True), lambda _: None)
    assert [c.effect.name for c in named] == ["arch"]


def test_what_was_certain_beside_another_effect_is_weighed_again_without_it() -> None:
    """Both show in the one measurement there is: when the wave leaves, the arch isn't certain any more."""
    search = _search((_Arch(size_dn=0.3), _Wave(size_dn=0.1)), 1)
    fit = search.fitted((_Arch(size_dn=0.3), _Wave(size_dn=0.1)), converged=True)
    certain = {"arch": Candidate(fit.effects[0], fit.std[0], 1.0, (), 500.0)}
    assert _still_certain(search, certain, fit, fit) == certain
    assert _still_certain(search, certain, fit, search.without(fit, 1)) == {}


def test_a_set_that_was_vetoed_is_not_returned_to() -> None:
    search = _search((_Up(size_dn=0.1), _Wave(size_dn=0.05)), 5)
    best = search.best()
    rest = search.fitted((best.effects[best.names.index("up")],), converged=True)
    named, _ = named_members(search, rest, lambda _: None, barred={frozenset(best.names)})
    assert [c.effect.name for c in named] in (["up"], [])


def test_sets_that_the_numbers_cannot_tell_apart_share_the_probability() -> None:
    """A ripple is the wave and a fainter one of another frequency, sqrt(60 / 2) x 0.4 x 0.004 / 0.01 = 0.9 standard
    deviations off at this size: either may be it, and the set that holds 95 % has both. Beside it nothing else is a
    part."""
    for seed in range(8):
        search = _search((_Up(size_dn=0.1), _Wave(size_dn=0.012)), 30 + seed)
        search.best()
        found = search.models()
        held = [set(m.effects) for m in found.models]
        assert {"up", "wave"} in held, seed
        assert sum(m.probability for m in found.models) >= 0.95
        assert sum(p for n, p in found.inclusion if n in {"wave", "ripple"}) > 0.5
    clear = _search((_Up(size_dn=0.1), _Wave(size_dn=0.05)), 40)
    clear.best()
    assert [set(m.effects) for m in clear.models().models] == [{"up", "wave"}]
    assert dict(clear.models().inclusion)["up"] == pytest.approx(1.0, abs=1e-3)


def test_a_spent_budget_ends_the_search_and_tells_what_is_left() -> None:
    """A clock on which every look takes a second: after two seconds nothing more is refitted."""
    ticks = iter(range(1000))
    truth = (_Up(size_dn=0.1), _Wave(size_dn=0.05))
    search = _search(truth, 5, DecisionPolicy(search_cpu_s=2.0), lambda: float(next(ticks)))
    search.best()
    left = {frozenset(names) for names in search.models().not_weighed}
    assert left
    assert not left & set(search.fits)
    unhurried = _search(truth, 5)
    unhurried.best()
    assert left & set(unhurried.fits)
    assert unhurried.models().not_weighed == ()
    assert len(search.fits) < len(unhurried.fits)


def test_a_diagnosis_whose_budget_is_spent_still_decides() -> None:
    model = contrast_model(np.random.default_rng(7), (effect("defocus")(defocus_um=6.0),))
    found = decide(model, np.random.default_rng(0), DecisionPolicy(search_cpu_s=0.0))
    assert found.named == ()
    assert found.before  # where it departs is located all the same
    assert ("defocus",) in found.models.not_weighed


def test_nothing_is_found_in_noise() -> None:
    """A score beyond 12 of any of five comes in 5 x 5e-4 of the draws: of 40, none with a probability of 0.9, at most 2
    with 0.9998."""
    assert sum(bool(_best((), seed)) for seed in range(100, 140)) <= 2


def test_the_nearer_of_two_rivals_wins() -> None:
    assert _best((_Up(size_dn=0.1), _Ripple(size_dn=0.05)), 4) == {"up", "ripple"}
    assert _best((_Up(size_dn=0.1), _Wave(size_dn=0.05)), 5) == {"up", "wave"}


class _Squared(_Curve):
    name: ClassVar[str] = "squared"
    size_dn: Annotated[
        float, Quantity("DN", "size", lower=-5.0, upper=5.0, prior=(0.0, 1.0), absent=0.0, linear_power=2)
    ] = 0.0
    skew: ClassVar[float] = 0.0

    def added_dn(self, elapsed_s: float) -> float:
        return (self.size_dn**2 + self.skew * self.size_dn) * elapsed_s


class _Lopsided(_Squared):
    name: ClassVar[str] = "lopsided"
    skew: ClassVar[float] = 0.3


def test_a_sign_is_unknown_where_only_the_square_acts() -> None:
    """The size keeps its own standard deviation, and is told positive. A sign that the numbers tell stays as it is
    known."""
    for kind, is_unsigned in ((_Squared, True), (_Lopsided, False)):
        truth = kind(size_dn=0.5)
        model = _model((truth,), np.random.default_rng(6))
        told = truth.replace_fields(size_dn=-0.5) if is_unsigned else truth
        candidate = Candidate(told, {"size_dn": 0.01}, 1.0, (), 50.0)
        found = _with_every_mode(model, candidate, (told,), DecisionPolicy())
        assert found.std["size_dn"] == 0.01
        assert found.effect.size_dn == 0.5  # type: ignore[attr-defined]
        assert found.unsigned == (frozenset({"size_dn"}) if is_unsigned else frozenset())
        assert found.modes == ()


class _Either(_Curve):
    """As a bowed and a tilted image in two opposite places: the parameters may be exchanged, and turn their signs
    together."""

    name: ClassVar[str] = "either"
    size_dn: Annotated[
        float, Quantity("DN", "size", lower=-5.0, upper=5.0, prior=(0.0, 1.0), absent=0.0, linear_power=2)
    ] = 0.0
    other_dn: Annotated[
        float, Quantity("DN", "size", lower=-5.0, upper=5.0, prior=(0.0, 1.0), absent=0.0, linear_power=2)
    ] = 0.0

    def added_dn(self, elapsed_s: float) -> float:
        return ((self.size_dn + self.other_dn) ** 2 + (self.size_dn - self.other_dn) ** 2 * elapsed_s) * elapsed_s


def test_other_modes_are_told_beside_the_size() -> None:
    """Modes (v, 0), (0, v), (-v, 0) and (0, -v), as likely: the second is told beside the first, and the signs are
    unknown."""
    truth = _Either(size_dn=0.5)
    model = _model((truth,), np.random.default_rng(6))
    candidate = Candidate(truth, {"size_dn": 0.01, "other_dn": 0.01}, 1.0, (), 50.0)
    found = _with_every_mode(model, candidate, (truth,), DecisionPolicy())
    assert found.std == candidate.std
    assert found.unsigned == frozenset({"size_dn", "other_dn"})
    (mode,) = found.modes
    assert abs(mode["other_dn"]) == pytest.approx(0.5, rel=0.1)
    assert abs(mode["size_dn"]) < 0.1


def test_a_size_that_may_be_absent_is_none() -> None:
    """Within two standard deviations of absence in every parameter that sizes the effect; shapes and unknown deviations
    don't count."""
    known = Candidate(_Either(size_dn=0.5, other_dn=0.1), {"size_dn": 0.2, "other_dn": 0.1}, 1.0, (), 50.0)
    assert not known.is_compatible_with_absence(2.0)
    assert replace(known, std={"size_dn": 0.3, "other_dn": 0.1}).is_compatible_with_absence(2.0)
    assert not replace(known, std={"size_dn": 0.3, "other_dn": None}).is_compatible_with_absence(2.0)


def test_a_covariance_that_came_out_negative_somewhere_still_has_a_factor() -> None:
    covariance = np.array([[1.0, 1.2], [1.2, 1.0]]) * 4.0
    lower = BlockCovariance(covariance).lower
    assert np.linalg.eigvalsh(lower @ lower.T)[0] > 0.0
    np.testing.assert_allclose((lower @ lower.T)[0, 1], 4.4, rtol=1e-3)  # what eigenvalues of 2.2 and 0 leave
    positive = np.array([[1.0, 0.5], [0.5, 1.0]])
    np.testing.assert_allclose(BlockCovariance(positive).lower @ BlockCovariance(positive).lower.T, positive)


def test_what_a_name_needs_is_a_probability() -> None:
    """Odds of 9 to 1 against its absence, of which the prior takes 45; and half of what drawn healthy cameras have
    raised the threshold by."""
    model, policy = contrast_model(np.random.default_rng(24)), DecisionPolicy()
    search = Search(model, candidates(), (), 16.0)
    odds = np.exp(search.needed_log_odds - policy.included_log_odds)
    assert odds / (1.0 + odds) == pytest.approx(policy.least_inclusion_probability)
    assert search.needed_log_odds == pytest.approx(np.log(45.0 * 9.0), abs=0.01)
    raised = Search(model, candidates(), (), 40.0, above_noise=24.0)
    assert raised.needed_log_odds == pytest.approx(search.needed_log_odds + 12.0)


class _EveryOther(_Curve):
    """A size times a power of the time; `name_only` changes nothing that is measured."""

    name: ClassVar[str] = "every_other"
    power: Annotated[Literal[1, 2], Field(description="power of the time")] = 1
    name_only: Annotated[int, Field(description="which of three", ge=0, le=2)] = 0

    def added_dn(self, elapsed_s: float) -> float:
        return self.size_dn * elapsed_s**self.power

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple((cls(size_dn=0.1, power=power, name_only=k),) for power in (1, 2) for k in range(3))


def test_choices_that_the_recordings_cannot_tell_are_kept_beside_the_one_told() -> None:
    truth = _EveryOther(size_dn=0.5, name_only=1)
    model = _model((truth,), np.random.default_rng(6))
    candidate = Candidate(truth, {"size_dn": 0.01}, 1.0, (), 50.0)
    found = _with_equal_choices(model, candidate, (truth,), DecisionPolicy())
    assert {(e.power, e.name_only) for e in found.alike} == {(1, 0), (1, 2)}  # type: ignore[attr-defined]
