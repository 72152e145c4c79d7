"""False names: what a diagnosis names besides what is there.

`python -m evaluation names --out DIR`. Four classes of cameras, each with seeds of its own:

- `bench`: quick sessions of the default mock bench over the wire, with another pair of cameras each. Its two filters
  and the column
  offsets of both cameras are there, and nothing else.
- `healthy`: cameras of the second image former that do what their data sheet says.
- `strong`: cameras of the former with one strong effect, its law varied, and nothing else. What the nearest law of the
  library lacks
  beside it is no second effect.
- `blur`: cameras of the former with a low-pass filter of 0.4 to 1.0 px, charge diffusion, or a smaller aperture: is it
  an anti-alias
  filter?

Each case leaves DIR/results/CASE.json; a case whose result is there is not run again.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from evaluation.draw import DrawnFrame, draw, recordings_of
from evaluation.independent_simulator import LISTED, ConcealedCamera, Law, Plan
from evaluation.live import commit, session_of
from evaluation.score import Rate, families_of
from evaluation.truth import load, store
from lab.errors import InputError
from lab.formats.recording_set import RecordingSet
from lab.formats.results import DiagnosisResult
from sim.effects.library import effects as library
from sim.parameters import Frozen

Kind = Literal["bench", "healthy", "strong", "blur"]
#: Non-centrality from which on a concealed effect has to be named.
LEAST_VISIBLE = 1000.0
#: How many cases of each class there are, and the most of them that may have a false name; the fewest right names of
#: `blur`.
COUNTS: dict[Kind, int] = {"bench": 60, "healthy": 150, "strong": 150, "blur": 60}
MOST_FALSE: dict[Kind, int] = {"bench": 0, "healthy": 1, "strong": 1, "blur": 0}
LEAST_RIGHT_BLUR = 0.95
#: Seed of the former's cameras here: one of tuning, as no strength is fitted to it.
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


class NameRun(Frozen):
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
    commit: str = ""
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
    used = {"wall_s": time.monotonic() - began_s, "cpu_s": time.process_time() - cpu_s, "commit": commit()}
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


def run_all(out: Path, kinds: tuple[Kind, ...], most: int | None) -> dict[str, NameRun]:
    """Case -> result, the classes in turn: from OUT/results where it exists, else run now."""
    runs: dict[str, NameRun] = {}
    for number in range(1, max(COUNTS.values()) + 1):
        for kind in kinds:
            if number > min(COUNTS[kind], most or COUNTS[kind]):
                continue
            name = case_name(kind, number)
            file = out / "results" / f"{name}.json"
            if file.exists():
                runs[name] = load(NameRun, file)
                continue
            folder = out / "session" / name
            try:
                runs[name] = run_case(kind, number, folder)
            finally:
                shutil.rmtree(folder, ignore_errors=True)
            store(runs[name], file)
            one = runs[name]
            said = f"false: {', '.join(one.false)}" if one.false else "no false name"
            print(
                f"{name}: {one.verdict}, {said}, missing {', '.join(one.missing) or 'none'}, {one.cpu_s:.0f} s",
                flush=True,
            )
    return runs


def table(runs: dict[str, NameRun]) -> str:
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


def prove(out: Path, only: Sequence[str] | None, most: int | None) -> bool:
    """Count false names on the classes `only` (None: all), with `most` cases of each at most, and print a table.

    Returns whether no class has too many. Raises InputError for a class that there is not.
    """
    unknown = sorted(set(only or ()) - set(get_args(Kind)))
    if unknown:
        raise InputError(f"--only {unknown[0]}: no such class; there are {', '.join(get_args(Kind))}")
    kinds = tuple(kind for kind in COUNTS if not only or kind in only)
    runs = run_all(out, kinds, most)
    print(table(runs))
    counts = {kind: sum(bool(r.false) for n, r in runs.items() if n.startswith(f"{kind}-")) for kind in kinds}
    return all(counts[kind] <= MOST_FALSE[kind] for kind in kinds)
