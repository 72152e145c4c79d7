"""A twin's budget of uncertainty against the truth of a concealed camera: whether what it says adds most to a use's
error is what did.

The budget gives the error of a group of parameters as c' z, with z how wrong they are. Here z is known: truth less
posterior mean. What the budget ranks by its standard deviations is ranked by these errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from evaluation.independent_simulator import WAVELENGTH_NM, ConcealedCamera, Law
from lab.diagnose.outcome.model_posterior import coordinate_name, with_unnamed
from lab.formats.camera_file import CameraFile
from lab.formats.model_posterior import ModelPosterior
from lab.inference.coordinates import EffectCoordinate, coordinates
from lab.observables.flats.noise import GAIN_STD, READ_STD
from lab.observables.spectra.curves import freed_curve
from lab.twin.budget import USES, LinearUse, linear_use, with_darks
from lab.twin.predict import posterior_of
from sim.effects.base import Effect
from sim.parameters import Frozen
from sim.spectrum import FloatArray

#: Draws of the parameters that say how often the budget's first would be the truth's.
DRAWS, SEED = 4000, 1289
#: From this probability on the budget tells which contribution is the largest.
TELLS = 0.9
#: Relative size below which a singular value of the curves' modes is none.
LEAST_MODE = 1e-3


class BudgetCheck(Frozen):
    """One use of one camera.

    stated, found : contribution -> its relative standard deviation by the budget, and its error by the truth, per cent
    std_percent, error_percent : of the use, by the budget, and by all that the truth tells
    probability : that the first of `stated` is the largest error, were the budget right
    """

    use: str
    stated: dict[str, float]
    found: dict[str, float]
    std_percent: float
    error_percent: float
    probability: float

    @property
    def is_first(self) -> bool:
        """Whether the budget's largest contribution is the truth's."""
        return max(self.stated, key=self.stated.__getitem__) == max(self.found, key=self.found.__getitem__)


def check_budget(model: CameraFile, truth: ConcealedCamera, laws: Sequence[Law]) -> tuple[BudgetCheck, ...]:
    """Compare every use's budget of a fitted `model` with what its parameters were wrong by. `laws`: of the concealed
    camera, the dark current's included. Contributions of an effect whose true size nobody can state are left out."""
    posterior = with_darks(posterior_of(model), model.camera)
    whole = replace(model, effects=with_unnamed(model.effects, posterior), posterior=posterior)
    mean = dict(zip(posterior.names, posterior.mean, strict=True))
    errors = {name: error - mean.get(name, 0.0) for name, error in _errors(whole, posterior, truth, laws).items()}
    found = []
    for use in USES:
        linear = linear_use(whole, posterior, use)
        check = _checked(use, linear, errors)
        if check is not None:
            found.append(check)
    return tuple(found)


def _checked(use: str, linear: LinearUse, errors: Mapping[str, float]) -> BudgetCheck | None:
    """Return the check of a use; None where fewer than two contributions have a known truth."""
    groups = {
        name: members
        for name, members in linear.groups().items()
        if all(linear.names[i] in errors for i in members) and linear.covariance[members, members].any()
    }
    if len(groups) < 2:
        return None
    told = {name: linear.propagate_errors(members) for name, members in groups.items()}
    known = sorted({i for members in groups.values() for i in members})
    covariance = linear.covariance[np.ix_(known, known)]
    z = np.random.default_rng(SEED).multivariate_normal(np.zeros(len(known)), covariance, DRAWS, method="eigh")
    place = {i: k for k, i in enumerate(known)}
    drawn = np.array([_rms(z[:, [place[i] for i in groups[name]]] @ told[name]) for name in groups])
    true = {i: errors[linear.names[i]] for i in known}
    found = {
        name: 100.0 * float(_rms(np.array([true[i] for i in members]) @ told[name])) for name, members in groups.items()
    }
    stated = {name: 100.0 * float(np.sqrt(np.mean(one**2))) for name, one in zip(groups, drawn, strict=True)}
    first = list(groups).index(max(stated, key=stated.__getitem__))
    return BudgetCheck(
        use=use, stated=stated, found=found, std_percent=100.0 * linear.std,
        error_percent=100.0 * float(_rms(np.array([true[i] for i in known]) @ linear.gradient[known])),
        probability=float(np.mean(np.argmax(drawn, axis=0) == first)),
    )  # fmt: skip


def _rms(values: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=-1)))


def _errors(
    model: CameraFile, posterior: ModelPosterior, truth: ConcealedCamera, laws: Sequence[Law]
) -> dict[str, float]:
    """Truth less what the camera file states in the units of the posterior, by parameter; without those whose truth
    nobody can state."""
    camera, first = model.camera, posterior.first
    gain = camera.conversion_gain_dn_per_e
    dark_dn_per_s = truth.dark_e_per_s * truth.gain_dn_per_e
    found = {
        "gain": (truth.gain_dn_per_e / gain - 1.0) / GAIN_STD,
        "read": ((truth.read_noise_e / camera.read_noise_e) ** 2 - 1.0) / READ_STD,
        "black": (truth.black_level_dn - camera.black_level_dn) / first.black_level_std_dn,
        "dark": (dark_dn_per_s - camera.dark_current_e_per_s * gain) / first.dark_current_std_dn_per_s,
    }
    filtered = any(e.name == "infrared_cut_filter" for e in model.effects)  # then the effect holds the filter
    for channel, curve in camera.quantum_efficiency.items():
        modes = [name for name in posterior.names if name.startswith(f"curve:{channel}:")]
        own = truth.quantum_efficiency[channel] * (1.0 if filtered else truth.filter_transmittance[channel])
        plain = freed_curve(curve, channel, dict.fromkeys(modes, 0.0)).at(WAVELENGTH_NM)
        changes = [freed_curve(curve, channel, {name: 0.1}).at(WAVELENGTH_NM) - plain for name in modes]
        if modes:
            away = own * truth.gain_dn_per_e / gain - plain
            sizes = np.linalg.lstsq(10.0 * np.array(changes).T, away, rcond=LEAST_MODE)[0]
            found |= dict(zip(modes, sizes.tolist(), strict=True))
    for coordinate in coordinates(model.effects, camera):
        effect = model.effects[coordinate.index]
        true = _true_value(effect, coordinate, laws)
        if true is not None:
            found[coordinate_name(model.effects, coordinate)] = true
    return found


def _true_value(effect: Effect, coordinate: EffectCoordinate, laws: Sequence[Law]) -> float | None:
    """Truth less model of an effect's parameter, in its coordinate; None where the law that acts has no such
    parameter."""
    law = next((one for one in laws if one.effect == effect.name), None)
    parameters = {} if law is None else law.library_parameters()
    if law is not None and not parameters:
        return None
    true = coordinate.to_u(parameters.get(coordinate.name, coordinate.absent))
    stands = coordinate.to_u(float(getattr(effect, coordinate.name)))
    if coordinate.quantity.linear_power != 1:  # acts by its square: its sign is nobody's to know
        true = abs(true) * (1.0 if stands >= 0 else -1.0)
    return true - stands


def budget_lines(checks: Sequence[tuple[BudgetCheck, ...]]) -> list[str]:
    """The section of the page, Markdown: of each use, how often the budget's first is the truth's. `checks`: those of
    each camera."""
    lines = [
        (
            "| use | cameras | first agrees | were the budget right | where it tells | agrees there | wanted | "
            "error within 2 std |"
        ),
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    every = [one for camera in checks for one in camera]
    for use in [*USES, "all"]:
        of = [one for one in every if use in (one.use, "all")]
        if not of:
            continue
        sure = [one for one in of if one.probability >= TELLS]
        right = f"{100 * np.mean([one.is_first for one in sure]):.0f} %" if sure else "-"
        lines.append(
            f"| {use} | {len(of)} | {100 * np.mean([one.is_first for one in of]):.0f} % | "
            f"{100 * np.mean([one.probability for one in of]):.0f} % | {len(sure)} | {right} | 90 % | "
            f"{100 * np.mean([one.error_percent <= 2.0 * one.std_percent for one in of]):.0f} % |"
        )
    return lines
