"""Calibrations over the network: who certified what, and what is refused."""

from __future__ import annotations

from typing import Any

from tests.api.conftest import Running, until_state
from tests.lab.calibration.test_life import fitted

LIMITS = {"valid_days": 90, "limit": [{"figure": "noise read_noise_e", "good": [None, 2.5], "warn": [None, 3.0]}]}


def of_names(named: dict[str, Any]) -> dict[str, Any]:
    """What `/history` takes of an entry of `/figures`."""
    return {key: named[key] for key in ("camera", "figure", "place")}


def test_a_calibration_is_certified_and_its_history_is_told(running: Running) -> None:
    with running.client("operate") as operator, running.client("calibrate") as client:
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"]}
        session = operator.post("/api/v1/sessions", json=asked).json()["id"]
        until_state(client, session, "finished")
        ids = [running.store.add_result("fit", session, fitted(v).model_dump(mode="json")) for v in (2.0, 2.3, 3.5)]
        listed = client.get("/api/v1/calibrations", params={"limit": 2})
        assert [one["id"] for one in listed.json()] == ids[:0:-1] and listed.headers["x-total-count"] == "3"
        assert "next" in listed.headers["link"] and {one["state"] for one in listed.json()} == {"candidate"}
        first, second, third = (f"/api/v1/calibrations/{id}" for id in ids)
        assert "limits.toml" in client.post(f"{first}/certify", json={}).json()["detail"]
        refused = client.post(f"{third}/certify", json={"limits": LIMITS, "accept_warnings": True})
        assert refused.status_code == 422 and "is bad" in refused.json()["detail"]
        assert client.post(f"{first}/certify", json={"limits": {"limit": []}}).status_code == 422
        done = client.post(f"{first}/certify", json={"limits": LIMITS})
        assert done.status_code == 200 and done.json()["certified_by"] == "calibrate"
        assert client.post(f"{first}/certify", json={"limits": LIMITS}).status_code == 409
        assert client.get(first).json()["state"] == "certified"
        (running.store.root / "limits.toml").write_text('[[limit]]\nfigure = "noise read_noise_e"\ngood = [0.0, 2.2]\n')
        marks = {one["side"]: one["mark"] for one in client.get(second).json()["judgements"]}
        assert marks == {"left": "bad", "right": "bad"}
        names = [one for one in client.get("/api/v1/figures").json() if one["figure"] == "noise read_noise_e"]
        assert len(names) == 2
        found = client.get("/api/v1/history", params=of_names(names[0])).json()
        assert [point["mark"] for point in found["points"]] == ["good", "bad", "bad"]
        assert [point["drifted"] for point in found["points"]] == [False, True, True]
        assert client.get("/api/v1/history", params=of_names(names[0]) | {"figure": "x"}).status_code == 404


def test_a_session_demands_a_certified_calibration(running: Running) -> None:
    with running.client("operate") as client:
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"], "demands_certified": True}
        session = client.post("/api/v1/sessions", json=asked).json()
        assert session["demands_certified"]
        failed = until_state(client, session["id"], "failed")
        assert "demands a certified calibration" in failed["error"] and "calibrations certify" in failed["error"]
