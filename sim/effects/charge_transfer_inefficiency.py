"""Charge transfer inefficiency: traps of a CCD's registers take charge from packets and release it behind them."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.electrons import NEIGHBOURS
from sim.sensor.trails import Trails
from sim.stages import Charge

#: Release time that is tried first, in transfers.
RELEASE_PX = 1.5


class ChargeTransferInefficiency(Effect):
    """Each transfer leaves the share `parallel_ppm` (of rows) or `serial_ppm` (of columns) of a packet behind, in
    proportion to it; traps release it by exp(-t / tau), t in transfers. Far from the output a pixel is transferred
    more often, so that its trail is longer in proportion. Traps of a second species take `slow_share` of it.

    Traps take electrons one by one, so that the shot noise of what arrives is independent from pixel to pixel. Where
    the same share of every packet lags behind, noise moves with it: neighbours share it (`noise`). Where capture is
    fast and each packet fills the traps to its own level, all that it finds is what the one before has left, whatever
    their release: the noise of that one goes to the next alone (Massey et al., section 2).

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
    noise: Annotated[
        Literal["single electrons", "moves along", "to the next packet"],
        Field(
            description="shot noise of single electrons in traps, of a share of every packet that lags behind, or of "
            "one that the next packet takes over as a whole"
        ),
    ] = "single electrons"
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
                cls.model_validate({"release_px": RELEASE_PX, "serial_release_px": RELEASE_PX, "first_row": row,
                                    "first_column": column, "noise": noise} | size)
                for size in ({"parallel_ppm": parallel_ppm}, {"serial_ppm": serial_ppm})
            )
            for noise in ("single electrons", "moves along", "to the next packet") for row, column in ends
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
        if self.noise != "single electrons":
            charge = self._share_noise(charge)
        return charge

    def _share_noise(self, charge: Charge) -> Charge:
        """Return the charge's state with the frame's mean of what noise loses, and what the next pixels share of it.

        A packet of which the share a lies in the next one has (1 - a)^2 + a^2 of the variance, and (1 - a) a of it in
        common with either neighbour, to first order 1 - 2 a and a.
        """
        camera, shares = charge.camera, []
        for ppm, release_px, lines in (
            (self.serial_ppm, self.serial_release_px, camera.cols),
            (self.parallel_ppm, self.release_px, camera.rows),
        ):
            lost = 1e-6 * ppm * 0.5 * (lines + 1.0)
            released = sum(share * (1.0 - np.exp(-1.0 / release)) for share, release in self._releases(release_px))
            beside = float(released) if self.noise == "moves along" else 1.0
            shares.append((min(lost, 0.4), min(lost, 0.4) * beside))
        lost_share = sum(lost for lost, _ in shares)
        next_share = np.zeros(len(NEIGHBOURS))  # of further ones to first order none
        next_share[:2] = [beside for _, beside in shares]
        return charge.add_laws(
            variance_e2=lambda electrons, variance_e2: variance_e2 * (1.0 - lost_share) ** 2,
            correlation=lambda electrons: np.multiply.outer(next_share, np.ones(np.shape(electrons))),
        )
