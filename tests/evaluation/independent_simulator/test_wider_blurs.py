"""Blurs of the wider library are named where the former conceals them strongly, by its own form of the law, and don't
take the names of their relatives. Healthy cameras are those of `test_wider_library`.
"""

from __future__ import annotations

import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator.laws import (
    AstigmatismLaw,
    ChargeDiffusionLaw,
    ComaLaw,
    SeeingLaw,
    TrefoilLaw,
    TurbulentAirLaw,
)
from lab.diagnose import diagnose

pytestmark = [pytest.mark.extra, pytest.mark.timeout(600)]  # a whole diagnosis each

STRONG: tuple[Law, ...] = (
    TrefoilLaw(0.3, 0, 9),
    TrefoilLaw(0.3, 1, 9),
    SeeingLaw(2.0, 0, 9),
    SeeingLaw(2.0, 1, 9),
    TurbulentAirLaw(2.0, 0, 9),
    # the likest laws: of an odd path error, of an even one, and of a Gaussian blur
    ComaLaw(0.4, 0, 9),
    AstigmatismLaw(0.3, 0, 9),
    ChargeDiffusionLaw(1.2, 0, 9),
)
EVERY_DAY = (STRONG[0], STRONG[2])


@pytest.mark.parametrize(
    "law",
    [
        pytest.param(law, id=f"{law.name}-{law.variant}", marks=() if law in EVERY_DAY else pytest.mark.slow)
        for law in STRONG
    ],
)
def test_a_strong_blur_is_named_and_sized(law: Law) -> None:
    recordings = recordings_of(
        ConcealedCamera(930, [law], cfa="RGGB", rows=192, cols=256), Plan(("dark", "flat", "slanted_edge", "screen"))
    )
    (named,) = diagnose(recordings, at_once=False).effects
    assert named.name == law.effect
    for name, truth in law.library_parameters().items():
        found = named.parameters[name]
        # 4 of its own standard deviations
        assert found.std is not None
        assert found.value == pytest.approx(truth, abs=4.0 * found.std)
