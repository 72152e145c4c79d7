"""Tetrafoil: a lens pressed at four places spreads points into four arms."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.zernike_term import ZernikeTerm
from sim.parameters import Quantity


class Tetrafoil(ZernikeTerm):
    """Path error r^4 (a cos 4 t + b sin 4 t), of Noll's terms 14 and 15: quadrafoil."""

    name: ClassVar[str] = "tetrafoil"
    degree: ClassVar[int] = 4
    order: ClassVar[int] = 4
    sentence: ClassVar[str] = (
        "The lens has tetrafoil: points have four arms, so that contrast differs between directions 45 degrees apart."
    )

    cos_um: Annotated[
        float,
        Quantity("um", "path error at the rim, arms along columns and rows", lower=-5.0, upper=5.0, prior=(0.0, 0.1),
                 absent=0.0, linear_power=2),
    ] = 0.0  # fmt: skip
    sin_um: Annotated[
        float,
        Quantity("um", "path error at the rim, arms along the diagonals", lower=-5.0, upper=5.0, prior=(0.0, 0.1),
                 absent=0.0, linear_power=2),
    ] = 0.0  # fmt: skip
