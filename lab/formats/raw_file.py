"""Raw frames as .npy, 16-bit TIFF or DNG files. A file is written completely or not at all; an existing one is replaced
at the end.

A DNG holds the codes as they are, uncompressed, with mosaic, black and white level, and a colour matrix from the
camera's own quantum efficiency; a MONO frame is its `LinearRaw` of one sample. (Adobe, Digital Negative Specification
1.7.1.)"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from lab.errors import InputError, cannot_write
from sim.camera import CameraModel
from sim.parameters import Frozen, Quantity
from sim.scene.colorchecker import reflectances
from sim.scene.light import colour_science, illuminant
from sim.spectrum import FloatArray, Spectrum, photons_from_energy, quadrature

Frame = NDArray[np.uint16]

#: What TIFF calls a colour-filter array, and DNG a raw image without one.
CFA_PHOTOMETRIC, LINEAR_RAW = 32803, 34892
#: Field types of TIFF.
BYTE, ASCII, SHORT, LONG, RATIONAL, SRATIONAL = 1, 2, 3, 4, 5, 10
#: EXIF's number of the illuminant that a DNG's colour matrix holds for: D65.
D65 = 21


class RawMetadata(Frozen):
    """Metadata of a frame in a file, besides the camera's parameters.

    `neutral`: codes above black of a white surface by channel, up to a common factor; empty: those in daylight (D65).
    """

    exposure_s: Annotated[float, Quantity("s", "exposure", lower=0.0)]
    gain_db: Annotated[float, Quantity("dB", "analogue gain")] = 0.0
    camera_name: str = "calibench camera"
    software: str = "calibench"
    neutral: dict[str, float] | None = None


@contextlib.contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """Yield a temporary file beside `file`, which replaces `file` when the block succeeds, and is removed when it
    fails.

    Raises InputError where the folder can't be written to.
    """
    try:
        handle, name = tempfile.mkstemp(prefix=f".{file.name}.", dir=file.parent)
    except OSError as error:
        raise cannot_write(file, error, "name a file in a folder that exists") from error
    os.close(handle)
    partial = Path(name)
    try:
        yield partial
        partial.chmod(0o644)
        with partial.open("rb") as stream:
            os.fsync(stream.fileno())
        partial.replace(file)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:  # of a full disk, the system names no file
            raise OSError(error.errno, error.strerror, str(file)) from error
        raise


def write_raw(file: Path, frame: Frame, camera: CameraModel, metadata: RawMetadata) -> None:
    """Write one frame of codes; the ending of the file says how: .npy, .tif or .tiff, .dng.

    file : to be written
    frame : (rows, cols), DN
    camera : whose frame it is
    metadata : exposure, gain and names

    Raises InputError for another ending, a folder that can't be written to, and a frame that isn't this camera's.

    >>> from tempfile import TemporaryDirectory
    >>> from lab.formats.camera_file import default_camera
    >>> camera = default_camera().camera
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "flat.npy"
    ...     write_raw(file, np.full((camera.rows, camera.cols), 64, np.uint16), camera, RawMetadata(exposure_s=0.01))
    ...     np.load(file).shape
    (960, 1280)
    """
    writer = writer_of(file)
    if frame.dtype != np.uint16 or frame.shape != (camera.rows, camera.cols):
        raise InputError(
            f"{file}: the frame is {frame.dtype} {frame.shape}, this camera's are uint16 "
            f"{(camera.rows, camera.cols)}; give its own frame"
        )
    highest = int(frame.max(initial=0))
    if highest > camera.white_level_dn:
        raise InputError(
            f"{file}: the frame holds {highest} DN, above the limit of the white level {camera.white_level_dn:g} DN; "
            "give the camera's own white level"
        )
    with replacing(file) as partial:
        writer(partial, np.ascontiguousarray(frame), camera, metadata)


def writer_of(file: Path) -> Callable[[Path, Frame, CameraModel, RawMetadata], None]:
    """Return the function that writes files of an ending. Raises InputError for an ending that isn't known.

    >>> callable(writer_of(Path("edge.dng")))
    True
    """
    known = {".npy": _write_npy, ".tif": _write_tiff, ".tiff": _write_tiff, ".dng": _write_dng}
    if file.suffix.lower() not in known:
        raise InputError(
            f"{file}: a raw frame can't be {file.suffix or 'without an ending'}; end it in .npy, .tif or .dng"
        )
    return known[file.suffix.lower()]


def _write_npy(file: Path, frame: Frame, camera: CameraModel, metadata: RawMetadata) -> None:
    with file.open("wb") as stream:
        np.save(stream, frame)


class TiffDescription(Frozen):
    """What stands in a TIFF's ImageDescription, as JSON."""

    format: str = "calibench-raw"
    version: int = 1
    cfa: str
    bit_depth: int
    black_level_dn: float
    white_level_dn: float
    conversion_gain_dn_per_e: float
    exposure_s: float
    gain_db: float
    camera_name: str


def _write_tiff(file: Path, frame: Frame, camera: CameraModel, metadata: RawMetadata) -> None:
    import tifffile

    description = TiffDescription(
        cfa=camera.cfa,
        bit_depth=camera.bit_depth,
        black_level_dn=camera.black_level_dn,
        white_level_dn=camera.white_level_dn,
        conversion_gain_dn_per_e=camera.conversion_gain_dn_per_e,
        exposure_s=metadata.exposure_s,
        gain_db=metadata.gain_db,
        camera_name=metadata.camera_name,
    )
    tifffile.imwrite(
        file,
        frame,
        photometric="minisblack",
        description=description.model_dump_json(),
        metadata=None,
        software=metadata.software,
    )


def _write_dng(file: Path, frame: Frame, camera: CameraModel, metadata: RawMetadata) -> None:
    import tifffile

    mono = camera.cfa == "MONO"
    tags: list[tuple[int, int, int, Any]] = [
        _tag(271, ASCII, "calibench"),  # Make
        _tag(272, ASCII, metadata.camera_name),  # Model
        _tag(274, SHORT, [1]),  # Orientation: as stored
        _tag(33434, RATIONAL, [metadata.exposure_s]),  # ExposureTime
        _tag(50706, BYTE, [1, 4, 0, 0]),  # DNGVersion
        _tag(50707, BYTE, [1, 1, 0, 0]),  # DNGBackwardVersion
        _tag(50708, ASCII, metadata.camera_name),  # UniqueCameraModel
        _tag(50713, SHORT, [1, 1]),  # BlackLevelRepeatDim
        _tag(50714, RATIONAL, [camera.black_level_dn]),  # BlackLevel
        _tag(50717, LONG, [round(camera.white_level_dn)]),  # WhiteLevel
        _tag(50778, SHORT, [D65]),  # CalibrationIlluminant1
    ]
    if not mono:
        letters = {"R": 0, "G": 1, "B": 2}
        neutral = metadata.neutral or dict(zip("RGB", colour_matrix(camera) @ _white_xyz(), strict=True))
        most = max(neutral.values())
        tags += [
            _tag(33421, SHORT, [2, 2]),  # CFARepeatPatternDim
            _tag(33422, BYTE, [letters[letter] for letter in camera.cfa]),  # CFAPattern
            _tag(50710, BYTE, [0, 1, 2]),  # CFAPlaneColor
            _tag(50711, SHORT, [1]),  # CFALayout: rectangular
            _tag(50721, SRATIONAL, colour_matrix(camera).ravel().tolist()),  # ColorMatrix1
            _tag(50728, RATIONAL, [max(neutral[channel] / most, 1e-4) for channel in "RGB"]),  # AsShotNeutral
        ]
    tifffile.imwrite(
        file,
        frame,
        photometric=CFA_PHOTOMETRIC,
        description=None,
        metadata=None,
        software=metadata.software,
        subfiletype=0,
        extratags=[(*tag, True) for tag in tags],
    )
    if mono:  # the library wants three samples of a linear raw, DNG doesn't
        with tifffile.TiffFile(file, mode="r+") as tiff:
            tiff.pages[0].tags["PhotometricInterpretation"].overwrite(LINEAR_RAW)


def _tag(code: int, kind: int, value: Any) -> tuple[int, int, int, Any]:
    """(code, type, count, value) as tifffile wants it; numbers of rational tags become numerators and denominators."""
    if kind == ASCII:
        return code, kind, 0, value.encode("ascii", "replace").decode("ascii")
    if kind in (RATIONAL, SRATIONAL):
        # 1e6: numerators of the codes and matrices here stay below 2^31
        parts = [Fraction(float(number)).limit_denominator(1_000_000) for number in value]
        return code, kind, len(value), tuple(n for part in parts for n in (part.numerator, part.denominator))
    return code, kind, len(value), tuple(value)


def colour_matrix(camera: CameraModel) -> FloatArray:
    """Return the matrix from CIE XYZ to this camera's R, G, B under D65 (3, 3), as DNG's ColorMatrix1 wants it: white
    has a greatest code of 1.

    Least squares over the 24 patches of the ColorChecker. A camera channel is the electrons from the patch over those
    from white. Raises ValueError for a MONO camera, which has no colours."""
    if camera.cfa == "MONO":
        raise ValueError("a MONO camera has no colour matrix: ask for one of a camera with R, G and B")
    key = tuple(camera.quantum_efficiency[channel] for channel in "RGB")
    return _colour_matrix(key).copy()


@cache
def _colour_matrix(efficiency: tuple[Spectrum, ...]) -> FloatArray:
    light = daylight()
    patches = list(reflectances().values())
    xyz = np.stack([[_product(light, curve, patch) for curve in _matching()] for patch in patches])
    codes = np.stack([[electrons_of(light, curve, patch) for curve in efficiency] for patch in patches])
    white = np.array([electrons_of(light, curve) for curve in efficiency])
    matrix = np.linalg.lstsq(xyz / _product(light, _matching()[1]), codes / white.max(), rcond=None)[0].T
    return np.asarray(matrix / np.max(matrix @ _white_xyz()))


def electrons_of(light: Spectrum, efficiency: Spectrum, reflectance: Spectrum | None = None) -> float:
    """Return a number proportional to the electrons of a channel.

    light : W per nm
    efficiency : quantum efficiency of the channel
    reflectance : of the patch that reflects the light; by default 1

    >>> flat = Spectrum(wavelength_nm=(400.0, 700.0), value=(1.0, 1.0))
    >>> grey = Spectrum(wavelength_nm=(400.0, 700.0), value=(0.18, 0.18))
    >>> round(electrons_of(flat, flat, grey) / electrons_of(flat, flat), 2)
    0.18
    """
    curves = [light, efficiency, *([reflectance] if reflectance is not None else [])]
    wavelength_nm, weight = quadrature(curves)
    seen = photons_from_energy(wavelength_nm, light.at(wavelength_nm)) * efficiency.at(wavelength_nm)
    return float(np.sum(weight * seen * (1.0 if reflectance is None else reflectance.at(wavelength_nm))))


def _product(*curves: Spectrum) -> float:
    wavelength_nm, weight = quadrature(curves)
    return float(np.sum(weight * np.prod([curve.at(wavelength_nm) for curve in curves], axis=0)))


@cache
def daylight() -> Spectrum:
    """Return CIE D65 at 100 cd/m^2 of a white diffuser, W sr^-1 m^-2 nm^-1.

    >>> daylight().wavelength_nm[0] < 400.0 < daylight().wavelength_nm[-1]
    True
    """
    return illuminant("D65", 100.0)


@cache
def _matching() -> tuple[Spectrum, ...]:
    """Colour-matching functions x, y, z of the CIE 1931 observer."""
    curves = colour_science().MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    return tuple(Spectrum.of(curves.wavelengths, curves.values[:, k]) for k in range(3))


@cache
def _white_xyz() -> FloatArray:
    """XYZ of a perfect white diffuser under D65, Y = 1."""
    xyz = np.array([_product(daylight(), curve) for curve in _matching()])
    return xyz / xyz[1]
