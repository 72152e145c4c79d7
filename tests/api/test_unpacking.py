"""A .tar is unpacked under the same caps as a .zip, and what it states is checked before a byte is written."""

from __future__ import annotations

import gzip
import io
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from api.client import ServiceClient, ServiceProblem
from api.unpacking import TooMuch, unpack
from lab.errors import InputError
from lab.formats import recording_set as recording
from lab.formats.recording_set import RecordingSet
from tests.api.conftest import Running

Change = Callable[[tarfile.TarFile], None]
MOST_BYTES, MOST_FILES = 1_000_000, 50


def member(name: str, kind: bytes = tarfile.REGTYPE, link: str = "", size: int = 0) -> tarfile.TarInfo:
    found = tarfile.TarInfo(name)
    found.type, found.linkname, found.size = kind, link, size
    return found


def packed(folder: Path, to: Path, top: str = "", change: Change | None = None) -> Path:
    """The folder as `tar` packs it, by the ending of `to`."""
    mode = {".tar": "w:", ".gz": "w:gz", ".tgz": "w:gz"}[to.suffix]
    with tarfile.open(to, mode) as archive:  # type: ignore[call-overload]
        archive.add(folder, top or ".")
        if change:
            change(archive)
    return to


@pytest.fixture
def folder(tmp_path: Path, little_set: RecordingSet) -> Path:
    return recording.write(little_set, tmp_path / "set")


@pytest.mark.parametrize(("name", "top"), [("set.tar", ""), ("set.tar.gz", "my recordings"), ("set.tgz", "")])
def test_recordings_are_sent_in_as_a_tar(running: Running, folder: Path, tmp_path: Path, name: str, top: str) -> None:
    with ServiceClient(running.url, running.keys["calibrate"]) as client:
        found = client.send_recordings(packed(folder, tmp_path / name, top))
        assert found.captures == 2 and found.name == "two darks"
        # What comes back is what was sent.
        again = client.fetch_recordings(found.id, tmp_path / "again.zip")
        assert client.send_recordings(again).captures == 2


def hard_link(archive: tarfile.TarFile) -> None:
    archive.addfile(member("frames/link.npy", tarfile.LNKTYPE, "manifest.json"))


def soft_link(archive: tarfile.TarFile) -> None:
    archive.addfile(member("frames/link.npy", tarfile.SYMTYPE, "/etc/passwd"))


def link_and_through_it(archive: tarfile.TarFile) -> None:
    archive.addfile(member("out", tarfile.SYMTYPE, "/tmp"))
    archive.addfile(member("out/evil.txt", size=1), io.BytesIO(b"x"))


def sparse(archive: tarfile.TarFile) -> None:
    found = member("sparse.npy")
    found.pax_headers = {"GNU.sparse.map": "0,1", "GNU.sparse.size": "900000", "GNU.sparse.numblocks": "1"}
    archive.addfile(found)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda archive: archive.addfile(member("../evil.txt")), "evil"),
        (lambda archive: archive.addfile(member("frames/../../evil.txt")), "evil"),
        (lambda archive: archive.addfile(member("/tmp/evil.txt")), "evil"),
        (lambda archive: archive.addfile(member("a/" * 20 + "evil.txt")), "isn't a path"),
        (lambda archive: archive.addfile(member("x" * 300)), "isn't a path"),
        (lambda archive: archive.addfile(member("manifest.json")), "once"),
        (lambda archive: archive.addfile(member("manifest.json/x")), "can't be unpacked"),
        (lambda archive: archive.addfile(member("null", tarfile.CHRTYPE)), "device"),
        (lambda archive: archive.addfile(member("pipe", tarfile.FIFOTYPE)), "device"),
        (hard_link, "link"),
        (soft_link, "link"),
        (link_and_through_it, "'out' is a link"),
        (sparse, "pack plain files only"),
    ],
)
def test_what_reaches_beyond_the_folder_is_refused(folder: Path, tmp_path: Path, change: Change, said: str) -> None:
    archive = packed(folder, tmp_path / "set.tar", change=change)
    with pytest.raises(InputError, match=said) as refused:
        unpack(archive, tmp_path / "out", MOST_BYTES, MOST_FILES)
    assert str(tmp_path) not in str(refused.value)
    assert not list(tmp_path.rglob("*evil*")) and not Path("/tmp/evil.txt").exists()


def test_nothing_is_written_before_all_headers_are_checked(folder: Path, tmp_path: Path) -> None:
    for change in (soft_link, lambda archive: archive.addfile(member("../evil.txt"))):
        with pytest.raises(InputError):
            unpack(packed(folder, tmp_path / "set.tar", change=change), tmp_path / "out", MOST_BYTES, MOST_FILES)
        assert not (tmp_path / "out").exists()


def test_caps_hold_for_what_is_stated_and_for_what_comes(tmp_path: Path) -> None:
    many = tmp_path / "many.tar"
    with tarfile.open(many, "w") as made:
        for number in range(MOST_FILES + 1):
            made.addfile(member(f"{number}.npy"))
    with pytest.raises(TooMuch, match="50 at most"):
        unpack(many, tmp_path / "out", MOST_BYTES, MOST_FILES)
    # A header that states more than there is, and a stream of zeros that unpacks to a thousand times its size.
    header = member("large.npy", size=20 * MOST_BYTES).tobuf()
    (tmp_path / "stated.tar").write_bytes(header + bytes(1024))
    (tmp_path / "bomb.tar.gz").write_bytes(gzip.compress(header + bytes(20 * MOST_BYTES)))
    for name in ("stated.tar", "bomb.tar.gz"):
        with pytest.raises(TooMuch, match="bytes unpacked"):
            unpack(tmp_path / name, tmp_path / "out", MOST_BYTES, MOST_FILES)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", [tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.GNUTYPE_LONGNAME])
def test_a_header_that_fills_the_memory_isnt_read(tmp_path: Path, kind: bytes) -> None:
    archive = tmp_path / "set.tar.gz"
    archive.write_bytes(gzip.compress(member("x", kind, size=100 << 20).tobuf() + bytes(1 << 20)))
    with pytest.raises(TooMuch, match="list of files"):
        unpack(archive, tmp_path / "out", 1 << 30, MOST_FILES)


def test_a_negative_size_ends(tmp_path: Path) -> None:
    """It would lead back to the same header for ever."""
    raw = bytearray(member("a.npy").tobuf(tarfile.GNU_FORMAT))
    raw[124:136] = (-1024 & (1 << 96) - 1).to_bytes(12, "big")  # base 256, negative
    raw[148:156] = b" " * 8
    raw[148:156] = f"{sum(raw):06o}\0 ".encode()
    archive = tmp_path / "set.tar"
    archive.write_bytes(bytes(raw) + bytes(1024))
    with pytest.raises(InputError, match="pack plain files only"):
        unpack(archive, tmp_path / "out", MOST_BYTES, MOST_FILES)


@pytest.mark.parametrize("name", ["set.tar", "set.tar.gz"])
def test_an_archive_that_broke_off_is_refused(running: Running, folder: Path, tmp_path: Path, name: str) -> None:
    archive = packed(folder, tmp_path / name)
    content = archive.read_bytes()
    with ServiceClient(running.url, running.keys["calibrate"]) as client:
        for end in (3, 700, len(content) // 2):
            archive.write_bytes(content[:end])
            with pytest.raises(ServiceProblem) as refused:
                client.send_recordings(archive)
            assert refused.value.status == 422, end
        assert list(client.recordings()) == []


# --- archives as operating systems make them --------------------------------------------------------------------------


def zipped(to: Path, files: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(to, "w", compression) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return to


def frames_of(rng: np.random.Generator, shape: tuple[int, int], number: int) -> dict[str, bytes]:
    """Dark frames with an index and a camera, as a person keeps them."""
    files, index = {"camera.toml": b'cfa = "MONO"\nbit_depth = 12\n'}, ["frame,kind,exposure_s"]
    for k in range(number):
        buffer = io.BytesIO()
        np.save(buffer, np.rint(rng.normal(100, 3, shape)).astype(np.uint16))
        files[f"dark_{k}.npy"] = buffer.getvalue()
        index.append(f"dark_{k}.npy,dark,{0.01 * (k + 1):g}")
    files["index.csv"] = "\n".join(index).encode()
    return files


ADDED = {"__MACOSX/set/._dark_0.npy": b"\0\5\x16\7", "set/.DS_Store": b"\0\0\0\1Bud1", "set/Thumbs.db": b"\xd0\xcf"}


@pytest.mark.parametrize("shape", [(24, 32), (40, 16), (9, 50)])
@pytest.mark.parametrize(
    ("name", "change", "remark"),
    [
        ("windows", lambda files: {f"set\\{name}": one for name, one in files.items()}, "backslashes"),
        ("deep", lambda files: {f"a\\b\\{name}": one for name, one in files.items()}, "backslashes"),
        ("mac", lambda files: {f"set/{name}": one for name, one in files.items()} | ADDED, "3 files that an operating"),
        (
            "capitals",
            lambda files: {name.upper() if name.endswith("npy") else name: one for name, one in files.items()},
            "dark_0.npy is taken to be DARK_0.NPY",
        ),
        ("plain", lambda files: files, None),
    ],
)
def test_archives_of_all_systems_are_taken_and_what_was_changed_is_told(
    shared: Running, tmp_path: Path, name: str, change: Any, remark: str | None, shape: tuple[int, int]
) -> None:
    files = frames_of(np.random.default_rng(shape[0]), shape, 3)
    archive = zipped(tmp_path / f"{name}.zip", change(files))
    query = {"format": "raw-folder"} | ({"path": "a/b"} if name == "deep" else {})
    with shared.client("calibrate") as client:
        headers = {"Content-Type": "application/zip"}
        answer = client.post("/api/v1/recordings", params=query, content=archive.read_bytes(), headers=headers)
        assert answer.status_code == 201 and answer.json()["captures"] == 3, answer.text
        told = [line for line in answer.json()["warnings"] if "archive: " in line or "taken to be" in line]
        assert len(told) == (remark is not None) and (remark is None or remark in told[0])
        id = answer.json()["id"]
        stored = client.get(f"/api/v1/recordings/{id}/captures").json()
        fetched = [np.load(io.BytesIO(client.get(one["frame"]).content)) for one in stored]
        expected = [np.load(io.BytesIO(files[f"dark_{k}.npy"])) for k in range(3)]
        assert all(np.array_equal(a, b) for a, b in zip(fetched, expected, strict=True))


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"..\\..\\evil.txt": b"x"}, "leads out of the archive's folder"),
        ({"set\\..\\..\\evil.txt": b"x", "set\\a": b""}, "leads out of the archive's folder"),
        ({"\\evil.txt": b"x"}, "it is absolute"),
        ({"C:\\evil.txt": b"x"}, "it is absolute"),
        ({"a/b.npy": b"x", "a\\c.npy": b"x"}, "it has a backslash"),
        ({"a/b\x1b[2J.npy": b"x"}, "it has a control character"),
        ({"__MACOSX/../../evil.txt": b"x"}, "leads out of the archive's folder"),
    ],
)
def test_no_separator_leads_out_of_the_folder(tmp_path: Path, files: dict[str, bytes], said: str) -> None:
    with pytest.raises(InputError) as caught:
        unpack(zipped(tmp_path / "a.zip", files), tmp_path / "set", MOST_BYTES, MOST_FILES)
    assert said in str(caught.value) and "pack the files" in str(caught.value) and "\x1b" not in str(caught.value)
    assert not (tmp_path / "set").exists() and not (tmp_path / "evil.txt").exists()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (lambda file: zipped(file, {"a": bytes(99)}, zipfile.ZIP_LZMA).read_bytes(), "compressed by lzma, neither"),
        (lambda file: zipped(file, {"a": bytes(99)}, zipfile.ZIP_BZIP2).read_bytes(), "compressed by bzip2, neither"),
        (lambda file: zipped(file, {"a": bytes(9999)}).read_bytes()[:-40], "it is cut off: the list of files"),
        (lambda file: gzip.compress(tar_of(99))[:-30], "it is cut off before its end"),
        (lambda file: tar_of(2000)[:1024], "it is cut off before its end"),
        (lambda file: b"7z\xbc\xaf\x27\x1c" + bytes(99), "it is a 7-Zip archive; send a .zip"),
        (lambda file: b"\xfd7zXZ\0" + bytes(99), "it is compressed by xz; send a .zip"),
    ],
)
def test_the_cause_and_the_remedy_of_what_cannot_be_unpacked(tmp_path: Path, content: Any, said: str) -> None:
    archive = tmp_path / "sent"
    archive.write_bytes(content(tmp_path / "made.zip"))
    with pytest.raises(InputError) as caught:
        unpack(archive, tmp_path / "set", MOST_BYTES, MOST_FILES)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def tar_of(size: int) -> bytes:
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w:") as archive:
        archive.addfile(member("a.npy", size=size), io.BytesIO(np.random.default_rng(1).bytes(size)))
    return made.getvalue()
