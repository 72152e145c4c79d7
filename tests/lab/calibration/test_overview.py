"""Sessions at a glance: their figures, verdicts, tags, and the search."""

from __future__ import annotations

import pytest

from lab.calibration.overview import overviews, sessions_of_verdict, tags_of
from lab.capture.store import Store
from tests.lab.calibration.test_life import STATION, calibrated, fitted


def session_of(store: Store, calibration: str) -> str:
    return store.result(calibration).source


@pytest.mark.parametrize(
    ("notes", "tags"),
    [
        ("after the move #nightly #lens-b", ("nightly", "lens-b")),
        ("#a #b #a", ("a", "b")),
        ("C#4 and # alone", ()),
        ("", ()),
    ],
)
def test_tags_are_words_of_the_notes(notes: str, tags: tuple[str, ...]) -> None:
    assert tags_of(notes) == tags


def test_an_overview_has_the_newest_fit_and_diagnosis(store: Store) -> None:
    first = session_of(store, calibrated(store, 2.0))
    store.add_result("diagnose", first, {"verdict": "unexplained"})
    store.add_result("diagnose", first, {"verdict": "explained"})
    newest = store.add_result("fit", first, fitted(2.2).model_dump(mode="json"))
    second = session_of(store, calibrated(store, 3.0))
    third = store.create_session(STATION, (), name="nothing yet")
    found = overviews(store, [first, second, third])
    one = found[first]
    assert one.calibration_id == newest and one.read_noise_e == {"left": 2.2, "right": 2.2}
    assert one.mtf50_cy_per_px == {"left": 0.25} and one.verdict == "explained"
    assert one.cameras == {"left": "m c L1", "right": "m c R1"} and one.station == (STATION.name or "")
    assert found[second].verdict is None and found[third].read_noise_e == {}
    assert sessions_of_verdict(store, "explained") == [first]
    assert sessions_of_verdict(store, "unexplained") == []


def test_sessions_are_searched_by_every_word(store: Store) -> None:
    """In name, notes, and what the instruments reported; signs of SQL are plain letters."""
    one, other = (
        session_of(store, calibrated(store, 2.0, {"left": serial, "right": "R"})) for serial in ("AB12", "CD34")
    )
    store.describe_session(one, name="after the move", notes="50% of it #night_ly")
    store.describe_session(other, notes="500 of it #nightXly")

    def ids(text: str) -> list[str]:
        found = [info.id for info in store.sessions(search=text)]
        assert store.count_sessions(search=text) == len(found)
        return found

    assert ids("move 50%") == ids("ab12") == ids("#night_ly") == [one]
    assert ids("of it") == [other, one] and ids("move cd34") == [] and ids(other) == [other]
    assert [info.id for info in store.sessions(search="of it", only=[one])] == [one]
    assert store.session(other).name == "" and store.session(one).name == "after the move"
