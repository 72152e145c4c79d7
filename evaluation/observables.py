"""Calibration of the observables: does each scatter about its prediction as its covariance says?

On healthy cameras the residual r = y - m of an observable has the distribution N(0, S + J J'), J the Jacobian by the
nuisance parameters per prior standard deviation. A parameter whose prior is wide against the noise takes its direction
out of r, whatever the truth is; these directions are projected out, and

    chi2 = r' C^-1 r ~ chi2_n

remains with n directions. Over many sets the mean of chi2 / n is 1 within its standard error, and the probability
integral transform F(chi2; n) is uniform (Kolmogorov-Smirnov, Holm over the observables). Below 1, the covariance is too
wide and hides departures; above 1, it is too narrow and makes departures of noise.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.special import chdtr
from scipy.stats import kstest

from evaluation.draw import draw
from evaluation.own_chain import healthy_session
from evaluation.rig_errors import RigErrors
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.side_model import measurement_model
from lab.fit import fit_recording_set
from lab.formats.recording_set import RecordingSet
from lab.observables.observable import measurements
from sim.spectrum import FloatArray

#: Seed of the sets: one for development.
SEED = 4711
#: Eigenvalue of the correlation matrix below which a direction is rounding alone.
LEAST_EIGENVALUE = 1e-6
#: Width of a nuisance parameter's prior, over the noise in its direction, from which on the direction is projected out.
FREE = 2.0
#: Probability by chance, over all observables of a table, that one is marked.
CHANCE = 0.01


def of_second_simulator(number: int) -> RecordingSet:
    """Return healthy set `number` of the second simulator, of a rig within its tolerances."""
    size = "small" if number % 2 else "medium"
    return draw(SEED, number, size, kind="healthy", sizing="unmeasured", rig=RigErrors(SEED, number)).recordings


#: Healthy sets by the simulator that draws them.
SOURCES: dict[str, Callable[[int], RecordingSet]] = {
    "own chain": lambda number: healthy_session([SEED, number]),
    "second simulator": of_second_simulator,
}


@dataclass(frozen=True)
class Calibrated:
    """One observable of one healthy set; `observable` "all": all of them together."""

    source: str
    set: int
    observable: str
    chi2: float
    n: int


def calibrate(file: Path, sets: int, sources: Sequence[str]) -> list[Calibrated]:
    """Return the results of `sets` healthy sets of each source. Those in `file` aren't measured again."""
    found = list(_kept(file))
    done = {(one.source, one.set) for one in found}
    for number in range(1, sets + 1):
        for source in sources:
            if (source, number) in done:
                continue
            own = list(_of_set(source, number))
            with file.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps([asdict(one) for one in own]) + "\n")
            found += own
    return [one for one in found if one.set <= sets and one.source in sources]


def _kept(file: Path) -> Iterator[Calibrated]:
    if file.exists():
        for line in file.read_text(encoding="utf-8").splitlines():
            yield from (Calibrated(**one) for one in json.loads(line))


@dataclass(frozen=True)
class Scatter:
    """How the numbers of one observable scatter about their prediction; "all": those of all together.

    `chi2` of `n` directions: without those that wide nuisance parameters take. `pull`: the mean of the numbers, each
    over its standard deviation, over that mean's standard deviation, nuisance parameters in it.
    """

    observable: str
    chi2: float
    n: int
    pull: float


def scatter(model: MeasurementModel) -> Iterator[Scatter]:
    """Yield the scatter of every observable of a model about the prediction without effects, and of all together."""
    away = model.value - model.mean()
    nuisances = np.reshape(list(model.nuisance_jacobian().values()), (-1, len(away))).T
    white, own = [], []
    for block, at in zip(model.blocks, model.slices, strict=True):
        whiten = _whitening(block.covariance)
        white.append(whiten @ away[at])
        own.append(whiten @ nuisances[at])
        yield Scatter(
            block.measurement.name, *_chi2(white[-1], own[-1]), _pull(away[at], block.covariance, nuisances[at])
        )
    yield Scatter("all", *_chi2(np.concatenate(white), np.concatenate(own)), float("nan"))


def _pull(away: FloatArray, covariance: FloatArray, nuisances: FloatArray) -> float:
    weight = 1.0 / np.sqrt(np.diag(covariance) + np.sum(np.square(nuisances), axis=1))
    return float(weight @ away / np.sqrt(weight @ covariance @ weight + np.sum(np.square(weight @ nuisances))))


def _of_set(source: str, number: int) -> Iterator[Calibrated]:
    """Yield chi2 and n of every observable of the left camera, and of all together."""
    recordings = SOURCES[source](number)
    model, _ = measurement_model(recordings, "left", fit_recording_set(recordings))
    for one in scatter(model) if model is not None else ():
        yield Calibrated(source, number, one.observable, one.chi2, one.n)


def _whitening(covariance: FloatArray) -> FloatArray:
    """Return W (k, n) with W S W' = 1, S the covariance (n, n), without the directions that are rounding alone."""
    std = np.sqrt(np.diag(covariance))
    size, direction = np.linalg.eigh(covariance / np.outer(std, std))
    use = size > LEAST_EIGENVALUE
    return np.asarray((direction[:, use] / np.sqrt(size[use])).T / std)


def _chi2(white: FloatArray, nuisances: FloatArray) -> tuple[float, int]:
    """Return chi2 and its number of directions: of whitened residuals (k,), with the whitened Jacobian (k, p) by
    nuisance parameters."""
    direction, size, _ = np.linalg.svd(nuisances, full_matrices=False)
    along = direction.T @ white
    free, held = size > FREE, size <= FREE
    # of a narrow prior the variance along its direction is 1 + size^2
    chi2 = white @ white - along @ along + float(np.sum(np.square(along[held]) / (1.0 + np.square(size[held]))))
    return float(chi2), len(white) - int(free.sum())


def table(found: Iterable[Calibrated]) -> str:
    """Return the table as Markdown: a row an observable and source, in the order of the report.

    Bold: the transform isn't uniform (Holm over the table at `CHANCE`).
    """
    rows: dict[tuple[str, str], list[Calibrated]] = {}
    for one in found:
        if one.n > 0:  # else wide nuisance parameters take all of its numbers
            rows.setdefault((one.observable, one.source), []).append(one)
    order = [measurement.name for measurement in measurements()]
    keys = sorted(rows, key=lambda key: (order.index(key[0]) if key[0] in order else len(order), key[1]))
    p = {key: kstest([chdtr(one.n, one.chi2) for one in rows[key]], "uniform").pvalue for key in keys}
    lines = [
        "| observable | simulator | sets | numbers | chi2 a number | KS p |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    rejected = _holm(p)
    for name, source in keys:
        own = rows[name, source]
        share = np.array([one.chi2 / one.n for one in own])
        std = share.std(ddof=1) / np.sqrt(len(share)) if len(share) > 1 else np.nan
        value = f"{share.mean():.2f} ± {std:.2f}"
        lines.append(
            f"| `{name}` | {source} | {len(own)} | {np.mean([one.n for one in own]):.0f} | "
            f"{f'**{value}**' if (name, source) in rejected else value} | {p[name, source]:.2g} |"
        )
    return "\n".join(lines)


def _holm(p: dict[tuple[str, str], float]) -> set[tuple[str, str]]:
    """Return the keys that Holm's procedure rejects at `CHANCE`."""
    rejected: set[tuple[str, str]] = set()
    for number, key in enumerate(sorted(p, key=lambda key: p[key])):
        if p[key] > CHANCE / (len(p) - number):
            break
        rejected.add(key)
    return rejected
