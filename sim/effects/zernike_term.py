"""What the path errors of one Zernike term above trefoil share."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sim.effects.base import Effect, StatedFNumber
from sim.effects.families import Family
from sim.optics.pupil import zernike
from sim.stages import Image


class ZernikeTerm(Effect):
    """Path error R(r) (a cos m t + b sin m t) over the pupil, t the angle from columns, R Zernike's radial polynomial
    of `degree` n and azimuthal `order` m, 1 at the rim; alike all over the field. Its tilt is left out.

    a and b are those at the rim of the pupil of `stated_f_number` N0: a smaller pupil is the middle of it. Terms of
    even degree act alike with either sign, and by the square of a and b; odd ones have a phase.
    """

    family: ClassVar[Family] = Family.DIRECTIONAL_CONTRAST
    reference: ClassVar[str] = "M. Born and E. Wolf, Principles of Optics, section 9.2; R. J. Noll, JOSA 66 (1976) 207"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "time"})
    degree: ClassVar[int]
    order: ClassVar[int]

    stated_f_number: StatedFNumber = None

    @property
    def cos_and_sin_um(self) -> tuple[float, float]:
        """Return a and b, um."""
        return float(getattr(self, "cos_um")), float(getattr(self, "sin_um"))  # noqa: B009

    def log_prior(self) -> float:
        """Return -ln 30: lenses are designed and adjusted until the terms below dominate."""
        return -float(np.log(30.0)) if any(self.cos_and_sin_um) else 0.0

    def on_image(self, image: Image) -> Image:
        cos_um, sin_um = self.cos_and_sin_um
        if cos_um == 0.0 and sin_um == 0.0:
            return image
        rim = np.sqrt(2.0 * (self.degree + 1.0))  # of a term of rms 1
        path = zernike(self.degree, self.order).scale(cos_um / rim) + zernike(self.degree, -self.order).scale(
            sin_um / rim
        )
        path = path.bend.stopped(self.pupil_share(image.camera.lens.f_number))
        return image.add_laws(pupil=lambda wavelength_nm: path)
