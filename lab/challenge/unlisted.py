"""The cases of a proof of discovery: cameras that conceal a law of no list, alone or beside a listed effect, and
healthy ones.

They are sealed and diagnosed as the cases of the other proof. What differs is what is drawn (`draw_unlisted`, here) and
what counts (`lab.challenge.unlisted_score`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import TypeVar

import numpy as np

from lab.challenge.along_axis import separability_along
from lab.challenge.draw import Case, recording_set
from lab.challenge.noncentrality import noncentrality, summaries
from lab.challenge.truth import SIZES, CaseTruth, Concealed
from lab.errors import InputError
from mocks.former import LISTED, UNLISTED, ConcealedCamera, DrawnSession, Law, Plan, UnlistedLaw, record

#: Of every block of cases: each law once, as many healthy cameras.
BLOCK = 2 * len(UNLISTED)
#: Of twenty laws, so many stand beside a listed effect; others in each block.
BESIDE = 4
#: Listed effects that stand beside a law; none of them acts along the axes of one.
COMPANIONS: tuple[type[Law], ...] = tuple(
    law
    for law in LISTED
    if law.name
    in {"optical_low_pass_filter", "defocus", "infrared_cut_filter", "veiling_glare", "hot_pixels", "vignetting"}
)
TARGETS, COMPANION_TARGETS = (10.0, 600.0), (100.0, 1000.0)  # ranges of separability, and of non-centrality
SIZING_ROUNDS, SIZING_FACTOR = 6, 1.3
COMPANION_ROUNDS = 2  # its summaries take long, and its strength is of no account
#: Captures of which means need no others: they come first in a session.
UNIFORM = ("dark", "flat", "narrowband")
MOSAICS = ("RGGB", "BGGR", "GRBG", "GBRG", "MONO")
GOLDEN = 0.5 * (5.0**0.5 - 1.0)
AnyLaw = TypeVar("AnyLaw", bound=Law)
Take = Callable[[tuple[Law, ...], int], DrawnSession]


def concealed_in(seed: int, index: int) -> tuple[type[UnlistedLaw] | None, bool]:
    """Return the law of case number `index` (from 1 on), None of a healthy camera, and whether it stands beside a
    listed effect. Every block holds each law once, and in `len(UNLISTED) / BESIDE` blocks each stands beside one
    once."""
    block, place = divmod(index - 1, BLOCK)
    number = int(np.random.default_rng([seed, 3000, block]).permutation(BLOCK)[place])
    if number >= len(UNLISTED):
        return None, False
    turn = int(np.random.default_rng([seed, 3001]).permutation(len(UNLISTED))[number]) // BESIDE
    return UNLISTED[number], turn == block % (len(UNLISTED) // BESIDE)


def target_of(seed: int, index: int) -> float:
    """Return the separability that the law of a case is drawn for. Over the blocks a law's are spread evenly in the
    logarithm, by steps of the golden ratio."""
    law, _ = concealed_in(seed, index)
    first = np.random.default_rng([seed, 3002, 0 if law is None else UNLISTED.index(law)]).random()
    low, high = TARGETS
    return float(low * (high / low) ** ((first + GOLDEN * ((index - 1) // BLOCK)) % 1.0))


def draw_unlisted(
    seed: int, index: int, size: str = "medium", *, cfa: str | None = None, law: type[UnlistedLaw] | None = None
) -> Case:
    """Case number `index`; the same arguments give the same case. `cfa`, `law`: None: as drawn. Raises InputError for a
    size that has no one frame."""
    kind, beside = (law, False) if law is not None else concealed_in(seed, index)
    rng = np.random.default_rng([seed, index, 4])
    frame = SIZES[size]
    if frame is None:
        raise InputError(f"size {size!r}: laws of no list are sized for one frame; take small, medium or full")
    camera_seed, mosaic = int(rng.integers(1, 2**31)), str(rng.choice(MOSAICS))
    if kind is not None and kind.needs == "bayer" and mosaic == "MONO":
        mosaic = MOSAICS[int(rng.integers(4))]
    mosaic = cfa or mosaic
    lights, warm, shuttle, exposures = (bool(rng.random() < share) for share in (0.3, 0.4, 0.4, 0.3))
    drop = "chart" if rng.random() < 0.15 else "screen" if rng.random() < 0.15 else ""
    kinds = tuple(k for k in Plan.kinds if k != drop)
    plan = Plan(kinds=kinds, lights=lights, warm=warm, shuttle=shuttle, exposures=exposures)

    def camera(present: tuple[Law, ...] = (), noise_draw: int = 0) -> ConcealedCamera:
        return ConcealedCamera(camera_seed, present, cfa=mosaic, rows=frame[0], cols=frame[1], noise_draw=noise_draw)

    @lru_cache(maxsize=6)
    def take(present: tuple[Law, ...], noise_draw: int) -> DrawnSession:
        return record(camera(present, noise_draw), plan)

    @lru_cache(maxsize=6)
    def take_uniform(present: tuple[Law, ...], noise_draw: int) -> DrawnSession:
        return record(camera(present, noise_draw), replace(plan, kinds=UNIFORM))

    laws: list[Law] = []
    concealed: list[Concealed] = []
    if kind is not None:
        first = kind(kind.nominal, int(rng.integers(kind.variants)), int(rng.integers(2**31)))
        bare = camera()
        quick = take_uniform if kind.acts in {"offset", "factor"} else take

        def plain(one: UnlistedLaw) -> float:
            return separability_along(one, bare, [(quick((one,), k), quick((), k)) for k in (0, 1)])

        found, _ = sized(first, plain, target_of(seed, index))
        laws.append(found)
        if beside:
            other = COMPANIONS[int(rng.integers(len(COMPANIONS)))]
            companion = other(other.nominal, int(rng.integers(other.variants)), int(rng.integers(2**31)))
            wanted = float(np.exp(rng.uniform(*np.log(COMPANION_TARGETS))))
            laws.append(sized(companion, lambda one: _shown(take, (one,), ()), wanted, COMPANION_ROUNDS)[0])
        whole = tuple(laws)
        for one in laws:
            others = tuple(law for law in whole if law is not one)
            separability, shown = None, take
            if isinstance(one, UnlistedLaw):
                pairs = [(quick(whole, k), quick(others, k)) for k in (0, 1)]
                separability, shown = separability_along(one, bare, pairs), take_uniform
            concealed.append(
                Concealed(
                    name=one.name,
                    effect=one.listed_effect,
                    variant=one.variant,
                    strength=one.strength,
                    unit=one.unit,
                    parameters=one.library_parameters(),
                    noncentrality=_shown(shown, whole, others),
                    separability=separability,
                )
            )
    session = take(tuple(laws), 0)
    truth = CaseTruth(
        kind="healthy" if not laws else "outside" if len(laws) == 1 else "compound",
        concealed=tuple(concealed),
        accepts=tuple(sorted({name for one in laws for name in one.accepts})),
        cfa=mosaic,
        f_number=camera().f_number,
        frames=len(session.manifest["captures"]),
        rows=frame[0],
        cols=frame[1],
    )
    return Case(recording_set(session), truth)


def sized(
    law: AnyLaw, measured: Callable[[AnyLaw], float], target: float, rounds: int = SIZING_ROUNDS
) -> tuple[AnyLaw, float]:
    """Return the law at the strength at which it measures about the target, within its limits and after so many
    `rounds` at most, and what it measures there."""
    size = measured(law)
    low, high = law.limits
    for _ in range(rounds):
        if target / SIZING_FACTOR < size < SIZING_FACTOR * target:
            break
        # below 0.1 rounding is measured
        ratio = float(np.clip((target / max(size, 0.1)) ** (0.5 / law.power), 0.1, 10.0))
        strength = float(np.clip(law.strength * ratio, low, high))
        if strength == law.strength:
            break
        law = type(law)(strength, law.variant, law.seed)
        size = measured(law)
    return law, size


def _shown(take: Take, present: tuple[Law, ...], absent: tuple[Law, ...]) -> float:
    """Return the non-centrality of a change in the diagnosis's own summaries."""
    pairs = [tuple(summaries(recording_set(take(laws, k))) for laws in (present, absent)) for k in (0, 1)]
    return noncentrality([(one, other) for one, other in pairs])
