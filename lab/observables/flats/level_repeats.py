"""The scatter of repeated levels beyond that by pixels' noise and a steady lamp: whether the light changes from frame
to frame."""

from __future__ import annotations

import numpy as np

from lab.errors import NotDetermined
from lab.observables.dataset import Dataset, held_out_flats
from lab.observables.flats.row_light import ROW_LIGHT, row_light_variance
from lab.observables.noise.repeatability import RepeatedMeans, repeated_levels, steady
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import LAG, acting
from sim.effects.base import Effects
from sim.uniform import Uniform

#: Relative standard deviation of a steady lamp's light from frame to frame: data sheets of regulated halogen sources
#: and integrating spheres state 0.05 %, twice that at most. No finding by itself.
STEADY_LAMP = 5.0e-4
#: Least degrees of freedom of a number, and most numbers, each of settings of neighbouring exposures.
LEAST_FREEDOM, MOST_NUMBERS = 4, 4


def measure_level_repeats(dataset: Dataset) -> Observable:
    """(S / noise)^(1/3) of flat settings with repeats, pooled over neighbouring exposures.

    S is the variance of a setting's relative levels, with f = n - 1 degrees of freedom; noise its expectation by the
    noise of pixels. The cube root of chi2_f / f is all but normal, of mean 1 - 2 / (9 f) and variance 2 / (9 f), also
    for few degrees of freedom, where a logarithm would hide much of a large variance (Wilson and Hilferty, PNAS 17,
    684, 1931). The means of dark frames scatter, as rows of one frame share noise of low frequencies and black levels
    jump; by the same DN^2 do those of flats. Nuisance parameters: that variance (`_dark_scatter`); a lamp's usual
    unsteadiness, whose variance is uncertain by s0^2, s0 = `STEADY_LAMP`; and how much wider S scatters the larger it
    is. Image lag adds to S what each repeat's predecessor leaves in it. Settings out of line with the others are left
    out (`steady`): other measurements find those. Raises NotDetermined for fewer than `LEAST_FREEDOM` degrees of
    freedom."""
    groups = _by_exposure(_seen(dataset))
    if not groups:
        raise NotDetermined(
            "level_repeats",
            f"fewer than {LEAST_FREEDOM + 1} repeats of flat settings: how steady the light is can't be told; repeat "
            "one setting ten times",
        )
    freedom = np.array([sum(len(r.away) - 1 for r in group) for group in groups], float)
    noise = np.array([_weighted(group, [r.noise for r in group]) for group in groups])
    square = np.array([sum(float(np.sum(np.square(r.away))) for r in group) for group in groups]) / freedom
    value = np.cbrt(square / noise)
    variance = 2.0 / (9.0 * freedom)
    exposure_s = np.array([_weighted(group, [r.captures[0].exposure_s for r in group]) for group in groups])

    per_dn2 = np.array([_weighted(group, [r.signal_dn**-2 for r in group]) for group in groups])
    dark_dn2, dark_std_dn2 = _dark_scatter(dataset)

    def predict(effects: Effects) -> Prediction:
        model = Uniform(dataset.camera, effects)
        more = dark_dn2 * per_dn2 + np.array(
            [model.unsteadiness**2 + row_light_variance(model, dataset.camera.rows, float(t)) for t in exposure_s]
        )
        if acting(effects, LAG):
            more = more + np.array([_of_lag(dataset, effects, group) for group in groups])
        root = np.cbrt(1.0 + more / noise)
        usual = np.cbrt(1.0 + (more + STEADY_LAMP**2) / noise) - root
        darker = np.cbrt(1.0 + (more + dark_std_dn2 * per_dn2) / noise) - root
        wider = np.diag(np.sqrt(variance * (np.square(root) - 1.0)))
        scatter = {f"scatter of repeats {number}": column for number, column in enumerate(wider)}
        usually = {"usual unsteadiness of the lamp": usual, "scatter of dark frames": darker}
        return Prediction(root * (1.0 - variance), usually | scatter)

    labels = tuple(
        Label(float(np.log(t)), "all", f"{t:.4g} s", tuple(c.id for r in group for c in r.captures), held_out=False)
        for t, group in zip(exposure_s, groups, strict=True)
    )
    return Observable(
        measurement=LEVEL_REPEATS, reach=1.0, value=value, covariance=np.diag(variance), labels=labels,
        reads=frozenset({"light.unsteadiness"}) | ROW_LIGHT | LAG, predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


def _seen(dataset: Dataset) -> list[RepeatedMeans]:
    """Return the repeats that aren't held out, of settings in line with each other (`steady`)."""
    noise, out = dataset.noise, dataset.once(held_out_flats)
    found = []
    for one in repeated_levels(dataset, noise.black, noise.gain, noise.read_dn):
        kept = [i for i, c in enumerate(one.captures) if c.id not in out]
        if len(kept) > 1:
            captures, elapsed = tuple(one.captures[i] for i in kept), one.elapsed_s[kept]
            away = one.away[kept] - one.away[kept].mean()
            found.append(RepeatedMeans(captures, away, elapsed, one.noise, one.signal_dn))
    return steady(found)


def _dark_scatter(dataset: Dataset) -> tuple[float, float]:
    """Variance of a dark frame's mean beside that by the noise of independent pixels, DN^2, and its standard deviation.

    Without repeated dark frames it may be as large as rows leave whose noise is that of their pixels.
    """
    noise = dataset.noise
    if noise.jitter_dn2_std == 0.0:
        return 0.0, max(noise.jitter_dn**2, noise.read_dn**2 / dataset.camera.rows)
    return noise.jitter_dn**2, noise.jitter_dn2_std


def _by_exposure(repeats: list[RepeatedMeans]) -> list[list[RepeatedMeans]]:
    """Settings in the order of their exposure, in at most `MOST_NUMBERS` groups of at least `LEAST_FREEDOM` degrees of
    freedom."""
    ordered = sorted(repeats, key=lambda r: (r.captures[0].exposure_s, r.captures[0].id))
    whole = sum(len(r.away) - 1 for r in ordered)
    wanted = max(LEAST_FREEDOM, -(-whole // MOST_NUMBERS))
    groups: list[list[RepeatedMeans]] = []
    free = wanted
    for one in ordered:
        if free >= wanted:
            groups.append([])
            free = 0
        groups[-1].append(one)
        free += len(one.away) - 1
    if groups and free < LEAST_FREEDOM:
        last = groups.pop()
        if groups:
            groups[-1].extend(last)
    return groups


def _weighted(group: list[RepeatedMeans], value: list[float]) -> float:
    """Mean over settings, weighted by their degrees of freedom."""
    return float(np.average(value, weights=[len(r.away) - 1 for r in group]))


def _of_lag(dataset: Dataset, effects: Effects, group: list[RepeatedMeans]) -> float:
    """Variance that image lag adds to the repeats' relative levels about the mean of each setting, as the first repeat
    often follows another level."""
    carried, total = dataset.carried_e(effects), 0.0
    for repeats in group:
        signal_e = [
            sum(max(v - dataset.noise.black, 1e-9) for v in dataset.levels(c).whole.values()) / dataset.noise.gain
            for c in repeats.captures
        ]
        added_e = [sum(carried(c, channel) for channel in dataset.levels(c).whole) for c in repeats.captures]
        share = np.array(added_e) / np.array(signal_e)
        total += float(np.sum(np.square(share - share.mean())))
    return total / sum(len(r.away) - 1 for r in group)


LEVEL_REPEATS = Measurement(
    "level_repeats",
    title="scatter of repeated levels",
    order=205,
    axis="exposure",
    unit="log s",
    make=measure_level_repeats,
    quantity="variance over noise, cube root",
    of_variances=True,
)
