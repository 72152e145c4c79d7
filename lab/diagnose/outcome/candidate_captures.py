"""Captures that a station or a person could take next, each with the forward model's prediction of it and its
covariance."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import constants

from lab.capture.plan import CapturePlan
from lab.capture_kinds.base import Equipment
from lab.capture_kinds.dark import DarkCapture, DarkSequence, TemperatureTarget
from lab.capture_kinds.flat import FlatSequence
from lab.capture_kinds.narrowband import NarrowbandSequence
from lab.capture_kinds.screen import ScreenSequence
from lab.capture_kinds.slanted_edge import EdgeSequence, EdgeTarget, TurnTarget
from lab.capture_kinds.stopped_edge import ApertureTarget, StoppedEdgeSequence
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.outcome.expected_information import Forecast
from lab.diagnose.outcome.settling_capture import FEW_REPEATS, MORE_REPEATS, repeats_of
from lab.formats.recording_set import RecordingSet
from lab.observables.noise.figures import BLACK_FLOOR_DN
from lab.observables.noise.repeatability import LAMP_FLOOR
from lab.observables.spectra.curves import CURVE_ROUGH_STD
from sim.camera import CameraModel, Side
from sim.effects.base import Effect
from sim.optics.imaging import DiffractionLimited
from sim.point import optical_transfer
from sim.spectrum import FloatArray, Spectrum
from sim.stop_down import at_f_number, effects_at_f_number
from sim.uniform import FieldPoints, Uniform, electron_rate

#: Size of a capture that is assumed: pixels of a channel, repeats, and the brightest channel's electrons over the full
#: well.
PIXELS, REPEATS, FILLED = 2e4, 4, 0.6
#: Standard deviations that don't average out: of a variance, relative, beside its noise; of a transfer function, where
#: no edge tells.
VARIANCE_STD, EDGE_STD = 0.003, 0.004
#: Prior standard deviation of a level that is a nuisance parameter, relative: so wide that it says nothing.
NUISANCE_STD = 10.0
#: Directions of knife edges (deg from the vertical) where no station says them, and wavelengths of their light beside
#: white. A channel that sees less of a light than this share of the brightest isn't counted.
EDGE_ANGLES_DEG, EDGE_LIGHTS_NM, DIMMEST_CHANNEL = (5.0, 50.0, 95.0, 140.0), (450.0, 550.0, 650.0), 0.02
#: Turns of a knife edge by hand (deg) where a station says none; a direction is a new one where it lies so far (deg)
#: from every other.
TURNS_DEG, LEAST_TURN_DEG = (45.0, 90.0), 15.0
#: Wavelengths (nm) between which a light source's light is taken to lie, its colour temperature (K) where none is
#: stated, the share of its full level at which it is dimmed, and the levels then, shares of `FILLED`.
LED_LIGHT_NM, USUAL_LIGHT_K, DIMMED, DIMMED_SHARES = (410.0, 680.0), 5000.0, 0.1, (0.05, 0.2, 0.6, 1.0)
#: By how much (C) sensors are warmed where a station says no temperatures, and exposures (s) of darks at each.
WARMER_C, WARM_EXPOSURES_S = (10.0, 20.0), (0.01, 1.0, 5.0)
#: What a station lacks for a capture that no sequence takes.
BY_HAND = "no sequence takes it; take it by hand and diagnose it with the session's captures"
#: Length of a session (s), over which drifts show.
SESSION_S = 3600.0


@dataclass(frozen=True)
class Hypothesis:
    """A rival with the effects that act beside it, and the camera with its nuisance parameters at their posterior
    means.

    `displaced`: the same effects with the rival's parameters one posterior standard deviation away, a set for each
    principal direction of these; `beside`: those that act beside the rival; `law_std`: relative standard deviation of
    what its law changes. `law_stds`: by the name of an effect, relative standard deviation of what its law changes
    beside the others.
    """

    name: str
    effects: tuple[Effect, ...]
    camera: CameraModel
    displaced: tuple[tuple[Effect, ...], ...] = ()
    beside: tuple[Effect, ...] | None = None
    law_std: float = 0.0
    law_stds: Mapping[str, float] = field(default_factory=dict)

    def without(self) -> Iterator[tuple[tuple[Effect, ...], float]]:
        """Yield the effects without one whose law may be wrong, and the relative standard deviation of its change."""
        if self.beside is not None and self.law_std > 0.0:
            yield self.beside, self.law_std
        for name, std in self.law_stds.items():
            if std > 0.0:
                yield tuple(e for e in self.effects if e.name != name), std


@dataclass(frozen=True)
class CandidateCapture:
    """A capture that could be taken."""

    words: str
    predict: Callable[[Hypothesis], FloatArray]  # (n,): its numbers under a hypothesis
    covariance: FloatArray  # (n, n)
    plan: CapturePlan | None = None  # the sequence that takes it; None: no sequence does
    needs: str = BY_HAND  # what a station lacks where `plan` is None

    def forecast(self, rivals: Sequence[Hypothesis]) -> Forecast:
        """Return what rivals predict of it, with what their parameters and their laws leave open."""
        mean = np.array([self.predict(h) for h in rivals])
        jacobian, law_error = [], []
        for h, own in zip(rivals, mean, strict=True):
            moved = [self.predict(replace(h, effects=effects)) - own for effects in h.displaced]
            jacobian.append(np.reshape(moved, (len(moved), -1)).T if moved else np.zeros((len(own), 0)))
            wrong = [std * (own - self.predict(replace(h, effects=effects))) for effects, std in h.without()]
            law_error.append(np.reshape(wrong, (len(wrong), -1)).T if wrong else np.zeros((len(own), 0)))
        return Forecast.of(mean, jacobian, law_error, self.covariance)


def candidate_captures(
    recordings: RecordingSet, side: Side, model: MeasurementModel, station: Equipment | None = None
) -> Iterator[CandidateCapture]:
    """All captures that are considered, in order: narrowband, edges, flats, darks, and those of the session again.
    `station`: the edges, the f-numbers and the light source's lights of the plans are its own; None: edges and
    f-numbers of any station, and no light source."""
    camera = model.camera
    lamp = _lamp(recordings, side)
    yield from _narrowband(camera)
    yield from _edges(camera, model, lamp, station)
    yield from _exposure_series(camera, lamp)
    if station is not None:
        yield from _colour_temperatures(camera, station)
        yield from _dimmed(camera, station)
    yield from _steady(camera, lamp)
    yield from _darks(camera, station)
    yield from _again(recordings, side, model)


def _lamp(recordings: RecordingSet, side: Side) -> Spectrum:
    """Return the light of the flats or the chart, else of equal energy."""
    for kind in ("flat", "chart"):
        for capture in recordings.captures(kind, side):
            path = getattr(capture, "radiance", None)
            if path is not None:
                return recordings.spectrum(path)
    return Spectrum.of((380.0, 780.0), (0.01, 0.01))


def _filling_exposure_s(camera: CameraModel, light: Spectrum, kind: str = "flat") -> float:
    """Exposure (s) that fills the brightest channel to `FILLED` of the full well; 0 where no channel sees the light."""
    brightest = max(electron_rate(camera, c, light, (), kind) for c in camera.channels)
    return FILLED * camera.full_well_e / brightest if brightest > 0 else 0.0


def _means(h: Hypothesis, light: Spectrum, kind: str, exposure_s: float, elapsed_s: float = 0.0) -> dict[str, float]:
    """Mean electrons of uniform light by channel, after the read-out."""
    rates = {c: electron_rate(h.camera, c, light, h.effects, kind) for c in h.camera.channels}
    model = Uniform(h.camera, h.effects)
    field = model.field(FieldPoints.of(h.camera))
    collected = model.electrons(rates, exposure_s, field=field, elapsed_s=elapsed_s)
    gain = h.camera.conversion_gain_dn_per_e
    return {c: float(value) / gain for c, value in model.mean_dn(collected).items()}


def _narrowband(camera: CameraModel) -> Iterator[CandidateCapture]:
    """Light of one wavelength, every 5 nm."""
    for centre in np.arange(400.0, 721.0, 5.0):
        light = Spectrum.of((centre - 10.0, centre, centre + 10.0), (0.0, 1e-3, 0.0))
        exposure = _filling_exposure_s(camera, light, "narrowband")
        if exposure <= 0:
            continue

        def predict(h: Hypothesis, light: Spectrum = light, exposure: float = exposure) -> FloatArray:
            return np.array(list(_means(h, light, "narrowband", exposure).values()))

        signal = predict(Hypothesis("", (), camera))
        noise = (signal + camera.read_noise_e**2) / (PIXELS * REPEATS)
        floor = np.square(CURVE_ROUGH_STD * signal)
        around = {"from_nm": float(centre - 5.0), "to_nm": float(centre + 5.0), "step_nm": 2.5}
        yield CandidateCapture(
            f"narrowband light at {centre:g} nm",
            predict,
            np.diag(noise + floor + (BLACK_FLOOR_DN / camera.conversion_gain_dn_per_e) ** 2),
            CapturePlan((NarrowbandSequence.model_validate(around),)),
        )


def _edges(
    camera: CameraModel, model: MeasurementModel, lamp: Spectrum, station: Equipment | None
) -> Iterator[CandidateCapture]:
    """Slanted edges: at all orientations and at each, in the lamp's and in narrowband light, at the lens's f-number and
    at others."""
    frequency = np.arange(1, 17) * 0.05
    block = next((b for b in model.blocks if b.measurement.name == "slanted_edge"), None)
    std = np.full(frequency.shape, EDGE_STD)
    if block is not None:  # the smallest standard deviation of any recorded edge at each frequency
        x, variance = np.array([label.x for label in block.labels]), np.diag(block.covariance)
        places = np.unique(x)
        std = np.interp(frequency, places, [float(np.sqrt(variance[x == place].min())) for place in places])
    edges = _edge_angles(station)
    turned = _turned_edges(station, edges)
    lights = {("the lamp's light", 0.0): lamp} | {
        (f"light of {nm:g} nm", nm): Spectrum.of((nm - 10.0, nm, nm + 10.0), (0.0, 1e-3, 0.0)) for nm in EDGE_LIGHTS_NM
    }
    usual = camera.lens.f_number
    stops = [usual]
    if isinstance(camera.lens.imaging, DiffractionLimited):
        stops += [f for f in _stops(station, usual) if f != usual]
    for (light_words, nm), light in lights.items():
        rate = {c: electron_rate(camera, c, light) for c in camera.channels}
        brightest = max(rate.values())
        lit = {c: float(np.sqrt(brightest / one)) for c, one in rate.items() if one > DIMMEST_CHANNEL * brightest > 0.0}
        for f_number in stops if lit else ():
            at = "" if f_number == usual else f" at f/{f_number:g}"
            # what two hands change, the ring's and the holder's, is never proposed at once
            by_turn = {0.0: [tuple(edges), *((one,) for one in edges)]} | (turned if f_number == usual else {})
            for turn_deg, which in ((turn, one) for turn, ones in by_turn.items() for one in ones):
                at_deg = [edges[name] + turn_deg for name in which]
                angles = np.deg2rad(at_deg)
                fx, fy = np.outer(np.cos(angles), frequency), np.outer(np.sin(angles), frequency)

                def predict(
                    h: Hypothesis,
                    f_number: float = f_number,
                    light: Spectrum = light,
                    channels: tuple[str, ...] = tuple(lit),
                    fx: FloatArray = fx,
                    fy: FloatArray = fy,
                ) -> FloatArray:
                    stopped = h.camera if f_number == usual else at_f_number(h.camera, f_number)
                    effects = effects_at_f_number(h.effects, usual, f_number)
                    return np.concatenate(
                        [np.real(optical_transfer(stopped, c, light, fx, fy, effects)).ravel() for c in channels]
                    )

                noise = np.concatenate([np.tile(dimmer * std, len(which)) for dimmer in lit.values()])
                is_one = len(which) == 1
                words = f"{'a slanted edge' if is_one else 'slanted edges'} at {_listed(at_deg)} degrees"
                words += f", {which[0]} turned by {turn_deg:g} degrees," if turn_deg else ""
                named = which if is_one and station is not None else ()
                yield CandidateCapture(
                    f"{words} in {light_words}{at}",
                    predict,
                    np.diag(np.square(noise)),
                    _edge_plan(nm, f_number, usual, named, turn_deg),
                )


def _edge_angles(station: Equipment | None) -> dict[str, float]:
    """Return the knife edges of a station by name, with their angles (deg) from the vertical; those of any station
    where it has none."""
    there = station.list_targets(EdgeTarget) if station is not None else {}
    return {name: edge.angle_deg for name, edge in there.items()} or {f"edge {a:g}": a for a in EDGE_ANGLES_DEG}


def _turned_edges(station: Equipment | None, edges: dict[str, float]) -> dict[float, list[tuple[str, ...]]]:
    """Return the turns of a station's knife edges by hand that give a direction which it hasn't otherwise, each with
    the edge that is turned; of a station without such turns, those of `TURNS_DEG`, which it then lacks."""
    if station is None:
        return {}
    there = sorted({turn.angle_deg for turn in station.list_targets(TurnTarget).values()} - {0.0}) or TURNS_DEG
    known = list(edges.values())
    found: dict[float, list[tuple[str, ...]]] = {}
    for turn_deg in there:
        for name, angle_deg in edges.items():
            if all(abs((angle_deg + turn_deg - other + 90.0) % 180.0 - 90.0) >= LEAST_TURN_DEG for other in known):
                known.append(angle_deg + turn_deg)
                found.setdefault(turn_deg, []).append((name,))
    return found


def _stops(station: Equipment | None, usual: float) -> tuple[float, ...]:
    """Return the f-numbers that a station's lenses are set to; without any, twice the usual one."""
    there = station.list_targets(ApertureTarget) if station is not None else {}
    return tuple(sorted({stop.f_number for stop in there.values()} - {usual})) or (2.0 * usual,)


def _edge_plan(
    wavelength_nm: float, f_number: float, usual: float, edges: tuple[str, ...], turn_deg: float
) -> CapturePlan:
    if f_number == usual:
        edge = EdgeSequence(frames=REPEATS, wavelength_nm=wavelength_nm, edges=edges, turn_deg=turn_deg)
        return CapturePlan((edge,))
    stopped = StoppedEdgeSequence(frames=REPEATS, wavelength_nm=wavelength_nm, edges=edges, f_number=f_number)
    return CapturePlan((stopped,))


def _listed(values: Iterable[float]) -> str:
    """Numbers in words: 5, 50 and 95."""
    *first, last = (f"{value:.3g}" for value in values)
    return f"{', '.join(first)} and {last}" if first else last


def _exposure_series(camera: CameraModel, lamp: Spectrum) -> Iterator[CandidateCapture]:
    """Flats at many levels: by the exposure, or by the light at one exposure. Means and variances. Nuisance parameters:
    gain, read noise, black level, and the light in each channel."""
    shares = np.array([0.01, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.92]) / FILLED
    full = _filling_exposure_s(camera, lamp)
    if full <= 0:
        return
    dimmed = [Spectrum.of(*(lamp.arrays[0], share * lamp.arrays[1])) for share in shares]
    series = {
        "flats at ten exposures, from 1 to 92 % of the full well": [(lamp, share * full) for share in shares],
        "flats at one exposure and ten levels of the light, from 1 to 92 % of the full well": [
            (d, full) for d in dimmed
        ],
    }
    for words, steps in series.items():

        def predict(h: Hypothesis, steps: list[tuple[Spectrum, float]] = steps) -> FloatArray:
            levels = [list(_means(h, light, "flat", seconds).values()) for light, seconds in steps]
            mean = np.array(levels).T.ravel()
            variance = Uniform(h.camera, h.effects).shot_e2(mean) + h.camera.read_noise_e**2
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
        jacobian = [np.concatenate([zero, mean]), np.concatenate([zero, np.ones_like(mean)])]  # gain and read noise
        jacobian += [np.concatenate([np.ones_like(mean), zero])]  # black level
        for channel in np.split(np.arange(len(mean)), len(camera.channels)):  # the light
            rate = np.zeros(2 * len(mean))
            rate[channel] = mean[channel]
            jacobian.append(rate)
        covariance += NUISANCE_STD**2 * sum(np.outer(column, column) for column in jacobian)
        by_exposure = all(light is lamp for light, _ in steps)
        sequence = FlatSequence(levels=tuple((FILLED * shares).round(3).tolist()), frames=2 * REPEATS)
        yield CandidateCapture(words, predict, covariance, CapturePlan((sequence,)) if by_exposure else None)


def _colour_temperatures(camera: CameraModel, station: Equipment) -> Iterator[CandidateCapture]:
    """Flats in the light source's light of each colour temperature that the station states. Their spectra will be
    measured; till then they are a black body's between `LED_LIGHT_NM`. The level is a nuisance parameter, so that the
    ratios of the channels tell."""
    if len(camera.channels) < 2:
        return
    for kelvin in _colour_temperatures_k(station):
        light = _black_body(kelvin)
        exposure = _filling_exposure_s(camera, light)
        if exposure <= 0:
            continue

        def predict(h: Hypothesis, light: Spectrum = light, exposure: float = exposure) -> FloatArray:
            return np.array(list(_means(h, light, "flat", exposure).values()))

        mean = predict(Hypothesis("", (), camera))
        noise = (mean + camera.read_noise_e**2) / (PIXELS * REPEATS)
        floor = np.square(CURVE_ROUGH_STD * mean)
        black = (BLACK_FLOOR_DN / camera.conversion_gain_dn_per_e) ** 2
        flats = FlatSequence(levels=(FILLED,), frames=REPEATS, lamp_level=1.0, colour_temperature_k=kelvin)
        yield CandidateCapture(
            f"flats in the light source's light of {kelvin:g} K",
            predict,
            np.diag(noise + floor + black) + NUISANCE_STD**2 * np.outer(mean, mean),
            CapturePlan((flats,)),
        )


def _colour_temperatures_k(station: Equipment) -> list[float]:
    """Return the colour temperatures (K) of a station's lights, ascending."""
    return sorted({one.colour_temperature_k for one in station.lights.values() if one.colour_temperature_k is not None})


def _black_body(kelvin: float) -> Spectrum:
    """Return the light of a black body (W sr^-1 m^-2 nm^-1, scaled to 0.01 at 560 nm) between `LED_LIGHT_NM`."""
    wavelength_nm = np.arange(LED_LIGHT_NM[0], LED_LIGHT_NM[1] + 1.0, 10.0)
    x, at_560 = (constants.h * constants.c / (nm * 1e-9 * constants.k * kelvin) for nm in (wavelength_nm, 560.0))
    value = 0.01 * (560.0 / wavelength_nm) ** 5 * np.expm1(at_560) / np.expm1(x)
    return Spectrum.of(wavelength_nm, value)


def _dimmed(camera: CameraModel, station: Equipment) -> Iterator[CandidateCapture]:
    """Flats at the light source's full level and at `DIMMED` of it, exposed longer by as much: what follows the
    exposure differs between the two, what follows the signal doesn't. Nuisance parameters: the light at each level,
    and the black level."""
    if not station.lights:
        return
    kelvin = next(iter(station.lights.values())).colour_temperature_k
    light = _black_body(kelvin or USUAL_LIGHT_K)
    full = _filling_exposure_s(camera, light)
    if full <= 0:
        return
    wavelength_nm, value = light.arrays
    lights = {1.0: light, DIMMED: Spectrum.of(wavelength_nm, DIMMED * value)}
    steps = [(level, one, share * full / level) for level, one in lights.items() for share in DIMMED_SHARES]

    def predict(h: Hypothesis) -> FloatArray:
        return np.array([list(_means(h, one, "flat", seconds).values()) for _, one, seconds in steps]).ravel()

    mean = predict(Hypothesis("", (), camera))
    noise = (mean + camera.read_noise_e**2) / (PIXELS * REPEATS)
    level = np.repeat([level for level, *_ in steps], len(camera.channels))
    channel = np.tile(np.arange(len(camera.channels)), len(steps))
    free = [np.where((level == at) & (channel == c), mean, 0.0) for at in lights for c in range(len(camera.channels))]
    free.append(np.ones_like(mean))
    flats = [
        FlatSequence(
            levels=tuple((FILLED * np.array(DIMMED_SHARES)).round(3).tolist()),
            frames=REPEATS,
            lamp_level=at,
            colour_temperature_k=kelvin,
        )
        for at in lights
    ]
    yield CandidateCapture(
        f"flats at the light source's full level and at {100.0 * DIMMED:g} % of it, exposed {1.0 / DIMMED:g} times as "
        "long",
        predict,
        np.diag(noise + np.square(2.0 * LAMP_FLOOR * mean)) + NUISANCE_STD**2 * sum(np.outer(c, c) for c in free),
        CapturePlan(tuple(flats)),
    )


def _steady(camera: CameraModel, lamp: Spectrum) -> Iterator[CandidateCapture]:
    """Yield the same flat, repeated over an hour. The lamp's level is a nuisance parameter, its change with time
    isn't."""
    full = _filling_exposure_s(camera, lamp)
    times = np.linspace(0.0, SESSION_S, 13)
    if full <= 0:
        return

    def predict(h: Hypothesis) -> FloatArray:
        return np.array([list(_means(h, lamp, "flat", full, float(t)).values()) for t in times]).T.ravel()

    mean = predict(Hypothesis("", (), camera))
    noise = (mean + camera.read_noise_e**2) / (PIXELS * REPEATS)
    levels = np.kron(np.eye(len(camera.channels)), np.ones((len(times), len(times)))) * np.outer(mean, mean)
    yield CandidateCapture(
        "the same flat every five minutes for an hour",
        predict,
        np.diag(noise + np.square(2.0 * LAMP_FLOOR * mean)) + NUISANCE_STD**2 * levels,
    )


def _darks(camera: CameraModel, station: Equipment | None) -> Iterator[CandidateCapture]:
    """Dark frames by exposure, by time and by temperature; black level and dark current are nuisance parameters. The
    temperatures are those that a hand brings the sensors of `station` to."""
    gain, reference = camera.conversion_gain_dn_per_e, camera.dark_current_reference_c
    times = np.linspace(0.0, SESSION_S, 13)
    known = () if station is None else station.list_targets(TemperatureTarget).values()
    warm_c = sorted({one.sensor_c for one in known if one.sensor_c is not None})
    warm_words = f"dark frames with the sensor at {_listed(warm_c)} C" if warm_c else ""
    if not warm_c:
        warm_c, warm_words = [reference + c for c in WARMER_C], "dark frames with the sensor 10 and 20 degrees warmer"
    series = {
        "dark frames every five minutes for an hour": [(0.01, t, reference) for t in times],
        warm_words: [(s, 0.0, at_c) for at_c in (reference, *warm_c) for s in WARM_EXPOSURES_S],
        "dark frames from 1 ms to 20 s": [(s, 0.0, reference) for s in np.geomspace(0.001, 20.0, 10)],
    }
    for words, steps in series.items():

        def predict(h: Hypothesis, steps: list[tuple[float, float, float]] = steps) -> FloatArray:
            found = []
            for seconds, elapsed, temperature in steps:
                model = Uniform(h.camera, h.effects)
                dark = float(np.mean(model.dark_e_per_s(temperature))) + model.mean_hot_e_per_s
                found.append(dark * seconds * gain + model.offset_dn(elapsed, temperature, seconds))
            return np.array(found)

        seconds = np.array([s for s, _, _ in steps])
        covariance = np.eye(len(steps)) * (2 * BLACK_FLOOR_DN) ** 2
        covariance += NUISANCE_STD**2 * (np.ones_like(covariance) + np.outer(seconds, seconds))
        plan = None
        if "from 1 ms" in words:
            plan = CapturePlan((DarkSequence(exposures_s=tuple(seconds.round(4).tolist()), frames=REPEATS),))
        elif words == warm_words and station is not None:
            plan = CapturePlan(
                tuple(
                    DarkSequence(exposures_s=WARM_EXPOSURES_S, frames=REPEATS, sensor_c=at_c)
                    for at_c in (None, *warm_c)
                )
            )
        yield CandidateCapture(words, predict, covariance, plan)


def _again(recordings: RecordingSet, side: Side, model: MeasurementModel) -> Iterator[CandidateCapture]:
    """Every measurement again with the same captures. Those of dark frames with few repeats get more, which reduces
    their covariance."""
    darks = {c.id: c for c in recordings.captures(DarkCapture, side)}
    screens = {c.id for kind in ScreenSequence.kinds().values() for c in recordings.captures(kind, side)}
    repeats = repeats_of(darks.values())
    fitted: dict[tuple[Effect, ...], FloatArray] = {}
    for block, at in zip(model.blocks, model.slices, strict=True):

        def predict(h: Hypothesis, at: slice = at) -> FloatArray:
            if h.effects not in fitted:
                fitted[h.effects] = model.fitted_mean(tuple(e for e in h.effects if e not in model.always))
            return fitted[h.effects][at]

        title = block.measurement.title
        names = {name for label in block.labels for name in label.captures}
        if 0 < repeats < FEW_REPEATS and names <= set(darks):
            exposures = tuple(sorted({darks[name].exposure_s for name in names if darks[name].exposure_s > 0}))
            plan = CapturePlan((DarkSequence(exposures_s=exposures, frames=MORE_REPEATS),)) if exposures else None
            words = f"the dark frames of {title} again, {MORE_REPEATS} at each setting in place of {repeats}"
            yield CandidateCapture(words, predict, block.covariance * repeats / MORE_REPEATS, plan)
        else:
            words = f"the captures of {title} again, with as many repeats"
            plan = CapturePlan((ScreenSequence(frames=REPEATS),)) if names <= screens else None
            yield CandidateCapture(words, predict, block.covariance, plan)
