"""A camera's spectral sensitivities as raw converters take them: rawtoaces JSON, Adobe DCP, ICC input profile.

The matrices are least-squares fits over 190 training reflectances (AMPAS, with colour-science) that keep white exactly:
camera to XYZ for an ICC profile and a DCP's ForwardMatrix, XYZ to camera for its ColorMatrix (DNG 1.4, ICC.1:2001).
A camera file's quantum efficiencies are electrons a photon; what a converter takes is in proportion to energy.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import numpy as np

from lab.errors import InputError
from lab.formats.camera_file import CameraFile
from lab.formats.raw_file import replacing
from sim.camera import CameraModel
from sim.scene.light import colour_science
from sim.spectrum import FloatArray

#: The wavelengths (nm) of rawtoaces' camera files.
GRID_NM = np.arange(380.0, 781.0, 5.0)
CHANNELS = ("R", "G", "B")
#: Illuminants of a DCP's two sets of matrices, and their numbers in EXIF's LightSource.
DCP_LIGHTS = {"A": 17, "D65": 21}
#: XYZ of the profile connection space's white, as ICC rounds D50.
PCS_WHITE = np.array([0.9642, 1.0, 0.8249])


def _of_colour(camera: CameraModel, file: Path) -> CameraModel:
    if camera.cfa == "MONO":
        raise InputError(f"{file}: the camera has no colour filters (cfa is MONO); a profile is of red, green and blue")
    return camera


def energy_sensitivities(camera: CameraModel) -> FloatArray:
    """Return the sensitivity to energy of R, G, B (columns) at `GRID_NM` (rows): efficiency x wavelength, the highest
    1.

    >>> from lab.formats.camera_file import default_camera
    >>> float(energy_sensitivities(default_camera().camera).max())
    1.0
    """
    curves = np.stack([camera.quantum_efficiency[channel].at(GRID_NM) * GRID_NM for channel in CHANNELS], axis=1)
    return np.asarray(curves / curves.max())


def list_losses(content: CameraFile) -> tuple[str, ...]:
    """Return a remark on the effects of a camera file, which its curves don't have; none where it has no effects.

    >>> from lab.formats.camera_file import default_camera
    >>> list_losses(default_camera())
    ()
    """
    names = ", ".join(effect.name for effect in content.effects)
    return (f"the curves are those of quantum_efficiency: effects aren't in them ({names})",) if names else ()


def write_rawtoaces(file: Path, content: CameraFile) -> tuple[str, ...]:
    """Write the sensitivities as rawtoaces' camera JSON (schema 1.0.0). InputError for a MONO camera."""
    curves = energy_sensitivities(_of_colour(content.camera, file))
    document = {
        "header": {
            "schema_version": "1.0.0",
            "manufacturer": "calibench",
            "model": content.name,
            "description": "camera spectral sensitivity data, in proportion to energy",
            "document_creator": f"calibench {metadata.version('calibench')}",
            "document_creation_date": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            "measurement_equipment": None,
            "laboratory": None,
            "license": None,
        },
        "spectral_data": {
            "units": "relative",
            "index": {"main": list(CHANNELS)},
            "data": {"main": {f"{nm:g}": row.tolist() for nm, row in zip(GRID_NM, curves, strict=True)}},
        },
    }
    with replacing(file) as partial:
        partial.write_text(json.dumps(document, indent=4) + "\n", encoding="utf-8")
    return list_losses(content)


def colour_matrices(camera: CameraModel, light: str) -> tuple[FloatArray, FloatArray]:
    """Return (ColorMatrix, ForwardMatrix), 3 x 3 each, of a camera under an illuminant.

    camera : with quantum efficiencies of R, G, B
    light : name of an illuminant of colour-science

    ColorMatrix: XYZ under that light (white of Y = 1) to the camera's own signals, the greatest of white 1.
    ForwardMatrix: signals divided by white's to XYZ under D50. White is kept exactly by both (DNG 1.7.1, chapter 6).

    >>> from lab.formats.camera_file import default_camera
    >>> colour, forward = colour_matrices(default_camera().camera, "D65")
    >>> (forward @ np.ones(3)).round(3).tolist()  # XYZ of D50
    [0.964, 1.0, 0.825]
    """
    colour = colour_science()
    sensitivity = energy_sensitivities(camera)
    shape = colour.SpectralShape(GRID_NM[0], GRID_NM[-1], GRID_NM[1] - GRID_NM[0])
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape).values
    power = colour.SDS_ILLUMINANTS[light].copy().align(shape).values
    reflectance = (
        colour.characterisation.read_training_data_rawtoaces_v1().align(shape).values
    )  # (wavelengths, patches)
    stimulus = np.concatenate([np.ones((len(GRID_NM), 1)), reflectance], axis=1) * power[:, None]
    xyz, signal = stimulus.T @ observer, stimulus.T @ sensitivity
    xyz, signal = xyz / xyz[0, 1], signal / signal[0].max()
    adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries(xyz[0], PCS_WHITE, transform="Bradford")
    adapted = xyz @ adapt.T
    return _fit_keeping_white(xyz, signal), _fit_keeping_white(signal / signal[0], adapted * (PCS_WHITE / adapted[0]))


def _fit_keeping_white(source: FloatArray, target: FloatArray) -> FloatArray:
    """M (3, 3) with target = M source in least squares over the rows, exactly in the first: white."""
    normal = np.zeros((4, 4))
    normal[:3, :3] = source[1:].T @ source[1:]
    normal[:3, 3] = normal[3, :3] = source[0]
    right = np.concatenate([source[1:].T @ target[1:], target[:1]])
    return np.asarray(np.linalg.solve(normal, right)[:3].T)


_ASCII, _SHORT, _LONG, _SRATIONAL, _FLOAT = 2, 3, 4, 10, 11
_DENOMINATOR = 1_000_000


def write_dcp(file: Path, content: CameraFile) -> tuple[str, ...]:
    """Write a DNG camera profile: matrices under A and D65, and a tone curve that leaves the light linear.

    Returns remarks; raises InputError for a MONO camera.
    """
    camera = _of_colour(content.camera, file)
    (colour_1, forward_1), (colour_2, forward_2) = (colour_matrices(camera, light) for light in DCP_LIGHTS)
    entries: list[tuple[int, int, int, bytes]] = [
        _ascii(50708, content.name or "camera"),  # UniqueCameraModel
        _matrix(50721, colour_1),
        _matrix(50722, colour_2),
        *((50778 + n, _SHORT, 1, struct.pack("<H", number)) for n, number in enumerate(DCP_LIGHTS.values())),
        _ascii(50932, "calibench"),  # ProfileCalibrationSignature
        _ascii(50936, f"calibench {content.name}".strip()),  # ProfileName
        (50940, _FLOAT, 4, struct.pack("<4f", 0.0, 0.0, 1.0, 1.0)),  # ProfileToneCurve
        (50941, _LONG, 1, struct.pack("<I", 3)),  # ProfileEmbedPolicy: no restrictions
        _ascii(50942, "no copyright"),
        _matrix(50964, forward_1),
        _matrix(50965, forward_2),
    ]
    with replacing(file) as partial:
        partial.write_bytes(_tiff(entries))
    return list_losses(content)


def _ascii(tag: int, text: str) -> tuple[int, int, int, bytes]:
    data = text.encode("ascii", "replace") + b"\0"
    return tag, _ASCII, len(data), data


def _matrix(tag: int, matrix: FloatArray) -> tuple[int, int, int, bytes]:
    numbers = [value for element in matrix.ravel() for value in (round(float(element) * _DENOMINATOR), _DENOMINATOR)]
    return tag, _SRATIONAL, 9, struct.pack("<18i", *numbers)


def _tiff(entries: Sequence[tuple[int, int, int, bytes]]) -> bytes:
    """Return a TIFF of one directory, with DCP's magic number `RC` in place of 42."""
    head = struct.pack("<2s2sIH", b"II", b"RC", 8, len(entries))
    data_at = len(head) + 12 * len(entries) + 4
    directory, data = b"", b""
    for tag, kind, count, value in entries:
        directory += struct.pack("<HHI", tag, kind, count)
        if len(value) <= 4:
            directory += value.ljust(4, b"\0")
        else:
            directory += struct.pack("<I", data_at + len(data))
            data += value + b"\0" * (len(value) % 2)
    return head + directory + struct.pack("<I", 0) + data


def write_icc(file: Path, content: CameraFile) -> tuple[str, ...]:
    """Write an ICC input profile (version 2.4, matrix and linear curves) of signals that are white-balanced under D65.

    Returns remarks; raises InputError for a MONO camera.
    """
    _, forward = colour_matrices(_of_colour(content.camera, file), "D65")
    name = f"calibench {content.name}".strip().encode("ascii", "replace") + b"\0"
    tags: dict[bytes, bytes] = {
        b"desc": b"desc" + struct.pack(">4xI", len(name)) + name + bytes(4 + 4 + 2 + 1 + 67),
        b"cprt": b"text\0\0\0\0no copyright\0",
        b"wtpt": _xyz(PCS_WHITE),
    }
    for channel, column in zip((b"r", b"g", b"b"), forward.T, strict=True):
        tags[channel + b"XYZ"] = _xyz(column)
        tags[channel + b"TRC"] = b"curv" + struct.pack(">4xI", 0)  # no entries: the identity
    table, data, at = struct.pack(">I", len(tags)), b"", 128 + 4 + 12 * len(tags)
    for key, value in tags.items():
        padded = value + b"\0" * (-len(value) % 4)
        table += key + struct.pack(">II", at + len(data), len(value))
        data += padded
    made = datetime.now(UTC)
    head = struct.pack(
        ">I4sI4s4s4s6H4s4sI4s4sQI12s4s44x",
        128 + len(table) + len(data), b"\0" * 4, 0x02400000, b"scnr", b"RGB ", b"XYZ ",
        made.year, made.month, made.day, made.hour, made.minute, made.second,
        b"acsp", b"\0" * 4, 0, b"\0" * 4, b"\0" * 4, 0, 0, _xyz(PCS_WHITE)[8:], b"\0" * 4,
    )  # fmt: skip
    with replacing(file) as partial:
        partial.write_bytes(head + table + data)
    return list_losses(content)


def _xyz(value: FloatArray) -> bytes:
    """Return an XYZType of one colour, in s15Fixed16."""
    return b"XYZ " + struct.pack(">4x3i", *(round(float(component) * 65536) for component in value))
