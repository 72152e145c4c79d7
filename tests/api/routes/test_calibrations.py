"""Calibrations over the network: who certified what, and what is refused."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from tests.api.conftest import Running, until_state
from tests.api.routes.test_findings import diagnosis
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


def test_a_certificate_states_what_was_certified_and_is_revoked(running: Running) -> None:
    """Its hash is of what it states: it stays when it is revoked, and shows a changed fit."""
    with running.client("operate") as operator, running.client("calibrate") as client:
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"], "name": "<b>nightly</b>"}
        session = operator.post("/api/v1/sessions", json=asked).json()["id"]
        until_state(client, session, "finished")
        id = running.store.add_result("fit", session, fitted(2.0).model_dump(mode="json"))
        here = f"/api/v1/calibrations/{id}"
        assert client.get(f"{here}/certificate").status_code == 409
        assert client.post(f"{here}/revoke", json={"why": "x"}).status_code == 409
        assert "isn't diagnosed" in client.get(here).json()["warnings"][0]
        running.store.add_result("diagnose", session, diagnosis().model_dump(mode="json"))
        assert "rejects the model (explained)" in client.get(here).json()["warnings"][0]
        assert client.post(f"{here}/certify", json={"limits": LIMITS}).status_code == 200
        content = client.get(f"{here}/certificate.json").json()
        page = client.get(f"{here}/certificate").text
        for said in (
            "2.000 ± 0.010 e", "≤ 2.5", "≤ 3", "by calibrate", "SN-1", "rejects the model", "system gain K",
            content["sha256"], "&lt;b&gt;nightly", "valid until",
        ):  # fmt: skip
            assert said in page, said
        signed = {"stated": content["stated"], "fit_sha256": content["fit_sha256"]}
        text = json.dumps(signed, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        assert hashlib.sha256(text.encode()).hexdigest() == content["sha256"]
        assert operator.post(f"{here}/revoke", json={"why": "x"}).status_code == 403
        assert client.post(f"{here}/revoke", json={"why": ""}).status_code == 422
        revoked = client.post(f"{here}/revoke", json={"why": "the lens was touched"}).json()
        assert revoked["state"] == "revoked" and revoked["revoked_by"] == "calibrate"
        assert client.post(f"{here}/revoke", json={"why": "again"}).status_code == 409
        page = client.get(f"{here}/certificate").text
        assert "the lens was touched" in page and content["sha256"] in page
        assert client.get(f"{here}/certificate.json").json() == content
        demands = {"station": "fakes", "quick": True, "sequences": ["dark"], "demands_certified": True}
        until_state(client, operator.post("/api/v1/sessions", json=demands).json()["id"], "failed")


def test_drift_figures_and_drafted_limits_are_told(running: Running) -> None:
    with running.client("operate") as operator, running.client("calibrate") as client:
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"]}
        for value in (2.0, 2.01, 2.4):
            session = operator.post("/api/v1/sessions", json=asked).json()["id"]
            until_state(client, session, "finished")
            id = running.store.add_result("fit", session, fitted(value).model_dump(mode="json"))
        camera = next(one["camera"] for one in client.get("/api/v1/figures").json() if "left" in one["camera"])
        board = client.get("/api/v1/drift", params={"camera": camera}).json()
        noise = next(row for row in board["rows"] if row["figure"] == "noise read_noise_e")
        assert [cell["drifted"] for cell in noise["cells"]] == [False, False, True] and len(board["columns"]) == 3
        newest = client.get("/api/v1/drift", params={"camera": camera, "newest": 1}).json()
        assert [column["calibration_id"] for column in newest["columns"]] == [id]
        assert client.get("/api/v1/drift", params={"camera": "nobody"}).status_code == 404
        (running.store.root / "limits.toml").write_text('[[limit]]\nfigure = "noise read_noise_e"\ngood = [0.0, 2.2]\n')
        for path in (f"/api/v1/calibrations/{id}", f"/api/v1/sessions/{session}"):
            told = {(one["figure"], one["side"]): one for one in client.get(f"{path}/figures").json()}
            assert (
                told["noise read_noise_e", "left"]["mark"] == "bad"
                and told["noise read_noise_e", "left"]["value"] == 2.4
            )
            assert told["mtf edge-1 G mtf50_cy_per_px", "left"]["mark"] is None
        drafted = client.get(f"/api/v1/calibrations/{id}/drafted-limits").json()
        assert {one["title"] for one in drafted["limits"]} >= {"temporal dark noise (read noise)", "MTF50, every edge"}
        # What was drafted is taken as it was answered; without a limit, it isn't.
        refused = client.post(f"/api/v1/calibrations/{id}/certify", json={"limits": drafted | {"limits": []}})
        assert refused.status_code == 422 and "limit" in refused.json()["detail"]
        done = client.post(f"/api/v1/calibrations/{id}/certify", json={"limits": drafted | {"valid_days": 30}})
        assert done.status_code == 200, done.text
        stated = client.get(f"/api/v1/calibrations/{id}").json()["limits"]
        assert stated["valid_days"] == 30 and len(stated["limit"]) == len(drafted["limits"])
        other = operator.post("/api/v1/sessions", json=asked).json()["id"]
        until_state(client, other, "finished")
        assert client.get(f"/api/v1/sessions/{other}/figures").status_code == 409
