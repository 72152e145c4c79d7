"""Dimmable lamps, on the simulators of others' servers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers.alpaca import AlpacaDevice
from drivers.contract.peer import Peer
from drivers.errors import InstrumentError, InUse
from drivers.found_settings import FoundSettings
from drivers.light_source.alpaca import AlpacaLamp
from drivers.light_source.base import SteppedLamp
from drivers.light_source.indi import IndiLamp
from mocks.peers import alpaca_lamp, indi_lamp
from tests.peers import missing

LAMPS: dict[type[SteppedLamp], Callable[[], Peer]] = {AlpacaLamp: alpaca_lamp, IndiLamp: indi_lamp}


@pytest.fixture(params=LAMPS, ids=lambda kind: kind.__name__)
def lamp(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[[], SteppedLamp]]:
    """Makes drivers of one lamp."""
    FoundSettings.keep_in(tmp_path / "instruments")
    try:
        peer = LAMPS[request.param]()
    except InstrumentError as error:
        missing(str(error))
    with peer:
        yield lambda: request.param(peer.address, **peer.settings)


def test_a_level_is_a_share_of_the_brightest(lamp: Callable[[], SteppedLamp]) -> None:
    with lamp() as driver:
        assert driver.channels() == ("light",)
        for level in (1.0, 0.2, 0.0):
            driver.set_level(level)
            assert driver.level() == pytest.approx(level, abs=0.5 / driver._steps)
        driver.set_level(0.2, "light")
        driver.stop()
        assert driver.level() == 0.0
        for wrong, message in (
            ((1.5,), "a level of 1.5 is outside 0..1"),
            ((0.5, "red"), "no channel 'red'; it has light"),
        ):
            with pytest.raises(InstrumentError, match=message):
                driver.set_level(*wrong)
        with pytest.raises(InUse, match="another driver on this computer"):
            lamp().connect()


def test_it_shines_on_as_it_was_found(lamp: Callable[[], SteppedLamp], tmp_path: Path) -> None:
    with lamp() as driver:
        driver._light(51)  # by another program, so to say
    with lamp() as driver:
        driver.set_level(1.0)
        (file,) = (tmp_path / "instruments").iterdir()
        kept = file.read_text()
    assert not (tmp_path / "instruments").exists()
    with lamp() as driver:
        assert driver._read() == 51
        driver._light(3)  # as a process left it that was killed
    file.parent.mkdir(parents=True)
    file.write_text(kept)
    with lamp() as driver:
        assert driver._read() == 51


def test_a_lamp_that_failed_or_is_none_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    FoundSettings.keep_in(tmp_path / "instruments")
    states = iter((1, 3, 5))
    told = {"connected": True, "maxbrightness": 100, "brightness": 50}
    monkeypatch.setattr(AlpacaDevice, "get", lambda self, name: told[name] if name in told else next(states))
    monkeypatch.setattr(AlpacaDevice, "put", lambda self, name, **given: None)
    monkeypatch.setattr(AlpacaDevice, "identity", lambda self: AlpacaLamp("h/0")._identity)
    driver = AlpacaLamp("127.0.0.1:11111/0")
    assert driver.level() == 0.5
    with pytest.raises(InstrumentError, match="the lamp says that it failed"):
        driver.level()
    driver.close()
    states = iter((0,))
    with pytest.raises(InstrumentError, match="has a cover, and no lamp; correct its number"):
        AlpacaLamp("127.0.0.1:11111/0").connect()
