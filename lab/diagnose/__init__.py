"""Diagnosis: where recordings and the baseline differ, which effect was left out, and what naming it gains.

policy.py       every number by which a diagnosis decides
measurements/   what is looked at: numbers with covariance, and how a model predicts them
inference/      the measurement model; locate, score, search, weigh, name
outcome/        what is told: result, improved model, next capture
visibility.py   which measurements show each effect, and which effects are rivals
side.py         the chain for one side; lab/side_processes.py runs the sides at the same time
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from lab.diagnose.outcome.merge_sides import merged
from lab.diagnose.outcome.next_capture import Proposal
from lab.diagnose.policy import DecisionPolicy
from lab.diagnose.side import diagnose_side
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import RecordingSet
from lab.formats.results import DiagnosisResult, FitResult
from lab.one_blas_thread import one_blas_thread
from lab.side_processes import in_processes
from lab.workers import Workers
from sim.camera import Side

__all__ = ["DecisionPolicy", "Diagnosis", "Progress", "diagnose", "examine"]

#: Called with what is being done and the share of the work that is done, 0..1.
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Diagnosis:
    """The result; the improved model of every side that could be judged; and what to capture next, best first."""

    result: DiagnosisResult
    improved: dict[Side, CameraFile]
    proposals: tuple[Proposal, ...] = ()


def diagnose(
    recordings: RecordingSet,
    fit: FitResult | None = None,
    progress: Progress | None = None,
    *,
    at_once: bool = True,
) -> DiagnosisResult:
    """What `examine` finds, without the improved models."""
    return examine(recordings, fit, progress, at_once=at_once).result


@one_blas_thread
def examine(
    recordings: RecordingSet,
    fit: FitResult | None = None,
    progress: Progress | None = None,
    *,
    baseline: Mapping[Side, CameraFile] | None = None,
    at_once: bool = True,
    pictures: bool = False,
    bootstrap: int = 0,
    workers: Workers | None = None,
    policy: DecisionPolicy | None = None,
) -> Diagnosis:
    """Diagnose every side.

    fit         gives geometry and sensitivities; None: neither, where the maker states none. Noise and levels are nuisance parameters
                of the measurement model. What the recordings don't determine stands in `skipped`.
    progress    is called in the caller's thread with a text and the share of the work that is done.
    baseline    cameras with their effects, by side, in place of the maker's word and the fit.
    at_once     several sides run at the same time, each in a process of its own; else one after the other in this one.
    pictures    draw residual pictures, for the report.
    bootstrap   healthy cameras like the baseline that are drawn frame by frame; the threshold is at least what their scores say.
    workers     where these are drawn; None: in the side's process.
    policy      the rules of decision; None: `DecisionPolicy()`.
    """
    policy = policy or DecisionPolicy()
    shares = dict.fromkeys(recordings.sides, 0.0)
    cameras = baseline or {}

    def report(side: Side, text: str) -> None:
        shares[side] = 1.0 - 0.8 * (1.0 - shares[side])
        if progress is not None:
            progress(f"{text} ({side})", sum(shares.values()) / len(shares))

    tasks = {
        side: partial(
            diagnose_side,
            recordings,
            side,
            fit,
            cameras.get(side),
            policy=policy,
            pictures=pictures,
            bootstrap=bootstrap,
            workers=workers,
        )
        for side in recordings.sides
    }
    if at_once and len(tasks) > 1:
        found = [*in_processes(recordings, tasks, report, "diagnose").values()]
    else:
        found = [task(partial(report, side)) for side, task in tasks.items()]
    if progress is not None:
        progress("done", 1.0)
    improved = {findings.side: findings.improved for findings in found if findings.improved is not None}
    offered = sorted((p for findings in found for p in findings.proposals), key=lambda p: -p.capture.distance)
    return Diagnosis(merged(recordings.source, found, policy), improved, tuple(offered))
