"""The GenApi reader: formulas against Python's own arithmetic, registers against bytes written by hand."""

from __future__ import annotations

import contextlib
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.camera.formula import Formula
from drivers.camera.genapi import NodeMap
from drivers.errors import InstrumentError

HEAD = '<RegisterDescription xmlns="http://www.genicam.org/GenApi/Version_1_1">'


class Memory:
    """A port that is an array of bytes."""

    def __init__(self, size: int = 64) -> None:
        self.data = bytearray(size)

    def read(self, address: int, length: int) -> bytes:
        return bytes(self.data[address : address + length])

    def write(self, address: int, data: bytes) -> None:
        self.data[address : address + len(data)] = data


def nodes(body: str, memory: Memory | None = None) -> NodeMap:
    return NodeMap((HEAD + body + "</RegisterDescription>").encode(), memory or Memory())


def value(text: str, **variables: float) -> float:
    return Formula(text)({name: lambda v=v: v for name, v in variables.items()})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1 + 2 * 3", 7),
        ("(1 + 2) * 3", 9),
        ("2 ** 3 ** 2", 512),
        ("-7 / 2", -3),  # C truncates towards zero
        ("-7 % 2", -1),
        ("7.0 / 2", 3.5),
        ("0xFF & 0x0F", 15),
        ("1 << 4 | 1", 17),
        ("5 ^ 3", 6),
        ("~0", -1),
        ("3 = 3 && 2 <> 3", 1),
        ("1 > 2 ? 10 : 1 > 0 ? 20 : 30", 20),
        ("0 && (1 / 0)", 0),  # the right side isn't looked at
        ("SGN(-3) + NEG(2) + ABS(-5)", 2),
        ("ROUND(2.5) + ROUND(-2.5)", 0),
        ("ROUND(3.14159, 2)", 3.14),
        ("TRUNC(-2.7) + FLOOR(-2.2) + CEIL(2.2)", -2),
        ("LN(E()) + LG(100) + SQRT(16)", 7),
        ("SIN(PI() / 2)", 1),
        ("1e-3 * 5", 0.005),
        (".5 + 1.", 1.5),
    ],
)
def test_formula(text: str, expected: float) -> None:
    assert value(text) == pytest.approx(expected)


numbers = st.integers(-1000, 1000)


@st.composite
def arithmetic(draw: st.DrawFn, depth: int = 3) -> str:
    """A formula that Python reads the same way."""
    if depth == 0 or draw(st.booleans()):
        return draw(st.one_of(numbers.map(lambda n: f"({n})"), st.sampled_from(["A", "B"])))
    operator = draw(st.sampled_from(["+", "-", "*", "&", "|", "^", "<", ">=", "**2 +"]))
    left, right = draw(arithmetic(depth - 1)), draw(arithmetic(depth - 1))
    return f"({left}) {operator} ({right})"


@given(arithmetic(), numbers, numbers)
def test_formula_agrees_with_python(text: str, a: int, b: int) -> None:
    ours = value(text, A=a, B=b)
    assert ours == int(eval(text, {"A": a, "B": b}))


@given(st.text(alphabet="01.eE+-*/%()<>=&|^~?:, ABxRWSGN", max_size=40))
def test_no_text_breaks_the_formula_reader(text: str) -> None:
    with contextlib.suppress(ValueError, InstrumentError):  # what it is allowed to say
        value(text, A=1, B=2)


@pytest.mark.parametrize("text", ["", "1 +", "(1", "1 2", "FOO(1)", "1 $ 2", "(" * 100 + "1" + ")" * 100])
def test_refused_formulas(text: str) -> None:
    with pytest.raises(ValueError, match="formula"):
        Formula(text)


@given(st.binary(max_size=200))
def test_no_bytes_break_the_xml_reader(xml: bytes) -> None:
    try:
        NodeMap(xml, Memory())
    except InstrumentError as error:
        assert "XML" in str(error)


INT = (
    '<IntReg Name="A"><Address>{at}</Address><Length>{size}</Length><AccessMode>RW</AccessMode><pPort>Device</pPort>'
    "<Sign>{sign}</Sign><Endianess>{order}</Endianess></IntReg>"
)


@given(st.sampled_from([1, 2, 4, 8]), st.booleans(), st.booleans(), st.data())
def test_integers_come_back(size: int, signed: bool, big: bool, data: st.DataObject) -> None:
    low, high = (-(1 << 8 * size - 1), (1 << 8 * size - 1) - 1) if signed else (0, (1 << 8 * size) - 1)
    number = data.draw(st.integers(low, high))
    memory = Memory()
    camera = nodes(
        INT.format(
            at=8, size=size, sign="Signed" if signed else "Unsigned", order="BigEndian" if big else "LittleEndian"
        ),
        memory,
    )
    camera.set("A", number)
    assert memory.read(8, size) == number.to_bytes(size, "big" if big else "little", signed=signed)
    assert camera.get("A") == number


@given(st.integers(0, 31), st.integers(0, 31), st.booleans(), st.integers(0, 2**32 - 1), st.data())
def test_bits_leave_their_neighbours_alone(one: int, two: int, big: bool, before: int, data: st.DataObject) -> None:
    low, high = min(one, two), max(one, two)
    order = "big" if big else "little"
    # a big-endian register's bits count from the left
    msb, lsb = (31 - high, 31 - low) if big else (high, low)
    memory = Memory()
    memory.write(0, before.to_bytes(4, order))
    camera = nodes(
        f'<MaskedIntReg Name="A"><Address>0</Address><Length>4</Length><LSB>{lsb}</LSB><MSB>{msb}</MSB>'
        f"<Endianess>{'BigEndian' if big else 'LittleEndian'}</Endianess></MaskedIntReg>",
        memory,
    )
    number = data.draw(st.integers(0, (1 << high - low + 1) - 1))
    camera.set("A", number)
    assert camera.get("A") == number
    mask = ((1 << high - low + 1) - 1) << low
    assert int.from_bytes(memory.read(0, 4), order) & ~mask == before & ~mask & 0xFFFFFFFF


CONVERTER = (
    '<Float Name="T"><pValue>C</pValue><Min>10</Min><Max>1e7</Max></Float>'
    '<Converter Name="C"><pVariable Name="K">K</pVariable><FormulaTo>FROM * K</FormulaTo><FormulaFrom>TO / '
    "K</FormulaFrom>"
    '<pValue>R</pValue></Converter><Float Name="K"><Value>10</Value></Float>'
    '<IntReg Name="R"><Address>4</Address><Length>4</Length><Endianess>LittleEndian</Endianess></IntReg>'
)


@given(st.floats(10, 1e7))
def test_converter_round_trip(us: float) -> None:
    camera = nodes(CONVERTER)
    camera.set("T", us)
    # half a tick of 0.1 us, and the rounding of 1e7 in double precision
    assert camera.get("T") == pytest.approx(us, abs=0.05 + 1e-8)


def test_limits_are_kept() -> None:
    camera = nodes(CONVERTER)
    assert camera.limits("T") == (10, 1e7)
    assert camera.limits("K") == (-math.inf, math.inf)
    with pytest.raises(InstrumentError, match=r"T: 9 is outside 10\.\.1e\+07"):
        camera.set("T", 9)


def test_enumeration_boolean_command_text_and_float() -> None:
    memory = Memory()
    memory.data[32:37] = b"hello"
    memory.data[16:20] = struct.pack(">f", 1.5)
    reg = '<IntReg Name="{n}R"><Address>{a}</Address><Length>1</Length><Endianess>LittleEndian</Endianess></IntReg>'
    camera = nodes(
        '<Group Comment="all"><Enumeration Name="Mode"><EnumEntry Name="Off"><Value>0</Value></EnumEntry>'
        '<EnumEntry Name="On"><Value>0x3</Value></EnumEntry><pValue>ModeR</pValue></Enumeration></Group>'
        + reg.format(n="Mode", a=0)
        + '<Boolean Name="Flag"><pValue>FlagR</pValue><OnValue>5</OnValue><OffValue>2</OffValue></Boolean>'
        + reg.format(n="Flag", a=1)
        + '<Command Name="Go"><pValue>GoR</pValue><CommandValue>7</CommandValue></Command>'
        + reg.format(n="Go", a=2)
        + '<StringReg Name="Text"><Address>32</Address><Length>16</Length></StringReg>'
        + '<FloatReg Name="F"><Address>0</Address><pAddress>Base</pAddress><Length>4</Length><Endianess>BigEndian</Endianess></FloatReg>'  # noqa: E501
        + '<Integer Name="Base"><Value>16</Value></Integer>'
        + '<SwissKnife Name="Twice"><pVariable Name="X">F</pVariable><Constant Name="TWO">2</Constant>'
        + '<Expression Name="XX">X * TWO</Expression><Formula>XX + Y.Max</Formula><pVariable '
        'Name="Y.Max">Lim.Max</pVariable></SwissKnife>'
        + '<Integer Name="Lim"><Value>1</Value><Max>100</Max></Integer>',
        memory,
    )
    camera.set("Mode", "On")
    camera.set("Flag", False)
    camera.execute("Go")
    assert memory.data[:3] == bytes([3, 2, 7])
    assert camera.get("Mode") == "On"
    assert camera.number("Mode") == 3
    assert camera.get("Flag") is False
    assert camera.get("Text") == "hello"
    assert camera.get("F") == 1.5
    assert camera.get("Twice") == 103.0
    assert camera.entries("Mode") == {"Off": 0, "On": 3}
    with pytest.raises(InstrumentError, match="takes Off, On, not 'Auto'"):
        camera.set("Mode", "Auto")
    with pytest.raises(InstrumentError, match="no feature Gain"):
        camera.get("Gain")
    with pytest.raises(InstrumentError, match="not a command"):
        camera.execute("Mode")


def test_a_feature_that_refers_to_itself_is_refused() -> None:
    camera = nodes('<Integer Name="A"><pValue>B</pValue></Integer><Integer Name="B"><pValue>A</pValue></Integer>')
    with pytest.raises(InstrumentError, match="refers to itself"):
        camera.get("A")


def test_availability() -> None:
    camera = nodes(
        '<Integer Name="A"><pIsAvailable>No</pIsAvailable><Value>1</Value></Integer><Integer '
        'Name="No"><Value>0</Value></Integer>'
    )
    assert not camera.has("A")
    assert camera.has("No")
    assert not camera.has("Nothing")


def test_struct_register_and_index() -> None:
    memory = Memory()
    memory.data[8:12] = bytes([0, 0, 0x50, 0x01])
    camera = nodes(
        "<StructReg><Address>0</Address><Length>4</Length><Endianess>LittleEndian</Endianess><pIndex "
        'Offset="8">Sel</pIndex>'
        '<StructEntry Name="Low"><LSB>16</LSB><MSB>19</MSB></StructEntry><StructEntry '
        'Name="High"><LSB>20</LSB><MSB>23</MSB></StructEntry>'
        '<StructEntry Name="Bit"><Bit>24</Bit></StructEntry></StructReg><Integer Name="Sel"><Value>1</Value></Integer>',
        memory,
    )
    assert (camera.get("Low"), camera.get("High"), camera.get("Bit")) == (0, 5, 1)
    with pytest.raises(InstrumentError, match="doesn't fit into 4 bits"):
        camera.set("Low", 16)
