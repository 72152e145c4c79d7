"""ASCOM Alpaca: astronomers' devices by HTTP. What its cameras and lamps have in common.

Source: ASCOM Alpaca API Reference, ASCOM Alpaca ImageBytes specification. Nothing beside Python is needed.
"""

from __future__ import annotations

import http.client
import json
import socket
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any
from urllib.parse import urlencode, urlsplit

import numpy as np
from numpy.typing import NDArray

from drivers.errors import Disconnected, Garbled, InstrumentError, NoAnswer, Refused
from drivers.instrument import Identity, Recorder, Setting

#: ASCOM's error numbers.
NOT_IMPLEMENTED, NOT_CONNECTED = 0x400, 0x407
_IMAGE_BYTES = "application/imagebytes"
#: How ImageBytes sends a number: its codes of types.
_TYPES = {1: "<i2", 2: "<i4", 3: "<f8", 4: "<f4", 5: "<u8", 6: "u1", 7: "<i8", 8: "<u2", 9: "<u4"}
_CLIENT = 4711


class AlpacaDevice:
    """One device of a server: `host:port/NUMBER`, by its `kind` (`camera`, `covercalibrator`).

    `left_s` says how long a request may take at most. Each has a connection of its own: no late answer is another's.
    """

    def __init__(self, address: str, kind: str, left_s: Callable[[], float], recorder: Recorder) -> None:
        parts = urlsplit(address if "://" in address else f"http://{address}")
        number = parts.path.strip("/") or "0"
        try:
            self._host, self._port = parts.hostname or "", parts.port or 11111
        except ValueError:
            self._host = ""
        if not self._host or not number.isdigit() or parts.scheme != "http":
            raise InstrumentError(f"{kind} {address}: isn't an Alpaca device's address; write host:port/NUMBER")
        self._path = f"/api/v1/{kind}/{number}/"
        self._who = f"{kind} {address}"
        self._left_s, self._record = left_s, recorder
        self._asked = 0

    def get(self, name: str) -> Any:
        """Return the value of a property. Raises `Refused` with ASCOM's number, `NoAnswer`, `Disconnected`,
        `Garbled`."""
        return self._value(name, *self._request("GET", name, {}))

    def put(self, name: str, **arguments: Any) -> None:
        """Set a property, or call a method."""
        self._value(name, *self._request("PUT", name, arguments))

    def has(self, name: str) -> bool:
        """Return whether a property is implemented."""
        try:
            self.get(name)
        except Refused:
            return False
        return True

    def get_if_there(self, name: str) -> Any:
        """Return the value of a property; None where it isn't implemented."""
        try:
            return self.get(name)
        except Refused:
            return None

    def identity(self) -> Identity:
        """Return the device's name and its driver's. Raises `InstrumentError`."""
        texts = [str(self.get_if_there(name) or "") for name in ("driverinfo", "name", "driverversion")]
        return Identity(texts[0], texts[1], self._unique_id(), texts[2])

    def _unique_id(self) -> str:
        """Return the device's own identifier, which stays when its address changes; empty where the server doesn't
        list it."""
        _, _, kind, number, _ = self._path.removeprefix("/").split("/", 4)
        try:
            listed = self._value("configureddevices", *self._request("GET", "/management/v1/configureddevices", {}))
            return next(
                str(entry["UniqueID"])
                for entry in listed
                if entry["DeviceType"].lower() == kind and str(entry["DeviceNumber"]) == number
            )
        except (Refused, Garbled, StopIteration, KeyError, TypeError, AttributeError):
            return ""

    def image(self) -> NDArray[Any]:
        """Return the picture, (rows, cols)."""
        kind, body = self._request("GET", "imagearray", {}, accept=f"{_IMAGE_BYTES}, application/json")
        if kind.startswith(_IMAGE_BYTES):
            return self._unpack_picture(body)
        value = np.array(self._value("imagearray", kind, body))
        if value.ndim != 2:
            raise Garbled(f"{self._who}: a picture of {value.ndim} dimensions; 2 are wanted")
        return value.T

    def _unpack_picture(self, body: bytes) -> NDArray[Any]:
        """Return a picture sent as ImageBytes: eleven numbers, then columns."""
        if len(body) < 44:
            raise Garbled(f"{self._who}: a picture of {len(body)} bytes; let no proxy stand between")
        _, error, _, _, start, _, sent_as, rank, cols, rows, _ = struct.unpack("<11i", body[:44])
        if error:
            raise self._describe_refusal("imagearray", error, body[start:].decode("utf-8", "replace"))
        if rank != 2 or sent_as not in _TYPES:
            raise Garbled(f"{self._who}: a picture of rank {rank} and type {sent_as}; one of rank 2 is wanted")
        numbers = np.frombuffer(body[start:], _TYPES[sent_as]) if cols > 0 and rows > 0 else np.zeros(0)
        if numbers.size != cols * rows or numbers.size == 0:
            raise Garbled(f"{self._who}: a picture of {numbers.size} pixels, {cols} x {rows} are announced; ask again")
        return numbers.reshape(cols, rows).T

    def _request(self, method: str, name: str, given: dict[str, Any], accept: str = "*/*") -> tuple[str, bytes]:
        """Return the answer's content type and body, within the time that is left."""
        self._asked += 1
        fields = urlencode(given | {"ClientID": _CLIENT, "ClientTransactionID": self._asked})
        path = name if name.startswith("/") else self._path + name
        self._record("sent", f"{method} {path} {urlencode(given)}".rstrip().encode())
        limit_s = self._left_s()
        connection = http.client.HTTPConnection(self._host, self._port, timeout=limit_s)
        over = threading.Event()
        lines: list[socket.socket] = []  # the connection forgets its own where the server ends it

        def give_up() -> None:
            over.set()
            with suppress(OSError):
                for line in lines:
                    line.shutdown(socket.SHUT_RDWR)

        watch = threading.Timer(limit_s, give_up)
        watch.daemon = True
        watch.start()
        try:
            connection.connect()
            lines.append(connection.sock)
            if method == "GET":
                connection.request("GET", f"{path}?{fields}", headers={"Accept": accept})
            else:
                form = {"Content-Type": "application/x-www-form-urlencoded", "Accept": accept}
                connection.request("PUT", path, fields, headers=form)
            answer = connection.getresponse()
            body = answer.read()
        except (OSError, http.client.HTTPException) as error:
            raise self._describe_failure(name, error, limit_s, over.is_set()) from error
        finally:
            watch.cancel()
            connection.close()
        if over.is_set():
            raise self._describe_failure(name, TimeoutError(), limit_s, True)
        kind = answer.getheader("Content-Type", "")
        self._record("received", body[:200] if kind.startswith("application/json") else f"{len(body)} bytes".encode())
        if answer.status != 200:
            raise self._describe_refusal(name, answer.status, body.decode("utf-8", "replace"))
        return kind, body

    def _value(self, name: str, kind: str, body: bytes) -> Any:
        try:
            answer = json.loads(body)
            number, message = int(answer.get("ErrorNumber", 0)), str(answer.get("ErrorMessage", ""))
        except (ValueError, AttributeError, TypeError):
            raise Garbled(
                f"{self._who}: answered {name!r} with {body[:60]!r} ({kind}); is an Alpaca server at this address?"
            ) from None
        if number == NOT_CONNECTED:
            raise Disconnected(f"{self._who}: {name!r}: the server has lost it ({_line(message)}); plug it in again")
        if number:
            raise self._describe_refusal(name, number, message)
        return answer.get("Value")

    def _describe_refusal(self, name: str, number: int, message: str) -> Refused:
        return Refused(
            f"{self._who}: {name!r} failed with {number:#x} ({_line(message)}); look it up in its driver", number
        )

    def _describe_failure(self, name: str, error: Exception, limit_s: float, over: bool) -> InstrumentError:
        if over or isinstance(error, TimeoutError):
            return NoAnswer(
                f"{self._who}: no answer within {limit_s:.3g} s to {name!r}; check the server and the cable"
            )
        return Disconnected(
            f"{self._who}: {name!r} failed ({_line(str(error)) or type(error).__name__}); check that its server runs "
            "at this address, the next call reconnects"
        )


class AlpacaFeatures:
    """A device's properties by ASCOM's names, in lower case."""

    #: Properties whose argument has another case.
    _ARGUMENT = {
        "binx": "BinX",
        "biny": "BinY",
        "numx": "NumX",
        "numy": "NumY",
        "startx": "StartX",
        "starty": "StartY",
        "readoutmode": "ReadoutMode",
        "fastreadout": "FastReadout",
    }

    def __init__(self, device: AlpacaDevice) -> None:
        self._device = device

    def has(self, name: str) -> bool:
        return self._device.has(name)

    def get(self, name: str) -> Setting:
        setting: Setting = self._device.get(name)
        return setting

    def set(self, name: str, value: Setting) -> None:
        self._device.put(name, **{self._ARGUMENT.get(name, name.capitalize()): value})

    def entries(self, name: str) -> tuple[str, ...]:
        return tuple(str(entry) for entry in self._device.get_if_there(f"{name}s") or ())

    def limits(self, name: str) -> tuple[float, float]:
        return float(self._device.get(f"{name}min")), float(self._device.get(f"{name}max"))

    def execute(self, name: str) -> None:
        self._device.put(name)


def _line(text: str) -> str:
    return " ".join(text.split())[:160]
