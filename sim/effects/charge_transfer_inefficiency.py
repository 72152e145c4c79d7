"""Charge transfer inefficiency: traps of a CCD's registers take charge from packets and release it behind them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field
from scipy.special import ndtr

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.electrons import NEIGHBOURS
from sim.sensor.trails import Trails
from sim.spectrum import FloatArray
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
    their release: the noise of that one goes to the next alone (Massey et al., section 2), unless that is so faint that
    the traps, which kept b = exp(-1 / tau) of the one before, hold more than it would fill: it takes none then.
    Overscan reads loss x transfers x signal of even light in all lines together.

    `capture`: losses of many transfers act one after the other, or those of all at once, as models of many transfers
    have it that don't follow each of them (Short et al.): the same for few transfers, less for many.

    The law of small packets, whose cloud grows with them: of traps that are always full, or of a cloud of constant
    volume, the loss isn't in proportion, and faint packets lose more.
    """

    name: ClassVar[str] = "charge_transfer_inefficiency"
    family: ClassVar[Family] = Family.CHARGE_BETWEEN_NEIGHBOURS
    reference: ClassVar[str] = (
        "J. R. Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, chapter 5; R. Massey et al., An improved "
        "model of charge transfer inefficiency, MNRAS 439 (2014) 887; A. Short et al., An analytical model of "
        "radiation-induced charge transfer inefficiency for CCD detectors, MNRAS 430 (2013) 3078"
    )
    form_tolerance: ClassVar[float] = 0.15
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "time"})
    forms: ClassVar[Mapping[str, object]] = {"capture": "all at once"}
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
    capture: Annotated[
        Literal["transfer by transfer", "all at once"],
        Field(description="traps take charge in every transfer, or those of all transfers in a single one"),
    ] = "transfer by transfer"
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
        fast = (1.0 - self.slow_share, release_px)
        return (fast, (self.slow_share, self.slow_release_px)) if self.slow_share > 0.0 else (fast,)

    def _trails(self) -> tuple[Trails, ...]:
        """Return the law of each direction that has a loss."""
        at_once = self.capture == "all at once"
        rows: Literal["first", "last"] = "first" if self.first_row == "top" else "last"
        columns: Literal["first", "last"] = "first" if self.first_column == "left" else "last"
        laws = (
            Trails(0, 1e-6 * self.parallel_ppm, self._releases(self.release_px), rows, at_once),
            Trails(1, 1e-6 * self.serial_ppm, self._releases(self.serial_release_px), columns, at_once),
        )
        return tuple(law for law in laws if law.loss != 0.0)

    def on_charge(self, charge: Charge) -> Charge:
        laws = self._trails()
        for law in laws:
            charge = charge.add_laws(trails=law)
        if self.noise != "single electrons":
            for law in laws:
                charge = self._share_noise(charge, law)
        return charge

    def _share_noise(self, charge: Charge, law: Trails) -> Charge:
        """Return the charge's state with the noise that packets share by one of the laws, as it is in the mean of the
        frame."""
        camera, to_the_next = charge.camera, self.noise == "to the next packet"
        variance, first, second = law.noise((camera.rows, camera.cols)[law.axis], to_the_next)
        at = [(1, 4), (0, 3)][law.axis]  # of `NEIGHBOURS`
        left = float(sum(share * np.exp(-1.0 / release) for share, release in law.releases))

        def filling(electrons: FloatArray) -> FloatArray:
            # packets of Poisson numbers about the mean that lie above b times the mean
            full = np.ones(np.shape(electrons))
            return ndtr((1.0 - left) * np.sqrt(np.maximum(electrons, 0.0))) if to_the_next else full

        def correlation(electrons: FloatArray) -> FloatArray:
            shared = np.zeros((len(NEIGHBOURS), *np.shape(electrons)))
            shared[at[0]], shared[at[1]] = first * filling(electrons), second * filling(electrons)
            return shared

        return charge.add_laws(
            variance_e2=lambda electrons, variance_e2: variance_e2 * (1.0 - (1.0 - variance) * filling(electrons)),
            correlation=correlation,
        )
