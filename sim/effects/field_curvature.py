"""Field curvature and tilt: the image lies on a bowl, or the sensor askew to it."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.optics.pupil import Wavefront, seidel
from sim.parameters import Quantity
from sim.stages import Image


class FieldCurvature(Effect):
    """The sensor lies dz = c r^2 + a x + b y from the focus, x, y from its centre in half diagonals: W = dz / (8 N^2)
    rho^2.

    `transfer` is that of one place, the centre unless `at_place` says another: edges and kernels show it, whole frames
    are drawn as the centre is.
    """

    name: ClassVar[str] = "field_curvature"
    family: ClassVar[Family] = Family.ISOTROPIC_CONTRAST
    reference: ClassVar[str] = "W. J. Smith, Modern Optical Engineering, chapter on aberrations"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "orientation", "time"})
    sentence: ClassVar[str] = (
        "The plane of focus is bowed or tilted against the sensor: the image is sharp in some places and out of focus "
        "in others."
    )

    curvature_um: Annotated[
        float,
        Quantity("um", "distance of sensor and focus half a diagonal from the centre, of the part that is quadratic in "
                       "the radius", lower=-200.0,
                 upper=200.0, prior=(0.0, 20.0), absent=0.0, linear_power=2),
    ] = 0.0  # fmt: skip
    tilt_x_um: Annotated[
        float,
        Quantity("um", "the same along columns, of the part that is linear", lower=-200.0, upper=200.0,
                 prior=(0.0, 20.0),
                 absent=0.0, linear_power=2),
    ] = 0.0  # fmt: skip
    tilt_y_um: Annotated[
        float,
        Quantity("um", "the same along rows", lower=-200.0, upper=200.0, prior=(0.0, 20.0), absent=0.0, linear_power=2),
    ] = 0.0  # fmt: skip

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        # a defocus that grows from place to place is no small change of the same with the other sign beside another
        # term
        return tuple(
            (cls(curvature_um=6.0), cls(tilt_x_um=sign_x * 6.0), cls(tilt_y_um=sign_y * 6.0))
            for sign_x in (1.0, -1.0)
            for sign_y in (1.0, -1.0)
        )

    def on_image(self, image: Image) -> Image:
        if self.curvature_um == 0.0 and self.tilt_x_um == 0.0 and self.tilt_y_um == 0.0:
            return image
        half_um, f_number = image.camera.half_diagonal_um, image.camera.lens.f_number

        def path(wavelength_nm: float, x_um: float, y_um: float) -> Wavefront:
            x, y = x_um / half_um, y_um / half_um
            away_um = self.curvature_um * (x * x + y * y) + self.tilt_x_um * x + self.tilt_y_um * y
            return seidel(defocus_um=away_um / (8.0 * f_number**2))

        return image.add_laws(pupil_at=path)
