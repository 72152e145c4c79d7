"""Laws without a name: the posterior of the small physics of a state on which something unlisted acts, as curves.

Of each state that is likelier unlisted than not, the processes that show are told: their mean and standard deviation at
their nodes, what the mean takes off chi2 of held-out captures, and the effect that acts so in the improved model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lab.diagnose.evidence.causes import SHOWN_CHI2, SHOWN_SHARE
from lab.diagnose.evidence.side_table import SideTable
from lab.diagnose.outcome.law_words import coordinate_unit, departure_unit, quantity_of, suspects_of_place
from lab.formats.results import DiscoveredLaw
from lab.inference.check import CurvePrediction, predict_by_curve
from lab.inference.delta import Delta, delta_of
from lab.inference.discrepancy import BordersCurve, ObservableCurve, StateCurve
from lab.inference.model import Process
from lab.inference.posterior import LIKELIER
from lab.observables.observable import measurement_title
from sim.effects.base import Effect
from sim.effects.empirical_law import EmpiricalLaw
from sim.spectrum import FloatArray

#: Standard deviations by which a process has to depart from none at a node to be told beside the one that shows most.
TOLD_SIGMA = 3.0
#: Stage and index of the chain that observables are of whose axis is another one, a spatial frequency or a level.
PLACES_OF: dict[str, tuple[str, str, str]] = {
    "dark_row_noise": ("signal", "row", "variance"),
    "dark_column_noise": ("signal", "column", "variance"),
    "dark_row_pattern": ("signal", "row", "mean"),
    "dark_column_pattern": ("signal", "column", "mean"),
    "flat_rows": ("light", "row", "mean"),
    "flat_lines": ("charge", "column", "mean"),
    "code_density": ("codes", "code", "mean"),
    "noise_neighbours": ("charge", "level", "covariance"),
}


@dataclass(frozen=True)
class Law:
    """A law without a name: the group whose process it is, how the result lists it, and the effect that acts so; None
    where no state of the camera has it."""

    group: int
    told: DiscoveredLaw
    effect: Effect | None


@dataclass(frozen=True)
class _Shown:
    """A process with its posterior mean and standard deviation at its nodes (k,), and the blocks that show it, the
    strongest first, with the chi2 of its change."""

    process: Process
    mean: FloatArray
    std: FloatArray
    blocks: tuple[int, ...]
    chi2: float

    @property
    def sigma(self) -> float:
        """Largest departure from none, in standard deviations."""
        return float(np.max(np.abs(self.mean) / np.maximum(self.std, 1e-300)))


def laws_of(reading: SideTable) -> tuple[Law, ...]:
    """Return the laws without a name, by state the one that shows most first."""
    found: list[Law] = []
    for finding in reading.posterior.findings:
        if finding.kind != "unlisted" or finding.probability < LIKELIER:
            continue
        group = reading.table.groups.index(finding.name)
        delta = delta_of(reading.table, reading.model, group)
        if delta is not None:
            shown = list(_shown(reading, delta, group))
            names = tuple(dict.fromkeys(reading.used.blocks[k].measurement.name for s in shown for k in s.blocks))
            judged = predict_by_curve(reading.problem, reading.search, reading.table, group, names)
            found += [_law(reading, group, one, finding.probability, names, judged) for one in shown]
    return tuple(found)


def _shown(reading: SideTable, delta: Delta, group: int) -> Iterator[_Shown]:
    """Yield the processes of a group whose change stands out of the noise, the one that changes most first; only that,
    where none does."""
    model = reading.used
    variance = np.concatenate([np.diag(b.covariance) for b in model.blocks])
    found = []
    for process in reading.model.groups[group].processes:
        power = np.square(process.columns @ delta.mean) / variance
        by_block = {k: float(power[at].sum()) for k, at in enumerate(model.slices)}
        order = sorted(by_block, key=lambda k: -by_block[k])
        least = max(SHOWN_CHI2, SHOWN_SHARE * by_block[order[0]])
        blocks = tuple(k for k in order if by_block[k] > least) or tuple(order[:1])
        mean, covariance = delta.at_nodes(process)
        found.append(_Shown(process, mean, np.sqrt(np.diag(covariance)), blocks, float(power.sum())))
    found.sort(key=lambda one: -one.chi2)
    for k, one in enumerate(found):
        if not k or (one.chi2 > max(SHOWN_CHI2, SHOWN_SHARE * found[0].chi2) and one.sigma > TOLD_SIGMA):
            yield one


@dataclass(frozen=True)
class _Curve:
    """A process as the result lists it: place, points, the law's table there, departures from none with their standard
    deviations in the unit in which they are shown. `curve_of`, `labels`: of one measurement's numbers."""

    stage: str
    along: str
    of: str
    at: tuple[float, ...]
    table: FloatArray
    departure: FloatArray
    std: FloatArray
    period: int = 0
    curve_of: str = ""
    labels: tuple[str, ...] = ()


def _law(
    reading: SideTable, group: int, shown: _Shown, probability: float, names: Sequence[str],
    judged: CurvePrediction | None,
) -> Law:  # fmt: skip
    curve, state = shown.process.curve, reading.table.groups[group]
    one = _of_state(reading, curve, shown) if isinstance(curve, StateCurve) else _of_observable(curve, shown)
    before, after, n = _chi2_of(reading, shown, judged)
    form = "periodic" if one.period else "curve"
    told = DiscoveredLaw(
        side=reading.side,
        stage=one.stage,
        along=one.along,
        of=one.of,
        form=form,
        period=one.period,
        at=one.at,
        table=tuple(one.table.tolist()),
        shown_period=one.period,
        shown_departure=tuple(one.departure.tolist()),
        shown_std=tuple(one.std.tolist()),
        chi2_before=before,
        chi2_after=after,
        n=n,
        own_chi2_before=before,
        own_chi2_after=after,
        own_n=n,
        measurements=tuple(sorted(names)),
        suspects=suspects_of_place(one.stage, one.along, one.of, form),
        statement="",
        state=state,
        probability=round(probability, 6),
        curve_of=one.curve_of,
        labels=one.labels,
    )
    said = _statement(told, probability, is_held_out=judged is not None)
    is_of_camera = isinstance(curve, StateCurve) and not isinstance(curve, BordersCurve)
    return Law(group, told.model_copy(update={"statement": said}), curve.law(shown.mean) if is_of_camera else None)


def _of_state(reading: SideTable, curve: StateCurve, shown: _Shown) -> _Curve:
    """Return a law on a state of the chain, at all its points."""
    gain = reading.used.camera.conversion_gain_dn_per_e
    unit = departure_unit(curve.stage, curve.along, curve.of, bool(curve.at))
    factor = {"DN": gain, "DN/s": gain, "DN^2": gain**2}.get(unit, 1.0)
    change, std = curve.change(shown.mean), np.abs(curve.change(shown.std))
    law = curve.law(shown.mean)
    table = np.array(law.table) if isinstance(law, EmpiricalLaw) else curve.none + change
    return _Curve(curve.stage, curve.along, curve.of, curve.at, table, factor * change, factor * std, curve.period)


def _of_observable(curve: ObservableCurve, shown: _Shown) -> _Curve:
    """Return a curve of one measurement's used numbers, in its quantity: by channel and condition, along its axis."""
    measurement, used = curve.measurement, curve.used
    labels = [" ".join(dict.fromkeys((label.channel, label.condition))).strip() for label in curve.labels[:used]]
    order = np.array(sorted(range(used), key=lambda k: (labels[k], curve.labels[k].x)), int)
    departure, std = (curve.scale[order] * v[order] for v in (shown.mean, shown.std))
    stage, along, of = PLACES_OF.get(measurement.name, ("image", measurement.axis.replace("_", " "), "mean"))
    at = tuple(curve.labels[k].x for k in order)
    of_each = tuple(labels[k] for k in order)
    return _Curve(stage, along, of, at, departure, departure, std, curve_of=measurement.name, labels=of_each)


def _chi2_of(reading: SideTable, shown: _Shown, judged: CurvePrediction | None) -> tuple[float, float, int]:
    """Return chi2 without and with the law of held-out numbers; of the used ones that it shows in, where none are held
    out: these by their noise alone."""
    if judged is not None:
        return judged.chi2_before, judged.chi2_after, judged.n
    n = sum(len(reading.used.blocks[k].value) for k in shown.blocks)
    return shown.chi2 + n, float(n), n


def _statement(law: DiscoveredLaw, probability: float, *, is_held_out: bool) -> str:
    """Say where the law acts, how large it is and where, what may do that, and what it predicts."""
    departure, std = np.array(law.shown_departure), np.array(law.shown_std)
    k = int(np.argmax(np.abs(departure) / np.maximum(std, 1e-300)))
    if law.curve_of:
        what = f"{measurement_title(law.curve_of)} of the {law.side} camera departs"
        size, where = f"{departure[k]:+.3g} ± {std[k]:.1g}", f"{law.labels[k]} at {law.at[k]:.4g}"
    else:
        unit = departure_unit(law.stage, law.along, law.of, bool(law.at))
        factor, shown = (100.0, "%") if unit == "%" else (1.0, unit)
        what = f"the {quantity_of(law.stage, law.along, law.of)} by {law.along} of the {law.side} camera departs"
        size = f"{factor * departure[k]:+.3g} ± {factor * std[k]:.1g} {shown}"
        if law.period:
            where = f"{law.along} {k} of every {law.period}"
        else:
            unit = coordinate_unit(law.stage, law.along, law.of)
            where = f"{law.at[k % len(law.at)]:.4g} {unit}".strip()
    told = [
        f"No named effect accounts for this: {what} by {size} ({where}).",
        f"Something unlisted acts on the {law.state} with probability {probability:.3f}.",
        f"{law.suspects[0].upper()}{law.suspects[1:]}.",
    ]
    if is_held_out:
        places = " and ".join(measurement_title(name) for name in law.measurements)
        told.append(
            f"By this curve chi2 of {law.n} held-out numbers ({places}) falls from {law.chi2_before:.0f} to "
            f"{law.chi2_after:.0f}."
        )
    return " ".join(told)
