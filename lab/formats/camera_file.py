"""A camera in a TOML file: every parameter of the camera model under its own name, which ends in its unit. The comments
are the parameters' declarations.

    rows = 960  # px: rows of the frame (1 ..)
    [quantum_efficiency]      # a table of samples each, or the name of a CSV file
    R = "red.csv"
    [lens.imaging]
    kind = "traced_lens"
    prescription = "lens.zmx"
    [[effects]]
    name = "veiling_glare"
    share_percent = 1.5

Paths in it are relative to the camera file's folder.
"""

from __future__ import annotations

import os
import sys
import tomllib
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from pydantic import BaseModel, ValidationError

from lab.errors import InputError
from lab.formats.camera_model import camera_model, remarks_on_values
from lab.formats.model_posterior import ModelPosterior
from lab.formats.raw_file import replacing
from lab.formats.recording_set import RecordingSet
from lab.formats.result_file import read_result, write_result
from lab.formats.results import CameraFit
from lab.formats.spectrum_csv import parse_spectrum
from sim.camera import CameraModel, Lens, Side
from sim.effects.base import Effect
from sim.effects.library import effect, effects
from sim.optics.imaging import DiffractionLimited, MeasuredOtf, MeasuredPsf, TracedLens
from sim.optics.table import LensTable
from sim.parameters import Quantity, read_quantities
from sim.scene.projection import Projection
from sim.spectrum import Spectrum

FORMAT, VERSION = "calibench-camera", 1
HEADER = (
    "# A camera for calibench: each key is a parameter, and ends in its unit. docs/reference/camera-file.md says what "
    "they do."
)
#: Keys of the file that don't belong to the camera model.
OWN_KEYS = ("format", "version", "name", "effects", "posterior")
CURVES = ("quantum_efficiency", "quantum_efficiency_std")


@dataclass(frozen=True)
class CameraFile:
    """The content of a camera file: the model, the effects that act in it, the prescription of a traced lens, and how
    well its parameters are known together (None: nobody says). `remarks`: comments of the file, which aren't read."""

    name: str
    camera: CameraModel
    effects: tuple[Effect, ...] = ()
    prescription: Path | None = None
    posterior: ModelPosterior | None = None
    remarks: tuple[str, ...] = field(default=(), compare=False)


def read_camera(
    file: Path,
    cache: Path | None = None,
    progress: Callable[[str, float], None] | None = None,
    *,
    sent: bool = False,
) -> CameraFile:
    """Read a camera file. `cache`: folder of traced lenses' tables (None: `lens_cache`). `sent`: it came from
    elsewhere, so that the files it names are looked for in its folder alone, and no lens is traced.

    Raises InputError, in one line, that names file, key, value, limit and remedy.
    """
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: can't be read ({getattr(error, 'strerror', error)}); name a camera file") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{file}: isn't TOML ({error}); correct it") from error
    if content.get("format") != FORMAT or content.get("version") != VERSION:
        raise InputError(
            f"{file}: format {content.get('format')!r} version {content.get('version')!r} is not {FORMAT!r} "
            f'{VERSION}; write format = "{FORMAT}" and version = {VERSION}'
        )
    values = {key: value for key, value in content.items() if key not in OWN_KEYS}
    for curves in CURVES:
        if isinstance(values.get(curves), dict):
            values[curves] = {
                channel: _curve(file, f"{curves}.{channel}", of, sent) for channel, of in values[curves].items()
            }
    prescription = None
    if isinstance(values.get("lens"), dict) and isinstance(values["lens"].get("imaging"), dict):
        imaging, prescription = _imaging(file, values["lens"]["imaging"], cache, progress, sent)
        values["lens"] = values["lens"] | {"imaging": imaging}
    camera = _validate(file, "", CameraModel, values)
    _check_levels(file, camera)
    acting = content.get("effects", [])
    if not isinstance(acting, list) or not all(isinstance(entry, dict) for entry in acting):
        raise InputError(f"{file}: effects is {acting!r}, not a list of tables; write [[effects]] above each")
    name = content.get("name", file.stem)
    if not isinstance(name, str):
        raise InputError(f"{file}: name is {name!r}, not text; put it into quotes")
    posterior = _posterior(file, content["posterior"], sent) if "posterior" in content else None
    effects_of = tuple(_effect(file, k, entry) for k, entry in enumerate(acting))
    return CameraFile(name, camera, effects_of, prescription, posterior)


def _posterior(file: Path, given: Any, sent: bool) -> ModelPosterior:
    """Return the posterior in the JSON file that the key `posterior` names."""
    if not isinstance(given, str):
        raise InputError(f"{file}: posterior is {given!r}, not a file's name; name the JSON file, or leave the key out")
    return read_result(ModelPosterior, _beside(file, "posterior", given, sent))


def _beside(file: Path, key: str, path: str, sent: bool) -> Path:
    """Return a file that a camera file names. Raises InputError where it lies outside the folder of one that was
    sent."""
    path_of_file = file.parent / path
    if sent and ("\0" in path or not path_of_file.resolve().is_relative_to(file.parent.resolve())):
        raise InputError(f"{file}: {key}: {path[:80]!r} leaves the folder; put the file beside the camera file")
    return path_of_file


def _curve(file: Path, key: str, given: Any, sent: bool) -> Any:
    """Return a spectrum's samples, from the CSV file where it is a path."""
    if not isinstance(given, str):
        return given
    beside = _beside(file, key, given, sent)
    try:
        return parse_spectrum(beside.read_text(encoding="utf-8")).model_dump()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{file}: {key}: {beside} can't be read ({getattr(error, 'strerror', error)}); correct the path"
        ) from error
    except (InputError, ValidationError) as error:
        raise InputError(f"{file}: {key}: {beside}: {_first(error)}") from error


def _imaging(
    file: Path,
    given: Mapping[str, Any],
    cache: Path | None,
    progress: Callable[[str, float], None] | None,
    sent: bool,
) -> tuple[Any, Path | None]:
    """Return the keys of `lens.imaging` with the files that they name read in, and the prescription among them."""
    values = dict(given)
    key = "lens.imaging"
    if values.get("kind") == "traced_lens":
        named = {k: values[k] for k in ("prescription", "table") if k in values}
        if len(named) != 1 or not isinstance(next(iter(named.values())), str) or set(values) - {"kind", *named}:
            raise InputError(
                f"{file}: {key} of a traced lens has the keys {', '.join(values)}; give kind and either prescription "
                '= "FILE.zmx" or table = "FILE.npz"'
            )
        which, path = next(iter(named.items()))
        if sent and which == "prescription":
            raise InputError(f"{file}: {key}.prescription: a lens isn't traced here; trace it and send its table")
        beside = _beside(file, f"{key}.{which}", path, sent)
        try:
            if which == "table":
                return {"kind": "traced_lens", "table": LensTable.load(beside)}, None
            return {"kind": "traced_lens", "table": trace_table(beside, cache, progress)}, beside
        except (ValueError, InputError) as error:
            raise InputError(f"{file}: {key}.{which}: {_first(error)}") from error
    if "samples" not in values:
        return values, None
    beside = _beside(file, f"{key}.samples", str(values.pop("samples")), sent)
    try:
        stored = np.load(beside, allow_pickle=False)
        if isinstance(stored, np.ndarray):
            values["psf"] = np.atleast_3d(stored) if stored.ndim > 2 else stored[None]
        else:
            with stored:
                values |= {name: stored[name] for name in stored.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{file}: {key}.samples: {beside} can't be read ({_first(error)}); save it with numpy as .npy or .npz"
        ) from error
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}, None


def lens_cache() -> Path:
    """Return the folder where traced lenses' tables are kept: CALIBENCH_CACHE, else the platform's own place for such
    files.

    >>> import os
    >>> os.environ["CALIBENCH_CACHE"] = "/data/lenses"
    >>> lens_cache()
    PosixPath('/data/lenses')
    >>> del os.environ["CALIBENCH_CACHE"]
    """
    if "CALIBENCH_CACHE" in os.environ:
        return Path(os.environ["CALIBENCH_CACHE"])
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "calibench" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "calibench"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "calibench"


def trace_table(
    prescription: Path, cache: Path | None = None, progress: Callable[[str, float], None] | None = None
) -> LensTable:
    """Return the table of a lens from its prescription, from the folder `cache` (None: `lens_cache`) or traced and kept
    there.

    Raises InputError for a prescription that can't be read or traced, and for a folder that can't be written to.
    """
    from sim.optics.traced_table import read_or_trace_table  # here, as compiled code takes a second to import
    from sim.optics.zmx import read_zmx

    folder = cache or lens_cache()
    try:
        return read_or_trace_table(read_zmx(prescription), folder, progress=progress)
    except ValueError as error:
        raise InputError(_first(error)) from error
    except OSError as error:
        raise InputError(
            f"{folder}: lens tables can't be kept there ({error.strerror}); name another folder in CALIBENCH_CACHE"
        ) from error


def _validate(file: Path, at: str, model: type[BaseModel], values: Mapping[str, Any]) -> Any:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        where = [str(part) for part in problem["loc"]]
        key = ".".join([*([at] if at else []), *where])
        if problem["type"] == "extra_forbidden":
            what = (
                f"{key} isn't a key of a camera file; leave it out, or take one of "
                f"{', '.join(_keys_of_table(model, where[:-1]))}"
            )
        elif problem["type"] == "missing":
            meant = read_quantities(model).get(where[-1])
            what = f"{key} is missing; add it" + (f" ({meant.unit}: {meant.meaning})" if meant else "")
        else:
            value = repr(problem["input"])
            shown = "" if len(value) > 60 or value in problem["msg"] else f" is {value}"
            message = problem["msg"].removeprefix("Value error, ")
            what = f"{key}{shown}: {message}" + ("" if "; " in message else "; correct it")
        raise InputError(f"{file}: {' '.join(what.split())}") from error


def _keys_of_table(model: type[BaseModel], where: Sequence[str]) -> list[str]:
    """Return the keys that the table `where` may have."""
    if where[:1] == ["lens"]:
        return (
            [*Lens.model_fields]
            if len(where) == 1
            else ["kind", "samples", "prescription", "table", "and those of the kind"]
        )
    return [*(OWN_KEYS if model is CameraModel else ()), *model.model_fields]


def _effect(file: Path, index: int, given: Mapping[str, Any]) -> Effect:
    at = f"effects[{index}]"
    name = given.get("name")
    if not isinstance(name, str) or name not in effects():
        raise InputError(f"{file}: {at}.name is {name!r}, which isn't an effect; take one of {', '.join(effects())}")
    acting: Effect = _validate(file, at, effect(name), {key: value for key, value in given.items() if key != "name"})
    return acting


def _check_levels(file: Path, camera: CameraModel) -> None:
    highest = 2**camera.bit_depth - 1
    if camera.white_level_dn > highest:
        raise InputError(
            f"{file}: white_level_dn is {camera.white_level_dn:g} DN, above the limit of {highest} DN of "
            f"{camera.bit_depth} bit; correct one of them"
        )
    if camera.black_level_dn >= camera.white_level_dn:
        raise InputError(
            f"{file}: black_level_dn is {camera.black_level_dn:g} DN, not below the limit of white_level_dn, "
            f"{camera.white_level_dn:g} DN; correct one of them"
        )
    if set(camera.quantum_efficiency) != set(camera.channels):
        raise InputError(
            f"{file}: quantum_efficiency has the channels {', '.join(camera.quantum_efficiency)}; a {camera.cfa} "
            f"camera's are {', '.join(camera.channels)}, give those"
        )
    for channel, curve in camera.quantum_efficiency.items():
        low, high = min(curve.value), max(curve.value)
        if low < 0 or high > 1:
            raise InputError(
                f"{file}: quantum_efficiency.{channel} runs from {low:g} to {high:g}, beyond the limits of 0 and 1 "
                "electron a photon; scale it"
            )


def _first(error: Exception) -> str:
    """Return the first message of an error, on one line."""
    text = (
        str(error) if not isinstance(error, ValidationError) else error.errors()[0]["msg"].removeprefix("Value error, ")
    )
    return " ".join(text.split())


def write_camera(file: Path, content: CameraFile) -> None:
    """Write a camera file that `read_camera` reads back to exactly the same camera.

    file : TOML, to be written
    content : the camera, its effects and its lens

    Measured point-spread and transfer functions go into an .npz file beside it; so does the table of a traced lens
    without a prescription.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "left.toml"
    ...     write_camera(file, default_camera())
    ...     read_camera(file).camera == default_camera().camera
    True
    """
    text = "\n".join(_lines(file, content)) + "\n"
    with replacing(file) as partial:
        partial.write_text(text, encoding="utf-8")


def _lines(file: Path, content: CameraFile) -> Iterator[str]:
    camera = content.camera
    yield HEADER
    yield from (f"# {' '.join(remark.split())}" for remark in content.remarks)
    yield f"format = {_text(FORMAT)}"
    yield f"version = {VERSION}"
    yield f"name = {_text(content.name)}"
    if content.posterior is not None:
        beside = file.with_name(f"{file.stem}-posterior.json")
        write_result(content.posterior, beside)
        yield f"posterior = {_text(beside.name)}  # how well the parameters are known together"
    yield ""
    yield from _parameters(camera, skip=(*CURVES, "lens", "geometry", "std"))
    for curves, what in zip(
        CURVES,
        (
            "electrons a photon, without the lens; a table of samples, or the name of a CSV file",
            "one standard uncertainty of it",
        ),
        strict=True,
    ):
        for channel, curve in getattr(camera, curves).items():
            yield ""
            yield f"[{curves}.{channel}]  # {what}"
            yield from _parameters(curve)
    yield ""
    yield "[lens]"
    yield from _parameters(camera.lens, skip=("imaging", "illumination"))
    yield ""
    yield (
        "[lens.imaging]  # how a point is imaged: diffraction_limited, zernike_pupil, measured_psf, measured_otf, "
        "traced_lens"
    )
    yield from _imaging_lines(file, content)
    yield ""
    yield (
        "[lens.illumination]  # how the light falls off: cosine_fourth, radial (a maker's curve), measured (a flat's "
        "map)"
    )
    yield from _parameters(camera.lens.illumination)
    if camera.geometry is not None:
        yield ""
        coefficients = " ".join(Projection.of(camera.geometry).coefficients[: len(camera.geometry.distortion) or None])
        yield f"[geometry]  # {camera.geometry.projection} projection: camera matrix (px) and distortion {coefficients}"
        yield from _parameters(camera.geometry)
    if camera.std:
        yield ""
        yield "[std]  # one standard uncertainty of the parameter of that name, in its unit"
        yield from (f"{key} = {_text(value)}" for key, value in camera.std.items())
    for acting in content.effects:
        yield ""
        yield f"[[effects]]  # {acting.sentence}"
        yield f"name = {_text(acting.name)}"
        yield from _parameters(acting)


def _imaging_lines(file: Path, content: CameraFile) -> Iterator[str]:
    imaging = content.camera.lens.imaging
    if isinstance(imaging, TracedLens):
        yield 'kind = "traced_lens"'
        if content.prescription is not None:
            path = content.prescription.resolve()
            folder = file.parent.resolve()
            named = path.relative_to(folder) if path.is_relative_to(folder) else path
            yield f"prescription = {_text(named.as_posix())}"
        else:
            beside = file.with_name(f"{file.stem}-lens.npz")
            imaging.table.save(beside)
            yield f"table = {_text(beside.name)}"
    elif isinstance(imaging, MeasuredPsf | MeasuredOtf):
        beside = file.with_name(f"{file.stem}-{imaging.kind.removeprefix('measured_')}.npz")
        arrays: dict[str, Any] = {
            name: np.array(getattr(imaging, name)) for name in type(imaging).model_fields if name != "kind"
        }
        with replacing(beside) as partial, partial.open("wb") as stream:
            np.savez(stream, **arrays)
        yield f"kind = {_text(imaging.kind)}"
        yield f"samples = {_text(beside.name)}"
    else:
        yield from _parameters(imaging)


def _parameters(model: BaseModel, skip: Sequence[str] = ()) -> Iterator[str]:
    """One line for each field: key, value, and its declaration as a comment. A field that isn't set is a comment as a
    whole."""
    known = read_quantities(type(model))
    for key in type(model).model_fields:
        if key in skip:
            continue
        value = getattr(model, key)
        comment = f"  # {describe_quantity(known[key])}" if key in known else ""
        yield f"# {key} is not set{comment}" if value is None else f"{key} = {_text(value)}{comment}"


def describe_quantity(quantity: Quantity) -> str:
    """Return unit, meaning and bounds of a parameter, as they stand in the file's comments and in the documentation.

    >>> describe_quantity(read_quantities(CameraModel)["read_noise_e"]).startswith("e")
    True
    """
    bounds = ["" if limit is None else f"{limit:g}" for limit in (quantity.lower, quantity.upper)]
    limits = f" ({bounds[0]} .. {bounds[1]})".replace("( ..", "(..").replace(".. )", "..)") if any(bounds) else ""
    return f"{quantity.unit}: {quantity.meaning}{limits}"


def _text(value: Any) -> str:
    """Return a value as TOML; numbers in rows of ten."""
    if isinstance(value, tuple):
        parts = [_text(part) for part in value]
        if len(parts) <= 10 and not any(isinstance(part, tuple) for part in value):
            return f"[{', '.join(parts)}]"
        rows = [", ".join(parts[start : start + 10]) for start in range(0, len(parts), 10)]
        if any(isinstance(part, tuple) for part in value):
            rows = parts
        return "[\n" + "".join(f"  {row},\n" for row in rows) + "]"
    return tomli_w.dumps({"value": value}).strip().removeprefix("value = ")


def fitted_camera(recordings: RecordingSet, side: Side, fit: CameraFit) -> CameraFile:
    """Return the camera that a fit found (`lab.formats.camera_model.camera_model`), with the fit's uncertainties, to be
    written as a file; its remarks say which values nobody stated or fitted, and which aren't the fitted ones."""
    model = camera_model(recordings, side, fit)
    std = {}
    for key in read_quantities(CameraModel) if fit.noise is not None else ():
        value = getattr(fit.noise, f"{key}_std", None)
        if value is not None:
            std[key] = float(value)
    remarks = remarks_on_values(recordings.camera(side), fit, model)
    return CameraFile(f"{recordings.manifest.name} {side}", model.model_copy(update={"std": std}), remarks=remarks)


def default_camera() -> CameraFile:
    """Return a plausible RGB machine-vision camera: 1280 x 960 px of 3.45 um, 12 bit, global shutter, f/4, 8 mm.

    Its values are like those of data sheets of 1/3 inch sensors. Its curves, with an infrared-cut filter at 650 nm,
    have typical shapes and are of no particular maker.

    >>> import calibench
    >>> camera = calibench.default_camera().camera
    >>> camera.rows, camera.cols, camera.cfa, camera.bit_depth
    (960, 1280, 'RGGB', 12)
    """
    wavelength_nm = np.arange(380.0, 721.0, 10.0)

    def curve(peak: float, centre_nm: float, short_nm: float, long_nm: float) -> Spectrum:
        width = np.where(wavelength_nm < centre_nm, short_nm, long_nm)
        shape = np.exp(-0.5 * ((wavelength_nm - centre_nm) / width) ** 2) + 0.04
        cut = 1.0 / (1.0 + np.exp((wavelength_nm - 655.0) / 7.0)) / (1.0 + np.exp((405.0 - wavelength_nm) / 5.0))
        return Spectrum.of(wavelength_nm, np.round(peak * shape * cut, 5))

    camera = CameraModel(
        rows=960,
        cols=1280,
        pixel_pitch_um=3.45,
        fill_factor=1.0,
        cfa="RGGB",
        bit_depth=12,
        black_level_dn=64.0,
        white_level_dn=4095.0,
        conversion_gain_dn_per_e=0.38,
        full_well_e=10500.0,
        read_noise_e=2.4,
        dark_current_e_per_s=5.0,
        dark_current_reference_c=25.0,
        dark_current_doubling_c=7.0,
        dsnu_e=0.8,
        prnu_percent=0.6,
        row_noise_e=0.2,
        column_noise_e=0.3,
        shutter="global",
        quantum_efficiency={
            "R": curve(0.48, 605.0, 28.0, 60.0),
            "G": curve(0.58, 530.0, 38.0, 38.0),
            "B": curve(0.52, 455.0, 35.0, 32.0),
        },
        lens=Lens(f_number=4.0, focal_length_mm=8.0, transmittance=0.92, imaging=DiffractionLimited()),
    )
    return CameraFile("calibench default", camera)
