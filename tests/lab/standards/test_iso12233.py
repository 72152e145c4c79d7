"""The e-SFR as ISO 12233 specifies it: known transfer functions, its bias, its intervals, and a peer."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.observables.edges.mtf import edge_mtf
from lab.standards.iso12233 import Window, measure_e_sfr
from tests.lab.standards.edges import gaussian_edge, gaussian_transfer, noise_of, noisy
from tests.peers import missing

FREQUENCY = np.linspace(0.0, 1.0, 4001)


def true_mtf50(sigma_px: float, angle_deg: float = 5.0) -> float:
    return float(np.interp(-0.5, -gaussian_transfer(sigma_px, angle_deg, FREQUENCY), FREQUENCY))


@pytest.mark.parametrize("sigma_px", [0.55, 0.9, 1.5])
def test_bias_is_that_of_bins_and_window(sigma_px: float) -> None:
    """Bins of h = 1/4 px average the profile over h: the response falls by the factor sinc(h f), which the standard
    doesn't take out. At SFR50 that moves the frequency by ln sinc(h f) over the logarithmic slope of the response.
    The window cos^2(pi x / N) = 1 - (pi x / N)^2 narrows a line spread of variance s^2 by s^2 pi^2 / N^2 of its width,
    and widens the response by as much."""
    truth = true_mtf50(sigma_px)
    found = measure_e_sfr(gaussian_edge(sigma_px))
    slope = np.gradient(np.log(gaussian_transfer(sigma_px, 5.0, FREQUENCY)), FREQUENCY)
    bins = -np.log(np.sinc(0.25 * truth)) / float(np.interp(truth, FREQUENCY, slope)) / truth
    window = (sigma_px**2 + 1.0 / 12.0) * (np.pi / 64.0) ** 2
    # beyond: the straight line between two frequencies of 1/64 cy/px, (1/64)^2 / 8 of a curvature of 4 pi^2 s^2 over
    # the slope at half (2 ln 2 / f50): 0.02 f50 s^2 at most, and the slope's cosine
    tolerance = 1e-3 + 0.02 / 64.0 * (np.pi * sigma_px) ** 2 * truth
    assert found.falls_to(0.5)[0] / truth - 1.0 == pytest.approx(bins + window, abs=tolerance)
    assert found.empty_bins == 0
    assert abs(found.angle_deg) == pytest.approx(5.0, abs=0.01)


def test_unbiased_estimate_is_nearer() -> None:
    """Of a sharp edge the standard's estimate is below the truth by its bins, the unbiased one isn't."""
    truth, image = true_mtf50(0.55), gaussian_edge(0.55)
    letter = measure_e_sfr(image).falls_to(0.5)[0] / truth - 1.0
    # 1 DN of noise on a contrast of 3000 DN: MTF50 to 0.02 %
    free = edge_mtf(image + np.random.default_rng(7).standard_normal(image.shape)).mtf50_cy_per_px
    assert free is not None
    assert letter < -0.004
    assert abs(free / truth - 1.0) < 0.1 * abs(letter)


@pytest.mark.parametrize("window", ["tukey", "hamming"])
def test_intervals_hold(window: Window) -> None:
    """95 % intervals about what the estimator finds without noise hold in 90 to 99 of 100 draws."""
    image, rng = gaussian_edge(0.55), np.random.default_rng(3)
    order = 5 if window == "tukey" else 1
    exact = measure_e_sfr(image, window=window, order=order)
    noise = float(noise_of(1000.0)), float(noise_of(4000.0))
    held = np.zeros(2, int)
    for _ in range(100):
        own = measure_e_sfr(noisy(image, rng), noise, window, order)
        pairs = (own.falls_to(0.5), exact.falls_to(0.5)[0]), (own.at(0.25), exact.at(0.25)[0])
        held += [abs(value - truth) < 1.96 * std for (value, std), truth in pairs]
    assert np.all((held >= 90) & (held <= 99)), held


def test_direction_doesnt_matter() -> None:
    image = gaussian_edge(0.9)
    first, second = measure_e_sfr(image), measure_e_sfr(image[:, ::-1])
    assert second.falls_to(0.5)[0] == pytest.approx(first.falls_to(0.5)[0], rel=2e-3)


def test_edge_outside_of_the_region_is_refused() -> None:
    with pytest.raises(NotDetermined, match="leaves the region"):
        measure_e_sfr(gaussian_edge(0.9, angle_deg=40.0))


def test_response_that_stays_high_has_no_limit() -> None:
    found = measure_e_sfr(gaussian_edge(0.3), highest=0.2)
    with pytest.raises(NotDetermined, match=r"doesn't fall to 0\.5"):
        found.falls_to(0.5)


@pytest.mark.extra
def test_agrees_with_a_peer() -> None:
    """quickMTF's slanted edge: straight line, bins of 1/4 px, central difference, a Hann window over the line spread's
    own width. Both have the bias of the bins; the windows differ by a known width."""
    if importlib.util.find_spec("quickMTF") is None:
        missing("quickmtf isn't installed; `make peers` installs it")
    from quickMTF.SFR_MTF import sfr_mtfcal

    class WithWidth(sfr_mtfcal):
        def filter_window(self, *given: object, **more: object) -> tuple[np.ndarray, int, list[int]]:
            found = super().filter_window(*given, **more)
            self.width_px = found[1] / 4.0
            return found

    for sigma_px in (0.55, 0.9, 1.5):
        image, peer = gaussian_edge(sigma_px), WithWidth()
        curve, _ = peer.calc_sfr(image, oversampling=4)
        frequency, mtf = np.asarray(curve)[:, 0], np.asarray(curve)[:, 1]
        k = int(np.argmax(mtf < 0.5))
        other = float(np.interp(-0.5, -mtf[k - 1 : k + 1], frequency[k - 1 : k + 1]))
        own = measure_e_sfr(image, order=1).falls_to(0.5)[0]
        # The narrower window widens the response by (pi s / N)^2 to second order, and by less where that isn't small.
        # Straight lines between the peer's frequencies of 1/40 cy/px add 0.5 %.
        window = (sigma_px**2 + 1.0 / 12.0) * np.pi**2 * (peer.width_px**-2 - 64.0**-2)
        assert -0.005 < other / own - 1.0 < window + 0.005
