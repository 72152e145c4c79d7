"""The described library: declarations and what is derived, and plain words for what a diagnosis never names."""

from __future__ import annotations

import pytest

import lab.diagnose.effect_list
from lab.diagnose.effect_list import NOT_DERIVED, NOT_SOUGHT, UNSEEN, effect_description, effect_list
from lab.diagnose.visibility import visibility
from lab.errors import InputError
from sim.effects.library import effects


def test_each_effect_is_told_with_its_declarations_and_what_is_derived() -> None:
    told = {effect.name: effect for effect in effect_list().effects}
    assert list(told) == list(effects())
    for name, kind in effects().items():
        effect, shown = told[name], visibility()[name]
        assert (effect.stages, effect.sentence, effect.reference) == (kind.stages(), kind.sentence, kind.reference)
        assert (effect.measurements, effect.capture_kinds) == (shown.measurements, shown.capture_kinds)
        assert effect.rivals == shown.rivals
        for one, (field, quantity) in zip(effect.parameters, kind.quantities().items(), strict=True):
            assert (one.name, one.unit, one.lower, one.upper) == (field, quantity.unit, quantity.lower, quantity.upper)
        remark = NOT_SOUGHT if not kind.is_candidate else None if shown.measurements else UNSEEN
        assert effect.remark == remark
    assert told["blooming"].remark == UNSEEN


def test_every_choice_is_told_with_its_meaning() -> None:
    choices = {(effect.name, one.name): one for effect in effect_list().effects for one in effect.choices}
    assert all(one.meaning for one in choices.values())
    corner = choices["amplifier_glow", "corner"]
    assert corner.values == ("top_left", "top_right", "bottom_left", "bottom_right")
    assert corner.default == "top_left"
    plate = choices["optical_low_pass_filter", "plate"]
    assert (plate.values, plate.default) == (("quartz",), "none")


def test_an_effect_that_was_just_added_says_what_to_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lab.diagnose.effect_list, "visibility", dict)
    assert effect_description("coma").remark == NOT_DERIVED


def test_an_unknown_effect_is_refused() -> None:
    with pytest.raises(InputError, match="no effect named 'glare'; there are: adc_nonlinearity"):
        effect_description("glare")
