"""The reader of Zemax's `.zmx` files.

What changes the optics and isn't understood is an error or a warning that names it; nothing is left out in silence.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from sim.optics.prescription import (
    ASPHERE_TERMS,
    Aperture,
    ApertureKind,
    FieldKind,
    GlassName,
    Prescription,
    PrescriptionError,
    Surface,
    SurfaceKind,
)

#: What the program writes for the nd and Vd of a glass that it finds by name.
_UNKNOWN_GLASS = (1.5, 40.0)
_UNIT_MM = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0, "M": 1000.0}
_KINDS: dict[str, SurfaceKind] = {
    "STANDARD": "standard",
    "EVENASPH": "even_asphere",
    "XASPHERE": "even_asphere",
    "ODDASPHE": "odd_asphere",
    "COORDBRK": "coordinate_break",
}
_MAXIMUM_SURFACES = 500
_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")

_UNDERSTOOD_HEADER = frozenset([
    "MODE", "UNIT", "ENPD", "FNUM", "OBNA", "FLOA", "OCOS", "ENVD", "GCAT", "FTYP", "XFLN", "YFLN", "VDXN", "VDYN",
    "VCXN", "VCYN", "VANN", "WAVM", "WAVL", "WAVN", "PWAV", "XFLD", "YFLD",
])  # fmt: skip
# Settings of the program and of its pictures, solves (whose result is in the value itself) and analysis: they don't
# change what light does.
_HARMLESS_HEADER = frozenset([
    "VERS", "NAME", "NOTE", "PFIL", "LANG", "GFAC", "RAIM", "PUSH", "SDMA", "OMMA", "ROPD", "HYPR", "PICB", "FWGN",
    "ZVDX", "ZVDY", "ZVCX", "ZVCY", "ZVAN", "WWGT", "WWGN", "POLS", "GLRS", "GSTD", "NSCD", "COFN", "BLNK", "FWGT",
    "FLDC", "DBDT", "NSCS", "PROJ", "AUTH", "EFFL", "SCFG", "PKUP", "OPDX", "LUID", "TITL", "FCOM",
])  # fmt: skip
_HARMLESS_SURFACE = frozenset([
    "FIMP", "HIDE", "MIRR", "SLAB", "POPS", "COMM", "MEMA", "MAZH", "PZUP", "PPAR", "PKUP", "CRSR", "EDGE", "VPAR",
    "VCON", "VDSZ", "SPID", "TCMM", "TCE", "CNVL", "GCRS", "COLR", "FLIP", "PSCL", "SDRT", "SCOL", "ISNA", "BKEF",
    "BKDF", "BKSN", "FCDR", "SDWN", "SFCO", "SOPA", "THIC", "DRAW", "PFLC", "SCAT", "LAFT",
])  # fmt: skip


_UNDERSTOOD_SURFACE = frozenset([
    "TYPE", "CURV", "DISZ", "DIAM", "CONI", "GLAS", "PARM", "STOP", "FLAP", "CLAP", "SQAP", "OBDC",
])  # fmt: skip
#: Lines of a surface, which programs other than Zemax write without the blanks before them.
_OF_A_SURFACE = _UNDERSTOOD_SURFACE | {"COMM", "COAT", "XDAT", "SCBD"}


@dataclass
class _SurfaceBlock:
    """One SURF block of a file: (keyword, rest of the line) of each line in order."""

    number: int
    lines: list[tuple[str, str]] = field(default_factory=list)

    def last(self, keyword: str) -> str | None:
        values = [rest for name, rest in self.lines if name == keyword]
        return values[-1] if values else None


def decode(data: bytes) -> str:
    """Text of a file in UTF-16 (with or without its mark), UTF-8 or latin-1."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", errors="replace")
    if data[1:2] == b"\0" or data[:1] == b"\0":
        return data.decode("utf-16-le" if data[1:2] == b"\0" else "utf-16-be", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def read_zmx(path: Path | str) -> Prescription:
    """Read a Zemax `.zmx` file. PrescriptionError, in one line, for what can't be read or isn't understood."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise PrescriptionError(f"{path}: can't be read ({error.strerror}); give a .zmx file") from error
    try:
        return parse_zmx(decode(data), fallback_name=Path(path).stem)
    except PrescriptionError as error:
        raise PrescriptionError(f"{path}: {error}") from error


def parse_zmx(text: str, *, fallback_name: str = "lens") -> Prescription:
    """Return a prescription from the text of a `.zmx` file.

    Surfaces STANDARD, EVENASPH, XASPHERE, ODDASPHE and COORDBRK; apertures FLAP, CLAP, SQAP with OBDC; the system's
    aperture ENPD, FNUM, OBNA or FLOA; fields FTYP, XFLN, YFLN; wavelengths WAVM, WAVN or WAVL with PWAV; units MM, CM,
    IN, METER; catalogues GCAT. Other surfaces, mirrors, obscurations and apertures of other shapes are refused by name.
    """
    header, blocks, tail = _split(text)
    return _Reader(header, blocks, tail, fallback_name).prescription()


def _split(text: str) -> tuple[list[tuple[str, str]], list[_SurfaceBlock], list[tuple[str, str]]]:
    """Header, surfaces, and what follows them (merit function, tolerances, configurations), as (keyword, rest) each."""
    header: list[tuple[str, str]] = []
    tail: list[tuple[str, str]] = []
    blocks: list[_SurfaceBlock] = []
    inside = False
    for line in text.splitlines():
        stripped = line.strip().strip("\0")
        if not stripped:
            continue
        keyword, _, rest = stripped.partition(" ")
        rest = rest.strip()
        if keyword == "SURF":
            if len(blocks) >= _MAXIMUM_SURFACES:
                raise PrescriptionError(f"more than {_MAXIMUM_SURFACES} surfaces; is this a lens?")
            blocks.append(_SurfaceBlock(int(_number(rest, "SURF", "number", "header"))))
            inside = True
        elif inside and (line[:1] in (" ", "\t") or keyword in _OF_A_SURFACE):
            blocks[-1].lines.append((keyword, rest))
        elif blocks:
            inside = False
            tail.append((keyword, rest))
        else:
            header.append((keyword, rest))
    if len(blocks) < 3:
        raise PrescriptionError(
            f"{len(blocks)} surfaces found; a .zmx file has SURF blocks for the object, the lens and the image"
        )
    return header, blocks, tail


def _number(text: str, keyword: str, meaning: str, where: str, position: int = 0) -> float:
    """Return the number at a position of a keyword's line."""
    parts = text.split()
    if len(parts) <= position:
        raise PrescriptionError(f"{where}: {keyword} has no {meaning}; the file is damaged, export it again")
    token = parts[position]
    if token.upper() == "INFINITY":
        return math.inf
    try:
        value = float(token)
    except ValueError:
        remedy = f"write {token.replace(',', '.')}" if _COMMA.fullmatch(token) else "correct it"
        raise PrescriptionError(f"{where}: {keyword} {meaning} {token[:40]!r} is not a number; {remedy}") from None
    if math.isnan(value):
        raise PrescriptionError(f"{where}: {keyword} {meaning} is not a number; correct it")
    return value


@contextlib.contextmanager
def _within_bounds(where: str) -> Iterator[None]:
    """A value that a prescription can't have is an error of the file in one line."""
    try:
        yield
    except ValidationError as refused:
        first = refused.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise PrescriptionError(f"{where}: {name} {str(first['input'])[:40]}: {first['msg']}; correct it") from None


def _optional(text: str, position: int, default: float = 0.0) -> float:
    parts = text.split()
    try:
        value = float(parts[position])
    except IndexError:
        return default
    except ValueError:
        token = parts[position]
        if _COMMA.fullmatch(token):
            raise PrescriptionError(f"{token!r} is not a number; write {token.replace(',', '.')}") from None
        return default
    return value if math.isfinite(value) else default


class _Reader:
    """Turns the lines of a file into a prescription, and collects what isn't understood."""

    def __init__(
        self,
        header: list[tuple[str, str]],
        blocks: list[_SurfaceBlock],
        tail: list[tuple[str, str]],
        fallback_name: str,
    ) -> None:
        self.header, self.blocks, self.tail, self.fallback_name = header, blocks, tail, fallback_name
        self.warnings: list[str] = []
        self.scale = 1.0

    def prescription(self) -> Prescription:
        self._check_header()
        stated = (self._header("UNIT") or "").split()
        if not stated:
            self.warnings.append("header: UNIT isn't stated: lengths are taken as mm (UNIT MM)")
        unit = stated[0].upper() if stated else "MM"
        if unit not in _UNIT_MM:
            raise PrescriptionError(f"header: UNIT {unit} is none of {', '.join(_UNIT_MM)}; correct it")
        self.scale = _UNIT_MM[unit]
        surfaces = [self._surface(block) for block in self.blocks]
        object_mm = self._object_distance(self.blocks[0], surfaces[0])
        stops = [i for i, block in enumerate(self.blocks) if block.last("STOP") is not None]
        if len(stops) != 1 or not 0 < stops[0] < len(surfaces) - 1:
            raise PrescriptionError(f"{len(stops)} surfaces are marked STOP between object and image; mark one")
        aperture_kind, aperture_value = self._aperture()
        if aperture_kind == "object_numerical_aperture" and object_mm is None:
            raise PrescriptionError("header: OBNA with an object at infinity; give ENPD or FNUM")
        field_kind, points = self._fields()
        if field_kind == "object_height_mm" and object_mm is None:
            raise PrescriptionError("header: FTYP 1 (object height) with an object at infinity; give angles (FTYP 0)")
        wavelengths, primary = self._wavelengths()
        name = (self._header("NAME") or "").strip('" ') or self.fallback_name
        with _within_bounds("header"):
            return Prescription(
                name=name,
                surfaces=tuple(surfaces[1:]),
                stop=stops[0] - 1,
                object_distance_mm=object_mm,
                aperture_kind=aperture_kind,
                aperture_value=surfaces[stops[0]].semi_diameter_mm
                if aperture_kind == "stop_semi_diameter"
                else aperture_value,
                field_kind=field_kind,
                field_points=points,
                wavelength_nm=wavelengths,
                primary_wavelength_nm=primary,
                catalogues=tuple((self._header("GCAT") or "").upper().split()),
                paraxial_stop=int(_optional(self._header("RAIM") or "", 1)) == 1,
                stated_focal_length_mm=self._read_focal_length(),
                stated_stop_mm=self._read_stop(self.blocks[stops[0]]),
                warnings=tuple(dict.fromkeys(self.warnings)),
            )

    # --- header -------------------------------------------------------------------------------------------------------

    def _header(self, keyword: str) -> str | None:
        values = [rest for name, rest in self.header if name == keyword]
        return values[-1] if values else None

    def _check_header(self) -> None:
        for keyword, rest in self.header:
            if keyword not in _UNDERSTOOD_HEADER and keyword not in _HARMLESS_HEADER:
                self.warnings.append(f"header: {keyword[:8]} {rest[:40]} is not understood and has no effect here")
        mode = (self._header("MODE") or "SEQ").split()
        if mode and mode[0] != "SEQ":
            raise PrescriptionError(
                f"header: MODE {mode[0]}: only sequential lenses (SEQ) are traced; export it as such"
            )
        environment = self._header("ENVD")
        if environment and (_optional(environment, 0, 20.0), _optional(environment, 1, 1.0)) != (20.0, 1.0):
            self.warnings.append(
                f"header: ENVD {environment}: indices are those at 20 degC and 1 atm; the file's temperature and "
                "pressure have no effect"
            )
        if any(_nonzero(self._header(name)) for name in ("VDXN", "VDYN", "VCXN", "VCYN", "VANN")):
            self.warnings.append(
                "header: the vignetting factors VDX, VDY, VCX, VCY have no effect here: rays are clipped by the "
                "surfaces' apertures"
            )
        for keyword, rest in self.tail:
            if keyword == "MNUM" and _optional(rest, 0, 1.0) > 1:
                self.warnings.append(
                    f"MNUM {rest}: several configurations; the one that the surfaces stand in is traced"
                )

    def _aperture(self) -> tuple[ApertureKind, float]:
        stated = [name for name in ("ENPD", "FNUM", "OBNA", "FLOA", "OCOS") if self._header(name) is not None]
        if len(stated) != 1 or stated == ["OCOS"]:
            what = " and ".join(stated) or "nothing"
            raise PrescriptionError(f"header: the aperture is given by {what}; give one of ENPD, FNUM, OBNA, FLOA")
        keyword = stated[0]
        if keyword == "FLOA":
            return "stop_semi_diameter", 0.0
        rest = self._header(keyword) or ""
        value = _number(rest, keyword, "value", "header")
        if not 0 < value < math.inf:
            raise PrescriptionError(f"header: {keyword} {value:g} is not above the limit of 0; correct it")
        variant = int(_optional(rest, 1))
        if keyword == "ENPD":
            return "entrance_pupil_mm", value * self.scale
        if keyword == "OBNA":
            return "object_numerical_aperture", value
        return ("working_f_number" if variant == 1 else "f_number"), value

    def _fields(self) -> tuple[FieldKind, tuple[tuple[float, float], ...]]:
        stated = self._header("FTYP") or "0"
        kind = int(_number(stated, "FTYP", "kind", "header"))
        kinds: tuple[FieldKind, ...] = (
            "angle_deg",
            "object_height_mm",
            "paraxial_image_height_mm",
            "real_image_height_mm",
        )
        if not 0 <= kind < len(kinds):
            raise PrescriptionError(
                f"header: FTYP {kind} is none of 0 (angle), 1 (object height), 2 and 3 (image height); correct it"
            )
        if _optional(stated, 1) != 0:
            raise PrescriptionError(
                "header: FTYP says telecentric in object space, which isn't traced; use an entrance pupil"
            )
        count = int(_optional(stated, 2, 12.0)) or 12
        scale = 1.0 if kind == 0 else self.scale
        xs, ys = (
            self._numbers(next((key for key in keys if self._header(key) is not None), keys[0]), count)
            for keys in (("XFLN", "XFLD"), ("YFLN", "YFLD"))
        )
        length = max(len(xs), len(ys), 1)
        xs += [0.0] * (length - len(xs))
        ys += [0.0] * (length - len(ys))
        points = tuple((x * scale, y * scale) for x, y in zip(xs, ys, strict=True))
        if kind == 0 and any(abs(x) >= 90 or abs(y) >= 90 for x, y in points):
            raise PrescriptionError("header: a field angle isn't below the limit of 90 deg; correct XFLN, YFLN")
        return kinds[kind], points

    def _numbers(self, keyword: str, count: int) -> list[float]:
        rest = self._header(keyword)
        if rest is None:
            return []
        values = [_number(rest, keyword, f"value {i + 1}", "header", i) for i in range(min(count, len(rest.split())))]
        if not all(math.isfinite(value) for value in values):
            raise PrescriptionError(f"header: {keyword} holds a value that isn't finite; correct it")
        return values

    def _wavelengths(self) -> tuple[tuple[float, ...], float | None]:
        in_um = [_number(rest, "WAVM", "wavelength", "header", 1) for keyword, rest in self.header if keyword == "WAVM"]
        for keyword in ("WAVN", "WAVL"):  # one line each, of 24 and of 12 wavelengths
            listed = self._header(keyword)
            if not in_um and listed is not None:
                in_um = [_number(listed, keyword, "wavelength", "header", i) for i in range(len(listed.split()))]
        used = int(_optional(self._header("FTYP") or "", 3))
        if 0 < used < len(in_um):
            in_um = in_um[:used]
        wavelengths = tuple(1e3 * value for value in in_um)
        if not all(100 <= value <= 20000 for value in wavelengths):
            raise PrescriptionError("header: a wavelength isn't between 0.1 and 20 um; correct WAVM")
        stated = self._header("PWAV")
        if not wavelengths:
            self.warnings.append("header: no wavelength is stated (WAVM): first-order quantities are those at 550 nm")
            return wavelengths, None
        if stated is None:
            if len(wavelengths) > 1:
                self.warnings.append(f"header: PWAV isn't stated: {wavelengths[0]:g} nm is taken as the primary")
            return wavelengths, wavelengths[0]
        primary = int(_number(stated, "PWAV", "number", "header"))
        if not 1 <= primary <= len(wavelengths):
            raise PrescriptionError(f"header: PWAV {primary} is none of the {len(wavelengths)} wavelengths; correct it")
        return wavelengths, wavelengths[primary - 1]

    def _read_focal_length(self) -> float | None:
        """Return the focal length that the file's merit function asks for with a weight, if it does."""
        for keyword, rest in self.tail:
            if keyword in ("EFLY", "EFLX", "EFFL"):
                target, weight = _optional(rest, 6), _optional(rest, 7)
                if target > 0 and weight > 0:
                    return target * self.scale
        return None

    def _read_stop(self, stop: _SurfaceBlock) -> float | None:
        """Return the stop's semi-diameter where it is fixed or was found by aiming rays at the stop: else it is the
        beams' extent.
        """
        stated = stop.last("DIAM") or ""
        aimed = int(_optional(self._header("RAIM") or "", 1)) != 0
        radius = _optional(stated, 0) * self.scale
        return radius if radius > 0 and (aimed or _optional(stated, 1) == 1) else None

    # --- surfaces -----------------------------------------------------------------------------------------------------

    def _object_distance(self, block: _SurfaceBlock, surface: Surface) -> float | None:
        where = f"surface {block.number} (object)"
        if surface.kind != "standard" or surface.curvature_per_mm:
            raise PrescriptionError(f"{where}: the object isn't a plane; make it one")
        if surface.glass is not None:
            raise PrescriptionError(f"{where}: the object lies in {surface.glass.name}, only air is traced; correct it")
        stated = block.last("DISZ")
        distance = math.inf if stated is None else _number(stated, "DISZ", "thickness", where)
        if not math.isfinite(distance) or abs(distance) * self.scale >= 1e9:
            return None
        if distance <= 0:
            raise PrescriptionError(
                f"{where}: DISZ {distance:g} isn't above the limit of 0; the object lies before the lens"
            )
        return distance * self.scale

    def _surface(self, block: _SurfaceBlock) -> Surface:
        is_object = block is self.blocks[0]
        where = f"surface {block.number}"
        stated_kind = (block.last("TYPE") or "STANDARD").split()[0].upper()
        if stated_kind not in _KINDS:
            raise PrescriptionError(
                f"{where}: surfaces of type {stated_kind[:20]} aren't traced, only {', '.join(_KINDS)}; replace it"
            )
        kind = _KINDS[stated_kind]
        glass = self._glass(block, where)
        parameters = self._parameters(block, where)
        if kind in ("standard", "coordinate_break"):
            coefficients: tuple[float, ...] = ()
        else:
            power = 2 if kind == "even_asphere" else 1
            terms = self._extended_terms(block, where) if stated_kind == "XASPHERE" else parameters
            coefficients = tuple(terms.get(i, 0.0) * self.scale ** (1 - power * i) for i in range(1, ASPHERE_TERMS + 1))
            beyond = [i for i, value in terms.items() if i > ASPHERE_TERMS and value]
            if beyond:
                raise PrescriptionError(
                    f"{where}: term {beyond[0]} of {stated_kind} isn't known; at most {ASPHERE_TERMS} terms"
                )
            while coefficients and coefficients[-1] == 0.0:
                coefficients = coefficients[:-1]
        thickness = self._length(block, "DISZ", "thickness", where) if not is_object else 0.0
        if not math.isfinite(thickness):
            raise PrescriptionError(f"{where}: DISZ INFINITY stands behind the object; give a distance")
        curvature = self._length(block, "CURV", "curvature", where) / self.scale**2
        if kind == "coordinate_break" and (curvature or glass):
            raise PrescriptionError(f"{where}: a coordinate break has neither curvature nor glass; correct it")
        self._check_keywords(block, where)
        semi_diameter = _optional(block.last("DIAM") or "", 0) * self.scale
        with _within_bounds(where):
            return Surface(
                kind=kind,
                curvature_per_mm=curvature,
                conic=_number(block.last("CONI") or "0", "CONI", "constant", where),
                coefficients_mm=coefficients,
                thickness_mm=thickness,
                glass=glass,
                semi_diameter_mm=semi_diameter,
                aperture=None if is_object else self._surface_aperture(block, semi_diameter, where),
                decentre_mm=(parameters.get(1, 0.0) * self.scale, parameters.get(2, 0.0) * self.scale)
                if kind == "coordinate_break"
                else (0.0, 0.0),
                tilt_deg=(parameters.get(3, 0.0), parameters.get(4, 0.0), parameters.get(5, 0.0))
                if kind == "coordinate_break"
                else (0.0, 0.0, 0.0),
                tilt_first=kind == "coordinate_break" and parameters.get(6, 0.0) != 0.0,
            )

    def _length(self, block: _SurfaceBlock, keyword: str, meaning: str, where: str) -> float:
        stated = block.last(keyword)
        return 0.0 if stated is None else _number(stated, keyword, meaning, where) * self.scale

    def _parameters(self, block: _SurfaceBlock, where: str) -> dict[int, float]:
        parameters: dict[int, float] = {}
        for keyword, rest in block.lines:
            if keyword == "PARM":
                value = _number(rest, "PARM", "value", where, 1)
                if not math.isfinite(value):
                    raise PrescriptionError(f"{where}: PARM {rest} isn't finite; correct it")
                parameters[int(_number(rest, "PARM", "number", where))] = value
        return parameters

    def _extended_terms(self, block: _SurfaceBlock, where: str) -> dict[int, float]:
        """Return the coefficients of r^2, r^4, ... of an extended asphere: those of its extra data over powers of its
        norm radius."""
        data = {
            int(_number(rest, "XDAT", "number", where)): _number(rest, "XDAT", "value", where, 1)
            for keyword, rest in block.lines
            if keyword == "XDAT"
        }
        count, radius = int(data.get(1, 0.0)), data.get(2, 0.0)
        if count and not radius > 0:
            raise PrescriptionError(f"{where}: XDAT 2, the norm radius, is {radius:g}, not above 0; correct it")
        return {i: data.get(i + 2, 0.0) / radius ** (2 * i) for i in range(1, count + 1)}

    def _glass(self, block: _SurfaceBlock, where: str) -> GlassName | None:
        stated = block.last("GLAS")
        if not stated:
            return None
        parts = stated.split()
        name = parts[0].upper()
        if name == "MIRROR":
            raise PrescriptionError(f"{where}: a mirror; only lenses that light passes straight through are traced")
        solve = int(_optional(stated, 1))
        index_d, abbe_d = _optional(stated, 3), _optional(stated, 4)
        if solve == 1 or name == "___BLANK":
            if not (1.0 < index_d < 5.0 and abbe_d > 0.0):
                raise PrescriptionError(
                    f"{where}: the model glass has nd {index_d:g} and Vd {abbe_d:g}; give nd above 1 and Vd above 0"
                )
            return GlassName(
                name=f"nd {index_d:g} Vd {abbe_d:g}",
                model=True,
                index_d=index_d,
                abbe_d=abbe_d,
                partial_dispersion_deviation=_optional(stated, 5),
            )
        known = (index_d, abbe_d) != _UNKNOWN_GLASS and 1.0 < index_d < 5.0 and abbe_d > 0.0
        return GlassName(name=name, index_d=index_d, abbe_d=abbe_d) if known else GlassName(name=name)

    def _surface_aperture(self, block: _SurfaceBlock, semi_diameter: float, where: str) -> Aperture | None:
        shift = block.last("OBDC") or ""
        centre = (_optional(shift, 0) * self.scale, _optional(shift, 1) * self.scale)
        for refused, meaning in (
            ("OBSC", "an obscuration"),
            ("SQOB", "an obscuration"),
            ("ELOB", "an obscuration"),
            ("ELAP", "an elliptical aperture"),
            ("SPID", "a spider"),
            ("UDAD", "a drawn aperture"),
            ("USAP", "a drawn aperture"),
        ):
            if block.last(refused) is not None:
                raise PrescriptionError(
                    f"{where}: {refused}: {meaning} isn't traced; use a circle (CLAP) or a rectangle (SQAP)"
                )
        square = block.last("SQAP")
        if square is not None:
            half = [_number(square, "SQAP", "half width", where, i) * self.scale for i in range(2)]
            if min(half) <= 0:
                raise PrescriptionError(f"{where}: SQAP {square} isn't above the limit of 0; correct it")
            return Aperture(shape="rectangle", half_width_mm=half[0], half_height_mm=half[1], centre_mm=centre)
        for keyword in ("CLAP", "FLAP"):
            stated = block.last(keyword)
            if stated is None:
                continue
            if _number(stated, keyword, "inner radius", where) > 0:
                raise PrescriptionError(f"{where}: {keyword} with an inner radius: rings aren't traced; set it to 0")
            radius = _number(stated, keyword, "radius", where, 1) * self.scale
            # A floating aperture is as large as the surface's semi-diameter; older files leave its own radius at 0.
            if keyword == "FLAP" and radius <= 0:
                radius = semi_diameter
            if not 0 < radius < math.inf:
                raise PrescriptionError(f"{where}: {keyword} {stated} isn't above the limit of 0; correct it")
            return Aperture(shape="circle", half_width_mm=radius, half_height_mm=radius, centre_mm=centre)
        return None

    def _check_keywords(self, block: _SurfaceBlock, where: str) -> None:
        extended = (block.last("TYPE") or "").split()[:1] == ["XASPHERE"]
        for keyword, rest in block.lines:
            if keyword == "COAT":
                self.warnings.append(
                    f"{where}: COAT {rest[:40]}: coatings have no effect here, surfaces transmit all light"
                )
            elif keyword == "SCBD" and any(_nonzero_values(rest.split(" ", 2)[-1])):
                raise PrescriptionError(
                    f"{where}: SCBD {rest[:40]}: a tilt or decentre of the surface itself isn't traced; write it as "
                    "coordinate breaks (TYPE COORDBRK)"
                )
            elif keyword == "XDAT" and not extended and _nonzero(rest.partition(" ")[2].split(" ")[0]):
                self.warnings.append(f"{where}: XDAT {rest[:40]} is not understood and has no effect here")
            elif (
                keyword not in _UNDERSTOOD_SURFACE
                and keyword not in _HARMLESS_SURFACE
                and keyword not in ("XDAT", "SCBD")
            ):
                self.warnings.append(f"{where}: {keyword[:8]} {rest[:40]} is not understood and has no effect here")


def _nonzero(text: str | None) -> bool:
    return text is not None and any(True for _ in _nonzero_values(text))


def _nonzero_values(text: str) -> Iterator[float]:
    for token in text.split():
        try:
            value = float(token)
        except ValueError:
            continue
        if value != 0.0:
            yield value
