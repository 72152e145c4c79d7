"""The budget of uncertainty: what is uncertain alone adds everything, and its standard deviation is what linear
propagation says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lab.errors import InputError
from lab.formats.camera_file import CameraFile
from lab.formats.model_posterior import FirstEstimates, ModelPosterior
from lab.twin.budget import budget, parse_uses
from sim.effects.dark_current_temperature import DarkCurrentTemperature
from sim.effects.defocus import Defocus
from tests.lab.twin.test_twin import TRUTH

FIRST = FirstEstimates(
    dark_temperature_c=25.0, read_noise_dn=1.5, black_level_std_dn=0.1, dark_current_std_dn_per_s=0.1,
    level_jitter_dn=0.02, lamp_jitter=1e-3
)  # fmt: skip


def _model(names: tuple[str, ...], std: tuple[float, ...]) -> CameraFile:
    posterior = ModelPosterior.of(FIRST, names, np.zeros(len(names)), np.diag(np.square(std)))
    effects = (DarkCurrentTemperature(doublings_per_c=0.14), Defocus(defocus_um=8.0))
    camera = TRUTH.camera.model_copy(update={"dark_current_doubling_c": None})
    return replace(TRUTH, camera=camera, effects=effects, posterior=posterior)


def test_what_alone_is_uncertain_adds_everything() -> None:
    found = budget(_model(("dark_current_temperature.doublings_per_c",), (0.002,)), ("dark mean", "MTF50")).uses
    (one,) = found[0].contributions
    assert one.name == "dark_current_temperature" and one.share_percent == pytest.approx(100.0)
    # d ln(dark) / d k = 10 ln 2 at ten degrees, 0 at the reference; rms over the two
    assert found[0].std_percent == pytest.approx(100.0 * 0.002 * 10.0 * np.log(2.0) / np.sqrt(2.0), rel=0.02)
    assert found[1].std_percent == 0.0


def test_the_larger_uncertainty_comes_first() -> None:
    def first(of_defocus: float, of_curve: float) -> str:
        content = _model(("defocus.defocus_um", "curve:G:1"), (of_defocus, of_curve))
        return budget(content, ("MTF50",)).uses[0].contributions[0].name

    assert (first(5.0, 0.01), first(1e-7, 1.0)) == ("defocus", "sensitivity G")


def test_an_unknown_use_and_a_model_without_uncertainties_are_refused() -> None:
    with pytest.raises(InputError, match="isn't a use"):
        parse_uses("MTF50, colour")
    with pytest.raises(InputError, match="no uncertainties"):
        budget(TRUTH, ("patches",))
