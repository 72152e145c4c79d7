"""A .tar is unpacked under the same caps as a .zip, and what it states is checked before a byte is written."""

from __future__ import annotations

import gzip
import io
import tarfile
from collections.abc import Callable
from pathlib import Path

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
