"""Secondary astigmatism: what a lens that is corrected for astigmatism leaves of it towards the pupil's rim."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.zernike_term import ZernikeTerm
from sim.parameters import Quantity


class SecondaryAstigmatism(ZernikeTerm):
    """Path error (4 r^4 - 3 r^2) (a cos 2 t + b sin 2 t)."""

    name: ClassVar[str] = "secondary_astigmatism"
    degree: ClassVar[int] = 4
    order: ClassVar[int] = 2
    sentence: ClassVar[str] = (
        "The lens has secondary astigmatism: the rim of its pupil is astigmatic the other way than its middle, so that "
        "edges along two directions are blurred differently."
    )

    cos_um: Annotated[
        float,
        Quantity("um", "path error at the rim along columns and rows", lower=-5.0, upper=5.0, prior=(0.0, 0.1),
                 absent=0.0, linear_power=2),
    ] = 0.0  # fmt: skip
    sin_um: Annotated[
        float,
        Quantity("um", "path error at the rim along the diagonals", lower=-5.0, upper=5.0, prior=(0.0, 0.1),
                 absent=0.0, linear_power=2),
    ] = 0.0  # fmt: skip
