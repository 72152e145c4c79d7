"""Effects of the wider library are named where the former conceals them strongly, by its own form of the law, and not
on healthy cameras.
"""

from __future__ import annotations

from functools import cache

import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator.laws import (
    AlternatingRowNoiseLaw,
    AmplifierCrosstalkLaw,
    BitWeightsLaw,
    ChargeTransferLaw,
    ColouredLineNoiseLaw,
    CosmicRaysLaw,
    CoverGlassFringeLaw,
    ExcessNoiseLaw,
    ImageLagLaw,
    LeakyShutterLaw,
    LineGainLaw,
    MicrolensAngleLaw,
    PersistenceLaw,
    PhaseDetectionRowsLaw,
    PinkNoiseLaw,
    ResponseKneeLaw,
    TapGainLaw,
    TapOffsetLaw,
    VignettingLaw,
)
from lab.diagnose import diagnose
from lab.formats.results import DiagnosisResult

pytestmark = pytest.mark.timeout(300)

#: One strong case of each; the forms of each law.
STRONG: tuple[Law, ...] = (
    BitWeightsLaw(0.25, 0, 9),
    BitWeightsLaw(0.25, 1, 9),
    ResponseKneeLaw(10.0, 0, 9),
    ResponseKneeLaw(10.0, 1, 9),
    # three repeats of 192 rows tell 1/f from rows that are correlated over some in three of four draws; else the family
    ColouredLineNoiseLaw(5.0, 0, 11),
    ColouredLineNoiseLaw(5.0, 1, 9),
    AlternatingRowNoiseLaw(1.5, 0, 9),
    PhaseDetectionRowsLaw(4.0, 0, 9),
    PhaseDetectionRowsLaw(4.0, 1, 9),
    PhaseDetectionRowsLaw(4.0, 2, 9),
    TapGainLaw(1.0, 0, 9),
    TapGainLaw(1.0, 1, 9),
    TapGainLaw(1.0, 2, 9),
    TapOffsetLaw(1.0, 0, 9),
    TapOffsetLaw(1.0, 1, 9),
    AmplifierCrosstalkLaw(1.0, 0, 9),
    AmplifierCrosstalkLaw(1.0, 1, 9),
    AmplifierCrosstalkLaw(1.0, 2, 9),
    PinkNoiseLaw(4.0, 0, 9),
    PinkNoiseLaw(4.0, 1, 9),
    PinkNoiseLaw(4.0, 2, 9),
    LineGainLaw(0.6, 0, 9),
    LineGainLaw(0.6, 1, 9),
    LineGainLaw(0.6, 2, 9),
    LeakyShutterLaw(60.0, 0, 9),
    LeakyShutterLaw(60.0, 1, 9),
    LeakyShutterLaw(60.0, 2, 9),
    PersistenceLaw(1.0, 0, 9),
    PersistenceLaw(1.0, 1, 9),
    PersistenceLaw(1.0, 2, 9),
    CoverGlassFringeLaw(2.0, 0, 9),
    CoverGlassFringeLaw(5.0, 1, 4),
    MicrolensAngleLaw(6.0, 0, 9),
    MicrolensAngleLaw(6.0, 1, 9),
    MicrolensAngleLaw(6.0, 2, 9),
    ChargeTransferLaw(400.0, 0, 9),
    ChargeTransferLaw(400.0, 1, 9),
    ExcessNoiseLaw(60.0, 0, 9),
    ExcessNoiseLaw(60.0, 1, 9),
    CosmicRaysLaw(600.0, 0, 9),
    CosmicRaysLaw(600.0, 1, 9),
    # the likest laws of persistence and of microlenses
    ImageLagLaw(1.0, 0, 9),
    VignettingLaw(4.0, 0, 1),
)
#: Those that a mosaic shows.
OF_COLOURS = {"microlens_angle", "vignetting"}
NEW = {str(law.listed_effect) for law in STRONG}


@cache
def _diagnosed(law: Law | None, cfa: str = "MONO", seed: int = 930) -> DiagnosisResult:
    camera = ConcealedCamera(seed, [] if law is None else [law], cfa=cfa, rows=192, cols=256)
    remembers = law is None or law.effect in {"persistence", "image_lag"}
    edges = law is not None and law.effect == "charge_transfer_inefficiency"
    kinds = ("dark", "flat", "slanted_edge" if edges else "narrowband")
    repeats = 12 if law is not None and law.effect == "excess_noise" else 3  # a third moment needs many numbers
    plan = Plan(kinds=kinds, repeats=repeats, dark_again=remembers)
    return diagnose(recordings_of(camera, plan), at_once=False)


@pytest.mark.extra  # whole diagnoses
@pytest.mark.parametrize(
    "law",
    [  # of several variants of a law one is enough
        pytest.param(law, id=f"{law.name}-{law.variant}", marks=pytest.mark.slow if law.variant else ())
        for law in STRONG
    ],
)
def test_a_strong_one_is_named_and_sized(law: Law) -> None:
    (named,) = _diagnosed(law, "RGGB" if law.effect in OF_COLOURS else "MONO").effects
    assert named.name == law.listed_effect
    for name, truth in law.library_parameters().items():
        if truth != 0.0:
            found = named.parameters[name]
            # 4 of its own standard deviations; an interval ends two away, on the truth's side
            if found.interval is not None:
                std = 0.5 * abs(found.interval[1 if truth > found.value else 0] - found.value)
            else:
                assert found.std is not None
                std = found.std
            assert found.value == pytest.approx(truth, abs=4.0 * std)


@pytest.mark.extra  # whole diagnoses
@pytest.mark.parametrize(("cfa", "seed"), [("MONO", 930), ("RGGB", 931)])
def test_healthy_cameras_have_none(cfa: str, seed: int) -> None:
    found = _diagnosed(None, cfa, seed)
    assert not NEW & {e.name for e in found.effects}
    assert found.verdict == "no_mismatch"
