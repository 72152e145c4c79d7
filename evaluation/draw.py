"""Cases of the blind proof: drawn cameras, the laws that they conceal, at which strength, and faults of metadata or
rig."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from evaluation.independent_simulator import (
    BIT_DEPTH,
    LISTED,
    OUTSIDE,
    WAVELENGTH_NM,
    WHOLE_SESSION,
    ConcealedCamera,
    DrawnSession,
    Law,
    Plan,
    record,
    record_pair,
)
from evaluation.noncentrality import FairStrength, Summaries, fair_strengths, library_changes, noncentrality, summaries
from evaluation.rig_errors import RigErrors
from evaluation.truth import SIZES, CaseTruth, Concealed, Kind
from lab.formats.recording_set import Manifest, RecordingSet
from sim.spectrum import Spectrum

# --- Faults of metadata or rig around a healthy camera: mismatches that no effect explains ----------------------------


Spoil = Callable[[dict[str, Any], dict[str, Any], dict[str, Any], np.random.Generator], None]


@dataclass(frozen=True)
class CaseFault:
    """One fault. `spoil` changes manifest, frames and spectra in place; `accepts`: effects whose name is right for
    it."""

    name: str
    spoil: Spoil
    accepts: tuple[str, ...] = ()
    colour_only: bool = False


def spoilt(session: DrawnSession, fault: CaseFault, rng: np.random.Generator) -> DrawnSession:
    """Return a copy of a session with the fault."""
    manifest, frames, spectra = deepcopy(session.manifest), dict(session.frames), dict(session.spectra)
    fault.spoil(manifest, frames, spectra, rng)
    return replace(session, manifest=manifest, frames=frames, spectra=spectra)


def _misstated(key: str, factor: Callable[[np.random.Generator], float]) -> Spoil:
    def spoil(manifest: dict[str, Any], _frames: Any, _spectra: Any, rng: np.random.Generator) -> None:
        camera = manifest["cameras"]["left"]
        camera[key] = float(camera[key] * factor(rng))

    return spoil


def _exposure_unit(manifest: dict[str, Any], _frames: Any, _spectra: Any, _rng: np.random.Generator) -> None:
    for capture in manifest["captures"]:
        if capture["kind"] == "flat":
            capture["exposure_s"] *= 1000.0


def _cfa_phase(manifest: dict[str, Any], _frames: Any, _spectra: Any, _rng: np.random.Generator) -> None:
    camera = manifest["cameras"]["left"]
    camera["cfa"] = {"RGGB": "GRBG", "GRBG": "RGGB", "BGGR": "GBRG", "GBRG": "BGGR"}[camera["cfa"]]


def _wavelength_axis(manifest: dict[str, Any], _frames: Any, spectra: dict[str, Any], rng: np.random.Generator) -> None:
    offset_nm = float(rng.choice([-8.0, 8.0]))
    for path in manifest["cameras"]["left"]["quantum_efficiency"].values():
        spectra[path] = np.interp(WAVELENGTH_NM - offset_nm, WAVELENGTH_NM, spectra[path])


def _frames_of(manifest: dict[str, Any], kind: str) -> list[str]:
    return [c["frame"] for c in manifest["captures"] if c["kind"] == kind]


def _lamp_out(manifest: dict[str, Any], frames: dict[str, Any], _spectra: Any, rng: np.random.Generator) -> None:
    flats, darks = _frames_of(manifest, "flat"), _frames_of(manifest, "dark")
    frames[str(rng.choice(flats[6:]))] = frames[darks[0]].copy()


def _frames_swapped(manifest: dict[str, Any], frames: dict[str, Any], _spectra: Any, rng: np.random.Generator) -> None:
    sweep = _frames_of(manifest, "narrowband")
    i = int(rng.integers(8, 18))
    frames[sweep[i]], frames[sweep[i + 2]] = frames[sweep[i + 2]], frames[sweep[i]]


def _stale_frame(manifest: dict[str, Any], frames: dict[str, Any], _spectra: Any, rng: np.random.Generator) -> None:
    sweep = _frames_of(manifest, "narrowband")
    i = int(rng.integers(6, 20))
    frames[sweep[i]] = frames[sweep[i - 1]].copy()


FAULTS: tuple[CaseFault, ...] = (
    CaseFault(
        "f_number_misstated", _misstated("f_number", lambda rng: float(rng.choice([0.7, 1.4]))), ("other_f_number",)
    ),
    CaseFault("exposure_unit", _exposure_unit),
    CaseFault("black_level_misstated", _misstated("black_level_dn", lambda rng: 1.25)),
    CaseFault("pitch_misstated", _misstated("pixel_pitch_um", lambda rng: float(rng.choice([0.8, 1.25])))),
    CaseFault("focal_length_misstated", _misstated("focal_length_mm", lambda rng: 0.6), ("vignetting",)),
    CaseFault("cfa_phase_swapped", _cfa_phase, colour_only=True),
    CaseFault("wavelength_axis_shifted", _wavelength_axis, ("wavelength_offset",)),
    CaseFault("lamp_out", _lamp_out),
    CaseFault("frames_swapped", _frames_swapped),
    CaseFault("stale_frame", _stale_frame),
)


# --- Sessions of the independent simulator as recording sets ----------------------------------------------------------


def recordings_of(camera: ConcealedCamera, plan: Plan = WHOLE_SESSION) -> RecordingSet:
    """Return the recording set of one camera."""
    return recording_set(record(camera, plan))


def recordings_of_pair(left: ConcealedCamera, right: ConcealedCamera, plan: Plan) -> RecordingSet:
    """Return the recording set of a stereo pair."""
    return recording_set(record_pair(left, right, plan))


def recording_set(session: DrawnSession) -> RecordingSet:
    """Return the recording set of a session; raises ValidationError where its manifest doesn't follow the format."""
    spectra = {path: Spectrum.of(WAVELENGTH_NM, values) for path, values in session.spectra.items()}
    manifest = Manifest.model_validate(session.manifest)
    # every field is written, null where it is unknown
    manifest = Manifest.model_validate(manifest.model_dump(mode="json"))
    return RecordingSet(manifest, dict(session.frames), spectra, dict(session.targets), source=manifest.name)


#: Of twenty cases: 30 % healthy, 35 % one effect, 15 % two, 20 % outside the library.
SHARES: tuple[tuple[Kind, int], ...] = (("healthy", 6), ("single", 7), ("compound", 3), ("outside", 4))
FOREIGN_FRAMES = ((24, 32), (48, 64), (96, 128), (192, 256), (384, 512))
FOREIGN_SHARES = (0.1, 0.2, 0.35, 0.25, 0.1)  # probabilities of these frames
FOREIGN_BITS = (8, 10, 12, 14, 16)
WEAK, STRONG = (10.0, 50.0), (50.0, 2000.0)  # ranges of the target non-centrality, each in half of the cases
INVISIBLE = 1.0  # non-centrality below which the strength isn't adjusted
SIZING_ROUNDS, SIZING_FACTOR = 3, 1.6  # most adjustments of the strength; tolerated factor to the target non-centrality
FAULT_SHARE = 0.35  # share of faults among the cases outside the library
MUCH = (1500.0, 30000.0)  # the same of laws that nobody overlooks
Sizing = Literal["aimed", "strong", "nominal", "unmeasured"]


@dataclass(frozen=True)
class Case:
    """A recording set and its concealed truth."""

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
        """Return a frame unlike those of tuning: 24 to 384 rows, 8 to 16 bit, screen cells of 2 to 6 px, rotated by 0
        to 2 degrees.

        In a third of the cases cells are a whole number of pixels and aren't rotated, as a careful laboratory sets a
        screen up."""
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
    seed: int, index: int, size: str = "medium", *, cfa: str | None = None, kind: Kind | None = None,
    law: type[Law] | None = None, sizing: Sizing = "aimed", rig: RigErrors | None = None
) -> Case:  # fmt: skip
    """Return case number `index` of a seed; the same arguments give the same case.

    cfa, kind, law    None: drawn
    sizing            "aimed": laws get the strength that gives a drawn non-centrality. "strong": the same of one draw
    of the noise, far
                      above what is needed to see them. "nominal": they have their nominal strength, and the
                      non-centrality is taken from one draw of the noise, which is quick and too high. "unmeasured":
                      they have their nominal strength, and 0 stands for the non-centrality
    rig       errors of chart and radiometer; None: they have none
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
    if rig is not None:
        plan = replace(plan, chart=rig.reflectances, reading=rig.reading)
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

    @lru_cache(maxsize=4)  # the session that was measured last is the one returned
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
    elif sizing == "strong":
        found = _sized(take, laws, [float(np.exp(rng.uniform(*np.log(MUCH)))) for _ in laws], (0, 0), None)
    elif sizing == "aimed":
        found = _sized(take, laws, targets, (0, 1), (accepted, np.random.default_rng([seed, index, 1])))
    session = take(tuple(found.laws), 0)
    if fault is not None:
        session = spoilt(session, fault, rng)
    concealed = tuple(
        Concealed(
            name=one.name, effect=one.listed_effect, variant=one.variant, strength=one.strength, unit=one.unit,
            parameters=one.library_parameters(), noncentrality=size, conditional=fair.conditional,
            separability=fair.separability,
            nearest_rival=fair.rival,
        )
        for one, size, fair in zip(found.laws, found.noncentrality, found.fair, strict=True)
    )  # fmt: skip
    truth = CaseTruth(
        kind=what, concealed=concealed, fault=fault.name if fault else None, accepts=tuple(sorted(accepted)),
        oracle_share=found.oracle_share, cfa=healthy.cfa, f_number=healthy.f_number,
        frames=len(session.manifest["captures"]), rows=rows, cols=cols,
    )  # fmt: skip
    return Case(recording_set(session), truth)


def kind_of(seed: int, index: int) -> Kind:
    """Kind of case number `index` (from 1 on): every twenty hold the whole mix."""
    deck = [name for name, count in SHARES for _ in range(count)]
    order = np.random.default_rng([seed, 1000 + (index - 1) // len(deck)]).permutation(len(deck))
    return deck[order[(index - 1) % len(deck)]]


def _card(seed: int, which: int, index: int, count: int) -> int:
    """Item number `index` of a sequence of random permutations of `count` items: all occur before one occurs again."""
    return int(np.random.default_rng([seed, 2000 + which, index // count]).permutation(count)[index % count])


class _Dealer:
    """Chooses the laws of a case among those that its camera can have, each equally often over the cases of a kind."""

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
    """Return the law at another strength, within its limits."""
    low, high = law.limits
    return type(law)(float(np.clip(strength, low, high)), law.variant, law.seed)


@dataclass(frozen=True)
class _Sized:
    """Concealed laws at their strengths."""

    laws: list[Law]
    noncentrality: list[float]  # of each
    fair: list[FairStrength]  # of each
    oracle_share: float | None  # of the case


def _sized(
    take: Callable[[tuple[Law, ...], int], DrawnSession],
    laws: list[Law],
    targets: list[float],
    draws: tuple[int, int],
    against: tuple[Collection[str], np.random.Generator] | None,
) -> _Sized:
    """Laws at strengths near the target non-centralities; of two laws, near target conditional non-centralities.

    `take`: draws the session with given laws and a number of the draw of the noise; `draws`: the two numbers.
    `against`: names that are no rivals, and the oracle's random numbers; None: only the non-centralities are measured.
    """
    if not laws:
        return _Sized([], [], [], None)

    @lru_cache(maxsize=4)
    def both(present: tuple[Law, ...]) -> list[Summaries | None]:
        found = {k: summaries(recording_set(take(present, k))) for k in set(draws)}
        return [found[k] for k in draws]

    def shown(present: list[Summaries | None], absent: list[Summaries | None]) -> float:
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
        if max(ratios) > SIZING_FACTOR:  # stronger by the part that the other law imitates
            laws = [
                _resized(one, one.strength * min(max(ratio, 1.0) ** (0.5 / one.power), 10.0))
                for one, ratio in zip(laws, ratios, strict=True)
            ]
            whole, without = both(tuple(laws)), _without(both, laws)
            fair, oracle = fair_strengths(whole, without, library, effects, accepts, rng)
    return _Sized(laws, [shown(whole, absent) for absent in without], fair, oracle)


def _without(
    both: Callable[[tuple[Law, ...]], list[Summaries | None]], laws: list[Law]
) -> list[list[Summaries | None]]:
    """Return the summaries without each of the laws."""
    return [both(tuple(one for one in laws if one is not law)) for law in laws]
