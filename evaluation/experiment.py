"""An experiment: cases whose truth is known are drawn, diagnosed one by one, and scored together.

Every result is kept in OUT/results/CASE.json. An interrupted run continues there, and a page shows the results of all
runs.
"""

from __future__ import annotations

import shutil
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

from evaluation.page import placed, with_seed
from evaluation.truth import load, store
from lab.errors import InputError
from lab.workers import Workers
from sim.parameters import Frozen


class CaseResult(Frozen):
    """What the diagnosis of one case gave. `commit`: of the code, abbreviated; empty outside a checkout."""

    commit: str = ""


C = TypeVar("C")
R = TypeVar("R", bound=CaseResult)


@dataclass(frozen=True)
class PagePicture:
    """A picture of a page. `end`: of its file's name, after the page's; `shows`: its alternative text."""

    end: str
    shows: str
    svg: str


@dataclass(frozen=True)
class ScoredExperiment:
    """The scores of an experiment. `section`: its marks on a page; `text`: Markdown; `introduction`: what stands before
    it on the page; `title`: heading of a page that isn't there yet; `seed_row`: of the page's list of seeds; `reached`:
    whether no goal was missed."""

    section: str
    text: str
    introduction: str = ""
    title: str = "Proof"
    pictures: Sequence[PagePicture] = ()
    seed_row: str = ""
    reached: bool = True

    def write(self, page: Path) -> None:
        """Write the section between its marks on the page, and the pictures beside the page."""
        text = page.read_text(encoding="utf-8") if page.is_file() else f"# {self.title}\n"
        page.parent.mkdir(parents=True, exist_ok=True)
        body = "\n\n".join(part for part in (self.introduction, self.text) if part)
        for picture in self.pictures:
            file = page.with_name(f"{page.stem}{picture.end}.svg")
            file.write_text(picture.svg, encoding="utf-8")
            body += f"\n\n![{picture.shows}]({file.name})"
        text = placed(text, self.section, body)
        page.write_text(with_seed(text, self.seed_row) if self.seed_row else text, encoding="utf-8")


class Experiment(ABC, Generic[C, R]):
    """Draw, diagnose, score; a subclass says how."""

    result: ClassVar[type[CaseResult]]

    @abstractmethod
    def draw(self) -> Mapping[str, C]:
        """Return the cases by name."""

    @abstractmethod
    def diagnose(self, case: C, folder: Path) -> R:
        """Return the result of a case; `folder`: a place of its own, removed afterwards."""

    @abstractmethod
    def score(self, runs: Mapping[str, R]) -> ScoredExperiment:
        """Return the scores of results by the cases' names."""

    def is_current(self, kept: R, case: C) -> bool:
        """Return whether a kept result stands, so that its case isn't diagnosed again."""
        return True

    def describe(self, run: R) -> str:
        """Return a line on a result, printed when it is there; empty: none."""
        return ""

    def file(self, out: Path, name: str) -> Path:
        """Return where the result of a case is kept."""
        return out / "results" / f"{name}.json"

    def chosen(self, only: Sequence[str] | None) -> dict[str, C]:
        """Return the cases of these names, all without any. Raises InputError for a name that there is not."""
        every = self.draw()
        unknown = sorted(set(only or ()) - set(every))
        if unknown:
            raise InputError(f"--only {unknown[0]}: no such case; there are {', '.join(every)}")
        return {name: case for name, case in every.items() if not only or name in only}

    def run(
        self,
        out: Path,
        only: Sequence[str] | None = None,
        workers: Workers | None = None,
        progress: Callable[[str, float], None] = lambda _text, _share: None,
    ) -> dict[str, R]:
        """Return the results of the cases by name: those that are kept, all others diagnosed now."""
        cases = self.chosen(only)
        runs: dict[str, R] = {}
        for name, case in cases.items():
            if (file := self.file(out, name)).exists():
                kept: R = load(self.result, file)  # type: ignore[assignment]
                if self.is_current(kept, case):
                    runs[name] = kept
        missing = [name for name in cases if name not in runs]
        here = commit() if missing else ""
        # workers elsewhere know a folder by its whole path
        work = [(cases[name], out.resolve() / "session" / name) for name in missing]
        for number, found in (workers or Workers()).done(self._diagnosed, work):
            name = missing[number]
            runs[name] = found.model_copy(update={"commit": here})
            store(runs[name], self.file(out, name))
            progress(f"{len(runs)} of {len(cases)} cases", len(runs) / len(cases))
            if line := self.describe(runs[name]):
                print(f"{name}: {line}", flush=True)
        return {name: runs[name] for name in cases}

    def _diagnosed(self, work: tuple[C, Path]) -> R:
        case, folder = work
        shutil.rmtree(folder, ignore_errors=True)
        try:
            return self.diagnose(case, folder)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def kept(self, out: Path) -> dict[str, R]:
        """Return all results that are kept, in the order of the cases."""
        files = {name: self.file(out, name) for name in self.draw()}
        return {name: load(self.result, file) for name, file in files.items() if file.exists()}  # type: ignore[misc]

    def prove(self, out: Path, only: Sequence[str] | None = None, page: Path | None = None) -> ScoredExperiment:
        """Run the cases, print the scores of all that have a result, and write them into a page."""
        self.run(out, only)
        outcome = self.score(self.kept(out))
        print(outcome.text)
        if page is not None:
            outcome.write(page)
        return outcome


def commit() -> str:
    """Return the abbreviated hash of the checkout's commit, with `+` where files differ from it; empty where there is
    no checkout."""
    command = ["git", "describe", "--always", "--abbrev=7", "--exclude=*", "--dirty=+"]
    done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    return done.stdout.strip()
