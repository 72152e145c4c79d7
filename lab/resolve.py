"""Resolve what a diagnosis leaves in doubt: choose the next capture on a station, and keep a journal of it.

The choice ranks captures by expected information per second of lab time, single ones and pairs: a pair counts where
two captures tell together what neither tells alone. The journal lies in the session's folder. It is written before
anything moves and after every diagnosis, so that a process that dies in the middle loses nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.errors import InstrumentError
from lab.capture.blocking_calls import in_thread
from lab.capture.catalogue import StepTimes, estimate, step_times
from lab.capture.durable_files import write_durably
from lab.capture.session import CaptureSession
from lab.capture.station import drivers_of
from lab.diagnose.outcome.expected_information import Forecast, entropy, expected_information, settling_probability
from lab.diagnose.outcome.next_capture import Doubt, OpenCapture
from lab.diagnose.policy import DecisionPolicy
from lab.errors import DeviceError, InputError
from lab.formats.recording_set import RecordingSet, Snapshots, manifest_json
from lab.formats.result_file import read_result, result_json
from lab.formats.results import DiagnosisResult, Resolution, ResolveEnd, ResolveJournal, RivalOdds
from lab.inference.posterior import NAMED

if TYPE_CHECKING:
    from collections.abc import Callable

    from drivers.instrument import Identity, Instrument
    from lab.capture.station import Drivers, Station
    from lab.capture.store import Store
    from sim.camera import Side

#: The journal, in the session's folder.
JOURNAL = "resolve.json"
#: Captures that are taken for one session at most, where nobody says otherwise.
MOST_ROUNDS = 6
#: How long (s) a camera is waited for that is asked who it is.
IDENTITY_S = 60.0
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
    def forecasts(self) -> list[Forecast]:
        """What the rivals predict of the captures."""
        return [one.capture.forecast for one in (self.first, self.then) if one is not None]

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


def read_journal(folder: Path) -> ResolveJournal | None:
    """Return the journal in the folder of a session, or of a recording set that is resolved; None: it never was."""
    file = folder / JOURNAL
    return read_result(ResolveJournal, file) if file.is_file() else None


class Resolver:
    """The resolving of one session, or recording set, by captures of `station`. `journal` is what is on disk, in
    `folder`."""

    def __init__(
        self,
        store: Store,
        folder: Path,
        station: Station,
        limits: ResolveLimits,
        policy: DecisionPolicy | None = None,
    ) -> None:
        self._store, self._folder, self._station = store, folder, station
        self._policy, self._limits = policy or DecisionPolicy(), limits
        found = read_journal(folder) or ResolveJournal()
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
        station = self._station
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
        session = CaptureSession.start(self._store, self._station, plan, name=name).id
        step = Resolution(
            side=choice.doubt.side,
            rivals=odds_of(choice.doubt),
            capture=choice.first.capture.words,
            then="" if choice.then is None else choice.then.capture.words,
            information_nat=round(choice.information_nat, 4),
            settles=round(settling_probability(choice.forecasts, choice.doubt.odds, NAMED), 3),
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
        write_durably(self._folder / JOURNAL, result_json(self.journal).encode("utf-8"))


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


def resolving_folder(root: Path, recordings: RecordingSet) -> Path:
    """Return where the journal of a recording set's resolving lies in the data folder `root`. The same recordings have
    the same folder, wherever they lie."""
    key = sha256(manifest_json(recordings.manifest).encode("utf-8")).hexdigest()
    return root / "resolving" / key[:16]


def station_of(
    recordings: RecordingSet, station: Station, connect: Callable[[Station], Drivers] = drivers_of
) -> Station:
    """Return the station with the cameras of the recordings alone, after these were asked who they are. Nothing moves,
    and nothing is exposed.

    Raises InputError, one line, where it isn't the same cameras: one is lacking, its data sheet contradicts the
    recordings', it has another serial number, or one of the two doesn't say it. DeviceError where one doesn't answer.
    """
    for side in recordings.sides:
        if side not in station.cameras:
            raise InputError(
                f"{recordings.source}: has a {side} camera, and the station has none; name the station that made the "
                "recordings"
            )
        check_same_data_sheet(recordings, side, station)
        if not _serial_number(recordings.manifest.instruments, side):
            raise InputError(
                f"{recordings.source}: doesn't say the serial number of its {side} camera, so that nobody can tell "
                f"whether it is the station's; write it into the manifest as instruments.'camera {side}'.serial_number"
            )
    own = station.model_copy(update={"cameras": {side: station.cameras[side] for side in recordings.sides}})
    cameras = connect(own).cameras
    asked = {side: in_thread(partial(_identity, cameras[side])) for side in recordings.sides}
    for side, answer in asked.items():
        try:
            found = answer.result(IDENTITY_S)
        except TimeoutError:
            raise DeviceError(f"camera {side}: didn't say who it is within {IDENTITY_S:g} s; look after it") from None
        except InstrumentError as error:
            raise DeviceError(str(error)) from error
        _check_serial_number(recordings, side, found.serial_number)
    return own


def _identity(driver: Instrument) -> Identity:
    try:
        driver.connect()
        return driver.identity()
    finally:
        driver.close()


def check_same_cameras(recordings: RecordingSet, later: RecordingSet) -> None:
    """Raise InputError where later captures are of other cameras than the recordings that they are to be joined to."""
    for side in recordings.sides:
        _check_serial_number(recordings, side, _serial_number(later.manifest.instruments, side))


def check_same_data_sheet(recordings: RecordingSet, side: Side, station: Station) -> None:
    """Raise InputError where the recordings and the station file state different data of a camera."""
    stated = recordings.manifest.cameras[side].model_dump(exclude={"quantum_efficiency", "lens_file"})
    there = station.cameras[side].datasheet.model_dump()
    for key, value in stated.items():
        if None not in (value, there.get(key)) and value != there[key]:
            raise InputError(
                f"{recordings.source}: the {side} camera's data sheet says {key} = {value}, the station file "
                f"{there[key]}; name the station that made the recordings, or correct one of them"
            )


def _serial_number(instruments: Snapshots, side: Side) -> str:
    found = instruments.get(f"camera {side}")
    return "" if found is None else found.serial_number


def _check_serial_number(recordings: RecordingSet, side: Side, found: str) -> None:
    wanted = _serial_number(recordings.manifest.instruments, side)
    if not found:
        raise InputError(
            f"station: its {side} camera doesn't say a serial number; only {wanted} can settle a doubt here"
        )
    if wanted != found:
        raise InputError(
            f"{recordings.source}: was recorded with the {side} camera {wanted}, the station has {found}; "
            "connect that one, or name the station that made the recordings"
        )
