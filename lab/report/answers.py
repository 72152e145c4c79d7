"""The first screen of the report: what was found, how sure that is, what it means, what to do; and two charts that show
it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lab.effect_titles import at_beginning, effect_title
from lab.formats.results import (
    Check,
    DiagnosisResult,
    DiscoveredLaw,
    EffectSet,
    FitResult,
    NamedEffect,
    ParameterValue,
    ResidualCurve,
    ValidationResult,
)
from lab.formats.results.words import plain_number
from lab.observables.observable import measurement_title
from lab.predict.validate import BothModels
from lab.report import charts, words
from lab.report.diagnosis import worst_of_each
from lab.report.figures import KeyFigure, camera_figures
from sim.camera import Side
from sim.effects.library import effects as library
from sim.parameters import Quantity

#: Parameters within so many standard deviations of 0 aren't on the first screen.
TOLD_SIGMA = 2.0
PROOFS = 2  # charts
ODDS = 4  # sets of effects a side
#: Most effects that the first screen describes; the others follow in the diagnosis.
NAMED = 4
#: From this probability on, unlisted physics is told on the first screen.
LIKELIER = 0.5
#: Prefixes of the names of the key figures on the first screen.
STRIP = ("system gain", "temporal dark noise", "saturation capacity", "dark current", "DSNU", "PRNU")


@dataclass(frozen=True)
class Proof:
    """A chart of the first screen with title and caption."""

    title: str
    caption: str
    figure: charts.Figure


def _short(value: float) -> str:
    """Two digits, without a power of ten."""
    return f"{value:.0f}" if value >= 9.95 else f"{value:.2g}"


def _from_zero(value: ParameterValue, quantity: Quantity | None) -> str:
    """Return how many standard deviations lie between a size and none, in brackets; empty where it has no such
    distance."""
    if quantity is None or quantity.absent != 0.0 or not value.std or value.shown_interval is not None:
        return ""
    return f" ({plain_number(abs(value.value) / value.std, 2)} σ from 0)"


def odds(diagnosis: DiagnosisResult | None) -> list[tuple[Side, list[tuple[str, float]]]]:
    """Return the probabilities of the models by side: the likeliest sets of effects, none further acting, and all the
    rest; and the rivals, where these aren't among the sets.

    >>> odds(None)
    []
    """
    likeliest_sets = []
    for models in diagnosis.models if diagnosis is not None else ():
        shown = models.sets[:ODDS]
        rows = [(set_in_words(item), item.probability) for item in shown]
        has_unlisted = diagnosis is not None and diagnosis.engine == "evidence"
        rest = "all other sets together" if has_unlisted else "all other sets of listed effects together"
        rows.append((rest, max(1.0 - sum(p for _, p in rows), 0.0)))
        for effect in diagnosis.effects if diagnosis is not None and not has_unlisted else ():
            if models.side in effect.sides:
                title = effect_title(effect.name)
                rows += [(f"rival of {title}: {effect_title(r.name)}", r.probability) for r in effect.rivals]
        likeliest_sets.append((models.side, rows))
    return likeliest_sets


def set_in_words(item: EffectSet) -> str:
    """Return a set of effects with what is unlisted beside them."""
    unlisted = [f"unlisted physics of the {state}" for state in item.unlisted]
    if not item.effects:
        return " + ".join(["no effect", *unlisted]) if unlisted else "no effect: the baseline"
    return f"{' + '.join([*(effect_title(name) for name in item.effects), *unlisted])}, none further"


def effect_line(effect: NamedEffect) -> str:
    """Return an effect, its cameras, and its parameters that differ from zero, in the library's words."""
    law = library().get(effect.nearest_law)
    described = law.quantities() if law else {}
    fields = law.choices() if law else {}
    sizes = [
        f"{described[name].meaning if name in described else words.parameter_name(name, value)} "
        f"{words.parameter_value(value)}{_from_zero(value, described.get(name))}"
        f"{'' if value.sign_known else ', sign unknown'}"
        for name, value in effect.parameters.items()
        if value.std is None or abs(value.value) >= TOLD_SIGMA * value.std
    ]
    sizes += [
        f"{fields[name].description or name}: {value.replace('_', ' ')}"
        for name, value in effect.choices.items()
        if name in fields
    ]
    who = f"{at_beginning(effect_title(effect.name))}, {' and '.join(effect.sides)}"
    return f"{who}: {'; '.join(sizes)}." if sizes else f"{who}."


def list_findings(fit: FitResult, diagnosis: DiagnosisResult | None) -> Iterator[str]:
    """Yield sentences on implausible figures, the named effects, mismatches without a name, and cameras without a
    mismatch.

    >>> fit = FitResult(source="my-camera", cameras={}, warnings=("the read noise of 0.001 e is implausible",))
    >>> any("0.001 e" in sentence for sentence in list_findings(fit, None))
    True
    """
    yield from (f"Warning: {line}." for line in fit.warnings)
    if diagnosis is None:
        return
    yield from (effect_line(effect) for effect in diagnosis.effects[:NAMED])
    if len(diagnosis.effects) > NAMED:
        more = ", ".join(effect_title(effect.name) for effect in diagnosis.effects[NAMED:])
        yield f"Also: {more}."
    for state in diagnosis.unlisted:
        if state.probability >= LIKELIER:
            yield (
                f"Unlisted physics acts on the {state.state} of the {state.side} camera: probability "
                f"{state.probability:.2f}."
            )
    if diagnosis.unexplained:
        places = sorted({f"{measurement_title(item.measurement)} ({item.side})" for item in diagnosis.unexplained})
        yield f"Without a name so far: {', '.join(places)}."
    yield from (_law_line(law) for law in diagnosis.discovered)
    named = {side for effect in diagnosis.effects for side in effect.sides}
    missed = named | {item.side for item in diagnosis.mismatches}
    if named and (clean := [side for side in fit.cameras if side not in missed]):
        yield f"The {' and '.join(clean)} camera shows no mismatch in these recordings."


def _law_line(law: DiscoveredLaw) -> str:
    """Say along what a law without a name acts, and what it takes off chi2."""
    if law.shown_period and not law.columns:
        goes = f"repeats every {law.shown_period} {law.along}s"
    elif law.form in {"step", "line", "knee", "bump"}:
        goes = f"a {law.form} by {law.along}"
    else:
        goes = f"goes by {law.along}"
    before, after = law.chi2_before / law.n, law.chi2_after / law.n
    return f"A law without a name, {law.side}, {goes}: with it χ² per number falls from {before:.3g} to {after:.3g}."


def _sure_of(effect: NamedEffect) -> str:
    share = f"{100 * effect.probability:.1f} %" if effect.probability < 0.9995 else "above 99.9 %"
    rivals = ", ".join(f"{effect_title(rival.name)} ({rival.probability:.2g})" for rival in effect.rivals)
    return f"{at_beginning(effect_title(effect.name))}: probability {share}" + (
        f"; rivals: {rivals}." if rivals else "."
    )


def certainty(diagnosis: DiagnosisResult | None) -> Iterator[str]:
    """Yield sentences on probabilities and rivals, chi2 on held-out captures, and the false-alarm rate."""
    if diagnosis is None:
        yield "The fits' own standard deviations; nothing was compared with a model."
        return
    yield from (_sure_of(effect) for effect in diagnosis.effects[:NAMED])
    if diagnosis.engine == "evidence" and diagnosis.verdict == "no_mismatch":
        for models in diagnosis.models:
            nothing = sum(item.probability for item in models.sets if not item.effects and not item.unlisted)
            yield f"No effect and nothing unlisted in the {models.side} camera: probability {nothing:.3f}."
    held = diagnosis.held_out
    if held is not None and held.n and (diagnosis.effects or diagnosis.discovered):
        laws = held.chi2_discovered
        beside = "" if laws is None else f", and with the laws without a name to {_short(laws / held.n)}"
        yield (
            f"On {len(held.captures)} held-out captures, χ² per number falls from {_short(held.chi2_before / held.n)} "
            "to "
            f"{_short(held.chi2_after / held.n)}{beside} (noise alone: 1)."
        )
    if diagnosis.false_alarm_rate is not None:
        yield (
            f"False-alarm rate: {100 * diagnosis.false_alarm_rate:.2g} % of healthy cameras are reported with a "
            "mismatch."
        )


def meaning(
    diagnosis: DiagnosisResult | None, validation: ValidationResult | None, both: BothModels | None = None
) -> Iterator[str]:
    """Yield sentences: what the effects do to light and signal, and by how much the baseline's predictions are off."""
    for effect in diagnosis.effects[:NAMED] if diagnosis is not None else ():
        yield effect.statement.split(" Seen in ")[0]
    checks = both.baseline if both is not None else validation.checks if validation is not None else ()
    model = "baseline" if both is not None else words.FITTED
    mended = _worst(both.improved) if both is not None else {}
    for side, worst in _worst(checks).items():
        off = [check for check in worst if not check.passed]
        said = ", ".join(f"{_name(check)} by {plain_number(check.rms_relative_percent, 2)} % rms" for check in off)
        if off:
            now = {check.name: check for check in mended.get(side, ())}
            after = ", ".join(
                f"{plain_number(now[check.name].rms_relative_percent, 2)} %" for check in off if check.name in now
            )
            yield f"The {model} of the {side} camera misses {said}{f'; the improved model: {after}' if after else ''}."
        elif worst:
            yield f"The {model} of the {side} camera predicts within its uncertainty: {', '.join(map(_name, worst))}."


def _name(check: Check) -> str:
    return words.CHECK_NAMES[check.name]


def _worst(checks: Iterable[Check]) -> dict[Side, list[Check]]:
    """Side -> the check of each kind that has the highest chi2 per number."""
    worst: dict[tuple[Side, str], Check] = {}
    for check in checks:
        before = worst.get((check.side, check.name))
        if before is None or check.chi2 / max(check.n, 1) > before.chi2 / max(before.n, 1):
            worst[check.side, check.name] = check
    sides: dict[Side, list[Check]] = {}
    for (side, _), check in worst.items():
        sides.setdefault(side, []).append(check)
    return sides


def to_do(
    diagnosis: DiagnosisResult | None, left_out: int, warnings: int, implausible: Sequence[str] = ()
) -> Iterator[str]:
    """Yield sentences on the next capture, what to check, and which model to predict with."""
    if implausible:
        yield "Settle the warnings about figures first: what depends on a wrong statement is wrong, too."
    if diagnosis is None:
        yield "Diagnose the recordings: calibench diagnose."
    else:
        if diagnosis.next_capture:
            yield f"Next capture: {diagnosis.next_capture}"
        yield from dict.fromkeys(item.check for item in diagnosis.unexplained if item.check)
        if diagnosis.effects:
            yield "Predict with the improved camera model, which holds the named effects; not with the baseline."
        if diagnosis.verdict == "no_mismatch" and not implausible:
            yield "Nothing: the baseline holds. Compare the next calibration with this one: calibench compare."
        if diagnosis.verdict == "nothing_judged":
            yield "Take the captures that the steps under Left out ask for."
    if warnings:
        yield f"Look at the {warnings} warning{'s' if warnings > 1 else ''} about the recordings, under Left out."
    if left_out:
        yield f"{left_out} step{'s were' if left_out > 1 else ' was'} left out, each with its remedy, under Left out."


def _rms_residual(values: Sequence[float], curve: ResidualCurve) -> float:
    std = np.maximum(np.asarray(curve.measured_std), 1e-12)
    return float(np.sqrt(np.mean(np.square((np.asarray(curve.measured) - np.asarray(values)) / std))))


def proof_curves(diagnosis: DiagnosisResult) -> list[ResidualCurve]:
    """Return, for each of the first two named effects, the measurement that shows it most, where the baseline fits
    worst; then the measurements that it fits worst. None where nothing was named.
    """
    if not diagnosis.effects:
        return []
    curves = [curve for curve in diagnosis.curves if len(curve.x) > 3]
    worst = worst_of_each(curves, len(curves))
    chosen: list[ResidualCurve] = []
    for effect in diagnosis.effects[:PROOFS]:
        # a transfer function is what a reader knows; the contrast of patterns says the same
        shown_in = sorted(effect.shown_in, key=lambda name: name != "slanted_edge")
        mine = [c for name in shown_in for c in worst if c.measurement == name and c not in chosen]
        chosen += mine[:1]
    return [*chosen, *(c for c in worst if c not in chosen)][:PROOFS]


def proof_words(curve: ResidualCurve) -> tuple[str, str]:
    """Return the title and caption of such a measurement."""
    before, after = _rms_residual(curve.before, curve), _rms_residual(curve.after, curve)
    title = measurement_title(curve.measurement)
    caption = (
        f"{curve.label}{', held out' if curve.held_out else ''}: rms residual {_short(before)} σ without the effects, "
        f"{_short(after)} σ with them."
    )
    return f"{title[0].upper()}{title[1:]}, {curve.side}, {curve.channel}", caption


def _as_sensitivity(curve: ResidualCurve, fit: FitResult, both: BothModels | None) -> ResidualCurve:
    """Return a curve of signals in narrowband light as the quantum efficiency, which the exposures don't enter; others
    as they are."""
    models = both.sensitivity.get(curve.side, {}) if both is not None else {}
    spectral = fit.cameras[curve.side].spectral if curve.side in fit.cameras else None
    if curve.measurement != "narrowband" or spectral is None or curve.channel not in models:
        return curve
    drawn, at = models[curve.channel], spectral.wavelength_nm
    return curve.model_copy(
        update={
            "label": "all wavelengths",
            "quantity": "quantum efficiency, e/photon",
            "held_out": False,
            "x": at,
            "measured": spectral.quantum_efficiency[curve.channel],
            "measured_std": spectral.quantum_efficiency_std[curve.channel],
            "before": tuple(np.interp(at, drawn.wavelength_nm, drawn.baseline).tolist()),
            "after": tuple(np.interp(at, drawn.wavelength_nm, drawn.improved).tolist()),
        }
    )


def proofs(fit: FitResult, diagnosis: DiagnosisResult | None, both: BothModels | None = None) -> list[Proof]:
    """Draw charts for the first screen.

    The two measurements that show the named effects (`proof_curves`), with both models; of a healthy or an undiagnosed
    camera, its photon transfer.
    """
    shown = []
    for signals in proof_curves(diagnosis) if diagnosis is not None else ():
        curve = _as_sensitivity(signals, fit, both)
        title, caption = proof_words(curve)
        title = title if curve is signals else f"Spectral sensitivity, {curve.side}, {curve.channel}"
        shown.append(Proof(title=title, caption=caption, figure=charts.residual_curve(curve)))
    for side, camera in fit.cameras.items():
        figure = charts.photon_transfer(camera.noise) if camera.noise is not None else None
        if len(shown) < PROOFS and figure is not None:
            caption = "Temporal variance against signal; the dashed line has the fitted system gain as its slope."
            shown.append(Proof(title=f"Photon transfer, {side}", caption=caption, figure=figure))
    return shown


def strip(fit: FitResult) -> list[tuple[str, list[KeyFigure]]]:
    """Return the key figures of the first screen: by side, then those of the stereo pair.

    >>> strip(FitResult(source="my-camera", cameras={}))
    []
    """
    rows = [
        (
            str(side),
            [figure for figure in camera_figures(camera) if figure.name.startswith(STRIP) and figure.is_determined],
        )
        for side, camera in fit.cameras.items()
    ]
    if fit.stereo is not None:
        baseline = KeyFigure("baseline", "mm", fit.stereo.baseline_mm, fit.stereo.baseline_mm_std)
        rows.append(("stereo", [baseline, KeyFigure("reprojection error, rms", "px", fit.stereo.rms_px)]))
    return [(name, figures) for name, figures in rows if figures]


def answers(
    fit: FitResult,
    validation: ValidationResult | None,
    diagnosis: DiagnosisResult | None,
    left_out: int = 0,
    warnings: int = 0,
    both: BothModels | None = None,
) -> list[tuple[str, list[str]]]:
    """Return the four questions, each with its answers in sentences. `left_out`: number of skipped steps; `warnings`:
    number of warnings about the recordings."""
    return [
        ("What was found", list(list_findings(fit, diagnosis))),
        ("How sure", list(certainty(diagnosis))),
        ("What it means", list(meaning(diagnosis, validation, both))),
        ("What to do", list(to_do(diagnosis, left_out, warnings, fit.warnings))),
    ]


def context(
    fit: FitResult,
    validation: ValidationResult | None,
    diagnosis: DiagnosisResult | None,
    left_out: int,
    warnings: int,
    both: BothModels | None = None,
) -> dict[str, Any]:
    """Return the variables of `answers.html`."""
    badge, mood, headline = words.headline(diagnosis)
    return {
        "badge": badge,
        "mood": mood,
        "headline": headline,
        "answers": answers(fit, validation, diagnosis, left_out, warnings, both),
        "odds": odds(diagnosis),
        "odds_are_whole": diagnosis is not None and diagnosis.engine == "evidence",
        "proofs": proofs(fit, diagnosis, both),
        "strip": strip(fit),
    }
