"""Places, measurements and what could have been seen, on small made-up models; residual pictures on recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy import stats

from lab.challenge.recordings import recordings_of
from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.measurements.summaries import Block, Label, Prediction
from lab.diagnose.outcome.detectability import detectability, detectable
from lab.diagnose.outcome.goodness_of_fit import measurement_fits, places
from lab.diagnose.outcome.residual_pictures import residual_pictures
from lab.diagnose.policy import DecisionPolicy
from lab.formats.camera_file import CameraFile, default_camera
from lab.predict.camera_model import camera_model
from mocks.former import ConcealedCamera, Plan
from mocks.former import laws as concealed_laws
from sim.effects.base import Effect
from sim.effects.defocus import Defocus
from sim.effects.optical_low_pass_filter import OpticalLowPassFilter
from sim.point import TRANSFER, Blur

CAMERA = default_camera().camera
FREQUENCY = np.linspace(0.05, 0.9, 18)
NOISE = 0.004
TRUTH = OpticalLowPassFilter(displacement_x_um=1.5, displacement_y_um=1.5)


def _verdict(named: tuple[Effect, ...] = ()) -> Verdict:
    angles = [0.0, 0.0, 0.8, 0.8]

    def predict(acting: Sequence[Effect]) -> Prediction:
        parts, blur = [], Blur(CAMERA, acting)
        for angle in angles:
            factor = blur.beside_lens(550.0, FREQUENCY * np.cos(angle), FREQUENCY * np.sin(angle))
            parts.append(np.exp(-2.0 * FREQUENCY) * np.real(factor))
        return Prediction(np.concatenate(parts), {})

    labels = tuple(
        Label(float(f), "G", f"{a:g}", (f"edge-{i}",), i % 2 == 1) for i, a in enumerate(angles) for f in FREQUENCY
    )
    value = predict((TRUTH,)).mean + NOISE * np.random.default_rng(8).standard_normal(len(labels))
    block = Block(
        measurement="slanted_edge", axis="spatial_frequency", unit="cy/px", reach=0.2, value=value,
        covariance=NOISE**2 * np.eye(len(labels)), labels=labels, reads=TRANSFER, predict=predict,
        scale=np.ones(len(labels)), conditions="orientation",
    )  # fmt: skip
    candidates = tuple(Candidate(e, {}, 1.0, (), 100.0) for e in named)
    return Verdict(MeasurementModel((block,), CAMERA), 12.0, 60.0, (), candidates, (), (), ())


def test_detectable_is_seen_at_its_rate() -> None:
    """200 000 draws of a squared normal: 3 sigma of the rate are 0.002."""
    size = np.sqrt(detectable(12.0))
    score = np.square(np.random.default_rng(1).standard_normal(200_000) + size)
    assert np.mean(score > 12.0) == pytest.approx(0.9, abs=0.002)


def test_the_smallest_size_that_is_seen_has_that_non_centrality() -> None:
    """The change by the effect at that size, whitened: lambda to 5 %, as blurs bend a little beyond the slope at zero."""
    verdict = _verdict()
    found = {item.effect: item for item in detectability("left", verdict, DecisionPolicy())}
    size = found["defocus"].smallest["defocus_um"]
    model = verdict.model
    change = (model.mean((Defocus(defocus_um=size),)) - model.mean())[model.seen] / NOISE
    assert float(change @ change) == pytest.approx(detectable(12.0), rel=0.05)
    assert 0.9 < found["defocus"].cosine <= 1.0  # all blurs are alike in so few numbers
    assert found["defocus"].told_apart == pytest.approx(
        stats.norm.cdf(0.5 * np.sqrt(detectable(12.0) * (1.0 - found["defocus"].cosine ** 2)))
    )


def test_measurements_fit_with_the_truth_and_not_without() -> None:
    (fit,) = measurement_fits("left", _verdict((TRUTH,)))
    model = _verdict().model
    assert (fit.n, fit.held_out_n) == (36, 36)
    assert fit.held_out_before == pytest.approx(model.held_out()[0])
    assert fit.held_out_after == pytest.approx(model.held_out((TRUTH,))[0])
    assert fit.chi2_after < stats.chi2.ppf(0.999, 36) < fit.chi2_before


def test_every_place_is_told_before_and_after() -> None:
    found = list(places("left", _verdict((TRUTH,)), DecisionPolicy()))
    assert {p.axis for p in found} == {"spatial_frequency", "orientation"}
    assert max(p.sigma_before for p in found) > 5.0
    assert max(p.sigma_after for p in found) < 3.0
    assert all(p.chi2_after < p.chi2_before for p in found)


def test_pictures_show_what_the_model_lacks_and_noise_once_it_has_it() -> None:
    """Cells' residuals of a right model are normal, of rms 1; the sensor's own patterns differ from their mean scatter by some per cent."""
    law = concealed_laws.OpticalLowPassFilterLaw(1.8)
    camera = ConcealedCamera(20771, [law], cfa="MONO", f_number=4.0, rows=160, cols=200)
    recordings = recordings_of(camera, Plan(("flat", "slanted_edge")))
    model = camera_model(recordings, "left").model_copy(
        update={"black_level_dn": camera.black_level_dn, "conversion_gain_dn_per_e": camera.gain_dn_per_e, "read_noise_e": camera.read_noise_e,
                "prnu_percent": camera.prnu_percent, "dark_current_e_per_s": camera.dark_e_per_s, "full_well_e": camera.full_well_e}
    )  # fmt: skip
    known = CameraFile("known", model, (OpticalLowPassFilter(displacement_x_um=1.8, displacement_y_um=1.8),))
    found = {p.kind: p for p in residual_pictures(recordings, "left", _verdict().model, known)}
    assert set(found) == {"flat", "slanted_edge"}

    def rms(table: tuple[tuple[float, ...], ...]) -> float:
        return float(np.sqrt(np.mean(np.square(table))))

    edge = found["slanted_edge"]
    # where the edge lies is known to some hundredths of a pixel only: it keeps a thin trace
    assert rms(edge.after) < 1.4
    assert rms(edge.before) > rms(edge.after) + 0.1
    assert rms(found["flat"].after) == pytest.approx(1.0, abs=0.15)
