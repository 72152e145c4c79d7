"""Challenges that the service keeps: made and scored by jobs, with the truths out of reach until they are scored.

    DATA/challenges/ID/challenge.json   what was asked for
                       set/             the recording sets, seals.json, the diagnoses
                       truths.json      the truths and the seed; only its owner may read it
                       score.json       once it is scored

The seed is drawn here and never told: whoever knows it can draw the truths. It belongs neither to tuning nor to proofs.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import re
import secrets
import shutil
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Literal, get_args

from lab.capture.records import now
from lab.errors import InputError
from lab.formats import recording_set
from lab.formats.recording_set import RecordingSet
from lab.workers import Workers
from sim.parameters import Frozen

#: Work on a challenge, as a job's kind.
ChallengeWork = Literal["make-challenge", "score-challenge"]
WORK: tuple[ChallengeWork, ...] = get_args(ChallengeWork)
#: Seeds are drawn below this.
LAST_SEED = 1 << 63
_ID = re.compile(r"[0-9a-f]{16}")
Progress = Callable[[str, float], None]


class ChallengeOrder(Frozen):
    """What was asked for. `cfa`: None: as drawn."""

    id: str
    name: str = ""
    created: datetime
    cases: int
    size: str
    cfa: str | None = None


class KeptChallenge(Frozen):
    """A challenge as it stands: `seals` of the cases that are made, SHA-256 of a salt and the truth; `scored`: when,
    None before that."""

    order: ChallengeOrder
    seals: dict[str, str]
    scored: datetime | None


class Challenges:
    """The challenges of a data folder."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def begin(self, cases: int, size: str, cfa: str | None, name: str) -> str:
        """Enter a challenge; its id. Nothing is drawn yet."""
        id = secrets.token_hex(8)
        order = ChallengeOrder(id=id, name=name, created=now(), cases=cases, size=size, cfa=cfa)
        folder = self.root / id
        folder.mkdir(parents=True, mode=0o700)
        (folder / "challenge.json").write_text(order.model_dump_json(), encoding="utf-8")
        return id

    def folder(self, id: str) -> Path:
        """Return a challenge's folder. Raises InputError where there is none of that id."""
        if not _ID.fullmatch(id) or not (self.root / id / "challenge.json").is_file():
            raise InputError(f"no challenge {id[:60]!r}; list them for their ids")
        return self.root / id

    def id_of(self, folder: str) -> str | None:
        """Return the id of the challenge whose folder this is, or None."""
        path = Path(folder)
        return path.name if path.parent == self.root else None

    def all(self) -> list[KeptChallenge]:
        """All of them, the newest first."""
        found = [self.challenge(file.parent.name) for file in self.root.glob("*/challenge.json")]
        return sorted(found, key=lambda one: (one.order.created, one.order.id), reverse=True)

    def challenge(self, id: str) -> KeptChallenge:
        """One. Raises InputError where there is none."""
        folder = self.folder(id)
        seals = folder / "set" / "seals.json"
        score = folder / "score.json"
        return KeptChallenge(
            order=ChallengeOrder.model_validate_json((folder / "challenge.json").read_text(encoding="utf-8")),
            seals=json.loads(seals.read_text(encoding="utf-8"))["seals"] if seals.is_file() else {},
            scored=datetime.fromtimestamp(score.stat().st_mtime, now().tzinfo) if score.is_file() else None,
        )

    def case(self, id: str, case: str) -> Path:
        """Return the folder of a case. Raises InputError where it isn't made."""
        if case not in self.challenge(id).seals:  # looked up, never joined: a name can't leave the folder
            raise InputError(f"challenge {id}: no case {case[:20]!r}; `seals` lists those that are made")
        return self.folder(id) / "set" / case

    def recordings(self, id: str, case: str) -> RecordingSet:
        """Return the recording set of a case. Raises InputError where it isn't made."""
        return recording_set.read(self.case(id, case))

    def opened(self, id: str, what: Literal["score", "truths"]) -> str:
        """Score or truths of a challenge that is scored, as JSON. Raises InputError before that."""
        folder = self.folder(id)
        if not (folder / "score.json").is_file():
            raise InputError(
                f"challenge {id}: isn't scored; its truths stay sealed until then: start a job that scores it"
            )
        return (folder / f"{what}.json").read_text(encoding="utf-8")

    def remove(self, id: str) -> None:
        """Delete a challenge for ever."""
        away = self.root / f".removed-{id}"
        self.folder(id).rename(away)
        shutil.rmtree(away)


def carry_out(work: ChallengeWork, folder: Path, progress: Progress) -> None:
    """Make what is missing of a challenge, or score it. Raises InputError, and what `progress` raises."""
    order = ChallengeOrder.model_validate_json((folder / "challenge.json").read_text(encoding="utf-8"))
    latest = ("", 0.0)

    def told(text: str, share: float) -> None:
        nonlocal latest
        latest = (text, share)
        progress(text, share)

    # A case takes a minute: between two of them, too, somebody may ask for the end.
    workers = _workers(lambda: progress(*latest))
    if work == "make-challenge":
        _make(order, folder, workers, told)
    else:
        _score(order, folder, workers, told)


def _workers(tick: Callable[[], None]) -> Workers:
    """Processes of their own, so that no capture of this process is slowed; one core is left. A worker of a cluster may
    start none."""
    if multiprocessing.current_process().daemon:
        return Workers(1)
    return Workers(max(1, (os.cpu_count() or 1) - 1), apart=True, tick=tick)


def _make(order: ChallengeOrder, folder: Path, workers: Workers, progress: Progress) -> None:
    from evaluation.make import make
    from evaluation.truth import FIRST_FRESH_SEED, Truths, load

    truths = folder / "truths.json"
    # From an earlier job that was stopped: it goes on there.
    begun = truths.exists()
    seed = load(Truths, truths).seed if begun else random.SystemRandom().randrange(FIRST_FRESH_SEED, LAST_SEED)
    if not begun:
        shutil.rmtree(folder / "set", ignore_errors=True)
    make(folder / "set", order.cases, seed, truths, order.size, workers, cfa=order.cfa, progress=progress)


def _score(order: ChallengeOrder, folder: Path, workers: Workers, progress: Progress) -> None:
    from evaluation.run import run_all
    from evaluation.score import broken_seals, score
    from evaluation.truth import Seals, Truths, load, store

    seals = load(Seals, folder / "set" / "seals.json")
    if len(seals.seals) < order.cases:
        raise InputError(
            f"challenge {order.id}: {len(seals.seals)} of {order.cases} cases are made; start a job that makes the "
            "others"
        )
    runs = run_all(folder / "set", tuple(sorted(seals.seals)), workers, progress)
    truths = load(Truths, folder / "truths.json")  # only now that all diagnoses are written
    store(score(truths, seals, runs, broken_seals(folder / "set", seals, truths)), folder / "score.json")
