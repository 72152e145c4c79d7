"""Features through the reference implementation of GenApi: values, limits, and what a port or an XML does wrong."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.camera.genapi import GenApiFeatures
from drivers.errors import InstrumentError, NoAnswer

HEAD = (
    '<RegisterDescription ModelName="Made" VendorName="calibench" StandardNameSpace="None" SchemaMajorVersion="1" '
    'SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1" MinorVersion="0" SubMinorVersion="0" '
    'ProductGuid="5f1c26d2-4f0a-4d35-8f6e-6d0f5b0c1e01" VersionGuid="5f1c26d2-4f0a-4d35-8f6e-6d0f5b0c1e02" '
    'xmlns="http://www.genicam.org/GenApi/Version_1_1">'
)
REGISTER = (
    '<IntReg Name="{name}"><Address>{at}</Address><Length>{size}</Length><AccessMode>RW</AccessMode>'
    "<pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>LittleEndian</Endianess></IntReg>"
)
PORT = '<Port Name="Device"/>'


class Memory:
    """A port that is an array of bytes."""

    def __init__(self, size: int = 64) -> None:
        self.data = bytearray(size)

    def read(self, address: int, length: int) -> bytes:
        return bytes(self.data[address : address + length])

    def write(self, address: int, data: bytes) -> None:
        self.data[address : address + len(data)] = data


def features(body: str, memory: Memory | None = None) -> GenApiFeatures:
    xml = f"{HEAD}{body}{PORT}</RegisterDescription>"
    return GenApiFeatures.of_xml(xml.encode(), memory or Memory(), "camera X")


TIME = (
    '<Float Name="T"><pValue>C</pValue><Min>10</Min><Max>10000000</Max></Float>'
    '<Converter Name="C"><FormulaTo>FROM * 10</FormulaTo><FormulaFrom>TO / 10.0</FormulaFrom><pValue>R</pValue>'
    "</Converter>" + REGISTER.format(name="R", at=4, size=4)
)


@given(st.floats(10, 1e7))
def test_a_converted_value_comes_back_within_a_tick(us: float) -> None:
    """The register counts 0.1 us: half a tick, and the rounding of 1e7 in double precision; GenApi may cut."""
    camera = features(TIME)
    camera.set("T", us)
    assert camera.get("T") == pytest.approx(us, abs=0.1 + 1e-8)


def test_a_value_is_read_anew_each_time() -> None:
    memory = Memory()
    camera = features(TIME, memory)
    assert camera.get("T") == 0.0
    memory.data[4:8] = struct.pack("<I", 250)
    assert camera.get("T") == 25.0


def test_limits_are_told_and_kept() -> None:
    camera = features(TIME)
    assert camera.limits("T") == (10.0, 1e7)
    with pytest.raises(InstrumentError, match=r"camera X: feature T: Value 9\.000000 must be greater than or equal 10"):
        camera.set("T", 9.0)


def test_enumeration_boolean_command_text_and_availability() -> None:
    memory = Memory()
    memory.data[32:37] = b"hello"
    camera = features(
        '<Enumeration Name="Mode"><EnumEntry Name="Off"><Value>0</Value></EnumEntry>'
        '<EnumEntry Name="On"><Value>3</Value></EnumEntry><pValue>ModeR</pValue></Enumeration>'
        '<Boolean Name="Flag"><pValue>FlagR</pValue><OnValue>5</OnValue><OffValue>2</OffValue></Boolean>'
        '<Command Name="Go"><pValue>GoR</pValue><CommandValue>7</CommandValue></Command>'
        '<StringReg Name="Text"><Address>32</Address><Length>16</Length><AccessMode>RO</AccessMode>'
        "<pPort>Device</pPort></StringReg>"
        '<Integer Name="Gone"><pIsAvailable>No</pIsAvailable><Value>1</Value></Integer>'
        '<Integer Name="No"><Value>0</Value></Integer>'
        + "".join(REGISTER.format(name=f"{name}R", at=k, size=1) for k, name in enumerate(("Mode", "Flag", "Go"))),
        memory,
    )
    camera.set("Mode", "On")
    camera.set("Flag", False)
    camera.execute("Go")
    assert memory.data[:3] == bytes([3, 2, 7])
    assert (camera.get("Mode"), camera.get("Flag"), camera.get("Text")) == ("On", False, "hello")
    assert set(camera.entries("Mode")) == {"Off", "On"}
    assert (camera.has("No"), camera.has("Gone"), camera.has("Nothing")) == (True, False, False)
    with pytest.raises(InstrumentError, match="camera X: feature Mode: cannot convert value 'Auto'"):
        camera.set("Mode", "Auto")
    with pytest.raises(InstrumentError, match="camera X: the camera has no feature Gain"):
        camera.get("Gain")
    with pytest.raises(InstrumentError, match="camera X: feature Mode is of type Enumeration"):
        camera.execute("Mode")


def test_what_the_port_raises_comes_through() -> None:
    class Silent(Memory):
        def read(self, address: int, length: int) -> bytes:
            raise NoAnswer("camera X: no answer in 1 s; check the cable")

    with pytest.raises(NoAnswer, match="check the cable"):
        features(TIME, Silent()).get("T")


@pytest.mark.parametrize("xml", [b"", b"<", b"<a/>", b"\xff\xfe", HEAD.encode()])
def test_an_xml_that_cannot_be_read_is_one_line(xml: bytes) -> None:
    with pytest.raises(InstrumentError, match="camera X: the camera's XML can't be read: ") as caught:
        GenApiFeatures.of_xml(xml, Memory(), "camera X")
    assert "\n" not in str(caught.value)


@given(st.binary(max_size=200))
def test_no_bytes_break_the_reader_of_the_xml(xml: bytes) -> None:
    with pytest.raises(InstrumentError, match="XML"):
        GenApiFeatures.of_xml(xml, Memory(), "camera X")


def test_a_feature_that_refers_to_itself_is_refused() -> None:
    with pytest.raises(InstrumentError):
        features('<Integer Name="A"><pValue>B</pValue></Integer><Integer Name="B"><pValue>A</pValue></Integer>').get(
            "A"
        )
