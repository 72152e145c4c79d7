"""Charge transfer inefficiency: traps of a CCD's registers take charge from packets and release it behind them."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.trails import Trails
from sim.stages import Charge

#: Release times that are tried first, in transfers.
RELEASES_PX = (0.6, 4.0)


class ChargeTransferInefficiency(Effect):
    """Each transfer leaves the share `parallel_ppm` (of rows) or `serial_ppm` (of columns) of a packet behind, in
    proportion to it; traps release it by exp(-t / tau), t in transfers. Far from the output a pixel is transferred
    more often, so that its trail is longer in proportion. Traps of a second species take `slow_share` of it.

    The law of small packets, whose cloud grows with them: of traps that are always full, or of a cloud of constant
    volume, the loss isn't in proportion, and faint packets lose more.
    """

    name: ClassVar[str] = "charge_transfer_inefficiency"
    family: ClassVar[Family] = Family.CHARGE_BETWEEN_NEIGHBOURS
    reference: ClassVar[str] = (
        "J. R. Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, chapter 5; R. Massey et al., An improved "
        "model of charge transfer inefficiency, MNRAS 439 (2014) 887"
    )
    form_tolerance: ClassVar[float] = 0.15
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"release_px", "serial_release_px", "slow_share", "slow_release_px"})
    sentence: ClassVar[str] = (
        "Charge is lost from pixel to pixel on its way to the output: hot pixels and edges trail away from it, the "
        "more the farther they are from it."
    )

    parallel_ppm: Annotated[
        float,
        Quantity("1e-6", "share of a packet that a transfer of rows leaves behind", lower=0.0, upper=1000.0,
                 prior=(0.0, 30.0), absent=0.0),
    ] = 0.0  # fmt: skip
    release_px: Annotated[
        float,
        Quantity("px", "time constant of the release, in transfers of rows", lower=0.1, upper=100.0, absent=1.0,
                 logarithmic=True),
    ] = 1.0  # fmt: skip
    serial_ppm: Annotated[
        float,
        Quantity("1e-6", "share of a packet that a transfer of columns leaves behind", lower=0.0, upper=1000.0,
                 prior=(0.0, 30.0), absent=0.0),
    ] = 0.0  # fmt: skip
    serial_release_px: Annotated[
        float,
        Quantity("px", "time constant of the release, in transfers of columns", lower=0.1, upper=100.0, absent=1.0,
                 logarithmic=True),
    ] = 1.0  # fmt: skip
    slow_share: Annotated[
        float,
        Quantity("1", "part of the loss that a second species takes", lower=0.0, upper=1.0, prior=(0.0, 0.3),
                 absent=0.0, dispensable=True),
    ] = 0.0  # fmt: skip
    slow_release_px: Annotated[
        float,
        Quantity("px", "time constant of that species' release, in transfers", lower=2.0, upper=1000.0, absent=20.0,
                 logarithmic=True, dispensable=True),
    ] = 20.0  # fmt: skip
    first_row: Annotated[Literal["top", "bottom"], Field(description="end of the frame whose row is read first")] = (
        "top"
    )
    first_column: Annotated[Literal["left", "right"], Field(description="end of a row whose column is read first")] = (
        "left"
    )

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        """Losses by which the middle of the frame keeps 0.5 % in trails."""
        parallel_ppm, serial_ppm = (min(1e4 / lines, 1000.0) for lines in (camera.rows, camera.cols))
        ends = [(row, column) for row in ("top", "bottom") for column in ("left", "right")]
        return tuple(
            tuple(
                cls.model_validate({"release_px": release, "serial_release_px": release, "first_row": row,
                                    "first_column": column} | size)
                for size in ({"parallel_ppm": parallel_ppm}, {"serial_ppm": serial_ppm})
            )
            for release in RELEASES_PX for row, column in ends
        )  # fmt: skip

    def _releases(self, release_px: float) -> tuple[tuple[float, float], ...]:
        one = (1.0 - self.slow_share, release_px)
        return (one, (self.slow_share, self.slow_release_px)) if self.slow_share > 0.0 else (one,)

    def on_charge(self, charge: Charge) -> Charge:
        if self.parallel_ppm != 0.0:
            output: Literal["first", "last"] = "first" if self.first_row == "top" else "last"
            charge = charge.add_laws(
                trails=Trails(0, 1e-6 * self.parallel_ppm, self._releases(self.release_px), output)
            )
        if self.serial_ppm != 0.0:
            output = "first" if self.first_column == "left" else "last"
            charge = charge.add_laws(
                trails=Trails(1, 1e-6 * self.serial_ppm, self._releases(self.serial_release_px), output)
            )
        return charge
