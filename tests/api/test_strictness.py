"""What a request states is taken as it is meant, or refused in one clear line."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import pytest

from api.unpacking import FREE_BYTES, MOST_RATIO, TooMuch, unpack
from lab.errors import InputError
from tests.api.conftest import Running


@pytest.mark.parametrize(
    ("path", "said"),
    [
        (
            "/api/v1/sessions?limt=3",
            "'limt': isn't a query parameter of /api/v1/sessions; it takes after, limit, search, verdict",
        ),
        ("/api/v1/stations?x=1", "'x': isn't a query parameter of /api/v1/stations; it takes none"),
    ],
)
def test_an_unknown_query_parameter_is_refused(shared: Running, path: str, said: str) -> None:
    with shared.client("read") as client:
        refused = client.get(path)
        assert refused.status_code == 422 and refused.json()["detail"] == said
        assert client.get("/api/v1/sessions?limit=3").status_code == 200


def test_a_bomb_is_refused_by_what_it_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A deflated byte of zeros stands for a thousand: nothing of it is written."""
    bomb = tmp_path / "bomb.zip"
    with (
        zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as packed,
        packed.open("frames/0.npy", "w", force_zip64=True) as made,
    ):
        for _ in range(FREE_BYTES // (1 << 20) + 64):
            made.write(bytes(1 << 20))
    assert bomb.stat().st_size * MOST_RATIO < 64 << 20
    monkeypatch.setattr("api.unpacking._write", lambda *_: pytest.fail("it was unpacked"))
    with pytest.raises(TooMuch, match=r"bytes unpacked from \d+ packed ones, \d+ at most; pack"):
        unpack(bomb, tmp_path / "set", 1 << 40, 10)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_what_is_wrong_with_an_archive_is_said_without_the_readers_words(tmp_path: Path) -> None:
    twice, locked = tmp_path / "twice.zip", tmp_path / "locked.zip"
    with zipfile.ZipFile(twice, "w") as packed:
        packed.writestr("a/b.npy", b"1")
        packed.writestr("a/b.npy", b"2")
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as packed:
        packed.writestr("a.npy", b"1")
    made = bytearray(content.getvalue())
    made[6] |= 1
    made[made.index(b"PK\x01\x02") + 8] |= 1
    locked.write_bytes(made)
    for archive, said in ((twice, "a/b.npy is there twice"), (locked, "'a.npy' is encrypted")):
        with pytest.raises(InputError) as told:
            unpack(archive, tmp_path / f"{archive.stem}-set", 1 << 20, 10)
        assert said in str(told.value) and "Errno" not in str(told.value) and "ZipInfo" not in str(told.value)


@pytest.mark.parametrize(
    ("path", "body", "said"),
    [
        (
            "/sessions",
            {"station": "fakes", "parameters": {"dark": {"frames": True}}},
            "parameters.dark.frames: true isn't a number",
        ),
        ("/sessions", {"station": "fakes", "quick": 1}, "quick: 1 isn't true or false"),
        ("/sessions", {"station": "fakes", "quick": "yes"}, "quick: 'yes' isn't true or false"),
    ],
)
def test_a_value_of_another_kind_is_refused(shared: Running, path: str, body: dict[str, object], said: str) -> None:
    with shared.client("admin") as client:
        refused = client.post(f"/api/v1{path}", json=body)
        assert refused.status_code == 422 and said in refused.json()["detail"], refused.text
