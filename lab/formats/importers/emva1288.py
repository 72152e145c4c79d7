"""Recordings for EMVA 1288: a folder with images and a descriptor, a text file that says what each image is.

The descriptor's lines, in the form that the reference sets of the EMVA 1288 working group share: `v` release of the
standard; `n` bits, width, height; `b` exposure (ns), photons a pixel: a bright level; `d` exposure (ns): a dark level;
`i` path: one image of the level above it; `#` a comment. The file may have any name. Paths may have either slash and
any case of letters. The spatial stacks are levels like the others, with more images.

A descriptor doesn't give the wavelength of the light, the pixel pitch and the lens. A `camera.toml` beside it can: it
has the keys of a recording set's camera, and `wavelength_nm`. Without it they stay unknown, and the warnings say what
that prevents."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lab.errors import InputError
from lab.formats.cgats import read_foreign_text
from lab.formats.importers.images import ImageFiles, read_camera_file, read_image, read_sides
from lab.formats.importers.own_statements import compare_with_files
from lab.formats.importers.stated_settings import check_against_frames
from lab.formats.pictures import IMAGES, TIFFS, picture_facts
from lab.formats.recording_set import Manifest, RecordingSet
from lab.formats.recording_set.manifest import without_common_photons

NS = 1e-9
LARGEST_DESCRIPTOR_BYTES = 8 << 20


@dataclass
class DescribedLevel:
    """One exposure, bright or dark: its photons per pixel (None: not stated) and its images."""

    bright: bool
    exposure_s: float
    photons_per_pixel: float | None
    line: int
    images: list[str] = field(default_factory=list)


@dataclass
class ImageDescriptor:
    """The content of a descriptor file."""

    release: str | None = None
    bits: int | None = None
    width: int | None = None
    height: int | None = None
    levels: list[DescribedLevel] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)


def parse_descriptor(text: str) -> ImageDescriptor:
    r"""Return the descriptor of an EMVA 1288 data set.

    text : lines `v` release, `n` bits width height, `b` exposure (ns) photons, `d` exposure (ns), `i` image

    Raises InputError with `line N: ...` where a line can't be understood.

    >>> descriptor = parse_descriptor("n 12 640 480\nb 1000000 250.0\ni flat1.tif\ni flat2.tif\n")
    >>> descriptor.bits, descriptor.levels[0].exposure_s, descriptor.levels[0].images
    (12, 0.001, ['flat1.tif', 'flat2.tif'])
    """
    descriptor = ImageDescriptor()
    unused: Counter[str] = Counter()
    for number, line in enumerate(text.removeprefix("\ufeff").splitlines(), start=1):
        words = line.split("#")[0].split() if line.lstrip()[:1] != "i" else line.split()
        if not words or words[0].startswith("#"):
            continue
        key, rest = words[0].lower(), words[1:]
        if key == "v":
            descriptor.release = " ".join(rest) or None
        elif key == "n":
            bits, descriptor.width, descriptor.height = (
                int(value) for value in _numbers(rest, 3, number, "bits, width and height")[:3]
            )
            descriptor.bits = bits
            if not 1 <= bits <= 16:
                raise InputError(f"line {number}: {bits} bits; frames have 1 to 16: correct it")
        elif key == "b":
            exposure_ns, *photons = _numbers(rest, 1, number, "exposure (ns) and photons a pixel")
            descriptor.levels.append(DescribedLevel(True, exposure_ns * NS, photons[0] if photons else None, number))
            if len(photons) > 1:
                unused["further numbers in a line 'b'"] += 1
        elif key == "d":
            exposure_ns, *_ = _numbers(rest, 1, number, "exposure (ns)")
            descriptor.levels.append(DescribedLevel(False, exposure_ns * NS, None, number))
        elif key == "i":
            if not descriptor.levels:
                raise InputError(f"line {number}: an image before the first level; put a line 'b' or 'd' before it")
            descriptor.levels[-1].images.append(line.strip()[1:].strip().strip('"'))
        else:
            unused[f"'{key}'"] += 1
    descriptor.remarks += [f"{count} lines with {name} are not used" for name, count in unused.items()]
    return descriptor


def _numbers(words: list[str], least: int, line: int, what: str) -> list[float]:
    values: list[float] = []
    for word in words:
        try:
            values.append(float(word.strip(",;") or "nan"))
        except ValueError:
            break  # a word after the numbers (a pixel format) is ignored
    if len(values) < least or not all(np.isfinite(values)) or any(value < 0 for value in values):
        raise InputError(f"line {line}: '{' '.join(words)}' isn't {what}; write these numbers")
    return values


def find_descriptor(path: Path) -> Path:
    """Return the descriptor: `path` itself, or the only descriptor among the text files in the folder, else one folder
    deeper."""
    if path.is_file():
        return path

    def is_descriptor(file: Path) -> bool:
        if not file.is_file() or file.suffix.lower() in (*IMAGES, ".npy", ".dng", ".json", ".toml"):
            return False
        if not 0 < file.stat().st_size <= LARGEST_DESCRIPTOR_BYTES:
            return False
        try:
            text = read_foreign_text(file).text
        except InputError:
            return False
        return bool(re.search(r"^\s*[bd]\s+[\d.]", text, re.M | re.I) and re.search(r"^\s*i\s+\S", text, re.M | re.I))

    for pattern in ("*", "*/*"):
        descriptors = sorted(file for file in path.glob(pattern) if is_descriptor(file))
        if len(descriptors) == 1:
            return descriptors[0]
        if descriptors:
            names = ", ".join(file.name for file in descriptors)
            raise InputError(f"{path}: {len(descriptors)} descriptor files ({names}); give the one that counts")
    raise InputError(f"{path}: no EMVA 1288 descriptor (a text file with lines 'n', 'b', 'd', 'i'); give its folder")


class _Images:
    """Finds the images that a descriptor lists, whatever their slashes and case of letters."""

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self.by_name: dict[str, Path] = {}
        self.by_stem: dict[str, Path] = {}
        for file in sorted(root.rglob("*")):
            if file.suffix.lower() in (*IMAGES, ".npy") and file.resolve().is_relative_to(self.root):
                relative = file.relative_to(root).as_posix().lower()
                self.by_name[relative] = file
                self.by_stem.setdefault(relative.rsplit(".", 1)[0], file)

    def find(self, listed: str) -> Path | None:
        """Return the file at a listed path, or one of the same name in another image format; None: there is none."""
        path = re.sub(r"/+", "/", listed.replace("\\", "/")).lower().removeprefix("./")
        return self.by_name.get(path) or self.by_stem.get(path.rsplit(".", 1)[0])


def read_emva1288(path: Path) -> RecordingSet:
    """Return the recordings of an EMVA 1288 measurement as a recording set of one (left) camera.

    Images that are listed but missing are left out and counted. Raises InputError where no image is there, an image is
    damaged or of another size than the others, or the descriptor can't be understood.
    """
    file = find_descriptor(path)
    try:
        text = read_foreign_text(file)
        descriptor = parse_descriptor(text.text)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    images = _Images(file.parent)
    warnings = [f"{file}: {remark}" for remark in (*text.remarks, *descriptor.remarks)]
    listed = [(level, name, images.find(name)) for level in descriptor.levels for name in level.images]
    there = [(level, name, image) for level, name, image in listed if image is not None]
    missing = [name for _, name, image in listed if image is None]
    if not there:
        raise InputError(f"{file}: none of its {len(listed)} images is there; put them where it says, beside it")
    if missing:
        warnings.append(
            f"{file}: {len(missing)} of {len(listed)} listed images are missing and left out ({missing[0]} .. "
            f"{missing[-1]}); copy them for the full set"
        )
    captures, frames, pages, remarks = _captures(there)
    warnings += [f"{file}: {remark}" for remark in remarks]
    brightest = max(captures, key=lambda capture: (capture.get("photons_per_pixel") or 0.0, capture["exposure_s"]))[
        "frame"
    ]
    first = [(frames[path], pages.get(path)) for path in dict.fromkeys((captures[0]["frame"], brightest))]
    shape, shift = _shape_and_shift(first, descriptor, file, warnings)
    cameras = read_camera_file(
        file.parent / "camera.toml",
        {"left": {"rows": shape[0], "cols": shape[1], "cfa": "MONO", "bit_depth": descriptor.bits or 16}},
    )
    if "left" not in cameras:
        raise InputError(f"{file.parent / 'camera.toml'}: describes no left camera; write the keys without a table")
    camera = cameras["left"]
    keys = camera.model_dump(exclude_unset=True)
    wavelength_nm = keys.pop("wavelength_nm", None)  # of the light, not of the camera
    if descriptor.bits is None and "bit_depth" not in camera.model_fields_set:
        warnings.append(f"{file}: no line 'n', so 16 bits are assumed; write 'n BITS WIDTH HEIGHT'")
    unknown = [key for key in ("pixel_pitch_um", "black_level_dn") if getattr(camera, key) is None]
    if wavelength_nm is None:
        unknown.insert(0, "wavelength_nm")
    if unknown:
        warnings.append(
            f"{file}: doesn't state {', '.join(unknown)}"
            f"{'; the quantum efficiency is that at the wavelength of its light' if wavelength_nm is None else ''}: "
            "what is unknown stays so; write what you know into camera.toml beside it"
        )
    for capture in captures:
        if capture["kind"] == "flat":
            capture["wavelength_nm"] = wavelength_nm
    manifest = Manifest.model_validate(
        {
            "format": "calibench-recording",
            "version": 1,
            "name": path.resolve().name if path.is_dir() else file.stem,
            "notes": f"imported from the EMVA 1288 descriptor {file.name}, release {descriptor.release or 'not stated'}",  # noqa: E501
            "cameras": {"left": keys},
            "captures": captures,
        }
    )
    manifest, warnings = without_common_photons(manifest, str(file), warnings)
    manifest, said = check_against_frames(manifest, frames, str(file))
    warnings += said
    stated = {**read_sides(file.parent / "camera.toml")["left"]}
    if descriptor.bits is not None:
        stated["bit_depth"] = descriptor.bits
    warnings += compare_with_files(camera, stated, frames.values())
    files = ImageFiles(file.parent, frames, shift, pages)
    return RecordingSet(manifest, source=str(path), warnings=tuple(warnings), files=files)


def _shape_and_shift(
    images: Sequence[tuple[Path, int | None]], descriptor: ImageDescriptor, file: Path, warnings: list[str]
) -> tuple[tuple[int, int], int]:
    """Rows and columns of the images, and by how many bits the values are shifted up in their 16-bit container: by the
    first image and one of the brightest level (file, page)."""
    shape, shift = (0, 0), 0
    for image, page in images:
        try:
            frame = read_image(image, page)
        except InputError as error:
            raise InputError(f"{image}: {error}") from error
        shape = shape if any(shape) else (frame.shape[0], frame.shape[1])
        if descriptor.bits is not None and int(frame.max()) >= 2**descriptor.bits:
            shift = 16 - descriptor.bits
            if np.any(frame & ((1 << shift) - 1)):
                raise InputError(
                    f"{image}: {int(frame.max())} DN is above the {descriptor.bits} bits of line 'n' in {file.name}; "
                    "correct it"
                )
    rows, cols = shape
    if (descriptor.height, descriptor.width) not in (shape, (None, None)):
        warnings.append(
            f"{file}: line 'n' says {descriptor.height} x {descriptor.width}, the images are {rows} x {cols} (rows x "
            "cols): "
            "the images are believed; correct the line"
        )
    if shift:
        warnings.append(
            f"{file}: the images hold {descriptor.bits} bits shifted up by {shift}; they are shifted down: check that"
        )
    return shape, shift


def _captures(
    there: list[tuple[DescribedLevel, str, Path]],
) -> tuple[list[dict[str, Any]], dict[str, Path], dict[str, int], list[str]]:
    """The captures, one an image or a page of one; the file of each frame, and its page where that has several; and
    which files have."""
    captures: list[dict[str, Any]] = []
    frames: dict[str, Path] = {}
    pages: dict[str, int] = {}
    stacks: list[str] = []
    used: Counter[str] = Counter()
    for level, _, image in there:
        try:
            many = picture_facts(image).pages if image.suffix.lower() in TIFFS else 1
        except InputError as error:
            raise InputError(f"{image}: {error}") from error
        if many > 1:
            stacks.append(f"{image.name} ({many})")
        for page in range(many):
            stem = re.sub(r"[^\w.-]+", "_", image.stem) + ("" if many == 1 else f"-p{page + 1}")
            used[stem] += 1
            id = stem if used[stem] == 1 else f"{stem}-{used[stem]}"
            path = f"frames/{id}.npy"
            capture: dict[str, Any] = {
                "id": id,
                "kind": "flat" if level.bright else "dark",
                "side": "left",
                "frame": path,
                "exposure_s": level.exposure_s,
            }
            if level.bright:
                capture["photons_per_pixel"] = level.photons_per_pixel
            captures.append(capture)
            frames[path] = image
            if many > 1:
                pages[path] = page
    more = f" and {len(stacks) - 3} more" if len(stacks) > 3 else ""
    remarks = [f"each page of {', '.join(stacks[:3])}{more} is an image of its level"] if stacks else []
    return captures, frames, pages, remarks
