"""The camera model: every parameter declared once, with its unit, bounds and prior, and its uncertainty beside it."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import model_validator

from sim.optics.fall_off import CosineFourth, Illumination
from sim.optics.imaging import DiffractionLimited, Imaging, TracedLens
from sim.parameters import Frozen, Quantity
from sim.spectrum import Spectrum

Cfa = Literal["RGGB", "BGGR", "GRBG", "GBRG", "MONO"]
Side = Literal["left", "right"]
#: How the exposure of the rows begins: of all at one time, or one after the other.
Shutter = Literal["global", "rolling"]


#: By how much a lens's stated f-number and focal length may differ from those that its traced table has.
TABLE_AGREEMENT = 0.02


class Lens(Frozen):
    """The optics. `imaging` says how a point is imaged (default: diffraction limited at `f_number`), `illumination` how
    the light falls off (default: cos^4 at `focal_length_mm`); a traced lens's table says both. `focal_length_mm`: None
    where nobody says; the light then doesn't fall off. Raises where a traced lens is of another f-number or focal
    length.
    """

    f_number: Annotated[float, Quantity("1", "working f-number", lower=0.5, upper=64.0)]
    focal_length_mm: Annotated[float | None, Quantity("mm", "focal length", lower=0.1, upper=5000.0)] = None
    transmittance: Annotated[float, Quantity("1", "transmittance on the axis", lower=0.0, upper=1.0)] = 1.0
    imaging: Imaging = DiffractionLimited()
    illumination: Illumination = CosineFourth()

    @property
    def known_focal_length_mm(self) -> float:
        """The focal length, mm. Raises ValueError where nobody says it."""
        if self.focal_length_mm is None:
            raise ValueError(
                "focal_length_mm of the camera's lens is not set, and the scale of the image depends on it: write it "
                "into the camera file below [lens], or name a prescription (--lens)"
            )
        return self.focal_length_mm

    @model_validator(mode="after")
    def _agrees_with_its_table(self) -> Self:
        if isinstance(self.imaging, TracedLens):
            table = self.imaging.table
            for name, stated, traced in (
                ("f-number", self.f_number, table.f_number),
                ("focal length in mm", self.focal_length_mm, table.focal_length_mm),
            ):
                if stated is not None and abs(stated / traced - 1.0) > TABLE_AGREEMENT:
                    raise ValueError(
                        f"the lens's {name} is {stated:g}, beyond the limit of {100 * TABLE_AGREEMENT:g} % from the "
                        f"traced {traced:g}: state the traced value, or trace the prescription at the aperture you mean"
                    )
        return self


ProjectionKind = Literal["pinhole", "equidistant", "splined_stereographic"]


class Geometry(Frozen):
    """How the camera projects (`sim.scene.projection`): camera matrix, px, x to the right, and distortion coefficients.

    Of a pinhole these are OpenCV's `k1 k2 p1 p2 k3 [k4 k5 k6]`; of an equidistant fisheye OpenCV's `k1 k2 k3 k4`; of a
    splined stereographic projection `s1 s2 p1 p2 s3 s4 s5 s6`, with the angle from the axis at which its spline ends.
    """

    camera_matrix: tuple[tuple[float, float, float], ...]
    distortion: tuple[float, ...] = ()
    projection: ProjectionKind = "pinhole"
    spline_angle_deg: float | None = None

    @property
    def is_ideal(self) -> bool:
        """Return whether this is a pinhole without distortion."""
        return self.projection == "pinhole" and not any(self.distortion)


class CameraModel(Frozen):
    """One camera's parameters. Fits fill it, `sim.frame` predicts with it.

    `quantum_efficiency` is the sensor's with its colour filters, electrons a photon, per channel (`R`, `G`, `B`, or `Y`
    of a MONO sensor), without the lens's transmittance and without any infrared filter that the maker left out.
    `shutter`: None where nobody says. `std` holds one standard uncertainty by field name; `quantum_efficiency_std` the
    same on the wavelengths of the curve.
    """

    rows: Annotated[int, Quantity("px", "rows of the frame", lower=1)]
    cols: Annotated[int, Quantity("px", "columns of the frame", lower=1)]
    pixel_pitch_um: Annotated[float, Quantity("um", "distance of neighbouring pixels", lower=0.1, upper=100.0)]
    fill_factor: Annotated[
        float,
        Quantity("1", "share of the pixel's area that collects light, a centred square", lower=0.01, upper=1.0),
    ]
    cfa: Cfa
    bit_depth: Annotated[int, Quantity("bit", "depth of the converter", lower=1, upper=16)]
    black_level_dn: Annotated[float, Quantity("DN", "mean of a dark pixel at zero exposure", lower=0.0)]
    white_level_dn: Annotated[float, Quantity("DN", "highest code of the converter", lower=1.0)]
    conversion_gain_dn_per_e: Annotated[
        float, Quantity("DN/e", "overall system gain K: codes per electron at 0 dB", lower=1e-6)
    ]
    full_well_e: Annotated[float, Quantity("e", "electrons at which the pixel saturates", lower=1.0)]
    read_noise_e: Annotated[float, Quantity("e", "temporal noise of a dark pixel without quantisation", lower=0.0)]
    dark_current_e_per_s: Annotated[float, Quantity("e/s", "mean dark current at the reference temperature", lower=0.0)]
    dsnu_e: Annotated[float, Quantity("e", "spatial standard deviation of the dark signal", lower=0.0)]
    prnu_percent: Annotated[float, Quantity("%", "spatial standard deviation of the response", lower=0.0)]
    quantum_efficiency: dict[str, Spectrum]
    lens: Lens
    geometry: Geometry | None = None
    dark_current_reference_c: Annotated[
        float, Quantity("C", "sensor temperature at which the dark current is stated", lower=-273.0, upper=200.0)
    ] = 25.0
    dark_current_doubling_c: Annotated[
        float | None,
        Quantity(
            "C",
            "rise in temperature that doubles the dark current; without it the dark current is constant",
            lower=0.5,
            upper=100.0,
        ),
    ] = None
    row_noise_e: Annotated[
        float, Quantity("e", "temporal noise that all pixels of a row share, new in every frame", lower=0.0)
    ] = 0.0
    column_noise_e: Annotated[
        float, Quantity("e", "spatial standard deviation of the columns' fixed offsets", lower=0.0)
    ] = 0.0
    shutter: Shutter | None = None
    std: dict[str, float] = {}
    quantum_efficiency_std: dict[str, Spectrum] = {}

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the colour channels, in the order R, G, B; `("Y",)` for a MONO sensor."""
        return ("Y",) if self.cfa == "MONO" else ("R", "G", "B")

    @property
    def half_diagonal_px(self) -> float:
        return 0.5 * math.hypot(self.rows, self.cols)

    @property
    def half_diagonal_um(self) -> float:
        return self.half_diagonal_px * self.pixel_pitch_um


class StereoRig(Frozen):
    """Two cameras in one frame: `x_right = rotation x_left + translation_mm` (OpenCV's convention)."""

    left: CameraModel
    right: CameraModel
    rotation: tuple[tuple[float, float, float], ...]
    translation_mm: tuple[float, float, float]
