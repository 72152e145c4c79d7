"""Doubts whose captures tell known rivals apart by known distances."""

from __future__ import annotations

import numpy as np

from lab.capture.plan import CapturePlan
from lab.capture_kinds.dark import DarkSequence
from lab.diagnose.outcome.expected_information import Forecast
from lab.diagnose.outcome.next_capture import Doubt, OpenCapture

DARKS = CapturePlan((DarkSequence(exposures_s=(0.001, 0.1), frames=2),))
FAR = 40.0  # standard deviations between two rivals: such a capture tells all


def offered(words: str, apart: float = FAR, plan: CapturePlan | None = DARKS) -> OpenCapture:
    """A capture in which the rivals lie so many standard deviations apart."""
    none = [np.zeros((1, 0))] * 2
    return OpenCapture(words, Forecast.of(np.array([[0.0], [apart]]), none, none, np.eye(1)), plan, "a lens is lacking")


def doubt(*captures: OpenCapture) -> list[Doubt]:
    """Defocus 0.7, coma 0.3."""
    return [Doubt("left", ("defocus", "coma"), (0.7, 0.3), captures)]
