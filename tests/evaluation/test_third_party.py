"""Sets of third parties' simulators: the score, and one set of each simulator."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from evaluation.third_party.camera import BLACK_DN, draw_camera, record_sensor
from evaluation.third_party.models import SimulatedSensor, SimulatorCheck
from evaluation.third_party.score import Diagnosed, ScoredSize, share_with_interval, size_table, table
from tests.peers import missing

ONE = Diagnosed(
    "persistence", "Pyxel", "persistence", 1, asked=0.1, measured=0.1, is_checked=True, verdict="explained",
    names={"persistence": 0.99}, sizes=(ScoredSize("share_percent", 2.0, 2.1, 1.9, 2.3),), cpu_s=3.0,
)  # fmt: skip


def test_names_of_the_effect_and_its_family_are_right_and_others_are_second_names() -> None:
    family = replace(ONE, set=2, names={"memory_of_the_last_frame": 0.97}, sizes=())
    wrong = replace(
        ONE, set=3, names={"persistence": 0.99, "source_drift": 0.96}, sizes=(ScoredSize("x", 2.0, 3.0, 2.5, 3.5),)
    )
    unlike = replace(ONE, set=4, is_checked=False, names={})
    assert [one.is_named for one in (ONE, family, wrong)] == [True, True, True]
    row = table([ONE, family, wrong, unlike]).splitlines()[-1]
    assert row == (
        "| Pyxel | persistence | 4 | 3 of 4 | 3 of 3 (29-100 %) | `source_drift` 1 | 0 | 1 of 2 (1-99 %) | 3 |"
    )


def test_sizes_are_told_by_model_and_parameter() -> None:
    """Of a truth of 2.0: values 2.1 and -3.0, standard deviations 0.1 and 0.25."""
    wrong = replace(ONE, set=2, sizes=(ScoredSize("share_percent", 2.0, -3.0, -3.5, -2.5),))
    unlike = replace(ONE, set=3, is_checked=False)
    row = size_table([ONE, wrong, unlike]).splitlines()[-1]
    assert row == "| persistence | `share_percent` | 2 | 1 of 2 (1-99 %) | -0.225 | 0.087 |"


def test_rates_have_the_binomial_interval() -> None:
    """Of none in n the upper end is 1 - 0.025^(1 / n): of 10 it is 30.8 %. Textbooks' 8 of 10: 44.4 to 97.5 %."""
    assert share_with_interval(0, 10) == "0 of 10 (0-31 %)"
    assert share_with_interval(8, 10) == "8 of 10 (44-97 %)"
    assert share_with_interval(10, 10) == "10 of 10 (69-100 %)"
    assert share_with_interval(0, 0) == "-"


def test_a_simulator_that_errs_by_more_than_its_tolerance_is_not_right() -> None:
    assert SimulatorCheck(1.0, 1.02, 0.03).is_right
    assert not SimulatorCheck(1.0, 1.04, 0.03).is_right


def test_a_healthy_session_has_the_drawn_gain_and_noise() -> None:
    """Gain by two flats of one level: half of the variance of their difference over the mean, less the dark frames'.
    Its relative standard deviation is sqrt(2 / pixels), below 1.3 %."""
    rng = np.random.default_rng(3)
    camera = draw_camera(rng)
    recordings = record_sensor("healthy", camera, SimulatedSensor(), rng)

    def pair(kind: str) -> tuple[float, float]:
        captures = recordings.captures(kind)
        one, two = (recordings.frame(c).astype(float) for c in (captures[-1], captures[-2]))
        return float(one.mean()) - BLACK_DN, float(np.var(one - two)) / 2.0

    (dark, dark_variance), (light, variance) = pair("dark"), pair("flat")
    assert (variance - dark_variance) / (light - dark) == pytest.approx(camera.gain_dn_per_e, rel=4 * 0.013)


@pytest.mark.extra  # other programs
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of what the simulators themselves call
def test_simulators_do_what_they_are_asked_for() -> None:
    """One model of each simulator against its closed form, as before each set of the evaluation."""
    for package in ("pyxel", "galsim"):
        if find_spec(package) is None:
            missing(f"{package} isn't installed; `make third-party` installs it")
    from evaluation.third_party.experiment import draw_set

    sources = "inter_pixel_capacitance", "moffat_blur", "cosmic_rays", "column_gain", "charge_transfer_into_overscan"
    for source in sources:
        recordings, truth, checked = draw_set(source, 1)
        assert checked.is_right
        assert truth
        assert recordings.whole_frame(recordings.captures("flat")[0]).shape == recordings.camera("left").frame_shape
    assert recordings.camera("left").frame_shape[0] == recordings.camera("left").rows + 16
