"""Open a sealed prediction against the recordings of the session that it foretold."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.stats import norm

from lab.capture_kinds.base import Capture
from lab.errors import InputError
from lab.formats.camera_file import lens_cache, trace_table
from lab.formats.recording_set import RecordingSet
from lab.formats.results import Skipped
from lab.observables.dataset import Dataset
from lab.observables.edges.slanted_edge import SLANTED_EDGE
from lab.observables.edges.transfer import REAL_AT
from lab.observables.flats.linearity import PHOTON_TRANSFER
from lab.observables.gaussian import chi2
from lab.observables.observable import Label, measurement_title
from lab.one_blas_thread import one_blas_thread
from lab.shown import Tabular
from lab.twin.predict import QUANTITIES, is_predicted, measure_blocks
from lab.twin.sealed import PredictedName, PredictedNumber, SealedPrediction, SidePrediction, TwinNumber
from sim.camera import CameraModel, Side
from sim.optics.table import load_cached
from sim.parameters import Frozen
from sim.spectrum import FloatArray

#: Half width of a 95 % interval, in standard deviations.
WIDTH_95 = float(norm.ppf(0.975))
#: Most relative change of an exposure, change of a temperature (C) and of a corner (px) that still is the session that
#: was predicted.
MOST_EXPOSURE, MOST_C, MOST_PX = 0.25, 3.0, 4.0
#: Most relative difference of an f-number from that of the prediction.
MOST_F_NUMBER = 0.02
#: Least change of the logarithm of the likelihood that an effect makes for its name to be tested.
LEAST_GAIN = 2.0
#: Measurements whose numbers a prediction may hold.
SCORED = (*QUANTITIES, PHOTON_TRANSFER)
#: Probability from which on one of the rivals is the name.
SURE = 0.95
#: Probability that a rival has at least before a session: so sure is no diagnosis.
LEAST_PROBABILITY = 1e-3
#: Keys of the data sheet that have to be those of the prediction.
SHEET = ("rows", "cols", "cfa", "bit_depth", "f_number")


class ScoredNumber(TwinNumber):
    """One number: predicted, moved to the exposure and temperature that were really set, and measured."""

    side: Side
    measured: float
    deviation: float
    deviation_sigma: float
    deviation_percent: float

    @property
    def is_inside(self) -> bool:
        """Whether the measured number lies in the 95 % interval."""
        return abs(self.deviation_sigma) <= WIDTH_95


class QuantityScore(Frozen):
    """All numbers of one quantity. Deviations of an MTF are absolute, all others in per cent."""

    quantity: str
    n: int
    unit: Literal["%", "1"]
    median: float
    largest_of_95_percent: float
    within_95_percent_interval: float
    chi2: float


class TestedRival(Frozen):
    """A rival of a name. `gain`: log likelihood of the numbers with it less that with the name; `before`, `after`: its
    probability without and with these numbers."""

    name: str
    gain: float
    before: float
    after: float = 0.0


TwinVerdict = Literal["survives", "withdrawn", "named", "untested"]


class TestedEffect(Frozen):
    """Whether a name survives.

    name, effect : as it was told, an effect's or a family's, and the effect that stands for it in the model
    gain : log likelihood of the numbers with it less that with nothing in its place
    before : probability of the effect among its rivals, without these numbers
    verdict : `survives`; `withdrawn`: the numbers are likelier without it, or a rival predicted them (`becomes`);
        `named`: of a family, `becomes` is the effect that predicted them; `untested`: they show too little of it
    probability : of `becomes`, else of the effect, among the rivals, with these numbers
    """

    side: Side
    name: str
    effect: str
    gain: float
    before: float
    verdict: TwinVerdict = "untested"
    becomes: str | None = None
    probability: float = 1.0
    rivals: tuple[TestedRival, ...] = ()

    @property
    def words(self) -> str:
        """The verdict as a lab reads it, with the figures that it rests on."""
        title = self.name.replace("_", " ")
        replacement = (self.becomes or "").replace("_", " ")
        was = next((rival.before for rival in self.rivals if rival.name == self.becomes), self.before)
        shares = f"probability {self.probability:.3g}, before {was:.2g}"
        if self.verdict == "named":
            return f"{title}: is {replacement} ({shares})"
        if self.verdict == "withdrawn" and self.becomes is not None:
            return f"{title}: withdrawn: {replacement} predicted the session ({shares})"
        return f"{title}: {self.verdict} (log likelihood {self.gain:+.1f})"


class TwinScore(Tabular, Frozen):
    """The result of `calibench twin score`."""

    format: Literal["calibench-twin-score"] = "calibench-twin-score"
    version: Literal[2] = 2
    source: str
    quantities: tuple[QuantityScore, ...]
    effects: tuple[TestedEffect, ...]
    chi2: float
    n: int
    numbers: tuple[ScoredNumber, ...]
    missing: int
    skipped: tuple[Skipped, ...] = ()


def conclusion(effects: Sequence[TestedEffect]) -> str:
    """Return what is named of one camera after its tests, in a line: names that stand, those that were withdrawn, and
    those that the session doesn't test.

    >>> conclusion([])
    'stands: no name'
    """

    def join_names(*verdicts: TwinVerdict) -> str:
        mine = [effect for effect in effects if effect.verdict in verdicts]
        return ", ".join((effect.becomes or effect.name).replace("_", " ") for effect in mine)

    gone = [effect for effect in effects if effect.verdict == "withdrawn"]
    named = ", ".join(
        f"{effect.becomes} in place of {effect.name}".replace("_", " ") for effect in gone if effect.becomes is not None
    )
    parts = {
        "stands": ", ".join(filter(None, (join_names("survives", "named"), named))) or "no name",
        "withdrawn": ", ".join(effect.name.replace("_", " ") for effect in gone),
        "untested": join_names("untested"),
    }
    return "; ".join(f"{key}: {said}" for key, said in parts.items() if said)


@one_blas_thread
def score(sealed: SealedPrediction, recordings: RecordingSet) -> TwinScore:
    """Compare a sealed prediction with the measured session. Raises InputError where the recordings aren't of the
    session that was predicted.
    """
    for side, prediction in sealed.sides.items():
        check_session(prediction, recordings, side)
    numbers: list[ScoredNumber] = []
    effects: list[TestedEffect] = []
    skipped: list[Skipped] = []
    whole, missing = 0.0, 0
    parts: dict[str, float] = {}
    for side, prediction in sealed.sides.items():
        camera = _camera(sealed, side)
        dataset = Dataset(_with_curves(recordings, prediction, camera, side), side, camera)
        wanted = {number.quantity for number in prediction.numbers}
        of_edges = [number.x for number in prediction.numbers if number.quantity == SLANTED_EDGE.name]
        if of_edges:
            dataset.highest_cy_per_px = min(of_edges) / REAL_AT[0]
        blocks, left_out = measure_blocks(dataset, tuple(m for m in SCORED if m.name in wanted))
        skipped += left_out
        measured = {
            _key(b.measurement.name, label): (float(v), label.x)
            for b in blocks
            for v, label in zip(b.value, b.labels, strict=True)
            if is_predicted(b, label)
        }
        bare = {
            _key(b.measurement.name, label): float(v)
            for b in blocks
            if b.measurement is SLANTED_EDGE
            for v, label in zip(b.predict(()).mean, b.labels, strict=True)
        }
        present = [i for i, number in enumerate(prediction.numbers) if number.key in measured]
        missing += len(prediction.numbers) - len(present)
        if not present:
            raise InputError(
                f"{recordings.source}: none of the {side} camera's predicted numbers is measured there; give the "
                "session that was predicted"
            )
        moved = np.array(
            [_predict_at_settings(prediction.numbers[i], prediction, recordings, measured, bare) for i in present]
        )
        seen = np.array([measured[prediction.numbers[i].key][0] for i in present])
        covariance = _square(prediction)[np.ix_(present, present)]
        whole += chi2(seen - moved, covariance)
        for name in dict.fromkeys(prediction.numbers[i].quantity for i in present):
            mine = np.array([prediction.numbers[i].quantity == name for i in present])
            parts[name] = parts.get(name, 0.0) + chi2((seen - moved)[mine], covariance[np.ix_(mine, mine)])
        at = np.array([prediction.numbers[i].predicted for i in present])
        for predicted_name in prediction.names:
            changes = [np.array(rival.numbers)[present] - at for rival in predicted_name.rivals]
            effects.append(_weigh_name(side, predicted_name, seen - moved, changes, covariance))
        numbers += [
            _score_number(side, prediction.numbers[i], m, v) for i, m, v in zip(present, moved, seen, strict=True)
        ]
    return TwinScore(
        source=recordings.source, quantities=tuple(_quantity(name, numbers, value) for name, value in parts.items()),
        effects=tuple(effects), chi2=whole, n=len(numbers), numbers=tuple(numbers), missing=missing,
        skipped=tuple(skipped),
    )  # fmt: skip


def _camera(sealed: SealedPrediction, side: Side) -> CameraModel:
    """Return the changed camera of a side. A traced lens is sealed by its hash: its table is the one that is kept on
    this computer, else traced from the file of the changes. Raises InputError where neither is that lens."""
    content = json.loads(sealed.cameras[side])
    imaging = content["lens"]["imaging"]
    if imaging["kind"] == "traced_lens":
        wanted = imaging["content_hash"]
        table = load_cached(lens_cache(), wanted)
        file = sealed.changes.lens
        if table is None and file is not None and file.is_file():
            table = trace_table(file)
        if table is None or table.content_hash != wanted:
            where = f"lens: {file}" if file is not None else f"the {side} camera's lens"
            raise InputError(
                f"{where}: isn't the traced lens that was sealed, {wanted}; give its file where it was then"
            )
        content["lens"]["imaging"] = {"kind": "traced_lens", "table": table}
    return CameraModel.model_validate(content)


def check_session(prediction: SidePrediction, recordings: RecordingSet, side: Side) -> None:
    """Raises InputError where the recordings aren't of the session that was predicted: another data sheet, gain or
    setting."""
    stated = recordings.camera(side)
    isnt = f"{recordings.source}: isn't the session that was predicted:"
    for key in SHEET:
        there, wanted = getattr(stated, key), getattr(prediction.camera, key)
        is_same = there == wanted
        if key == "f_number" and there is not None and wanted is not None:  # a traced lens has it of its rays
            is_same = abs(there / wanted - 1.0) <= MOST_F_NUMBER
        if not is_same:
            raise InputError(f"{isnt} {key} of the {side} camera is {there}, predicted {wanted}; give that session")
    taken_captures = {c.id: c for c in recordings.captures(side=side)}
    for planned in prediction.captures:
        taken = taken_captures.get(planned.id)
        if taken is None or taken.kind != planned.kind:
            raise InputError(f"{isnt} it has no {planned.kind} capture {planned.id}; give that session")
        for key, there, wanted, most in _settings(taken, planned):
            if abs(there - wanted) > most:
                raise InputError(f"{isnt} {key} of {planned.id} is {there:g}, predicted {wanted:g}; give that session")


def _settings(taken: Capture, planned: Capture) -> list[tuple[str, float, float, float]]:
    """(key, as taken, as predicted, largest difference)."""
    settings = [
        ("gain_db", taken.gain_db or 0.0, planned.gain_db or 0.0, 0.01),
        ("exposure_s", taken.exposure_s, planned.exposure_s, MOST_EXPOSURE * planned.exposure_s),
    ]
    if taken.temperature_c is not None and planned.temperature_c is not None:
        settings.append(("temperature_c", taken.temperature_c, planned.temperature_c, MOST_C))
    for key in ("corners", "region"):
        there, wanted = (np.ravel(getattr(c, key, None) or 0.0) for c in (taken, planned))
        if there.shape == wanted.shape:
            settings += [(key, float(a), float(b), MOST_PX) for a, b in zip(there, wanted, strict=True)]
    return settings


def _with_curves(recordings: RecordingSet, prediction: SidePrediction, camera: CameraModel, side: Side) -> RecordingSet:
    """Return the recordings under the data sheet of the prediction, without which the chart isn't measured."""
    sheet = recordings.camera(side).model_copy(
        update={"quantum_efficiency": prediction.camera.quantum_efficiency, "pixel_pitch_um": camera.pixel_pitch_um}
    )
    cameras = dict(recordings.manifest.cameras) | {side: sheet}
    return recordings.under(recordings.manifest.model_copy(update={"cameras": cameras}))


def _key(quantity: str, label: Label) -> tuple[object, ...]:
    return PredictedNumber(
        quantity=quantity, captures=label.captures, channel=label.channel, where=label.condition, x=label.x,
        predicted=0.0, std=0.0,
    ).key  # fmt: skip


def _predict_at_settings(
    number: PredictedNumber,
    prediction: SidePrediction,
    recordings: RecordingSet,
    measured: dict[tuple[object, ...], tuple[float, float]],
    bare: dict[tuple[object, ...], float],
) -> float:
    """Return the prediction at the exposure, temperature and level that were really set, and of an edge for the samples
    that were really recorded."""
    if number.without_effects is not None:
        return number.predicted + bare[number.key] - number.without_effects
    if number.level_dn is not None:
        return number.predicted + number.level_slope * (measured[number.key][1] - number.level_dn)
    taken = recordings.capture(number.captures[0])
    planned = next(c for c in prediction.captures if c.id == taken.id)
    longer = taken.exposure_s / planned.exposure_s if planned.exposure_s > 0 else 1.0
    warmer = 0.0
    if taken.temperature_c is not None and planned.temperature_c is not None:
        warmer = taken.temperature_c - planned.temperature_c
    light = number.predicted - number.fixed - number.dark
    return float(number.fixed + longer * (light + number.dark * np.exp(number.warmth_per_c * warmer)))


def _square(prediction: SidePrediction) -> FloatArray:
    """Return the covariance (n, n) of a prediction."""
    n = len(prediction.numbers)
    out = np.zeros((n, n))
    out[np.tril_indices(n)] = prediction.covariance
    return np.asarray(out + np.tril(out, -1).T)


def _weigh_name(
    side: Side, name: PredictedName, residual: FloatArray, changes: list[FloatArray], covariance: FloatArray
) -> TestedEffect:
    """Weigh a name against its rivals, which change the prediction by `changes` (n,) each. Log likelihoods are tempered
    by chi2 / n of the best of them where that is above 1: what none predicts counts for none."""
    fits = [chi2(residual - change, covariance) for change in changes]
    present = chi2(residual, covariance)
    tempered = max(min(present, *fits) / len(residual), 1.0)
    gains = [0.5 * (present - fit) / tempered for fit in fits]
    is_told = any(0.5 * chi2(change, covariance) >= LEAST_GAIN for change in changes)
    absent = -next((gain for rival, gain in zip(name.rivals, gains, strict=True) if not rival.name), 0.0)
    rivals = [
        TestedRival(name=rival.name, gain=gain, before=rival.probability)
        for rival, gain in zip(name.rivals, gains, strict=True)
        if rival.name
    ]
    plain = TestedEffect(side=side, name=name.told, effect=name.effect, gain=absent, before=name.probability)
    return _judge(plain, rivals, is_told)


def _judge(plain: TestedEffect, rivals: Sequence[TestedRival], is_told: bool) -> TestedEffect:
    """Return the verdict on a name by its gain over nothing and the gains of its rivals over it."""
    weights = {plain.effect: float(np.log(max(plain.before, LEAST_PROBABILITY)))}
    weights |= {rival.name: float(np.log(max(rival.before, LEAST_PROBABILITY))) + rival.gain for rival in rivals}
    top = max(weights.values())
    whole = sum(np.exp(w - top) for w in weights.values())
    after = {key: float(np.exp(w - top) / whole) for key, w in weights.items()}
    likeliest = max(after, key=lambda key: after[key])
    gain = {rival.name: rival.gain for rival in rivals} | {plain.effect: 0.0}
    verdict: TwinVerdict = "survives" if plain.gain > 0 else "withdrawn"
    becomes = None
    is_another = likeliest != plain.effect or plain.name != plain.effect
    if not is_told:
        verdict = "untested"
    elif is_another and after[likeliest] >= SURE and plain.gain + gain[likeliest] > 0:
        becomes = likeliest
        verdict = "withdrawn" if plain.name == plain.effect else "named"
    return plain.model_copy(
        update={
            "verdict": verdict,
            "becomes": becomes,
            "probability": after[becomes or plain.effect],
            "rivals": tuple(rival.model_copy(update={"after": after[rival.name]}) for rival in rivals),
        }
    )


def combine_sessions(tests: Sequence[Sequence[TestedEffect]]) -> tuple[TestedEffect, ...]:
    """Return what several sessions say together of the names of one model: log likelihoods add up."""
    members_of: dict[tuple[Side, str], list[TestedEffect]] = {}
    for session in tests:
        for test in session:
            members_of.setdefault((test.side, test.effect), []).append(test)
    whole = []
    for members in members_of.values():
        decisive = [test for test in members if test.verdict != "untested"]
        first = members[0]
        rivals = [
            rival.model_copy(
                update={"gain": sum(r.gain for test in decisive for r in test.rivals if r.name == rival.name)}
            )
            for rival in first.rivals
        ]
        plain = first.model_copy(update={"gain": sum(test.gain for test in decisive)})
        whole.append(_judge(plain, rivals, bool(decisive)))
    return tuple(whole)


def _score_number(side: Side, number: PredictedNumber, moved: float, seen: float) -> ScoredNumber:
    away = seen - moved
    return ScoredNumber(
        side=side, quantity=number.quantity, captures=number.captures, channel=number.channel, where=number.where,
        x=number.x,
        predicted=moved, std=number.std, measured=seen, deviation=away, deviation_sigma=away / number.std,
        deviation_percent=100.0 * away / max(abs(moved), 1e-12),
    )  # fmt: skip


def _quantity(name: str, numbers: list[ScoredNumber], value: float) -> QuantityScore:
    mine = [n for n in numbers if n.quantity == name]
    is_share = name == "slanted_edge"
    away = np.abs([n.deviation if is_share else n.deviation_percent for n in mine])
    return QuantityScore(
        quantity=name, n=len(mine), unit="1" if is_share else "%", median=float(np.median(away)),
        largest_of_95_percent=float(np.quantile(away, 0.95)),
        within_95_percent_interval=float(np.mean([n.is_inside for n in mine])), chi2=value,
    )  # fmt: skip


def title(quantity: str) -> str:
    """Return the name of a predicted quantity in words.

    >>> title("slanted_edge")
    'transfer function of slanted edges'
    """
    return measurement_title(quantity)
