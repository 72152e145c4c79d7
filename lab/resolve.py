"""Resolve what a diagnosis leaves in doubt: choose the next capture on a station, and keep a journal of it.

The choice ranks captures by expected information per second of lab time, single ones and pairs: a pair counts where
two captures tell together what neither tells alone. The journal lies in the session's folder. It is written before
anything moves and after every diagnosis, so that a process that dies in the middle loses nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

from lab.capture.catalogue import StepTimes, estimate, step_times
from lab.capture.durable_files import write_durably
from lab.capture.session import CaptureSession
from lab.diagnose.outcome.expected_information import entropy, expected_information
from lab.diagnose.outcome.next_capture import Doubt, OpenCapture
from lab.diagnose.policy import DecisionPolicy
from lab.errors import InputError
from lab.formats.result_file import read_result, result_json
from lab.formats.results import DiagnosisResult, Resolution, ResolveEnd, ResolveJournal, RivalOdds

if TYPE_CHECKING:
    from lab.capture.station import Station
    from lab.capture.store import Store
    from sim.camera import Side

#: The journal, in the session's folder.
JOURNAL = "resolve.json"
#: Captures that are taken for one session at most, where nobody says otherwise.
MOST_ROUNDS = 6
#: Captures of which pairs are formed: the best by information per second, and the best by information.
PAIRED = 12


@dataclass(frozen=True)
class ResolveLimits:
    """How far resolving may go.

    minutes : lab time that all its captures may take, min; None: as long as it takes
    rounds : how many captures are taken at most
    """

    minutes: float | None = None
    rounds: int = MOST_ROUNDS

    def __post_init__(self) -> None:
        if self.minutes is not None and not (math.isfinite(self.minutes) and self.minutes > 0.0):
            raise InputError(
                f"resolve minutes: {self.minutes:g} isn't above 0; give the lab time that captures may take, in minutes"
            )
        if self.rounds < 1:
            raise InputError(
                f"resolve rounds: {self.rounds} is below 1; give how many captures may be taken, or leave it out"
            )


def resolve_limits(asked: bool, minutes: float | None = None, rounds: int | None = None) -> ResolveLimits | None:
    """Return the limits that a command or a request states; None where resolving isn't asked for. Raises InputError for
    limits that can't be kept, and for limits without `asked`."""
    if not asked:
        if minutes is not None or rounds is not None:
            raise InputError("resolve minutes, resolve rounds: go with resolve; ask for it, or leave them out")
        return None
    return ResolveLimits(minutes, MOST_ROUNDS if rounds is None else rounds)


# --- the choice -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Option:
    """A capture that the station can take, and the lab time (s) that it takes there."""

    capture: OpenCapture
    expected_s: float


@dataclass(frozen=True)
class Choice:
    """The capture to take next. `then`: the one that is planned after it, which tells only together with it; None: it
    tells alone. `information_nat`: of both."""

    doubt: Doubt
    first: Option
    then: Option | None
    information_nat: float

    @property
    def rate(self) -> float:
        """Expected information per second of lab time, nat/s."""
        seconds = self.first.expected_s + (0.0 if self.then is None else self.then.expected_s)
        return self.information_nat / max(seconds, 1e-9)


def choose(doubt: Doubt, options: Sequence[Option], policy: DecisionPolicy, left_s: float = math.inf) -> Choice | None:
    """Return the best capture, or the better one of the best pair, that fits into `left_s`; None where no single one
    and no pair tells `resolve_least_share` of the doubt."""
    least = policy.resolve_least_share * entropy(doubt.odds)
    told = [(option, expected_information([option.capture.forecast], doubt.odds)) for option in options]
    single = [Choice(doubt, option, None, nat) for option, nat in told if option.expected_s <= left_s]
    ranked = sorted(single, key=lambda one: -one.rate)
    paired = {
        id(one): one for one in (*ranked[:PAIRED], *sorted(single, key=lambda one: -one.information_nat)[:PAIRED])
    }
    plans = list(single)
    for one, other in combinations(sorted(paired.values(), key=lambda one: -one.rate), 2):
        if one.first.expected_s + other.first.expected_s <= left_s:
            both = [one.first.capture.forecast, other.first.capture.forecast]
            plans.append(Choice(doubt, one.first, other.first, expected_information(both, doubt.odds)))
    worth = [plan for plan in plans if plan.information_nat >= least]
    return max(worth, key=lambda plan: plan.rate, default=None)


# --- the journal ------------------------------------------------------------------------------------------------------


def read_journal(store: Store, session: str) -> ResolveJournal | None:
    """Return the journal of a session's resolving; None where it was never resolved."""
    file = store.folder(session) / JOURNAL
    return read_result(ResolveJournal, file) if file.is_file() else None


class Resolver:
    """The resolving of one session. `journal` is what is on disk."""

    def __init__(self, store: Store, session: str, limits: ResolveLimits, policy: DecisionPolicy | None = None) -> None:
        self._store, self._session, self._policy = store, session, policy or DecisionPolicy()
        self._limits = limits
        found = read_journal(store, session) or ResolveJournal()
        self.journal = found.model_copy(
            update={"budget_min": limits.minutes, "most_rounds": limits.rounds, "end": None}
        )

    @property
    def spent_s(self) -> float:
        """Lab time that the captures have taken, s."""
        return sum(self._store.lab_time_s(step.session) for step in self.journal.resolutions)

    def next(self, result: DiagnosisResult, doubts: Sequence[Doubt]) -> Choice | None:
        """Return the next capture; None at the end, which the journal then tells."""
        if not doubts:
            if result.verdict in ("explained", "no_mismatch"):
                self._ended("settled", "no rivals are left")
                return None
            left = "nothing is judged" if result.verdict == "nothing_judged" else "no rivals are left, but a mismatch"
            self._ended("this station can't", _and_then(left, result))
            return None
        station = self._store.station(self._session)
        times = step_times(self._store, station)
        taken = {(step.side, step.capture) for step in self.journal.resolutions}
        left_s = math.inf if self._limits.minutes is None else 60.0 * self._limits.minutes - self.spent_s
        best, dear, lacking = [], [], []
        for doubt in doubts:
            options, lacks = _priced(doubt, station, times, taken)
            lacking += [(doubt, *one) for one in lacks]
            best.append(choose(doubt, options, self._policy, left_s))
            dear.append(choose(doubt, options, self._policy))
        found = max((one for one in best if one is not None), key=lambda one: one.rate, default=None)
        if found is not None and len(self.journal.resolutions) < self._limits.rounds:
            return found
        rivals = "; ".join(" from ".join(doubt.rivals) for doubt in doubts)
        wanted = found or max((one for one in dear if one is not None), key=lambda one: one.rate, default=None)
        if wanted is not None:
            minutes = wanted.first.expected_s / 60.0
            words = f"{wanted.first.capture.words} would go on telling {rivals}, in {minutes:.2g} min"
            taken_too = f"{len(self.journal.resolutions)} captures were taken of {self._limits.rounds}"
            spent = f"{self.spent_s / 60.0:.2g} of {self._limits.minutes or math.inf:g} min are spent"
            self._ended("budget spent", f"{taken_too if found else spent}; {words}")
        else:
            self._ended("this station can't", f"to tell {rivals}, {self._needed(lacking, result)}")
        return None

    def _needed(self, lacking: Sequence[tuple[Doubt, OpenCapture, str]], result: DiagnosisResult) -> str:
        """Return the capture that would tell most of those that the station lacks something for, and what that is."""
        told = [
            (expected_information([capture.forecast], doubt.odds) / entropy(doubt.odds), capture.words, lacks)
            for doubt, capture, lacks in lacking
        ]
        share, words, lacks = max(told, default=(0.0, "", ""))
        if share >= self._policy.resolve_least_share:
            return f"you need {words}: {lacks}"
        return _and_then("no capture that can be predicted is enough", result)

    def begin(self, choice: Choice, result: DiagnosisResult, name: str) -> str:
        """Register the session of a choice and note it in the journal; nothing moves yet. Returns its id."""
        plan = choice.first.capture.plan
        assert plan is not None  # else it is no option
        station = self._store.station(self._session)
        session = CaptureSession.start(self._store, station, plan, name=name).id
        step = Resolution(
            side=choice.doubt.side,
            rivals=odds_of(choice.doubt),
            capture=choice.first.capture.words,
            then="" if choice.then is None else choice.then.capture.words,
            information_nat=round(choice.information_nat, 4),
            expected_s=round(choice.first.expected_s, 1),
            session=session,
            verdict_before=result.verdict,
            effects_before=result.effects,
        )
        self._keep(resolutions=(*self.journal.resolutions, step))
        return session

    def note(self, result: DiagnosisResult, doubts: Sequence[Doubt]) -> None:
        """Note what a diagnosis with all captures of the journal says."""
        steps = [
            step
            if step.rivals_after is not None
            else step.model_copy(
                update={
                    "spent_s": round(self._store.lab_time_s(step.session), 1),
                    "rivals_after": _odds_on(step.side, result, doubts),
                }
            )
            for step in self.journal.resolutions
        ]
        if steps:
            self._keep(resolutions=tuple(steps))

    def _ended(self, state: ResolveEnd, reason: str) -> None:
        self._keep(end=state, reason=reason)

    def _keep(self, **changes: object) -> None:
        self.journal = self.journal.model_copy(update=changes)
        write_durably(self._store.folder(self._session) / JOURNAL, result_json(self.journal).encode("utf-8"))


def _and_then(what: str, result: DiagnosisResult) -> str:
    """Return a reason with what the diagnosis proposes, as one line without its full stop."""
    return what if result.next_capture is None else f"{what}; {result.next_capture.rstrip('.')}"


def odds_of(doubt: Doubt) -> tuple[RivalOdds, ...]:
    """Return the rivals of a doubt with their probabilities."""
    return tuple(
        RivalOdds(name=name, probability=round(p, 4)) for name, p in zip(doubt.rivals, doubt.odds, strict=True)
    )


def _odds_on(side: Side, result: DiagnosisResult, doubts: Sequence[Doubt]) -> tuple[RivalOdds, ...]:
    """Return the rivals that are left on a side; where none are, the names that stand there."""
    left = next((doubt for doubt in doubts if doubt.side == side), None)
    if left is not None:
        return odds_of(left)
    return tuple(
        RivalOdds(name=effect.name, probability=round(effect.probability, 4))
        for effect in result.effects
        if side in effect.sides
    )


def _priced(
    doubt: Doubt, station: Station, times: StepTimes, taken: set[tuple[Side, str]]
) -> tuple[list[Option], list[tuple[OpenCapture, str]]]:
    """Return the captures of a doubt that the station can take, with their lab time; and the others, with what is
    lacking."""
    options, lacking = [], []
    for capture in doubt.captures:
        if (doubt.side, capture.words) in taken:
            continue
        if capture.plan is None:
            lacking.append((capture, capture.needs))
            continue
        try:
            options.append(Option(capture, estimate(capture.plan, station, times).estimated_s))
        except InputError as error:
            lacking.append((capture, str(error)))
    return options, lacking
