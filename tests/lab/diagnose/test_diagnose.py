"""The parts of the diagnosis on small made-up evidence, and the chain on recordings of a second image former."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lab.challenge.recordings import recordings_of
from lab.diagnose import diagnose
from lab.diagnose.inference.decide import decide
from lab.diagnose.inference.discrepancy import likeliest_discrepancy, predictive_discrepancy
from lab.diagnose.inference.gaussian import BlockCovariance, Gaussian, chi2
from lab.diagnose.inference.locate import mismatches
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.refit import Fit, refit
from lab.diagnose.inference.score import Signatures, signatures
from lab.diagnose.inference.search import Search
from lab.diagnose.measurements.summaries import Block, Label, Prediction
from lab.diagnose.policy import DecisionPolicy
from lab.formats.recording_set import Manifest, RecordingSet
from mocks.former import ConcealedCamera, Plan
from sim.camera import CameraModel, Lens
from sim.effects.base import Effect
from sim.effects.library import candidates, effect, effects
from sim.point import TRANSFER, Blur
from sim.spectrum import Spectrum

FREQUENCY = np.linspace(0.02, 0.9, 23)
NOISE = 0.004


def _camera() -> CameraModel:
    grid = np.arange(380.0, 781.0, 10.0)
    return CameraModel(
        rows=64, cols=64, pixel_pitch_um=3.0, fill_factor=0.9, cfa="MONO", bit_depth=12, black_level_dn=64.0, white_level_dn=4095.0,
        conversion_gain_dn_per_e=0.4, full_well_e=10000.0, read_noise_e=2.0, dark_current_e_per_s=5.0, dsnu_e=0.0, prnu_percent=0.0,
        quantum_efficiency={"Y": Spectrum.of(grid, np.full(grid.shape, 0.5))}, lens=Lens(f_number=4.0, focal_length_mm=8.0),
    )  # fmt: skip


CAMERA = _camera()


def _transfer(acting: Sequence[Effect], angle: float) -> np.ndarray:
    blur = Blur(CAMERA, acting)  # over any baseline
    factor = blur.beside_lens(550.0, FREQUENCY * np.cos(angle), FREQUENCY * np.sin(angle))
    return np.asarray(np.exp(-2.0 * FREQUENCY) * np.real(factor))


def _model(rng: np.random.Generator, truth: Sequence[Effect] = (), extra: np.ndarray | float = 0.0) -> MeasurementModel:
    """Two directions, seen and held out; white noise."""
    angles = [0.0, 0.0, 0.8, 0.8]
    labels = tuple(
        Label(float(f), "Y", f"{a:g}", (f"edge-{i}",), i % 2 == 1) for i, a in enumerate(angles) for f in FREQUENCY
    )
    n = len(labels)
    value = np.concatenate([_transfer(truth, a) + extra for a in angles]) + NOISE * rng.standard_normal(n)
    block = Block(
        measurement="slanted_edge", axis="spatial_frequency", unit="cy/px", reach=0.2, value=value, covariance=NOISE**2 * np.eye(n),
        labels=labels, reads=TRANSFER, scale=np.ones(n),
        predict=lambda acting: Prediction(np.concatenate([_transfer(acting, a) for a in angles]), {}),
    )  # fmt: skip
    return MeasurementModel((block,), CAMERA)


def test_score_is_the_likelihood_ratio_of_a_small_effect() -> None:
    """Noise-free, S = |whitened change|^2; the change of defocus is linear in u to better than 5 % here."""
    truth = effect("defocus")(defocus_um=5.0)
    model = _model(np.random.default_rng(1), (truth,))
    exact = model.mean((truth,))
    clean = MeasurementModel((Block(**{**model.blocks[0].__dict__, "value": exact}),), CAMERA)
    change = (exact - clean.mean())[clean.seen] / NOISE
    score = next(s for s in signatures(clean, CAMERA, (), [effect("defocus")]).scores())
    assert score.value == pytest.approx(float(change @ change), rel=0.05)


def test_threshold_holds_its_rate() -> None:
    """Of 300 healthy draws 1 % may exceed the 99 % quantile; 3 sigma of a binomial is 3 + 5.2 = 8 of them."""
    rng = np.random.default_rng(2)
    kinds = list(effects().values())
    first = signatures(_model(rng), CAMERA, (), kinds)
    threshold = first.threshold(np.random.default_rng(0), 0.99, 400)
    exceeded = 0
    for _ in range(300):
        draw = replace(first, white=rng.standard_normal(len(first.white)))
        exceeded += max(s.value for s in draw.scores()) > threshold
    assert exceeded <= 8


def test_a_refit_begins_at_the_prototype_that_lies_nearest() -> None:
    """Ten times the first prototype promises most, but is far off where it isn't small; the second one is half of the residual."""
    few, many = (effect("hot_pixels")(excess_e_per_s=100.0, share_ppm=ppm) for ppm in (20.0, 200.0))
    white, promised, near = np.array([10.0, 1.0]), np.array([1.0, 0.0]), np.array([5.0, 1.0])

    def table_of(prototypes: Sequence[Effect]) -> np.ndarray:
        return np.array([[100.0, 100.0] for _ in prototypes]).T

    columns = [(type(few), (one,), table[:, None]) for one, table in ((few, promised), (many, near))]
    (score,) = Signatures(white, columns, table_of).scores()
    assert score.value == pytest.approx(51.0**2 / 26.0)
    assert score.start == many
    (score,) = Signatures(white, columns, lambda one: white[:, None]).scores()  # the scaled one is all of it
    assert score.start.having(excess_e_per_s=100.0) == many
    assert score.start != many


def test_score_of_a_one_sided_effect_is_never_negative() -> None:
    """A contrast that is too high can't be a blur."""
    model = _model(np.random.default_rng(3), (), 0.05 * np.exp(-FREQUENCY))
    scores = {
        s.effect.name: s.value
        for s in signatures(model, CAMERA, (), [effect("defocus"), effect("pixel_aperture")]).scores()
    }
    assert scores["defocus"] >= 0.0
    assert scores["defocus"] < 0.05 * scores["pixel_aperture"]


def test_refit_covers_the_truth() -> None:
    """40 draws: pulls have mean 0 within 3 / sqrt(40) and a standard deviation in 0.6..1.35.

    The form tolerance (1 %) is in the intervals and not in the draws, so that they may be too wide and not too narrow.
    """
    kind = effect("optical_low_pass_filter")
    truth = kind(displacement_x_um=1.5, displacement_y_um=1.2)
    pulls = []
    for seed in range(40):
        fit = refit(
            _model(np.random.default_rng(100 + seed), (truth,)),
            (kind(displacement_x_um=1.0, displacement_y_um=1.0),),
            DecisionPolicy(),
        )
        std = fit.std[0]["displacement_x_um"]
        assert std is not None
        pulls.append((fit.effects[0].displacement_x_um - 1.5) / std)
    assert abs(np.mean(pulls)) < 3.0 / np.sqrt(40)
    assert 0.6 < np.std(pulls) < 1.35


def test_held_out_chi2_is_its_number_for_the_truth() -> None:
    """46 numbers: mean 46, standard deviation sqrt(92) = 9.6; over 30 draws of the mean 3 sigma are 5.3."""
    truth = (effect("defocus")(defocus_um=8.0),)
    found = [_model(np.random.default_rng(s), truth).held_out(truth) for s in range(30)]
    assert {n for _, n in found} == {46}
    # the form tolerance widens the distribution: never above, little below
    assert 46 - 12 < np.mean([c for c, _ in found]) < 46 + 5.3
    assert np.mean([_model(np.random.default_rng(s), truth).held_out()[0] for s in range(5)]) > 200


def test_slices_find_nothing_in_noise_and_the_place_of_a_bump() -> None:
    healthy = 0
    for seed in range(100):
        model = _model(np.random.default_rng(seed))
        healthy += bool(mismatches(model, model.gaussian(), DecisionPolicy()))
    assert healthy <= 3  # 0.5 % allowed, SLACK beside it
    bump = 0.03 * np.exp(-0.5 * ((FREQUENCY - 0.7) / 0.05) ** 2)
    model = _model(np.random.default_rng(7), (), bump)
    top = mismatches(model, model.gaussian(), DecisionPolicy())[0]
    low, high = (float(x) for x in top.where.split(" ")[0].split(".."))
    assert low < 0.75
    assert high > 0.65


def test_unknown_process_takes_a_smooth_discrepancy_and_leaves_noise() -> None:
    quiet = _model(np.random.default_rng(11))
    assert likeliest_discrepancy(quiet, quiet.seen_gaussian(), 0, DecisionPolicy()).log_odds == 0.0
    wave = _model(np.random.default_rng(12), (), 0.03 * np.sin(6.0 * FREQUENCY))
    found = likeliest_discrepancy(wave, wave.seen_gaussian(), 0, DecisionPolicy())
    assert found.log_odds > 50.0
    assert 0.005 < found.amplitude < 0.1


def _spectral(rng: np.random.Generator, extra: Callable[[np.ndarray], np.ndarray]) -> MeasurementModel:
    """A capture a wavelength, every third held out; white noise about 0 and a departure."""
    x = np.arange(400.0, 700.0, 10.0)
    labels = tuple(Label(float(w), "Y", "", (f"narrow-{i}",), i % 3 == 1) for i, w in enumerate(x))
    n = len(x)
    block = Block(
        measurement="narrowband", axis="wavelength", unit="nm", reach=40.0, value=extra(x) + NOISE * rng.standard_normal(n),
        covariance=NOISE**2 * np.eye(n), labels=labels, reads=frozenset({"image.transmittance"}), predict=lambda _: Prediction(np.zeros(n), {}),
        scale=np.ones(n),
    )  # fmt: skip
    return MeasurementModel((block,), CAMERA)


def test_the_unknown_is_predicted_where_nothing_was_seen() -> None:
    """A smooth departure at wavelengths left out: chi2 falls to their number, as the noise of what was seen averages out."""
    model = _spectral(np.random.default_rng(31), lambda x: 0.1 * np.sin(x / 60.0))
    gap = predictive_discrepancy(model, model.seen_gaussian(), 0, DecisionPolicy())
    before, n = model.held_out()
    after, _ = model.held_out(discrepancies={0: gap.kernel})
    assert before > 100 * n
    # the process' own error adds to the noise at most as much again; chi2 of n numbers scatters by sqrt(2 n)
    assert after < 2 * (n + 3 * np.sqrt(2 * n))


def test_what_is_irregular_is_not_predicted_elsewhere() -> None:
    """Departures that neighbours don't share: the likeliest process holds them as they are, and none is better left-out captures."""
    rng = np.random.default_rng(32)
    model = _spectral(rng, lambda x: 0.1 * rng.standard_normal(len(x)))
    assert likeliest_discrepancy(model, model.seen_gaussian(), 0, DecisionPolicy()).log_odds > 20.0
    assert predictive_discrepancy(model, model.seen_gaussian(), 0, DecisionPolicy()).log_odds == 0.0


def test_repeats_of_what_is_irregular_are_predicted() -> None:
    """Each direction has its own departure, whose repeat is held out: another direction's says nothing of it, its own does."""
    rng = np.random.default_rng(33)
    ragged = [0.05 * rng.standard_normal(len(FREQUENCY)) for _ in range(2)]
    model = _model(rng)
    model = MeasurementModel((replace(model.blocks[0], value=model.value + np.concatenate([ragged[0]] * 2 + [ragged[1]] * 2)),), CAMERA)  # fmt: skip
    gap = predictive_discrepancy(model, model.seen_gaussian(), 0, DecisionPolicy())
    before, n = model.held_out()
    after, _ = model.held_out(discrepancies={0: gap.kernel})
    assert before > 20 * n
    # a number is predicted by one other of the same noise: twice the variance
    assert after < 2 * (n + 3 * np.sqrt(2 * n))


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("optical_low_pass_filter", {"displacement_x_um": 1.6, "displacement_y_um": 1.6}),
        ("defocus", {"defocus_um": 14.0}),
        ("charge_diffusion", {"length_um": 0.8}),
    ],
)
def test_the_chain_names_what_was_put_in(name: str, parameters: dict[str, float]) -> None:
    """One wavelength and one f-number: what tells these apart is the shape over frequency and direction alone."""
    model = _model(np.random.default_rng(21), (effect(name)(**parameters),))
    verdict = decide(model, np.random.default_rng(0), DecisionPolicy())
    assert [c.effect.name for c in verdict.named] == [name]
    assert not verdict.after


def test_what_nobody_lists_gets_no_name() -> None:
    """A ripple of contrast: located, and left without a name."""
    model = _model(np.random.default_rng(22), (), 0.05 * np.sin(14.0 * FREQUENCY))
    verdict = decide(model, np.random.default_rng(0), DecisionPolicy())
    assert not verdict.named
    assert verdict.after
    assert verdict.discrepancies


def test_a_name_beside_a_strong_remainder_is_a_family() -> None:
    """A filter, and a ripple that no law has: the nearest name takes 96 % of the excess, and what it leaves isn't within its tolerance."""
    model = _model(np.random.default_rng(23), (effect("optical_low_pass_filter")(displacement_x_um=1.6, displacement_y_um=1.6),), 0.03 * np.sin(14.0 * FREQUENCY))  # fmt: skip
    verdict = decide(model, np.random.default_rng(0), DecisionPolicy())
    assert not verdict.named
    assert verdict.abstained
    assert verdict.discrepancies


def test_what_is_added_beside_a_stronger_effect_has_to_earn_more() -> None:
    """Half as much again as the threshold, where both act on the same measurement; a first effect earns the threshold alone."""
    model = _model(np.random.default_rng(24))
    search = Search(model, candidates(), 18.0)
    alone = Fit((effect("defocus")(defocus_um=3.0),), ({},), 0.0, 0.0, np.zeros((len(model.value), 0)))
    both = replace(alone, effects=(*alone.effects, effect("charge_diffusion")(length_um=0.3)))
    none = replace(alone, effects=())
    assert search._added_cost(alone, none) == 0.0
    assert search._added_cost(both, alone) == pytest.approx(0.25 * 18.0)


def test_gaussians_agree_with_their_formulas() -> None:
    """Blocks by themselves, tied by free quantities: whitened, solved and weighed as the dense matrix is."""
    rng = np.random.default_rng(5)
    blocks = [a @ a.T + np.eye(len(a)) for a in (rng.standard_normal((4, 4)), rng.standard_normal((3, 3)))]
    free = rng.standard_normal((7, 2)) * (1.0, 1e3)  # one all but undetermined beforehand
    gaussian = Gaussian(rng.standard_normal(7), tuple(BlockCovariance(b) for b in blocks), free)
    dense = free @ free.T
    dense[:4, :4] += blocks[0]
    dense[4:, 4:] += blocks[1]
    np.testing.assert_allclose(gaussian.covariance, dense)
    np.testing.assert_allclose(gaussian.block_covariance(1), dense[4:, 4:])
    y = gaussian.mean + rng.standard_normal(7)
    r = y - gaussian.mean
    # the dense inverse is good to 1e-16 of the condition of 1e7
    solved = np.linalg.solve(dense, r)
    np.testing.assert_allclose(gaussian.solve(r), solved, rtol=1e-4, atol=1e-6)
    white = gaussian.whiten(np.column_stack([r, free]))
    np.testing.assert_allclose(white.T @ white, np.column_stack([r, free]).T @ gaussian.solve(np.column_stack([r, free])), rtol=1e-6, atol=1e-9)  # fmt: skip
    assert gaussian.chi2(y) == pytest.approx(r @ solved, rel=1e-4)
    assert chi2(r, dense) == pytest.approx(r @ solved, rel=1e-4)
    assert gaussian.log_likelihood(y) == pytest.approx(-0.5 * r @ solved - 0.5 * np.linalg.slogdet(dense)[1], rel=1e-4)
    more = gaussian.with_discrepancy(0, np.eye(4))
    np.testing.assert_allclose(more.covariance - dense, np.diag([1.0] * 4 + [0.0] * 3), atol=1e-4)


# --- recordings ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def edges() -> RecordingSet:
    return recordings_of(
        ConcealedCamera(7, cfa="RGGB", f_number=2.0, rows=280, cols=280), Plan(("dark", "slanted_edge"))
    )


def test_a_subset_is_judged_by_what_it_has(edges: RecordingSet) -> None:
    result = diagnose(edges)
    assert result.verdict == "no_mismatch"
    assert {s.step for s in result.skipped} >= {
        "diagnose narrowband",
        "diagnose chart",
        "diagnose photon_transfer",
        "diagnose screen",
    }
    assert result.held_out is not None
    assert set(result.held_out.captures) <= {c.id for c in edges.manifest.captures}


def test_nothing_to_judge_is_said(edges: RecordingSet) -> None:
    camera: dict[str, Any] = edges.camera("left").model_dump()
    camera["f_number"] = None
    keep = [c for c in edges.manifest.captures if c.kind == "slanted_edge"]
    bare = RecordingSet(
        Manifest.model_validate({"cameras": {"left": camera}, "captures": [c.model_dump() for c in keep]}),
        {c.frame: np.array(edges.frame(c)) for c in keep},
        {
            str(p): edges.spectrum(str(p))
            for p in [*dict.fromkeys(c.light_radiance for c in keep), *camera["quantum_efficiency"].values()]
        },
    )
    result = diagnose(bare)
    assert result.verdict == "no_mismatch"
    assert result.held_out is None
    assert any("f-number" in s.reason for s in result.skipped)
