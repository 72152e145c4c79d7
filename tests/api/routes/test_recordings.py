"""Recording sets that are sent in, and what is refused."""

from __future__ import annotations

import copy
import errno
import io
import json
import os
import shutil
import socket
import stat
import tarfile
import threading
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import httpx
import numpy as np
import pytest
import tifffile

import lab.fit
from api.client import ServiceClient, ServiceProblem
from api.schemas import SentAs
from api.service import Limits
from api.unpacking import RESERVE_BYTES, TooMuch, unpack
from lab.errors import InputError
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
        assert client.get(path).json().items() >= {key: of for key, of in found.items() if key != "warnings"}.items()
        assert client.get("/api/v1/recordings").json() == [found]
        assert kept(running) == [found["id"]]
        job = client.post(f"{path}/jobs", json={"kind": "fit"})
        assert job.status_code == 202
        assert job.json()["recordings_id"] == found["id"] and job.json()["session_id"] is None
        until(client, job.headers["location"], lambda now: now["state"] == "done")
        for asked in ({"kind": "pipeline", "resolve": True}, {"kind": "pipeline", "station": "fakes"}):
            refused = client.post(f"{path}/jobs", json=asked)
            assert refused.status_code == 422 and "give both, or none" in refused.json()["detail"]


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


def written_below(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files that unpacking opens for writing; filled while it runs."""
    written: list[str] = []
    opened = Path.open

    def watched(self: Path, mode: str = "r", *more: Any, **options: Any) -> Any:
        if self.is_relative_to(folder) and mode == "xb":
            written.append(self.name)
        return opened(self, mode, *more, **options)

    monkeypatch.setattr(Path, "open", watched)
    return written


def compressed(method: int) -> Change:
    return lambda archive: archive.writestr("x.bin", b"x" * 5000, compress_type=method)


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        (lambda archive: archive.writestr("bomb.bin", b"\0" * 3_000_000), TooMuch, "1000000 at most"),
        (lambda archive: [archive.writestr(f"{n}", "") for n in range(60)] and None, TooMuch, "50 at most"),
        (lambda archive: archive.writestr("../evil.txt", "x"), InputError, "evil"),
        (link, InputError, "link"),
        (compressed(zipfile.ZIP_LZMA), InputError, "deflated"),
        (compressed(zipfile.ZIP_BZIP2), InputError, "deflated"),
    ],
)
def test_an_archive_is_checked_before_a_byte_of_it_is_written(
    tmp_path: Path, folder: Path, change: Change, error: type[Exception], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The offending member comes last, and none of those before it lands on the disk."""
    archive = tmp_path / "archive.zip"
    archive.write_bytes(packed(folder, change=change))
    written = written_below(tmp_path / "out", monkeypatch)
    with pytest.raises(error, match=said):
        unpack(archive, tmp_path / "out", 1_000_000, 50)
    assert written == [] and not (tmp_path / "out").exists()
    archive.write_bytes(packed(folder))
    unpack(archive, tmp_path / "out", 1_000_000, 50)
    assert written  # the check itself sees what is written


def test_an_archive_that_states_less_than_it_holds_is_refused(tmp_path: Path) -> None:
    """The size is stated twice, in the list and before the data; neither lets more out than the list says."""
    archive = tmp_path / "archive.zip"
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("a.bin", b"\0" * 3_000_000)
    lying = archive.read_bytes().replace((3_000_000).to_bytes(4, "little"), (1000).to_bytes(4, "little"))
    assert lying != archive.read_bytes()
    archive.write_bytes(lying)
    with pytest.raises(InputError, match="unpacked"):
        unpack(archive, tmp_path / "out", 1_000_000, 50)
    assert sum(file.stat().st_size for file in (tmp_path / "out").rglob("*")) <= 1000


def test_a_list_of_files_that_fills_the_memory_isnt_read(tmp_path: Path) -> None:
    archive = tmp_path / "archive.zip"
    with zipfile.ZipFile(archive, "w") as made:
        for number in range(300):
            made.writestr(f"{number:0200d}" * 30, "")  # 300 names of 6,000 bytes
    with pytest.raises(TooMuch, match="list of files"):
        unpack(archive, tmp_path / "out", 1_000_000, 50)


def test_members_that_share_their_bytes_count_each(tmp_path: Path) -> None:
    """The bomb of overlapping members: one compressed block, listed many times under other names."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("000.bin", b"\0" * 400_000)
        first = made.infolist()[0]
        for number in range(1, 40):
            again = copy.copy(first)
            again.filename = f"{number:03d}.bin"
            made.filelist.append(again)
            made.NameToInfo[again.filename] = again
        made._didModify = True  # type: ignore[attr-defined]
    archive = tmp_path / "archive.zip"
    archive.write_bytes(buffer.getvalue())
    assert archive.stat().st_size < 10_000
    with pytest.raises(TooMuch, match="16000000 bytes unpacked"):
        unpack(archive, tmp_path / "out", 1_000_000, 50)


def test_a_stated_size_beyond_the_cap_is_refused_before_it_is_sent(tmp_path: Path, folder: Path) -> None:
    with serving(tmp_path / "data", limits=Limits(upload_bytes=20_000)) as running:
        address = urlsplit(running.url)
        with socket.create_connection((address.hostname, address.port), timeout=10) as line:
            line.sendall(
                "POST /api/v1/recordings HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: "
                "application/zip\r\nContent-Length: 30000\r\n"
                f"Authorization: Bearer {running.keys['calibrate']}\r\n\r\nPK".encode()
            )
            assert line.recv(1000).startswith(b"HTTP/1.1 413")  # after two bytes of 30,000
        assert kept(running) == []


@pytest.mark.parametrize("path", ["recordings", "camera-models"])
def test_an_upload_that_breaks_off_leaves_nothing_and_is_no_defect(
    running: Running, path: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "api.errors")
    address = urlsplit(running.url)
    with socket.create_connection((address.hostname, address.port), timeout=10) as line:
        line.sendall(
            f"POST /api/v1/{path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/zip\r\nContent-Length: "
            "30000\r\n"
            f"Idempotency-Key: once\r\nAuthorization: Bearer {running.keys['calibrate']}\r\n\r\nPK".encode()
        )
    until = time.monotonic() + 30.0
    while not caplog.messages:
        assert time.monotonic() < until
        time.sleep(0.01)
    assert caplog.messages == [f"POST /api/v1/{path}: the client broke off"]
    assert kept(running) == [] and not (running.store.root / "cameras").exists()
    with running.client("calibrate") as client:  # and the key is free again
        headers = ZIP | {"Idempotency-Key": "once"}
        assert client.post(f"/api/v1/{path}", content=b"no archive", headers=headers).status_code == 422


def test_a_full_disk_is_said_and_captures_keep_their_room(
    running: Running, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(folder)
    with running.client("calibrate") as client:
        monkeypatch.setattr("api.upload.shutil.disk_usage", lambda _: usage._replace(free=RESERVE_BYTES + 100))
        response = send(client, packed(folder))
        assert response.status_code == 507 and "make room" in response.json()["detail"]
        monkeypatch.undo()

        def full(*_: object) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr("api.upload.recording.read", full)
        response = send(client, packed(folder))
        assert response.status_code == 507 and "full" in response.json()["detail"]
        monkeypatch.undo()
        assert kept(running) == []
        left = running.store.root / "recordings" / ".incoming-left"
        left.mkdir()
        os.utime(left, (0, 0))
        assert send(client, packed(folder)).status_code == 201 and not left.exists()


@pytest.mark.parametrize("path", ["../../registry.sqlite", "/etc/passwd", "frames/../../x", "C:/x", "..\\x"])
@pytest.mark.parametrize("key", ["frame", "lens_file", "quantum_efficiency"])
def test_a_manifest_names_files_of_its_own_folder_only(
    shared: Running, folder: Path, tmp_path: Path, key: str, path: str
) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    if key == "frame":
        manifest["captures"][0]["frame"] = path
    else:
        manifest["cameras"]["left"][key] = path if key == "lens_file" else {"Y": path}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with shared.client("calibrate") as client:
        response = send(client, packed(folder))
    detail = response.json()["detail"]
    assert response.status_code == 422 and ("folder" in detail or "rename" in detail)
    assert "root:" not in detail and str(shared.store.root) not in detail and "/etc" not in detail.replace(path, "")


def test_a_picture_that_is_larger_than_the_data_sheet_says_isnt_decoded(
    shared: Running, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tifffile.imwrite(folder / "frames" / "0.tif", np.zeros((4000, 4000), np.uint16), compression="zlib")
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["captures"][0]["frame"] = "frames/0.tif"
    (folder / "manifest.json").write_text(json.dumps(manifest))
    monkeypatch.setattr(tifffile.TiffPage, "asarray", lambda *_: pytest.fail("decoded"))
    with shared.client("calibrate") as client:
        response = send(client, packed(folder))
        assert response.status_code == 422 and "4000 x 4000" in response.json()["detail"]
        manifest["cameras"]["left"] |= {"rows": 60_000, "cols": 60_000}
        (folder / "manifest.json").write_text(json.dumps(manifest))
        response = send(client, packed(folder))
        assert response.status_code == 422 and "32768" in response.json()["detail"]


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


# --- listed, fetched, imported, deleted -------------------------------------------------------------------------------


def test_what_was_sent_in_is_fetched_again_and_deleted(
    running: Running, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = tmp_path / "sent.zip"
    archive.write_bytes(packed(folder, "my recordings/"))
    with ServiceClient(running.url, running.keys["calibrate"]) as client:
        first, second = client.send_recordings(archive), client.send_recordings(archive)
        assert [one.id for one in client.recordings()] == [second.id, first.id]
        assert len(client.request("GET", "/recordings", params={"limit": 1}).json()) == 1
        fetched = client.fetch_recordings(first.id, tmp_path / "fetched.zip")
        again = client.send_recordings(fetched)
        assert (again.name, again.captures) == ("two darks", 2)
        unpack(fetched, tmp_path / "fetched", 1 << 20, 100)
        for path in ("manifest.json", "frames/0.npy", "frames/1.npy"):
            assert (tmp_path / "fetched" / path).read_bytes() == (folder / path).read_bytes()
        begun, go_on = threading.Event(), threading.Event()

        def slow(*_: object) -> FitResult:
            begun.set()
            assert go_on.wait(30.0)
            return FitResult(source="sent", cameras={}, skipped=())

        monkeypatch.setattr(lab.fit, "fit_recording_set", slow)
        job = client.request("POST", f"/recordings/{first.id}/jobs", json={"kind": "fit"}).json()["id"]
        assert begun.wait(30.0)
        with pytest.raises(ServiceProblem, match=f"409: recordings {first.id}: job {job} .fit. is running"):
            client.delete_recordings(first.id)
        go_on.set()
        client.wait_job(job)
        client.delete_recordings(first.id)
        for method, path in (("GET", ""), ("DELETE", ""), ("GET", "/archive.zip")):
            with pytest.raises(ServiceProblem, match="404: no recordings"):
                client.request(method, f"/recordings/{first.id}{path}")
        assert client.job(job).state == "done"  # what was found stays
        assert [one.id for one in client.recordings()] == [again.id, second.id]
    assert kept(running) == sorted([again.id, second.id])
    with ServiceClient(running.url, running.keys["read"]) as client:
        with pytest.raises(ServiceProblem, match="403"):
            client.delete_recordings(second.id)
        with pytest.raises(ServiceProblem, match="422: after"):
            client.request("GET", "/recordings", params={"after": first.id})
        with pytest.raises(ServiceProblem, match="404: no recordings"):
            client.fetch_recordings(first.id, tmp_path / "none.zip")
    assert not list(tmp_path.glob("*none.zip*"))


def test_a_set_is_fetched_as_a_tar_and_sent_in_again(running: Running, folder: Path, tmp_path: Path) -> None:
    with ServiceClient(running.url, running.keys["calibrate"]) as client:
        (tmp_path / "set.zip").write_bytes(packed(folder))
        first = client.send_recordings(tmp_path / "set.zip")
        fetched = client.fetch_recordings(first.id, tmp_path / "set.tar")
        with tarfile.open(fetched, "r:") as tar:
            # The manifest comes last: what breaks off before has none.
            assert tar.getnames()[-1] == "manifest.json" and len(tar.getnames()) == 3
        again = client.send_recordings(fetched)
        assert again.model_dump(exclude={"id"}) == first.model_dump(exclude={"id"})
        a, b = (recording.read(running.store.root / "recordings" / one.id) for one in (first, again))
        for one, other in zip(a.captures(), b.captures(), strict=True):
            np.testing.assert_array_equal(a.frame(one), b.frame(other))
        with pytest.raises(ServiceProblem, match="422"):
            client.fetch_recordings(first.id, tmp_path / "set.rar")


@pytest.mark.parametrize("form", ["zip", "tar"])
def test_a_damaged_frame_breaks_the_archive_off(running: Running, folder: Path, tmp_path: Path, form: str) -> None:
    with running.client("calibrate") as client:
        sent = send(client, packed(folder)).json()["id"]
        (running.store.root / "recordings" / sent / "frames" / "1.npy").write_bytes(b"damaged")
        with pytest.raises(httpx.RemoteProtocolError):
            client.get(f"/api/v1/recordings/{sent}/archive.{form}")
        (running.store.root / "recordings" / sent / "frames" / "0.npy").unlink()
        refused = client.get(f"/api/v1/recordings/{sent}/archive.{form}")
        assert refused.status_code == 422 and "frames/0.npy" in refused.json()["detail"]


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """Two dark images with the index of a raw folder."""
    path = tmp_path / "foreign"
    path.mkdir()
    for n in range(2):
        assert cv2.imwrite(str(path / f"{n}.png"), np.full((6, 8), 60 + n, np.uint8))
    (path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 8\n')
    (path / "index.csv").write_text("frame,kind,exposure_s\n0.png,dark,0.1\n1.png,dark,0.1\n")
    return path


@pytest.mark.parametrize("top", ["", "their folder/"])
def test_another_format_becomes_a_recording_set(running: Running, foreign: Path, tmp_path: Path, top: str) -> None:
    archive = tmp_path / "sent.zip"
    archive.write_bytes(packed(foreign, top))
    with ServiceClient(running.url, running.keys["calibrate"]) as client:
        found = client.send_recordings(archive, SentAs(format="raw-folder", path=top.strip("/")))
        assert found.captures == 2 and found.cameras == ("left",)
        assert [one.id for one in client.recordings()] == [found.id]
        read = recording.read(running.store.root / "recordings" / found.id)
        assert [int(read.frame(capture).max()) for capture in read.captures()] == [60, 61]


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ({}, "manifest.json"),
        ({"format": "nothing"}, "format"),
        ({"square_mm": 2}, "square_mm: a recording set states it itself"),
        ({"format": "raw-folder", "dots": "9x9"}, "format raw-folder doesn't take dots"),
        ({"format": "raw-folder", "checkerboard": "9"}, "checkerboard 9: give ROWSxCOLS"),
        ({"format": "raw-folder", "checkerboard": "6x9"}, "state square_mm"),
        ({"format": "raw-folder", "square_mm": -1}, "square_mm"),
        ({"format": "raw-folder", "path": "../0.png"}, "isn't a path inside it"),
        ({"format": "raw-folder", "path": "elsewhere"}, "isn't in the archive"),
        ({"format": "slanted-edge"}, "path: a recording of the format slanted-edge is one file"),
        ({"format": "slanted-edge", "path": "0.png", "camera": "/etc/passwd"}, "isn't a path inside it"),
        ({"format": "slanted-edge", "path": "0.png", "exposure_s": 0.1, "transfer": "linear"}, "0.png"),
        ({"format": "emva1288"}, "no EMVA 1288 descriptor"),
        ({"wrong": 1}, "wrong"),
    ],
)
def test_what_no_format_is_is_refused_and_nothing_is_kept(
    shared: Running, foreign: Path, params: dict[str, Any], said: str
) -> None:
    before = kept(shared)
    with shared.client("calibrate") as client:
        refused = client.post("/api/v1/recordings", content=packed(foreign), headers=ZIP, params=params)
    detail = refused.json()["detail"]
    assert refused.status_code == 422 and said in detail, detail
    assert "--" not in detail and str(shared.store.root) not in detail and "incoming" not in detail
    assert kept(shared) == before


def test_an_index_leads_out_of_no_folder(running: Running, foreign: Path) -> None:
    outside = running.store.root / "secret.npy"
    np.save(outside, np.zeros((6, 8), np.uint16))
    for frame in (str(outside), "../../../secret.npy"):
        (foreign / "index.csv").write_text(f"frame,kind,exposure_s\n{frame},dark,0.1\n")
        with running.client("calibrate") as client:
            for format in ("raw-folder", "fits"):
                refused = client.post(
                    "/api/v1/recordings", content=packed(foreign), headers=ZIP, params={"format": format}
                )
                assert refused.status_code == 422 and "folder" in refused.json()["detail"]
    assert kept(running) == []


def test_an_upload_is_carried_out_once(running: Running, folder: Path) -> None:
    with running.client("calibrate") as client:
        sent = [send(client, packed(folder), ZIP | {"Idempotency-Key": "once"}) for _ in range(2)]
        assert sent[0].json() == sent[1].json() and sent[1].headers["idempotency-replayed"] == "true"
        other = send(client, b"something else", ZIP | {"Idempotency-Key": "once"})
        assert other.status_code == 422 and "another request" in other.json()["detail"]
        # What was refused doesn't use the key up.
        assert send(client, b"no archive", ZIP | {"Idempotency-Key": "twice"}).status_code == 422
        assert send(client, packed(folder), ZIP | {"Idempotency-Key": "twice"}).status_code == 201
    assert len(kept(running)) == 2


def test_the_captures_of_a_set_are_looked_at(running: Running, folder: Path, little_set: RecordingSet) -> None:
    """Numbered from 1 in the manifest's order; each frame is the one that was sent."""
    with running.client("calibrate") as client:
        here = send(client, packed(folder)).headers["location"]
        detail = client.get(here).json()
        assert detail["counts"] == [{"kind": "dark", "side": "left", "captures": 2}] and detail["results"] == {}
        captures = client.get(f"{here}/captures").json()
        assert [(one["id"], one["name"], one["exposure_s"]) for one in captures] == [(1, "d0", 0.1), (2, "d1", 0.1)]
        newest = client.get(f"{here}/captures", params={"order": "newest", "limit": 1})
        assert [one["id"] for one in newest.json()] == [2] and newest.headers["x-total-count"] == "2"
        assert [one["id"] for one in client.get(f"{here}/captures?order=newest&after=2").json()] == [1]
        assert client.get(f"{here}/captures?side=right").json() == []
        for number, capture in enumerate(little_set.captures(), start=1):
            sent = np.load(io.BytesIO(client.get(f"{here}/captures/{number}/frame.npy").content))
            assert np.array_equal(sent, little_set.frame(capture))
        (channel,) = client.get(f"{here}/captures/2/figures").json()["channels"]
        assert channel["mean_dn"] == pytest.approx(little_set.frame(little_set.captures()[1]).mean())
        assert client.get(f"{here}/captures/1/preview.webp").content[8:12] == b"WEBP"
        assert client.get(f"{here}/captures/3").status_code == 404
        assert client.get(f"{here}/figures").status_code == 409
        job = client.post(f"{here}/jobs", json={"kind": "fit"}).json()
        id = here.rpartition("/")[2]
        assert [one["id"] for one in client.get("/api/v1/jobs", params={"recordings_id": id}).json()] == [job["id"]]
        assert client.get("/api/v1/jobs", params={"session_id": "nothing"}).json() == []
        assert client.get("/api/v1/jobs", params={"session_id": "x", "recordings_id": id}).status_code == 422
        until(client, f"/api/v1/jobs/{job['id']}", lambda one: one["state"] in ("done", "failed"), 60.0)
