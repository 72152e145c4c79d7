"""The report's sentences: the verdict in plain words, and what the checks say."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from lab.diagnose.measurements.library import measurement_title
from lab.formats.results import Check, DiagnosisResult, FitResult, NamedEffect, ParameterValue, ValidationResult
from lab.report.figures import measured
from sim.effects.families import Family

#: Verdict -> (what stands on the badge, its mood, the headline).
VERDICTS = {
    "no_mismatch": ("no mismatch", "good", "The baseline model explains these recordings."),
    "nothing_judged": ("nothing judged", "open", "No measurement of these recordings could be looked at."),
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


def effect_name(name: str) -> str:
    """An effect's or a family's name as words."""
    return Family(name).words if name in set(Family) else name.replace("_", " ")


def parameter_name(name: str, value: ParameterValue) -> str:
    """A parameter's name as words, without the unit at its end: `displacement_x_um` is `displacement x`."""
    unit = "percent" if value.unit == "%" else value.unit
    return name.removesuffix(f"_{unit}").replace("_", " ")


def parameter_text(name: str, value: ParameterValue) -> str:
    """`displacement x 2.10 ± 0.05 µm`."""
    return f"{parameter_name(name, value)} {measured(value.value, value.std, value.unit)}"


def effect_sentence(effect: NamedEffect) -> str:
    """An effect's name, side, probability and parameters."""
    where = " and ".join(effect.sides)
    sizes = "; ".join(parameter_text(name, value) for name, value in effect.parameters.items())
    near = ""
    if effect.members:
        near = (
            f"by {effect_name(effect.nearest_law)}, "
            if effect.law == "exact"
            else f"nearest law {effect_name(effect.nearest_law)}, "
        )
    return f"{effect_name(effect.name).capitalize()} ({where}, probability {effect.probability:.3g}): {near}{sizes}."


def summary(fit: FitResult, validation: ValidationResult | None, diagnosis: DiagnosisResult | None) -> Iterator[str]:
    """The report in a few sentences, those of the verdict first."""
    if diagnosis is not None:
        yield from (effect_sentence(effect) for effect in diagnosis.effects)
        if diagnosis.unexplained:
            places = sorted({f"{measurement_title(item.measurement)} ({item.side})" for item in diagnosis.unexplained})
            yield f"Without a name so far: {', '.join(places)}."
            yield from dict.fromkeys(u.check for u in diagnosis.unexplained if u.check)
        named = {side for effect in diagnosis.effects for side in effect.sides}
        clean = [
            side for side in fit.cameras if side not in named and not any(m.side == side for m in diagnosis.mismatches)
        ]
        if named and clean:
            yield f"The {' and '.join(clean)} camera shows no mismatch in these recordings."
        held = diagnosis.held_out
        if held is not None and held.chi2_after < held.chi2_before:
            yield (
                f"On {len(held.captures)} held-out captures χ² falls from {held.chi2_before:.0f} to "
                f"{held.chi2_after:.0f} over {held.n} numbers."
            )
    for side, camera in fit.cameras.items():
        noise = camera.noise
        if noise is not None and noise.conversion_gain_dn_per_e is not None:
            parts = [
                f"conversion gain {measured(noise.conversion_gain_dn_per_e, noise.conversion_gain_dn_per_e_std, 'DN/e')}"
            ]
            if noise.read_noise_e is not None:
                parts.append(f"read noise {measured(noise.read_noise_e, noise.read_noise_e_std, 'e')}")
            if noise.full_well_e is not None:
                parts.append(f"full well {measured(noise.full_well_e, noise.full_well_e_std, 'e')}")
            yield f"{side.capitalize()} camera: {', '.join(parts)}."
    if fit.stereo is not None:
        yield (
            f"Stereo: baseline {measured(fit.stereo.baseline_mm, fit.stereo.baseline_mm_std, 'mm')}, "
            f"rms {fit.stereo.rms_px:.3f} px over {fit.stereo.pairs} pairs."
        )
    for side in fit.cameras:
        worst = _one_a_kind(check for check in (validation.checks if validation else ()) if check.side == side)
        if worst:
            parts = [
                f"{CHECK_NAMES[check.name]} {check.rms_relative_percent:.2g} % rms ({_within(check)})"
                for check in worst
            ]
            yield f"{side.capitalize()} camera, measured against the baseline's prediction: {', '.join(parts)}."


def _one_a_kind(checks: Iterable[Check]) -> list[Check]:
    worst: dict[str, Check] = {}
    for check in checks:
        if check.name not in worst or check.chi2 / max(check.n, 1) > worst[check.name].chi2 / max(
            worst[check.name].n, 1
        ):
            worst[check.name] = check
    return list(worst.values())


def _within(check: Check) -> str:
    return "within its uncertainty" if check.passed else "beyond its uncertainty"


CHECK_NAMES = {"colorchecker": "ColorChecker", "mtf": "MTF", "psf": "PSF"}


def check_sentence(check: Check) -> str:
    """One comparison of the baseline's prediction with the measurement."""
    return (
        f"{CHECK_NAMES[check.name]} ({check.side}, {check.capture}): {check.rms_relative_percent:.2g} % rms from the "
        f"baseline's prediction, {_within(check)}."
    )
