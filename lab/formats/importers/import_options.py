"""Options of an import: what the user states because a format doesn't hold it."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from lab.errors import InputError


@dataclass(frozen=True)
class ImportOptions:
    """Statements that a format doesn't hold. None: not stated.

    `checkerboard`, `dots`: inner corners or dots (rows, cols), `square_mm` their spacing. `camera`: a camera file, in
    place of the `camera.toml` beside the picture. `channel`: of a colour picture, R, G or B. `transfer`: what the
    picture's codes are, proportional to the light or sRGB. `corners`: of a chart's 24 patches, [row, col] of dark skin,
    bluish green, black, white. `light`, `white_patch`: CSV of the radiance of a perfect diffuser, or of the chart's
    white patch, in the chart's place. `tap`: one tap of the sensor alone."""

    checkerboard: tuple[int, int] | None = None
    dots: tuple[int, int] | None = None
    square_mm: float | None = None
    camera: Path | None = None
    exposure_s: float | None = None
    channel: str | None = None
    transfer: Literal["linear", "srgb"] | None = None
    corners: tuple[tuple[float, float], ...] | None = None
    light: Path | None = None
    white_patch: Path | None = None
    tap: str | None = None

    def stated(self) -> tuple[str, ...]:
        """Names of the options that are stated, as on the command line."""
        names = (field.name for field in fields(self))
        return tuple(f"--{name.replace('_', '-')}" for name in names if getattr(self, name) is not None)


def grid(option: str, text: str) -> tuple[int, int] | None:
    """ROWSxCOLS as two numbers; None where `text` is empty. Raises InputError, with the option's name."""
    if not text:
        return None
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text)
    if found is None:
        raise InputError(f"{option} {text}: give ROWSxCOLS, as in 6x9")
    return int(found[1]), int(found[2])


def chart_corners(option: str, text: str) -> tuple[tuple[float, float], ...] | None:
    """Eight numbers with commas as four corners (row, col); None where `text` is empty. Raises InputError, with the
    option's name."""
    if not text:
        return None
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 8:
        raise InputError(
            f"{option} {text}: give eight numbers, row and column of dark skin, bluish green, black, white"
        )
    return tuple(zip(numbers[::2], numbers[1::2], strict=True))
