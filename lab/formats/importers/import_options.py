"""What the command line says beside a path, for the importers that ask for it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class ImportOptions:
    """Statements that a format doesn't hold. None: not stated.

    `checkerboard`, `dots`: inner corners or dots (rows, cols), `square_mm` their spacing. `camera`: a camera file, in place of the
    `camera.toml` beside the picture. `channel`: of a colour picture, R, G or B. `transfer`: what the picture's codes are, proportional to
    the light or sRGB. `corners`: of a chart's 24 patches, [row, col] of dark skin, bluish green, black, white. `light`, `white_patch`: CSV of
    the radiance of a perfect diffuser, or of the chart's white patch, in the chart's place. `tap`: one tap of the sensor alone.
    """

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
