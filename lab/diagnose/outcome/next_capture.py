"""The capture that would best tell rivals apart.

Every capture that could be taken is predicted under each rival, at the parameters that the recordings give it. The best
capture c is the one in which the two nearest rivals k, l lie furthest apart:

    argmax over c of min over k, l of D,   D = 1/2 |L^-1 (m_k(c) - m_l(c))|^2,   L L' = covariance of m(c)

The covariance holds noise, floors and nuisance parameters. Two rivals are then told apart with
probability Phi(sqrt(D / 2)). So captures are listed in the report; `lab/resolve.py` chooses by what they tell a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import ndtr

from lab.capture.plan import CapturePlan
from lab.diagnose.outcome.expected_information import Forecast, settling_probability
from lab.diagnose.policy import DecisionPolicy
from lab.diagnose.visibility import visibility
from lab.formats.results import NextCapture
from lab.inference.posterior import NAMED
from sim.camera import Side
from sim.effects.library import effects as library

#: What to vary where no predicted capture tells two effects apart, but one depends on a condition and the other
#: doesn't; and the kind of capture in which it has to show (None: any; `LIT`: any with light).
LIT = "light"
SETTLING: dict[str, tuple[str, str | None]] = {
    "f_number": ("the slanted edges again at twice the f-number", "slanted_edge"),
    "wavelength": ("slanted edges in narrowband light, at 450 and at 650 nm", "slanted_edge"),
    "orientation": (
        "slanted edges at four orientations, 5, 50, 95 and 140 degrees from the vertical",
        "slanted_edge",
    ),
    "exposure": ("the same captures at a quarter of the exposure and four times the light", LIT),
    "level": ("the same captures at a quarter of the light", LIT),
    "field": ("the same captures at the corners of the field", LIT),
    "time": ("the same captures again, in the reverse order", None),
}


#: Between the effects of a rival that is a set of them, and the name of one without any.
WITH, NOTHING = " with ", "none"


#: A rival without an effect, in a sentence.
NO_EFFECT = "no further effect"


@dataclass(frozen=True)
class OpenCapture:
    """A capture that may tell rivals apart: what they predict of it, and the sequence that takes it (None: no sequence
    does; `needs` says what is lacking then)."""

    words: str
    forecast: Forecast
    plan: CapturePlan | None
    needs: str


@dataclass(frozen=True)
class Doubt:
    """The rivals of one side, their probabilities, which sum to 1, and what could be captured to tell them apart."""

    side: Side
    rivals: tuple[str, ...]
    odds: tuple[float, ...]
    captures: tuple[OpenCapture, ...]

    def listed(self, policy: DecisionPolicy) -> tuple[NextCapture, ...]:
        """Return the captures in which the two nearest rivals lie furthest apart, the best first."""
        found = []
        for capture in self.captures:
            apart = capture.forecast.distances()
            pairs = {(k, l): float(apart[k, l]) for k, l in combinations(range(len(self.rivals)), 2)}  # noqa: E741
            one, other = min(pairs, key=lambda pair: pairs[pair])
            distance = pairs[one, other]
            found.append(
                NextCapture(
                    side=self.side,
                    capture=capture.words,
                    rivals=(self.rivals[one], self.rivals[other]),
                    distance=distance,
                    told_apart=float(ndtr(np.sqrt(0.5 * distance))),
                    settles=round(settling_probability([capture.forecast], self.odds, NAMED), 3),
                )
            )
        found.sort(key=lambda item: -item.distance)
        # a capture that neither rival changes tells nothing: an f-number for darks
        found = [item for item in found if item.distance >= policy.next_capture_least_distance] or found[:1]
        return tuple(found[: policy.next_captures_listed])


def next_sentence(found: Sequence[NextCapture], settling: str | None, policy: DecisionPolicy) -> str | None:
    """Return the best capture of all sides as a sentence. `settling`: what to capture for a mismatch that is left
    without a name."""
    if not found:
        return settling
    best = max(found, key=lambda one: one.distance)
    one, other = best.rivals
    told, told_other = (NO_EFFECT if n == NOTHING else n for n in sorted(best.rivals, key=lambda n: n == NOTHING))
    sigma = f"{np.sqrt(2.0 * best.distance):.1f}"
    if best.distance >= policy.next_capture_distance:
        return (
            f"{best.capture[0].upper()}{best.capture[1:]} would tell {told} from {told_other}: their predictions lie "
            f"{sigma} standard deviations apart there, which decides rightly in "
            f"{100 * min(best.told_apart, 0.999):.3g} % of all cases."
        )
    beyond = f"no capture that can be predicted tells {told} from {told_other} by more than {sigma} standard deviations"
    steady_by = {name: _invariances(name) for name in (one, other)}
    for thing, (capture, kind) in SETTLING.items():
        if thing in steady_by[one] ^ steady_by[other]:
            steady, moving = (one, other) if thing in steady_by[one] else (other, one)
            if any(_shows_in(effect, kind) for effect in moving.split(WITH)):
                why = f"{moving} changes" if steady == NOTHING else f"only {steady} stays the same"
                return f"{capture[0].upper()}{capture[1:]} may tell them apart ({beyond}): {why}."
    return f"{beyond[0].upper()}{beyond[1:]}: both depend on the same things."


def _invariances(rival: str) -> frozenset[str]:
    """Return what none of a rival's effects depends on; of a rival without effects, everything."""
    kinds = [library()[name] for name in rival.split(WITH) if name in library()]
    return frozenset(SETTLING).intersection(*(kind.invariances for kind in kinds))


def _shows_in(effect: str, kind: str | None) -> bool:
    """Return whether an effect shows in captures of a kind."""
    kinds = set(visibility()[effect].capture_kinds) if effect in visibility() else set()
    return kind is None or bool(kinds - {"dark"} if kind == LIT else kinds & {kind})
