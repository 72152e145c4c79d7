"""Ambient light: light of the room reaches the sensor beside the source."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.parameters import Quantity


class AmbientLight(Effect):
    """Electrons a second added while the shutter is open, alike in all channels."""

    name: ClassVar[str] = "ambient_light"
    stage: ClassVar[Stage] = Stage.RIG
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, measuring set-up"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "level", "orientation", "time"})
    shown_by: ClassVar[frozenset[str]] = frozenset({"narrowband", "flat", "chart"})
    rivals: ClassVar[frozenset[str]] = frozenset(
        {"veiling_glare", "black_level_drift", "exposure_offset", "nonlinearity", "stray_light"}
    )
    sentence: ClassVar[str] = (
        "Light of the room reaches the sensor: all lit captures carry a signal that grows with the exposure and not with the source."
    )

    rate_e_per_s: Annotated[
        float,
        Quantity(
            "e/s",
            "electrons a second a pixel",
            lower=0.0,
            upper=10000000.0,
            prior=(0.0, 50.0),
            absent=0.0,
            slope_power=1,
        ),
    ] = 0.0

    def ambient_e_per_s(self, channel: str, camera: CameraModel) -> float:
        return self.rate_e_per_s
