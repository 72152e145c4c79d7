"""Experiments on sealed cases: the truths are opened after the last diagnosis."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from evaluation.case_run import CaseRun, run_case
from evaluation.experiment import Experiment, ScoredExperiment
from evaluation.score import SealedScore, broken_seals
from evaluation.truth import Seals, Truths, load
from lab.diagnose.policy import DecisionPolicy
from lab.engine import DEFAULT_ENGINE, Engine

S = TypeVar("S", bound=SealedScore)


@dataclass(frozen=True)
class SealedExperiment(Experiment[Path, CaseRun], Generic[S]):
    """Cases in a folder that `make` wrote; their truths are opened after the last diagnosis.

    cases: names; truths: their file, for the scores; policy: rules of decision, None: the default ones; results:
    folder of the results below that of the cases; engine: what diagnoses.
    """

    result = CaseRun

    folder: Path
    cases: tuple[str, ...]
    truths: Path | None = None
    policy: DecisionPolicy | None = None
    results: str = "results"
    engine: Engine = DEFAULT_ENGINE

    def draw(self) -> dict[str, Path]:
        """Return the folder of each case."""
        return {case: self.folder.resolve() / case for case in self.cases}

    def diagnose(self, case: Path, folder: Path) -> CaseRun:
        """Diagnose the recording set of a case."""
        return run_case(case, self.policy, self.engine)

    def file(self, out: Path, name: str) -> Path:
        """Return where the result of a case is kept."""
        return out / self.results / f"{name}.json"

    def score(self, runs: Mapping[str, CaseRun]) -> ScoredExperiment:
        """Open the seals, and return the tables and pictures."""
        return self.outcome(self.opened(runs))

    def opened(self, runs: Mapping[str, CaseRun]) -> S:
        """Open the seals, and return all scores."""
        assert self.truths is not None, "the truths are needed for the scores"
        seals, truths = load(Seals, self.folder / "seals.json"), load(Truths, self.truths)
        return self.scored(truths, seals, dict(runs), broken_seals(self.folder, seals, truths))

    @abstractmethod
    def scored(
        self, truths: Truths, seals: Seals, runs: dict[str, CaseRun], broken: Sequence[str]
    ) -> S:  # fmt: skip
        """Return all scores; cases with a broken seal are left out."""

    @abstractmethod
    def outcome(self, scores: S) -> ScoredExperiment:
        """Return the tables and pictures of scores."""


def sealed_cases(folder: Path) -> tuple[str, ...]:
    """Return the names of the cases of a folder that are there. Raises InputError where it has no seals."""
    seals = load(Seals, folder / "seals.json")
    return tuple(case for case in sorted(seals.seals) if (folder / case).is_dir())


def about(scores: SealedScore) -> tuple[str, str]:
    """Return what a page says of sealed cases before their tables, and their row of its list of seeds."""
    seals = scores.seals_sha256
    return (
        f"Seed {scores.seed}, {scores.cases} cases, {scores.size} frames; SHA-256 over all seals `{seals}`.",
        f"| {scores.purpose} | {scores.seed} | {scores.cases} | {scores.size} | `{seals[:16]}` |",
    )
