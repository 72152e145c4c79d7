"""A kill -9 of the service in a sweep: its next start closes the shutter, tells why, and the session can go on."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from lab.bench_process import mock_bench
from lab.capture.store import Store
from tests.api.conftest import served, shutter_is_open, until, until_state


@pytest.fixture
def stations(tmp_path: Path) -> Iterator[Path]:
    """The station files' folder of a data folder, with a mock bench's in it."""
    folder = tmp_path / "data" / "stations"
    folder.mkdir(parents=True)
    with mock_bench([]) as file:
        shutil.copy(file, folder / "bench.toml")
        yield folder


def test_after_kill_9_of_the_service_the_shutter_is_closed_at_its_next_start(stations: Path) -> None:
    data = stations.parent
    with served(data) as (url, process, output):
        secret = re.findall(r"calibench_[A-Za-z0-9_-]{43}", output.read_text())[0]
        headers = {"Authorization": f"Bearer {secret}"}
        with httpx.Client(base_url=url, headers=headers, timeout=30.0) as client:
            asked = {"station": "bench", "quick": True, "sequences": ["flat"]}
            session_id = client.post("/api/v1/sessions", json=asked).json()["id"]
            until(client, f"/api/v1/sessions/{session_id}", lambda found: found["steps_done"] >= 3, 30.0)
        process.kill()
        process.wait(10.0)
    assert shutter_is_open(stations / "bench.toml")  # else this test shows nothing
    with served(data) as (url, process, output), httpx.Client(base_url=url, headers=headers, timeout=30.0) as client:
        found = until_state(client, session_id, "interrupted", patience_s=30.0)
        assert "kill -9" in found["error"] and "made safe" in found["error"]
        # Before the service was loaded, and before what it prints then.
        assert output.read_text().startswith(f"session {session_id}: its process ended without a word; its shutter was")
        assert not shutter_is_open(stations / "bench.toml")
        known = until(client, "/api/v1/stations/bench", lambda now: now["safety"] is not None)["safety"]
        assert (known["state"], known["shutter"]) == ("safe", "closed")
        assert client.post(f"/api/v1/sessions/{session_id}/resume").status_code == 202
        until_state(client, session_id, "finished", patience_s=60.0)
    store = Store(data)
    taken = store.captures(session_id)
    assert len({capture.name for capture in taken}) == len(taken) > 0
    store.close()
