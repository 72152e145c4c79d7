"""An image-level bootstrap: scores of healthy cameras like the fitted baseline, drawn frame by frame by the forward
model.

The threshold of `decide.py` is drawn from the covariance of the measurements. Here whole frames with their own patterns
and noise go through every estimator, so that the scores hold what a covariance leaves out: estimators' errors, an
edge's tail, rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.score import signatures
from lab.diagnose.inference.side_model import measurement_model
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import RecordingSet
from lab.formats.results import FitResult
from lab.observables.gaussian import chi2
from lab.one_blas_thread import one_blas_thread
from lab.predict.replay import Replay
from lab.workers import Workers
from sim.camera import CameraModel, Side
from sim.effects.library import candidates
from sim.spectrum import Spectrum

#: Flats whose predicted signal is below this share of the range say too little of the level.
LEAST_SIGNAL_SHARE = 0.05


@dataclass(frozen=True)
class HealthyDraw:
    """One draw: the highest score of any effect, and chi2 and number of values of every measurement."""

    top_score: float
    chi2: dict[str, tuple[float, int]]


def healthy_draws(
    recordings: RecordingSet,
    side: Side,
    model: MeasurementModel,
    count: int,
    rng: np.random.Generator,
    fit: FitResult | None = None,
    baseline: CameraFile | None = None,
    workers: Workers | None = None,
    report: Callable[[int], None] = lambda done: None,
) -> list[HealthyDraw]:
    """`count` draws of the recordings by the baseline of `model`; measurements of captures that can't be replayed are
    left out. Each draw has a generator of its own, so that they are the same wherever `workers` do them (None: in this
    process). `report` is called with the number of draws that are done, after each."""
    workers = workers or Workers()
    camera = _at_recorded_levels(recordings, side, model.camera)
    if workers.scheduler is not None:
        recordings.let_go()  # every worker reads its own frames
    draws: dict[int, HealthyDraw | None] = {}
    for number, draw in workers.done(_healthy_draw, rng.spawn(count), recordings, side, camera, fit, baseline):
        draws[number] = draw
        report(len(draws))
    return [draw for _, draw in sorted(draws.items()) if draw is not None]


@one_blas_thread
def _healthy_draw(
    rng: np.random.Generator,
    recordings: RecordingSet,
    side: Side,
    camera: CameraModel,
    fit: FitResult | None,
    baseline: CameraFile | None,
) -> HealthyDraw | None:
    """One draw; None where nothing of it can be summarised."""
    replay = Replay(recordings, side, camera)
    others = {c.id for c in recordings.captures(side=side)} - {c.id for c in replay.captures}
    again, _ = measurement_model(replay.drawn(rng).without(others), side, fit, baseline)
    return None if again is None else _draw_of(again)


def image_threshold(draws: Sequence[HealthyDraw], false_alarm_rate: float) -> float:
    """Return the score that a share `false_alarm_rate` of healthy cameras exceeds: the quantile of Gumbel's
    extreme-value distribution with the draws' mean and standard deviation. The largest of many scores follows it, and
    few draws fix it."""
    tops = np.array([d.top_score for d in draws])
    scale = float(np.std(tops, ddof=1)) * np.sqrt(6.0) / np.pi
    return float(np.mean(tops)) - scale * (np.euler_gamma + float(np.log(-np.log1p(-false_alarm_rate))))


def _draw_of(model: MeasurementModel) -> HealthyDraw:
    scores = signatures(model, model.camera, (), candidates()).scores()
    gaussian = model.gaussian()
    blocks = {}
    for block, at in zip(model.blocks, model.slices, strict=True):
        index = np.arange(at.start, at.stop)[model.seen[at]]
        residual = (model.value - gaussian.mean)[index]
        blocks[block.measurement.name] = chi2(residual, gaussian.covariance[np.ix_(index, index)]), len(index)
    return HealthyDraw(max((s.value for s in scores), default=0.0), blocks)


def _at_recorded_levels(recordings: RecordingSet, side: Side, camera: CameraModel) -> CameraModel:
    """Return the camera with sensitivities scaled so that it gives the recorded levels. Their scale is a nuisance
    parameter of the baseline; at a wrong one, frames would clip or be lost in noise."""
    replay = Replay(recordings, side, camera)
    ratios = []
    for capture in replay.captures:
        if isinstance(capture, FlatCapture | NarrowbandCapture):
            lit = float(recordings.frame(capture).mean()) - camera.black_level_dn
            predicted = float(replay.expected(capture).mean()) - camera.black_level_dn
            if predicted > LEAST_SIGNAL_SHARE * (camera.white_level_dn - camera.black_level_dn):
                ratios.append(lit / predicted)
    if not ratios:
        return camera
    highest = max(max(curve.value) for curve in camera.quantum_efficiency.values())
    factor = min(float(np.median(ratios)), 1.0 / highest)
    scaled = {
        channel: Spectrum.of(curve.wavelength_nm, [factor * v for v in curve.value])
        for channel, curve in camera.quantum_efficiency.items()
    }
    return camera.model_copy(update={"quantum_efficiency": scaled})
