"""Frames that are exchanged in an index are told as metadata, and no physics is made of them."""

from __future__ import annotations

from functools import cache

from lab.diagnose import diagnose
from lab.diagnose.metadata import misstatements
from lab.formats.recording_set import Manifest, RecordingSet
from tests.lab.diagnose.metadata.lies import told
from tests.lab.diagnose.on_blocks import former
from tests.lab.measure.test_exchanged_frames import swapped


@cache
def _recorded() -> RecordingSet:
    return former(12, kinds=("dark", "flat"))


def test_exchanged_frames_of_two_levels_are_told_and_nothing_else() -> None:
    """A converter whose codes are unequal explains such means, too."""
    recordings = _recorded()
    flats = recordings.captures("flat")
    one, other = (next(c.id for c in flats if c.exposure_s == t) for t in sorted({c.exposure_s for c in flats})[2:6:3])
    wrong = swapped(recordings, [one], [other])
    corrected, (found,) = misstatements(wrong, "left")
    assert set(found.captures) == {one, other}
    assert corrected.manifest == recordings.manifest
    result = diagnose(wrong)
    assert (result.verdict, result.effects, result.mismatches) == ("unexplained", (), ())
    (item,) = result.unexplained
    assert one in item.check
    assert other in item.check
    assert "exchange these frames" in item.check


def test_a_dark_and_a_flat_exchanged_are_told() -> None:
    recordings = _recorded()
    one, other = recordings.captures("dark")[1].id, recordings.captures("flat")[9].id
    (line,) = told(swapped(recordings, [one], [other]))
    assert one in line
    assert other in line


def test_darks_and_flats_stated_for_each_other_are_told() -> None:
    recordings = _recorded()
    content = recordings.manifest.model_dump(mode="json")
    for capture in content["captures"]:
        capture["kind"] = {"dark": "flat", "flat": "dark"}.get(capture["kind"], capture["kind"])
    corrected, (found,) = misstatements(recordings.under(Manifest.model_validate(content)), "left")
    assert "darks and flats are stated for each other" in found.check
    assert not corrected.captures()
