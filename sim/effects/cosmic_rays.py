"""Cosmic rays and radiation: single particles leave tracks and points in frames, each at another place."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.particles import Particles
from sim.stages import Charge


class CosmicRays(Effect):
    """A Poisson number of events a frame, in proportion to exposure and area: straight tracks of minimum ionising
    particles, 80 e a um of silicon, at angles as muons have at sea level; and points, as X-rays of surrounding
    material or recoils make, of charges between one and an exponential distribution.

    Natural rates are some 0.02 at sea level; detectors in space, at altitude and near sources see up to 1e4. A hit
    pixel is bright in one frame alone; hot pixels are in all, blinking ones in several.
    """

    name: ClassVar[str] = "cosmic_rays"
    family: ClassVar[Family] = Family.RADIATION
    reference: ClassVar[str] = (
        "D. E. Groom, Cosmic rays and other nonsense in astronomical CCD imagers, Experimental Astronomy 14 (2002) 45"
    )
    form_tolerance: ClassVar[float] = 0.2
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "field", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"depth_um", "point_share", "point_e", "point_spread"})
    sentence: ClassVar[str] = (
        "Single particles leave charge: pixels and short tracks are bright in one frame alone, more of them the longer "
        "the exposure."
    )

    rate_per_cm2_s: Annotated[
        float,
        Quantity("1/(cm2 s)", "events a second on a cm2 of the sensor", lower=0.0, upper=1e5, prior=(0.0, 100.0),
                 absent=0.0),
    ] = 0.0  # fmt: skip
    depth_um: Annotated[
        float,
        Quantity("um", "depth of silicon from which charge is collected", lower=1.0, upper=1000.0, absent=10.0,
                 logarithmic=True),
    ] = 10.0  # fmt: skip
    point_share: Annotated[
        float,
        Quantity("1", "share of the events that are points", lower=0.0, upper=1.0, prior=(0.0, 0.5), absent=0.0,
                 dispensable=True),
    ] = 0.0  # fmt: skip
    point_e: Annotated[
        float,
        Quantity("e", "mean charge of a point", lower=10.0, upper=1e6, absent=2000.0, logarithmic=True,
                 dispensable=True),
    ] = 2000.0  # fmt: skip

    point_spread: Annotated[
        float,
        Quantity("1", "relative standard deviation of a point's charge; 1: exponential", lower=0.05, upper=1.5,
                 absent=1.0, dispensable=True),
    ] = 1.0  # fmt: skip

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        tracks = tuple((cls(rate_per_cm2_s=0.3, depth_um=depth_um),) for depth_um in (10.0, 3.0, 100.0))
        points = tuple((cls(rate_per_cm2_s=0.3, point_share=1.0, point_spread=spread),) for spread in (1.0, 0.1))
        return (*tracks, *points)

    def on_charge(self, charge: Charge) -> Charge:
        if self.rate_per_cm2_s == 0.0:
            return charge
        return charge.add_laws(
            particles=Particles(self.rate_per_cm2_s, self.depth_um, self.point_share, self.point_e, self.point_spread)
        )
