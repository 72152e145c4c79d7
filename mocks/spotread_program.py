"""A stand-in of Argyll's `spotread` as a program: it says what the mock at ADDRESS says (`calibench mock spotread --tcp
HOST:PORT`), and what spotread says of an instrument that is gone.

Run as `python -m mocks.spotread_program HOST:PORT OPTION...`.
"""

from __future__ import annotations

import os
import select
import socket
import sys

#: What the mock sends where its program ends.
END = b"\x04"
GONE = b"\n\nSpot read failed due to communication problem.\nHit Esc or Q to give up, any other key to retry:"


def _say(text: bytes) -> None:
    while text:
        text = text[os.write(1, text) :]


def main(address: str, *options: str) -> int:
    """Carry keys there and text back. Returns the exit code."""
    host, _, port = address.rpartition(":")
    try:
        line = socket.create_connection((host, int(port)))
    except OSError:
        number = options[options.index("-c") + 1] if "-c" in options else "1"
        _say(f"spotread: Error - No instrument at port {number}\n".encode())
        return 1
    line.sendall(f"spotread {' '.join(options)}\n".encode())
    listened: list[int | socket.socket] = [0, line]
    while True:
        for ready in select.select(listened, [], [])[0]:
            if ready == 0:
                keys = os.read(0, 4096)
                if not keys:
                    listened.remove(0)  # spotread doesn't notice the end of its input either
                line.sendall(keys)
            else:
                try:
                    text = line.recv(4096)
                except OSError:
                    text = b""
                if not text:
                    return _fail()
                _say(text.replace(END, b""))
                if END in text:
                    return 1


def _fail() -> int:
    """The instrument is gone: every key ends in the same words."""
    _say(GONE)
    while keys := os.read(0, 4096):
        if keys[:1] in b"qQ\x1b":
            return 0
        _say(GONE)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
