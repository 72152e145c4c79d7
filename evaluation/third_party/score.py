"""The score of third parties' sets: right names, second names, sizes within their uncertainty."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import betaincinv

from sim.effects.library import effect


@dataclass(frozen=True)
class ScoredSize:
    """A parameter of a rightly named effect, beside the simulator's. `low`, `high`: two standard deviations, or the
    interval that is reported."""

    name: str
    truth: float
    value: float
    low: float
    high: float

    @property
    def is_right(self) -> bool:
        """Return whether the truth lies in the interval."""
        return self.low <= self.truth <= self.high


@dataclass(frozen=True)
class Diagnosed:
    """One set: what the simulator was asked for and did, the verdict, the names with their probabilities.

    source : name of the simulator's model
    effect : the library's name of it, None of healthy cameras
    also : a second effect of the drawn camera
    """

    source: str
    simulator: str
    effect: str | None
    set: int
    asked: float
    measured: float
    is_checked: bool
    verdict: str
    names: dict[str, float]
    sizes: tuple[ScoredSize, ...]
    cpu_s: float
    also: str | None = None

    @property
    def is_named(self) -> bool:
        """Return whether the effect's or its family's name is among those given."""
        return self.effect is not None and not {self.effect, effect(self.effect).family}.isdisjoint(self.names)

    @property
    def right_names(self) -> frozenset[str]:
        """Return the names that are right: those of the effects and of their families."""
        concealed = [name for name in (self.effect, self.also) if name is not None]
        return frozenset(concealed) | {effect(name).family.value for name in concealed}

    @property
    def second_names(self) -> tuple[str, ...]:
        """Names that aren't right."""
        return tuple(name for name in self.names if name not in self.right_names)


def share_with_interval(right: int, of: int) -> str:
    """Return "RIGHT of OF (LOW-HIGH %)": the 95 % interval of the rate (Clopper and Pearson 1934)."""
    if not of:
        return "-"
    low = betaincinv(right, of - right + 1, 0.025) if right else 0.0
    high = betaincinv(right + 1, of - right, 0.975) if right < of else 1.0
    return f"{right} of {of} ({100.0 * low:.0f}-{100.0 * high:.0f} %)"


def table(results: Iterable[Diagnosed]) -> str:
    """Return the table as Markdown, a row a source; rates with their 95 % intervals."""
    kept = list(results)
    lines = [
        "| simulator | model | sets | check | named | second names | nothing | sizes right | CPU s, median |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for source in dict.fromkeys(one.source for one in kept):
        own = [one for one in kept if one.source == source]
        use = [one for one in own if one.is_checked]
        sizes = [size for one in use for size in one.sizes]
        named = "-" if own[0].effect is None else share_with_interval(sum(one.is_named for one in use), len(use))
        seconds = sorted(second for one in use for second in one.second_names)
        words = ", ".join(f"`{second}` {seconds.count(second)}" for second in dict.fromkeys(seconds)) or "-"
        right = share_with_interval(sum(size.is_right for size in sizes), len(sizes))
        cpu_s = f"{np.median([one.cpu_s for one in use]):.0f}" if use else "-"
        lines.append(
            f"| {own[0].simulator} | {source} | {len(own)} | {len(use)} of {len(own)} | {named} | {words} | "
            f"{sum(not one.names for one in use)} | {right} | {cpu_s} |"
        )
    return "\n".join(lines)


def size_table(results: Iterable[Diagnosed]) -> str:
    """Return the sizes as Markdown, a row a parameter of a model: how many lie within two standard deviations of the
    simulator's, their ratio to it, and the standard deviation that was reported, over the truth."""
    lines = [
        "| model | parameter | sets | within 2 σ | found over true, median | reported σ over true, median |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    found: dict[tuple[str, str], list[ScoredSize]] = {}
    for one in results:
        for size in one.sizes if one.is_checked else ():
            found.setdefault((one.source, size.name), []).append(size)
    for (source, name), sizes in found.items():
        ratio, std = (
            np.median([value / abs(size.truth) for value, size in zip(values, sizes, strict=True)])
            for values in (
                [size.value * np.sign(size.truth) for size in sizes],
                [(size.high - size.low) / 4.0 for size in sizes],
            )
        )
        right = share_with_interval(sum(size.is_right for size in sizes), len(sizes))
        lines.append(f"| {source} | `{name}` | {len(sizes)} | {right} | {ratio:.3f} | {std:.3f} |")
    return "\n".join(lines)
