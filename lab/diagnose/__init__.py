"""Diagnosis: where recordings depart from the baseline camera, which effect the baseline lacks, and how much better the
camera with that effect predicts.

policy.py       every number by which a diagnosis decides
metadata/       statements about camera and captures that the recordings contradict
inference/      the measurement model; locate, score, search, weigh, name
outcome/        what is reported: result, improved model, next capture
evidence/       the same questions answered by the table of sets of `lab.inference`
visibility.py   which measurements show each effect, and which effects are rivals
side.py         all of it for one side by today's engine; lab/side_processes.py runs the sides at the same time
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeVar, get_args

from lab.capture_kinds.base import Equipment
from lab.diagnose.outcome.merge_sides import merged
from lab.diagnose.outcome.next_capture import Doubt
from lab.diagnose.policy import DecisionPolicy
from lab.diagnose.side import SideFindings, diagnose_side
from lab.engine import DEFAULT_ENGINE, Engine
from lab.errors import InputError
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import Manifest, RecordingSet
from lab.formats.results import DiagnosisResult, FitResult
from lab.one_blas_thread import one_blas_thread
from lab.side_processes import Task, in_processes
from lab.workers import Workers
from sim.camera import Side

if TYPE_CHECKING:
    from lab.diagnose.evidence.side import EvidenceFindings, Refit

__all__ = ["DecisionPolicy", "Diagnosis", "Progress", "diagnose", "examine"]

F = TypeVar("F")

#: Called with the current step in words, and the share of the work that is done, 0..1.
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Diagnosis:
    """The result, the improved model of every side that could be judged, and what is left in doubt on each side."""

    result: DiagnosisResult
    improved: dict[Side, CameraFile]
    doubts: tuple[Doubt, ...] = ()


def diagnose(
    recordings: RecordingSet,
    fit: FitResult | None = None,
    progress: Progress | None = None,
    *,
    at_once: bool = True,
    engine: Engine = DEFAULT_ENGINE,
    refit: Refit | None = None,
) -> DiagnosisResult:
    """Return the result of `examine`, without improved models and proposals."""
    return examine(recordings, fit, progress, at_once=at_once, engine=engine, refit=refit).result


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
    station: Equipment | None = None,
    engine: Engine = DEFAULT_ENGINE,
    refit: Refit | None = None,
) -> Diagnosis:
    """Diagnose every side of the recordings. Measurements that they don't determine are listed in the result's
    `skipped`.

    fit         the fit of the recordings: geometry and sensitivity of the baseline camera. None: as the data sheet
    states them. progress    called in the caller's thread with the current step and the share of the work that is done.
    baseline    camera files by side, effects included, in place of data sheet and fit.
    at_once     diagnose several sides at the same time, each in a process of its own; else one after the other in this
    one. pictures    draw residual pictures, for the report.
    bootstrap   number of healthy cameras, drawn frame by frame, whose scores may raise the threshold.
    workers     where these are drawn; None: in the side's process.
    policy      the rules of decision; None: `DecisionPolicy()`.
    station     where the next capture may be taken: its edges and f-numbers are those of the plans.
    engine      `evidence`: one table of sets with their posterior probabilities (`lab.inference`); `today`: odds with
    their gates. Of the arguments above, `bootstrap`, `workers` and `policy` are of the latter alone.
    refit       by the engine `evidence`, fits the captures that aren't held out, in the place of `fit`. None: `fit`,
    which has seen the held-out captures, too.
    """
    _check_arguments(engine, bootstrap, policy)
    shares = dict.fromkeys(recordings.sides, 0.0)
    steps = dict.fromkeys(recordings.sides, "")
    cameras = baseline or {}

    def report(side: Side, text: str) -> None:
        step = text.partition(":")[0]
        if step != steps[side]:  # else it counts on within its step: "STEP: 3 done"
            steps[side], shares[side] = step, 1.0 - 0.8 * (1.0 - shares[side])
        if progress is not None:
            progress(f"{text} ({side})", sum(shares.values()) / len(shares))

    apart = at_once and len(recordings.sides) > 1

    def given(side: Side) -> RecordingSet:
        return recordings.for_one_of(len(recordings.sides)) if apart else recordings

    def in_order(tasks: Mapping[Side, Task[F]]) -> list[F]:
        if apart:
            return [*in_processes(recordings, tasks, report, "diagnose").values()]
        return [task(partial(report, side)) for side, task in tasks.items()]

    warnings = fit.warnings if fit is not None else ()
    found: Sequence[SideFindings | EvidenceFindings]
    if engine == "evidence":
        # `lab.inference` rests on this package's measurement model
        from lab.diagnose.evidence.merge import merged_evidence
        from lab.diagnose.evidence.side import diagnose_side_by_evidence

        again = refit if refit is not None or fit is None else partial(_as_given, fit, recordings.manifest)
        by_evidence = in_order(
            {
                side: partial(
                    diagnose_side_by_evidence, given(side), side, again, cameras.get(side), pictures=pictures,
                    station=station,
                )
                for side in recordings.sides
            }
        )  # fmt: skip
        found, result = by_evidence, merged_evidence(recordings.source, by_evidence, warnings)
    else:
        by_odds = in_order(
            {
                side: partial(
                    diagnose_side, given(side), side, fit, cameras.get(side), policy=policy, pictures=pictures,
                    bootstrap=bootstrap, workers=workers, station=station,
                )
                for side in recordings.sides
            }
        )  # fmt: skip
        found, result = by_odds, merged(recordings.source, by_odds, policy or DecisionPolicy(), warnings)
    if progress is not None:
        progress("done", 1.0)
    improved = {findings.side: findings.improved for findings in found if findings.improved is not None}
    doubts = tuple(findings.doubt for findings in found if findings.doubt is not None)
    return Diagnosis(result, improved, doubts)


def _as_given(fit: FitResult, stated: Manifest, used: RecordingSet) -> FitResult:
    """Return a fit that is given, whatever is used; without the cameras whose mosaic isn't the one that was stated: the
    fit mixed their planes."""
    kept = {s: c for s, c in fit.cameras.items() if used.camera(s).cfa == stated.cameras[s].cfa}
    return fit.model_copy(update={"cameras": kept})


def _check_arguments(engine: Engine, bootstrap: int, policy: DecisionPolicy | None) -> None:
    """Raise InputError for what an engine doesn't take."""
    if engine not in get_args(Engine):
        raise InputError(f"engine {engine!r}: isn't one; take {' or '.join(get_args(Engine))}")
    if engine == "evidence" and (bootstrap or policy is not None):
        what = "bootstrap" if bootstrap else "a decision policy"
        raise InputError(f"engine evidence: takes no {what}, as its table decides; leave it out, or take engine today")
