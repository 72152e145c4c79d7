"""Effects' names as a laboratory writes them, for sentences and pages; results and commands keep the identifiers."""

from __future__ import annotations

from sim.effects.families import Family
from sim.effects.library import effects as library


def effect_title(name: str) -> str:
    """Return an effect's or a family's identifier as words, as they stand within a sentence."""
    if name in set(Family):
        return Family(name).words
    kind = library().get(name)
    return (kind.title if kind is not None else "") or name.replace("_", " ")


def at_beginning(words: str) -> str:
    """Words as they stand at the beginning of a sentence; capitals within stay."""
    return words[:1].upper() + words[1:]
