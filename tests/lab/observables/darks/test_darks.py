"""Measurements of dark frames: their statistics against drawn numbers, no finding on healthy cameras, names of
concealed effects."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan, laws
from evaluation.observables import scatter
from lab.diagnose.inference.decide import Verdict, decide
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.side_model import measurement_model
from lab.diagnose.policy import DecisionPolicy
from lab.errors import NotDetermined
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import Manifest, RecordingSet
from lab.observables.darks import defective_pixels
from lab.observables.darks import noise as dark_noise
from lab.observables.darks.frames import TAIL_EDGES, DarkCondition, dark_frames, spread_dn2
from lab.observables.darks.level import measure_dark
from lab.observables.darks.readout import measure_dark_correlation, measure_fixed_lines
from lab.observables.dataset import Dataset
from lab.observables.gaussian import chi2
from lab.observables.observable import Observable, measurements
from sim.camera import CameraModel, Lens
from sim.effects.base import Effect
from sim.effects.library import effect
from sim.effects.row_noise import RowNoise
from sim.frame import Exposure, sample
from sim.scene.scenes import Darkness
from sim.sensor.defects import Defects, defect_sizes, node_std, size_nodes
from sim.sensor.electrons import FixedPattern
from sim.spectrum import FloatArray, Spectrum
from sim.stages import signal_of
from tests.lab.inference.on_blocks import judged

ROWS, COLS = 96, 128
DRAWN = 24  # cameras
OF_DARK_FRAMES = [one for one in measurements() if one.order < 200]


def _sim_darks(
    seed: int, acting: Sequence[Effect] = (), *, bits: int = 12, cfa: Any = "MONO", plan: Sequence[tuple[float,
    float]] = (), read_e: float = 3.0, dark: float = 8.0, shape: tuple[int, int] = (ROWS, COLS)
) -> RecordingSet:  # fmt: skip
    """Dark frames of `sim`'s own camera, (exposure, temperature) each."""
    rng = np.random.default_rng([seed, 1])
    white = 2.0**bits - 1
    channels = ("Y",) if cfa == "MONO" else ("R", "G", "B")
    black, gain = 0.03 * white, 0.97 * white / 10000.0
    camera = CameraModel(
        rows=shape[0], cols=shape[1], pixel_pitch_um=3.0, fill_factor=0.8, cfa=cfa, bit_depth=bits,
        black_level_dn=black,
        white_level_dn=white,
        conversion_gain_dn_per_e=gain, full_well_e=10000.0, read_noise_e=read_e, dark_current_e_per_s=dark, dsnu_e=1.0,
        prnu_percent=0.7,
        quantum_efficiency={c: Spectrum.of([400.0, 700.0], [0.5, 0.5]) for c in channels}, lens=Lens(f_number=4.0,
        focal_length_mm=8.0),
    )  # fmt: skip
    pattern = FixedPattern.draw(camera, rng)
    plan = plan or [(t, 25.0) for t in (0.001, 0.5, 2.0) for _ in range(4)]
    frames = {
        f"frames/{k}.npy": sample(camera, Exposure(Darkness(), t, temperature_c=c), rng, tuple(acting), pattern)
        for k, (t, c) in enumerate(plan)
    }
    captures = [
        {"id": f"d{k}", "kind": "dark", "side": "left", "frame": f"frames/{k}.npy", "exposure_s": t, "temperature_c": c}
        for k, (t, c) in enumerate(plan)
    ]
    stated = {
        "rows": shape[0], "cols": shape[1], "pixel_pitch_um": 3.0, "fill_factor": 0.8, "cfa": cfa, "bit_depth": bits,
        "black_level_dn": black,
        "white_level_dn": white, "conversion_gain_dn_per_e": gain, "f_number": 4.0, "focal_length_mm": 8.0,
    }  # fmt: skip
    return RecordingSet(Manifest.model_validate({"cameras": {"left": stated}, "captures": captures}), frames, {}, {})


def _concealed(seed: int, *built_in: Law, warm: bool = False) -> RecordingSet:
    return recordings_of(ConcealedCamera(seed, built_in, rows=ROWS, cols=COLS), Plan(("dark",), warm=warm, repeats=4))


def _blocks(recordings: RecordingSet) -> tuple[Dataset, list[Observable], dict[str, str]]:
    dataset = Dataset(recordings, "left", camera_model(recordings, "left"))
    found, refused = [], {}
    for measurement in OF_DARK_FRAMES:
        try:
            found.append(measurement.make(dataset))
        except NotDetermined as reason:
            refused[reason.step] = reason.reason
    return dataset, found, refused


def _verdict(recordings: RecordingSet) -> Verdict:
    dataset, blocks, _ = _blocks(recordings)
    return decide(MeasurementModel(tuple(blocks), dataset.camera), np.random.default_rng(0), DecisionPolicy())


def _names(verdict: Verdict) -> list[str]:
    return [c.effect.name for c in verdict.named]


@pytest.mark.parametrize(("noise_e", "offset_e"), [(3.0, 0.0), (0.0, 3.0)])
def test_odd_and_even_rows_share_what_is_fixed(noise_e: float, offset_e: float) -> None:
    """Odd less even rows of seen and of held-out dark frames: noise of rows is another in both, offsets are the same.
    chi2 of both numbers, of variance 4 in a draw: its mean over N draws within 4 sqrt(4 / N) of 2."""
    found = []
    for seed in range(DRAWN):
        noisy = RowNoise(noise_e=noise_e, offset_e=offset_e, pattern_seed=seed)
        recordings = _sim_darks(seed, [noisy], plan=[(0.001, 25.0)] * 12)
        block = measure_fixed_lines("rows", Dataset(recordings, "left", camera_model(recordings, "left")))
        at = [k for k, label in enumerate(block.labels) if label.condition == "odd and even"]
        assert [block.labels[k].held_out for k in at] == [False, True]
        found.append(chi2((block.value - block.predict([noisy]).mean)[at], block.covariance[np.ix_(at, at)]))
    assert abs(np.mean(found) - 2.0) < 4.0 * np.sqrt(4.0 / DRAWN)


@pytest.mark.parametrize(
    ("shape", "is_measured"), [((48, 48), False), ((49, 49), False), ((50, 50), True), ((32, 64), True)]
)
def test_the_size_that_correlation_needs_is_the_one_that_is_named(shape: tuple[int, int], is_measured: bool) -> None:
    rng = np.random.default_rng(3)
    frames = {f"d{k}": np.rint(100.0 + 4.0 * rng.standard_normal(shape)).astype(np.uint16) for k in range(6)}
    captures = [{"id": name, "kind": "dark", "side": "left", "frame": name, "exposure_s": 0.01} for name in frames]
    sheet = {"rows": shape[0], "cols": shape[1], "cfa": "MONO", "bit_depth": 12}
    manifest = Manifest.model_validate({"cameras": {"left": sheet}, "captures": captures})
    recordings = RecordingSet(manifest, frames, {}, {})
    dataset = Dataset(recordings, "left", camera_model(recordings, "left"))
    if is_measured:
        assert measure_dark_correlation(dataset).labels
        return
    with pytest.raises(NotDetermined, match="measured from 50 px along rows or columns on"):
        measure_dark_correlation(dataset)


# --- statistics against drawn numbers ---------------------------------------------------------------------------------


def test_shares_of_defective_pixels_are_those_of_drawn_pixels() -> None:
    """Two kinds of defective pixels in 400 000; each bin's count within 4.5 sigma of a binomial, all of the same
    draw."""
    rng = np.random.default_rng(1)
    n, frames, moving, fixed = 400_000, 4, 2.0, 1.0
    kind = rng.choice(3, n, p=[0.98, 0.01, 0.01])
    more, jump = np.array([0.0, 30.0, 0.0])[kind], np.array([0.0, 0.0, 40.0])[kind]
    noise = np.sqrt(moving**2 + 0.5 * more)
    drawn = (
        more + fixed * rng.standard_normal(n) + noise * rng.standard_normal((frames, n))
        + jump * ((rng.random((frames, n)) < 0.25) - 0.25)
    )  # fmt: skip
    median = np.sort(drawn, axis=0)[(frames - 1) // 2] - defective_pixels._order_moments(frames)[0] * moving
    spread = 1.6
    classes = [defective_pixels._DefectClass(0.01, 30.0, 0.0), defective_pixels._DefectClass(0.01, 0.0, 40.0, 0.25)]
    shares = defective_pixels._tail_shares(classes, moving, fixed, frames, spread, 0.5, 0.0)
    edges = np.array([-np.inf, -6.0, -4.5, *TAIL_EDGES, np.inf]) * spread
    counts = np.histogram(median, edges)[0]
    expected = n * np.concatenate([shares[: len(TAIL_EDGES)], shares[len(TAIL_EDGES) :]])
    got = np.concatenate([counts[3:], counts[1::-1]])
    np.testing.assert_array_less(np.abs(got - expected), 4.5 * np.sqrt(expected) + 4.0)


@pytest.mark.parametrize("high_share", [0.5, 0.2])
def test_shares_of_flickering_pixels_are_those_of_drawn_pixels(high_share: float) -> None:
    """Contrasts of frames that are high or low at random: the cube root is good to a few per cent of a share."""
    rng = np.random.default_rng(2)
    n, frames, amplitude = 200_000, 5, 6.0
    values = rng.standard_normal((frames, n)) + amplitude * (rng.random((frames, n)) < high_share)
    total = np.square(values - values.mean(0)).sum(0)
    condition = DarkCondition(1.0, None, tuple([None] * frames), ())  # type: ignore[arg-type]
    edges = defective_pixels._flicker_edges(frames - 1)[:3]
    draws = defective_pixels._JumpDraws.of([SimpleNamespace(condition=condition)])  # type: ignore[list-item]
    away, weight = amplitude**2 * draws.sums[0, False], draws.weights(high_share)
    shares = weight @ defective_pixels._chance_above(np.full(len(away), frames - 1.0), np.maximum(away, 1e-9), edges)
    drawn = (total[:, None] > edges).mean(axis=0)
    # draws of states, worth 1 / sum of their squared weights: a share p is known to sqrt(p (1 - p) / that)
    worth = 1.0 / float(weight @ weight)
    assert worth > 60.0
    assert np.all(np.abs(shares - drawn) < 4.0 * np.sqrt(drawn * (1 - drawn) / worth) + 0.01)


def test_clipped_square_is_its_integral() -> None:
    x = np.linspace(-12.0, 12.0, 200_001)
    density = stats.norm.pdf(x, 1.0, 1.5)
    wanted = np.sum(np.clip(x, -2.0, 2.0) ** 2 * density) * (x[1] - x[0])
    assert dark_noise._cut_square(np.array([1.0]), np.array([2.25]), 2.0)[0] == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("spread", [0.0, 0.3, 1.0, 2.0])
def test_nodes_have_the_distribution_that_is_drawn(spread: float) -> None:
    """Mean 1; the standard deviation of 48 parts' means falls short by 1 %; drawn sizes agree with both at 4.5
    sigma."""
    weights, sizes = size_nodes(spread)
    assert weights.sum() == pytest.approx(1.0)
    assert weights @ sizes == pytest.approx(1.0, rel=1e-6)
    assert np.sqrt(weights @ np.square(sizes - 1.0)) == pytest.approx(spread, rel=0.05, abs=1e-9)
    # with the scatter within the parts, the variance is the whole
    inner = weights @ np.square(node_std(spread))
    assert np.sqrt(weights @ np.square(sizes - 1.0) + inner) == pytest.approx(spread, rel=1e-6, abs=1e-9)
    drawn = defect_sizes((300, 300), 0.2, 3, spread)
    drawn = drawn[drawn > 0]
    assert drawn.mean() == pytest.approx(1.0, abs=4.5 * spread / np.sqrt(drawn.size) + 1e-9)


def test_counts_of_hot_pixels_are_smooth_in_their_size() -> None:
    """Bins narrower than the distance of the nodes, in noise narrower still: the counts of an exponential distribution
    are its own, exp(-low / mean) - exp(-high / mean), within 3 %: a part of 1 / 24 of all at most, taken as normal in
    the place of uniform, is wrong by 6 % of it beyond a place, at either edge of a bin. And a mean larger by 1e-4
    changes none by more than 1e-4 times the largest slope of that, |x| exp(-x) <= 1 / e, times two."""
    hot = Defects(0.01, 400.0, 1.0, 0)

    def counts(factor: float) -> FloatArray:
        classes = [
            defective_pixels._DefectClass(float(s), factor * float(x), 0.0, spread_dn=factor * float(w))
            for s, x, w in zip(*hot.nodes(), hot.node_std(), strict=True)
        ]
        return defective_pixels._tail_shares(classes, 1.0, 0.0, 1, 10.0, 0.0, 0.0)[: len(TAIL_EDGES)]

    edges = np.array([*TAIL_EDGES, np.inf]) * 10.0
    found, wanted = counts(1.0), 0.01 * -np.diff(np.exp(-edges / 400.0))
    use = np.flatnonzero((edges[:-1] >= 60.0) & (wanted > 1e-4))
    assert use.size > 3
    np.testing.assert_allclose(found[use], wanted[use], rtol=0.03)
    assert np.abs(counts(1.0001) - found).max() < 2.0 * 1e-4 * 0.01 / np.e


def test_correlated_rows_have_their_spectrum() -> None:
    """Mean over all frequencies: the variance. Drawn rows: neighbours have the stated correlation, to 4.5 /
    sqrt(rows)."""
    (one,) = signal_of(_model(), (RowNoise(noise_e=2.0, correlation=0.6),)).lines
    f = np.linspace(-0.5, 0.5, 4001)[:-1]
    assert np.mean(one.spectrum_e2(f, fixed=False)) == pytest.approx(4.0, rel=1e-3)
    drawn = one.draw((4000, 5), np.random.default_rng(3))
    r = np.asarray(drawn)[:, 0]
    assert r.std() == pytest.approx(2.0, rel=0.1)
    assert np.corrcoef(r[1:], r[:-1])[0, 1] == pytest.approx(0.6, abs=4.5 / np.sqrt(4000))


def _model() -> CameraModel:
    recordings = _sim_darks(1, plan=[(0.1, 25.0)])
    return camera_model(recordings, "left")


# --- healthy cameras --------------------------------------------------------------------------------------------------


def test_healthy_darks_agree_with_their_covariance() -> None:
    """12 cameras of two generators, 10 to 16 bits: of some 130 blocks none has a chi2 that chance gives one in 30 000
    of."""
    rare = 1.0
    sets = [_concealed(40 + k, warm=k % 2 == 0) for k in range(4)]
    sets += [
        _sim_darks(60 + k, bits=(10, 12, 14, 16)[k % 4], cfa=("MONO", "RGGB")[k % 2], read_e=2.0 + 0.3 * k)
        for k in range(8)
    ]
    for recordings in sets:
        dataset, blocks, _ = _blocks(recordings)
        for block in blocks:
            model = MeasurementModel((block,), dataset.camera)
            gaussian, seen = model.seen_gaussian(), model.seen
            if not seen.any():
                continue
            value = chi2(model.seen_value - gaussian.mean, gaussian.covariance)
            rare = min(rare, float(stats.chi2.sf(value, int(seen.sum()))))
    assert rare > 1.0 / 30_000.0


@pytest.mark.parametrize(("bits", "read_e"), [(10, 1.5), (12, 3.0)], ids=["hardly dithered", "dithered"])
def test_covariances_of_darks_are_neither_too_wide_nor_too_narrow(bits: int, read_e: float) -> None:
    """Over six cameras of 240 x 320 px each measurement's chi2 is its number of directions within 3.5 sqrt(2 n), as
    there are six of them. Noise of 0.15 DN is too coarse for all but the means."""
    found: dict[str, list[tuple[float, int]]] = {}
    for k in range(6):
        dataset, blocks, _ = _blocks(_sim_darks(300 + k, bits=bits, read_e=read_e, shape=(240, 320)))
        for one in scatter(MeasurementModel(tuple(blocks), dataset.camera)):
            found.setdefault(one.observable, []).append((one.chi2, one.n))
    names = {"dark", "dark_noise", "dark_field", "dark_row_noise", "dark_row_pattern", "dark_correlation"}
    for name in names if bits == 12 else {"dark", "dark_field"}:
        total, number = np.sum(found[name], axis=0)
        assert abs(total - number) < 3.5 * np.sqrt(2.0 * number), (name, total, number)


@pytest.mark.parametrize("seed", [81, 82])
def test_healthy_darks_get_no_name(seed: int) -> None:
    verdict = _verdict(_concealed(seed, warm=True))
    assert not verdict.named
    assert not verdict.after


# --- what was put in --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("law", "names"),
    [
        (laws.HotPixelsLaw(300.0, 1, 3), "hot_pixels"),
        (laws.DarkCurrentTemperatureLaw(1.0, 1, 3), "dark_current_temperature"),
        (laws.BlackLevelDriftLaw(0.5, 1, 3), "black_level_drift"),
        # the same four effects are named every day in frames that sim renders
        pytest.param(laws.RandomTelegraphNoiseLaw(40.0, 0, 3), "random_telegraph_noise", marks=pytest.mark.slow),
        pytest.param(laws.AmplifierGlowLaw(6.0, 1, 3), "amplifier_glow", marks=pytest.mark.slow),
        pytest.param(laws.RowNoiseLaw(1.5, 1, 3), "row_noise", marks=pytest.mark.slow),
        pytest.param(laws.ColumnNoiseLaw(1.5, 1, 3), "column_noise", marks=pytest.mark.slow),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_a_concealed_law_is_named(law: Law, names: str) -> None:
    verdict = _verdict(_concealed(91, law, warm=names == "dark_current_temperature"))
    assert _names(verdict)[:1] == [names]


def test_one_hot_pixel_of_a_small_frame_is_named() -> None:
    """One of 768 pixels collects 150 e/s more, some 60 DN in 2 s where others lie within 3 DN: no tail and no particle
    does that in every frame. Its healthy twin shows nothing."""
    hot, healthy = (
        _verdict(recordings_of(ConcealedCamera(5000, built_in, rows=24, cols=32), Plan(("dark",))))
        for built_in in ([laws.HotPixelsLaw(150.0, 0, 11)], [])
    )
    assert _names(hot) == ["hot_pixels"]
    found, std = hot.named[0].effect.model_dump(), hot.named[0].std
    assert abs(found["share_ppm"] - 1e6 / 768.0) < 4.0 * (std["share_ppm"] or 0.0)
    # one pixel's excess isn't normal: told by its interval of two standard deviations, here four on the logarithmic
    # scale
    assert std["excess_e_per_s"] is None
    low, high = (end**2 / found["excess_e_per_s"] for end in hot.named[0].intervals["excess_e_per_s"])
    assert 0.0 < low < 150.0 < high
    assert _names(healthy) == []


@pytest.mark.parametrize(
    "one",
    [
        effect("hot_pixels")(excess_e_per_s=400.0, share_ppm=1000.0),
        effect("random_telegraph_noise")(amplitude_e=40.0, share_percent=0.5),
        effect("amplifier_glow")(glow_e_per_s=10.0, reach_mm=0.06, corner="bottom_left"),
        effect("row_noise")(noise_e=1.5),
        effect("column_noise")(offset_e=1.5),
    ],
    ids=lambda e: e.name,
)
def test_what_sim_renders_is_named_with_its_parameters(one: Effect) -> None:
    """Parameters within 4 standard uncertainties; the corner of a glow, which isn't fitted, is the right one."""
    verdict = _verdict(_sim_darks(95, (one,)))
    assert _names(verdict)[:1] == [one.name]
    named = verdict.named[0]
    for name in type(one).quantities():
        std = named.std[name]
        assert std is not None
        if name == "offset_e" and one.name == "row_noise":
            continue  # a fixed part of the rows in a few frames' mean is bounded, not measured
        assert abs(getattr(named.effect, name) - getattr(one, name)) < 4.0 * std + 1e-9
    if one.name == "amplifier_glow":
        assert named.effect.corner == "bottom_left"  # type: ignore[attr-defined]


def test_banding_of_a_fixed_period_is_located_and_gets_no_name() -> None:
    """It resembles row noise, and no effect has its law."""
    verdict = _verdict(_concealed(92, laws.PeriodicBandingLaw(1.5, 0, 3)))
    assert not verdict.named
    assert "dark_row_noise" in {part.block.measurement.name for part in verdict.after}


def test_banding_of_a_fixed_period_is_unlisted_noise_by_line_by_the_evidence() -> None:
    """Line noise of another spectrum would have to be wrong by two thirds of its own change."""
    dataset, blocks, _ = _blocks(_concealed(92, laws.PeriodicBandingLaw(1.5, 0, 3)))
    found = judged(MeasurementModel(tuple(blocks), dataset.camera), dataset)
    assert not found.names
    assert set(found.unlisted) == {"noise by line and pixel"}


def test_an_offset_of_half_of_the_frame_is_a_tap() -> None:
    (named,) = _verdict(_concealed(92, laws.TapOffsetLaw(1.5, 0, 3))).named
    assert named.effect.name == "taps"


# --- what the recordings don't allow, and faults ----------------------------------------------------------------------


def test_one_dark_frame_is_judged_by_what_it_has() -> None:
    _, blocks, refused = _blocks(_sim_darks(7, plan=[(0.5, 25.0)]))
    assert {"dark", "dark_field", "defective_pixels"} <= {b.measurement.name for b in blocks}
    assert "no two dark frames" in refused["dark_noise"]


def test_codes_that_are_too_coarse_say_so() -> None:
    """8 bit: a gain of 0.025 DN/e leaves 0.3 DN of noise with what rounding adds."""
    _, blocks, refused = _blocks(_sim_darks(8, bits=8))
    assert "codes are too coarse" in refused["flickering_pixels"]
    assert "dark" in {b.measurement.name for b in blocks}


def test_a_black_level_off_the_stated_one_is_no_drift() -> None:
    recordings = _concealed(93)
    manifest = recordings.manifest.model_dump(mode="json")
    manifest["cameras"]["left"]["black_level_dn"] *= 1.5
    wrong = RecordingSet(
        Manifest.model_validate(manifest),
        {c.frame: recordings.frame(c) for c in recordings.manifest.captures},
        {p: recordings.spectrum(p) for p in manifest["cameras"]["left"]["quantum_efficiency"].values()},
    )
    verdict = _verdict(wrong)
    assert not verdict.named
    assert {part.block.measurement.name for part in verdict.after} == {"black_level"}


def test_a_frame_that_was_not_taken_anew_is_left_out_and_told() -> None:
    recordings = _sim_darks(9)
    captures = list(recordings.manifest.captures)
    frames = {c.frame: np.array(recordings.frame(c)) for c in captures}
    frames[captures[5].frame] = frames[captures[4].frame].copy()
    stale = RecordingSet(recordings.manifest, frames, {}, {})
    dataset = Dataset(stale, "left", camera_model(stale, "left"))
    assert dataset.copies.ids == {"d5"}
    assert "d5" not in {c.id for c in dataset.recordings.captures("dark")}
    _, skipped = measurement_model(stale, "left")
    lines = [s.reason for s in skipped if "bit for bit" in s.reason]
    assert len(lines) == 1
    assert "d4" in lines[0]
    assert "\n" not in lines[0]


def test_repeats_that_are_all_copies_are_told_in_one_line() -> None:
    """Every repeat is the first frame: temporal noise is unknown, and the levels are judged all the same."""
    recordings = _sim_darks(10)
    captures = list(recordings.manifest.captures)
    first = {c.exposure_s: np.array(recordings.frame(c)) for c in reversed(captures)}
    still = RecordingSet(recordings.manifest, {c.frame: first[c.exposure_s] for c in captures}, {}, {})
    copies = Dataset(still, "left", camera_model(still, "left")).copies
    assert copies.ids == {c.id for c in captures if not np.shares_memory(still.frame(c), still.frame(captures[0]))} - {
        next(c.id for c in captures if c.exposure_s == exposure_s) for exposure_s in first
    }
    model, skipped = measurement_model(still, "left")
    assert model is not None
    assert "dark" in {b.measurement.name for b in model.blocks}
    (line,) = [s.reason for s in skipped if "bit for bit" in s.reason]
    assert f"{len(copies.ids)} captures" in line
    assert "temporal noise is unknown" in line


@pytest.mark.parametrize("seed", [9, 10])
def test_a_hot_pixel_does_not_move_the_mean_of_a_small_frame(seed: int) -> None:
    """Two or three of 3072 pixels, 20000 e/s: 200 e of shot noise at 2 s, 0.1 e of the frames' mean, which pixels'
    noise knows to 0.07 e. chi2 of n numbers, 4 sigma."""
    law = laws.HotPixelsLaw(20000.0, 0, 5)
    camera = ConcealedCamera(seed, (law,), cfa="MONO", rows=48, cols=64, bit_depth=16)
    recordings = recordings_of(camera, Plan(("dark",), repeats=6))
    block = measure_dark(Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True)))
    prediction = block.predict(())
    free = np.array(list(prediction.jacobian.values()))
    n = len(block.value)
    assert chi2(block.value - prediction.mean, block.covariance + free.T @ free) < n + 4.0 * np.sqrt(2.0 * n)


def test_dark_frames_at_code_0_have_no_level() -> None:
    """The black level is clipped: the mean that is left doesn't follow the signal."""
    recordings = _sim_darks(11)
    shift = int(np.mean(recordings.frame(recordings.manifest.captures[0]))) + 5
    frames = {
        c.frame: np.maximum(np.asarray(recordings.frame(c), int) - shift, 0).astype(np.uint16)
        for c in recordings.manifest.captures
        if c.exposure_s < 1.0
    }
    content = recordings.manifest.model_dump(mode="json")
    content["captures"] = [c for c in content["captures"] if c["frame"] in frames]
    _, _, refused = _blocks(RecordingSet(Manifest.model_validate(content), frames, {}, {}))
    assert "most pixels are at code 0" in refused["dark"]


@pytest.mark.parametrize(("offset", "noise_dn"), [(0.75, 0.05), (0.5, 0.1), (0.1, 0.02)])
def test_pixels_at_two_codes_do_not_tell_their_noise(offset: float, noise_dn: float) -> None:
    """The variance of two codes is p (1 - p) whatever the noise: the mean is off by rounding as by a code's width."""
    recordings, rng = _sim_darks(12), np.random.default_rng(12)
    frames = {
        c.frame: np.floor(100.0 + offset + noise_dn * rng.standard_normal((ROWS, COLS)) + 0.5).astype(np.uint16)
        for c in recordings.manifest.captures
    }
    coarse = RecordingSet(recordings.manifest, frames, {}, {})
    found = Dataset(coarse, "left", camera_model(coarse, "left"))
    np.testing.assert_array_equal(spread_dn2(found.once(dark_frames), 1.0), 0.0)
