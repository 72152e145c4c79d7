"""What an operator's hand has changed and not put back: the lenses' aperture, the direction of a knife edge.

A process that is killed can't ask him, and a session that is given up never does. So a file lies in the data folder
from before he is asked until he has put it back: `by_hand/SESSION.json`. The next session on one of these instruments
asks for that first, whatever it captures; until then pages and commands say what stands otherwise, and how to put it
back. What a camera itself was set to is put back by its driver (`drivers.found_settings`).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from pydantic import ValidationError

from lab.capture.durable_files import write_durably
from lab.capture.station import Station
from lab.capture_kinds.base import Adjustment, usual_of
from lab.errors import InputError
from lab.formats.result_file import result_json
from sim.parameters import Frozen

FOLDER = "by_hand"


class HandChange(Frozen):
    """One thing that was changed by hand. `changes`: what, in words; `now`: the state that was asked for last;
    `is_confirmed`: the operator said that it is so; `back`: the usual state, `how`: what he has to do for it."""

    changes: str
    now: str
    is_confirmed: bool
    back: str
    how: str

    @property
    def words(self) -> str:
        """The change as a clause."""
        stands = f"stands at {self.now}" if self.is_confirmed else f"may stand at {self.now}, which was asked for"
        return f"{self.changes} {stands}: {self.how} ({self.back})"


class LeftByHand(Frozen):
    """What a session has changed by hand and not put back, on the instruments at these addresses."""

    session: str
    addresses: tuple[str, ...]
    changes: tuple[HandChange, ...]

    @property
    def words(self) -> str:
        """All changes, as a sentence without its full stop."""
        return f"changed by hand and not put back: {'; '.join(change.words for change in self.changes)}"


class ByHand:
    """What one session changes by hand on its station, on disk. `root`: the data folder."""

    def __init__(self, root: Path, session: str, station: Station) -> None:
        self._root, self._session, self._station = root, session, station

    def kind_of(self, name: str) -> type[Adjustment]:
        """Return the kind of an adjustment. Raises InputError where the station has none of that name."""
        target = self._station.targets.get(name)
        if not isinstance(target, Adjustment):
            raise InputError(f"station: [targets.{name!r}] isn't there, or nothing that a hand changes; add it")
        return type(target)

    def note_asked(self, name: str) -> None:
        """Note, before the operator is asked, that he may change something from now on."""
        self._note(name, is_confirmed=False)

    def note_done(self, name: str) -> None:
        """Note that the operator said so. Where it is the usual state, nothing is left changed of it."""
        self._note(name, is_confirmed=True)

    def _note(self, name: str, is_confirmed: bool) -> None:
        kind = self.kind_of(name)
        usual = usual_of(kind, self._station)
        left = left_by_session(self._root, self._session)
        others = () if left is None else tuple(change for change in left.changes if change.changes != kind.changes)
        if is_confirmed and name == usual:
            _keep(self._root, self._session, self._station.addresses, others)
            return
        how = self._station.targets[usual].instruction
        change = HandChange(changes=kind.changes, now=name, is_confirmed=is_confirmed, back=usual, how=how)
        _keep(self._root, self._session, self._station.addresses, (*others, change))

    def check_can_put_back(self) -> None:
        """Raise InputError where this station can't ask for what other sessions left changed to be put back."""
        for left in self.left_by_others():
            if self._station.lacks("stage") or any(change.back not in self._station.targets for change in left.changes):
                raise InputError(
                    f"session {left.session}: {left.words}; the station has no [stage] or target to ask for it: put it "
                    f"back, then say so with `calibench put-back {left.session}`"
                )

    def left_by_others(self) -> tuple[LeftByHand, ...]:
        """Return what other sessions left changed on these instruments."""
        return tuple(left for left in left_by_hand(self._root, self._station) if left.session != self._session)


def _keep(root: Path, session: str, addresses: Iterable[str], changes: tuple[HandChange, ...]) -> None:
    file = _file(root, session)
    if not changes:
        file.unlink(missing_ok=True)
        return
    left = LeftByHand(session=session, addresses=tuple(sorted(addresses)), changes=changes)
    write_durably(file, result_json(left).encode("utf-8"))


def _file(root: Path, session: str) -> Path:
    return root / FOLDER / f"{session}.json"


def left_by_session(root: Path, session: str) -> LeftByHand | None:
    """Return what a session left changed by hand; None: nothing."""
    return _read(_file(root, session))


def left_by_hand(root: Path, station: Station | None = None) -> tuple[LeftByHand, ...]:
    """Return what sessions left changed by hand, in the order of the sessions: on the instruments of `station`, or on
    all."""
    every = map(_read, sorted((root / FOLDER).glob("*.json")))
    there = (session for session in every if session is not None)  # None: put back meanwhile
    return tuple(session for session in there if station is None or station.addresses.intersection(session.addresses))


def _read(file: Path) -> LeftByHand | None:
    try:
        return LeftByHand.model_validate_json(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValidationError) as error:
        raise InputError(
            f"{file}: can't be read ({type(error).__name__}); put back what hands changed on the bench, then remove it"
        ) from error


def note_put_back(root: Path, session: str, changes: str | None = None) -> None:
    """Note that what a session left changed is put back: all, or the thing `changes`."""
    left = left_by_session(root, session)
    if left is not None:
        rest = tuple(change for change in left.changes if changes not in (None, change.changes))
        _keep(root, session, left.addresses, rest)
