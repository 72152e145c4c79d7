"""The mix of a challenge: cameras, what they conceal and how strongly, and what is stated wrongly of them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from lab.challenge.faults import FAULTS, spoilt
from lab.challenge.noncentrality import FairStrength, fair_strengths, library_changes, noncentrality, summaries
from lab.challenge.recordings import recording_set
from lab.challenge.truth import CaseTruth, Concealed, Kind
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.formats.recording_set import RecordingSet
from mocks.former import BIT_DEPTH, LISTED, OUTSIDE, ConcealedCamera, DrawnSession, Law, Plan, record

#: (rows, cols) of frames by the name of their size; None: each case has a frame of its own, see `DrawnFrame.drawn`.
SIZES: dict[str, tuple[int, int] | None] = {
    "small": (96, 128),
    "medium": (192, 256),
    "full": (384, 512),
    "foreign": None,
}
#: Of twenty cases: 30 % healthy, 35 % one effect, 15 % two, 20 % outside the library.
SHARES: tuple[tuple[Kind, int], ...] = (("healthy", 6), ("single", 7), ("compound", 3), ("outside", 4))
FOREIGN_FRAMES = ((24, 32), (48, 64), (96, 128), (192, 256), (384, 512))
FOREIGN_SHARES = (0.1, 0.2, 0.35, 0.25, 0.1)
FOREIGN_BITS = (8, 10, 12, 14, 16)
WEAK, STRONG = (10.0, 50.0), (50.0, 2000.0)  # non-centralities aimed at, half of the cases each
INVISIBLE = 1.0  # a non-centrality below which no strength is searched
SIZING_ROUNDS, SIZING_FACTOR = 3, 1.6  # attempts to reach the non-centrality aimed at, and how near is near enough
FAULT_SHARE = 0.35  # of the cases outside the library
Sizing = Literal["aimed", "nominal", "unmeasured"]


@dataclass(frozen=True)
class Case:
    """A recording set and what it conceals."""

    recordings: RecordingSet
    truth: CaseTruth


@dataclass(frozen=True)
class DrawnFrame:
    """A camera's frame, its converter, and how a screen stands before it."""

    rows: int
    cols: int
    bit_depth: int = BIT_DEPTH
    screen_cell_px: float = Plan.screen_cell_px
    screen_turn_deg: float = Plan.screen_turn_deg

    @staticmethod
    def drawn(rng: np.random.Generator) -> DrawnFrame:
        """One that the tool was not tuned on: tiny and large frames, 8 to 16 bit, screens of 2 to 6 px a cell, turned by 0 to 2 degrees; cells of
        integral numbers of pixels that stand straight, as a careful laboratory sets a screen up, in a third of the cases."""
        rows, cols = FOREIGN_FRAMES[int(rng.choice(len(FOREIGN_FRAMES), p=FOREIGN_SHARES))]
        aligned = rng.random() < 1.0 / 3.0
        return DrawnFrame(
            rows=rows,
            cols=cols,
            bit_depth=int(rng.choice(FOREIGN_BITS)),
            screen_cell_px=float(rng.integers(2, 7)) if aligned else float(rng.uniform(2.0, 6.0)),
            screen_turn_deg=0.0 if aligned else float(rng.uniform(0.0, 2.0)),
        )


def draw(
    seed: int, index: int, size: str = "medium", *, cfa: str | None = None, kind: Kind | None = None, law: type[Law] | None = None, sizing: Sizing = "aimed"
) -> Case:  # fmt: skip
    """Case number `index` of a challenge; the same arguments give the same case.

    cfa, kind, law    None: drawn
    sizing            "aimed": laws get the strength that gives a drawn non-centrality. "nominal": the nominal strength, and a non-centrality from
                      one draw of the noise, which is quick and too high. "unmeasured": the nominal strength, and 0 for the non-centrality
    """
    rng = np.random.default_rng([seed, index])
    what = kind or kind_of(seed, index)
    of_size = SIZES[size]
    frame = DrawnFrame.drawn(np.random.default_rng([seed, index, 2])) if of_size is None else DrawnFrame(*of_size)
    rows, cols = frame.rows, frame.cols
    camera_seed = int(rng.integers(1, 2**31))
    plan = Plan(
        lights=bool(rng.random() < 0.3),
        warm=bool(rng.random() < 0.4),
        shuttle=bool(rng.random() < 0.4),
        exposures=bool(rng.random() < 0.3),
        screen_cell_px=frame.screen_cell_px,
        screen_turn_deg=frame.screen_turn_deg,
    )
    healthy = ConcealedCamera(camera_seed, cfa=cfa, rows=rows, cols=cols)
    dealer = _Dealer(seed, index, rng, healthy.cfa)
    laws: list[Law] = []
    fault = None
    if what in {"single", "compound"}:
        laws = dealer.laws(LISTED if law is None else (law,), 1 if what == "single" else 2)
    elif what == "outside":
        if law is None and rng.random() < FAULT_SHARE:
            able = [f for f in FAULTS if healthy.cfa != "MONO" or not f.colour_only]
            fault = able[_card(seed, 3, index, len(able))]
        else:
            laws = dealer.laws(OUTSIDE if law is None else (law,), 1)
    drop = "chart" if rng.random() < 0.15 else "screen" if rng.random() < 0.15 else ""
    if laws and any(drop in one.shown_by or (drop == "screen" and "checkerboard" in one.shown_by) for one in laws):
        drop = ""
    kinds = tuple(k for k in plan.kinds if k != drop)
    plan = replace(plan, kinds=kinds, warm=plan.warm or any(one.needs == "temperature" for one in laws))

    @lru_cache(maxsize=4)  # what was measured last is what is handed out
    def take(present: tuple[Law, ...], noise_draw: int) -> DrawnSession:
        camera = ConcealedCamera(
            camera_seed, present, cfa=cfa, rows=rows, cols=cols, noise_draw=noise_draw, bit_depth=frame.bit_depth
        )
        return record(camera, plan)

    targets = [float(np.exp(rng.uniform(*np.log(WEAK if rng.random() < 0.5 else STRONG)))) for _ in laws]
    accepted = {*(fault.accepts if fault else ()), *(a for one in laws for a in one.accepts)}
    found = _Sized(laws, [0.0] * len(laws), [FairStrength(None, None, None) for _ in laws], None)
    if sizing == "nominal":
        found = _sized(take, laws, [], (0, 0), None)
    elif sizing == "aimed":
        found = _sized(take, laws, targets, (0, 1), (accepted, np.random.default_rng([seed, index, 1])))
    session = take(tuple(found.laws), 0)
    if fault is not None:
        session = spoilt(session, fault, rng)
    concealed = tuple(
        Concealed(
            name=one.name, effect=one.listed_effect, variant=one.variant, strength=one.strength, unit=one.unit,
            parameters=one.library_parameters(), noncentrality=size, conditional=fair.conditional, separability=fair.separability,
            nearest_rival=fair.rival,
        )
        for one, size, fair in zip(found.laws, found.noncentrality, found.fair, strict=True)
    )  # fmt: skip
    truth = CaseTruth(
        kind=what, concealed=concealed, fault=fault.name if fault else None, accepts=tuple(sorted(accepted)), oracle_share=found.oracle_share, cfa=healthy.cfa, f_number=healthy.f_number,
        frames=len(session.manifest["captures"]), rows=rows, cols=cols,
    )  # fmt: skip
    return Case(recording_set(session), truth)


def kind_of(seed: int, index: int) -> Kind:
    """Kind of case number `index` (from 1 on): every twenty hold the whole mix."""
    deck = [name for name, count in SHARES for _ in range(count)]
    order = np.random.default_rng([seed, 1000 + (index - 1) // len(deck)]).permutation(len(deck))
    return deck[order[(index - 1) % len(deck)]]


def _card(seed: int, which: int, index: int, count: int) -> int:
    """Card number `index` of shuffled decks of `count`, one after the other: every card comes before one comes twice."""
    return int(np.random.default_rng([seed, 2000 + which, index // count]).permutation(count)[index % count])


class _Dealer:
    """Deals laws that a case's camera can have."""

    def __init__(self, seed: int, index: int, rng: np.random.Generator, cfa: str) -> None:
        self.rng, self.mono, self.seed = rng, cfa == "MONO", seed
        # laws are dealt over the cases of this kind, not over all cases
        kinds = [kind_of(seed, i) for i in range(1, index + 1)]
        self.count_of_kind = kinds.count(kinds[-1])

    def laws(self, pool: Sequence[type[Law]], count: int) -> list[Law]:
        able = [one for one in pool if one.needs not in ({"bayer"} if self.mono else {"mono"})] or list(pool)
        kinds = [able[_card(self.seed, 1 + len(pool) + 100 * count, self.count_of_kind, len(able))]]
        while len(kinds) < count:
            other = able[int(self.rng.integers(len(able)))]
            if other.effect != kinds[0].effect:
                kinds.append(other)
        return [k(k.nominal, int(self.rng.integers(k.variants)), int(self.rng.integers(2**31))) for k in kinds]


def _resized(law: Law, strength: float) -> Law:
    low, high = law.limits
    return type(law)(float(np.clip(strength, low, high)), law.variant, law.seed)


@dataclass(frozen=True)
class _Sized:
    """Laws at their strengths, and how strongly and how distinctly each shows."""

    laws: list[Law]
    noncentrality: list[float]
    fair: list[FairStrength]
    oracle_share: float | None


def _sized(
    take: Callable[[tuple[Law, ...], int], DrawnSession],
    laws: list[Law],
    targets: list[float],
    draws: tuple[int, int],
    against: tuple[Collection[str], np.random.Generator] | None,
) -> _Sized:
    """Laws at the strengths that come near the non-centralities aimed at; of two, near the conditional ones. `against`: names that are no rivals, and
    the noise of the oracle; None: only the non-centralities are measured."""
    if not laws:
        return _Sized([], [], [], None)

    @lru_cache(maxsize=4)
    def both(present: tuple[Law, ...]) -> list[MeasurementModel | None]:
        found = {k: summaries(recording_set(take(present, k))) for k in set(draws)}
        return [found[k] for k in draws]

    def shown(present: list[MeasurementModel | None], absent: list[MeasurementModel | None]) -> float:
        return noncentrality(list(zip(present, absent, strict=True)))

    none = both(())
    for i, target in enumerate(targets):
        for _ in range(SIZING_ROUNDS):
            size = shown(both((laws[i],)), none)
            if size < INVISIBLE or target / SIZING_FACTOR < size < SIZING_FACTOR * target:
                break
            ratio = float(np.clip((target / size) ** (0.5 / laws[i].power), 0.1, 10.0))
            laws[i] = _resized(laws[i], laws[i].strength * ratio)
    whole, without = both(tuple(laws)), _without(both, laws)
    fair, oracle = [FairStrength(None, None, None) for _ in laws], None
    if against is not None:
        accepts, rng = against
        effects = [one.listed_effect for one in laws]
        library = library_changes(none[0])
        fair, oracle = fair_strengths(whole, without, library, effects, accepts, rng)
        ratios = [t / max(f.conditional or t, INVISIBLE) for t, f in zip(targets, fair, strict=True)]
        if max(ratios) > SIZING_FACTOR:  # what one imitates of the other doesn't count
            laws = [
                _resized(one, one.strength * min(max(ratio, 1.0) ** (0.5 / one.power), 10.0))
                for one, ratio in zip(laws, ratios, strict=True)
            ]
            whole, without = both(tuple(laws)), _without(both, laws)
            fair, oracle = fair_strengths(whole, without, library, effects, accepts, rng)
    return _Sized(laws, [shown(whole, absent) for absent in without], fair, oracle)


def _without(
    both: Callable[[tuple[Law, ...]], list[MeasurementModel | None]], laws: list[Law]
) -> list[list[MeasurementModel | None]]:
    """The summaries without each of the laws."""
    return [both(tuple(one for one in laws if one is not law)) for law in laws]
