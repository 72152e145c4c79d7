"""The list of effects, and what shows each."""

from __future__ import annotations

import numpy as np
import pytest

import lab.diagnose.visibility
from lab.diagnose.inference.rivals import parallel_pairs, symmetric
from lab.diagnose.visibility import (
    NOT_DERIVED,
    NOT_SOUGHT,
    UNSEEN,
    as_toml,
    derived_visibility,
    effect_description,
    effect_list,
    visibility,
)
from lab.errors import InputError
from lab.formats.recording_set import Manifest
from sim.effects.library import candidates, effects


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
    monkeypatch.setattr(lab.diagnose.visibility, "visibility", dict)
    assert effect_description("coma").remark == NOT_DERIVED


def test_an_unknown_effect_is_refused() -> None:
    with pytest.raises(InputError, match="no effect named 'glare'; there are: adc_nonlinearity"):
        effect_description("glare")


# --- What shows an effect is derived; the kept table is current, and rivals are symmetric -----------------------------


def test_the_table_holds_the_library() -> None:
    """A new effect: `python docs/write_tables.py`."""
    assert list(visibility()) == list(effects())
    kinds = {kind for one in visibility().values() for kind in one.capture_kinds}
    schema = Manifest.model_json_schema()
    assert all(f'"{kind}"' in str(schema).replace("'", '"') for kind in kinds)


def test_rivals_are_symmetric_candidates() -> None:
    known = {kind.name for kind in candidates()}
    for name, one in visibility().items():
        assert set(one.rivals) <= known - {name}
        for rival in one.rivals:
            assert name in visibility()[rival].rivals


def test_what_shows_an_effect_is_what_its_physics_says() -> None:
    """Blooming keeps within saturated frames, which no measurement reads. Blurs show on edges and screens, dark
    current in dark frames and in the masked pixels of flats."""
    assert [name for name, one in visibility().items() if not one.measurements] == ["blooming"]
    assert set(visibility()["defocus"].capture_kinds) == {"slanted_edge", "bernoulli"}
    assert visibility()["dark_current_temperature"].capture_kinds == ("dark", "flat")
    assert visibility()["stereo_time_offset"].measurements == ("stereo_time",)
    assert "defocus" in visibility()["optical_low_pass_filter"].rivals
    assert "defocus" not in visibility()["row_noise"].rivals


def test_parallel_signatures_are_rivals_and_opposite_ones_arent() -> None:
    """Cosines of 0.8, -0.8 and 0.6; a column below the least norm is not compared."""
    a, b, c = np.array([1.0, 0.0]), np.array([0.8, 0.6]), np.array([-0.8, 0.6])
    signatures = {"a": a[:, None], "b": 5.0 * b[:, None], "c": c[:, None], "faint": 0.1 * a[:, None]}
    assert parallel_pairs(signatures, 0.75) == {("a", "b")}
    both = np.column_stack([c, -c])  # an effect of either sign
    assert ("a", "c") in parallel_pairs(signatures | {"c": both}, 0.75)
    assert symmetric("abc", {("a", "b")}) == {"a": {"b"}, "b": {"a"}, "c": frozenset()}


@pytest.mark.slow
def test_the_kept_table_is_current() -> None:
    """About a minute: the reference session is drawn and summarised."""
    assert as_toml(derived_visibility()) == as_toml(visibility())
