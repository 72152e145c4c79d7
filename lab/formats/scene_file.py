"""Scenes and lights from files and by name: measured lights (CSV), pictures, spectral cubes (ENVI, .npz).

Every function reads one file and returns a model; all errors are an `InputError` of one line that begins with the file.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.errors import InputError, one_line
from lab.formats.cgats import parse_cgats
from lab.formats.pictures import read_picture as read_samples
from lab.formats.spectrum_csv import parse_curve
from sim.camera import CameraModel
from sim.scene import Scene, SpectralImage
from sim.scene.catalogue import Cube, PictureOnScreen, View, scene_by_name, scenes
from sim.scene.light import at_luminance, illuminant
from sim.spectrum import FloatArray, Spectrum, energy_from_photons

#
# A layer's channels are those of the spectral OpenEXR layout (Fichet, Pacanowski, Wilkie, JCGT 10 (3), 2021; PBRT
# writes it): `S0.550,000000nm`, radiance in W sr^-1 m^-2 nm^-1; or ISET3d's `Radiance.C01` .. `C31`, 400 to 700 nm,
# alike. What stands before them in a channel's name, or the name of a part, is the light's: `lamp.S0.550,0nm`. OpenEXR
# is an extra.


#: A radiance's channel: light, wavelength with comma or point, unit.
_BAND = re.compile(r"(?:(.*)\.)?S0\.(\d+(?:[.,]\d+)?)nm", re.I)
_NUMBERED = re.compile(r"(?:(.*)\.)?Radiance\.C(\d+)", re.I)
#: First and last wavelength (nm) of numbered channels, by their number.
_NUMBERED_NM = {31: (400.0, 700.0), 16: (400.0, 700.0)}
#: Begins the key that scales a light among a scene's parameters.
WEIGHT = "light."
#: Most samples of a scene; more are taken for a mistake. 4 GiB as float64.
MOST_EXR_SAMPLES = 2**29


def read_exr(file: Path, weights: Mapping[str, float] | None = None) -> SpectralImage:
    """Return the scene in an OpenEXR file: the sum of its lights, each times its weight (1 where none is given).

    Raises InputError, without the path, for a file without spectra, and for a weight of a light that isn't in it.
    """
    lights = exr_lights(file)
    weights = weights or {}
    if unknown := [name for name in weights if name not in lights]:
        raise InputError(f"it has no light {unknown[0]!r}; its lights are {', '.join(lights)}")
    if wrong := [name for name, weight in weights.items() if not 0 <= weight < np.inf]:
        raise InputError(f"{WEIGHT}{wrong[0]} is {weights[wrong[0]]:g}, not a number of 0 or more; correct it")
    grids = {image.wavelength_nm for image in lights.values()}
    if len(grids) > 1:
        raise InputError("its lights have different wavelengths; render them with the same bands")
    total = sum(image.radiance * image.radiance.dtype.type(weights.get(name, 1.0)) for name, image in lights.items())
    return SpectralImage(grids.pop(), np.asarray(total))


def exr_lights(file: Path) -> dict[str, SpectralImage]:
    """Return the radiance of each light by its name, `scene` where it has none. Raises InputError without the path."""
    try:
        import OpenEXR
    except ImportError as error:
        raise InputError("needs the library OpenEXR; install calibench with its extra exr") from error
    try:
        with OpenEXR.File(str(file), separate_channels=True) as opened:
            parts = [(str(part.name()) if len(opened.parts) > 1 else "", part) for part in opened.parts]
            bands_of_light: dict[str, dict[float, NDArray[Any]]] = {}
            named: list[str] = []
            for prefix, part in parts:
                named += part.channels
                for light, bands in _bands(part.channels, prefix).items():
                    bands_of_light.setdefault(light, {}).update(bands)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"can't be read as OpenEXR ({one_line(error)}); copy it again") from error
    if not bands_of_light:
        raise InputError(
            f"has no radiance by wavelength (its channels are {', '.join(named[:6])}); name them S0.550,0nm, ..., as "
            "PBRT writes them, or Radiance.C01 to C31"
        )
    lights = {}
    for name, bands in bands_of_light.items():
        wavelength_nm = sorted(bands)
        if len(wavelength_nm) * bands[wavelength_nm[0]].size > MOST_EXR_SAMPLES:
            raise InputError("has more than 4 GiB of samples; cut the scene")
        if any(band.shape != bands[wavelength_nm[0]].shape for band in bands.values()):
            raise InputError(f"the bands of {name} have several sizes; render them alike")
        try:
            cube = np.stack([bands[nm].astype(np.float32, copy=False) for nm in wavelength_nm], axis=-1)
            lights[name] = SpectralImage(tuple(wavelength_nm), cube)
        except ValueError as error:
            raise InputError(f"light {name}: {one_line(error)}") from error
    return lights


def _bands(channels: Mapping[str, Any], prefix: str) -> dict[str, dict[float, NDArray[Any]]]:
    """Light -> wavelength (nm) -> samples, of the channels that hold a radiance."""
    bands_of_light: dict[str, dict[float, NDArray[Any]]] = {}
    numbered: dict[str, dict[int, NDArray[Any]]] = {}
    for name, channel in channels.items():
        if match := _BAND.fullmatch(name):
            light = ".".join(part for part in (prefix, match[1]) if part) or "scene"
            bands_of_light.setdefault(light, {})[float(match[2].replace(",", "."))] = np.asarray(channel.pixels)
        elif match := _NUMBERED.fullmatch(name):
            light = ".".join(part for part in (prefix, match[1]) if part) or "scene"
            numbered.setdefault(light, {})[int(match[2])] = np.asarray(channel.pixels)
    for light, bands in numbered.items():
        if len(bands) not in _NUMBERED_NM or sorted(bands) != list(range(1, len(bands) + 1)):
            raise InputError(f"light {light} has {len(bands)} numbered channels, not 31 or 16 from C01")
        grid = np.linspace(*_NUMBERED_NM[len(bands)], len(bands))
        bands_of_light[light] = {float(nm): bands[number] for number, nm in enumerate(grid, start=1)}
    return bands_of_light


#: Default luminance of a perfect white diffuser.
LUMINANCE_CD_M2 = 100.0

PICTURES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")
CUBES = (".npz", ".hdr", ".exr")

#: Names of the quantity that a light's CSV or an .npz cube holds, in the column's or the array's name.
RADIANCE, PHOTONS, RELATIVE, REFLECTANCE = "radiance_w_sr_m2_nm", "photons_s_sr_m2_nm", "relative", "reflectance"

#: ENVI's `data units`, without spaces and in small letters -> (quantity, factor).
ENVI_UNITS = {
    "w/m^2/sr/nm": (RADIANCE, 1.0),
    "w/(m^2*sr*nm)": (RADIANCE, 1.0),
    "wsr^-1m^-2nm^-1": (RADIANCE, 1.0),
    "w/m^2/sr/um": (RADIANCE, 1e-3),
    "uw/cm^2/sr/nm": (RADIANCE, 1e-2),
    "uw/(cm^2*sr*nm)": (RADIANCE, 1e-2),
    "photons/s/m^2/sr/nm": (PHOTONS, 1.0),
    "reflectance": (REFLECTANCE, 1.0),
}

#: Most samples of a cube or a picture; more are taken for a mistake. 4 GiB as float64.
MOST_SAMPLES = 2**29


def read_light(file: Path, luminance_cd_m2: float | None = None) -> Spectrum:
    """Radiance (W sr^-1 m^-2 nm^-1) of a measured light.

    CGATS (`.sp`, `.ti3`) of one spectrum: a radiance where its MEAS_TYPE says EMISSION, else relative.
    The CSV's header is `wavelength_nm,` and one of `radiance_w_sr_m2_nm`, `photons_s_sr_m2_nm` (s^-1 sr^-1 m^-2 nm^-1),
    which are taken as they are unless a luminance is asked for, and `relative`, which needs one.
    """
    with _about(file):
        column, curve = _light_curve(file)
    lowest = int(np.argmin(curve.value))
    if curve.value[lowest] < 0:
        raise InputError(
            f"{file}: {column} is {curve.value[lowest]:g} at {curve.wavelength_nm[lowest]:g} nm, below the limit of "
            "0; subtract the dark reading, and set what stays below 0 to 0"
        )
    if len(curve.value) < 2:
        raise InputError(f"{file}: one sample is a light of no width; give two or more")
    if column == PHOTONS:
        curve = Spectrum.of(curve.wavelength_nm, energy_from_photons(curve.wavelength_nm, curve.value))
    if luminance_cd_m2 is None:
        if column == RELATIVE:
            raise InputError(f"{file}: holds a relative spectrum; say its luminance in cd/m^2, or give {RADIANCE}")
        return curve
    with _about(file):
        return at_luminance(curve, luminance_cd_m2)


def _light_curve(file: Path) -> tuple[str, Spectrum]:
    """Return the quantity that a light's file holds, by its name in a CSV, and the curve. InputError without the
    path."""
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"can't be read as text ({_reason(error)}); give a CSV in UTF-8") from None
    if file.suffix.lower() not in (".sp", ".ti3"):
        return parse_curve(text, (RADIANCE, PHOTONS, RELATIVE))
    measured = parse_cgats(text)
    if len(measured.spectra) > 1:
        raise InputError(f"holds {len(measured.spectra)} spectra; import it, and name the light's CSV")
    return RADIANCE if measured.quantity == "radiance" else RELATIVE, next(iter(measured.spectra.values()))


def light(name: str, luminance_cd_m2: float | None = None) -> Spectrum:
    """Radiance of a perfect white diffuser under an illuminant: a name (D65, A, FL2, ...), at 100 cd/m^2 unless told,
    or a CSV."""
    if name.lower().endswith(".csv") or Path(name).is_file():
        return read_light(Path(name), luminance_cd_m2)
    try:
        return illuminant(name, LUMINANCE_CD_M2 if luminance_cd_m2 is None else luminance_cd_m2)
    except ValueError as error:
        raise InputError(str(error)) from None


def read_picture(file: Path) -> NDArray[np.uint8]:
    """8-bit codes (rows, cols, 3), red green blue, of a PNG, TIFF, JPEG or BMP. Grey becomes three equal codes, 16 bit
    is rounded to 8; transparency is refused, as the background isn't known."""
    if not file.is_file():
        raise InputError(f"{file}: no such file; give one of {' '.join(PICTURES)}")
    with _about(file):
        image = read_samples(file)
    if image.ndim == 2:
        image = np.repeat(image[:, :, None], 3, axis=2)
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        raise InputError(f"{file}: has the shape {image.shape}, not (rows, cols, 3); save it as RGB")
    full: int | None = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}.get(image.dtype)
    if full is None:
        raise InputError(f"{file}: its samples are {image.dtype}, not 8 or 16 bit; save it as 8-bit RGB")
    if image.shape[2] == 4 and np.any(image[:, :, 3] != full):
        raise InputError(f"{file}: is transparent in places; put it on a background and save it as RGB")
    codes = image[:, :, :3]
    if full != 255:
        codes = np.rint(codes / 257.0)
    return np.ascontiguousarray(codes, dtype=np.uint8)


def read_cube(file: Path, white: Spectrum | None = None, weights: Mapping[str, float] | None = None) -> SpectralImage:
    """Return a spectral image from an .npz, an ENVI header (.hdr) with its data file beside it, or a spectral OpenEXR.

    OpenEXR: the sum of its lights' radiances, each times its weight (`lab.formats.scene_file`).

    .npz: `wavelength_nm` (bands,) and one of `radiance_w_sr_m2_nm`, `photons_s_sr_m2_nm`, `reflectance`, (rows, cols,
    bands).
    ENVI: `wavelength` in `wavelength units` nanometers or micrometers, and `data units` as in `ENVI_UNITS`. A
    reflectance is taken under `white`, the radiance of a perfect diffuser.
    """
    suffix = file.suffix.lower()
    if suffix not in CUBES:
        raise InputError(f"{file}: a spectral cube can't be {suffix or 'without an ending'}; give {', '.join(CUBES)}")
    if not file.is_file():
        raise InputError(f"{file}: no such file; give a cube as {', '.join(CUBES)}")
    with _about(file):
        if suffix == ".exr":
            return read_exr(file, weights)
        quantity, wavelength_nm, values = _npz(file) if suffix == ".npz" else _envi(file)
        wavelengths = tuple(wavelength_nm.tolist())
        if values.dtype not in (np.float32, np.float64):
            values = values.astype(np.float64)
        if quantity == PHOTONS:
            return SpectralImage.from_photons(wavelengths, values)
        if quantity == REFLECTANCE:
            if white is None:
                raise InputError("holds reflectances; say the illuminant that falls on them")
            if values.ndim != 3 or values.shape[2] != len(wavelengths):
                raise InputError(
                    f"reflectance of shape {values.shape} has to be (rows, cols, {len(wavelengths)} bands); move the "
                    "bands to the last axis"
                )
            values = values * white.at(wavelengths).astype(values.dtype)
        return SpectralImage(wavelengths, values)


def scene(
    name: str,
    camera: CameraModel,
    white: Spectrum,
    *,
    distance_mm: float = 1000.0,
    parameters: Mapping[str, object] | None = None,
) -> Scene:
    """Return a scene before a camera: one of `sim.scene.catalogue.scenes()` by its name, or a picture or a cube by its
    file.

    `white`: radiance of a perfect white diffuser there. A picture's screen takes its luminance for its own white; a
    cube of radiance has its own light. Raises InputError for anything else.
    """
    try:
        if name in scenes():
            return scene_by_name(name, camera, white, distance_mm=distance_mm, parameters=parameters)
        view = View.of(camera, distance_mm)
    except ValueError as error:
        raise InputError(str(error)) from None
    file = Path(name)
    suffix = file.suffix.lower()
    if suffix in PICTURES:
        codes = read_picture(file)
        with _about(file):
            return PictureOnScreen.choose(parameters).show(codes, view, white)
    if suffix in CUBES:
        weights, chosen = _weights(suffix, parameters or {})
        image = read_cube(file, white, weights)
        with _about(file):
            return Cube.choose(chosen).show(image, view)
    raise InputError(
        f"scene {name!r} is not known: name one of {', '.join(scenes())}, a picture ({' '.join(PICTURES)}) or a cube "
        f"({' '.join(CUBES)})"
    )


def _weights(suffix: str, parameters: Mapping[str, object]) -> tuple[dict[str, float], dict[str, object]]:
    """Return the weights of an OpenEXR scene's lights, by light, and the other parameters."""
    lights = [key for key in parameters if suffix == ".exr" and key.startswith(WEIGHT)]
    weights = {key.removeprefix(WEIGHT): float(str(parameters[key])) for key in lights}
    return weights, {key: value for key, value in parameters.items() if key not in lights}


@contextmanager
def _about(file: Path) -> Iterator[None]:
    """Turn errors of the block into an InputError that begins with the file."""
    try:
        yield
    except (InputError, ValueError) as error:
        raise InputError(f"{file}: {error}") from None


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _npz(file: Path) -> tuple[str, FloatArray, NDArray[Any]]:
    """Quantity, wavelengths and samples of an .npz, as they're stored. InputError without the path."""
    damaged = "damaged .npz ({}); write it again with numpy.savez"
    try:
        with zipfile.ZipFile(file) as archive:
            sizes = {item.filename.removesuffix(".npy"): item.file_size for item in archive.infolist()}
    except Exception as error:
        raise InputError(damaged.format(_reason(error))) from None
    held = [name for name in (RADIANCE, PHOTONS, REFLECTANCE) if name in sizes]
    if "wavelength_nm" not in sizes or len(held) != 1:
        raise InputError(
            f"holds {', '.join(sizes) or 'nothing'}; give wavelength_nm and one of {RADIANCE}, {PHOTONS}, {REFLECTANCE}"
        )
    if max(sizes.values()) > 8 * MOST_SAMPLES:
        raise InputError(f"holds {max(sizes.values()) / 2**30:.1f} GiB, above the limit of 4 GiB; cut the cube")
    try:
        with np.load(file, allow_pickle=False) as arrays:
            wavelength_nm, values = np.asarray(arrays["wavelength_nm"]), np.asarray(arrays[held[0]])
    except Exception as error:
        raise InputError(damaged.format(_reason(error))) from None
    for name, array in (("wavelength_nm", wavelength_nm), (held[0], values)):
        if array.dtype.kind not in "fiu":
            raise InputError(f"{name} is {array.dtype}, not real numbers; save it as float32 or float64")
    if wavelength_nm.ndim != 1:
        raise InputError(f"wavelength_nm has the shape {wavelength_nm.shape}, not (bands,); give one a band")
    return held[0], np.asarray(wavelength_nm, float), values


def _envi(file: Path) -> tuple[str, FloatArray, NDArray[Any]]:
    """As `_npz`, of an ENVI image; its samples scaled to the unit that the quantity's name says."""
    header, values = _envi_samples(file)
    unit, length = (str(header.get(key, "")) for key in ("data units", "wavelength units"))  # a list, where in braces
    quantity, factor = ENVI_UNITS.get(unit.lower().replace(" ", ""), ("", 1.0))
    if not quantity:
        raise InputError(f"data units is '{unit[:60]}'; write one of {', '.join(ENVI_UNITS)} into the header")
    lengths = {"nanometers": 1.0, "nm": 1.0, "micrometers": 1e3, "um": 1e3}
    if length.lower() not in lengths:
        raise InputError(f"wavelength units is '{length[:60]}'; write nanometers or micrometers into the header")
    wavelength_nm = _numbers(header, "wavelength") * lengths[length.lower()]
    if quantity == REFLECTANCE and "reflectance scale factor" in header:
        (scale,) = _numbers(header, "reflectance scale factor")
        if not 0 < scale < np.inf:
            raise InputError(f"reflectance scale factor is {scale}, not a number above 0; correct the header")
        factor /= scale
    return quantity, wavelength_nm, values if factor == 1.0 else values * factor


def _envi_samples(file: Path) -> tuple[dict[str, Any], NDArray[Any]]:
    """Header and samples (rows, cols, bands), as they're stored."""
    from spectral.io import envi  # here, as few need it

    try:
        opened = envi.open(str(file.resolve()))
        header, shape = dict(opened.metadata), tuple(int(n) for n in getattr(opened, "shape", ()))
    except Exception as error:
        raise InputError(f"can't be read as ENVI ({_reason(error)}); correct the header") from None
    # For any other value the library would guess.
    for key, known in (("byte order", ("0", "1")), ("interleave", ("bsq", "bil", "bip"))):
        if str(header.get(key)).lower() not in known:
            raise InputError(f"{key} is '{header.get(key)}', not one of {', '.join(known)}; correct the header")
    if len(shape) != 3 or min(shape) < 1 or np.prod(shape, dtype=float) > MOST_SAMPLES:
        raise InputError(
            f"says {shape} rows, columns, bands, not an image of 1 to {MOST_SAMPLES} samples; correct the header"
        )
    data = Path(opened.filename)
    wanted = opened.offset + int(np.prod(shape)) * np.dtype(opened.dtype).itemsize
    if data.stat().st_size < wanted:
        raise InputError(
            f"{data.name} has {data.stat().st_size} bytes where the header asks for {wanted}; copy it again, or "
            "correct the header"
        )
    try:
        values = np.array(opened.open_memmap(interleave="bip", writable=False))
    except Exception as error:
        raise InputError(f"can't be read as ENVI ({_reason(error)}); correct the header") from None
    if values.ndim != 3:
        raise InputError(f"{data.name} can't be mapped into memory; correct the header's offset and sizes")
    if values.dtype.kind not in "fiu":
        raise InputError(f"its samples are {values.dtype}, not real numbers; save 4-byte or 8-byte reals")
    return header, values


def _numbers(header: dict[str, Any], key: str) -> FloatArray:
    written = header.get(key, [])
    try:
        return np.array([float(item) for item in (written if isinstance(written, list) else [written])])
    except ValueError:
        raise InputError(f"{key} is '{str(written)[:60]}', not numbers; correct the header") from None
