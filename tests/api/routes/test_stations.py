"""A station's devices over REST: where they are, what drives them, whether they work."""

from __future__ import annotations

import re
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from api.checks import DeviceChecks
from api.client import ServiceClient, ServiceProblem
from api.schemas import PlanAsked
from drivers import discovery
from drivers.contract.scripted import ScriptedPeer
from drivers.discovery import Found
from drivers.errors import Disconnected
from lab.capture.by_hand import ByHand, left_by_hand
from lab.capture.station import read_station
from lab.capture_kinds.base import SEQUENCES
from tests.api.conftest import Running, until, until_state
from tests.lab.fake_bench import Bench, FakeMonochromator

GOLDEN = Path(__file__).parents[2] / "wire"


def client_of(running: Running, scope: str = "operate") -> ServiceClient:
    return ServiceClient(running.url, running.keys[scope])


def test_devices_are_those_of_the_station_file(shared: Running) -> None:
    with client_of(shared, "read") as client:
        assert client.station("fakes") == client.stations()[0]
        devices = client.devices("fakes")
        assert [one.name for one in devices] == [
            "monochromator",
            "spectroradiometer",
            "stage",
            "cameras.left",
            "cameras.right",
        ]
        assert [one.driver for one in devices][2:4] == ["stage.fake", "camera.fake"]
        assert {(one.state, one.used_by, one.transcript) for one in devices} == {("unknown", None, None)}
        assert client.device("fakes", "cameras.left") == devices[3]


def test_what_is_connected_is_what_the_command_line_finds(shared: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    there = [
        Found("usb://4711", "Basler acA (2676:ba02) 4711", "camera", "u3v"),
        Found("/dev/ttyUSB0", "serial port: FT232R"),
    ]
    monkeypatch.setattr(discovery, "find_all", lambda: iter(there))
    with client_of(shared) as client:
        told = [(one.address, one.what, one.driver) for one in client.connected()]
        assert told == [(found.address, found.what, found.driver) for found in there]

        def broken() -> list[Found]:
            raise Disconnected("USB: gone; plug it in again")

        monkeypatch.setattr(discovery, "find_all", broken)
        with pytest.raises(ServiceProblem, match="503: USB: gone; plug it in again"):
            client.connected()


def test_a_check_says_who_it_is_and_leaves_it_safe(running: Running) -> None:
    running.bench.opened = True
    with client_of(running) as client:
        found = client.check_device("fakes", "monochromator")
        assert (found.state, found.identity) == ("works", "fake monochromator SN-1")
        assert found.words == "works, and is in its safe state"
        assert found.checked is not None
        assert not running.bench.opened
        assert client.check_device("fakes", "cameras.left").state == "works"
        running.bench.unplugged.add("camera left")
        broken = client.check_device("fakes", "cameras.left")
        assert broken.state == "fails"
        assert broken.words == "camera left at here: the line is gone; plug it in again"
        assert [one.state for one in client.devices("fakes")] == ["works", "unknown", "unknown", "fails", "unknown"]


def test_every_device_of_a_station_is_checked_and_that_is_kept(running: Running) -> None:
    """One after the other; the next service knows how it went."""
    with client_of(running) as client:
        assert {one.state for one in client.start_checks("fakes")} <= {"checking", "works", "fails"}
        with running.client() as looking:
            until(looking, "/api/v1/stations/fakes/devices", lambda of: all(one["checked"] for one in of), 60.0)  # type: ignore[attr-defined]
        checked = client.devices("fakes")
        assert {one.name: one.state for one in checked} == {
            "monochromator": "works", "spectroradiometer": "fails", "stage": "works",
            "cameras.left": "works", "cameras.right": "works",
        }  # fmt: skip
        # Its shutter was asked, and the station says so; what only measures may fail.
        with running.client() as looking:
            until(looking, "/api/v1/stations", lambda of: of[0]["safety"] is not None)  # type: ignore[index]
            safety = looking.get("/api/v1/stations").json()[0]["safety"]
        assert (safety["state"], safety["shutter"]) == ("safe", "closed")
        later = DeviceChecks(running.app.state.service.live, running.bench.drivers, running.store.root / "transcripts")
        kept = {one.name: later.latest("fakes", one.name) for one in checked}
        assert {name: (of.state, of.ended) for name, of in kept.items() if of} == {
            one.name: (one.state, one.checked) for one in checked
        }
        assert later.latest("elsewhere", "stage") is None


def test_nothing_else_uses_the_instruments_during_a_check(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, may_end = threading.Event(), threading.Event()

    def slowly(self: FakeMonochromator) -> None:
        begun.set()
        assert may_end.wait(30)

    monkeypatch.setattr(FakeMonochromator, "connect", slowly)
    with client_of(running) as client:
        assert client.start_check("fakes", "monochromator").state == "checking"
        assert begun.wait(30)
        for refused in (
            lambda: client.capture("fakes", quick=True, sequences=("dark",)),
            lambda: client.start_check("fakes", "stage"),
        ):
            with pytest.raises(ServiceProblem, match="one of these instruments is being checked") as conflict:
                refused()
            assert conflict.value.status == 409
        may_end.set()
        monkeypatch.undo()
        until = time.monotonic() + 30.0
        while client.device("fakes", "monochromator").state == "checking":
            assert time.monotonic() < until
        assert client.capture("fakes", quick=True, sequences=("dark",)).state == "finished"  # at once


def test_no_check_while_a_session_runs(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, may_end = threading.Event(), threading.Event()
    check = Bench.check
    monkeypatch.setattr(Bench, "check", lambda *asked: (begun.set(), may_end.wait(30), check(*asked)))
    with client_of(running, "admin") as client:
        started = client.http.post("/sessions", json={"station": "fakes", "quick": True, "sequences": ["dark"]})
        assert started.status_code == 201
        assert begun.wait(30)
        busy = client.device("fakes", "stage")
        assert (busy.state, busy.used_by) == ("in use", started.json()["id"])
        with pytest.raises(ServiceProblem, match=r"409: session .* runs on these instruments"):
            client.start_check("fakes", "stage")
        may_end.set()
        assert client.wait_session(started.json()["id"]).state == "finished"


def test_a_transcript_is_kept_on_request(running: Running) -> None:
    peer = ScriptedPeer((GOLDEN / "cornerstone260-driver.txt").read_text(encoding="ascii"))
    station = running.store.root / "stations" / "fakes.toml"
    table = re.sub(
        r'driver = "fake"\naddress = "monochromator"',
        f'driver = "cornerstone260"\naddress = "{peer.address}"\ntimeout_s = 0.3',
        station.read_text(),
    )
    (station.parent / "wired.toml").write_text(table)
    try:
        with client_of(running) as client:
            with pytest.raises(ServiceProblem, match="404: no transcript of monochromator is kept; check it with"):
                client.transcript("wired", "monochromator")
            found = client.check_device("wired", "monochromator", transcript=True)
            assert found.transcript == "/api/v1/stations/wired/devices/monochromator/transcript"
            assert client.transcript("wired", "monochromator").startswith("> ")
    finally:
        peer.close()


@pytest.mark.parametrize(
    ("path", "status", "said"),
    [
        ("/stations/nowhere", 404, "no station 'nowhere'"),
        ("/stations/..%2fstations/devices", 404, "there is no such path"),
        ("/stations/broken/devices", 422, "TOML"),
        ("/stations/fakes/devices/display", 404, "station 'fakes' has no display; it has monochromator"),
        ("/stations/fakes/devices/cameras.front", 404, "has no cameras.front"),
        ("/stations/fakes/devices/Stage!", 404, "among the devices"),
    ],
)
def test_missing_stations_and_devices_are_refused_in_one_line(
    shared: Running, path: str, status: int, said: str
) -> None:
    (shared.store.root / "stations" / "broken.toml").write_text("name = ")
    try:
        with shared.client("read") as client:
            response = client.get(f"/api/v1{path}")
    finally:
        (shared.store.root / "stations" / "broken.toml").unlink()
    assert response.status_code == status
    assert said in response.json()["detail"] and "\n" not in response.json()["detail"]


# --- the catalogue ----------------------------------------------------------------------------------------------------


def test_the_catalogue_is_told(shared: Running) -> None:
    with shared.client("read") as client:
        listed = client.get("/api/v1/sequences").json()
        assert [one["name"] for one in listed] == list(SEQUENCES)
        assert client.get("/api/v1/sequences/dark").json() == listed[0]
        assert client.get("/api/v1/sequences/magic").status_code == 404


def test_a_session_takes_what_was_estimated(running: Running) -> None:
    asked = {"quick": True, "sequences": ["dark"], "parameters": {"dark": {"exposures_s": [0.001, 0.002], "frames": 3}}}
    with running.client("operate") as client:
        told = client.post("/api/v1/stations/fakes/estimate", json=asked).json()
        assert (told["steps"], told["captures"]) == (6, 12)
        assert not told["sequences"][0]["learned"]
        assert told["sequences"][0]["parameters"] == {
            "exposures_s": [0.001, 0.002], "frames": 3, "sensor_c": None
        }  # fmt: skip
        session = client.post("/api/v1/sessions", json=asked | {"station": "fakes"}).json()
        assert until_state(client, session["id"], "finished")["captures"] == [
            {"kind": "dark", "side": side, "captures": 6} for side in ("left", "right")
        ]
        assert client.post("/api/v1/stations/fakes/estimate", json=asked).json()["sequences"][0]["learned"]


@pytest.mark.parametrize(
    ("parameters", "named"),
    [
        ({"dark": {"frames": 0}}, "dark.frames"),
        ({"dark": {"magic": 1}}, "dark.magic"),
        ({"dark": {"frames": "many"}}, "parameters.dark.frames"),
        ({"narrowband": {"step_nm": 5}}, "parameters: narrowband"),  # which isn't among the sequences
        ({"magic": {}}, "parameters.magic"),
    ],
)
def test_wrong_parameters_start_nothing(shared: Running, parameters: dict[str, Any], named: str) -> None:
    asked = {"sequences": ["dark"], "parameters": parameters}
    with shared.client("operate") as client:
        before = client.get("/api/v1/sessions").json()
        for path, more in (("stations/fakes/estimate", {}), ("sessions", {"station": "fakes"})):
            refused = client.post(f"/api/v1/{path}", json=asked | more)
            assert refused.status_code == 422 and refused.json()["detail"].startswith(named), refused.text
        assert client.get("/api/v1/sessions").json() == before


def test_the_typed_client_estimates(shared: Running) -> None:
    with client_of(shared, "read") as client:
        assert [one.name for one in client.sequences()] == list(SEQUENCES)
        found = client.estimate("fakes", PlanAsked(quick=True))
        assert [one.name for one in found.sequences] == list(client.station("fakes").sequences)
        with pytest.raises(ServiceProblem, match="no station 'none'"):
            client.estimate("none")


# --- by hand ----------------------------------------------------------------------------------------------------------


def test_what_was_left_changed_by_hand_is_told_until_it_is_put_back(running: Running) -> None:
    station = running.store.root / "stations" / "fakes.toml"
    stops = "".join(f'\n[targets."f/{n}"]\nkind = "aperture"\nf_number = {n}\n' for n in ("4.0", "8.0"))
    station.write_text(station.read_text().replace("rows =", "f_number = 4.0, rows =") + stops)
    by_hand = ByHand(running.store.root, "20260101-000000-abcdef", read_station(station))
    with running.client("operate") as client:
        assert client.get("/api/v1/stations/fakes").json()["left_by_hand"] == []
        by_hand.note_asked("f/8.0")
        by_hand.note_done("f/8.0")
        (left,) = client.get("/api/v1/stations/fakes").json()["left_by_hand"]
        assert left["session"] == "20260101-000000-abcdef"
        assert "stands at f/8.0" in left["words"] and "to f/4" in left["words"]
        answer = client.post("/api/v1/stations/fakes/put-back")
        assert answer.status_code == 200 and answer.json()["left_by_hand"] == []
    assert left_by_hand(running.store.root) == ()
