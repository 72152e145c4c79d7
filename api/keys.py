"""Keys of the REST service, and what each allows.

A key is 256 random bits. Only its SHA-256 is stored, and it is compared in constant time. A slow hash would protect a
password; at 256 bits it adds nothing.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import logging
import re
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from typing import TYPE_CHECKING

from lab.errors import InputError
from lab.plain_text import escaped

if TYPE_CHECKING:
    from lab.capture.store import Store

KEY_PREFIX = "calibench_"
LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
_HIDDEN = KEY_PREFIX + "***"
#: A key, also percent-encoded as a URL may have it: each of its characters as such or as %XX.
_KEYS = re.compile(
    "".join(f"(?:{letter}|%{ord(letter):02x})" for letter in KEY_PREFIX) + r"(?:[A-Za-z0-9_-]|%[0-9a-f]{2}){16,}", re.I
)


class Permission(StrEnum):
    """What a key allows. `operate` and `calibrate` include `read`; `admin` includes all."""

    READ = "read"
    OPERATE = "operate"
    CALIBRATE = "calibrate"
    ADMIN = "admin"

    def allows(self, wanted: Permission) -> bool:
        """Return whether a key of this scope may do what needs `wanted`."""
        return self is wanted or self is Permission.ADMIN or wanted is Permission.READ


def new_key() -> str:
    """Return a fresh key: 256 random bits behind a prefix that secret scanners can find.

    >>> new_key().startswith(KEY_PREFIX), new_key() == new_key()
    (True, False)
    """
    return KEY_PREFIX + secrets.token_urlsafe(32)


def digest(key: str) -> str:
    """Return what is stored of a key: its SHA-256.

    >>> len(digest("a key"))
    64
    """
    return hashlib.sha256(key.encode()).hexdigest()


@dataclass(frozen=True)
class StoredKey:
    name: str
    scope: Permission
    sha256: str


def stored_keys(store: Store, anew: bool = True) -> list[StoredKey]:
    """Return the keys that a store holds; unless `anew`, as it knows them."""
    return [StoredKey(name, Permission(scope), sha256) for name, scope, sha256 in store.keys(anew)]


def create_key(store: Store, name: str, scope: Permission) -> str:
    """Register a new key and return it; it can't be read again. Raises InputError if the name is taken."""
    if not re.fullmatch(r"[\w.@-]{1,100}", name):
        raise InputError(f"key name {name!r}: use up to 100 letters, digits and any of _ . @ -")
    key = new_key()
    store.add_key(name, scope.value, digest(key))
    return key


#: How long a page can halt after its last login.
HALT_TOKEN_LIFETIME = timedelta(days=30)


def create_halt_token(store: Store, key: StoredKey) -> str:
    """Register a token that allows a halt and nothing else, for the holder of `key`, and return it."""
    token = secrets.token_urlsafe(32)
    store.add_halt_token(digest(token), key.sha256, datetime.now(UTC) + HALT_TOKEN_LIFETIME)
    return token


def halt_token_key(store: Store, sha256: str) -> StoredKey | None:
    """Return the key that the halt token of this hash was made for; None where it is no longer valid, or its key may
    only read."""
    key_name = store.key_of_halt_token(sha256)
    key = None if key_name is None else StoredKey(key_name[0], Permission(key_name[1]), key_name[2])
    return None if key is None or key.scope is Permission.READ else key


def holder(key: str, stored: Iterable[StoredKey]) -> StoredKey | None:
    """Return the stored key that `key` is, or None; every stored key is compared, each in constant time."""
    mine = digest(key)
    matching = None
    for candidate in stored:
        if hmac.compare_digest(mine, candidate.sha256):
            matching = candidate
    return matching


class EscapeControls(logging.Filter):
    """Escapes control characters in log lines: a request, a file or an instrument could otherwise write on the terminal
    of whoever reads the log, or begin a line of its own. Our own newlines and tracebacks stay."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Escape a record's texts; no record is dropped."""
        if isinstance(record.args, tuple):  # kept one by one, as uvicorn's formatter unpacks them
            record.args = tuple(_plain(argument) for argument in record.args)
        text = record.getMessage()
        if (plain := escaped(text, several_lines=True)) != text:
            record.msg, record.args = plain, ()
        if record.exc_info and record.exc_info[0] is not None:
            record.exc_text = record.exc_text or logging.Formatter().formatException(record.exc_info)
        if record.exc_text:  # a formatter takes it as it is
            record.exc_text = escaped(record.exc_text, several_lines=True)
        return True


def _plain(argument: object) -> object:
    """Return a text, or an exception's text, escaped; another value as it is."""
    return escaped(str(argument)) if isinstance(argument, str | BaseException) else argument


class HideKeys(logging.Filter):
    """Removes keys from log lines and their tracebacks: a client may have written one into a URL."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Remove the keys from a record; no record is dropped."""
        text = record.getMessage()
        hidden = _KEYS.sub(_HIDDEN, text)
        if hidden != text and isinstance(record.args, tuple):
            # uvicorn's formatter unpacks the arguments, so they are kept, one by one.
            record.args = tuple(_KEYS.sub(_HIDDEN, a) if isinstance(a, str) else a for a in record.args)
        if _KEYS.search(record.getMessage()):
            record.msg, record.args = hidden, ()
        if record.exc_info and record.exc_info[0] is not None:
            record.exc_text = record.exc_text or logging.Formatter().formatException(record.exc_info)
        if record.exc_text:  # a formatter takes it as it is
            record.exc_text = _KEYS.sub(_HIDDEN, record.exc_text)
        if record.stack_info:
            record.stack_info = _KEYS.sub(_HIDDEN, record.stack_info)
        return True


def is_loopback(host: str) -> bool:
    """Return whether an address is this computer's own.

    >>> is_loopback("127.0.0.1"), is_loopback("192.0.2.1")
    (True, False)
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_bind(host: str, keys: Iterable[StoredKey]) -> None:
    """Check where the service listens. Raises InputError for a service without keys that other computers could reach.

    >>> check_bind("127.0.0.1", [])
    """
    if not is_loopback(host) and not any(True for _ in keys):
        raise InputError(
            f"--host {host}: others could reach this service, and it has no key; "
            "make one with `calibench key create NAME --scope admin`, then start again"
        )
