"""Mean levels of the patches of a ColorChecker chart, against its published reflectances and the maker's sensitivity
curves."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from lab.capture_kinds.chart import ChartCapture
from lab.errors import NotDetermined
from lab.observables.charts.patches import Patch, patch_covariance, patch_levels
from lab.observables.darks.level import added_dark_dn
from lab.observables.dataset import Dataset
from lab.observables.flats.row_light import ROW_LIGHT, nuisances, row_light_scatter
from lab.observables.observable import LEVEL_REACH, Label, Measurement, Observable, Prediction
from lab.observables.reads import DARK_CURRENT
from lab.observables.spectra.curves import CurveJacobian
from lab.observables.surroundings import halo_light
from sim.effects.base import Effects
from sim.point import even_share, wide_contrast
from sim.scene.colorchecker import reflectances
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import LEVEL, SPECTRAL, FieldPoints, Uniform, electron_rate

#: Prior standard deviation of the light's level on the chart, and of its gradient from the middle to a side of the
#: frame, relative.
CHART_SCALE_STD, CHART_GRADIENT_STD = 0.05, 0.005


def measure_chart(dataset: Dataset) -> Observable:
    """Mean level (DN) of every patch of a ColorChecker24 by channel.

    Nuisance parameters: level and gradient of the light, the maker's sensitivity curves, black level and dark current.
    Tolerances of the reflectances are in the covariance. Raises NotDetermined where the sensitivity curves aren't
    stated, and with fewer than twelve unclipped patches.
    """
    if not dataset.stated.quantum_efficiency:
        raise NotDetermined(
            "chart", "the maker's sensitivity curves aren't stated: nothing to hold the recordings against"
        )
    points = patch_levels(dataset)
    if len(points) < 12:
        raise NotDetermined("chart", "fewer than twelve unclipped patches of a ColorChecker24")
    noise, camera = dataset.noise, dataset.camera
    value = np.array([p.level for p in points])
    exposures = np.array([p.captures[0].exposure_s for p in points])
    row, col = np.array([p.row for p in points]), np.array([p.col for p in points])
    tail = np.array([p.tail for p in points])
    offset = noise.black + noise.dark_dn_per_s * exposures
    signal = np.maximum(value - offset, 0.1)
    surround = np.array([p.frame for p in points]) - offset  # the mean light, of which a veil adds a share
    place = FieldPoints.at(camera, row, col)
    known = reflectances(points[0].captures[0].chart)
    curves = CurveJacobian(
        dataset,
        [(p.captures[0].radiance, p.channel, p.captures[0].exposure_s, "chart", known[p.name]) for p in points],
        signal / noise.gain / exposures,
    )
    names = {n: i for i, n in enumerate(known)}

    unmeasured = _unmeasured_rates(dataset, points, known)
    of_channel = {name: np.array([p.channel == name for p in points]) for name in dataset.channels}

    def predict(effects: Effects) -> Prediction:
        rates = curves.rates(effects)
        model = Uniform(camera, effects)
        time = np.array([model.collected_s(float(t)) for t in exposures])
        ambient = np.array([model.ambient_e(p.channel, float(t)) for p, t in zip(points, exposures, strict=True)])
        electrons = rates * model.field(place).light * (time + model.leaked_s(place))
        if model.strays:
            electrons = _strayed(points, electrons, place, model)
        electrons = electrons * _mixing(points, electrons, model, unmeasured)
        veil = even_share(camera, effects) * surround + halo_light([p.around for p in points], effects, camera)
        electrons = wide_contrast(camera, effects) * electrons + (veil + tail) / noise.gain + ambient
        more = added_dark_dn(dataset, effects)
        dark = noise.dark_dn_per_s * exposures + np.array([more(p.captures[0]) for p in points])
        read_dn = np.empty(len(points))
        for name, mine in of_channel.items():
            read_dn[mine] = model.mean_dn({name: (electrons + dark / noise.gain)[mine, None]})[name]
        lit = read_dn - dark
        offset = dataset.offset(effects)
        shift = np.array([offset(p.captures[0]) for p in points])

        def jacobian() -> dict[str, FloatArray]:
            found = dataset.free_offsets(exposures) | dataset.free_warmth([p.captures[0] for p in points])
            found |= {k: v * lit / np.maximum(rates, 1e-30) for k, v in curves.jacobian(effects).items()}
            found["chart:scale"] = CHART_SCALE_STD * lit
            found["chart:x"] = CHART_GRADIENT_STD * lit * (col / camera.cols - 0.5) * 2
            found["chart:y"] = CHART_GRADIENT_STD * lit * (row / camera.rows - 0.5) * 2
            found |= _row_light(points, model, camera.rows, lit)
            return found

        return Prediction(noise.black + read_dn + shift, jacobian)

    return Observable(
        measurement=CHART,
        reach=LEVEL_REACH,
        along=np.log(np.maximum(signal, 1.0)),
        value=value,
        covariance=patch_covariance(dataset, points, signal),
        labels=tuple(
            Label(float(names[p.name]), p.channel, p.name, tuple(c.id for c in p.captures), p.held_out) for p in points
        ),
        reads=(LEVEL - {"light.level"}) | SPECTRAL | DARK_CURRENT | {"image.veils"},
        scattered_by=ROW_LIGHT,
        predict=predict,
        scale=signal,
    )


def _row_light(points: list[Patch], model: Uniform, rows: int, lit: FloatArray) -> dict[str, FloatArray]:
    """Jacobian of the patches' levels by a light that varies while a frame is taken, of each capture's frames at
    once."""
    by_capture: dict[tuple[ChartCapture, ...], list[int]] = {}
    for i, p in enumerate(points):
        by_capture.setdefault(p.captures, []).append(i)
    vectors = []
    for captures, members in by_capture.items():
        at = np.clip(np.round([points[i].row for i in members]).astype(int), 0, rows - 1)
        exposure_s = captures[0].exposure_s
        for one in row_light_scatter(model, rows, exposure_s, len(captures), partial(np.take, indices=at, axis=1)):
            whole = np.zeros(len(points))
            whole[members] = one * lit[members]
            vectors.append(whole)
    return nuisances("chart", vectors)


def _strayed(points: list[Patch], electrons: FloatArray, place: FieldPoints, model: Uniform) -> FloatArray:
    """Return the patches' electrons (n,) after light that misses its pixel fell on the next ones."""
    found = np.empty(len(points))
    for members in _by_patch(points):
        where = [*members.values()]
        there = FieldPoints(*(v[where] for v in (place.x_um, place.y_um, place.light)))
        after = model.stray_light({c: electrons[i] * np.ones(len(where)) for c, i in members.items()}, there)
        for k, (c, i) in enumerate(members.items()):
            found[i] = after[c][k]
    return found


def _by_patch(points: list[Patch]) -> list[dict[str, int]]:
    """Return the index of each channel, of every patch of every capture."""
    found: dict[tuple[str, str], dict[str, int]] = {}
    for i, p in enumerate(points):
        found.setdefault((p.captures[0].id, p.name), {})[p.channel] = i
    return [*found.values()]


def _unmeasured_rates(
    dataset: Dataset, points: list[Patch], known: Mapping[str, Spectrum]
) -> list[dict[str, float]]:  # fmt: skip
    """Return, of every patch of every capture, the electron rates of the channels that have no pixels in its inner
    part, over that of its first measured channel: neighbours of each pixel have them nevertheless."""
    found = []
    for members in _by_patch(points):
        first, at = next(iter(members.items()))
        light = dataset.spectrum(points[at].captures[0].radiance)

        def rate(channel: str, light: Spectrum = light, reflectance: Spectrum = known[points[at].name]) -> float:
            return electron_rate(dataset.camera, channel, light, kind="chart", reflectance=reflectance)

        missing = [c for c in dataset.channels if c not in members]
        found.append({c: rate(c) / max(rate(first), 1e-30) for c in missing} if missing else {})
    return found


def _mixing(
    points: list[Patch], electrons: FloatArray, model: Uniform, unmeasured: list[dict[str, float]]
) -> FloatArray:  # fmt: skip
    """Factors (n,) on the patches' electrons by effects that move charge between neighbouring pixels of different
    channels."""
    factor = np.ones(len(points))
    for members, others in zip(_by_patch(points), unmeasured, strict=True):
        first = float(electrons[next(iter(members.values()))])
        levels = {c: float(electrons[i]) for c, i in members.items()} | {
            c: share * first for c, share in others.items()
        }
        at = points[next(iter(members.values()))]
        mixed = model.mixing_factors(levels, (at.row, at.col))
        for c, i in members.items():
            factor[i] = mixed.get(c, 1.0)
    return factor


CHART = Measurement(
    "chart",
    title="patches of the chart",
    order=300,
    axis="level",
    unit="DN",
    make=measure_chart,
    quantity="mean level, DN",
    is_level=True,
    places="patches",
)
