"""Features of a GenICam camera by the reference implementation of GenApi, the package `genicam`.

The camera's XML says at which registers exposure time, gain and trigger lie, and how to convert them. Values are
read anew each time, as a camera may change them by itself.

Source: EMVA, GenICam Standard, section GenApi 2.1; `genicam` 1.6.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any, Protocol, TypeVar

from genicam import genapi, gentl

from drivers.errors import Disconnected, InstrumentError
from drivers.instrument import Setting

_T = TypeVar("_T")


class RegisterPort(Protocol):
    """Where registers are read and written."""

    def read(self, address: int, length: int) -> bytes: ...
    def write(self, address: int, data: bytes) -> None: ...


class _Port(genapi.AbstractPort):  # type: ignore[misc]  # the package has no types
    """A port as the library asks for it."""

    def __init__(self, port: RegisterPort) -> None:
        super().__init__()
        self._port = port

    def get_access_mode(self) -> Any:
        return genapi.EAccessMode.RW

    def read(self, address: int, length: int) -> bytes:
        return self._port.read(address, length)

    def write(self, address: int, data: bytes) -> None:
        self._port.write(address, bytes(data))

    def is_open(self) -> bool:
        return True

    def open(self, *_: Any) -> None: ...

    def close(self) -> None: ...


def library_message(error: Exception) -> str:
    """Return what the library says, without its numbers and the place in its sources."""
    text = str(error).removeprefix("GenTL exception: ").split(" : ")
    text = text[1:2] if text[0].startswith("Feature '") and len(text) > 1 else text[:1]
    return " ".join(text[0].split(" (Message from the source")[0].split()).rstrip(".")


class GenApiFeatures:
    """A camera's features by name.

    Each method raises `InstrumentError` where the camera lacks the feature, refuses the value or doesn't answer, and
    `Disconnected` where a GenTL producer lost it. What the port itself raises comes through.
    """

    def __init__(self, nodes: Any, who: str, port: _Port | None = None) -> None:
        self._nodes, self._who = nodes, who
        self._port = port  # the library doesn't hold it

    @classmethod
    def of_xml(cls, xml: bytes, port: RegisterPort, who: str) -> GenApiFeatures:
        """Read a camera's own description. Raises `InstrumentError` for XML that can't be read."""
        nodes = genapi.NodeMap()
        try:
            nodes.load_xml_from_string(xml.decode("utf-8", "replace"))
        except genapi.GenericException as error:
            raise InstrumentError(
                f"{who}: the camera's XML can't be read: {library_message(error)}; its firmware may need an update"
            ) from error
        through = _Port(port)
        nodes.connect(through, "Device")
        return cls(nodes, who, through)

    def _do(self, name: str, action: Callable[[Any], _T]) -> _T:
        if not self._nodes.has_node(name):
            raise InstrumentError(f"{self._who}: the camera has no feature {name}")
        try:
            self._nodes._invalidate_nodes()  # the package has no public name for it
            return action(self._nodes.get_node(name))
        except gentl.GenericException as error:
            raise Disconnected(
                f"{self._who}: feature {name}: {library_message(error)}; plug it in again, the next call reconnects"
            ) from error
        except genapi.GenericException as error:
            raise InstrumentError(
                f"{self._who}: feature {name}: {library_message(error)}; check that the camera is there and has it"
            ) from error
        except (AttributeError, TypeError) as error:  # of an interface that has no such thing
            kind = type(self._nodes.get_node(name)).__name__.removeprefix("I")
            raise InstrumentError(f"{self._who}: feature {name} is of type {kind}: {error}") from error

    def has(self, name: str) -> bool:
        """Return whether the camera has the feature, and it is implemented and available now."""
        return bool(self._nodes.has_node(name)) and self._do(name, lambda node: bool(genapi.is_available(node)))

    def get(self, name: str) -> Setting:
        """Return the value: a number, a text, a truth value, or the symbolic name of an enumeration's entry."""
        return self._do(name, lambda node: node.value)

    def set(self, name: str, value: Setting) -> None:
        """Write a feature; an enumeration takes a symbolic name."""
        self._do(name, lambda node: setattr(node, "value", value))

    def entries(self, name: str) -> Collection[str]:
        """Return the symbolic names of an enumeration's entries."""
        return self._do(name, lambda node: tuple(node.symbolics))

    def limits(self, name: str) -> tuple[float, float]:
        """Return the least and the greatest value that a number takes now."""
        return self._do(name, lambda node: (float(node.min), float(node.max)))

    def execute(self, name: str) -> None:
        """Run a command."""
        self._do(name, lambda node: node.execute())
