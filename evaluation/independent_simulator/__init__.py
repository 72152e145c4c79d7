"""An independent simulator: a second lab's camera, which conceals physics in recordings.

It shares no stage and no code with `sim`: an error of `sim` can't cancel against the same error here. `law` and `laws`
hold the concealed physics, `camera` the sensor and its frames, `transfer` the lens, `scenes` the targets, `session` the
order of the captures. What comes out is plain data (`DrawnSession`); `evaluation` makes recording sets of it.
"""

from evaluation.independent_simulator.camera import ConcealedCamera
from evaluation.independent_simulator.law import BIT_DEPTH, WAVELENGTH_NM, Law
from evaluation.independent_simulator.laws import BESIDE, LISTED, OUTSIDE
from evaluation.independent_simulator.session import WHOLE_SESSION, DrawnSession, Plan, record, record_pair
from evaluation.independent_simulator.unlisted import UNLISTED, UnlistedLaw

__all__ = [
    "BESIDE",
    "BIT_DEPTH",
    "LISTED",
    "OUTSIDE",
    "UNLISTED",
    "WAVELENGTH_NM",
    "WHOLE_SESSION",
    "ConcealedCamera",
    "DrawnSession",
    "Law",
    "Plan",
    "UnlistedLaw",
    "record",
    "record_pair",
]
