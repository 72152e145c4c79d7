"""A lens that works at another f-number than the one that is stated of it."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.optics.diffraction import diffraction_otf
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Image

LEAST_TRANSFER = 1e-6  # of the stated lens: below, there is nothing to scale


class OtherFNumber(Effect):
    """Diffraction at N ratio in place of N: factor OTF(f, N ratio) / OTF(f, N) of perfect lenses.

    A pixel pitch that is stated wrongly does the same, as all is seen in pixels. Either is a mistake in what is stated,
    not physics that a model lacks: a diagnosis doesn't name it, but gives no name to what it explains better.
    """

    name: ClassVar[str] = "other_f_number"
    title: ClassVar[str] = "other f-number"
    family: ClassVar[Family] = Family.METADATA
    is_candidate: ClassVar[bool] = False
    reference: ClassVar[str] = "J. W. Goodman, Introduction to Fourier Optics, chapter 6"
    form_tolerance: ClassVar[float] = 0.03
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "orientation", "time", "field"})
    sentence: ClassVar[str] = (
        "The lens's diffraction is that of another f-number than the stated one, or the pixels' pitch is another: "
        "contrast falls, or rises, in proportion to frequency."
    )

    ratio: Annotated[
        float,
        Quantity(
            "1",
            "f-number at which the lens works, over the stated one",
            lower=0.4,
            upper=2.5,
            prior=(1.0, 0.3),
            absent=1.0,
        ),
    ] = 1.0

    def on_image(self, image: Image) -> Image:
        if self.ratio == 1.0:
            return image
        f_number = image.camera.lens.f_number

        def transfer(fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float) -> FloatArray:
            frequency = np.hypot(fx_cy_per_um, fy_cy_per_um)
            stated, works = (diffraction_otf(frequency, wavelength_nm, n) for n in (f_number, f_number * self.ratio))
            return np.where(stated > LEAST_TRANSFER, works / np.maximum(stated, LEAST_TRANSFER), 1.0)

        return image.add_laws(transfer=transfer)
