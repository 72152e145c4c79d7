"""Every driver that has an entry point keeps its family's contract, with its mock or its library's own camera at the
other end."""

from __future__ import annotations

import pytest

from drivers.contract.checks import check_driver
from drivers.contract.peer import peers
from drivers.errors import InstrumentError
from drivers.registry import drivers
from tests.peers import missing

#: Each call on a silent GigE camera takes the library seconds.
SLOW = {("camera", "aravis")}
#: At their other end stands another program or a maker's library. The camera of gphoto2 serves one test at a time: its
#: own tests are `extra`, this one isn't.
OTHERS = {("camera", name) for name in ("alpaca", "basler", "gentl", "indi", "micromanager")} | {
    ("light_source", name) for name in ("alpaca", "indi")
}


def _marks(driver: tuple[str, str]) -> list[pytest.MarkDecorator]:
    if driver in SLOW:
        return [pytest.mark.slow]
    return [pytest.mark.extra] if driver in OTHERS else []


@pytest.mark.parametrize(
    ("family", "name"),
    [pytest.param(*one, marks=_marks(one)) for one in drivers()],
    ids=lambda part: part,
)
def test_it_keeps_the_contract(family: str, name: str) -> None:
    if (family, name) == ("spectroradiometer", "usb2000plus"):
        pytest.skip("another name of ocean_optics")
    point = peers().get(f"{family}.{name}")
    assert point is not None, "a driver without a peer is a driver without a check: add one under calibench.peers"
    try:
        peer = point.load()()
    except InstrumentError as error:
        missing(str(error))  # a library that isn't installed here
    with peer:
        found = list(check_driver(family, name, peer))
    assert [(outcome.asks, outcome.why) for outcome in found if outcome.ended == "not met"] == []
    assert sum(outcome.ended == "met" for outcome in found) >= (5 if peer.can_fail else 4)
