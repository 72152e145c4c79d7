"""A bootstrap of images: what a healthy camera like the fitted baseline would score, drawn frame by frame by the forward model.

The threshold in `decide.py` is drawn from the covariance of the measurements, in no time. Here the baseline's frames are drawn instead, with
patterns and noise of their own, and go through every estimator: what a covariance leaves out (estimators' errors, an edge's tail, rounding)
shows in the scores.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.diagnose.inference.evidence import Evidence, chi2
from lab.diagnose.inference.score import signatures
from lab.diagnose.measurements.blocks import evidence_of
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import Flat, Narrowband, RecordingSet
from lab.formats.results import FitResult
from lab.predict.replay import Replay
from sim.camera import CameraModel, Side
from sim.effects.library import effects as library
from sim.spectrum import Spectrum


@dataclass(frozen=True)
class HealthyDraw:
    """One draw: the highest score of any effect, and chi2 and number of values of every measurement."""

    top_score: float
    chi2: dict[str, tuple[float, int]]


def healthy_draws(
    recordings: RecordingSet,
    side: Side,
    evidence: Evidence,
    count: int,
    rng: np.random.Generator,
    fit: FitResult | None = None,
    baseline: CameraFile | None = None,
) -> list[HealthyDraw]:
    """`count` draws of the recordings by the baseline of `evidence`; measurements of captures that can't be replayed are left out."""
    camera = _at_recorded_levels(recordings, side, evidence.camera)
    replay = Replay(recordings, side, camera)
    others = {c.id for c in recordings.captures(side=side)} - {c.id for c in replay.captures}
    found = []
    for _ in range(count):
        again, _ = evidence_of(replay.drawn(rng).without(others), side, fit, baseline)
        if again is not None:
            found.append(_draw_of(again))
    return found


def image_threshold(draws: Sequence[HealthyDraw], false_alarm_rate: float) -> float:
    """The score that a share `false_alarm_rate` of healthy cameras exceeds, of the extreme-value distribution (Gumbel's) that
    has the draws' mean and standard deviation: the largest of many scores follows it, and few draws fix it."""
    tops = np.array([d.top_score for d in draws])
    scale = float(np.std(tops, ddof=1)) * np.sqrt(6.0) / np.pi
    return float(np.mean(tops)) - scale * (np.euler_gamma + float(np.log(-np.log1p(-false_alarm_rate))))


def _draw_of(evidence: Evidence) -> HealthyDraw:
    known = [effect for effect in library().values() if effect.shown_by]
    scores = signatures(evidence, evidence.camera, (), known).scores()
    model = evidence.gaussian()
    blocks = {}
    for block, at in zip(evidence.blocks, evidence.slices, strict=True):
        index = np.arange(at.start, at.stop)[evidence.seen[at]]
        residual = (evidence.value - model.mean)[index]
        blocks[block.measurement] = chi2(residual, model.covariance[np.ix_(index, index)]), len(index)
    return HealthyDraw(max((s.value for s in scores), default=0.0), blocks)


def _at_recorded_levels(recordings: RecordingSet, side: Side, camera: CameraModel) -> CameraModel:
    """The camera with sensitivities that give the recorded levels: the baseline leaves their scale free, and a level that is off
    would clip, or lose itself in noise."""
    replay = Replay(recordings, side, camera)
    ratios = []
    for capture in replay.captures:
        if isinstance(capture, Flat | Narrowband):
            lit = float(recordings.frame(capture).mean()) - camera.black_level_dn
            promised = float(replay.expected(capture).mean()) - camera.black_level_dn
            if promised > 0.05 * (camera.white_level_dn - camera.black_level_dn):
                ratios.append(lit / promised)
    if not ratios:
        return camera
    highest = max(max(curve.value) for curve in camera.quantum_efficiency.values())
    factor = min(float(np.median(ratios)), 1.0 / highest)
    scaled = {
        channel: Spectrum.of(curve.wavelength_nm, [factor * v for v in curve.value])
        for channel, curve in camera.quantum_efficiency.items()
    }
    return camera.model_copy(update={"quantum_efficiency": scaled})
