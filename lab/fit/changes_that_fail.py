"""Rules by which changes between two fits fail a check (`calibench compare --fail-on`): the name of a figure, and a tolerance.

A rule is `FIGURE`, or `FIGURE>AMOUNT` with the amount in the figure's own unit or in percent of A (`left:noise read_noise_e>5%`).
`*` in FIGURE stands for any text; `SIDE:` before it confines it to a camera. A change fails a rule where it is significant, as the
comparison decides, and larger than the amount.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from lab.errors import InputError
from lab.formats.results import Change, ComparisonResult

#: The name of the difference of two projections, in px, beside the figures of the fits.
PROJECTION = "projection"
_RULE = re.compile(r"(?:(?P<side>left|right):)?(?P<figure>[^>]+?)\s*(?:>\s*(?P<amount>[0-9.eE+-]+)\s*(?P<percent>%)?)?")


@dataclass(frozen=True)
class FailRule:
    """One rule. `amount`: the largest difference that passes, in the figure's unit, or as a share of A's value where `relative`."""

    figure: str
    side: str | None = None
    amount: float = 0.0
    relative: bool = False

    @classmethod
    def parse(cls, text: str) -> FailRule:
        """The rule that a text states. Raises InputError."""
        refused = InputError(f"--fail-on {text!r}: give FIGURE, or FIGURE>AMOUNT with an optional %, SIDE: before it")
        found = _RULE.fullmatch(text.strip())
        if found is None:
            raise refused
        try:
            amount = float(found["amount"] or 0.0)
        except ValueError:
            raise refused from None
        if not 0.0 <= amount < float("inf"):
            raise refused
        relative = found["percent"] is not None
        return cls(found["figure"].strip(), found["side"], amount / 100.0 if relative else amount, relative)

    def _names(self, name: str, side: str | None) -> bool:
        return fnmatchcase(name, self.figure) and self.side in (None, side)

    def _exceeded(self, row: Change) -> bool:
        return abs(row.difference) > self.amount * (abs(row.a) if self.relative else 1.0)

    def concerns(self, comparison: ComparisonResult) -> bool:
        """Whether the comparison has any figure of this rule."""
        return any(self._names(row.name, row.side) for row in comparison.changes) or any(
            self._names(PROJECTION, item.side) for item in comparison.projection
        )

    def failing(self, comparison: ComparisonResult) -> list[str]:
        """The changes that fail this rule, by name."""
        rows = [
            " ".join(part for part in (row.side, row.name, row.where) if part)
            for row in comparison.changes
            if row.changed and self._names(row.name, row.side) and self._exceeded(row)
        ]
        projections = [
            f"{item.side} {PROJECTION}"
            for item in comparison.projection
            if item.changed
            and self._names(PROJECTION, item.side)
            and item.difference_px > (0.0 if self.relative else self.amount)
        ]
        return rows + projections


def failing(comparison: ComparisonResult, rules: Sequence[FailRule]) -> list[str]:
    """The changes that fail any rule, by name. Raises InputError for a rule that concerns no figure of the comparison: a misspelt name,
    or a figure that one of the two fits lacks, would never fail."""
    for rule in rules:
        if not rule.concerns(comparison):
            raise InputError(
                f"--fail-on {rule.figure!r}: no such figure in both; `calibench compare A B --all` lists those that are compared"
            )
    return list(dict.fromkeys(name for rule in rules for name in rule.failing(comparison)))
