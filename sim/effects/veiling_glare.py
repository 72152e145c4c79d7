"""Veiling glare: a share of the light is spread over the whole frame."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.optics.filters import veil_otf
from sim.parameters import Quantity
from sim.spectrum import FloatArray


class VeilingGlare(Effect):
    """I' = (1 - g) I + g <I>: OTF 1 at zero frequency, 1 - g at every other that a frame holds."""

    name: ClassVar[str] = "veiling_glare"
    stage: ClassVar[Stage] = Stage.OPTICS
    reference: ClassVar[str] = "ISO 9358:1994; ISO 18844:2017"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "wavelength", "level", "orientation", "time"})
    shown_by: ClassVar[frozenset[str]] = frozenset({"chart", "checkerboard", "bernoulli"})
    rivals: ClassVar[frozenset[str]] = frozenset(
        {"ambient_light", "black_level_drift", "ghost", "nonlinearity", "stray_light"}
    )
    sentence: ClassVar[str] = (
        "Light scattered in the lens veils the frame: dark patches and dark squares are raised by a share of the frame's mean, "
        "while uniform fields stay as they are."
    )

    share_percent: Annotated[
        float,
        Quantity(
            "%", "share of the light that is spread over the frame", lower=0.0, upper=50.0, prior=(0.0, 2.0), absent=0.0
        ),
    ] = 0.0

    def transfer(
        self, fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float, camera: CameraModel
    ) -> FloatArray | None:
        if self.share_percent == 0.0:
            return None
        return veil_otf(fx_cy_per_um, fy_cy_per_um, self.veil())

    def veil(self) -> float:
        return self.share_percent / 100.0
