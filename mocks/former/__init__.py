"""A second lab's camera: an image former of its own, which conceals physics in recordings.

It shares no stage and no code with `sim`: an error of `sim` can't cancel against the same error here. `law` and `laws`
hold the concealed physics, `camera` the sensor and its frames, `transfer` the lens, `scenes` the targets, `session` the
order of the captures. What comes out is plain data (`DrawnSession`); `lab.challenge` makes recording sets of it.
"""

from mocks.former.camera import ConcealedCamera
from mocks.former.law import BIT_DEPTH, WAVELENGTH_NM, Law
from mocks.former.laws import BESIDE, LISTED, OUTSIDE
from mocks.former.session import WHOLE_SESSION, DrawnSession, Plan, record, record_pair
from mocks.former.unlisted import UNLISTED, UnlistedLaw

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
