"""Families: what is claimed where a name doesn't hold, and what isn't."""

from __future__ import annotations

from lab.diagnose.inference.decide import tied_family
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.policy import DecisionPolicy
from sim.effects.charge_diffusion import ChargeDiffusion
from sim.effects.families import Family
from sim.effects.library import candidates, effects, members


def _candidate(probability: float, *rivals: tuple[str, float]) -> Candidate:
    return Candidate(ChargeDiffusion(length_um=1.0), {}, probability, rivals, 30.0)


def test_a_tie_within_a_family_is_told_as_the_family() -> None:
    told = tied_family(
        _candidate(0.5, ("pixel_aperture", 0.45), ("crosstalk", 0.04), ("unknown", 0.01)), DecisionPolicy()
    )
    assert told.told_name == "isotropic_contrast_loss"
    assert told.members == (("charge_diffusion", 0.5), ("pixel_aperture", 0.45))
    assert told.probability == 0.95
    assert told.rivals == (("crosstalk", 0.04), ("unknown", 0.01))
    assert not told.holds_a_remainder  # a member's law is exact: it isn't known which
    assert told.alternatives[0] == ("pixel_aperture", 0.45)


def test_a_likely_effect_keeps_its_name() -> None:
    told = tied_family(_candidate(0.85, ("pixel_aperture", 0.15)), DecisionPolicy())
    assert told.told_name == "charge_diffusion"
    assert not told.members


def test_a_tie_of_two_families_is_no_family() -> None:
    """Neither family holds 4 to 1."""
    told = tied_family(_candidate(0.5, ("crosstalk", 0.5)), DecisionPolicy())
    assert not told.members


def test_every_effect_belongs_to_a_family_that_says_how_to_tell_its_members_apart() -> None:
    assert all(isinstance(kind.family, Family) for kind in effects().values())
    for family in Family:
        inside = members(family)
        assert set(inside) == {kind.name for kind in candidates() if kind.family is family}
        assert family.words and family.sentence.endswith(".")
        assert len(inside) < 2 or family.separating_capture
