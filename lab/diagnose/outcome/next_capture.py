"""The capture that would best tell apart what is still undecided.

Every capture that could be taken is predicted by the forward model under each rival, at the parameters that the recordings give it;
the best is the one in which the two nearest rivals lie furthest apart:

    argmax over captures c of min over rivals k, l of D = 1/2 |L^-1 (m_k(c) - m_l(c))|^2,   L L' = what scatters m(c)

(noise, floors, and what stays free). Two rivals are then told apart rightly with probability Phi(sqrt(D / 2)).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.special import ndtr

from lab.capture.sequences.calibration import Calibration
from lab.capture.sequences.dark import DarkSequence
from lab.capture.sequences.flat import FlatSequence
from lab.capture.sequences.narrowband import NarrowbandSequence
from lab.capture.sequences.targets import EdgeSequence
from lab.diagnose.inference.decide import Candidate, Verdict
from lab.diagnose.inference.evidence import Evidence
from lab.diagnose.inference.refit import refit
from lab.diagnose.inference.score import signatures
from lab.diagnose.measurements.curves import CURVE_ROUGH_STD, freed_curve
from lab.diagnose.measurements.summaries import BLACK_FLOOR_DN, LAMP_FLOOR, NARROWBAND_FLOOR
from lab.formats.recording_set import RecordingSet
from lab.formats.results import NextCapture
from lab.predict.camera_model import Field, collected_electrons, mean_dn
from sim.camera import CameraModel, Side
from sim.effects.base import Effect
from sim.effects.library import effects as library
from sim.forward import electron_rate, optical_transfer
from sim.spectrum import FloatArray, Spectrum

#: Rivals less likely than this aren't listed; told apart are the likeliest that together hold so much, and so many at most.
SMALLEST_RIVAL, TOLD_SHARE, MOST_RIVALS = 0.005, 0.9, 4
#: A capture is worth taking where it brings the nearest rivals so far apart: D = 2 tells them apart in 84 % of all cases.
WORTH_TAKING = 2.0
#: As many captures are listed.
LISTED = 5
#: What a capture that was planned holds: pixels of a channel, repeats, electrons of its brightest channel over the full well.
PIXELS, REPEATS, FILLED = 2e4, 4, 0.6
VARIANCE_STD = 0.003  # of a variance, beside its noise
EDGE_STD = 0.004  # of a transfer function, where no edge says
FREE_STD = 10.0  # of a level that stays free: so wide that nothing is known of it
BEHIND_S = 3600.0  # a session: over which drifts show

#: What to vary where no capture that can be predicted tells two effects apart, but one depends on a thing and the other doesn't.
SETTLING = {
    "f_number": "the slanted edges again at twice the f-number",
    "wavelength": "slanted edges in narrowband light, at 450 and at 650 nm",
    "orientation": "slanted edges at four orientations, 5, 50, 95 and 140 degrees from the vertical",
    "exposure": "the same captures at a quarter of the exposure and four times the light",
    "level": "the same captures at a quarter of the light",
    "field": "the same captures at the corners of the field",
    "time": "the same captures again, in the reverse order",
}


@dataclass(frozen=True)
class Hypothesis:
    """A rival with the effects that act beside it, and the camera where the recordings put what is free of it."""

    name: str
    effects: tuple[Effect, ...]
    camera: CameraModel


@dataclass(frozen=True)
class Design:
    """A capture that could be taken: what a hypothesis predicts of it (n,), its scatter (n, n), and the sequence that takes it on a
    station (None: a station can't by itself)."""

    words: str
    predict: Callable[[Hypothesis], FloatArray]
    covariance: FloatArray
    plan: Calibration | None = None


@dataclass(frozen=True)
class Proposal:
    """A capture with what it would tell."""

    capture: NextCapture
    plan: Calibration | None


def proposals(recordings: RecordingSet, side: Side, verdict: Verdict) -> tuple[Proposal, ...]:
    """What to capture next, best first; nothing where nothing is undecided."""
    rivals = _rivals(verdict)
    if len(rivals) < 2:
        return ()
    found = []
    for design in _designs(recordings, side, verdict.evidence):
        lower = cholesky(design.covariance, lower=True)
        white = {h.name: solve_triangular(lower, design.predict(h), lower=True) for h in rivals}
        pairs = {(a, b): 0.5 * float(np.sum(np.square(white[a] - white[b]))) for a, b in combinations(white, 2)}
        nearest = min(pairs, key=lambda pair: pairs[pair])
        found.append((pairs[nearest], nearest, design))
    found.sort(key=lambda item: -item[0])
    return tuple(
        Proposal(
            NextCapture(
                side=side,
                capture=design.words,
                rivals=nearest,
                distance=distance,
                told_apart=float(ndtr(np.sqrt(0.5 * distance))),
            ),
            design.plan,
        )
        for distance, nearest, design in found[:LISTED]
    )


def _rivals(verdict: Verdict) -> list[Hypothesis]:
    """The most undecided effect and its rivals, each fitted in its place."""
    evidence = verdict.evidence

    def open_share(candidate: Candidate) -> float:
        return sum(p for name, p in candidate.rivals if name in library() and p >= SMALLEST_RIVAL)

    candidates = [c for c in (*verdict.named, *verdict.abstained) if open_share(c) > 0]
    if not candidates:
        return []
    chosen = max(candidates, key=open_share)
    beside = tuple(e for e in verdict.effects if e.name != chosen.effect.name)
    found = [_hypothesis(evidence, chosen.effect.name, (*beside, chosen.effect))]
    held = [(chosen.probability, chosen.effect.name), *((p, name) for name, p in chosen.rivals if name in library())]
    before = np.cumsum([0.0, *(p for p, _ in held)]) / sum(p for p, _ in held)
    for (p, name), reached in list(zip(held, before, strict=False))[1:MOST_RIVALS]:
        if p < SMALLEST_RIVAL or (reached > TOLD_SHARE and len(found) > 1):
            break
        scores = signatures(evidence, evidence.camera, beside, [library()[name]]).scores()
        if scores:
            fit = refit(evidence, (*beside, scores[0].start), passes=2)
            found.append(_hypothesis(evidence, name, fit.effects))
    return found


def _hypothesis(evidence: Evidence, name: str, effects: tuple[Effect, ...]) -> Hypothesis:
    quantities = evidence.quantities(effects)
    curves = {c: freed_curve(q, c, quantities) for c, q in evidence.camera.quantum_efficiency.items()}
    camera = evidence.camera.model_copy(update={"quantum_efficiency": curves})
    return Hypothesis(name, (*evidence.always, *effects), camera)


# --- what could be captured ----------------------------------------------------------------------------------------------


def _designs(recordings: RecordingSet, side: Side, evidence: Evidence) -> Iterator[Design]:
    camera = evidence.camera
    lamp = _lamp(recordings, side)
    yield from _narrowband(camera)
    yield from _edges(camera, evidence, lamp)
    yield from _ladders(camera, lamp)
    yield from _steady(camera, lamp)
    yield from _darks(camera)
    yield from _again(evidence)


def _lamp(recordings: RecordingSet, side: Side) -> Spectrum:
    """The light of the flats, else of equal energy."""
    for kind in ("flat", "chart"):
        for capture in recordings.captures(kind, side):
            path = getattr(capture, "radiance", None)
            if path is not None:
                return recordings.spectrum(path)
    return Spectrum.of((380.0, 780.0), (0.01, 0.01))


def _exposed(camera: CameraModel, light: Spectrum, kind: str = "flat") -> float:
    """Exposure (s) that fills the brightest channel's wells to `FILLED`."""
    brightest = max(electron_rate(camera, c, light, (), kind) for c in camera.channels)
    return FILLED * camera.full_well_e / brightest if brightest > 0 else 0.0


def _means(h: Hypothesis, light: Spectrum, kind: str, exposure_s: float, elapsed_s: float = 0.0) -> dict[str, float]:
    """Mean electrons of uniform light by channel, after the read-out."""
    rates = {c: electron_rate(h.camera, c, light, h.effects, kind) for c in h.camera.channels}
    collected = collected_electrons(
        h.camera, rates, exposure_s, h.effects, field=Field.of(h.camera).under(h.camera, h.effects), elapsed_s=elapsed_s
    )
    gain = h.camera.conversion_gain_dn_per_e
    return {c: value / gain for c, value in mean_dn(h.camera, collected, h.effects).items()}


def _narrowband(camera: CameraModel) -> Iterator[Design]:
    """Light of one wavelength, every 5 nm."""
    for centre in np.arange(400.0, 721.0, 5.0):
        light = Spectrum.of((centre - 10.0, centre, centre + 10.0), (0.0, 1e-3, 0.0))
        exposure = _exposed(camera, light, "narrowband")
        if exposure <= 0:
            continue

        def predict(h: Hypothesis, light: Spectrum = light, exposure: float = exposure) -> FloatArray:
            return np.array(list(_means(h, light, "narrowband", exposure).values()))

        signal = predict(Hypothesis("", (), camera))
        noise = (signal + camera.read_noise_e**2) / (PIXELS * REPEATS)
        loose = np.square(signal) * (NARROWBAND_FLOOR**2 + CURVE_ROUGH_STD**2)
        around = {"from_nm": float(centre - 5.0), "to_nm": float(centre + 5.0), "step_nm": 2.5}
        yield Design(
            f"narrowband light at {centre:g} nm",
            predict,
            np.diag(noise + loose + (BLACK_FLOOR_DN / camera.conversion_gain_dn_per_e) ** 2),
            Calibration(narrowband=NarrowbandSequence.model_validate(around)),
        )


def _edges(camera: CameraModel, evidence: Evidence, lamp: Spectrum) -> Iterator[Design]:
    """Slanted edges: at four orientations, in the lamp's and in narrowband light, at the lens's and at twice its f-number."""
    frequency = np.arange(1, 17) * 0.05
    block = next((b for b in evidence.blocks if b.measurement == "slanted_edge"), None)
    std = np.full(frequency.shape, EDGE_STD)
    if block is not None:  # of the best edge there was, frequency by frequency
        x, variance = np.array([label.x for label in block.labels]), np.diag(block.covariance)
        places = np.unique(x)
        std = np.interp(frequency, places, [float(np.sqrt(variance[x == place].min())) for place in places])
    angles = np.deg2rad([5.0, 50.0, 95.0, 140.0])
    fx, fy = np.outer(np.cos(angles), frequency), np.outer(np.sin(angles), frequency)
    lights = {"the lamp's light": lamp} | {
        f"light of {nm:g} nm": Spectrum.of((nm - 10.0, nm, nm + 10.0), (0.0, 1e-3, 0.0)) for nm in (450.0, 550.0, 650.0)
    }
    for stops, at in ((1.0, ""), (2.0, " at twice the f-number")):
        for name, light in lights.items():
            sighted = [c for c in camera.channels if electron_rate(camera, c, light) > 0]

            def predict(
                h: Hypothesis, stops: float = stops, light: Spectrum = light, channels: list[str] = sighted
            ) -> FloatArray:
                lens = h.camera.lens.model_copy(update={"f_number": stops * h.camera.lens.f_number})
                stopped = h.camera.model_copy(update={"lens": lens})
                return np.concatenate(
                    [np.real(optical_transfer(stopped, c, light, fx, fy, h.effects)).ravel() for c in channels]
                )

            n = len(sighted) * fx.size
            plain = stops == 1.0 and light is lamp
            plan = Calibration(edge=EdgeSequence(frames=2 * REPEATS)) if plain else None
            if n:
                words = f"slanted edges at 5, 50, 95 and 140 degrees in {name}{at}"
                yield Design(words, predict, np.diag(np.square(np.tile(std, n // len(std)))), plan)


def _ladders(camera: CameraModel, lamp: Spectrum) -> Iterator[Design]:
    """Flats at many levels: by the exposure, or by the light at one exposure. Mean and variance; their scales are free."""
    shares = np.array([0.01, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.92]) / FILLED
    full = _exposed(camera, lamp)
    if full <= 0:
        return
    dimmed = [Spectrum.of(*(lamp.arrays[0], share * lamp.arrays[1])) for share in shares]
    ladders = {
        "flats at ten exposures, from 1 to 92 % of the full well": [(lamp, share * full) for share in shares],
        "flats at one exposure and ten levels of the light, from 1 to 92 % of the full well": [
            (d, full) for d in dimmed
        ],
    }
    for words, steps in ladders.items():

        def predict(h: Hypothesis, steps: list[tuple[Spectrum, float]] = steps) -> FloatArray:
            levels = [list(_means(h, light, "flat", seconds).values()) for light, seconds in steps]
            mean = np.array(levels).T.ravel()
            variance = mean + h.camera.read_noise_e**2
            for effect in h.effects:
                variance = effect.noise_e2(mean, variance, h.camera)
            return np.concatenate([mean, variance])

        mean, variance = np.split(predict(Hypothesis("", (), camera)), 2)
        std = np.concatenate(
            [
                np.hypot(np.sqrt(variance / (PIXELS * REPEATS)), 2.0 * LAMP_FLOOR * mean),
                np.hypot(np.sqrt(2.0 / (PIXELS * (REPEATS - 1))), VARIANCE_STD) * variance,
            ]
        )
        covariance = np.diag(np.square(std))
        zero = np.zeros_like(mean)
        free = [np.concatenate([zero, mean]), np.concatenate([zero, np.ones_like(mean)])]  # gain and read noise
        free += [np.concatenate([np.ones_like(mean), zero])]  # black level
        for channel in np.split(np.arange(len(mean)), len(camera.channels)):  # the light
            rate = np.zeros(2 * len(mean))
            rate[channel] = mean[channel]
            free.append(rate)
        covariance += FREE_STD**2 * sum(np.outer(column, column) for column in free)
        by_exposure = all(light is lamp for light, _ in steps)
        sequence = FlatSequence(levels=tuple((FILLED * shares).round(3).tolist()), frames=2 * REPEATS)
        yield Design(words, predict, covariance, Calibration(flat=sequence) if by_exposure else None)


def _steady(camera: CameraModel, lamp: Spectrum) -> Iterator[Design]:
    """The same flat again and again: the lamp's level is free, what becomes of it isn't."""
    full = _exposed(camera, lamp)
    times = np.linspace(0.0, BEHIND_S, 13)
    if full <= 0:
        return

    def predict(h: Hypothesis) -> FloatArray:
        return np.array([list(_means(h, lamp, "flat", full, float(t)).values()) for t in times]).T.ravel()

    mean = predict(Hypothesis("", (), camera))
    noise = (mean + camera.read_noise_e**2) / (PIXELS * REPEATS)
    levels = np.kron(np.eye(len(camera.channels)), np.ones((len(times), len(times)))) * np.outer(mean, mean)
    yield Design(
        "the same flat every five minutes for an hour",
        predict,
        np.diag(noise + np.square(2.0 * LAMP_FLOOR * mean)) + FREE_STD**2 * levels,
    )


def _darks(camera: CameraModel) -> Iterator[Design]:
    """Dark frames by exposure, by time and by temperature; black level and dark current are free."""
    gain, reference = camera.conversion_gain_dn_per_e, camera.dark_current_reference_c
    times = np.linspace(0.0, BEHIND_S, 13)
    ladders = {
        "dark frames every five minutes for an hour": [(0.01, t, reference) for t in times],
        "dark frames with the sensor 10 and 20 degrees warmer": [
            (s, 0.0, reference + c) for c in (0, 10, 20) for s in (0.01, 1.0, 5.0)
        ],
        "dark frames from 1 ms to 20 s": [(s, 0.0, reference) for s in np.geomspace(0.001, 20.0, 10)],
    }
    for words, steps in ladders.items():

        def predict(h: Hypothesis, steps: list[tuple[float, float, float]] = steps) -> FloatArray:
            found = []
            for seconds, elapsed, temperature in steps:
                dark: FloatArray | float = h.camera.dark_current_e_per_s
                shift = 0.0
                for effect in h.effects:
                    dark = effect.dark_current(dark, temperature, h.camera)
                    shift += effect.offset_dn(elapsed, temperature, h.camera)
                found.append(float(np.mean(dark)) * seconds * gain + shift)
            return np.array(found)

        seconds = np.array([s for s, _, _ in steps])
        covariance = np.eye(len(steps)) * (2 * BLACK_FLOOR_DN) ** 2
        covariance += FREE_STD**2 * (np.ones_like(covariance) + np.outer(seconds, seconds))
        exposures = "from 1 ms" in words
        plan = Calibration(dark=DarkSequence(exposures_s=tuple(seconds.round(4).tolist()), frames=REPEATS))
        yield Design(words, predict, covariance, plan if exposures else None)


def _again(evidence: Evidence) -> Iterator[Design]:
    """Every measurement once more, as it was."""
    for block, at in zip(evidence.blocks, evidence.slices, strict=True):

        def predict(h: Hypothesis, at: slice = at) -> FloatArray:
            return evidence.levelled(tuple(e for e in h.effects if e not in evidence.always))[at]

        name = block.measurement.replace("_", " ")
        yield Design(f"the captures of {name} again, with as many repeats", predict, block.covariance)


# --- in words --------------------------------------------------------------------------------------------------------------


def next_sentence(found: Sequence[NextCapture], unsettled: bool) -> str | None:
    """The best capture of all sides as a sentence. `unsettled`: something is unexplained."""
    if not found:
        return (
            "Repeat the captures that are off at another exposure and another f-number: what the mismatch follows says where it arises."
            if unsettled
            else None
        )
    best = max(found, key=lambda one: one.distance)
    one, other = best.rivals
    if best.distance >= WORTH_TAKING:
        return (
            f"{best.capture[0].upper()}{best.capture[1:]} would tell {one} from {other}: their predictions lie {np.sqrt(2.0 * best.distance):.1f} "
            f"standard deviations apart there, which decides rightly in {100 * min(best.told_apart, 0.999):.3g} % of all cases."
        )
    beyond = f"no capture that can be predicted tells {one} from {other} by more than {np.sqrt(2.0 * best.distance):.1f} standard deviations"
    differs = library()[one].invariances ^ library()[other].invariances
    for thing, capture in SETTLING.items():
        if thing in differs:
            steady = one if thing in library()[one].invariances else other
            return f"{capture[0].upper()}{capture[1:]} may tell them apart ({beyond}): only {steady} stays the same."
    return f"{beyond[0].upper()}{beyond[1:]}: both depend on the same things."
