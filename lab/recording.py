"""The recording set: the folder format in which recordings come in from outside and go out again.

The models below are the manifest's keys, name by name. An unknown key is kept (and reported), an unknown kind of capture
is reported and skipped; anything else that is off is an `InputError`.
"""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from sim.camera import Cfa, Side

Kind = Literal[
    "dark", "flat", "narrowband", "chart", "slanted_edge", "white", "black", "checkerboard", "bernoulli", "charuco"
]


class Open(BaseModel):
    """Base of the manifest's objects: immutable; an unknown key is kept, for the format says so."""

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)

    def unknown_keys(self) -> dict[str, Any]:
        """The keys that the format doesn't know, with their values."""
        return dict(self.model_extra or {})


class Camera(Open):
    """What the manufacturer says of one camera: to be tested, not believed. None = unknown."""

    rows: int = Field(gt=0)
    cols: int = Field(gt=0)
    pixel_pitch_um: float = Field(gt=0)
    fill_factor: float = Field(gt=0, le=1)
    cfa: Cfa
    bit_depth: int = Field(ge=1, le=16)
    black_level_dn: float | None = None
    white_level_dn: float | None = None
    conversion_gain_dn_per_e: float | None = None
    full_well_e: float | None = None
    read_noise_e: float | None = None
    dark_current_e_per_s: float | None = None
    dsnu_e: float | None = None
    prnu_percent: float | None = None
    quantum_efficiency: dict[str, str] | None = None  # channel -> CSV path
    f_number: float | None = None
    focal_length_mm: float | None = None
    lens_transmittance: float | None = None
    lens_file: str | None = None


class Screen(Open):
    """How a pattern was shown: same `pose` = nothing moved."""

    pose: str
    cell_camera_px: float | None = None
    radiance: str | None = None  # CSV path of the lit screen


class Capture(Open):
    """What every capture has; each kind adds its own keys."""

    id: str
    kind: str
    side: Side
    frame: str
    exposure_s: float = Field(ge=0)
    gain_db: float | None = None
    temperature_c: float | None = None
    time: datetime | None = None


class Dark(Capture):
    kind: Literal["dark"]


class Flat(Capture):
    kind: Literal["flat"]
    radiance: str | None = None
    photons_per_pixel: float | None = None
    wavelength_nm: float | None = None


class Narrowband(Capture):
    kind: Literal["narrowband"]
    wavelength_nm: float
    bandwidth_nm: float | None = None
    radiance: str


class Chart(Capture):
    kind: Literal["chart"]
    chart: str
    corners: tuple[
        tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]
    ]  # [row, col]: dark skin, bluish green, black, white
    radiance: str


class SlantedEdge(Capture):
    kind: Literal["slanted_edge"]
    region: tuple[int, int, int, int]  # row0, col0, row1, col1, end excluded
    angle_deg: float | None = None
    dark_radiance: str | None = None
    light_radiance: str | None = None
    field_mm: tuple[float, float] | None = None  # [row, col] from the optical axis, at the sensor


class White(Capture):
    kind: Literal["white"]
    screen: Screen


class Black(Capture):
    kind: Literal["black"]
    screen: Screen


class Checkerboard(Capture):
    kind: Literal["checkerboard"]
    screen: Screen
    target: str


class Bernoulli(Capture):
    kind: Literal["bernoulli"]
    screen: Screen
    target: str


class Charuco(Capture):
    kind: Literal["charuco"]
    dictionary: str
    squares: tuple[int, int]  # rows, cols
    square_mm: float = Field(gt=0)
    marker_mm: float = Field(gt=0)
    pose: str


AnyCapture = Annotated[
    Dark | Flat | Narrowband | Chart | SlantedEdge | White | Black | Checkerboard | Bernoulli | Charuco,
    Field(discriminator="kind"),
]
C = TypeVar("C", bound=Capture)


class Manifest(Open):
    format: Literal["calibench-recording"] = "calibench-recording"
    version: Literal[1] = 1
    name: str = ""
    notes: str = ""
    cameras: dict[Side, Camera]
    captures: tuple[AnyCapture, ...]
