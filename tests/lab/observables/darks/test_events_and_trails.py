"""Trails of hot pixels, events in dark frames and the skewness of noise: what is drawn is what is predicted, nothing is
seen where nothing is, and figures of darks and flats stay right where particles hit a few pixels."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from evaluation.independent_simulator.laws import PersistenceLaw
from lab.errors import NotDetermined
from lab.fit import fit_recording_set
from lab.formats.recording_set import RecordingSet
from lab.observables.darks.events import measure_dark_events
from lab.observables.darks.trails import measure_dark_trails
from lab.observables.noise.skewness import measure_noise_skewness
from sim.effects.base import Effect
from sim.effects.charge_transfer_inefficiency import ChargeTransferInefficiency
from sim.effects.cosmic_rays import CosmicRays
from sim.effects.excess_noise import ExcessNoise
from sim.effects.hot_pixels import HotPixels
from tests.lab.diagnose.on_blocks import dataset, measured_model, rendered, sigmas

HOT = HotPixels(excess_e_per_s=800.0, share_ppm=20_000.0)
TRAILS = ChargeTransferInefficiency(parallel_ppm=800.0, release_px=1.5)
RAYS = CosmicRays(rate_per_cm2_s=10_000.0, depth_um=10.0)
EXCESS = ExcessNoise(excess_percent=90.0)


@cache
def _recorded(*effects: Effect, repeats: int = 3) -> RecordingSet:
    return rendered(5, effects, repeats=repeats)


def test_hot_pixels_trail_as_predicted_and_only_along_rows_that_are_clocked() -> None:
    """Chi2 of 24 numbers and more within four of its standard deviations; without the effect far off."""
    model = measured_model(_recorded(HOT, TRAILS), measure_dark_trails)
    assert abs(sigmas(model, (TRAILS,))) < 4.0
    assert sigmas(model) > 20.0
    across = [k for k, label in enumerate(model.blocks[0].labels) if label.condition.startswith("columns")]
    std = np.sqrt(np.diag(model.blocks[0].covariance))
    assert np.max(np.abs(model.value[across] / std[across])) < 4.5


def test_hot_pixels_alone_have_no_trails() -> None:
    assert abs(sigmas(measured_model(_recorded(HOT), measure_dark_trails))) < 4.0
    with pytest.raises(NotDetermined, match="hot pixels"):
        measure_dark_trails(dataset(_recorded()))


def test_events_are_counted_as_predicted() -> None:
    """All numbers of events together: Poisson, four standard deviations; and none where none is."""
    block = measured_model(_recorded(RAYS), measure_dark_events).blocks[0]
    found, wanted = (np.sum(np.square(v) / 4.0 - 0.375) for v in (block.value, block.predict((RAYS,)).mean))
    assert wanted > 30.0
    # tracks that overlap in a frame, and the rim, take some away
    assert found == pytest.approx(wanted, abs=4.0 * np.sqrt(wanted) + 0.05 * wanted)
    quiet = measured_model(_recorded(HOT), measure_dark_events).blocks[0]
    np.testing.assert_allclose(quiet.value, 2.0 * np.sqrt(0.375))


def test_multiplied_electrons_have_skewed_noise() -> None:
    """The number is 1 of single electrons; a factor on the variance by the gain leaves it."""
    plain, noisy = (
        measured_model(_recorded(*acting, repeats=12), measure_noise_skewness) for acting in ((), (EXCESS,))
    )
    assert abs(sigmas(plain)) < 4.0
    assert abs(sigmas(noisy, (EXCESS,))) < 4.0
    weight = 1.0 / np.diag(noisy.blocks[0].covariance)
    mean = float(weight @ noisy.value / weight.sum())
    assert mean - 1.0 > 4.0 / np.sqrt(weight.sum())


def test_figures_of_darks_and_flats_stay_right_where_particles_hit() -> None:
    """Some 200 events in each of the long dark frames. Black level, read noise, dark current, gain and the median of
    the pixels' noise are those of the camera within three of the standard deviations that they have without particles;
    the stated ones may be wider, as dark frames of different exposures contradict each other."""
    quiet, hit = (fit_recording_set(_recorded(*acting)).cameras["left"].noise for acting in ((), (RAYS,)))
    assert quiet is not None and hit is not None
    assert quiet.read_noise_distribution is not None and hit.read_noise_distribution is not None
    truth = {"black_level_dn": 128.0, "read_noise_e": 3.0, "conversion_gain_dn_per_e": 0.4, "dark_current_e_per_s": 5.0}
    for name, value in truth.items():
        assert getattr(hit, name) == pytest.approx(value, abs=3.0 * getattr(quiet, f"{name}_std")), name
    # the median of 12,288 pixels' noise is known to about 0.6 %
    medians = quiet.read_noise_distribution.median_e, hit.read_noise_distribution.median_e
    assert medians[1] == pytest.approx(medians[0], rel=0.02)


def test_a_decay_of_dark_frames_is_no_scatter_of_them() -> None:
    """Frames that fade after light by some DN widen the scatter of all repeats, but not what is about their decay: it
    stays within twice the pixels' noise, 2 DN over the root of 12,288. In a healthy camera the pixels' noise explains
    the scatter."""
    plan = Plan(("dark", "flat"), dark_again=True)
    fading, healthy = (
        dataset(recordings_of(ConcealedCamera(930, laws, cfa="MONO", rows=96, cols=128), plan))
        for laws in ([PersistenceLaw(5.0, 0, 9)], [])
    )
    assert fading.noise.jitter_dn > 0.3
    assert fading.noise.white_jitter_dn < 2.0 * 2.0 / np.sqrt(12_288.0)
    assert healthy.noise.jitter_dn == healthy.noise.white_jitter_dn == 0.0
