"""How well the parameters of a camera model are known together: a JSON file beside the camera file.

A parameter is a nuisance parameter of the diagnosis (`gain`, `curve:G:0`), a parameter of an effect
(`veiling_glare.share_percent`), or the reflectance of a chart's patch in one channel (`patch:white:G`).
"""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import model_validator

from sim.effects.base import Effect
from sim.effects.library import effect as library_effect
from sim.parameters import Frozen
from sim.spectrum import FloatArray

#: Beginning of the names of patches' reflectances.
PATCH = "patch:"


class FirstEstimates(Frozen):
    """The figures about which a session's predictions were linear, and the scatter of its levels from repeat to
    repeat."""

    dark_temperature_c: float | None  # that the camera's dark current holds for; None: not known
    read_noise_dn: float  # as recorded, rounding included
    black_level_std_dn: float
    dark_current_std_dn_per_s: float
    level_jitter_dn: float  # standard deviation of a dark frame's mean
    lamp_jitter: float  # relative standard deviation of a flat frame's mean
    code_step_dn: float = 1.0  # step of the codes


class StoredEffect(Frozen):
    """An effect by its name and fields, as a camera file has it."""

    name: str
    values: dict[str, float | int | str | tuple[float, ...] | None]

    @classmethod
    def of(cls, effect: Effect) -> Self:
        """Return what is stored of an effect."""
        return cls(name=effect.name, values=effect.model_dump())

    def effect(self) -> Effect:
        """Return the effect. Raises ValueError for one that the library doesn't have."""
        acting: Effect = library_effect(self.name).model_validate(self.values)
        return acting


class RivalModel(Frozen):
    """The camera with a rival in the place of a named effect (`name` empty: with nothing there). `effects`: all that
    were named or stand in for them; `shift`: what the posterior means of the parameters differ by then."""

    name: str
    probability: float
    effects: tuple[StoredEffect, ...]
    shift: dict[str, float]


class NameInDoubt(Frozen):
    """A name, and what else may be meant.

    effect, told : of the effect in the camera file, and as it was told: its name, or its family's
    probability : of the effect among its rivals
    named : names of all effects that the rivals' `effects` stand in for
    """

    effect: str
    told: str
    probability: float
    named: tuple[str, ...]
    rivals: tuple[RivalModel, ...]


class ModelPosterior(Frozen):
    """Posterior mean (k,) and covariance (k, k) of a camera model's parameters.

    A nuisance parameter is in prior standard deviations of the diagnosis from what the camera file states. An effect's
    parameter is in its coordinate (`Quantity.linear_power`, `logarithmic`) from what the file states, a reflectance
    relative to the published one."""

    format: Literal["calibench-posterior"] = "calibench-posterior"
    version: Literal[1] = 1
    first: FirstEstimates
    names: tuple[str, ...]
    mean: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    doubts: tuple[NameInDoubt, ...] = ()

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        k = len(self.names)
        if len(self.mean) != k or len(self.covariance) != k or any(len(row) != k for row in self.covariance):
            raise ValueError(f"{k} names need {k} means and a covariance of {k} x {k}; write the file again")
        return self

    @classmethod
    def of(cls, first: FirstEstimates, names: tuple[str, ...], mean: FloatArray, covariance: FloatArray) -> Self:
        """Return the posterior of these arrays, in the nine digits that its file keeps."""
        rows = [[float(f"{value:.9g}") for value in row] for row in 0.5 * (covariance + covariance.T)]
        return cls(
            first=first, names=names, mean=tuple(float(f"{m:.9g}") for m in mean), covariance=tuple(map(tuple, rows))
        )

    def select(self, names: list[str]) -> tuple[FloatArray, FloatArray]:
        """Return mean (n,) and covariance (n, n) of the parameters `names`. One that isn't known here has its prior:
        mean 0, variance 1.
        """
        known = {name: i for i, name in enumerate(self.names)}
        mean, covariance = np.zeros(len(names)), np.eye(len(names))
        at = [i for i, name in enumerate(names) if name in known]
        places = [known[names[i]] for i in at]
        mean[at] = np.array(self.mean)[places]
        covariance[np.ix_(at, at)] = np.array(self.covariance).reshape(len(known), -1)[np.ix_(places, places)]
        return mean, covariance
