"""The budget of uncertainty: what is uncertain alone adds everything, and its standard deviation is what linear
propagation says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.capture.station import Station, read_station
from lab.errors import InputError
from lab.formats.camera_file import CameraFile
from lab.formats.model_posterior import FirstEstimates, ModelPosterior
from lab.twin.budget import CaptureGain, LinearUse, budget, parse_uses, with_darks
from lab.twin.lab_minutes import LabCapture
from sim.effects.dark_current_temperature import DarkCurrentTemperature
from sim.effects.defocus import Defocus
from tests.lab.twin.test_twin import TRUTH

STATION = """
name = "bench"
[monochromator]
driver = "cornerstone260"
address = "/dev/null"
[spectroradiometer]
driver = "pr655"
address = "/dev/zero"
[stage]
driver = "operator"
address = "socket://127.0.0.1:1"
[cameras.left]
driver = "u3v"
address = "usbip://127.0.0.1:1/A"
[cameras.left.datasheet]
rows = 120
cols = 160
cfa = "RGGB"
bit_depth = 12
[targets.cap]
kind = "cap"
[targets.sphere]
kind = "sphere"
[targets.edge]
kind = "slanted_edge"
angle_deg = 5.0
[targets.edge.left]
regions = [{name = "centre", region = [20, 40, 100, 120], angle_deg = 5.0, field_mm = [0.0, 0.0]}]
"""
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


def _station(tmp_path: Path) -> Station:
    file = tmp_path / "station.toml"
    file.write_text(STATION)
    return read_station(file)


def test_the_capture_comes_first_that_tells_what_is_uncertain(tmp_path: Path) -> None:
    station = _station(tmp_path)

    def ranked(name: str, std: float, use: str) -> list[CaptureGain]:
        return list(budget(_model((name,), (std,)), (use,), station).uses[0].captures)

    read = ranked("read", 1.0, "variance")
    assert read[0].sequence.startswith("dark") and not read[0].is_learned
    assert ranked("curve:G:0", 1.0, "patches")[0].sequence.split(",")[0] in {"flat", "narrowband", "chart"}
    assert {one.sequence.split(",")[0] for one in read} == {"dark", "flat", "narrowband", "edge"}
    for one in read:
        assert one.reduced_percent_per_minute == pytest.approx(one.reduced_percent / one.minutes)
    # a quick session takes fewer captures, and so leaves more in doubt in less time
    dark = {one.sequence.endswith("(quick)"): one for one in read if one.sequence.startswith("dark")}
    assert dark[True].minutes < dark[False].minutes


def test_a_capture_leaves_what_information_adds_up_to() -> None:
    rng = np.random.default_rng(3)
    half, jacobian, noise = rng.standard_normal((4, 4)), rng.standard_normal((6, 4)), rng.uniform(0.5, 2.0, 6)
    known = half @ half.T + np.eye(4)
    one = LabCapture("", 1.0, False, 1, lambda _: np.zeros(6), np.diag(noise))
    # information adds: V'^-1 = V^-1 + J' S^-1 J
    wanted = np.linalg.inv(np.linalg.inv(known) + jacobian.T @ np.diag(1.0 / noise) @ jacobian)
    assert one.update_covariance(known, jacobian) == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_dark_frames_tell_the_read_noise_beside_the_photon_transfer() -> None:
    """A pair of frames of 120 x 160 px measures the dark's variance to sqrt(2 / 19200), and to 1 %, in units of 30 %:
    of two correlated parameters the other is known better by what the correlation says."""
    posterior = ModelPosterior.of(FIRST, ("gain", "read"), np.array([0.5, 2.0]), np.array([[1.0, -0.6], [-0.6, 1.0]]))
    found = with_darks(posterior, TRUTH.camera)
    std2 = (2.0 / 19200.0 + 1e-4) / 0.3**2
    np.testing.assert_allclose(
        found.covariance, [[1.0 - 0.36 / (1.0 + std2), -0.6 * std2 / (1.0 + std2)],
                           [-0.6 * std2 / (1.0 + std2), std2 / (1.0 + std2)]], rtol=1e-6)  # fmt: skip
    np.testing.assert_allclose(found.mean, [0.5 + 1.2 / (1.0 + std2), 2.0 * std2 / (1.0 + std2)], rtol=1e-6)


def test_what_goes_along_with_a_parameter_is_its_own() -> None:
    """Of use = a + 2 b with correlation r, to know a takes away (1 + 2 r)^2: its own, and what it tells of b."""
    r = 0.5
    one = LinearUse(("a", "b"), np.array([[1.0], [2.0]]), np.array([[1.0, r], [r, 1.0]]))
    assert one.groups() == {"a": [0], "b": [1]}
    assert one.propagate_errors([0])[0, 0] == pytest.approx(1.0 + 2.0 * r)
    assert one.std == pytest.approx(np.sqrt(1.0 + 4.0 + 4.0 * r))


def test_an_unknown_use_and_a_model_without_uncertainties_are_refused() -> None:
    with pytest.raises(InputError, match="isn't a use"):
        parse_uses("MTF50, colour")
    with pytest.raises(InputError, match="no uncertainties"):
        budget(TRUTH, ("patches",))
