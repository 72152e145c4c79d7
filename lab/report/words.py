"""Sentences of the report: the verdict, and the results of the checks."""

from __future__ import annotations

from lab.formats.results import Check, DiagnosisResult, ParameterValue

#: Verdict -> (what stands on the badge, its mood, the headline).
VERDICTS = {
    "no_mismatch": ("no mismatch", "good", "The baseline model explains these recordings."),
    "nothing_judged": ("nothing judged", "open", "These recordings determine no measurement."),
    "explained": ("explained", "told", "The baseline model leaves physics out; the named effects account for it."),
    "partly_explained": (
        "partly explained",
        "open",
        "The baseline model leaves physics out; what is named accounts for a part of it.",
    ),
    "unexplained": (
        "unexplained",
        "bad",
        "The baseline model leaves something out that no family of effects accounts for.",
    ),
}


def headline(diagnosis: DiagnosisResult | None) -> tuple[str, str, str]:
    """(badge, mood, sentence) of a diagnosis, or of none."""
    if diagnosis is None:
        return "not diagnosed", "open", "The recordings were calibrated; they were not diagnosed."
    return VERDICTS[diagnosis.verdict]


def parameter_name(name: str, value: ParameterValue) -> str:
    """A parameter's name as words, without the unit at its end: `displacement_x_um` is `displacement x`."""
    unit = "percent" if value.unit == "%" else value.unit
    return name.removesuffix(f"_{unit}").replace("_", " ")


def _within(check: Check) -> str:
    return "within its uncertainty" if check.passed else "beyond its uncertainty"


CHECK_NAMES = {"colorchecker": "ColorChecker", "mtf": "MTF", "psf": "PSF"}


def check_sentence(check: Check) -> str:
    """One comparison of the baseline's prediction with the measurement."""
    return (
        f"{CHECK_NAMES[check.name]} ({check.side}, {check.capture}): {check.rms_relative_percent:.2g} % rms from the "
        f"baseline's prediction, {_within(check)}."
    )
