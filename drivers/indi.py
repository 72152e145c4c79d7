"""INDI: astronomers' devices by XML over TCP. What its cameras and lamps have in common.

Source: INDI: Instrument-Neutral Distributed Interface, E. C. Downey, version 1.7; the names are those of INDI's
standard properties. Nothing beside Python is needed.
"""

from __future__ import annotations

import base64
import binascii
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast
from urllib.parse import urlsplit
from xml.etree.ElementTree import Element, ParseError, XMLPullParser
from xml.sax.saxutils import quoteattr

from drivers.errors import Disconnected, Garbled, InstrumentError, NoAnswer
from drivers.instrument import Identity, Recorder, Setting

_PORT = 7624
_PIECE = 1 << 20


@dataclass
class _Vector:
    """A property as it was reported last: its kind (`Switch`, `Number`, `Text`, `Light`, `BLOB`), state, and values.

    `updates`: how often it was told; `changes`: of these, as a new value. A server tells definitions to all clients
    when one of them asks.
    """

    kind: str
    state: str = "Idle"
    values: dict[str, str] = field(default_factory=dict)
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    updates: int = 0
    changes: int = 0
    blob: bytes | None = None


class IndiDevice:
    """One device of a server: `host:port/NAME`. `left_s` says how long an answer may take at most.

    A property's value is the name of the switch that is on, or `NAME=NUMBER;NAME=NUMBER`: it is set as a whole.
    """

    def __init__(self, address: str, left_s: Callable[[], float], recorder: Recorder) -> None:
        parts = urlsplit(f"indi://{address.removeprefix('indi://')}")
        self.name = parts.path.strip("/")
        try:
            self._host, self._port = parts.hostname or "", parts.port or _PORT
        except ValueError:
            self._host = ""
        if not self._host or not self.name:
            raise InstrumentError(f"device {address}: isn't an INDI device's address; write host:port/NAME")
        self._who = f"INDI device {address}"
        self._left_s, self._record = left_s, recorder
        self._line: socket.socket | None = None
        self._parser: XMLPullParser[Any] | None = None
        self._root: Element | None = None
        self._vectors: dict[str, _Vector] = {}
        self._others: set[str] = set()
        self._said = ""
        self._begun = "", ""  # a property that was set, and the pictures that come before the device has heard it

    # --- the connection -----------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Reach the server, and the device's driver there. Raises `Disconnected`, `NoAnswer`."""
        self._reach(f"<getProperties version='1.7' device={quoteattr(self.name)}/>")
        try:
            self._await("CONNECTION", lambda: "CONNECTION" in self._vectors)
        except NoAnswer:
            self._reach("<getProperties version='1.7'/>")  # a server says nothing of a device that it hasn't got
            until = time.monotonic() + self._left_s()
            while self._pump(0.2 if self._others else until - time.monotonic()) and time.monotonic() < until:
                continue
            if self._others:
                raise Disconnected(
                    f"{self._who}: the server has no such device; it has {', '.join(sorted(self._others))}"
                ) from None
            raise

    def _reach(self, asked: str) -> None:
        """A connection of its own, on which something is asked."""
        self.close()
        self._vectors, self._others, self._said = {}, set(), ""
        try:
            self._line = socket.create_connection((self._host, self._port), self._left_s())
        except OSError as error:
            raise Disconnected(
                f"{self._who}: its server can't be reached ({error.strerror or error}); start indiserver there, or "
                "correct the address"
            ) from error
        self._parser = XMLPullParser(("start", "end"))
        self._parser.feed("<indi>")  # a document without end, of many roots
        self._root = None
        self._send(asked)

    def close(self) -> None:
        """End the connection; never raises."""
        line, self._line = self._line, None
        if line is not None:
            line.close()

    def _send(self, text: str) -> None:
        if self._line is None:
            raise Disconnected(f"{self._who}: not connected; the next call reconnects")
        self._record("sent", text.encode())
        try:
            self._line.settimeout(self._left_s())
            self._line.sendall(text.encode())
        except OSError as error:
            raise self._gone(str(error)) from error

    def _gone(self, why: str) -> Disconnected:
        self.close()
        return Disconnected(f"{self._who}: the line broke ({why}); check its server, the next call reconnects")

    def _pump(self, timeout_s: float) -> bool:
        """Take in what comes within a time; False if nothing did."""
        if self._line is None or self._parser is None:
            raise Disconnected(f"{self._who}: not connected; the next call reconnects")
        try:
            self._line.settimeout(max(0.001, timeout_s))
            piece = self._line.recv(_PIECE)
        except TimeoutError:
            return False
        except OSError as error:
            raise self._gone(str(error)) from error
        if not piece:
            raise self._gone("the server ended it")
        try:
            self._parser.feed(piece)
            for event_and_element in self._parser.read_events():
                event, element = cast("tuple[str, Element]", event_and_element)
                if self._root is None:
                    self._root = element
                elif event == "end" and element in self._root:
                    self._take(element)
                    self._root.remove(element)
        except (ParseError, ValueError, binascii.Error) as error:
            self.close()
            raise Garbled(f"{self._who}: says what isn't INDI ({error}); is an INDI server at this address?") from error
        return True

    def _take(self, message: Element) -> None:
        """A definition, a new value, a message, or the end of a property."""
        if message.get("device") != self.name:
            self._others.add(message.get("device") or "")
            self._others.discard("")
            return
        self._said = message.get("message") or self._said
        name, tag = message.get("name", ""), message.tag
        if tag == "delProperty":
            self._vectors.pop(name, None)
        if not tag.endswith("Vector") or tag[:3] not in ("def", "set"):
            return
        vector = self._vectors.setdefault(name, _Vector(tag[3:-6]))
        vector.state = message.get("state", vector.state)
        vector.updates += 1
        vector.changes += tag.startswith("set")
        if tag.startswith("set") and name == self._begun[0]:
            if self._begun[1]:
                self.forget_blob(self._begun[1])
            self._begun = "", ""
        for child in message:
            element, text = child.get("name", ""), (child.text or "").strip()
            if tag == "setBLOBVector":
                vector.blob = base64.b64decode(text)
                vector.values[element] = child.get("format", "")
                self._record("received", f"{name} {len(vector.blob)} bytes".encode())
                continue
            vector.values[element] = text
            if child.get("min") is not None and child.get("max") is not None:
                vector.limits[element] = float(child.get("min", 0)), float(child.get("max", 0))
        if vector.kind != "BLOB":
            self._record("received", f"{name} {vector.state} {vector.values}".encode())

    def _await(self, asked: str, holds: Callable[[], bool]) -> None:
        """Return once something holds. Raises `NoAnswer`."""
        limit_s = self._left_s()
        until = time.monotonic() + limit_s
        while not holds():
            if time.monotonic() >= until:
                raise NoAnswer(
                    f"{self._who}: no answer within {limit_s:.3g} s to {asked!r}; check its server and the cable"
                )
            self._pump(until - time.monotonic())

    # --- its properties -----------------------------------------------------------------------------------------------

    def has(self, name: str) -> bool:
        """Return whether it has a property now."""
        return name.partition(".")[0] in self._vectors

    def _vector(self, name: str) -> _Vector:
        if name not in self._vectors:
            if name != "CONNECTION" and self.get("CONNECTION") == "DISCONNECT":
                raise Disconnected(
                    f"{self._who}: another client disconnected it; end that one, the next call reconnects"
                )
            raise InstrumentError(f"{self._who}: it has no property {name}; is it the right device?")
        return self._vectors[name]

    def connect(self, *names: str) -> None:
        """Connect the device, and return once it has these properties: most come when it is connected.

        A server that was busy hears only now that a client before disconnected it: it is connected again then.
        """

        def are_there() -> bool:
            return all(name in self._vectors for name in names)

        def is_on() -> bool:
            return self.get("CONNECTION") == "CONNECT"

        while not (is_on() and are_there()):
            if not is_on():
                self.set("CONNECTION", "CONNECT")
            self._await("CONNECTION", lambda: are_there() or not is_on())

    def await_number(self, name: str, element: str) -> None:
        """Return once a number is above 0: some are sent after the connection, and are 0 before."""
        self._await(name, lambda: self.number(name, element) > 0)

    def ask(self, name: str) -> None:
        """Let the device tell a property anew."""
        before = self._vector(name).updates
        self._send(f"<getProperties version='1.7' device={quoteattr(self.name)} name={quoteattr(name)}/>")
        self._await(name, lambda: self._vector(name).updates > before)

    def get(self, name: str) -> Setting:
        """Return a property's last reported value."""
        vector = self._vector(name)
        if vector.kind == "Switch":
            return next((name for name, value in vector.values.items() if value == "On"), "")
        return ";".join(f"{name}={value}" for name, value in vector.values.items())

    def number(self, name: str, element: str) -> float:
        """Return a number of a property. Raises `Garbled` where it is none."""
        text = self._vector(name).values.get(element, "")
        try:
            return float(text)
        except ValueError:
            raise Garbled(
                f"{self._who}: {name} {element} is {text!r}, a number is wanted; look into its driver"
            ) from None

    def text(self, name: str, element: str) -> str:
        """Return a text of a property; empty where it has none."""
        return self._vectors[name].values.get(element, "") if name in self._vectors else ""

    def state(self, name: str) -> str:
        """Return `Idle`, `Ok`, `Busy` or `Alert`."""
        return self._vector(name).state

    def entries(self, name: str) -> tuple[str, ...]:
        """Return the names of a property's elements."""
        return tuple(self._vector(name).values)

    def limits(self, name: str) -> tuple[float, float]:
        """Return least and greatest value of `PROPERTY.ELEMENT`."""
        vector, _, element = name.partition(".")
        return self._vector(vector).limits[element]

    def set(self, name: str, value: Setting) -> None:
        """Set a property and wait until it isn't busy. Raises `InstrumentError` where the device refuses."""
        self.begin(name, value)
        self._await(name, lambda: self.state(name) != "Busy")
        self._refuse_alert(name)

    def catch_up(self) -> None:
        """Process the messages that have come."""
        until = time.monotonic() + self._left_s()
        while self._pump(0.0) and time.monotonic() < until:
            continue

    def begin(self, name: str, value: Setting, picture: str = "") -> None:
        """Set a property and wait until the device has heard it: until it tells the property's new value.

        A `picture` that comes before that belongs to an exposure before, and is forgotten; one may come at once after.
        """
        self.catch_up()  # what was told before isn't the answer
        vector = self._vector(name)
        if vector.kind == "Switch":
            if value not in vector.values:
                raise InstrumentError(
                    f"{self._who}: {name} can't be {value!r}; it has {', '.join(vector.values)}: correct the station "
                    "file"
                )
            given = {str(value): "On"}
        else:
            given = dict(part.partition("=")[::2] for part in str(value).split(";"))
        before, kind = vector.changes, vector.kind
        self._begun = name, picture
        parts = "".join(f"<one{kind} name={quoteattr(element)}>{text}</one{kind}>" for element, text in given.items())
        self._send(f"<new{kind}Vector device={quoteattr(self.name)} name={quoteattr(name)}>{parts}</new{kind}Vector>")
        self._await(name, lambda: name not in self._vectors or self._vectors[name].changes > before)
        if name in self._vectors:
            self._refuse_alert(name)

    def _refuse_alert(self, name: str) -> None:
        if name in self._vectors and self.state(name) == "Alert":
            message = " ".join(self._said.split())[-160:]
            raise InstrumentError(
                f"{self._who}: it refuses {name} ({message or 'no reason stated'}); look into its driver"
            )

    def execute(self, name: str) -> None:
        """Press a property's only button."""
        self.begin(name, self.entries(name)[0])

    def send_blobs(self) -> None:
        """Ask for pictures, too."""
        self._send(f"<enableBLOB device={quoteattr(self.name)}>Also</enableBLOB>")

    def forget_blob(self, name: str) -> None:
        """Forget the pictures that came before."""
        self._vector(name).blob = None

    def blob(self, name: str, wait_s: float) -> bytes | None:
        """Return a picture, if there is one by now; None otherwise, at the latest after `wait_s`."""
        if self._vector(name).blob is None:
            self._pump(wait_s)
        return self._vector(name).blob

    def identity(self) -> Identity:
        """Return the driver's program, the device's name, and the driver's version."""
        info = "DRIVER_INFO"
        return Identity(self.text(info, "DRIVER_EXEC"), self.name, "", self.text(info, "DRIVER_VERSION"))

    def settings(self) -> dict[str, Setting]:
        """Return all of its properties that aren't pictures."""
        return {name: self.get(name) for name, vector in self._vectors.items() if vector.kind not in ("BLOB", "Light")}
