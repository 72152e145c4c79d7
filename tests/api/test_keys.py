"""Keys: random, stored hashed, compared whole, kept out of logs."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from urllib.parse import unquote

import pytest

from api.keys import (
    HideKeys,
    Permission,
    StoredKey,
    check_bind,
    create_key,
    digest,
    holder,
    is_loopback,
    new_key,
    stored_keys,
)
from lab.capture.store import Store
from lab.errors import InputError

SOMEONE = StoredKey("someone", Permission.READ, digest("x"))


def test_a_key_is_256_random_bits_and_never_the_same() -> None:
    made = {new_key() for _ in range(100)}
    assert len(made) == 100
    assert all(len(key.removeprefix("calibench_")) == 43 for key in made)  # 43 characters of base64 hold 256 bits


def test_only_the_hash_is_stored(tmp_path: Path) -> None:
    store = Store(tmp_path)
    secret = create_key(store, "ada", Permission.OPERATE)
    assert stored_keys(store) == [StoredKey("ada", Permission.OPERATE, digest(secret))]
    assert holder(secret, stored_keys(store)) is not None
    assert holder(secret[:-1], stored_keys(store)) is None
    assert holder("", stored_keys(store)) is None
    with pytest.raises(InputError, match="exists"):
        create_key(store, "ada", Permission.READ)
    store.close()
    for file in tmp_path.rglob("*"):
        assert not file.is_file() or secret.encode() not in file.read_bytes()


@pytest.mark.parametrize("name", ["", "a b", "a/b", "x" * 101, "a\n"])
def test_a_keys_name_is_plain(tmp_path: Path, name: str) -> None:
    store = Store(tmp_path)
    with pytest.raises(InputError, match="key name"):
        create_key(store, name, Permission.READ)
    store.close()


def test_scopes_include_read_and_admin_includes_all() -> None:
    for one in Permission:
        assert one.allows(Permission.READ)
        assert Permission.ADMIN.allows(one)
        assert one.allows(Permission.ADMIN) == (one is Permission.ADMIN)
    assert not Permission.OPERATE.allows(Permission.CALIBRATE)
    assert not Permission.CALIBRATE.allows(Permission.OPERATE)


@pytest.mark.parametrize(
    ("host", "own"),
    [
        ("127.0.0.1", True),
        ("127.8.8.8", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("lab", False),
    ],
)
def test_only_loopback_may_be_without_a_key(host: str, own: bool) -> None:
    assert is_loopback(host) == own
    check_bind(host, [SOMEONE])
    if own:
        check_bind(host, [])
    else:
        with pytest.raises(InputError, match="key create"):
            check_bind(host, [])


@pytest.mark.parametrize(
    ("message", "args"),
    [
        ('%s - "%s %s" %d', ("127.0.0.1:1", "GET", "/x?key={}", 200)),
        ("refused {}", ()),
        ("%(key)s", ({"key": "{}"},)),
        ('%s - "%s %s" %d', ("127.0.0.1:1", "GET", "/x?key=%63alibench%5F{tail}", 200)),
        ("GET /x?key=%63alibench%5F{encoded}", ()),
        ("%s", (["{}"],)),
    ],
)
def test_a_key_in_a_log_line_is_hidden(message: str, args: tuple[object, ...]) -> None:
    secret = new_key()
    tail = secret.removeprefix("calibench_")

    def filled(value: object) -> object:
        if isinstance(value, str):
            encoded = "".join(f"%{ord(letter):02X}" for letter in tail)
            return value.replace("{}", secret).replace("{tail}", tail).replace("{encoded}", encoded)
        if isinstance(value, dict):
            return {name: filled(one) for name, one in value.items()}
        return [filled(one) for one in value] if isinstance(value, list) else value

    record = logging.LogRecord("x", logging.INFO, "", 1, str(filled(message)), tuple(filled(one) for one in args), None)
    assert HideKeys().filter(record)
    assert tail not in unquote(record.getMessage())
    assert "calibench_***" in record.getMessage()


def test_a_key_in_a_traceback_is_hidden() -> None:
    secret = new_key()
    try:
        {}[f"/{secret}"]
    except KeyError:
        record = logging.LogRecord("x", logging.ERROR, "", 1, "a defect", (), sys.exc_info())
    assert HideKeys().filter(record)
    text = logging.Formatter().format(record)
    assert secret not in text and "calibench_***" in text and "KeyError" in text
