"""Laws without a name: the posterior of the small physics of a state on which something unlisted acts, as curves.

Of each state that is likelier unlisted than not, the processes that show are told: their mean and standard deviation at
their nodes, what the mean takes off chi2 of held-out captures, and the effect that acts so in the improved model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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

#: Probability, given that something unlisted acts on a state, from which on another process is told as possible.
LEAST_OTHER = 0.05
#: Stage and index of the chain that observables are of whose axis is another one, a spatial frequency or a level.
PLACES_OF: dict[str, tuple[str, str, str]] = {
    "dark_row_noise": ("signal", "row", "variance"),
    "dark_column_noise": ("signal", "column", "variance"),
    "dark_row_pattern": ("signal", "row", "mean"),
    "dark_column_pattern": ("signal", "column", "mean"),
    "dark_field": ("signal", "place", "mean"),
    "flat_field": ("image", "place", "mean"),
    "flat_rows": ("light", "row", "mean"),
    "flat_lines": ("charge", "column", "mean"),
    "code_density": ("codes", "code", "mean"),
    "noise_neighbours": ("charge", "level", "covariance"),
}


@dataclass(frozen=True)
class UnnamedLaw:
    """A law without a name: the group whose process it is, how the result lists it, and the effect that acts so; None
    where no state of the camera has it."""

    group: int
    told: DiscoveredLaw
    effect: Effect | None


@dataclass(frozen=True)
class _Shown:
    """A process with its posterior mean (k,) and covariance (k, k) at its nodes, and the blocks that show it, the
    strongest first, with the chi2 of its change."""

    process: Process
    mean: FloatArray
    covariance: FloatArray
    blocks: tuple[int, ...]
    chi2: float

    @property
    def std(self) -> FloatArray:
        """Standard deviations at the nodes (k,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def steepest(self, fixed: int) -> tuple[int, int, float, float]:
        """The two points whose difference is the most standard deviations, the higher first, that difference and its
        standard deviation; the values of the first `fixed` points are none. A level that all points share may be
        undetermined, as a gain takes it up."""
        mean = np.concatenate([np.zeros(fixed), self.mean])
        covariance = np.pad(self.covariance, ((fixed, 0), (fixed, 0)))
        variance = np.diag(covariance)
        std = np.sqrt(np.maximum(variance[:, None] + variance - 2.0 * covariance, 1e-12 * variance.max()))
        apart = mean[:, None] - mean
        i, j = divmod(int(np.argmax(apart / std)), len(mean))
        return i, j, float(apart[i, j]), float(std[i, j])


def laws_of(reading: SideTable) -> tuple[UnnamedLaw, ...]:
    """Return the laws without a name, by state the likeliest first."""
    found: list[UnnamedLaw] = []
    for finding in reading.posterior.findings:
        if finding.kind != "unlisted" or finding.probability < LIKELIER:
            continue
        odds = _odds_of_processes(reading, finding.name)
        told = [g for g, p in odds.items() if p >= LIKELIER] or list(odds)[:1]
        others = [g for g, p in odds.items() if g not in told and p >= LEAST_OTHER]
        for group in told:
            delta = delta_of(reading.table, reading.model, group)
            if delta is not None:
                found.append(_law(reading, group, delta, finding.probability, others if len(told) == 1 else ()))
    return tuple(found)


def _odds_of_processes(reading: SideTable, state: str) -> dict[int, float]:
    """Return the groups of a state with the probability that each is unlisted, given that any is, likeliest first."""
    found: dict[int, float] = {}
    total = 0.0
    for row in reading.table.rows:
        own = row.unlisted & reading.table.groups_on(state)
        total += row.probability if own and row.refitted else 0.0
        for g in own if row.refitted else ():
            found[g] = found.get(g, 0.0) + row.probability
    return {g: p / total for g, p in sorted(found.items(), key=lambda item: -item[1]) if total > 0.0}


def _shown(reading: SideTable, delta: Delta, group: int) -> _Shown:
    """Return a process with the blocks that its change stands out in."""
    model, own = reading.used, reading.model.groups[group]
    assert own.process is not None
    variance = np.concatenate([np.diag(b.covariance) for b in model.blocks])
    power = np.square(own.columns @ delta.mean) / variance
    by_block = {k: float(power[at].sum()) for k, at in enumerate(model.slices)}
    order = sorted(by_block, key=lambda k: -by_block[k])
    least = max(SHOWN_CHI2, SHOWN_SHARE * by_block[order[0]])
    blocks = tuple(k for k in order if by_block[k] > least) or tuple(order[:1])
    return _Shown(own.process, *delta.at_nodes(own.process), blocks, float(power.sum()))


@dataclass(frozen=True)
class _ShownCurve:
    """A process as the result lists it: place, points, the law's table there, departures from none with their standard
    deviations in the unit in which they are shown. `curve_of`, `labels`: of one measurement's numbers. `size`: in
    words."""

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
    size: str = ""


def _law(reading: SideTable, group: int, delta: Delta, probability: float, others: Sequence[int]) -> UnnamedLaw:
    shown, state = _shown(reading, delta, group), reading.table.groups[group]
    names = tuple(dict.fromkeys(reading.used.blocks[k].measurement.name for k in shown.blocks))
    judged = predict_by_curve(reading.problem, reading.search, reading.table, group, names)
    curve = shown.process.curve
    one = _of_state(reading, curve, shown) if isinstance(curve, StateCurve) else _of_observable(curve, shown)
    before, after, n = _chi2_of(reading, shown, judged)
    form = "periodic" if one.period else "step" if isinstance(curve, StateCurve) and curve.is_step else "curve"
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
    said = _statement(
        told, one.size, list(dict.fromkeys(_axis(reading, g) for g in others)), is_held_out=judged is not None
    )
    is_of_camera = isinstance(curve, StateCurve) and not isinstance(curve, BordersCurve)
    return UnnamedLaw(
        group, told.model_copy(update={"statement": said}), curve.law(shown.mean) if is_of_camera else None
    )


def _of_state(reading: SideTable, curve: StateCurve, shown: _Shown) -> _ShownCurve:
    """Return a law on a state of the chain, at all its points."""
    gain = reading.used.camera.conversion_gain_dn_per_e
    unit = departure_unit(curve.stage, curve.along, curve.of, bool(curve.at))
    factor = {"DN": gain, "DN/s": gain, "DN^2": gain**2}.get(unit, 1.0)
    change, std = curve.change(shown.mean), np.abs(curve.change(shown.std))
    law = curve.law(shown.mean)
    table = np.array(law.table) if isinstance(law, EmpiricalLaw) else curve.none + change
    size = _size_of_state(curve, shown, factor, unit, reading.used.camera.channels)
    return _ShownCurve(
        curve.stage, curve.along, curve.of, curve.at, table, factor * change, factor * std, curve.period, size=size
    )


def _of_observable(curve: ObservableCurve, shown: _Shown) -> _ShownCurve:
    """Return a curve of one measurement's used numbers, in its quantity: by channel and condition, along its axis."""
    measurement, used = curve.measurement, curve.used
    labels = [" ".join(dict.fromkeys((label.channel, label.condition))).strip() for label in curve.labels[:used]]
    order = np.array(sorted(range(used), key=lambda k: (labels[k], curve.labels[k].x)), int)
    departure, std = (curve.scale[order] * v[order] for v in (shown.mean, shown.std))
    stage, along, of = PLACES_OF.get(measurement.name, ("image", measurement.axis.replace("_", " "), "mean"))
    at = tuple(curve.labels[k].x for k in order)
    of_each = tuple(labels[k] for k in order)
    one = _ShownCurve(stage, along, of, at, departure, departure, std, curve_of=measurement.name, labels=of_each)
    return replace(one, size=_size_of_measurement(one))


def _chi2_of(reading: SideTable, shown: _Shown, judged: CurvePrediction | None) -> tuple[float, float, int]:
    """Return chi2 without and with the law of held-out numbers; of the used ones that it shows in, where none are held
    out: these by their noise alone."""
    if judged is not None:
        return judged.chi2_before, judged.chi2_after, judged.n
    n = sum(len(reading.used.blocks[k].value) for k in shown.blocks)
    return shown.chi2 + n, float(n), n


def _axis(reading: SideTable, group: int) -> str:
    """Return what a process is of, and along what."""
    process = reading.model.groups[group].process
    curve = None if process is None else process.curve
    if isinstance(curve, ObservableCurve):
        return measurement_title(curve.measurement.name)
    assert isinstance(curve, StateCurve)
    return f"{quantity_of(curve.stage, curve.along, curve.of)} by {curve.along}"


def _statement(law: DiscoveredLaw, size: str, others: Sequence[str], *, is_held_out: bool) -> str:
    """Say where the law acts, how large it is, what may do that, and what it predicts. `others`: along what else it may
    act."""
    what = f"the {quantity_of(law.stage, law.along, law.of)} by {law.along}"
    if law.curve_of:
        what = f"{measurement_title(law.curve_of)}"
    told = [
        f"No named effect accounts for this: {what} of the {law.side} camera {size}.",
        f"Something unlisted acts on the {law.state} with probability {law.probability:.3f}.",
        f"{law.suspects[0].upper()}{law.suspects[1:]}.",
    ]
    if others:
        told.append(f"These captures don't tell it from a law of the {', or of the '.join(others)}.")
    if is_held_out:
        places = " and ".join(measurement_title(name) for name in law.measurements)
        told.append(
            f"By this curve chi2 of {law.n} held-out numbers ({places}) falls from {law.chi2_before:.0f} to "
            f"{law.chi2_after:.0f}."
        )
    return " ".join(told)


def _size_of_state(
    curve: StateCurve, shown: _Shown, factor: float, unit: str, channels: Sequence[str]
) -> str:  # fmt: skip
    """Say by how much a law differs between the two nodes that are known best against each other."""
    i, j, apart, std = shown.steepest(curve.fixed)
    scale, said = (100.0, "%") if unit == "%" else (factor, unit)
    size = f"{scale * curve.unit * apart:.3g} ± {scale * curve.unit * std:.1g} {said}"
    if curve.period:
        return f"repeats every {curve.period}, {curve.along} {i} {size} above {curve.along} {j}"
    at, of = coordinate_unit(curve.stage, curve.along, curve.of), curve.at
    high, low = (
        f"{of[k % len(of)]:.4g} {at}".strip() + (f" in {channels[k // len(of)]}" if curve.curves > 1 else "")
        for k in (i, j)
    )
    return f"is {size} higher at {high} than at {low}"


def _size_of_measurement(one: _ShownCurve) -> str:
    """Say by how much a measurement departs where that is the most standard deviations."""
    k = int(np.argmax(np.abs(one.departure) / np.maximum(one.std, 1e-300)))
    return f"departs by {one.departure[k]:+.3g} ± {one.std[k]:.1g} at {one.at[k]:.4g} ({one.labels[k]})"
