"""The live proof: mock benches that conceal effects, a whole session over the wire, and its diagnosis.

`python -m evaluation live --out DIR`. Every case starts `calibench bench` as an OS process, captures a quick session
from its station file, fits and diagnoses it, and leaves DIR/results/CASE.json; a case whose result is there is not run
again."""

from __future__ import annotations

import os
import random
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

from evaluation.experiment import CaseResult, Experiment, PagePicture, ScoredExperiment
from evaluation.plots import ABSTAINED, RIGHT, WRONG, Axis, Mark, Row, row_plot
from lab.bench_process import mock_bench
from lab.capture_kinds.base import CAPTURES, SEQUENCES
from lab.diagnose.visibility import visibility
from lab.effect_titles import effect_title
from lab.errors import InputError
from lab.formats.results import DiagnosisResult, NamedEffect, ResolveEnd
from sim.camera import Side
from sim.effects.library import effects as library
from sim.effects.library import typical
from sim.parameters import Frozen

# --- the page: concealed and named effects, and their parameters ------------------------------------------------------


#: Parameters found over concealed ones.
RATIO = Axis(0.0, 2.0, (0.0, 0.5, 1.0, 1.5, 2.0), 1.0)
COLOURS = {"named": RIGHT, "healthy": RIGHT, "among rivals": ABSTAINED, "not named": ABSTAINED}


def summary(runs: Mapping[str, LiveRun]) -> str:
    """Number of cases by outcome, as Markdown."""
    groups = {
        "single effects": [run for run in runs.values() if len(run.case.concealed) == 1 and not run.case.resolve],
        "pairs": [run for run in runs.values() if len(run.case.concealed) > 1],
        "healthy cameras": [run for run in runs.values() if not run.case.concealed],
        "benches to resolve": [run for run in runs.values() if run.case.resolve],
    }
    lines = [f"{len(runs)} of {len(every_case())} cases run.", "", "| | cases | outcomes |", "| --- | --- | --- |"]
    for name, group in groups.items():
        counts = ", ".join(f"{outcome} {n}" for outcome, n in Counter(run.outcome for run in group).most_common())
        lines.append(f"| {name} | {len(group)} | {counts or '-'} |")
    lines += commits(runs)
    unseen = sorted(name for name in runs if name in library() and name not in names_of(name))
    if unseen:
        lines.append(f"\nNot looked for, or shown by no measurement, so that no name is right: {', '.join(unseen)}.")
    return "\n".join(lines)


def commits(runs: Mapping[str, LiveRun]) -> list[str]:
    """Return the commits that cases were run at, as lines of Markdown."""
    by_commit: dict[str, list[str]] = {}
    for name, run in runs.items():
        by_commit.setdefault(run.commit or "unknown", []).append(name)
    usual = max(by_commit, key=lambda commit: len(by_commit[commit]), default="unknown")
    lines = [f"\nRun at commit {usual}" + ("." if len(by_commit) < 2 else ", except:")]
    return [*lines, *(f"- {commit}: {', '.join(names)}" for commit, names in by_commit.items() if commit != usual)]


def table(runs: Mapping[str, LiveRun]) -> str:
    """Markdown table with a row for each case."""
    lines = [
        (
            "| concealed | outcome | named (sides) | rivals | parameter: found, concealed | held-out chi2 / n, before | "  # noqa: E501
            "after |"
        ),
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, run in runs.items():
        named = ", ".join(f"{effect} ({' '.join(sides)})" for effect, sides in run.named.items())
        rivals = ", ".join(sorted({rival for told in run.rivals.values() for rival in told}))
        found = "; ".join(_words(parameter) for parameter in run.parameters)
        before, after = (
            "-" if chi2 is None or not run.n else f"{chi2 / run.n:.3g}" for chi2 in (run.chi2_before, run.chi2_after)
        )
        what = ", ".join(spec.partition(":")[2].replace(":", " ") for spec in run.case.concealed) or f"nothing ({name})"
        if run.case.resolve:
            first = ", ".join((*run.first_named, *run.first_rivals)) or "nothing"
            what += f"; at first {first}, then {', '.join(run.captures) or 'no capture taken'}"
        said = run.outcome if run.error is None else f"failed: {run.error}"
        lines.append(
            f"| {what} | {said} | {named or run.verdict} | {rivals or '-'} | {found or '-'} | {before} | {after} |"
        )
    return "\n".join(lines)


def _words(parameter: FoundParameter) -> str:
    doubt = "" if parameter.std is None else f" ± {parameter.std:.2g}"
    if parameter.interval is not None:
        doubt = f" ({parameter.interval[0]:.3g} to {parameter.interval[1]:.3g})"
    return f"{parameter.parameter} {parameter.value:.3g}{doubt} {parameter.unit}, {parameter.truth:g}"


def drawing(runs: Mapping[str, LiveRun]) -> str:
    """Return the parameters of singles and pairs as SVG, found over concealed, with two standard deviations or the
    interval; grey or red where the effect wasn't named."""
    rows = []
    for run in runs.values():
        if run.case.resolve or not run.case.concealed:
            continue
        colour = COLOURS.get(run.outcome, WRONG)
        sized = [p for p in run.parameters if library()[p.effect].quantities()[p.parameter].absent != p.truth]
        words = " + ".join(effect_title(effect) for effect in run.case.effects)
        rows += [Row(f"{words}: {p.parameter.replace('_', ' ')}", (_mark(p, colour),)) for p in sized]
        if not sized:
            rows.append(Row(words, note="no value", note_colour=colour))
    return row_plot("found / concealed, two standard deviations", RATIO, rows)


def _mark(parameter: FoundParameter, colour: str) -> Mark:
    ratio, half = parameter.value / parameter.truth, 2.0 * (parameter.std or 0.0) / abs(parameter.truth)
    ends = ratio - half, ratio + half
    if parameter.interval is not None:
        ends = parameter.interval[0] / parameter.truth, parameter.interval[1] / parameter.truth
    return Mark(ratio, colour, ends)


# --- the cases --------------------------------------------------------------------------------------------------------


Ending = Literal["named", "among rivals", "not named", "wrong name", "healthy", "failed"]

#: Sizes of effects at which a quick session shows them, on the left camera or on the rig. Effects that aren't here are
#: concealed at `sim.effects.library.typical`.
SIZES: dict[str, str] = {
    "adc_nonlinearity": "left:error_dn=4",
    "adc_step": "left:step_dn=3,code_dn=1500",
    "ambient_light": "both:rate_e_per_s=400,red_over_blue=3",
    "alternating_row_noise": "left:noise_e=3",
    "amplifier_crosstalk": "left:share_percent=2,excess_percent=0.5",
    "amplifier_glow": "left:glow_e_per_s=60,reach_mm=0.5",
    "astigmatism": "left:defocus_x_um=22",
    "axial_chromatic_aberration": "left:slope_um=15",
    "bit_weights": "left:last_dn=0.3,second_dn=-0.2",
    "black_level_drift": "left:drift_dn_per_min=1",
    "blooming": "left:share_percent=20",
    "brighter_fatter": "left:loss_percent=10,shared_percent=10",
    "charge_diffusion": "left:length_um=1.2",
    "charge_transfer_inefficiency": "left:parallel_ppm=200,release_px=0.8",
    "coloured_line_noise": "left:noise_e=5,exponent=1",
    "coloured_read_noise": "left:correlation=-0.1",
    "column_gain": "left:gain_percent=1",
    "column_noise": "left:offset_e=2",
    "coma": "left:w131_x_um=0.25",
    "cosmic_rays": "left:rate_per_cm2_s=300,depth_um=10",
    "cover_glass": "left:thickness_mm=15",
    "crosstalk": "left:share_percent=2",
    "dark_current_temperature": "both:doublings_per_c=0.12",
    "decentre": "left:shift_x_um=3",
    "defocus": "left:defocus_um=22",
    "distortion": "left:corner_percent=1.5",
    "empirical_law": "both:strength=1",
    "etaloning": "left:strength_percent=20,thickness_um=4",
    "excess_noise": "left:excess_percent=60",
    "exposure_offset": "left:offset_us=25",
    "field_curvature": "left:curvature_um=25",
    "fringes": "left:cos_percent=6,optical_thickness_um=4",
    "ghost": "left:share_percent=2",
    "green_imbalance": "left:imbalance_percent=2",
    "hot_pixels": "left:excess_e_per_s=1500,share_ppm=500",
    "image_lag": "left:lag_percent=2",
    "infrared_cut_filter": "left:cut_wavelength_nm=655,width_nm=4",
    "inter_pixel_capacitance": "left:share_percent=2",
    "lamp_ageing": "both:reddening_percent=12",
    "lateral_chromatic_aberration": "left:slope_um=2.5",
    "light_flicker": "both:modulation_percent=8,frequency_hz=100,line_time_us=20",
    "microlens_angle": "left:crosstalk_percent=3,loss_percent=4",
    "model_discrepancy": "left:strength=1",
    "moffat_blur": "left:radius_um=1.5,exponent=2.5",
    "non_uniform_illumination": "both:gradient_x_percent=4",
    "nonlinearity": "left:quadratic_percent=3",
    "on_chip_sharpening": "left:strength=0.3",
    "on_chip_smoothing": "left:strength=0.3",
    "optical_low_pass_filter": "left:displacement_x_um=2,displacement_y_um=2",
    "other_f_number": "left:ratio=1.4",
    "persistence": "left:share_percent=5,release_s=10",
    "phase_detection_rows": "left:loss_percent=4,period=8,first_row=3",
    "pixel_aperture": "left:side_change_um=-0.7",
    "radiometer_nonlinearity": "both:exponent_percent=4",
    "random_telegraph_noise": "left:amplitude_e=40,share_percent=0.5",
    "reading_order_noise": "left:noise_e=4,alternating_e=2",
    "response_knee": "left:slope_percent=-3,knee_share=0.45",
    "row_gain": "left:gain_percent=0.7",
    "row_noise": "left:noise_e=3",
    "screen_gamma": "both:exponent=1.8",
    "screen_pixel_structure": "both:amplitude_percent=20",
    "shutter_leakage": "left:last_row_us=40",
    "source_bandwidth": "both:width_nm=6",
    "source_drift": "both:drift_percent_per_min=5",
    "spherical_aberration": "left:w040_um=0.15",
    "stereo_gain_mismatch": "both:gain_percent=5",
    "stray_light": "both:share_percent=0.6",
    "taps": "left:gain_percent=1,offset_e=3",
    "secondary_astigmatism": "left:cos_um=0.2",
    "secondary_coma": "left:cos_um=0.2",
    "tetrafoil": "left:cos_um=0.25",
    "tree_rings": "left:amplitude_percent=0.8,period_um=30",
    "trefoil": "left:w333_x_um=0.2",
    "turbulent_air": "left:width_um=1.5",
    "veiling_glare": "left:share_percent=3",
    "vibration_blur": "both:amplitude_x_um=1.5",
    "vignetting": "left:corner_loss_percent=6",
    "vignetting_decentre": "left:fall_off_percent=12,centre_x=0.3",
    "wavelength_offset": "both:offset_nm=2",
}

PAIRS = (
    ("optical_low_pass_filter", "infrared_cut_filter"),
    ("nonlinearity", "vignetting"),
    ("wavelength_offset", "defocus"),
    ("row_noise", "hot_pixels"),
    ("veiling_glare", "crosstalk"),
    ("source_drift", "coma"),
    ("image_lag", "green_imbalance"),
    ("brighter_fatter", "infrared_cut_filter"),
    ("stray_light", "amplifier_glow"),
    ("lateral_chromatic_aberration", "column_noise"),
)

HEALTHY_SEEDS = (11, 12, 13, 14, 15, 16)

#: The first session leaves edges out, so that losses of contrast have rivals; `--resolve` may then take them.
RESOLVED = (
    "left:charge_diffusion:length_um=0.7",
    "left:crosstalk:share_percent=1.5",
    "left:optical_low_pass_filter:displacement_x_um=1.3,displacement_y_um=1.3",
)
FIRST_SESSION = ("dark", "flat", "screen")

#: Weak losses of contrast that are alike in all directions: `--isotropic` resolves each in three captures at most.
ISOTROPIC: dict[str, tuple[str, ...]] = {
    "defocus": tuple(f"defocus_um={um}" for um in (6, 9, 13, 5, 7.5, 8, 10, 11)),
    "spherical_aberration": tuple(f"w040_um={um}" for um in (0.07, 0.1, 0.14, 0.04, 0.055, 0.06, 0.08, 0.12)),
    "charge_diffusion": tuple(f"length_um={um}" for um in (0.45, 0.6, 0.8, 0.55, 0.7, 0.5, 0.65, 0.75)),
    "pixel_aperture": tuple(f"side_change_um={um}" for um in (-0.25, -0.4, -0.55, -0.8, -1.1, -0.5, -0.65, -0.95)),
    "optical_low_pass_filter": tuple(
        f"displacement_x_um={um},displacement_y_um={um}" for um in (0.8, 1.1, 1.4, 1.0, 1.25, 0.9, 1.2, 1.3)
    ),
}
MOST_CAPTURES = 3

#: By how much the sensors get warmer (C) where the effect needs that.
WARM_UP_C = {"dark_current_temperature": 6.0}

#: Effects that a diagnosis doesn't look for, and the names that are right for them, besides no name: those of effects
#: or families that change recordings alike. The model discrepancy's typical instance is an isotropic loss of contrast.
NOT_LOOKED_FOR: dict[str, frozenset[str]] = {
    "cover_glass": frozenset({"spherical_aberration"}),
    "empirical_law": frozenset(),
    "model_discrepancy": frozenset({"isotropic_contrast_loss"}),
    "other_f_number": frozenset(),
}

#: Effects that the mock bench can't show, and refuses to conceal.
NOT_SHOWN_BY_BENCH = frozenset({"second_order_light", "stereo_time_offset"})

#: Effects that one session can't show: distortion is fitted to its boards, so that only an earlier calibration shows a
#: change; it takes its dark frames before any light, so that nothing persists in them; and the bench's cameras have
#: filters that keep near-infrared light out.
NOT_IN_ONE_SESSION = frozenset({"distortion", "decentre", "etaloning", "persistence"})


class LiveCase(Frozen):
    """One mock bench and its session."""

    name: str
    concealed: tuple[str, ...] = ()  # values of `--conceal`
    seed: int = 1
    warm_up_c: float = 0.0  # by how much the sensors get warmer
    only: tuple[str, ...] = ()  # sequences to capture; empty: all
    resolve: bool = False  # `run --resolve`
    rounds: int | None = None  # captures of that, at most
    left_only: bool = False  # a station with the left camera alone

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the concealed effects."""
        return tuple(spec.split(":")[1] for spec in self.concealed)


class FoundParameter(Frozen):
    """A parameter of a concealed effect that was named: true and estimated value, with standard deviation or 95 %
    interval."""

    effect: str
    parameter: str
    unit: str
    truth: float
    value: float
    std: float | None
    interval: tuple[float, float] | None = None


class ResolvedStage(Frozen):
    """What stands after so many captures of `run --resolve`: names, their rivals, and these captures' lab time."""

    named: tuple[str, ...]
    rivals: tuple[str, ...]
    captures: int
    lab_s: float


class LiveRun(CaseResult):
    """The outcome of a case. `named`: effects with their sides; `first_named`, `first_rivals`: names and rivals before
    `--resolve` took its `captures`."""

    case: LiveCase
    outcome: Ending
    verdict: str = ""
    named: dict[str, tuple[Side, ...]] = {}
    rivals: dict[str, tuple[str, ...]] = {}
    parameters: tuple[FoundParameter, ...] = ()
    chi2_before: float | None = None
    chi2_after: float | None = None
    n: int | None = None
    first_named: tuple[str, ...] = ()
    first_rivals: tuple[str, ...] = ()
    captures: tuple[str, ...] = ()
    stages: tuple[ResolvedStage, ...] = ()
    resolve_end: ResolveEnd | None = None
    wall_s: float = 0.0
    error: str | None = None


def typical_spec(effect: str) -> str:
    """`SIDE:EFFECT:PARAMETER=VALUE,...` of an effect at its typical size."""
    kind = library()[effect]
    of_rig = "light" in kind.stages()
    one = typical(kind)
    values = ",".join(f"{name}={getattr(one, name):g}" for name in kind.quantities())
    # choices that aren't those of an effect that nothing is said of
    values += "".join(
        f",{name}={getattr(one, name)}"
        for name in kind.told_choices()
        if getattr(one, name) != kind.choices()[name].default
    )
    return f"{'both' if of_rig else 'left'}:{effect}:{values}"


def _spec(effect: str) -> str:
    if effect not in SIZES:
        return typical_spec(effect)
    side, values = SIZES[effect].split(":")
    return f"{side}:{effect}:{values}"


def _of(name: str, *effects: str) -> LiveCase:
    warm = max((WARM_UP_C.get(effect, 0.0) for effect in effects), default=0.0)
    return LiveCase(name=name, concealed=tuple(_spec(effect) for effect in effects), warm_up_c=warm)


def every_case() -> dict[str, LiveCase]:
    """Name -> case: singles, pairs, healthy cameras, and benches to resolve."""
    cases = [_of(effect, effect) for effect in library() if effect not in NOT_SHOWN_BY_BENCH]
    cases += [_of("+".join(pair), *pair) for pair in PAIRS]
    cases += [LiveCase(name=f"healthy-{seed}", seed=seed) for seed in HEALTHY_SEEDS]
    cases += [
        LiveCase(name=f"resolve-{spec.split(':')[1]}", concealed=(spec,), only=FIRST_SESSION, resolve=True)
        for spec in RESOLVED
    ]
    return {case.name: case for case in cases}


def isotropic_cases() -> dict[str, LiveCase]:
    """Name -> case: one camera with a weak loss of contrast that is alike in all directions, to resolve."""
    cases = [
        LiveCase(
            name=f"isotropic-{effect}-{size}",
            concealed=(f"left:{effect}:{values}",),
            seed=100 + size,
            only=FIRST_SESSION,
            resolve=True,
            rounds=MOST_CAPTURES,
            left_only=True,
        )
        for size in range(max(map(len, ISOTROPIC.values())))
        for effect, sizes in ISOTROPIC.items()
        for values in sizes[size : size + 1]
    ]
    return {case.name: case for case in cases}


def isotropic_table(runs: Mapping[str, LiveRun]) -> str:
    """Markdown: how many are named right, by the concealed name alone, after each capture; then each case."""
    done = [run for run in runs.values() if run.stages]
    lines = [
        f"{len(runs)} of {len(isotropic_cases())} cases run.",
        *commits(runs),
        "",
        "| captures | named right | with a rival left | another name | no name | lab time, s |",
        "| --- " * 6 + "|",
    ]
    for captures in range(MOST_CAPTURES + 1):
        counts = Counter(_standing(run, captures) for run in done)
        lab_s = sum(_stage(run, captures).lab_s for run in done)
        told = [f"{counts[one]} of {len(done)}" for one in ("right", "right, rivals", "wrong", "none")]
        lines.append(f"| {captures} | {' | '.join(told)} | {lab_s:.0f} |")
    lines += ["", "| concealed | before | captures | after | end |", "| --- " * 5 + "|"]
    for run in runs.values():
        first, last = (_words_of(run.stages[at]) if run.stages else run.error or "failed" for at in (0, -1))
        taken = "; ".join(run.captures) or "none"
        lines.append(f"| {run.case.concealed[0]} | {first} | {taken} | {last} | {run.resolve_end or '-'} |")
    return "\n".join(lines)


def _stage(run: LiveRun, captures: int) -> ResolvedStage:
    return run.stages[min(captures, len(run.stages) - 1)]


def _standing(run: LiveRun, captures: int) -> Literal["right", "right, rivals", "wrong", "none"]:
    """Return how the names stand after so many captures, or at the end where there were fewer."""
    stage = _stage(run, captures)
    if not stage.named:
        return "none"
    if set(stage.named) - {*run.case.effects, *(library()[name].family.value for name in run.case.effects)}:
        return "wrong"
    return "right, rivals" if stage.rivals or set(stage.named) != set(run.case.effects) else "right"


def _words_of(stage: ResolvedStage) -> str:
    rivals = f" (rivals {', '.join(stage.rivals)})" if stage.rivals else ""
    return f"{', '.join(stage.named) or 'nothing'}{rivals}"


def drawn(seed: int, count: int = 3) -> tuple[LiveCase, ...]:
    """Random cases of single effects, for everyday tests. Of the session, only darks, flats, and the sequences that can
    show the effect are captured."""
    single = [case for name, case in every_case().items() if name in library() and name not in NOT_IN_ONE_SESSION]
    return tuple(
        case.model_copy(update={"only": _showing(case.effects[0])})
        for case in random.Random(seed).sample(single, count)
    )


def _showing(effect: str) -> tuple[str, ...]:
    """Names of the sequences, in the order of a session, that a diagnosis of one effect needs."""
    kinds = visibility()[effect].capture_kinds if effect in visibility() else ()
    takers = (CAPTURES.models[kind].sequence for kind in kinds)
    wanted = {"dark", "flat"} | {taker.name for taker in takers if taker is not None}
    return tuple(name for name in SEQUENCES if name in wanted)


def run_case(case: LiveCase, folder: Path) -> LiveRun:
    """Run one case; its session lies in `folder` until it is diagnosed."""
    began_s = time.monotonic()
    options = ["--seed", str(case.seed), "--warm-up", str(case.warm_up_c), *([] if case.concealed else ["--healthy"])]
    shutil.rmtree(folder, ignore_errors=True)
    try:
        with mock_bench(case.concealed, options) as station:
            if case.left_only:
                _leave_right_out(station)
            ends = ["--quick", "--station", str(station), "--out", str(folder), "--name", case.name]
            ends += [f"--only={name}" for name in case.only]
            ends += ["--resolve"] if case.resolve else []
            ends += [] if case.rounds is None else [f"--resolve-rounds={case.rounds}"]
            _command("run" if case.resolve else "capture", *ends)
        sessions = sorted((folder / "sessions").iterdir())
        file = folder / "diagnose.json" if not case.resolve else sessions[0] / "diagnose.json"
        if not case.resolve:
            _command("diagnose", sessions[0].name, "--json", str(file), data=folder)
        found = DiagnosisResult.model_validate_json(file.read_text(encoding="utf-8"))
    except (subprocess.CalledProcessError, InputError) as error:
        said = str(getattr(error, "stderr", "") or error).strip().splitlines() or [""]
        return LiveRun(case=case, outcome="failed", error=said[-1], wall_s=time.monotonic() - began_s)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return judged(case, found).model_copy(update={"wall_s": time.monotonic() - began_s})


def _leave_right_out(station: Path) -> None:
    """Take the right camera out of a station file."""
    tables = re.split(r"\n(?=\[)", station.read_text(encoding="utf-8"))
    kept = [table for table in tables if not table.startswith("[cameras.right")]
    station.write_text("\n".join(kept), encoding="utf-8")


def session_of(options: Sequence[str], folder: Path) -> DiagnosisResult:
    """Capture a quick session of a mock bench over the wire, started with these options, and diagnose it. It lies in
    `folder`."""
    shutil.rmtree(folder, ignore_errors=True)
    with mock_bench((), options) as station:
        _command("capture", "--quick", "--station", str(station), "--out", str(folder))
    session, file = next((folder / "sessions").iterdir()), folder / "diagnose.json"
    _command("diagnose", session.name, "--json", str(file), data=folder)
    return DiagnosisResult.model_validate_json(file.read_text(encoding="utf-8"))


def _command(*arguments: str, data: Path | None = None) -> None:
    environment = dict(os.environ) | ({} if data is None else {"CALIBENCH_DATA": str(data)})
    command = [sys.executable, "-m", "calibench", *arguments]
    subprocess.run(command, check=True, capture_output=True, text=True, env=environment)


def judged(case: LiveCase, found: DiagnosisResult) -> LiveRun:
    """Return a diagnosis against what was concealed."""
    named = {effect.name: effect.sides for effect in found.effects}
    rivals = {effect.name: effect.alternatives for effect in found.effects}
    parameters = []
    wanted: dict[str, frozenset[Side]] = {}
    for spec in case.concealed:
        side, name, text = spec.split(":")
        wanted[name] = frozenset({"left", "right"} if side == "both" else {side})  # type: ignore[arg-type]
        for effect in found.effects:
            values = dict(part.split("=") for part in text.split(",")) if effect.name == name else {}
            for parameter, value in effect.parameters.items():
                if parameter in values:
                    parameters.append(
                        FoundParameter(
                            effect=name,
                            parameter=parameter,
                            unit=value.unit,
                            truth=float(values[parameter]),
                            value=value.value,
                            std=value.std,
                            interval=value.interval,
                        )
                    )
    held = found.held_out
    before = found.resolutions[0].effects_before if found.resolutions else ()
    return LiveRun(
        case=case,
        outcome=_outcome(case, named, rivals, wanted, found.verdict),
        verdict=found.verdict,
        named=named,
        rivals=rivals,
        parameters=tuple(parameters),
        chi2_before=None if held is None else held.chi2_before,
        chi2_after=None if held is None else held.chi2_after,
        n=None if held is None else held.n,
        first_named=tuple(effect.name for effect in before),
        first_rivals=tuple(rival.name for effect in before for rival in effect.rivals),
        captures=tuple(resolution.capture for resolution in found.resolutions),
        stages=tuple(_stages(found)) if case.resolve else (),
        resolve_end=found.resolve_end,
    )


def _stages(found: DiagnosisResult) -> Iterator[ResolvedStage]:
    """Yield what stood before each capture of the resolving, and at its end."""

    def stage(effects: tuple[NamedEffect, ...], captures: int) -> ResolvedStage:
        return ResolvedStage(
            named=tuple(effect.name for effect in effects),
            rivals=tuple(rival for effect in effects for rival in effect.alternatives),
            captures=captures,
            lab_s=round(sum(taken.spent_s or 0.0 for taken in found.resolutions[:captures]), 1),
        )

    for captures, taken in enumerate(found.resolutions):
        yield stage(taken.effects_before, captures)
    yield stage(found.effects, len(found.resolutions))


def _outcome(
    case: LiveCase,
    named: dict[str, tuple[Side, ...]],
    rivals: dict[str, tuple[str, ...]],
    wanted: dict[str, frozenset[Side]],
    verdict: str,
) -> Ending:
    if not wanted:
        return "healthy" if not named and verdict == "no_mismatch" else "wrong name" if named else "not named"
    right = {name: names_of(name) for name in wanted}
    allowed: frozenset[str] = frozenset().union(*right.values())
    strange = [name for name, sides in named.items() if name not in allowed or not _reaches(name, sides, wanted)]
    missing = [name for name, names in right.items() if name in names and name not in named]
    if strange:

        def stands_for(name: str) -> set[str]:
            """Concealed effects among a name's rivals that aren't named on its own sides."""
            sides = set(named[name])
            return {r for r in rivals[name] if r in wanted and sides <= wanted[r] - set(named.get(r, ()))}

        told = [stands_for(name) for name in strange]
        return "among rivals" if all(told) and set().union(*told).issuperset(missing) else "wrong name"
    return "not named" if missing else "named"


def names_of(effect: str) -> frozenset[str]:
    """Names that are right for a concealed effect: its own, unless it isn't looked for or no measurement shows it."""
    unseen = effect in visibility() and not visibility()[effect].measurements
    return NOT_LOOKED_FOR.get(effect, frozenset() if unseen else frozenset({effect}))


def _reaches(name: str, sides: tuple[Side, ...], wanted: dict[str, frozenset[Side]]) -> bool:
    """Return whether an effect was named only on sides that conceal it."""
    return name not in wanted or set(sides) <= wanted[name]


class LiveProof(Experiment[LiveCase, LiveRun]):
    """Every effect concealed on the mock bench, captured over the wire, and diagnosed."""

    result = LiveRun

    def draw(self) -> dict[str, LiveCase]:
        """Return singles, pairs, healthy cameras, and benches to resolve."""
        return every_case()

    def diagnose(self, case: LiveCase, folder: Path) -> LiveRun:
        """Run the session of a case, and its diagnosis."""
        return run_case(case, folder)

    def is_current(self, kept: LiveRun, case: LiveCase) -> bool:
        """Return whether a result is of this case, and not a failure."""
        return kept.case == case and kept.outcome != "failed"

    def describe(self, run: LiveRun) -> str:
        """Return how a case ended, and in what time."""
        return f"{run.outcome}, {run.wall_s:.0f} s"

    def score(self, runs: Mapping[str, LiveRun]) -> ScoredExperiment:
        """Return what is named of what is concealed."""
        picture = PagePicture("-live", "Parameters found over concealed ones", drawing(runs))
        return ScoredExperiment("live", f"{summary(runs)}\n\n{table(runs)}", pictures=[picture])


class IsotropicProof(LiveProof):
    """Weak losses of contrast that are alike in all directions, resolved by further captures."""

    def draw(self) -> dict[str, LiveCase]:
        """Return cameras with one such loss each."""
        return isotropic_cases()

    def score(self, runs: Mapping[str, LiveRun]) -> ScoredExperiment:
        """Return how many are named after each capture."""
        return ScoredExperiment("isotropic", isotropic_table(runs))
