"""False names: what a diagnosis names besides what is there.

`python -m evaluation names --out DIR`. Four classes of cameras, each with seeds of its own:

- `bench`: quick sessions of the default mock bench over the wire, with another pair of cameras each. Its two filters
  and the column offsets of both cameras are there, and nothing else.
- `healthy`: cameras of the independent simulator that do what their data sheet says.
- `strong`: cameras of the simulator with one strong effect, its law varied, and nothing else. What the nearest law of
  the library lacks beside it is no second effect.
- `blur`: cameras of the simulator with a low-pass filter of 0.4 to 1.0 px, charge diffusion, or a smaller aperture: is
  it an anti-alias filter?

Each case leaves DIR/results/CASE.json; a case whose result is there is not run again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from evaluation.draw import DrawnFrame, draw, recordings_of
from evaluation.experiment import CaseResult, Experiment, ScoredExperiment
from evaluation.independent_simulator import LISTED, ConcealedCamera, Law, Plan
from evaluation.live import session_of
from evaluation.score import Rate, families_of
from lab.errors import InputError
from lab.formats.recording_set import RecordingSet
from lab.formats.results import DiagnosisResult
from sim.effects.library import effects as library

Kind = Literal["bench", "healthy", "strong", "blur"]
#: Non-centrality from which on a concealed effect has to be named.
LEAST_VISIBLE = 1000.0
#: How many cases of each class there are, and the most of them that may have a false name; the fewest right names of
#: `blur`.
COUNTS: dict[Kind, int] = {"bench": 60, "healthy": 150, "strong": 150, "blur": 60}
MOST_FALSE: dict[Kind, int] = {"bench": 0, "healthy": 1, "strong": 1, "blur": 0}
LEAST_RIGHT_BLUR = 0.95
#: Seed of the simulator's cameras here: one of tuning, as no strength is fitted to it.
SEED = 7341
#: Name and side of what the default bench conceals.
OF_THE_BENCH = frozenset(
    {
        ("optical_low_pass_filter", "left"),
        ("infrared_cut_filter", "left"),
        ("column_noise", "left"),
        ("column_noise", "right"),
    }
)
#: Ranges of the blurs in pixels: displacement, drift, change of the aperture's side over its side.
FILTER_PX, DRIFT_PX, SIDE_CHANGE = (0.4, 1.0), (0.15, 0.4), (0.1, 0.35)
BLUR_ROWS, BLUR_COLS = 192, 256


class NameRun(CaseResult):
    """The names of one case. `false`: names, with the side, that nothing concealed gives; `missing`: what is concealed
    and has no name; `noncentrality`: of what is concealed, where it was measured (some laws can't be made strong enough
    for a small frame)."""

    case: str
    concealed: tuple[str, ...] = ()
    verdict: str = ""
    named: tuple[str, ...] = ()
    false: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    noncentrality: float | None = None
    cpu_s: float = 0.0
    wall_s: float = 0.0


def run_case(kind: Kind, number: int, folder: Path) -> NameRun:
    """Run case `number` (from 1 on) of a class. `folder` holds the session of a bench while it is diagnosed."""
    from lab.diagnose import diagnose

    began_s, cpu_s = time.monotonic(), time.process_time()
    if kind == "bench":
        found = session_of(("--seed", str(1000 + number)), folder)
        run = _judged(found, OF_THE_BENCH, {})
    else:
        made = MADE[kind](number)
        run = _judged(diagnose(made.recordings, at_once=False), made.wanted, made.right_besides)
        run = run.model_copy(update={"noncentrality": made.noncentrality})
    used = {"wall_s": time.monotonic() - began_s, "cpu_s": time.process_time() - cpu_s}
    return run.model_copy(update={"case": case_name(kind, number)} | used)


def case_name(kind: Kind, number: int) -> str:
    """Return the name of a case."""
    return f"{kind}-{number:03d}"


def _judged(
    found: DiagnosisResult, wanted: frozenset[tuple[str, str]], right_besides: dict[str, frozenset[str]]
) -> NameRun:
    """Judge a diagnosis. `wanted`: (name, side) of what is concealed; `right_besides`: by such a name, others that are
    right in its place: families, and effects that describe it as well."""
    named = {(e.name, side) for e in found.effects for side in e.sides}
    sides = {side for _, side in wanted} or {"left"}
    stands_for = {
        (other, side): (name, side) for name, others in right_besides.items() for other in others for side in sides
    }
    told = named | {stands_for[one] for one in named if one in stands_for}
    false = {one for one in named if one not in wanted and one not in stands_for}
    return NameRun(
        case="",
        concealed=tuple(sorted(f"{name} ({side})" for name, side in wanted)),
        verdict=found.verdict,
        named=tuple(sorted(f"{name} ({side})" for name, side in named)),
        false=tuple(sorted(f"{name} ({side})" for name, side in false)),
        missing=tuple(sorted(f"{name} ({side})" for name, side in wanted - told)),
    )


@dataclass(frozen=True)
class Made:
    """A drawn camera's recordings. `wanted` and `right_besides`: as of `_judged`; `noncentrality`: of what is
    concealed, where it was measured."""

    recordings: RecordingSet
    wanted: frozenset[tuple[str, str]] = frozenset()
    right_besides: dict[str, frozenset[str]] = field(default_factory=dict)
    noncentrality: float | None = None


def _healthy(number: int) -> Made:
    return Made(draw(SEED, number, "foreign", kind="healthy").recordings)


def _strong(number: int) -> Made:
    case = draw(SEED, number, "foreign", kind="single", sizing="strong")
    one = case.truth.concealed[0]
    besides = frozenset(case.truth.accepts) | families_of(one)
    wanted = frozenset({(one.effect, "left")} if one.effect is not None else set())
    return Made(case.recordings, wanted, {one.effect or one.name: besides}, one.noncentrality)


def blur_law(number: int, pitch_um: float, side_um: float) -> Law:
    """Return the blur of a case: filters, diffusions and apertures in turn, of drawn size and form."""
    rng, laws = np.random.default_rng([SEED, number, 3]), {law.name: law for law in LISTED}
    if number % 3 == 1:
        return laws["optical_low_pass_filter"](pitch_um * rng.uniform(*FILTER_PX), int(rng.integers(2)))
    if number % 3 == 2:
        return laws["charge_diffusion"](pitch_um * rng.uniform(*DRIFT_PX), int(rng.integers(3)))
    aperture = laws["pixel_aperture"]
    smaller = next(
        s for s in range(100) if aperture(1.0, 0, s).sign < 0.0
    )  # seed of an aperture that is smaller than stated
    return aperture(side_um * rng.uniform(*SIDE_CHANGE), int(rng.integers(3)), smaller)


def _blur(number: int) -> Made:
    seed = SEED + 1000 * number
    bare = ConcealedCamera(seed)
    law = blur_law(number, bare.pitch_um, bare.pitch_um * bare.fill_factor**0.5)
    frame = DrawnFrame.drawn(np.random.default_rng([SEED, number, 4]))
    plan = Plan(screen_cell_px=frame.screen_cell_px, screen_turn_deg=frame.screen_turn_deg)
    camera = ConcealedCamera(seed, [law], rows=BLUR_ROWS, cols=BLUR_COLS)
    name = str(law.effect)
    return Made(
        recordings_of(camera, plan),
        frozenset({(name, "left")}),
        {name: frozenset({library()[name].family.value})},
    )


MADE: dict[Kind, Callable[[int], Made]] = {"healthy": _healthy, "strong": _strong, "blur": _blur}


def table(runs: Mapping[str, NameRun]) -> str:
    """Return the outcome by class as a Markdown table, with every false name below it."""
    lines = [
        "| class | cases | with a false name | most | all that is concealed named |",
        "| --- | --- | --- | --- | --- |",
    ]
    for kind, count in COUNTS.items():
        of = [run for name, run in runs.items() if name.startswith(f"{kind}-")]
        if of:
            visible = [run for run in of if run.noncentrality is None or run.noncentrality > LEAST_VISIBLE]
            false, whole = Rate.over(bool(run.false) for run in of), Rate.over(not run.missing for run in visible)
            lines.append(
                f"| {kind} | {len(of)} of {count} | {false.count} | {MOST_FALSE[kind]} | {whole.count} of {whole.of} |"
            )
    for name, run in sorted(runs.items()):
        if run.false:
            lines.append(f"\n{name} ({', '.join(run.concealed) or 'healthy'}): {', '.join(run.false)}.")
    return "\n".join(lines)


@dataclass(frozen=True)
class NamesExperiment(Experiment[tuple[Kind, int], NameRun]):
    """False names on cameras of the classes `kinds`, `most` of each at most."""

    result = NameRun

    kinds: tuple[Kind, ...] = tuple(COUNTS)
    most: int | None = None

    @classmethod
    def of(cls, only: Sequence[str] | None, most: int | None) -> NamesExperiment:
        """Return that on the classes of these names, all without any. Raises InputError for one that there is not."""
        unknown = sorted(set(only or ()) - set(COUNTS))
        if unknown:
            raise InputError(f"--only {unknown[0]}: no such class; there are {', '.join(COUNTS)}")
        return cls(tuple(kind for kind in COUNTS if not only or kind in only), most)

    def draw(self) -> dict[str, tuple[Kind, int]]:
        """Return class and number of each case, the classes in turn."""
        counts = {kind: min(COUNTS[kind], self.most or COUNTS[kind]) for kind in self.kinds}
        numbers = range(1, max(counts.values()) + 1)
        return {
            case_name(kind, number): (kind, number)
            for number in numbers
            for kind in self.kinds
            if number <= counts[kind]
        }

    def diagnose(self, case: tuple[Kind, int], folder: Path) -> NameRun:
        """Record and diagnose a camera."""
        return run_case(*case, folder)

    def describe(self, run: NameRun) -> str:
        """Return the false and the missing names of a case."""
        false = f"false: {', '.join(run.false)}" if run.false else "no false name"
        return f"{run.verdict}, {false}, missing {', '.join(run.missing) or 'none'}, {run.cpu_s:.0f} s"

    def score(self, runs: Mapping[str, NameRun]) -> ScoredExperiment:
        """Return the false names by class; reached where no class has too many."""
        counts = {kind: sum(bool(r.false) for n, r in runs.items() if n.startswith(f"{kind}-")) for kind in self.kinds}
        reached = all(count <= MOST_FALSE[kind] for kind, count in counts.items())
        return ScoredExperiment("names", table(runs), reached=reached)
