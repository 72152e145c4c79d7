"""Which measurements show each effect, and which effects are rivals, derived from the reference study.

An effect is visible in a measurement where one of its prototypes changes a predicted number by more than rounding.
Rivals are pairs of effects whose whitened signatures have a cosine of `DecisionPolicy.rival_cosine` or more in some
part of a session: the whole, one measurement, or one condition of a measurement. (For independent measurements no other
subset has to be looked at: the cosine over several is a weighted mean of the single ones with weights that sum to 1 at
most, by Cauchy and Schwarz.)

Deriving takes about a minute, so that the result is kept in visibility.toml. docs/write_tables.py writes it anew; a
slow test compares.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.rivals import parallel_pairs, signature_changes, symmetric, whitened
from lab.diagnose.measurements.blocks import measurement_model
from lab.diagnose.policy import DecisionPolicy
from lab.diagnose.reference_study import reference_study
from sim.effects.library import candidates, effects

TABLE = Path(__file__).with_name("visibility.toml")
#: Changes below this share of a number's standard deviation are rounding.
ROUNDING = 1e-6
#: Numbers that a condition has to have to count as a part of a session: of fewer, nuisance parameters leave no shape to
#: compare.
LEAST_NUMBERS = 8


@dataclass(frozen=True)
class EffectVisibility:
    """The measurements that show one effect, the kinds of capture that they need, and the effect's rivals."""

    effect: str
    measurements: tuple[str, ...]
    capture_kinds: tuple[str, ...]
    rivals: tuple[str, ...]


@cache
def visibility() -> dict[str, EffectVisibility]:
    """Effect -> its entry in visibility.toml. An effect that was added after the file was written is missing."""
    content = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    return {
        name: EffectVisibility(
            name, tuple(entry["measurements"]), tuple(entry["capture_kinds"]), tuple(entry["rivals"])
        )
        for name, entry in content.items()
    }


def derived_visibility(policy: DecisionPolicy | None = None) -> dict[str, EffectVisibility]:
    """Return the table, derived anew from both sides of the reference study."""
    policy = policy or DecisionPolicy()
    recordings = reference_study()
    kind_of = {capture.id: capture.kind for capture in recordings.captures()}
    looked_for = {kind.name for kind in candidates()}
    measurements: dict[str, dict[str, None]] = {name: {} for name in effects()}
    kinds: dict[str, set[str]] = {name: set() for name in effects()}
    pairs: set[tuple[str, str]] = set()
    for side in recordings.sides:
        model, _ = measurement_model(recordings, side)
        if model is None:
            continue
        changes = signature_changes(model, effects().values())
        std = np.sqrt(np.concatenate([np.diag(block.covariance) for block in model.blocks]))
        for name, table in changes.items():
            changed = (np.abs(table) > ROUNDING * std[:, None]).any(axis=1)
            for measurement, captures in _shown(model, changed):
                measurements[name][measurement] = None
                kinds[name] |= {kind_of[capture] for capture in captures}
        compared = {name: table for name, table in changes.items() if name in looked_for}
        for part in _parts(model):
            pairs |= parallel_pairs(whitened(model, compared, part), policy.rival_cosine)
    rivals = symmetric(effects(), pairs)
    return {
        name: EffectVisibility(name, tuple(measurements[name]), tuple(sorted(kinds[name])), tuple(sorted(rivals[name])))
        for name in effects()
    }


def _shown(model: MeasurementModel, changed: np.ndarray) -> Iterator[tuple[str, set[str]]]:
    """Measurements of changed numbers, and their captures."""
    for block, at in zip(model.blocks, model.slices, strict=True):
        labels = [label for label, is_changed in zip(block.labels, changed[at], strict=True) if is_changed]
        if labels:
            yield block.measurement.name, {capture for label in labels for capture in label.captures}


def _parts(model: MeasurementModel) -> Iterable[np.ndarray]:
    """Masks (n,) of the session's parts: the whole, each measurement, and each condition of one."""
    yield np.ones(len(model.value), bool)
    for index, (block, at) in enumerate(zip(model.blocks, model.slices, strict=True)):
        yield model.mask(index)
        if block.measurement.conditions:
            condition = np.array([label.condition for label in block.labels])
            for one in np.unique(condition):
                part = np.zeros(len(model.value), bool)
                part[at] = condition == one
                if LEAST_NUMBERS <= part.sum() < len(condition):
                    yield part


def as_toml(table: Mapping[str, EffectVisibility]) -> str:
    """Return the table as the text of visibility.toml."""
    lines = ["# Generated by docs/write_tables.py from the reference study; see visibility.py."]
    for name, one in table.items():
        lines += ["", f"[{name}]"]
        for key in ("measurements", "capture_kinds", "rivals"):
            values = ", ".join(f'"{value}"' for value in getattr(one, key))
            lines.append(f"{key} = [{values}]")
    return "\n".join(lines) + "\n"
