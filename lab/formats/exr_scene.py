"""Spectral scenes in OpenEXR, with several lights: each a layer (or a part) of its own radiance, which add up.

A layer's channels are those of the spectral OpenEXR layout (Fichet, Pacanowski, Wilkie, JCGT 10 (3), 2021; PBRT writes
it): `S0.550,000000nm`, radiance in W sr^-1 m^-2 nm^-1; or ISET3d's `Radiance.C01` .. `C31`, 400 to 700 nm, alike. What
stands before them in a channel's name, or the name of a part, is the light's: `lamp.S0.550,0nm`. OpenEXR is an extra.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.errors import InputError, one_line
from sim.scene import SpectralImage

#: A radiance's channel: light, wavelength with comma or point, unit.
_BAND = re.compile(r"(?:(.*)\.)?S0\.(\d+(?:[.,]\d+)?)nm", re.I)
_NUMBERED = re.compile(r"(?:(.*)\.)?Radiance\.C(\d+)", re.I)
#: First and last wavelength (nm) of numbered channels, by their number.
_NUMBERED_NM = {31: (400.0, 700.0), 16: (400.0, 700.0)}
#: Begins the key that scales a light among a scene's parameters.
WEIGHT = "light."
#: Most samples of a scene; more are taken for a mistake. 4 GiB as float64.
MOST_SAMPLES = 2**29


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
            found: dict[str, dict[float, NDArray[Any]]] = {}
            named: list[str] = []
            for prefix, part in parts:
                named += part.channels
                for light, bands in _bands(part.channels, prefix).items():
                    found.setdefault(light, {}).update(bands)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"can't be read as OpenEXR ({one_line(error)}); copy it again") from error
    if not found:
        raise InputError(
            f"has no radiance by wavelength (its channels are {', '.join(named[:6])}); name them S0.550,0nm, ..., as "
            "PBRT writes them, or Radiance.C01 to C31"
        )
    lights = {}
    for name, bands in found.items():
        wavelength_nm = sorted(bands)
        if len(wavelength_nm) * bands[wavelength_nm[0]].size > MOST_SAMPLES:
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
    found: dict[str, dict[float, NDArray[Any]]] = {}
    numbered: dict[str, dict[int, NDArray[Any]]] = {}
    for name, channel in channels.items():
        if match := _BAND.fullmatch(name):
            light = ".".join(part for part in (prefix, match[1]) if part) or "scene"
            found.setdefault(light, {})[float(match[2].replace(",", "."))] = np.asarray(channel.pixels)
        elif match := _NUMBERED.fullmatch(name):
            light = ".".join(part for part in (prefix, match[1]) if part) or "scene"
            numbered.setdefault(light, {})[int(match[2])] = np.asarray(channel.pixels)
    for light, bands in numbered.items():
        if len(bands) not in _NUMBERED_NM or sorted(bands) != list(range(1, len(bands) + 1)):
            raise InputError(f"light {light} has {len(bands)} numbered channels, not 31 or 16 from C01")
        grid = np.linspace(*_NUMBERED_NM[len(bands)], len(bands))
        found[light] = {float(nm): bands[number] for number, nm in enumerate(grid, start=1)}
    return found
