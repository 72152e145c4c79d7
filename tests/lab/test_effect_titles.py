"""Effects' names in words: those that are spelt differently belong to effects, and differ from the identifier in spelling alone."""

from lab.effect_titles import SPELT, at_beginning, effect_title
from sim.effects.library import effects


def test_what_is_spelt_differently_is_an_effect_and_still_its_identifier() -> None:
    assert set(SPELT) <= set(effects())
    for name, title in SPELT.items():
        identifier = title.lower().replace("-", "_").replace(" ", "_").removesuffix("_effect")
        assert identifier == name and title != name.replace("_", " ")


def test_titles_as_a_laboratory_writes_them() -> None:
    assert effect_title("optical_low_pass_filter") == "optical low-pass filter"
    assert effect_title("column_noise") == "column noise"
    assert effect_title("an_effect_of_ones_own") == "an effect of ones own"
    assert effect_title("defective_pixels") == "defective pixels"  # a family
    assert at_beginning(effect_title("adc_step")) == "ADC step"
    assert at_beginning(effect_title("infrared_cut_filter")) == "Infrared-cut filter"
