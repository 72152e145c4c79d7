"""Backups: taken while sessions capture and are packed, restored unchanged, and refused where they would be useless."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa

import lab.capture.backup
from lab.capture.backup import back_up
from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession
from lab.capture.store import Store
from lab.capture_kinds.dark import DarkSequence
from lab.cli import main
from lab.errors import InputError
from tests.lab import fake_bench

DARKS = CapturePlan((DarkSequence(exposures_s=(0.001, 0.1), frames=2),))


def captured(store: Store) -> str:
    session = CaptureSession.start(store, fake_bench.station(), DARKS, connect=fake_bench.Bench().drivers)
    session.run()
    return session.id


def frames(store: Store, session: str) -> list[np.ndarray]:
    return [store.frame(one.id) for one in store.captures(session)]


def test_a_backup_is_a_data_folder(store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = captured(store)
    (store.root / "limits.toml").write_text("valid_days = 90\n")
    made = back_up(store, tmp_path / "backup")
    assert made.sessions == 1 and made.copied > 0
    second = captured(store)
    again = back_up(store, tmp_path / "backup")
    assert again.sessions == 2 and 0 < again.copied < made.copied + again.files
    assert back_up(store, tmp_path / "backup").copied == 0
    assert main(["backup", str(tmp_path / "backup"), "--data", str(store.root)]) == 0
    assert "2 sessions" in capsys.readouterr().out
    restored = Store(tmp_path / "backup")
    for session in (first, second):
        assert restored.session(session).state == "finished"
        for one, other in zip(frames(restored, session), frames(store, session), strict=True):
            np.testing.assert_array_equal(one, other)
    assert (restored.root / "limits.toml").exists()
    restored.close()


def test_a_session_that_is_packed_meanwhile_is_whole_in_the_backup(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is packed between the registry's copy and the copy of its frames: what was taken first names frames that are
    gone."""
    closed = Store.close_session
    monkeypatch.setattr(Store, "close_session", lambda *_, **__: None)
    session = captured(store)
    monkeypatch.setattr(Store, "close_session", closed)
    assert not store.session(session).packed
    taken = lab.capture.backup._files
    times = 0

    def packed_first(root: Path):
        nonlocal times
        times += 1
        if times == 1:
            store.close_session(session)
        return taken(root)

    monkeypatch.setattr(lab.capture.backup, "_files", packed_first)
    back_up(store, tmp_path / "backup")
    assert times == 2
    restored = Store(tmp_path / "backup")
    assert restored.session(session).packed and len(frames(restored, session)) == 8
    restored.close()


def test_useless_backups_are_refused(store: Store, tmp_path: Path) -> None:
    session = captured(store)
    for folder in (store.root, store.root / "backup", tmp_path):
        with pytest.raises(InputError, match="lies in it"):
            back_up(store, folder)
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").touch()
    with pytest.raises(InputError, match="isn't empty"):
        back_up(store, other)
    back_up(store, tmp_path / "backup")
    elsewhere = Store(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="another data folder"):
        back_up(elsewhere, tmp_path / "backup")
    elsewhere.close()
    shutil.rmtree(store.folder(session))
    with pytest.raises(InputError, match=r"session\.nxs|missing"):
        back_up(store, tmp_path / "fresh")
    assert not (tmp_path / "fresh" / "registry.sqlite").exists()
    back_up(store, tmp_path / "backup")  # the old one still has what the data folder lost
    restored = Store(tmp_path / "backup")
    assert len(frames(restored, session)) == 8
    restored.close()


def test_a_registry_of_a_newer_version_is_left_alone(store: Store, tmp_path: Path) -> None:
    with store.transaction() as db:
        db.execute(sa.text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(InputError, match="revision 9999, written by a newer calibench"):
        Store(store.root)
