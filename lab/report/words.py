"""Sentences of the report: the verdict, and the results of the checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lab.formats.results import Check, DiagnosisResult, ParameterValue
from lab.formats.results.words import format_value, plain_number
from sim.camera import Side

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
    """Return (badge, CSS class, sentence) of a diagnosis, or of none.

    >>> headline(None)[0]
    'not diagnosed'
    """
    if diagnosis is None:
        return "not diagnosed", "open", "The recordings were calibrated; they were not diagnosed."
    return VERDICTS[diagnosis.verdict]


def parameter_name(name: str, value: ParameterValue) -> str:
    """Return a parameter's name as words, without the unit at its end.

    >>> parameter_name("displacement_x_um", ParameterValue(value=2.1, std=0.05, unit="um"))
    'displacement x'
    """
    unit = "percent" if value.unit == "%" else value.unit
    return name.removesuffix(f"_{unit}").replace("_", " ")


def parameter_value(value: ParameterValue) -> str:
    """Return a parameter's value with its uncertainty; and that its size isn't determined, where it isn't.

    >>> parameter_value(ParameterValue(value=2.1, std=0.05, unit="um"))
    '2.100 ± 0.050 µm'
    """
    text = format_value(value.value, value.std, value.unit, value.shown_interval)
    return text if value.is_determined else f"{text}, not determined"


CHECK_NAMES = {"colorchecker": "ColorChecker", "mtf": "MTF", "psf": "PSF"}
#: The name of the model that a validation predicts with where no camera file stands in for it.
FITTED = "fitted camera"


@dataclass(frozen=True)
class ComparedCheck:
    """One kind of check on one side: what each model that was asked makes of it, in words, and whether it passes."""

    name: str
    side: Side
    captures: int
    results: dict[str, tuple[str, bool]]


def models(has_both: bool, has_improved: bool) -> str:
    """Return what predicts on the pages of the checks, and why the predictions may differ."""
    if not has_both:
        return (
            f"Predicted by the {FITTED}: the data sheet's camera with the noise and the sensitivities that were "
            "measured. No "
            "improved camera is known here."
        )
    improved = "The improved model is the baseline with the named effects. " if has_improved else ""
    return (
        "The baseline is the data sheet's camera with the maker's sensitivities, freed within their uncertainty, and "
        "the fitted "
        f"noise: the model that the diagnosis tests. {improved}The {FITTED} has the sensitivities that were measured "
        "in place of "
        "the maker's. It can predict a chart well where the baseline departs from it: what was measured is in its "
        "curves, "
        "without a cause."
    )


def compare_checks(
    baseline: Sequence[Check], improved: Sequence[Check], fitted: Sequence[Check]
) -> list[ComparedCheck]:
    """Return the checks by kind and side, with the results of each model that predicted them."""
    given = {"baseline": baseline, "improved model": improved, FITTED: fitted}
    grouped: dict[tuple[str, Side], dict[str, list[Check]]] = {}
    for model, checks in given.items():
        for check in checks:
            grouped.setdefault((check.name, check.side), {}).setdefault(model, []).append(check)
    return [
        ComparedCheck(
            name=CHECK_NAMES[name],
            side=side,
            captures=max(len(checks) for checks in checks_of_model.values()),
            results={model: _summarise_checks(checks) for model, checks in checks_of_model.items()},
        )
        for (name, side), checks_of_model in sorted(grouped.items(), key=lambda item: (item[0][1], item[0][0]))
    ]


def _summarise_checks(checks: Sequence[Check]) -> tuple[str, bool]:
    """Return the largest deviation and chi2 per number of checks, and whether all pass."""
    rms = max(check.rms_relative_percent for check in checks)
    per_number = max(check.chi2 / max(check.n, 1) for check in checks)
    passed = sum(check.passed for check in checks)
    return (
        f"{plain_number(rms, 2)} % rms, χ²/n {plain_number(per_number, 2)}, {passed} of {len(checks)} pass",
        passed == len(checks),
    )
