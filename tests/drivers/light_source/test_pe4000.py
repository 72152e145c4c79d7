"""A tunable light source: against the golden transcript, and against the mock on a real line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import Garbled, InstrumentError, NoAnswer
from drivers.found_settings import FoundSettings
from drivers.light_source.pe4000 import Pe4000
from mocks.pe4000 import LEDS, MockPe4000
from mocks.peers import LinePeer
from mocks.wire import Fault


@pytest.fixture(autouse=True)
def kept(tmp_path: Path) -> Path:
    FoundSettings.keep_in(tmp_path / "instruments")
    return tmp_path / "instruments"


@pytest.fixture
def peer() -> Iterator[LinePeer]:
    with LinePeer(MockPe4000, timeout_s=2.0) as found:
        yield found


def _mock(peer: LinePeer) -> MockPe4000:
    assert isinstance(peer.line.grammar, MockPe4000)
    return peer.line.grammar


def test_golden_transcript(scripted: Callable[[str], Any]) -> None:
    peer = scripted("pe4000-driver.txt")
    with Pe4000(peer.address) as lamp:
        assert (lamp.identity().model, len(lamp.channels())) == ("pE-4000", 15)
        assert lamp.level("365") == 0.5
        with pytest.raises(
            InstrumentError, match="385 nm shares channel A with 365 nm, which is lit at 50 %; set that"
        ):
            lamp.set_level(1.0, "385")
        lamp.set_level(0.25, "470")
        lamp.stop()
    assert peer.strange == []
    assert peer.requests[-1] == b"CSS?\r"


def test_every_led_is_lit_alone(peer: LinePeer) -> None:
    mock = _mock(peer)
    every = [nm for leds in LEDS.values() for nm in leds]
    with Pe4000(peer.address, **peer.settings) as lamp:
        assert lamp.channels() == tuple(map(str, every))
        for nm in every:
            lamp.set_level(0.37, str(nm))
            assert [one for one in every if mock.shines(one)] == [nm]
            assert (mock.shines(nm), lamp.level(str(nm))) == (0.37, 0.37)
            lamp.set_level(0.0, str(nm))
        lamp.set_level(1.0)  # the first
        lamp.set_level(0.5, "660")
        assert lamp.settings() == {"level_365_nm": 1.0, "level_500_nm": 0.0, "level_595_nm": 0.0, "level_660_nm": 0.5}
        lamp.stop()
        assert not any(map(mock.shines, every))
        for wrong in ("666", "A", ""):
            with pytest.raises(InstrumentError, match=f"no channel '{wrong}'; it has 365, 385"):
                lamp.set_level(0.5, wrong)


def test_it_is_left_as_it_was_found(peer: LinePeer, kept: Path) -> None:
    mock = _mock(peer)
    mock.state["A"], mock.loaded["A"] = ("S", "N", 80), 435
    found = dict(mock.state), dict(mock.loaded)
    lamp = Pe4000(peer.address, **peer.settings)
    lamp.set_level(0.0, "435")
    lamp.set_level(0.2, "405")
    (file,) = kept.iterdir()
    noted = file.read_text()
    lamp.close()
    assert ((mock.state, mock.loaded), kept.exists()) == (found, False)
    # As a process left it that was killed: another LED lit, and told on disk what there was.
    mock.state["A"], mock.loaded["A"] = ("S", "N", 20), 405
    file.parent.mkdir(parents=True)
    file.write_text(noted)
    with Pe4000(peer.address, **peer.settings) as lamp:
        assert lamp.level("435") == 0.8
    assert (mock.state, mock.loaded) == found


def test_an_led_that_never_arrives_and_one_that_stays_lit_are_told(peer: LinePeer) -> None:
    mock = _mock(peer)
    lamp = Pe4000(peer.address, **peer.settings, load_timeout_s=0.3)
    lamp.connect()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mock, "_end", list)  # it doesn't move
        with pytest.raises(NoAnswer, match=r"385 nm isn't loaded within 0\.3 s; listen"):
            lamp.set_level(0.5, "385")
    lamp.set_level(0.5, "365")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mock, "_set", lambda groups: [mock._css()])
        with pytest.raises(InstrumentError, match="channel A was set to AXF000 and reads SN050; check the lamp"):
            lamp.set_level(0.0, "365")
        with pytest.raises(InstrumentError, match="it may be lit still: switch it off by hand"):
            lamp.close()


@pytest.mark.parametrize(
    ("said", "message"),
    [
        (b"XMODEL=pE-300\r\n", "answered 'XMODEL' with 'pE-300'"),
        (b"CSS\r\n" * 60, "answered 'XMODEL' with 'CSS'; check that a pE-4000"),
    ],
)
def test_another_instrument_is_named(peer: LinePeer, said: bytes, message: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_mock(peer), "receive", lambda data: [said] if data == b"XMODEL\r" else [])
        with pytest.raises(Garbled, match=message):
            Pe4000(peer.address, **peer.settings).connect()


@pytest.mark.parametrize("kind", ["half", "drop", "wrong", "never"])
def test_a_fault_is_one_line_and_then_it_works_again(peer: LinePeer, kind: str) -> None:
    with Pe4000(peer.address, timeout_s=0.3) as lamp:
        for at in range(1, 7):
            peer.line.fail((Fault(kind, at),))
            try:
                lamp.set_level(0.5, "470")
            except InstrumentError as error:
                assert "\n" not in str(error)
            peer.line.fail(())
            lamp.set_level(0.0, "470")
            assert lamp.level("470") == _mock(peer).shines(470) == 0.0
