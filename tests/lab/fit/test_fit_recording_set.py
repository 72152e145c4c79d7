"""All fits at once: every step has a result or a reason, whatever the threads' order; progress runs to its end."""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import lab.fit
from lab.errors import InputError, NotDetermined
from lab.fit import fit_recording_set
from lab.formats.recording_set import RecordingSet
from lab.formats.results import FitResult, GeometryFit, NoiseFit, RepeatDrift, StereoFit

STEPS = {
    "noise": "lab.fit.noise.noise_fit.fit_noise",
    "spectral": "lab.fit.spectral.recordings.fit_spectral",
    "mtf": "lab.fit.mtf.fit_mtf",
    "psf": "lab.fit.psf.recordings.fit_psf_field",
    "geometry": "lab.fit.geometry.fit_geometry",
    "stereo": "lab.fit.stereo.fit_stereo",
}


def refuse(step: str) -> Callable[..., Any]:
    def fit(*_: object) -> None:
        raise NotDetermined(step, f"no {step}; capture some")

    return fit


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """`steps(noise=..., geometry=...)`: these fits, and all others refused."""

    def use(**fits: Callable[..., Any]) -> None:
        for step, function in STEPS.items():
            monkeypatch.setattr(function, fits.get(step, refuse(step)))

    return use


GEOMETRY = GeometryFit(camera_matrix=((1, 0, 0), (0, 1, 0), (0, 0, 1)), distortion=(), rms_px=0.1)


def test_every_step_that_is_refused_stands_in_skipped_in_a_fixed_order(
    small_set: Callable[..., RecordingSet], steps: Callable[..., None]
) -> None:
    steps()
    results = [fit_recording_set(small_set()) for _ in range(3)]
    assert results[0] == results[1] == results[2]
    sides = [item.side for item in results[0].skipped]
    assert sides == ["left"] * 5 + ["right"] * 5 + [None]
    assert {item.step for item in results[0].skipped} == set(STEPS)
    assert "no geometry of the left and right side" in results[0].skipped[-1].reason
    assert FitResult.model_validate_json(results[0].model_dump_json()) == results[0]


def test_later_steps_get_what_earlier_ones_found(
    small_set: Callable[..., RecordingSet], steps: Callable[..., None]
) -> None:
    seen: dict[tuple[str, str], Any] = {}

    def noise(recordings: RecordingSet, side: str, drifts: tuple[RepeatDrift, ...]) -> NoiseFit:
        return NoiseFit(read_noise_e={"left": 1.0, "right": 2.0}[side])

    def mtf(recordings: RecordingSet, side: str, levels: NoiseFit, left_out: list[str]) -> tuple[()]:
        seen["mtf", side] = levels.read_noise_e
        return ()

    def stereo(recordings: RecordingSet, left: GeometryFit, right: GeometryFit) -> StereoFit:
        return StereoFit(
            rotation=((1, 0, 0), (0, 1, 0), (0, 0, 1)),
            translation_mm=(-60, 0, 0),
            baseline_mm=60,
            rms_px=left.rms_px + right.rms_px,
            pairs=3,
        )

    steps(noise=noise, mtf=mtf, geometry=lambda *_: GEOMETRY, stereo=stereo)
    result = fit_recording_set(small_set())
    assert seen == {("mtf", "left"): 1.0, ("mtf", "right"): 2.0}
    assert result.cameras["right"].noise == NoiseFit(read_noise_e=2.0)
    assert result.cameras["left"].geometry == GEOMETRY
    assert result.stereo is not None
    assert result.stereo.rms_px == pytest.approx(0.2)
    assert {item.step for item in result.skipped} == {"spectral", "psf"}


def test_one_side_makes_no_pair(small_set: Callable[..., RecordingSet], steps: Callable[..., None]) -> None:
    steps(geometry=lambda *_: GEOMETRY)
    result = fit_recording_set(small_set(sides=("left",)))
    assert list(result.cameras) == ["left"]
    assert result.stereo is None
    assert "no geometry of the right side" in result.skipped[-1].reason


def test_progress_goes_up_to_one_and_may_end_the_work(
    small_set: Callable[..., RecordingSet], steps: Callable[..., None]
) -> None:
    steps()
    told: list[tuple[str, float]] = []
    fit_recording_set(small_set(), lambda text, share: told.append((text, share)))
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert len(told) == 11

    class StopError(Exception):
        pass

    def stop(text: str, share: float) -> None:
        raise StopError

    with pytest.raises(StopError):
        fit_recording_set(small_set(), stop)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("fit")]


def test_damage_that_shows_late_is_no_skipped_step(
    small_set: Callable[..., RecordingSet], steps: Callable[..., None]
) -> None:
    def damaged(recordings: RecordingSet, side: str, drifts: tuple[RepeatDrift, ...]) -> NoiseFit:
        raise InputError("frames/x.npy: damaged; recapture")

    steps(noise=damaged)
    with pytest.raises(InputError, match="damaged"):
        fit_recording_set(small_set())


def test_real_steps_refuse_frames_of_noise_without_falling_over(small_set: Callable[..., RecordingSet]) -> None:
    """24 x 32 pixels of noise in place of edges, boards and screens: reasons, not tracebacks."""
    result = fit_recording_set(small_set())
    done = {step for side in result.cameras.values() for step in ("mtf", "psf", "geometry") if getattr(side, step)}
    refused = {item.step for item in result.skipped}
    assert {"mtf", "psf", "geometry"} <= done | refused
    assert all(";" in item.reason or ":" in item.reason or len(item.reason) > 10 for item in result.skipped)
    noise = result.cameras["left"].noise
    assert noise is None or np.isfinite(noise.conversion_gain_dn_per_e or 0.0)


def test_sides_in_processes_give_the_same_fit(
    small_set: Callable[..., RecordingSet], monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[float] = []
    here = fit_recording_set(small_set())
    monkeypatch.setattr(lab.fit, "WORTH_PROCESSES_PX", 0.0)
    assert fit_recording_set(small_set(), lambda text, share: told.append(share)) == here
    assert told == sorted(told)
    assert (len(told), told[-1]) == (11, 1.0)
