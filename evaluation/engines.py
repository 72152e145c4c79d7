"""The evidence engine and today's diagnosis on the same recordings: names, probabilities, time."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evaluation.draw import recordings_of
from evaluation.independent_simulator import LISTED, OUTSIDE, UNLISTED, ConcealedCamera, Law
from evaluation.own_chain import healthy_session
from lab.diagnose import diagnose
from lab.errors import InputError
from lab.fit import fit_recording_set
from lab.formats.recording_set import RecordingSet, read
from lab.inference.check import HeldOutCheck, check_held_out, passes
from lab.inference.posterior import Posterior, Verdict, healthy_nothing, read_table, verdict
from lab.inference.recordings import measure_side, search_side
from lab.inference.restated import examine_side
from lab.inference.search import Table
from sim.camera import Side

#: Draws behind the threshold of `no_mismatch`, and the share of healthy cameras below it.
DRAWS, RATE = 100, 0.01
#: Frames of the independent simulator, px.
ROWS, COLS = 192, 256
#: Statements that are listed: at least this probable.
LISTED_PROBABILITY = 0.02


@dataclass(frozen=True)
class Outcome:
    """What the evidence engine says of one side, and the CPU seconds of fit and summaries, and from there to the table.

    `least_nothing`: the p(nothing) that 1 % of healthy draws fall short of. `wrong`: statements that are, in
    sentences."""

    side: Side
    said: Verdict
    posterior: Posterior
    table: Table
    checked: tuple[HeldOutCheck, ...]
    least_nothing: float
    summaries_s: float
    search_s: float
    wrong: tuple[str, ...] = ()


def ask(recordings: RecordingSet, side: Side) -> Outcome | None:
    """Run the evidence engine on one side; None where nothing can be measured."""
    searched_at: list[float] = []
    begin = time.process_time()
    examined = examine_side(
        recordings, side, fit_recording_set,
        report=lambda step: searched_at.append(time.process_time()) if step.startswith("searching") else None,
    )  # fmt: skip
    if examined.searched is None:
        return None
    problem, search, table = examined.searched.problem, examined.searched.search, examined.searched.table
    done, measured = time.process_time(), searched_at[-1]
    posterior = read_table(table, search.hypotheses)
    least = healthy_nothing(search, DRAWS, RATE, np.random.default_rng(1288))
    checked = check_held_out(problem, search, table)
    said = verdict(posterior, least, passes(checked))
    wrong = tuple(one.check for one in examined.wrong)
    return Outcome(side, said, posterior, table, checked, least, measured - begin, done - measured, wrong)


def lines(outcome: Outcome) -> Iterator[str]:
    """Write an outcome as lines of text."""
    table, posterior = outcome.table, outcome.posterior
    named = ", ".join(f"{f.name} ({f.kind}) {f.probability:.4f}" for f in posterior.named) or "nothing"
    yield f"  {outcome.side}: {outcome.said}; named: {named}"
    yield from (f"    wrong metadata: {line}" for line in outcome.wrong)
    undecided = ", undecided" if table.is_undecided else ""
    yield (
        f"    p(nothing) {posterior.nothing:.4f} (1 % of healthy draws below {outcome.least_nothing:.3f}); "
        f"{table.refits} refits; never refitted {table.left:.4f}{undecided}, "
        f"closed form alone {table.closed_form:.3f}; log p(y) {table.log_evidence:.1f}; "
        f"CPU {outcome.summaries_s:.1f} s to the summaries, {outcome.search_s:.1f} s to the table"
    )
    for row in table.rows[:5]:
        members = ", ".join(sorted(row.members)) or "none"
        groups = f"; unlisted: {', '.join(table.states(row.unlisted))}" if row.unlisted else ""
        yield f"    {row.probability:.4f}  {members}{groups}{'' if row.refitted else ' (closed form)'}"
    for kind in ("effect", "family", "unlisted"):
        found = [f for f in posterior.findings if f.kind == kind and f.probability > LISTED_PROBABILITY]
        if found:
            yield f"    {kind}: " + ", ".join(f"{f.name} {f.probability:.3f}" for f in found)
    for name, sizes in posterior.sizes.items():
        words = [
            f"{s.parameter} {s.mean:.4g} +- {s.std:.2g}" + " (not determined)" * (not s.is_determined) for s in sizes
        ]
        law = f"; its law is inexact with p {posterior.inexact[name]:.2f}" if posterior.inexact[name] > 0.5 else ""
        yield f"    size of {name}: {', '.join(words)}{law}"
    total, count = sum(c.chi2 for c in outcome.checked), sum(c.n for c in outcome.checked)
    against = ", ".join(f"{c.measurement} chi2 {c.chi2:.1f} of {c.n}" for c in outcome.checked if c.contradicts)
    yield f"    held out: chi2 {total:.0f} of {count}; contradicted by: {against or 'none'}"


def recordings_named(name: str) -> RecordingSet:
    """Return the recordings of a folder; of `own:SEED`, the healthy session of the forward model; or of
    `former:LAW:VARIANT:STRENGTH:SEED`, a session of the independent simulator with one law (`former:healthy:SEED` for
    none). Raises InputError."""
    kind, _, rest = name.partition(":")
    if kind not in ("own", "former"):
        return read(Path(name))
    law, *numbers = rest.split(":") if kind == "former" else ("", rest)
    wanted = (int,) if law in ("", "healthy") else (int, float, int)
    try:
        values = [convert(number) for convert, number in zip(wanted, numbers, strict=True)]
    except ValueError:
        raise InputError(
            f"{name}: isn't own:SEED, former:healthy:SEED or former:LAW:VARIANT:STRENGTH:SEED; give numbers, as "
            "former:defocus:0:1.5:21"
        ) from None
    seed = int(values[-1])
    if not law:
        return healthy_session([seed])
    laws = () if law == "healthy" else (_law(law)(float(values[1]), int(values[0])),)
    return recordings_of(ConcealedCamera(seed, laws, rows=ROWS, cols=COLS))


def _law(name: str) -> type[Law]:
    for law in (*LISTED, *OUTSIDE, *UNLISTED):
        if law.name == name:
            return law
    known = ", ".join(sorted(law.name for law in (*LISTED, *OUTSIDE, *UNLISTED)))
    raise InputError(f"law {name!r}: isn't known; choose one of {known}")


#: Factors to all everyday scales by which the names must not change, and the share of sides in which they may.
FACTORS, MOST_CHANGED = (0.5, 2.0), 0.02


def vary_scales(names: Sequence[str]) -> Iterator[str]:
    """Yield, by side, what is named with all everyday scales as declared, halved and doubled; at the end the share of
    repeats whose names differ."""
    repeats = changed = 0
    for name in names:
        recordings = recordings_named(name)
        for side in recordings.sides:
            problem = measure_side(recordings, side, fit_recording_set)
            if problem is None:
                continue
            named = {}
            for factor in (1.0, *FACTORS):
                search, table = search_side(problem, everyday=factor)
                named[factor] = frozenset(f.name for f in read_table(table, search.hypotheses).named)
            differ = sum(named[factor] != named[1.0] for factor in FACTORS)
            repeats, changed = repeats + len(FACTORS), changed + differ
            words = "; ".join(f"x {f:g}: {', '.join(sorted(own)) or 'nothing'}" for f, own in named.items())
            yield f"{name} {side}: {words}{' (changed)' * (differ > 0)}"
    share = changed / max(repeats, 1)
    yield f"names changed in {changed} of {repeats} repeats ({100 * share:.1f} %; at most {100 * MOST_CHANGED:.0f} %)"


def compare(names: Sequence[str], *, with_diagnosis: bool) -> Iterator[str]:
    """Run the evidence engine on recordings, and, `with_diagnosis`, today's diagnosis."""
    for name in names:
        recordings = recordings_named(name)
        yield name
        for side in recordings.sides:
            outcome = ask(recordings, side)
            yield from (f"  {side}: nothing can be measured",) if outcome is None else lines(outcome)
        if with_diagnosis:
            begin = time.process_time()
            result = diagnose(recordings, fit_recording_set(recordings), at_once=False)
            named = ", ".join(f"{e.name} {e.probability:.4f}" for e in result.effects) or "nothing"
            yield f"  today: {result.verdict}; named: {named}; CPU {time.process_time() - begin:.1f} s with the fit"
