"""Trefoil: a lens pressed at three places spreads points into three arms."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect, StatedFNumber
from sim.effects.families import Family
from sim.optics.pupil import Wavefront
from sim.parameters import Quantity
from sim.stages import Image


class Trefoil(Effect):
    """Path error Wx (x^3 - 3 x y^2) + Wy (3 x^2 y - y^3) over the pupil, Zernike's terms of radial degree 3 and
    azimuthal order 3, alike all over the field.

    The spread comes again after a turn by 120 degrees. The transfer function has a phase, as that of coma, which begins
    with the square of frequency: coarse detail isn't displaced. The loss of contrast goes with W^2. W is that at the
    rim of the pupil of `stated_f_number` N0: at f/N it is (N0 / N)^3 of it.
    """

    name: ClassVar[str] = "trefoil"
    family: ClassVar[Family] = Family.DIRECTIONAL_CONTRAST
    reference: ClassVar[str] = "V. Mahajan, Optical Imaging and Aberrations, part II, section 2.4"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "time"})
    sentence: ClassVar[str] = (
        "The lens has trefoil: points have three arms, so that edges are lopsided along some directions and even along "
        "others, without being displaced."
    )

    w333_x_um: Annotated[
        float,
        Quantity("um", "path error at the pupil's rim along columns", lower=-5.0, upper=5.0, prior=(0.0, 0.08),
                 absent=0.0),
    ] = 0.0  # fmt: skip
    w333_y_um: Annotated[
        float,
        Quantity("um", "path error at the pupil's rim along rows", lower=-5.0, upper=5.0, prior=(0.0, 0.08),
                 absent=0.0),
    ] = 0.0  # fmt: skip

    stated_f_number: StatedFNumber = None

    def log_prior(self) -> float:
        """Return -ln 10: the design of a lens leaves coma and astigmatism; trefoil takes a strained element."""
        return -float(np.log(10.0)) if self.w333_x_um or self.w333_y_um else 0.0

    def on_image(self, image: Image) -> Image:
        x, y = self.w333_x_um, self.w333_y_um
        if x == 0.0 and y == 0.0:
            return image
        path = Wavefront.of({(3, 0): x, (1, 2): -3.0 * x, (2, 1): 3.0 * y, (0, 3): -y})
        path = path.stopped(self.pupil_share(image.camera.lens.f_number))
        return image.add_laws(pupil=lambda wavelength_nm: path)
