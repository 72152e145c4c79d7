"""The held-out predictive check: captures that no fit has used, against the prediction of the whole table.

Every third capture in time within a setting is held out, by its id, before anything is fitted."""

from __future__ import annotations

from lab.formats.recording_set import RecordingSet
from sim.camera import Side

#: Keys of a capture that don't belong to its setting.
_NOT_OF_SETTING = {"id", "frame", "time", "temperature_c", "dummy_frames"}
#: Of the captures of a setting, in time: the last of every so many is held out, so that among those that are used some
#: follow another of their own setting.
ONE_IN = 3


def held_out_ids(recordings: RecordingSet, side: Side) -> frozenset[str]:
    """Return the ids of one side's captures that are held out: every third in time of each setting with three or more.

    A setting is all that a capture states but its time, its temperature and its frame. Where captures have no time, the
    manifest's order stands for it."""
    settings: dict[str, list[tuple[float, int, str]]] = {}
    for order, capture in enumerate(recordings.captures(side=side)):
        setting = capture.model_dump_json(exclude=_NOT_OF_SETTING)
        time = 0.0 if capture.time is None else capture.time.timestamp()
        settings.setdefault(setting, []).append((time, order, capture.id))
    return frozenset(
        name
        for group in settings.values()
        if len(group) >= ONE_IN
        for k, (_, _, name) in enumerate(sorted(group))
        if k % ONE_IN == ONE_IN - 1
    )
