"""The mix of a challenge: which cameras, what they conceal and how strongly, and what is stated wrongly of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lab.challenge.truth import Concealed, Kind, Truth
from lab.formats.recording_set import Manifest, RecordingSet
from sim.spectrum import Spectrum

from .camera import Camera, Plan
from .laws import LISTED, OUTSIDE, Law
from .power import Evidence, evidence, noncentrality

SIZES = {"small": (96, 128), "medium": (192, 256), "full": (384, 512)}
#: Of twenty cases: 30 % healthy, 35 % one effect, 15 % two, 20 % outside the library.
SHARES: tuple[tuple[Kind, int], ...] = (("healthy", 6), ("single", 7), ("compound", 3), ("outside", 4))
NEAR, STRONG = (10.0, 50.0), (50.0, 2000.0)  # non-centralities aimed at, half of the cases each
BLIND = 1.0  # a non-centrality below which a strength isn't worth searching
FAULT_SHARE = 0.35  # of the cases outside the library


@dataclass(frozen=True)
class Fault:
    """Something stated wrongly, or a mishap on the rig; `accepts`: names that mean the same."""

    name: str
    spoil: Callable[[dict[str, Any], dict[str, Any], dict[str, Spectrum], np.random.Generator], None]
    accepts: tuple[str, ...] = ()
    colour_only: bool = False


def _camera(key: str, factor: Callable[[np.random.Generator], float]) -> Callable[..., None]:
    def spoil(
        manifest: dict[str, Any], frames: dict[str, Any], spectra: dict[str, Spectrum], rng: np.random.Generator
    ) -> None:
        camera = manifest["cameras"]["left"]
        camera[key] = float(camera[key] * factor(rng))

    return spoil


def _exposures(
    manifest: dict[str, Any], frames: dict[str, Any], spectra: dict[str, Spectrum], rng: np.random.Generator
) -> None:
    for capture in manifest["captures"]:
        if capture["kind"] == "flat":
            capture["exposure_s"] *= 1000.0


def _cfa(
    manifest: dict[str, Any], frames: dict[str, Any], spectra: dict[str, Spectrum], rng: np.random.Generator
) -> None:
    camera = manifest["cameras"]["left"]
    camera["cfa"] = {"RGGB": "GRBG", "GRBG": "RGGB", "BGGR": "GBRG", "GBRG": "BGGR"}[camera["cfa"]]


def _curves(
    manifest: dict[str, Any], frames: dict[str, Any], spectra: dict[str, Spectrum], rng: np.random.Generator
) -> None:
    off = float(rng.choice([-8.0, 8.0]))
    for path in manifest["cameras"]["left"]["quantum_efficiency"].values():
        w, value = spectra[path].arrays
        spectra[path] = Spectrum.of(w, np.interp(w - off, w, value))


def _frames_of(manifest: dict[str, Any], kind: str) -> list[str]:
    return [c["frame"] for c in manifest["captures"] if c["kind"] == kind]


def _lamp_out(
    manifest: dict[str, Any], frames: dict[str, Any], spectra: dict[str, Spectrum], rng: np.random.Generator
) -> None:
    flats, darks = _frames_of(manifest, "flat"), _frames_of(manifest, "dark")
    frames[str(rng.choice(flats[6:]))] = frames[darks[0]].copy()


def _swapped(
    manifest: dict[str, Any], frames: dict[str, Any], spectra: dict[str, Spectrum], rng: np.random.Generator
) -> None:
    sweep = _frames_of(manifest, "narrowband")
    i = int(rng.integers(8, 18))
    frames[sweep[i]], frames[sweep[i + 2]] = frames[sweep[i + 2]], frames[sweep[i]]


def _stale(
    manifest: dict[str, Any], frames: dict[str, Any], spectra: dict[str, Spectrum], rng: np.random.Generator
) -> None:
    sweep = _frames_of(manifest, "narrowband")
    i = int(rng.integers(6, 20))
    frames[sweep[i]] = frames[sweep[i - 1]].copy()


FAULTS: tuple[Fault, ...] = (
    Fault("f_number_misstated", _camera("f_number", lambda rng: float(rng.choice([0.7, 1.4])))),
    Fault("exposure_unit", _exposures),
    Fault("black_level_misstated", _camera("black_level_dn", lambda rng: 1.25)),
    Fault("pitch_misstated", _camera("pixel_pitch_um", lambda rng: float(rng.choice([0.8, 1.25])))),
    Fault("focal_length_misstated", _camera("focal_length_mm", lambda rng: 0.6), ("vignetting",)),
    Fault("cfa_phase_swapped", _cfa, colour_only=True),
    Fault("wavelength_axis_shifted", _curves, ("wavelength_offset",)),
    Fault("lamp_out", _lamp_out),
    Fault("frames_swapped", _swapped),
    Fault("stale_frame", _stale),
)


@dataclass(frozen=True)
class Case:
    """A recording set and what it conceals."""

    recordings: RecordingSet
    truth: Truth


def draw(
    seed: int,
    index: int,
    size: str = "medium",
    *,
    cfa: str | None = None,
    kind: Kind | None = None,
    law: type[Law] | None = None,
    sized: bool = True,
) -> Case:
    """Case number `index` of a challenge. The same arguments give the same case; `cfa`, `kind`, `law`: not as drawn; without
    `sized`, laws have their nominal strengths, and their non-centralities are of one draw of the noise: quick, and too high."""
    rng = np.random.default_rng([seed, index])
    what = kind or kind_of(seed, index)
    rows, cols = SIZES[size]
    camera_seed = int(rng.integers(1, 2**31))
    plan = Plan(
        lights=bool(rng.random() < 0.3),
        warm=bool(rng.random() < 0.4),
        shuttle=bool(rng.random() < 0.4),
        exposures=bool(rng.random() < 0.3),
    )
    first = Camera(camera_seed, cfa=cfa, rows=rows, cols=cols)
    pick = _Picker(seed, index, rng, first.cfa, plan)
    laws: list[Law] = []
    fault = None
    if what in {"single", "compound"}:
        laws = pick.laws(LISTED if law is None else (law,), 1 if what == "single" else 2)
    elif what == "outside":
        if law is None and rng.random() < FAULT_SHARE:
            able = [f for f in FAULTS if first.cfa != "MONO" or not f.colour_only]
            fault = able[_deck(seed, 3, index, len(able))]
        else:
            laws = pick.laws(OUTSIDE if law is None else (law,), 1)
    drop = "chart" if rng.random() < 0.15 else "screen" if rng.random() < 0.15 else ""
    if laws and any(drop in one.shown_by or (drop == "screen" and "checkerboard" in one.shown_by) for one in laws):
        drop = ""
    plan = Plan(
        tuple(k for k in plan.kinds if k != drop),
        plan.lights,
        plan.warm or any(one.needs == "temperature" for one in laws),
        plan.shuttle,
        plan.exposures,
    )

    def take(present: Sequence[Law], noise_draw: int = 0) -> RecordingSet:
        return Camera(camera_seed, present, cfa=cfa, rows=rows, cols=cols, noise_draw=noise_draw).record(plan)

    targets = [float(np.exp(rng.uniform(*np.log(NEAR if rng.random() < 0.5 else STRONG)))) for _ in laws]
    chosen, sizes = _sized(take, laws, targets if sized else [], (0, 1) if sized else (0, 0))
    recordings = take(chosen)
    recordings = _copied(recordings, fault, rng)  # healthy ones too: what is written has the same form for all
    concealed = tuple(
        Concealed(
            name=one.name,
            effect=one.effect,
            variant=one.v,
            strength=one.s,
            unit=one.unit,
            parameters=one.stated(),
            noncentrality=size_,
        )
        for one, size_ in zip(chosen, sizes, strict=True)
    )
    accepts = sorted({*(fault.accepts if fault else ()), *(a for one in chosen for a in one.accepts)})
    return Case(
        recordings,
        Truth(kind=what, concealed=concealed, fault=fault.name if fault else None, accepts=tuple(accepts), cfa=first.cfa, f_number=first.n,
              frames=len(recordings.manifest.captures), rows=rows, cols=cols),
    )  # fmt: skip


def kind_of(seed: int, index: int) -> Kind:
    """Which kind of case number `index` (from 1 on) is: every twenty hold the whole mix."""
    deck = [name for name, count in SHARES for _ in range(count)]
    order = np.random.default_rng([seed, 1000 + (index - 1) // len(deck)]).permutation(len(deck))
    return deck[order[(index - 1) % len(deck)]]


def _deck(seed: int, which: int, index: int, count: int) -> int:
    """Card number `index` of shuffled decks laid one behind the other: every card comes before one comes twice."""
    return int(np.random.default_rng([seed, 2000 + which, index // count]).permutation(count)[index % count])


class _Picker:
    """Laws for a case that its camera and plan can have."""

    def __init__(self, seed: int, index: int, rng: np.random.Generator, cfa: str, plan: Plan) -> None:
        self.rng, self.mono = rng, cfa == "MONO"
        # the how-manieth case of its kind this is: laws are dealt over these, not over all cases
        kinds = [kind_of(seed, i) for i in range(1, index + 1)]
        self.turn, self.seed = kinds.count(kinds[-1]), seed

    def laws(self, pool: Sequence[type[Law]], count: int) -> list[Law]:
        able = [one for one in pool if one.needs not in ({"bayer"} if self.mono else {"mono"})] or list(pool)
        first = _deck(self.seed, 1 + len(pool) + 100 * count, self.turn, len(able))
        kinds = [able[first]]
        while len(kinds) < count:
            other = able[int(self.rng.integers(len(able)))]
            if other.effect != kinds[0].effect:
                kinds.append(other)
        return [k(k.nominal, int(self.rng.integers(k.variants)), int(self.rng.integers(2**31))) for k in kinds]


def _resized(law: Law, strength: float) -> Law:
    low, high = law.limits
    return type(law)(float(np.clip(strength, low, high)), law.v, law.seed)


def _sized(
    take: Callable[[Sequence[Law], int], RecordingSet], laws: list[Law], targets: list[float], draws: tuple[int, int]
) -> tuple[list[Law], list[float]]:
    """Laws at the strengths that give the wanted non-centralities, and what these are in the end."""
    if not laws:
        return [], []

    def both(present: Sequence[Law]) -> list[Evidence | None]:
        found = {k: evidence(take(present, k)) for k in set(draws)}
        return [found[k] for k in draws]

    def shown(present: list[Evidence | None], absent: list[Evidence | None]) -> float:
        return noncentrality(list(zip(present, absent, strict=True)))

    none = both(())
    for i, target in enumerate(targets):
        for _ in range(3):
            size = shown(both((laws[i],)), none)
            if size < BLIND or target / 1.6 < size < 1.6 * target:
                break  # the summaries are blind to it, or it is near enough
            ratio = float(np.clip((target / size) ** (0.5 / laws[i].power), 0.1, 10.0))
            laws[i] = _resized(laws[i], laws[i].s * ratio)
    whole = both(laws)
    without = [none] if len(laws) == 1 else [both([one for one in laws if one is not law]) for law in laws]
    return laws, [shown(whole, absent) for absent in without]


def _copied(recordings: RecordingSet, fault: Fault | None, rng: np.random.Generator) -> RecordingSet:
    manifest = recordings.manifest.model_dump(mode="json")
    frames = {
        c["frame"]: recordings.frame(k) for c, k in zip(manifest["captures"], recordings.manifest.captures, strict=True)
    }
    paths = {c["radiance"] for c in manifest["captures"] if c.get("radiance")} | set(
        manifest["cameras"]["left"]["quantum_efficiency"].values()
    )
    paths |= {c["light_radiance"] for c in manifest["captures"] if c.get("light_radiance")}
    paths |= {c["screen"]["radiance"] for c in manifest["captures"] if c.get("screen")}
    spectra = {path: recordings.spectrum(path) for path in paths}
    targets = {c["target"]: recordings.target(c["target"]) for c in manifest["captures"] if c.get("target")}
    if fault is not None:
        fault.spoil(manifest, frames, spectra, rng)
    return RecordingSet(Manifest.model_validate(manifest), frames, spectra, targets, source=recordings.source)
