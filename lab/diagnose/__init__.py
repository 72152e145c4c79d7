"""Diagnosis: where recordings and the baseline part, what physics was left out, and what the named effects gain.

blocks.py     what is looked at: BLOCKS; one side's evidence
decide.py     the chain on that evidence: score, refit, weigh, hold out
side.py       what is told of one side
processes.py  the sides at the same time
findings.py   all sides in one result
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from lab.diagnose.measurements.blocks import BLOCKS
from lab.diagnose.outcome.findings import merged
from lab.diagnose.outcome.next_capture import Proposal
from lab.diagnose.processes import in_processes
from lab.diagnose.side import SideFindings, diagnose_side
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import RecordingSet
from lab.formats.results import DiagnosisResult, FitResult
from sim.camera import Side

__all__ = ["BLOCKS", "Diagnosis", "Progress", "diagnose", "examine"]
#: Called with what is being done and the share of the work that is done, 0..1.
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Diagnosis:
    """What was found; each side's model with it (of the sides that could be judged); and what to capture next, best first."""

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


def examine(
    recordings: RecordingSet,
    fit: FitResult | None = None,
    progress: Progress | None = None,
    *,
    baseline: Mapping[Side, CameraFile] | None = None,
    at_once: bool = True,
    pictures: bool = False,
    bootstrap: int = 0,
) -> Diagnosis:
    """Diagnose every side. `fit` gives the geometry and, where the maker states no curves, the sensitivities; None: neither.

    Noise and levels are taken from the recordings anew, as free quantities of the same model. What the recordings don't
    determine is not judged, and stands in `skipped`. `baseline`: cameras with their effects, in place of the maker's word and the
    fit, for the sides that it has. Several sides are worked on at the same time, each in a process of its own; one side, or with
    `at_once` False each in its turn, in this one. `pictures`: draw residual pictures, for the report.
    `bootstrap`: so many healthy cameras like the baseline are drawn frame by frame, whose scores the threshold has to hold. `progress` is called in the caller's thread.
    """
    shares = dict.fromkeys(recordings.sides, 0.0)
    cameras = baseline or {}

    def report(side: Side, text: str) -> None:
        shares[side] = 1.0 - 0.8 * (1.0 - shares[side])
        if progress is not None:
            progress(f"{text} ({side})", sum(shares.values()) / len(shares))

    def alone(side: Side) -> SideFindings:
        return diagnose_side(
            recordings,
            side,
            fit,
            cameras.get(side),
            lambda text: report(side, text),
            pictures=pictures,
            bootstrap=bootstrap,
        )

    if at_once and len(shares) > 1:
        found = in_processes(recordings, fit, cameras, report, pictures=pictures, bootstrap=bootstrap)
    else:
        found = [alone(side) for side in recordings.sides]
    if progress is not None:
        progress("done", 1.0)
    improved = {findings.side: findings.improved for findings in found if findings.improved is not None}
    offered = sorted((p for findings in found for p in findings.proposals), key=lambda p: -p.capture.distance)
    return Diagnosis(merged(recordings.source, found), improved, tuple(offered))
