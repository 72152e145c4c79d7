"""A second image former, beside the product: it conceals physics in recordings, for proofs. See `camera.py` and `laws.py`."""

from .camera import Camera, Plan
from .laws import LISTED, OUTSIDE, Law

__all__ = ["LISTED", "OUTSIDE", "Camera", "Law", "Plan"]
