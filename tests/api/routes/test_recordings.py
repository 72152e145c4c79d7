"""Recording sets that are sent in, and what is refused."""

from __future__ import annotations

import io
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

import lab.fit
from api.service import Limits
from lab.formats import recording_set as recording
from lab.formats.recording_set import RecordingSet
from lab.formats.results import FitResult
from tests.api.conftest import Running, serving, until

Change = Callable[[zipfile.ZipFile], None]
ZIP = {"Content-Type": "application/zip"}


def packed(folder: Path, top: str = "", change: Change | None = None) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, top + str(file.relative_to(folder)))
        if change:
            change(archive)
    return buffer.getvalue()


@pytest.fixture
def folder(tmp_path: Path, little_set: RecordingSet) -> Path:
    return recording.write(little_set, tmp_path / "set")


def send(client: httpx.Client, content: Any, headers: dict[str, str] | None = None) -> httpx.Response:
    return client.post("/api/v1/recordings", content=content, headers=headers or ZIP)


def kept(running: Running) -> list[str]:
    place = running.store.root / "recordings"
    return sorted(entry.name for entry in place.iterdir()) if place.exists() else []


@pytest.mark.parametrize("top", ["", "my recordings/"])
def test_recordings_are_taken_in_and_worked_on(
    running: Running, folder: Path, top: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lab.fit, "fit_recording_set", lambda *_: FitResult(source="sent", cameras={}, skipped=()))
    with running.client("calibrate") as client:
        response = send(client, packed(folder, top))
        assert response.status_code == 201, response.text
        found = response.json()
        assert found["name"] == "two darks" and found["captures"] == 2 and found["cameras"] == ["left"]
        path = response.headers["location"]
        assert client.get(path).json() == found
        assert client.get("/api/v1/recordings").json() == [found]
        assert kept(running) == [found["id"]]
        job = client.post(f"{path}/jobs", json={"kind": "fit"})
        assert job.status_code == 202
        assert job.json()["recordings_id"] == found["id"] and job.json()["session_id"] is None
        until(client, job.headers["location"], lambda now: now["state"] == "done")
        for asked in ({"kind": "pipeline", "resolve": True}, {"kind": "pipeline", "station": "fakes"}):
            refused = client.post(f"{path}/jobs", json=asked)
            assert refused.status_code == 422 and "leave" in refused.json()["detail"]


def test_a_streamed_archive_is_taken_in(running: Running, folder: Path) -> None:
    content = packed(folder)
    with running.client("calibrate") as client:
        assert send(client, (content[at : at + 500] for at in range(0, len(content), 500))).status_code == 201


def link(archive: zipfile.ZipFile) -> None:
    member = zipfile.ZipInfo("frames/link.npy")
    member.external_attr = (stat.S_IFLNK | 0o777) << 16
    archive.writestr(member, "/etc/passwd")


def twice(archive: zipfile.ZipFile) -> None:
    archive.writestr("a.txt", "1")
    member = zipfile.ZipInfo("./a.txt")
    archive.writestr(member, "2")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda archive: archive.writestr("../evil.txt", "x"), "evil"),
        (lambda archive: archive.writestr("frames/../../evil.txt", "x"), "evil"),
        (lambda archive: archive.writestr("/tmp/evil.txt", "x"), "evil"),
        (lambda archive: archive.writestr("..\\evil.txt", "x"), "evil"),
        (lambda archive: archive.writestr("C:/evil.txt", "x"), "evil"),
        (lambda archive: archive.writestr("a/" * 20 + "evil.txt", "x"), "isn't a path"),
        (lambda archive: archive.writestr("x" * 300, "x"), "isn't a path"),
        (lambda archive: archive.writestr("manifest.json/x", "x"), "unpacked"),
        (link, "link"),
        (twice, "once"),
    ],
)
def test_archives_that_reach_beyond_their_folder_are_refused(
    running: Running, folder: Path, tmp_path: Path, change: Change, said: str
) -> None:
    with running.client("calibrate") as client:
        response = send(client, packed(folder, change=change))
    assert response.status_code == 422
    assert said in response.json()["detail"] and "\n" not in response.json()["detail"]
    assert str(tmp_path) not in response.json()["detail"]
    assert kept(running) == []
    assert not list(tmp_path.rglob("*evil*")) and not Path("/tmp/evil.txt").exists()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder: (folder / "manifest.json").unlink(), "manifest.json"),
        (lambda folder: (folder / "manifest.json").write_text("{"), "manifest.json"),
        (lambda folder: next((folder / "frames").iterdir()).write_bytes(b"short"), "damaged"),
    ],
)
def test_what_is_no_recording_set_is_not_kept(
    running: Running, folder: Path, tmp_path: Path, spoil: Callable[[Path], Any], said: str
) -> None:
    spoil(folder)
    with running.client("calibrate") as client:
        response = send(client, packed(folder))
    assert response.status_code == 422 and said in response.json()["detail"]
    assert str(tmp_path) not in response.json()["detail"]
    assert kept(running) == []


@pytest.mark.parametrize("content", [b"", b"PK", b"nonsense" * 100])
def test_what_is_no_archive_is_refused(running: Running, content: bytes) -> None:
    with running.client("calibrate") as client:
        assert send(client, content).status_code == 422
        assert send(client, content, {"Content-Type": "text/html"}).status_code == 422
    assert kept(running) == []


def test_a_damaged_archive_is_refused_wherever_it_is_damaged(running: Running, folder: Path) -> None:
    whole = packed(folder)
    with running.client("calibrate") as client:
        for at in range(0, len(whole), len(whole) // 40):
            spoilt = bytearray(whole)
            spoilt[at] ^= 0xFF
            assert send(client, bytes(spoilt)).status_code in (201, 422)  # some bytes say nothing, a date for one
    assert not [name for name in kept(running) if name.startswith(".")]


def test_caps_hold(tmp_path: Path, folder: Path) -> None:
    whole = packed(folder)
    bomb = packed(folder, change=lambda archive: archive.writestr("bomb.bin", b"\0" * 3_000_000))
    many = packed(folder, change=lambda archive: [archive.writestr(f"{n}", "") for n in range(60)] and None)
    limits = Limits(upload_bytes=20_000, unpacked_bytes=1_000_000, unpacked_files=50)
    assert len(bomb) < limits.upload_bytes and len(many) < limits.upload_bytes
    with serving(tmp_path / "data", limits=limits) as running, running.client("calibrate") as client:
        assert send(client, whole).status_code == 201
        assert send(client, whole + b"x" * 20_000).status_code == 413
        assert send(client, (b"x" * 1000 for _ in range(30))).status_code == 413
        for archive, said in ((bomb, "unpacked"), (many, "files")):
            response = send(client, archive)
            assert response.status_code == 413 and said in response.json()["detail"]
        assert len(kept(running)) == 1


def test_unknown_recordings_are_404(shared: Running) -> None:
    with shared.client("calibrate") as client:
        assert client.get("/api/v1/recordings/" + "0" * 16).status_code == 404
        assert client.post("/api/v1/recordings/" + "0" * 16 + "/jobs", json={"kind": "fit"}).status_code == 404
