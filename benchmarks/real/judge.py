"""A set's results beside what is known of it by other means."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from scipy import stats

from benchmarks.real.sets import DeclaredSet, Figure
from benchmarks.real.take_through import Cost
from lab.formats.results import DiagnosisResult, FitResult
from sim.camera import Side
from sim.parameters import Frozen

#: Largest held-out chi2 over n of a measurement of which nothing more is told, and the quantile of chi2 that has to be
#: passed as well.
EXPLAINED, QUANTILE = 1.5, 0.999


class JudgedFigure(Frozen):
    """A figure beside the independent one. `pull`: their difference over its standard uncertainty. None: not
    determined."""

    name: str
    unit: str
    value: float | None
    std: float | None
    independent: float
    independent_std: float
    pull: float | None


class JudgedName(Frozen):
    """A name that was given, and whether an independent look agrees; `law`: as of `NamedEffect`."""

    name: str
    sides: tuple[Side, ...]
    probability: float
    law: str
    is_right: Literal["agrees", "contradicted", "not known"]
    why: str


class JudgedMeasurement(Frozen):
    """Held-out chi2 of a measurement. `is_told`: whether the diagnosis tells of a remainder in it."""

    side: Side
    measurement: str
    n: int
    before: float
    after: float
    is_told: bool

    @property
    def after_over_n(self) -> float:
        """chi2 over n with what was found."""
        return self.after / self.n

    @property
    def is_silent(self) -> bool:
        """Whether a remainder is left that nothing tells of."""
        return not self.is_told and self.after_over_n > EXPLAINED and self.after > stats.chi2.ppf(QUANTILE, self.n)


class SetResult(Frozen):
    """A set's row. `made_up`: figures that its recordings can't determine; `missing`: names that had to be given.
    `before`, `after`, `n`: held-out chi2 of all measurements. `summary`: the diagnosis in sentences."""

    state: str
    cpu_s: float
    memory_mb: float
    failed: str = ""
    verdict: str = ""
    figures: tuple[JudgedFigure, ...] = ()
    made_up: tuple[str, ...] = ()
    names: tuple[JudgedName, ...] = ()
    missing: tuple[str, ...] = ()
    before: float | None = None
    after: float | None = None
    n: int = 0
    measurements: tuple[JudgedMeasurement, ...] = ()
    summary: tuple[str, ...] = ()

    @property
    def worst(self) -> JudgedMeasurement | None:
        """The measurement of the largest held-out chi2 over n, with what was found."""
        return max(self.measurements, key=lambda m: m.after_over_n, default=None)

    @property
    def over_n(self) -> float | None:
        """Held-out chi2 of all measurements over n, with what was found."""
        return None if self.after is None or not self.n else self.after / self.n

    @property
    def contradicted(self) -> tuple[str, ...]:
        """Names that an independent look contradicts."""
        return tuple(name.name for name in self.names if name.is_right == "contradicted")


def judged(one: DeclaredSet, cost: Cost, fit: FitResult | None, diagnosis: DiagnosisResult | None) -> SetResult:
    """A set's row. `fit`: None where the set failed; `diagnosis`: None of a table without frames, too."""
    row = SetResult(state=cost.state, cpu_s=round(cost.cpu_s, 1), memory_mb=round(cost.memory_mb), failed=cost.failed)
    if fit is None:
        return row
    figures = tuple(_figure(figure, fit, diagnosis) for figure in one.figures)
    made_up = tuple(at for at in one.undetermined if found_at(at, fit, diagnosis)[0] is not None)
    row = row.model_copy(update={"figures": figures, "made_up": made_up})
    if diagnosis is None:
        return row
    names = []
    for effect in diagnosis.effects:
        known: tuple[tuple[Literal["agrees", "contradicted"], Mapping[str, str]], ...] = (
            ("agrees", one.agrees),
            ("contradicted", one.contradicted),
        )
        is_right, why = next(
            ((k, reasons[effect.name]) for k, reasons in known if effect.name in reasons), (one.others, "")
        )
        names.append(
            JudgedName(
                name=effect.name, sides=effect.sides, probability=effect.probability, law=effect.law, is_right=is_right,
                why=why
            )
        )  # fmt: skip
    told = {(u.side, u.measurement) for u in diagnosis.unexplained}
    told |= {(s, m) for e in diagnosis.effects if e.law == "inexact" for s in e.sides for m in e.shown_in}
    held = diagnosis.held_out
    return row.model_copy(
        update={
            "verdict": diagnosis.verdict,
            "names": tuple(names),
            "missing": tuple(name for name in one.expected if name not in {n.name for n in names}),
            "before": None if held is None else _digits(held.chi2_before),
            "after": None if held is None else _digits(held.chi2_after),
            "n": 0 if held is None else held.n,
            "measurements": tuple(
                JudgedMeasurement(
                    side=m.side, measurement=m.measurement, n=m.held_out_n, before=_digits(m.held_out_before),
                    after=_digits(m.held_out_after), is_told=(m.side, m.measurement) in told,
                )
                for m in diagnosis.measurements
                if m.held_out_n
            ),
            "summary": diagnosis.summary,
        }
    )  # fmt: skip


def _figure(figure: Figure, fit: FitResult, diagnosis: DiagnosisResult | None) -> JudgedFigure:
    value, std = found_at(figure.at, fit, diagnosis)
    uncertainty = float(np.hypot(std or 0.0, figure.std))
    pull = None if value is None else (value - figure.value) / uncertainty if uncertainty else None
    return JudgedFigure(
        name=figure.name,
        unit=figure.unit,
        value=None if value is None else _digits(value),
        std=None if std is None else _digits(std),
        independent=figure.value,
        independent_std=figure.std,
        pull=None if pull is None else round(pull, 2),
    )


def _digits(value: float) -> float:
    """A number of six significant digits, for what is kept."""
    return float(f"{value:.6g}")


def found_at(at: str, fit: FitResult, diagnosis: DiagnosisResult | None) -> tuple[float | None, float | None]:
    """The value at a place of the results and its standard deviation; None where they don't have one.

    A place is a path with dots. It begins with `effect`, `stereo`, or a part of the left camera's fit; `right` before
    it takes the right camera. Its steps are keys, numbers of a list's items, and `@NM`, the value at a wavelength. An
    effect is found by its name."""
    steps = at.split(".")
    side: Side = "right" if steps[0] == "right" else "left"
    steps = steps[1:] if steps[0] == "right" else steps
    if steps[0] == "effect":
        found = [] if diagnosis is None else [e for e in diagnosis.effects if e.name == steps[1] and side in e.sides]
        parameter = found[0].parameters.get(steps[2]) if found else None
        return (None, None) if parameter is None else (parameter.value, parameter.std)
    if steps[0] == "stereo":
        root: Any = {"stereo": None if fit.stereo is None else fit.stereo.model_dump()}
    else:
        root = fit.cameras[side].model_dump() if side in fit.cameras else None
    value = _walked(root, steps)
    # the standard deviation has the key of the value, or of what holds the value, with `_std`
    keys = [k for k in reversed(range(len(steps))) if steps[k].isidentifier()]
    beside = ([*steps[:k], f"{steps[k]}_std", *steps[k + 1 :]] for k in keys)
    std = next((s for path in beside for s in (_walked(root, path),) if s is not None), None)
    return value, std


def _walked(root: Any, steps: list[str]) -> float | None:
    axis: Any = None
    for step in steps:
        if isinstance(root, dict):
            axis = root.get("wavelength_nm", axis)
            root = root.get(step)
        elif isinstance(root, list | tuple) and step.startswith("@"):
            root = float(np.interp(float(step[1:]), axis, root))
        elif isinstance(root, list | tuple) and int(step) < len(root):
            root = root[int(step)]
        else:
            return None
    return float(root) if isinstance(root, int | float) else None
