"""A reader of GenApi: the features that a GenICam camera's own XML describes, evaluated over its registers.

The XML says at which addresses exposure time, gain and trigger lie and how to convert them. These node types are read:
Integer, IntReg, MaskedIntReg, StructReg, Float, FloatReg, Boolean, Command, Enumeration, StringReg, SwissKnife,
IntSwissKnife, Converter, IntConverter. Values are never cached, as a camera may change them by itself.

Source: EMVA, GenICam Standard, section GenApi 2.1 (schema version 1.1), reimplemented from its description.
"""

from __future__ import annotations

import math
import re
import struct
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

from drivers.camera.formula import Formula, Number
from drivers.errors import InstrumentError

Value = int | float | str | bool
_T = TypeVar("_T")


class Port(Protocol):
    """Where registers are read and written."""

    def read(self, address: int, length: int) -> bytes: ...
    def write(self, address: int, data: bytes) -> None: ...


@dataclass(frozen=True)
class Node:
    """One node of the XML: its type, its name, and its child elements in order, as (tag, text, attributes)."""

    kind: str
    name: str
    items: tuple[tuple[str, str, Mapping[str, str]], ...]
    entries: Mapping[str, int] = field(default_factory=dict)  # of an Enumeration: symbolic name -> value

    def text(self, tag: str) -> str | None:
        """Text of the first child `tag`."""
        return next((text for name, text, _ in self.items if name == tag), None)


_REGISTERS = frozenset({"IntReg", "MaskedIntReg", "FloatReg", "StringReg", "Register"})
_KINDS = _REGISTERS | {
    "Integer",
    "Float",
    "Boolean",
    "Command",
    "Enumeration",
    "SwissKnife",
    "IntSwissKnife",
    "Converter",
    "IntConverter",
    "Category",
    "Port",
    "String",
}
_LONGEST_CHAIN = 50


def _tag(element: ET.Element) -> str:
    return element.tag.rpartition("}")[2]


def _integer(text: str) -> int:
    return int(text.strip(), 0) if not re.fullmatch(r"\s*0\d+\s*", text) else int(text)


class NodeMap:
    """The features of a camera, by name: `get`, `set`, `execute`, `limits`, `entries`.

    Raises `InstrumentError` for a feature the camera doesn't have, a value outside its limits, or XML that can't be
    read."""

    def __init__(self, xml: bytes, port: Port) -> None:
        self._port = port
        self._formulas: dict[str, Formula] = {}
        self._local: dict[str, Value] = {}  # nodes that hold their value in the XML
        self._depth = 0
        self.nodes: dict[str, Node] = {}
        try:
            root = ET.fromstring(xml)
        except ET.ParseError as error:
            raise InstrumentError(
                f"camera XML can't be read: {error}; the camera's firmware may need an update"
            ) from error
        self._collect(root)

    def _collect(self, parent: ET.Element) -> None:
        for element in parent:
            kind = _tag(element)
            if kind == "Group":
                self._collect(element)
            elif kind == "StructReg":
                shared = [
                    (_tag(c), (c.text or "").strip(), dict(c.attrib)) for c in element if _tag(c) != "StructEntry"
                ]
                for entry in element:
                    if _tag(entry) == "StructEntry":
                        self._add("MaskedIntReg", entry, shared)
            elif kind in _KINDS:
                self._add(kind, element, [])

    def _add(self, kind: str, element: ET.Element, shared: list[tuple[str, str, dict[str, str]]]) -> None:
        name = element.get("Name", "")
        own = [(_tag(c), (c.text or "").strip(), dict(c.attrib)) for c in element if _tag(c) != "EnumEntry"]
        entries: dict[str, int] = {}
        for child in element:
            if _tag(child) == "EnumEntry":
                value = next((c.text for c in child if _tag(c) == "Value"), None)
                symbol = next((c.text for c in child if _tag(c) == "Symbolic"), None) or child.get("Name") or ""
                if value is not None:
                    entries[symbol.strip()] = _integer(value)
        self.nodes[name] = Node(kind, name, (*own, *shared), entries)

    # --- what a driver calls ------------------------------------------------------------------------------------------

    def has(self, name: str) -> bool:
        """Whether the camera has the feature, and it is implemented and available now."""
        node = self.nodes.get(name)
        return node is not None and all(
            (reference := node.text(tag)) is None or bool(self.get(reference))
            for tag in ("pIsImplemented", "pIsAvailable")
        )

    def get(self, name: str) -> Value:
        """Value of a feature: a number, a text, a truth value, or the symbolic name of an enumeration's entry."""
        return self._guard(name, lambda: self._get(self._node(name)))

    def number(self, name: str) -> Number:
        """Value of a numeric feature; an enumeration's entry as its integer."""
        node = self._node(name)
        value = self._guard(name, lambda: self._raw(node) if node.kind == "Enumeration" else self._get(node))
        if isinstance(value, str):
            raise InstrumentError(f"camera feature {name} is the text {value!r}, not a number")
        return value

    def set(self, name: str, value: Value) -> None:
        """Write a feature; an enumeration takes a symbolic name. Refuses what is outside the camera's limits."""
        self._guard(name, lambda: self._set(self._node(name), value))

    def execute(self, name: str) -> None:
        """Run a Command."""
        node = self._node(name)
        if node.kind != "Command":
            raise InstrumentError(f"camera feature {name} is a {node.kind}, not a command")
        self._guard(name, lambda: self._execute(node))

    def limits(self, name: str) -> tuple[Number, Number]:
        """(least, greatest) value that a number takes now; infinite where the XML names none."""
        node = self._node(name)
        return self._guard(name, lambda: (self._limit(node, "Min", -math.inf), self._limit(node, "Max", math.inf)))

    def entries(self, name: str) -> dict[str, int]:
        """The entries of an Enumeration: symbolic name -> value."""
        return dict(self._node(name).entries)

    # --- evaluation ---------------------------------------------------------------------------------------------------

    def _node(self, name: str) -> Node:
        try:
            return self.nodes[name]
        except KeyError:
            raise InstrumentError(f"the camera has no feature {name}") from None

    def _guard(self, name: str, action: Callable[[], _T]) -> _T:
        if self._depth > _LONGEST_CHAIN:
            raise InstrumentError(f"camera XML: feature {name} refers to itself")
        self._depth += 1
        try:
            return action()
        except (ValueError, struct.error, OverflowError) as error:
            raise InstrumentError(f"camera feature {name}: {error}") from error
        finally:
            self._depth -= 1

    def _get(self, node: Node) -> Value:  # noqa: PLR0911  (one return a type of node)
        match node.kind:
            case "IntReg" | "MaskedIntReg" | "FloatReg" | "StringReg":
                return self._register_value(node)
            case "SwissKnife" | "IntSwissKnife":
                return self._swiss_knife(node)
            case "Converter" | "IntConverter":
                return self._convert(node, "FormulaFrom", "TO", lambda: self.number(self._reference(node, "pValue")))
            case "Boolean":
                return self._raw(node) == _integer(node.text("OnValue") or "1")
            case "Enumeration":
                value = self._raw(node)
                return next((symbol for symbol, number in node.entries.items() if number == value), str(value))
            case "Command":
                return self._raw(node) == self._command_value(node)
            case "Integer":
                return int(self._raw(node))
            case "Float":
                return float(self._raw(node))
            case "String":
                reference = node.text("pValue")
                return (
                    str(self.get(reference)) if reference else str(self._local.get(node.name, node.text("Value") or ""))
                )
        raise InstrumentError(f"camera feature {node.name} is a {node.kind}, which has no value")

    def _raw(self, node: Node) -> Number:
        reference = node.text("pValue")
        if reference is not None:
            return self.number(reference)
        if node.name in self._local:
            value = self._local[node.name]
            return value if isinstance(value, int | float) else float(value)
        text = node.text("Value") or "0"
        return float(text) if node.kind == "Float" else _integer(text)

    def _set(self, node: Node, value: Value) -> None:
        if node.kind == "Enumeration":
            if isinstance(value, str) and value not in node.entries:
                raise InstrumentError(f"camera feature {node.name} takes {', '.join(node.entries)}, not {value!r}")
            self._store(node, node.entries[value] if isinstance(value, str) else int(value))
            return
        if node.kind == "Boolean":
            self._store(node, _integer(node.text("OnValue" if value else "OffValue") or ("1" if value else "0")))
            return
        if node.kind in ("StringReg", "String"):
            self._store_text(node, str(value))
            return
        if isinstance(value, str):
            raise InstrumentError(f"camera feature {node.name} takes a number, not {value!r}")
        low, high = self._limit(node, "Min", -math.inf), self._limit(node, "Max", math.inf)
        if not low <= value <= high:
            raise InstrumentError(f"camera feature {node.name}: {value:g} is outside {low:g}..{high:g}")
        if node.kind in ("Converter", "IntConverter"):
            number = self._convert(node, "FormulaTo", "FROM", lambda: value)
            target = self._node(self._reference(node, "pValue"))
            self.set(target.name, number if target.kind in ("Float", "FloatReg", "Converter") else round(number))
        elif node.kind in _REGISTERS:
            self._write_register(node, value)
        elif node.kind in ("Integer", "Float"):
            self._store(node, int(value) if node.kind == "Integer" else float(value))
        else:
            raise InstrumentError(f"camera feature {node.name} is a {node.kind}, which can't be written")

    def _store(self, node: Node, value: Number) -> None:
        reference = node.text("pValue")
        if reference is None:
            self._local[node.name] = value
            return
        target = self._node(reference)
        integral = target.kind in ("Integer", "IntReg", "MaskedIntReg", "IntConverter", "Enumeration")
        self.set(reference, round(value) if integral else value)

    def _store_text(self, node: Node, value: str) -> None:
        if node.kind == "String":
            reference = node.text("pValue")
            if reference is None:
                self._local[node.name] = value
            else:
                self.set(reference, value)
            return
        length = self._length(node)
        data = value.encode("utf-8")
        if len(data) > length:
            raise ValueError(f"{value!r} is longer than the register's {length} bytes")
        self._port.write(self._address(node), data.ljust(length, b"\0"))

    def _execute(self, node: Node) -> None:
        reference = self._reference(node, "pValue")
        self.set(reference, self._command_value(node))

    def _command_value(self, node: Node) -> int:
        reference = node.text("pCommandValue")
        return int(self.number(reference)) if reference else _integer(node.text("CommandValue") or "1")

    def _limit(self, node: Node, which: str, absent: Number) -> Number:
        reference = node.text(f"p{which}")
        if reference is not None:
            return self.number(reference)
        text = node.text(which)
        if text is None:
            return absent
        return float(text) if node.kind in ("Float", "Converter", "SwissKnife") else _integer(text)

    def _reference(self, node: Node, tag: str) -> str:
        reference = node.text(tag)
        if reference is None:
            raise InstrumentError(f"camera XML: {node.kind} {node.name} has no {tag}")
        return reference

    def _formula(self, text: str) -> Formula:
        if text not in self._formulas:
            try:
                self._formulas[text] = Formula(text)
            except ValueError as error:
                raise InstrumentError(f"camera XML: {error}") from error
        return self._formulas[text]

    def _variables(self, node: Node) -> dict[str, Callable[[], Number]]:
        variables: dict[str, Callable[[], Number]] = {}
        for tag, text, attributes in node.items:
            name = attributes.get("Name", "")
            if tag == "pVariable":
                variables[name] = lambda text=text: self._variable(text)  # type: ignore[misc]
            elif tag == "Constant":
                constant: Number = _integer(text) if re.fullmatch(r"-?\d+|0[xX][0-9a-fA-F]+", text) else float(text)
                variables[name] = lambda constant=constant: constant  # type: ignore[misc]
            elif tag == "Expression":
                variables[name] = lambda text=text: self._formula(text)(variables)  # type: ignore[misc]
        return variables

    def _variable(self, name: str) -> Number:
        """A variable names a node, or one of its properties: `Width`, `Width.Max`, `Width.Value`."""
        owner, _, tail = name.rpartition(".")
        if name not in self.nodes and owner in self.nodes:
            if tail in ("Min", "Max"):
                return self._limit(self._node(owner), tail, 0)
            name = owner
        return self.number(name)

    def _swiss_knife(self, node: Node) -> Number:
        value = self._formula(node.text("Formula") or "0")(self._variables(node))
        return int(value) if node.kind == "IntSwissKnife" else float(value)

    def _convert(self, node: Node, formula: str, variable: str, value: Callable[[], Number]) -> Number:
        variables = {**self._variables(node), variable: value}
        result = self._formula(self._reference(node, formula))(variables)
        integral = node.kind == "IntConverter"
        return int(result) if integral else float(result)

    # --- registers ----------------------------------------------------------------------------------------------------

    def _address(self, node: Node) -> int:
        address = 0
        for tag, text, attributes in node.items:
            if tag == "Address":
                address += _integer(text)
            elif tag == "pAddress":
                address += int(self.number(text))
            elif tag == "IntSwissKnife":
                raise InstrumentError(
                    f"camera XML: {node.name} has a formula inside its address, which isn't read here"
                )
            elif tag == "pIndex":
                step = attributes.get("Offset")
                offset = (
                    _integer(step)
                    if step
                    else int(self.number(attributes["pOffset"]))
                    if "pOffset" in attributes
                    else 1
                )
                address += int(self.number(text)) * offset
        return address

    def _length(self, node: Node) -> int:
        reference = node.text("pLength")
        length = int(self.number(reference)) if reference else _integer(node.text("Length") or "4")
        if not 0 < length <= 65536:
            raise ValueError(f"a register of {length} bytes is outside 1..65536")
        return length

    def _bits(self, node: Node, size: int) -> tuple[int, int]:
        """(least significant bit counted from the right, number of bits) of a MaskedIntReg.

        GenApi counts bits from the left in a big-endian register, from the right in a little-endian one.
        """
        single = node.text("Bit")
        first = _integer(single if single is not None else node.text("LSB") or "0")
        last = _integer(single if single is not None else node.text("MSB") or "0")
        if self._order(node) == "big":
            first, last = size * 8 - 1 - first, size * 8 - 1 - last
        first, last = min(first, last), max(first, last)
        if not 0 <= first <= last < size * 8:
            raise ValueError(f"bits {first}..{last} are outside a register of {size} bytes")
        return first, last - first + 1

    @staticmethod
    def _order(node: Node) -> str:
        return (
            "big" if (node.text("Endianess") or node.text("Endianness") or "LittleEndian") == "BigEndian" else "little"
        )

    def _register_value(self, node: Node) -> Value:
        size = self._length(node)
        data = self._port.read(self._address(node), size)
        if node.kind == "StringReg":
            return data.split(b"\0", 1)[0].decode("utf-8", "replace")
        big = self._order(node) == "big"
        if node.kind == "FloatReg":
            return float(struct.unpack((">" if big else "<") + {4: "f", 8: "d"}.get(size, "?"), data)[0])
        signed = (node.text("Sign") or "Unsigned") == "Signed"
        if node.kind == "IntReg":
            return int.from_bytes(data, "big" if big else "little", signed=signed)
        low, width = self._bits(node, size)
        value = (int.from_bytes(data, "big" if big else "little") >> low) & ((1 << width) - 1)
        return value - (1 << width) if signed and value >> (width - 1) else value

    def _write_register(self, node: Node, value: Number) -> None:
        size, address = self._length(node), self._address(node)
        big = self._order(node) == "big"
        if node.kind == "FloatReg":
            self._port.write(address, struct.pack((">" if big else "<") + {4: "f", 8: "d"}.get(size, "?"), value))
            return
        signed = (node.text("Sign") or "Unsigned") == "Signed"
        order = "big" if big else "little"
        if node.kind == "IntReg":
            self._port.write(address, int(value).to_bytes(size, order, signed=signed))  # type: ignore[arg-type]
            return
        low, width = self._bits(node, size)
        least, most = (-(1 << (width - 1)), (1 << (width - 1)) - 1) if signed else (0, (1 << width) - 1)
        if not least <= int(value) <= most:
            raise ValueError(f"{value} doesn't fit into {width} bits")
        mask = ((1 << width) - 1) << low
        old = int.from_bytes(self._port.read(address, size), order)  # type: ignore[arg-type]
        new = (old & ~mask) | ((int(value) << low) & mask)
        self._port.write(address, new.to_bytes(size, order))  # type: ignore[arg-type]
