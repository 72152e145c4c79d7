"""Secondary coma: what a lens that is corrected for coma leaves of it towards the pupil's rim."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.zernike_term import ZernikeTerm
from sim.parameters import Quantity


class SecondaryComa(ZernikeTerm):
    """Path error (10 r^5 - 12 r^3) (a cos t + b sin t)."""

    name: ClassVar[str] = "secondary_coma"
    degree: ClassVar[int] = 5
    order: ClassVar[int] = 1
    sentence: ClassVar[str] = (
        "The lens has secondary coma: points have a tail to one side and a shorter one to the other, so that edges are "
        "lopsided along one direction."
    )

    cos_um: Annotated[
        float,
        Quantity("um", "path error at the rim along columns", lower=-5.0, upper=5.0, prior=(0.0, 0.1),
                 absent=0.0),
    ] = 0.0  # fmt: skip
    sin_um: Annotated[
        float,
        Quantity("um", "path error at the rim along rows", lower=-5.0, upper=5.0, prior=(0.0, 0.1),
                 absent=0.0),
    ] = 0.0  # fmt: skip
