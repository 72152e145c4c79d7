"""On-chip sharpening: the raw data was sharpened before it left the camera."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.parameters import Quantity
from sim.spectrum import FloatArray


class OnChipSharpening(Effect):
    """OTF factor 1 + k (1 - B), B the transfer of a 3 x 3 binomial blur on the pixels of one colour."""

    name: ClassVar[str] = "on_chip_sharpening"
    stage: ClassVar[Stage] = Stage.ELECTRONICS
    reference: ClassVar[str] = "ISO 12233:2023, annex on sharpening"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    shown_by: ClassVar[frozenset[str]] = frozenset({"slanted_edge", "bernoulli"})
    rivals: ClassVar[frozenset[str]] = frozenset({"pixel_aperture"})
    sentence: ClassVar[str] = (
        "The camera sharpens on the chip: contrast rises above what optics and pixel allow, with overshoot beside edges."
    )

    strength: Annotated[
        float,
        Quantity(
            "1",
            "share of the detail that is added again",
            lower=0.0,
            upper=5.0,
            prior=(0.0, 0.3),
            absent=0.0,
            slope_power=1,
        ),
    ] = 0.0

    def transfer(
        self, fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float, camera: CameraModel
    ) -> FloatArray | None:
        if self.strength == 0.0:
            return None
        step = camera.pixel_pitch_um * (1 if camera.cfa == "MONO" else 2)
        blur = (
            0.25 * (1.0 + np.cos(2.0 * np.pi * fx_cy_per_um * step)) * (1.0 + np.cos(2.0 * np.pi * fy_cy_per_um * step))
        )
        return np.asarray(1.0 + self.strength * (1.0 - blur))
