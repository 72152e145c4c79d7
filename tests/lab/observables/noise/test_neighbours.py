"""Noise correlated between neighbouring pixels: white noise, analytic kernels, and frames of both image formers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator.laws import (
    AnisotropicBrighterFatterLaw,
    BrighterFatterLaw,
    ColouredReadNoiseLaw,
    InterPixelCapacitanceLaw,
    OnChipSharpeningLaw,
    OnChipSmoothingLaw,
)
from lab.diagnose.inference.decide import Verdict, decide
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.refit import refit
from lab.diagnose.policy import DecisionPolicy
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import Manifest, RecordingSet
from lab.observables.dataset import Dataset, held_out_flats
from lab.observables.edges.slanted_edge import measure_slanted_edge
from lab.observables.flats.linearity import measure_photon_transfer
from lab.observables.flats.noise import measure_noise
from lab.observables.noise.neighbours import correlations, measure_noise_neighbours, measure_noise_tones
from lab.observables.noise.temporal import PAIRS, independent_correlations, repeats_of
from lab.observables.observable import Observable
from sim.camera import CameraModel, Cfa, Lens
from sim.effects.base import Effect
from sim.effects.brighter_fatter import BrighterFatter
from sim.effects.library import effect
from sim.frame import Exposure, dark_electrons, expected_electrons, read_out
from sim.scene.scenes import Darkness, UniformField
from sim.sensor.electrons import FixedPattern, sample_from
from sim.spectrum import Spectrum
from tests.lab.diagnose.on_blocks import dataset, former, measured_model, rendered, sigmas
from tests.lab.inference.on_blocks import judged as search_blocks

SETS = 400  # of frames

LIGHT = Spectrum.of([400.0, 700.0], [2e-3, 2e-3])


def _dataset(recordings: RecordingSet) -> Dataset:
    return Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))


def _concealed(seed: int, laws: Sequence[Law] = (), cfa: str | None = None, repeats: int = 3) -> Dataset:
    camera = ConcealedCamera(seed, laws, cfa=cfa, rows=96, cols=128)
    return _dataset(recordings_of(camera, Plan(("dark", "flat"), repeats=repeats)))


def _rendered(acting: Sequence[Effect], seed: int = 5, cfa: str = "MONO", tone_dn: float = 0.0) -> Dataset:
    """Darks and flats of `sim`, with PRNU and a lamp that flickers by 0.3 %. `tone_dn`: of half the pixels' clock,
    whose sign changes from frame to frame, dithered."""
    channels = ("Y",) if cfa == "MONO" else ("R", "G", "B")
    camera = CameraModel(
        rows=96, cols=128, pixel_pitch_um=3.45, fill_factor=1.0, cfa=cfa, bit_depth=12, black_level_dn=100.0,
        white_level_dn=4095.0,
        conversion_gain_dn_per_e=0.4, full_well_e=1e4, read_noise_e=3.0, dark_current_e_per_s=5.0, dsnu_e=1.0,
        prnu_percent=0.8,
        quantum_efficiency={c: Spectrum.of([400.0, 700.0], [0.5, 0.5]) for c in channels}, lens=Lens(f_number=4.0,
        focal_length_mm=8.0),
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    pattern = FixedPattern.draw(camera, rng)
    frames, captures = {}, []
    one = float(np.mean(expected_electrons(camera, Exposure(UniformField(LIGHT), 0.01)))) / 0.01
    for kind, times in (
        ("dark", (0.001, 0.5)),
        ("flat", tuple(x * 1e4 / one for x in (0.08, 0.25, 0.4, 0.55, 0.7, 0.85))),
    ):
        for t in times:
            exposure = Exposure(Darkness() if kind == "dark" else UniformField(LIGHT), t)
            mean = expected_electrons(camera, exposure, acting)
            dark = dark_electrons(camera, exposure, acting)
            for _ in range(4):
                path = f"{len(captures)}.npy"
                lit = dark + (mean - dark) * (1.0 + 3e-3 * rng.standard_normal())
                frames[path] = sample_from(
                    lit, camera, rng, pattern, dark_electrons=dark, read_out=read_out(camera, exposure, acting)
                )
                if tone_dn:
                    tone = tone_dn * (-1.0) ** (np.indices((96, 128)).sum(axis=0) + len(captures))
                    moved = frames[path] + np.floor(tone + rng.random(tone.shape))
                    frames[path] = moved.clip(0, 4095).astype(np.uint16)
                captures.append({"id": f"c{len(captures)}", "kind": kind, "side": "left", "frame": path,
                "exposure_s": t}
                                | ({"radiance": "lamp.csv"} if kind == "flat" else {}))  # fmt: skip
    stated = {"rows": 96, "cols": 128, "pixel_pitch_um": 3.45, "cfa": cfa, "bit_depth": 12, "f_number": 4.0,
    "focal_length_mm": 8.0,
              "quantum_efficiency": dict.fromkeys(channels, "qe.csv")}  # fmt: skip
    manifest = Manifest.model_validate({"cameras": {"left": stated}, "captures": captures})
    return _dataset(
        RecordingSet(manifest, frames, {"lamp.csv": LIGHT, "qe.csv": Spectrum.of([400.0, 700.0], [0.5, 0.5])})
    )


def _blocks(dataset: Dataset) -> tuple[Observable, ...]:
    return measure_photon_transfer(dataset), measure_noise(dataset), measure_noise_neighbours(dataset)


def _verdict(dataset: Dataset) -> Verdict:
    return decide(MeasurementModel(_blocks(dataset), dataset.camera), np.random.default_rng(0), DecisionPolicy())


@pytest.mark.parametrize("cfa", ["MONO", "GBRG"])
def test_independent_pixels_have_the_correlations_of_a_vanishing_exchange(cfa: Cfa) -> None:
    """A filter of one tap, and shares of neighbours below the rounding of doubles, are none."""
    planes = ["all"] if cfa == "MONO" else ["R", "G1", "G2", "B"]
    shot, share = np.linspace(50.0, 400.0, len(planes)), np.zeros((5, len(planes)))
    read = np.array([-0.03, 1.0, -0.03])
    closed = correlations(cfa, planes, shot, share, 9.0, 0.1, None, read)
    summed = correlations(cfa, planes, shot, share + 1e-300, 9.0, 0.1, np.ones((1, 1)), read)
    np.testing.assert_allclose(closed, summed, atol=1e-14)
    assert closed[list(PAIRS).index("next in the row")] < 0.0


def test_correlations_of_a_filter_are_its_autocorrelation() -> None:
    """White noise through a kernel: correlations computed by hand for every pair; on a mosaic, pixels of a colour are
    two apart."""
    kernel = np.array([[0.0, 0.05, 0.0], [0.05, 0.8, 0.05], [0.0, 0.05, 0.0]])
    size = np.sum(kernel**2)
    own = {"1,0": 2 * 0.8 * 0.05 / size, "1,1": 2 * 0.05**2 / size, "2,0": 0.05**2 / size}
    mono = correlations("MONO", ["Y"], np.array([100.0]), np.zeros((5, 1)), 4.0, 0.0, kernel)
    np.testing.assert_allclose(mono[:5], [own["1,0"], own["1,0"], own["1,1"], own["2,0"], own["2,0"]], atol=1e-12)
    bayer = correlations("RGGB", ["R", "G1", "G2", "B"], np.full(4, 100.0), np.zeros((5, 4)), 4.0, 0.0, kernel)
    np.testing.assert_allclose(bayer, [0.0, 0.0, 0.0, own["1,0"], own["1,0"], own["1,1"]], atol=1e-12)
    # rounding is each pixel's own: half of the variance halves all
    rounded = correlations("MONO", ["Y"], np.array([100.0]), np.zeros((5, 1)), 4.0, 104.0 * size, kernel)
    np.testing.assert_allclose(rounded, 0.5 * mono, atol=1e-12)


@pytest.mark.parametrize("cfa", ["MONO", "RGGB"])
def test_noise_of_healthy_cameras_is_what_the_covariances_say(cfa: str) -> None:
    """chi2 of both formers' cameras over their numbers: 3 sigma of 2 / n is 0.4 for 100 numbers; never above by
    more."""
    for looked_at in (_concealed(770011, cfa=cfa), _concealed(770012, cfa=cfa, repeats=6), _rendered((), cfa=cfa)):
        for block in (measure_noise(looked_at), measure_noise_neighbours(looked_at)):
            residual = block.value - block.predict(()).mean
            jacobian = np.array(list(block.predict(()).jacobian.values())).reshape(-1, len(residual))
            covariance = block.covariance + jacobian.T @ jacobian
            chi2 = float(residual @ np.linalg.solve(covariance, residual)) / len(residual)
            assert chi2 < 1.0 + 3.0 * np.sqrt(2.0 / len(residual))


def test_a_lamp_that_flickers_and_rows_with_noise_leave_no_correlation() -> None:
    """Row noise of 3 e, as large as the pixels': row means are subtracted, and what that subtracts is corrected for.
    144 numbers."""
    blocks = [measure_noise_neighbours(_rendered((effect("row_noise")(noise_e=3.0),), seed)) for seed in (20, 21, 22)]
    pulls = np.concatenate([b.value / np.sqrt(np.diag(b.covariance)) for b in blocks])
    assert np.mean(np.square(pulls)) < 1.0 + 3.0 * np.sqrt(2.0 / len(pulls))
    assert abs(np.mean(pulls)) < 3.0 / np.sqrt(len(pulls))


def test_tones_of_the_read_out_are_told_and_leave_no_correlation() -> None:
    """0.6 DN of alternating sign have the variance 0.48 DN^2 in four repeats. Beside it stand 1.44 of read noise, 0.32
    of rounding and dither, and 0.40 of the dark current's shot noise in one of two settings: shares of 0.21 and 0.18,
    known to 2 %. A healthy camera has none. 48 correlations."""
    assert not measure_noise_tones(_rendered(())).value.any()
    dataset = _rendered((), tone_dn=0.6)
    told, block = measure_noise_tones(dataset), measure_noise_neighbours(dataset)
    assert told.value == pytest.approx([0.198], rel=0.06)
    pulls = block.value / np.sqrt(np.diag(block.covariance))
    assert np.mean(np.square(pulls)) < 1.0 + 3.0 * np.sqrt(2.0 / len(pulls))


@pytest.mark.parametrize("cfa", ["MONO", pytest.param("GRBG", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "one",
    [
        effect("brighter_fatter")(loss_percent=12.0, shared_percent=10.0),
        effect("brighter_fatter")(loss_percent=12.0, shared_percent=10.0, row_excess=0.6),
        effect("inter_pixel_capacitance")(share_percent=1.0, row_excess=0.4, corner_share=0.3),
        effect("on_chip_smoothing")(strength=0.06),
        effect("on_chip_sharpening")(strength=0.06),
        effect("coloured_read_noise")(correlation=-0.15),
        effect("coloured_read_noise")(correlation=0.25, decay=0.5),
    ],
    ids=lambda e: e.name,
)
def test_what_sim_renders_is_predicted_and_named(one: Effect, cfa: str) -> None:
    """The prediction's chi2 as above; the name alone; and its size within 3.5 standard uncertainties."""
    dataset = _rendered((one,), seed=8, cfa=cfa)
    block = measure_noise_neighbours(dataset)
    residual = block.value - block.predict((one,)).mean
    assert float(np.mean(np.square(residual) / np.diag(block.covariance))) < 1.0 + 4.0 * np.sqrt(2.0 / len(residual))
    verdict = _verdict(dataset)
    assert [c.effect.name for c in verdict.named] == [one.name]
    main = next(iter(type(one).quantities()))
    std = verdict.named[0].std[main]
    assert std is not None
    assert abs(getattr(verdict.named[0].effect, main) - getattr(one, main)) < 3.5 * std


@pytest.mark.parametrize(
    ("law", "name"),
    [
        (BrighterFatterLaw(9.0, 1), "brighter_fatter"),
        (OnChipSmoothingLaw(0.06, 0), "on_chip_smoothing"),
        (OnChipSmoothingLaw(0.06, 1), "on_chip_smoothing"),
        (OnChipSharpeningLaw(0.06, 1), "on_chip_sharpening"),
        (InterPixelCapacitanceLaw(1.0), "inter_pixel_capacitance"),
        (InterPixelCapacitanceLaw(1.5, 1), "inter_pixel_capacitance"),
        (BrighterFatterLaw(12.0, 3), "brighter_fatter"),
        (ColouredReadNoiseLaw(3.0, 0), "coloured_read_noise"),
        (ColouredReadNoiseLaw(3.0, 1), "coloured_read_noise"),
        (ColouredReadNoiseLaw(3.0, 2), "coloured_read_noise"),
    ],
    ids=lambda v: v if isinstance(v, str) else f"{v.strength:g}-{v.variant}",
)
def test_what_another_former_conceals_is_named(law: Law, name: str) -> None:
    """Non-centralities of 70 and more, from the growth of the correlation with the level, dark frames included."""
    assert [c.effect.name for c in _verdict(_concealed(770021, (law,), cfa="MONO")).named] == [name]


def test_borders_that_move_between_colours_are_measured_by_their_means() -> None:
    """A loss of 6 % by borders alone is a mean exchange of 6 / 4 %: all three sizes within 3.5 standard
    uncertainties."""
    dataset = _concealed(770041, (BrighterFatterLaw(6.0, 2),), cfa="RGGB")
    verdict = _verdict(dataset)
    assert [c.told_name for c in verdict.named] == ["brighter_fatter"]
    found, std = verdict.named[0].effect.model_dump(), verdict.named[0].std
    for name, truth in (("loss_percent", 6.0), ("shared_percent", 6.0), ("exchanged_percent", 1.5)):
        assert abs(found[name] - truth) < 3.5 * (std[name] or 0.0)


@pytest.mark.parametrize(("cfa", "variant"), [("MONO", 0), ("MONO", 1), ("RGGB", 1)])
def test_charge_that_prefers_a_direction_is_measured_by_the_two_covariances(cfa: str, variant: int) -> None:
    """Three times as much to neighbours in the row, or in the column: sizes and excess within 3.5 standard
    uncertainties, and the excess at least 4 from none."""
    law = AnisotropicBrighterFatterLaw(18.0, variant)
    verdict = _verdict(_concealed(770051, (law,), cfa=cfa, repeats=6))
    assert [c.told_name for c in verdict.named] == ["brighter_fatter"]
    found, std = verdict.named[0].effect.model_dump(), verdict.named[0].std
    for name, truth in law.library_parameters().items():
        assert abs(found[name] - truth) < 3.5 * (std[name] or 0.0)
    assert abs(found["row_excess"]) > 4.0 * (std["row_excess"] or np.inf)


def test_few_repeats_hold_whole_levels_out_and_many_their_last_third() -> None:
    few, many = _concealed(770031), _concealed(770031, repeats=6)
    levels = [{c.id for c in g} for g in few.flat_levels()]
    out = held_out_flats(few)
    assert all(g <= out or not g & out for g in levels)
    assert 0 < sum(g <= out for g in levels) < len(levels) / 2
    assert not levels[-1] & out  # the brightest
    for group in many.flat_levels():
        assert {c.id for c in group} & held_out_flats(many) == {c.id for c in group[4:]}
    seen = {c for b in _blocks(few) for label in b.labels if not label.held_out for c in label.captures}
    assert not seen & out


def test_pairs_are_all_within_two_pixels() -> None:
    assert all(max(abs(d) for d in lag) <= 2 for lags in PAIRS.values() for lag in lags)


@pytest.mark.parametrize(
    ("cfa", "shape", "frames"), [("MONO", (8, 12), 3), ("RGGB", (16, 16), 5), ("GBRG", (12, 16), 2)]
)
def test_correlations_of_independent_pixels_in_small_frames_are_none(
    cfa: str, shape: tuple[int, int], frames: int
) -> None:
    """What taking out the means of rows and columns does to independent pixels is exact: the mean of many sets is 0 and
    their covariance as stated."""
    rng = np.random.default_rng(8)
    dataset = _concealed(1, cfa=cfa)
    dark = dataset.recordings.captures("dark", "left")[:frames]
    captures = [dark[0].model_copy(update={"id": f"d{k}"}) for k in range(frames)]
    drawn: dict[str, np.ndarray] = {}
    dataset.recordings.frame = lambda c: drawn[c.id]  # type: ignore[method-assign, assignment, return-value]
    found = []
    for _ in range(SETS):
        drawn.update({c.id: 1000.0 + 30.0 * rng.standard_normal(shape) for c in captures})
        found.append(repeats_of(dataset, captures, False).correlation)
    value = np.array(found)
    covariance = independent_correlations(shape, frames - 1, dataset.camera.cfa)[1]
    std = np.sqrt(np.diag(covariance))
    # 6 means at 4.5 sigma
    assert np.all(np.abs(value.mean(0)) < 4.5 * std / np.sqrt(SETS))
    # a covariance from SETS sets: sqrt(2 / SETS) of the variances at most; near-normal numbers
    assert np.cov(value.T) / np.outer(std, std) == pytest.approx(
        covariance / np.outer(std, std), abs=5.0 * np.sqrt(2.0 / SETS)
    )


@pytest.mark.parametrize("cfa", ["MONO", pytest.param("RGGB", marks=pytest.mark.slow)])
def test_charge_that_moves_across_an_edge_is_no_blur(cfa: str) -> None:
    """Borders between unequal pixels move, so that a quarter of the variance's loss is exchanged: 5 % for 20 %. Edges
    alone tell it, within three standard deviations."""
    model = measured_model(
        former(6201, BrighterFatterLaw(20.0, 2, 1), cfa=cfa, kinds=("dark", "flat", "slanted_edge")),
        measure_slanted_edge,
    )
    fit = refit(
        model, (BrighterFatter(loss_percent=20.0, shared_percent=20.0, exchanged_percent=1.0),), DecisionPolicy()
    )
    found, std = fit.effects[0].model_dump()["exchanged_percent"], fit.std[0]["exchanged_percent"]
    assert std is not None
    assert abs(found - 5.0) < 3.0 * std
    assert sigmas(model, fit.effects) < 3.0 < sigmas(model)


def test_hot_pixels_take_nothing_from_the_correlation_of_the_others() -> None:
    """Noise x_i of which each pixel passes the share a to the next has the correlation a (1 - a) / ((1 - a)^2 + a^2).
    One pixel in a hundred of 500 DN and a noise of 40 DN has 2.8 times the variance of all others together; left out,
    it takes the pairs that it is in, a fiftieth. Of N pairs, a correlation scatters by 1 / sqrt(N)."""
    rng, share, std_dn, frames = np.random.default_rng(8), 0.2, 3.0, 12
    plain = rendered(5, repeats=1)
    darks = [c for c in plain.captures("dark") if c.exposure_s == 2.0]
    darks = [darks[0].model_copy(update={"id": f"d{k}", "frame": f"d{k}.npy"}) for k in range(frames)]
    hot = rng.random((96, 128)) < 0.01
    drawn = {}
    for capture in darks:
        noise = std_dn * rng.standard_normal((96, 129))
        passed = (1.0 - share) * noise[:, 1:] + share * noise[:, :-1]
        drawn[capture.frame] = np.rint(140.0 + passed + hot * (500.0 + 40.0 * rng.standard_normal(hot.shape)))
    manifest = plain.manifest.model_copy(update={"captures": (*plain.manifest.captures, *darks)})
    recordings = plain.under(manifest).with_frames({path: frame.astype(np.uint16) for path, frame in drawn.items()})
    found = repeats_of(dataset(recordings), darks, held_out=False)
    wanted = share * (1.0 - share) / ((1.0 - share) ** 2 + share**2)
    # rounding adds 1/12 DN^2 of its own to the variance of 6.1 DN^2
    wanted /= 1.0 + 1.0 / 12.0 / (std_dn**2 * ((1.0 - share) ** 2 + share**2))
    pairs = (frames - 1) * hot.size
    assert found.correlation[0] == pytest.approx(wanted, abs=wanted * 0.02 + 4.0 / np.sqrt(pairs))
    black_dn = dataset(recordings).noise.black
    assert found.ordinary["Y"] == pytest.approx(140.0 - black_dn, abs=4.0 * std_dn / np.sqrt(frames * hot.size) + 0.01)
    assert found.signal["Y"] == pytest.approx(140.0 - black_dn + 500.0 * hot.mean(), abs=1.0)


def test_capacitance_is_named_by_the_evidence_with_its_size() -> None:
    """An unlisted process of the correlations takes most of what capacitance does to shot noise. Given that process,
    charge transfer would have to be small; about its mode without it, its six parameters took the rest for nothing."""
    dataset = _rendered((effect("inter_pixel_capacitance")(share_percent=1.0, row_excess=0.4, corner_share=0.3),), 8)
    found = search_blocks(MeasurementModel(_blocks(dataset), dataset.camera), dataset)
    assert found.names == ["inter_pixel_capacitance"]
    size = found.size("inter_pixel_capacitance", "share_percent")
    assert abs(size.mean - 1.0) < 3.5 * size.std
