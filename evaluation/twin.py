"""Predictions in configurations that a model was never fitted in: 24 concealed cameras of the independent simulator,
each fitted and diagnosed at one configuration, and predicted in others.

`python -m evaluation twin --out DIR`. Eight cameras are healthy, eight conceal one effect, eight two. Eight
more conceal one weak blur, which a session at one aperture may tell as a family only. The dark current of all doubles
with the temperature, as that of silicon does. Each is recorded at f/4 in LED light at 25 C. Then the model is carried
to each of `TRANSFERS`, its predictions are sealed, the concealed camera is recorded there, and the seal is opened.
The budget of uncertainty of each model is held against the truth, and of more cameras, which aren't carried anywhere.
Each camera leaves DIR/results/CASE.json; one whose result is there isn't run again.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evaluation.budgets import BudgetCheck, budget_lines, check_budget
from evaluation.draw import recordings_of
from evaluation.experiment import CaseResult, Experiment, PagePicture, ScoredExperiment
from evaluation.independent_simulator import LISTED, ConcealedCamera, Law, Plan
from evaluation.plots import ABSTAINED, RIGHT, WRONG, Axis, Mark, Row, row_plot
from lab.diagnose import examine
from lab.errors import InputError
from lab.fit import fit_recording_set
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import RecordingSet
from lab.one_blas_thread import one_blas_thread
from lab.twin.changes import Changes
from lab.twin.predict import predict
from lab.twin.score import TestedEffect, TwinScore, combine_sessions, score, title
from lab.twin.sealed import open_seal, seal
from sim.effects.library import effects as library
from sim.parameters import Frozen

#: Seed of the drawn cameras where none is given; one of tuning.
SEED = 4177
ROWS, COLS = 128, 160
F_NUMBER, TEMPERATURE_C, DISTANCE_MM = 4.0, 25.0, 150.0
GAIN, LONGER = 4.0, 8.0
#: Laws of the camera that a twin's numbers can show, and that don't depend on the session.
CONCEALED = frozenset(
    {
        "optical_low_pass_filter", "defocus", "spherical_aberration", "astigmatism", "axial_chromatic_aberration",
        "veiling_glare", "vignetting", "infrared_cut_filter", "pixel_aperture", "charge_diffusion", "crosstalk",
        "green_imbalance", "brighter_fatter", "nonlinearity", "amplifier_glow", "row_noise", "ambient_light",
        "black_level_temperature",
    }
)  # fmt: skip
#: Laws that lose contrast alike in all directions, and the share of their nominal strength that a weak camera has of
#: one.
BLURS = frozenset({"optical_low_pass_filter", "defocus", "spherical_aberration", "pixel_aperture", "charge_diffusion"})
WEAK = (0.15, 0.35)
#: Every camera's dark current doubles in 1 / 1.3 x 10 degrees.
DARK_LAW = next(law for law in LISTED if law.name == "dark_current_temperature")
#: What a session after a transfer takes: what a twin predicts.
PREDICTED_KINDS = ("dark", "flat", "chart", "slanted_edge")
FITTED = Plan((*PREDICTED_KINDS, "narrowband"), lamp="led", chart_light=1.0, warm=True, lights=True)
#: Of weak blurs: edges in one light, and no sweep of the wavelength, which leave families.
WEAK_FITTED = replace(FITTED, kinds=PREDICTED_KINDS, lights=False)
#: Wanted of each quantity: the median, and that of 95 % of all; per cent, of an MTF absolute.
WANTED = {"chart": (0.5, 1.0), "noise": (1.0, 2.0), "slanted_edge": (0.01, 0.02), "dark": (1.0, 2.0)}
WANTED_INSIDE, WANTED_EXCESS, WANTED_NAMED = (0.90, 0.98), 0.2, 0.8


@dataclass(frozen=True)
class TransferSetting:
    """One change: of the concealed camera, of what is taken of it, and as `twin predict` is told it."""

    plan: dict[str, Any] = field(default_factory=dict)
    camera: dict[str, Any] = field(default_factory=dict)
    changes: Changes = field(default_factory=Changes)


def _aperture(f_number: float) -> TransferSetting:
    """Another aperture, in light by as much brighter or dimmer."""
    light = (1.0 + 4.0 * f_number**2) / (1.0 + 4.0 * F_NUMBER**2)
    return TransferSetting({"light": light}, {"f_number": f_number}, Changes(f_number=f_number, radiance_factor=light))


#: A lens of one surface that is free of spherical aberration: from the glass into air, a hyperboloid of conic -n^2
#: (Born and Wolf, Principles of Optics, 4.2.3). Its glass has no dispersion.
LENS_FILE, LENS_F_NUMBER, INDEX = "stigmatic.zmx", 8.0, 1.5
PRESCRIPTION = """VERS 140000 0 0
MODE SEQ
NAME stigmatic
UNIT MM X W X CM MR CPMM
ENPD {aperture_mm:.9g}
FTYP 0 0 2 3 0 0 0
XFLN 0 0
YFLN 0 {field_deg:.9g}
WAVM 1 0.48 1
WAVM 2 0.55 1
WAVM 3 0.63 1
PWAV 2
SURF 0
  TYPE STANDARD
  CURV 0
  DISZ INFINITY
SURF 1
  STOP
  TYPE STANDARD
  CURV 0
  DISZ {thickness_mm:.9g}
  GLAS ___BLANK 1 0 {index:.9g} 1000000 0
SURF 2
  TYPE STANDARD
  CURV {curvature:.12g}
  CONI {conic:.9g}
  DISZ {focal_mm:.12g}
SURF 3
  TYPE STANDARD
  CURV 0
  DISZ 0
"""


def write_lens(folder: Path, focal_mm: float) -> Path:
    """Write the prescription of a stigmatic lens at `LENS_F_NUMBER`; its file."""
    text = PRESCRIPTION.format(
        aperture_mm=focal_mm / LENS_F_NUMBER, field_deg=3.0, thickness_mm=1.0, index=INDEX,
        curvature=-1.0 / ((INDEX - 1.0) * focal_mm), conic=-(INDEX**2), focal_mm=focal_mm,
    )  # fmt: skip
    file = folder / LENS_FILE
    file.write_text(text, encoding="utf-8")
    return file


GAIN_DB = float(20.0 * np.log10(GAIN))
TRANSFERS: dict[str, TransferSetting] = {
    "f/4 to f/2.8": _aperture(2.8),
    "f/4 to f/8": _aperture(8.0),
    "another lens, by its file": _aperture(LENS_F_NUMBER),
    "LED to tungsten": TransferSetting({"lamp": "tungsten"}),
    "15 degrees warmer": TransferSetting({"temperature_c": 40.0}, {}, Changes(temperature_c=40.0)),
    "exposure x 8, gain x 4": TransferSetting(
        {"light": 1.0 / (GAIN * LONGER), "longer": LONGER, "gain_db": GAIN_DB},
        {"amplification": GAIN},
        Changes(exposure_factor=LONGER, gain_db=GAIN_DB, radiance_factor=1.0 / (GAIN * LONGER)),
    ),
    "at 150 mm": TransferSetting({}, {"distance_mm": DISTANCE_MM}, Changes(distance_mm=DISTANCE_MM)),
}


class TransferRun(Frozen):
    """One transfer of one camera. `deviations`: of each quantity, per cent (of an MTF absolute), in the order of its
    numbers, and `inside`, whether each is in its 95 % interval. `chi2` with what was diagnosed, `chi2_before`
    without any of its names but that of the dark current."""

    deviations: dict[str, tuple[float, ...]]
    inside: dict[str, tuple[bool, ...]]
    chi2_of: dict[str, float]
    chi2: float
    chi2_before: float
    n: int


class CameraRun(CaseResult):
    """One concealed camera. `told`: names of the diagnosis; `tested`: what all transfers together made of them;
    `budget`: of each use, beside the truth; `failed`: of transfers, why there is no score."""

    case: str
    seed: int = SEED
    concealed: tuple[str, ...]
    told: tuple[str, ...]
    tested: tuple[TestedEffect, ...] = ()
    transfers: dict[str, TransferRun] = {}
    budget: tuple[BudgetCheck, ...] = ()
    failed: dict[str, str] = {}
    cpu_s: float = 0.0


Kind = Literal["healthy", "single", "double", "weak"]
KINDS: tuple[Kind, ...] = ("healthy", "single", "double", "weak")
#: How many laws the cameras of a kind conceal, and how many cameras there are of each.
LAWS = {"healthy": 0, "single": 1, "double": 2, "weak": 1}
OF_EACH = 8
#: Cameras beyond those, one and two laws in turn, whose budget alone is held against the truth.
MORE = 18


def case_names() -> tuple[str, ...]:
    """All cases, the kinds in turn, weak ones last."""
    numbers = range(1, OF_EACH + 1)
    strong = tuple(f"{kind}-{number}" for number in numbers for kind in KINDS[:3])
    return strong + tuple(f"weak-{number}" for number in numbers)


def budget_names() -> tuple[str, ...]:
    """Cases of which the budget alone is held against the truth."""
    return tuple(f"{KINDS[1 + k % 2]}-{OF_EACH + 1 + k // 2}" for k in range(MORE))


def laws_of(case: str, seed: int = SEED) -> list[Law]:
    """Return the concealed laws of a case beside that of the dark current."""
    kind, _, number = case.partition("-")
    rng = np.random.default_rng([seed, KINDS.index(kind), int(number)])
    is_mono = ConcealedCamera(_seed(case, seed)).cfa == "MONO"
    pool = BLURS if kind == "weak" else CONCEALED
    able = [law for law in LISTED if law.name in pool and law.needs not in ({"bayer"} if is_mono else {"mono"})]
    chosen = rng.permutation(len(able))[: LAWS[kind]]
    laws = []
    for k in chosen:
        law, variant, own = able[k], int(rng.integers(able[k].variants)), int(rng.integers(2**31))
        share = float(rng.uniform(*WEAK)) if kind == "weak" else 1.0
        laws.append(law(share * law.nominal, variant, own))
    return laws


def _seed(case: str, seed: int) -> int:
    kind, _, number = case.partition("-")
    return seed + 1000 * int(number) + KINDS.index(kind)


def concealed_camera(case: str, noise_draw: int = 0, seed: int = SEED, **settings: Any) -> ConcealedCamera:
    """Return the camera of a case in a setting."""
    dark = DARK_LAW(1.3, 0, _seed(case, seed))
    settings = {"f_number": F_NUMBER, "stated_f_number": F_NUMBER} | settings
    return ConcealedCamera(
        _seed(case, seed), [*laws_of(case, seed), dark], rows=ROWS, cols=COLS, noise_draw=noise_draw, **settings
    )


@one_blas_thread
def run_case(case: str, seed: int = SEED) -> CameraRun:
    """Fit and diagnose a camera, hold its budget against the truth, and predict it in every transfer."""
    began_s = time.process_time()
    laws, camera = laws_of(case, seed), concealed_camera(case, seed=seed)
    recordings = recordings_of(camera, WEAK_FITTED if case.startswith("weak") else FITTED)
    fit = fit_recording_set(recordings)
    found = examine(recordings, fit, at_once=False)
    model = found.improved["left"]
    short = replace(FITTED, kinds=PREDICTED_KINDS, lights=False)
    plan = recordings_of(concealed_camera(case, seed=seed), short)
    runs, failed, tests = {}, {}, []
    budget = check_budget(model, camera, camera.laws)
    carried = TRANSFERS if case in case_names() else {}
    lenses = tempfile.TemporaryDirectory()
    for number, (name, transfer) in enumerate(carried.items(), start=1):
        taken = recordings_of(concealed_camera(case, number, seed, **transfer.camera), replace(short, **transfer.plan))
        changes = transfer.changes
        if "lens" in name:
            file = write_lens(Path(lenses.name), concealed_camera(case, seed=seed).focal_length_mm)
            changes = changes.model_copy(update={"f_number": None, "lens": file})
        if "lamp" in transfer.plan:  # as the radiometer reads it there
            changes = Changes(lamp=taken.spectrum(taken.captures("flat", "left")[0].radiance))
        try:
            result = _opened(model, plan, changes, taken)
        except InputError as refused:
            failed[name] = str(refused)
            continue
        tests.append(result.effects)
        runs[name] = _run(result)
    lenses.cleanup()
    return CameraRun(
        case=case, seed=seed, concealed=tuple(law.name for law in laws), told=tuple(e.name for e in
        found.result.effects), tested=combine_sessions(tests), transfers=runs, budget=budget, failed=failed,
        cpu_s=time.process_time() - began_s,
    )  # fmt: skip


def _opened(model: CameraFile, plan: RecordingSet, changes: Changes, taken: RecordingSet) -> TwinScore:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "sealed.json"
        seal(predict({"left": model}, plan, changes, light_std=0.0), file)
        return score(open_seal(file), taken)


def _run(found: TwinScore) -> TransferRun:
    of_names = sum(test.gain for test in found.effects if test.effect != DARK_LAW.effect)
    tempered = max(found.chi2 / found.n, 1.0)
    deviations: dict[str, list[float]] = {}
    inside: dict[str, list[bool]] = {}
    for one in found.numbers:
        away = one.deviation if one.quantity == "slanted_edge" else one.deviation_percent
        deviations.setdefault(one.quantity, []).append(float(f"{away:.4g}"))
        inside.setdefault(one.quantity, []).append(one.is_inside)
    return TransferRun(
        deviations={k: tuple(v) for k, v in deviations.items()}, inside={k: tuple(v) for k, v in inside.items()},
        chi2_of={q.quantity: q.chi2 for q in found.quantities}, chi2=found.chi2,
        chi2_before=found.chi2 + 2.0 * tempered * of_names, n=found.n,
    )  # fmt: skip


# --- the page --------------------------------------------------------------------------------------------------------


def wrong_names(run: CameraRun) -> dict[str, bool]:
    """Return whether each name of the diagnosis is right: an effect that is concealed, or its family."""
    concealed = {law.effect: law for law in LISTED if law.name in (*run.concealed, DARK_LAW.name)}
    families = {library()[name].family.value for name in concealed if name is not None}
    return {name: name in concealed or name in families for name in run.told}


def _pooled(runs: Sequence[TransferRun], quantity: str) -> tuple[np.ndarray, np.ndarray]:
    away = [value for run in runs for value in run.deviations.get(quantity, ())]
    inside = [value for run in runs for value in run.inside.get(quantity, ())]
    return np.abs(np.array(away)), np.array(inside, bool)


def _row(name: str, runs: Sequence[TransferRun], quantity: str) -> str | None:
    away, inside = _pooled(runs, quantity)
    if not len(away):
        return None
    unit = "" if quantity == "slanted_edge" else " %"
    cells = [f"{np.median(away):.2g}{unit}", f"{np.quantile(away, 0.95):.2g}{unit}", f"{100 * np.mean(inside):.1f} %"]
    return f"| {name} | {title(quantity)} | {len(away)} | {' | '.join(cells)} |"


def section(runs: Mapping[str, CameraRun]) -> str:
    """Return the outcome as Markdown."""
    budgets = budget_lines([run.budget for run in runs.values() if run.budget])
    runs = {case: run for case, run in runs.items() if case in case_names()}
    every = [run for camera in runs.values() for run in camera.transfers.values()]
    kinds = {kind: sum(case.startswith(kind) for case in runs) for kind in KINDS}
    said = ", ".join(f"{count} of {OF_EACH} {kind}" for kind, count in kinds.items())
    lines = [
        f"{len(runs)} of {len(case_names())} cameras ({said}), {len(TRANSFERS)} transfers each.",
        "Deviations are of measured from predicted numbers; those of an MTF are absolute.",
        "",
        "| quantity | median | wanted | 95 % of all within | wanted | in 95 % intervals | wanted |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for quantity, (median, most) in WANTED.items():
        away, inside = _pooled(every, quantity)
        if len(away):
            unit = "" if quantity == "slanted_edge" else " %"
            cells = [f"{np.median(away):.2g}{unit}", f"{median:g}{unit}", f"{np.quantile(away, 0.95):.2g}{unit}"]
            cells += [f"{most:g}{unit}", f"{100 * np.mean(inside):.1f} %", "90 to 98 %"]
            lines.append(f"| {title(quantity)} | {' | '.join(cells)} |")
    rows = [row for t in TRANSFERS for q in WANTED if (row := _row(t, _of(runs, t), q)) is not None]
    lines += [
        "",
        "| transfer | quantity | n | median | 95 % within | in 95 % intervals |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    lines += rows
    lines += ["", *_chi2_lines(runs), "", *_name_lines(runs), "", *budgets]
    return "\n".join(lines)


def _of(runs: Mapping[str, CameraRun], transfer: str) -> list[TransferRun]:
    return [camera.transfers[transfer] for camera in runs.values() if transfer in camera.transfers]


def _excess(run: TransferRun) -> float | None:
    """Excess chi2 with the diagnosis over that without; None where there is no excess without it."""
    before = run.chi2_before - run.n
    return None if before < 3.0 * np.sqrt(2.0 * run.n) else max(run.chi2 - run.n, 0.0) / before


def _chi2_lines(runs: Mapping[str, CameraRun]) -> list[str]:
    lines = ["| transfer | chi2 / n, median | excess chi2, diagnosed over not, median | a fifth or less |"]
    lines.append("| --- | --- | --- | --- |")
    for name in TRANSFERS:
        of = _of(runs, name)
        shares = [share for run in of if (share := _excess(run)) is not None]
        if of:
            told = f"{np.median(shares):.2g}" if shares else "-"
            fifth = sum(share <= WANTED_EXCESS for share in shares)
            lines.append(
                f"| {name} | {np.median([r.chi2 / r.n for r in of]):.2f} | {told} | {fifth} of {len(shares)} |"
            )
    return lines


def _name_lines(runs: Mapping[str, CameraRun]) -> list[str]:
    lines = ["| camera | concealed | named at f/4 | after the transfers |", "| --- | --- | --- | --- |"]
    for case, run in runs.items():
        is_right = wrong_names(run)
        told = ", ".join(f"{name}{'' if is_right[name] else ' (wrong)'}" for name in run.told) or "nothing"
        after = "; ".join(test.words for test in run.tested) or "-"
        failed = "".join(f"; {name}: {why}" for name, why in run.failed.items())
        lines.append(f"| {case} | {', '.join(run.concealed) or 'nothing'} | {told} | {after}{failed} |")
    families = [(run, test) for run in runs.values() for test in run.tested if test.name != test.effect]
    named = [(run, test) for run, test in families if test.verdict == "named"]
    right = sum(test.becomes in _effects_of(run) for run, test in named)
    share = f" ({100 * len(named) / len(families):.0f} %)" if families else ""
    lines += [
        "",
        (
            f"Families: {len(families)}, of which {len(named)}{share} became a name, {right} of them the right one; "
            f"wanted: {100 * WANTED_NAMED:.0f} %."
        ),
    ]
    names = [(run, test) for run in runs.values() for test in run.tested if test.name == test.effect]
    wrong = [(run, test) for run, test in names if test.effect not in _effects_of(run)]
    gone = sum(test.verdict == "withdrawn" for _, test in wrong)
    lost = [(run, test) for run, test in names if test.effect in _effects_of(run) and test.verdict == "withdrawn"]
    which = ": " + ", ".join(f"{test.effect} ({run.case})" for run, test in lost) if lost else ""
    lines.append(f"Names: {len(names)}, {len(wrong)} of them wrong, of which {gone} were withdrawn;")
    lines.append(f"of the right ones {len(lost)} were withdrawn{which}.")
    return lines


def _effects_of(run: CameraRun) -> set[str | None]:
    return {law.effect for law in LISTED if law.name in (*run.concealed, DARK_LAW.name)}


#: Deviations over what is wanted of 95 % of all.
DEVIATION = Axis(0.01, 10.0, (0.01, 0.1, 1.0, 10.0), 1.0, is_logarithmic=True)


def drawing(runs: Mapping[str, CameraRun]) -> str:
    """Return the deviations of each transfer and quantity as SVG, over what is wanted of 95 % of all: the median, and a
    bar to 95 %; beside them the share in 95 % intervals."""
    rows = []
    for transfer in TRANSFERS:
        for quantity in WANTED:
            away, inside = _pooled(_of(runs, transfer), quantity)
            if not len(away):
                continue
            median, most = (float(np.quantile(away, share)) / WANTED[quantity][1] for share in (0.5, 0.95))
            share = float(np.mean(inside))
            ink = RIGHT if WANTED_INSIDE[0] <= share <= WANTED_INSIDE[1] else ABSTAINED if share > 0.9 else WRONG
            mark = Mark(median, RIGHT if most <= 1.0 else WRONG, (median, most))
            rows.append(Row(f"{transfer}: {title(quantity)}", (mark,), f"{100 * share:.1f} %", ink))
    head = "deviation over what is wanted of 95 % of all: dot the median, bar to 95 % of all; right, in the interval"
    return row_plot(head, DEVIATION, rows)


@dataclass(frozen=True)
class TwinProof(Experiment[str, CameraRun]):
    """Concealed cameras fitted at one configuration, and predicted in others."""

    result = CameraRun

    seed: int = SEED

    def draw(self) -> dict[str, str]:
        """Return the cameras that are carried elsewhere, and those whose budget alone is compared."""
        return {case: case for case in (*case_names(), *budget_names())}

    def diagnose(self, case: str, folder: Path) -> CameraRun:
        """Fit and diagnose a camera, and predict it in every transfer."""
        return run_case(case, self.seed)

    def is_current(self, kept: CameraRun, case: str) -> bool:
        """Return True. Raises InputError for a result of another seed."""
        if kept.seed != self.seed:
            raise InputError(f"{case}: its result is of seed {kept.seed}, not {self.seed}; give that, or another --out")
        return True

    def describe(self, run: CameraRun) -> str:
        """Return what a camera conceals, what was named, and what the transfers made of that."""
        names = f"conceals {', '.join(run.concealed) or 'nothing'}, told {', '.join(run.told) or 'nothing'}"
        return f"{names}; {'; '.join(test.words for test in run.tested)}; {run.cpu_s:.0f} s"

    def score(self, runs: Mapping[str, CameraRun]) -> ScoredExperiment:
        """Return the deviations of all transfers, what became of names, and the budgets."""
        carried = {case: run for case, run in runs.items() if run.transfers}
        picture = PagePicture("", "Deviations over what is wanted", drawing(carried))
        return ScoredExperiment("transfers", section(runs), pictures=[picture], title="Proof of the twin")
