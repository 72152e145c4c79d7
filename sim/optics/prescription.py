"""Lens prescriptions: sequential surfaces in mm, in the order of the light. Zemax's files are read by
`sim.optics.zmx`.
"""

from __future__ import annotations

from typing import Literal

from sim.parameters import Frozen

SurfaceKind = Literal["standard", "even_asphere", "odd_asphere", "coordinate_break"]
FieldKind = Literal["angle_deg", "object_height_mm", "paraxial_image_height_mm", "real_image_height_mm"]
ApertureKind = Literal[
    "entrance_pupil_mm", "f_number", "working_f_number", "object_numerical_aperture", "stop_semi_diameter"
]

#: The most coefficients of an asphere.
ASPHERE_TERMS = 8


class PrescriptionError(ValueError):
    """A prescription can't be used; the message is one line: what, where, remedy."""


class Aperture(Frozen):
    """The opening of a surface: a circle or a rectangle, centred at (x, y) from the vertex."""

    shape: Literal["circle", "rectangle"]
    half_width_mm: float
    half_height_mm: float
    centre_mm: tuple[float, float] = (0.0, 0.0)


class GlassName(Frozen):
    """A medium as a file names it: a catalogue's glass, or a model glass by nd, Vd and the deviation of its partial
    dispersion. Of a catalogue's glass, `index_d` and `abbe_d` are what the file states with its name, 0: nothing.
    """

    name: str
    model: bool = False
    index_d: float = 0.0
    abbe_d: float = 0.0
    partial_dispersion_deviation: float = 0.0


class Surface(Frozen):
    """One sequential surface. Sag z(r) = c r^2 / (1 + sqrt(1 - (1 + conic) c^2 r^2)) + sum of the asphere's terms.

    `coefficients_mm` belong to r^2, r^4, ... of an even asphere and to r, r^2, r^3, ... of an odd one, so that the k-th
    has the unit mm^(1 - power). `thickness_mm` leads to the next surface, `glass` is the medium behind (None: air). A
    coordinate break has no sag: the frame of what follows is shifted by `decentre_mm` and turned by `tilt_deg` about x,
    y, z, right-handed, each about the axis that the one before left (Zemax's order), or the other way round where
    `tilt_first`.
    """

    kind: SurfaceKind = "standard"
    curvature_per_mm: float = 0.0
    conic: float = 0.0
    coefficients_mm: tuple[float, ...] = ()
    thickness_mm: float = 0.0
    glass: GlassName | None = None
    semi_diameter_mm: float = 0.0
    aperture: Aperture | None = None
    decentre_mm: tuple[float, float] = (0.0, 0.0)
    tilt_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tilt_first: bool = False


class Prescription(Frozen):
    """A lens: surfaces in the order of the light, the image surface last.

    `object_distance_mm` is that of the object before the first surface, None at infinity. `stop` is the stop's place in
    `surfaces`. Field points are (x, y) in what `field_kind` says. `paraxial_stop`: the stop is as large as the paraxial
    marginal ray makes it, not the real one (Zemax's paraxial ray aiming). `stated_` values are the file's own, to
    compare the traced lens with.
    """

    name: str
    surfaces: tuple[Surface, ...]
    stop: int
    object_distance_mm: float | None = None
    aperture_kind: ApertureKind
    aperture_value: float
    field_kind: FieldKind = "angle_deg"
    field_points: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    wavelength_nm: tuple[float, ...] = ()
    primary_wavelength_nm: float | None = None
    catalogues: tuple[str, ...] = ()
    paraxial_stop: bool = False
    stated_focal_length_mm: float | None = None
    stated_stop_mm: float | None = None
    warnings: tuple[str, ...] = ()

    @property
    def is_centred(self) -> bool:
        """Return whether the lens has one axis of rotation: no shift, no tilt, no aperture that isn't a circle about
        the axis.
        """
        return not any(
            any(surface.decentre_mm)
            or any(surface.tilt_deg)
            or (
                surface.aperture is not None and (surface.aperture.shape != "circle" or any(surface.aperture.centre_mm))
            )
            for surface in self.surfaces
        )
