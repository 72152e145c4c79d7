"""Effects' names in words: a title differs from the identifier in spelling alone."""

import pytest

from lab.effect_titles import at_beginning, effect_title
from sim.effects.base import Effect
from sim.effects.library import effects


@pytest.mark.parametrize("kind", [e for e in effects().values() if e.title], ids=lambda kind: kind.name)
def test_a_title_is_the_identifier_spelt_differently(kind: type[Effect]) -> None:
    identifier = kind.title.lower().replace("-", "_").replace(" ", "_").removesuffix("_effect")
    assert identifier == kind.name
    assert kind.title != kind.name.replace("_", " ")


def test_titles_as_a_laboratory_writes_them() -> None:
    assert effect_title("optical_low_pass_filter") == "optical low-pass filter"
    assert effect_title("column_noise") == "column noise"
    assert effect_title("an_effect_of_ones_own") == "an effect of ones own"
    assert effect_title("defective_pixels") == "defective pixels"  # a family
    assert at_beginning(effect_title("adc_step")) == "ADC step"
    assert at_beginning(effect_title("infrared_cut_filter")) == "Infrared-cut filter"
