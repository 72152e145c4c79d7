"""Effects' names as a laboratory writes them, for sentences and pages; results and commands keep the identifiers."""

from __future__ import annotations

from sim.effects.families import Family

#: Those that aren't the identifier with spaces in it.
SPELT = {
    "adc_nonlinearity": "ADC nonlinearity",
    "adc_ripple": "ADC ripple",
    "adc_step": "ADC step",
    "black_level_drift": "black-level drift",
    "brighter_fatter": "brighter-fatter effect",
    "infrared_cut_filter": "infrared-cut filter",
    "inter_pixel_capacitance": "inter-pixel capacitance",
    "non_uniform_illumination": "non-uniform illumination",
    "on_chip_sharpening": "on-chip sharpening",
    "on_chip_smoothing": "on-chip smoothing",
    "optical_low_pass_filter": "optical low-pass filter",
    "other_f_number": "other f-number",
    "second_order_light": "second-order light",
}


def effect_title(name: str) -> str:
    """An effect's or a family's identifier as words, as they stand within a sentence."""
    if name in set(Family):
        return Family(name).words
    return SPELT.get(name, name.replace("_", " "))


def at_beginning(words: str) -> str:
    """Words as they stand at the beginning of a sentence; capitals within stay."""
    return words[:1].upper() + words[1:]
