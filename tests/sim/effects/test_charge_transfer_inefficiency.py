"""Charge transfer inefficiency: the binomial law of deferred charge, the deposit of each transfer one by one, and that
charge behind the last line is all that a frame lacks."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.charge_transfer_inefficiency import ChargeTransferInefficiency
from sim.frame import Exposure, expected_electrons
from sim.point import edge_profile, mix_channels, optical_transfer
from sim.scene.scenes import UniformField
from sim.sensor.trails import TRAIL_PX, Trails
from sim.spectrum import FloatArray
from sim.stages import charge_of
from tests.sim.effects.test_sensor_effects import CAMERA, LIGHT

ROWS, COLS = 40, 30


def clocked_one_by_one(frame: FloatArray, loss: float, releases: tuple[tuple[float, float], ...]) -> FloatArray:
    """Rows are shifted by one towards row 0 at a time; each pixel's traps take and release charge of the packet there.

    The pixels of row p meet the packets p, p + 1, ... one after the other: the farthest pixels act first.
    """
    packets = frame.copy()
    for pixel in range(len(frame) - 1, -1, -1):
        held = [np.zeros(frame.shape[1]) for _ in releases]
        for row in range(pixel, len(frame)):
            taken = loss * packets[row]
            packets[row] -= taken
            for k, (share, release) in enumerate(releases):
                given = held[k] * (1.0 - np.exp(-1.0 / release))
                packets[row] += given
                held[k] += share * taken - given
    return packets


@pytest.mark.parametrize("releases", [((1.0, 0.7),), ((0.7, 1.5), (0.3, 12.0))])
def test_packets_lose_what_every_transfer_takes(releases: tuple[tuple[float, float], ...]) -> None:
    """The law is the limit of many small losses: of n transfers of loss e the square n e^2 / 2 is neglected, and a
    pixel that has released within the transfer: 40 x (2e-4)^2 / 2 < 1e-6 of the charge."""
    rng = np.random.default_rng(3)
    frame = rng.uniform(0.0, 1000.0, (ROWS, COLS))
    found = Trails(0, 2e-4, releases, "first").clock(frame)
    np.testing.assert_allclose(found, clocked_one_by_one(frame, 2e-4, releases), atol=1e-6 * 1000.0)
    assert np.abs(found - frame).max() > 3.0


def test_deferred_charge_has_the_textbooks_transfer() -> None:
    """Traps that release within the next transfer: exp(-n e (1 - exp(-2 pi i f))), of modulus
    exp(-n e (1 - cos 2 pi f)) (Janesick 2001)."""
    f = np.linspace(0.0, 0.5, 11)
    found = Trails(1, 1e-5, ((1.0, 0.02),), "first").otf(f, 0.0 * f, 2000.0)
    np.testing.assert_allclose(np.abs(found), np.exp(-0.02 * (1.0 - np.cos(2.0 * np.pi * f))), rtol=1e-12)


@pytest.mark.parametrize("output", ["first", "last"])
@pytest.mark.parametrize("axis", [0, 1])
def test_charge_is_conserved(axis: int, output: str) -> None:
    """With 60 empty lines behind the last one, as overscan has, no electron is missing: exp(-60 / 3) of the slow traps'
    charge, 1e-11 of all, is released beyond."""
    law = Trails(axis, 3e-4, ((0.8, 0.8), (0.2, 3.0)), output)
    padded = np.zeros((ROWS + 120, COLS + 120))
    inside = (slice(60, 60 + ROWS), slice(60, 60 + COLS))
    padded[inside] = np.random.default_rng(4).uniform(0.0, 1e4, (ROWS, COLS))
    found = law.clock(padded)
    assert found.sum() == pytest.approx(padded.sum(), rel=2e-11)
    assert found[inside].sum() < padded.sum() - 10.0


def test_a_hot_pixel_trails_away_from_the_output() -> None:
    """In proportion to the transfers, and with the kernel of its place: the far half twice as much as the near."""
    law = Trails(0, 1e-5, ((1.0, 1.3),), "last")
    frame = np.zeros((200, 5))
    frame[50, 2], frame[125, 2] = 1e4, 1e4
    found = law.clock(frame)
    for row, transfers in ((50, 150.0), (125, 75.0)):
        seen = found[row - TRAIL_PX : row + TRAIL_PX + 1, 2]
        np.testing.assert_allclose(seen, 1e4 * law.kernel(transfers)[:, 0], atol=1e-6)
        share = 1.0 - np.exp(-1.0 / 1.3)
        assert found[row - 1, 2] == pytest.approx(1e4 * 1e-5 * transfers * share, rel=2e-3)
        assert found[row + 1, 2] < 1e-12  # rounding of the far trail of nothing


def test_no_signal_of_even_light_changes_far_from_the_first_lines() -> None:
    """What a packet loses it finds again, but for what lies in the trail: the loss times the mean delay, 1 / (1 -
    exp(-1)) px. Five delays from the first line exp(-5) of that is missing."""
    one = ChargeTransferInefficiency(parallel_ppm=100.0, release_px=1.0)
    plain, lossy = (expected_electrons(CAMERA, Exposure(UniformField(LIGHT), 0.004), acting) for acting in ((), (one,)))
    np.testing.assert_allclose(lossy[8:] / plain[8:], 1.0 - 1e-4 / (1.0 - np.exp(-1.0)), atol=2e-6)


def test_an_edges_profile_is_that_of_a_frame() -> None:
    """The transfer at a place is what the pixels' packets have gone through: an upright edge, read along rows."""
    one = ChargeTransferInefficiency(serial_ppm=1000.0, serial_release_px=1.5)
    distance = np.arange(-10.0, 11.0)
    plain, lossy = (
        edge_profile(CAMERA, "Y", LIGHT, 0.0, distance, acting, place_um=(0.0, 0.0)) for acting in ((), (one,))
    )
    law = charge_of(CAMERA, (one,)).trails[0]
    wide = np.interp(np.arange(-60.0, 61.0), distance, plain)
    kernel = law.kernel(0.5 * (CAMERA.cols + 1))[0]
    wanted = np.convolve(wide, kernel, "same")[50:71]
    # the trail beyond TRAIL_PX is left out of the kernel; the profile is interpolated where it is flat
    np.testing.assert_allclose(lossy - plain, (wanted - wide[50:71])[: len(distance)], atol=2e-4)
    assert np.abs(lossy - plain).max() > 5e-3


def test_a_mosaic_of_one_colour_is_a_monochrome_sensor() -> None:
    """Channels of equal transfer and signal: charge from the next pixel is of another colour and the same."""
    f = np.linspace(0.0, 0.5, 6)
    one = ChargeTransferInefficiency(parallel_ppm=500.0, release_px=1.0)
    alike = np.ones((3, 6), complex)
    curve = next(iter(CAMERA.quantum_efficiency.values()))
    camera = CAMERA.model_copy(update={"cfa": "RGGB", "quantum_efficiency": dict.fromkeys("RGB", curve)})
    found = mix_channels(camera, alike, np.ones(3), 0.0 * f, f, (one,))
    law = charge_of(CAMERA, (one,)).trails[0]
    np.testing.assert_allclose(found, np.tile(law.otf(0.0 * f, f, 0.5 * (CAMERA.rows + 1)), (3, 1)), atol=1e-9)
    assert np.abs(optical_transfer(camera, "G", LIGHT, 0.0 * f, f, (one,))[-1]) > 0.0


def filled_at_once(frame: FloatArray, loss: float, release_px: float) -> FloatArray:
    """Short's model in its own words, with clouds in proportion to packets, rows read from 0 on: the traps of the n
    transfers of a row take charge until they hold g = n loss / b of what is left, if they don't hold more already, and
    release 1 - b of theirs into the packet."""
    held, kept = np.exp(-1.0 / release_px), np.zeros(frame.shape[1])
    read = np.empty(frame.shape)
    for row, packet in enumerate(frame):
        g = (row + 1) * loss / held
        taken = np.maximum((g * packet - kept) / (1.0 + g), 0.0)
        given = (1.0 - held) * (kept + taken)
        read[row] = packet - taken + given
        kept = held * (kept + taken)
    return read


@pytest.mark.parametrize("release_px", [0.6, 3.0])
def test_all_transfers_at_once_are_shorts_model(release_px: float) -> None:
    """Of single bright pixels exactly; of few transfers it is the law of transfer by transfer: they differ by less
    than (n loss)^2 (1 / 2 + 1 / b) of the packet."""
    frame = np.zeros((60, 60))
    frame[np.arange(5, 55, 7), np.arange(5, 55, 7)] = 1000.0
    law = Trails(0, 2e-3, ((1.0, release_px),), "first", at_once=True)
    np.testing.assert_allclose(law.clock(frame), filled_at_once(frame, 2e-3, release_px), atol=1e-9)
    np.testing.assert_allclose(law.kernel(20.0)[24:, 0], law.clock(np.eye(80)[:, [19]])[19:44, 0], atol=1e-6)
    few, lost = frame.copy(), 2e-3 * 12.0
    few[12:] = 0.0
    plain = Trails(0, 2e-3, ((1.0, release_px),), "first")
    np.testing.assert_allclose(
        law.clock(few), plain.clock(few), atol=1000.0 * lost**2 * (0.5 + np.exp(1.0 / release_px))
    )
    assert np.abs(law.clock(frame) - plain.clock(frame)).max() > 2.0


@pytest.mark.parametrize("level_e", [np.full(60, 1000.0), np.linspace(2000.0, 500.0, 60)])
@pytest.mark.parametrize("release_px", [0.6, 3.0])
def test_overscan_behind_traps_that_packets_fill_is_shorts_model(release_px: float, level_e: FloatArray) -> None:
    """Exactly; and of traps whose transfers act one by one n loss N in all lines of even light, whatever the release:
    the extended pixel edge response. 40 lines miss exp(-40 / 3) = 2e-6 of it."""
    frame = np.pad(np.repeat(level_e[:, None], 3, axis=1), ((0, 40), (0, 0)))
    law = Trails(0, 2e-4, ((1.0, release_px),), "first", at_once=True)
    wanted = filled_at_once(frame, 2e-4, release_px)
    np.testing.assert_allclose(law.clock(frame, (0, 40))[60:], wanted[60:], rtol=1e-9, atol=1e-12)
    one_by_one = Trails(0, 2e-4, ((0.4, release_px), (0.6, 0.2)), "first")
    even = one_by_one.clock(np.pad(np.full((60, 3), 1000.0), ((0, 40), (0, 0))), (0, 40))[60:]
    assert even[:, 0].sum() == pytest.approx(2e-4 * 60 * 1000.0, rel=1e-5)


@pytest.mark.parametrize("mean_e", [9.0, 4000.0])
@pytest.mark.parametrize("release_px", [0.6, 2.5])
def test_noise_of_traps_that_packets_fill(release_px: float, mean_e: float) -> None:
    """Variance and correlation with the next row, of the mean over all rows: N numbers, within 3 / sqrt(N) and, for
    faint packets, the error of a law that takes what lies below b times the mean as nothing: a fifth of the share."""
    rows, loss, columns, frames = 80, 1e-3, 400, 30
    drawn = np.random.default_rng(5).poisson(mean_e, (rows, columns * frames)).astype(float)
    read = filled_at_once(drawn, loss, release_px)
    away = read - read.mean(axis=1, keepdims=True)
    variance = float(np.mean(np.square(away)))
    beside = float(np.mean(away[1:] * away[:-1])) / variance
    law = ChargeTransferInefficiency(
        parallel_ppm=1e6 * loss, release_px=release_px, noise="to the next packet", capture="all at once"
    )
    charge = charge_of(CAMERA.model_copy(update={"rows": rows}), (law,))
    electrons = np.array(mean_e)
    tolerance = 3.0 / np.sqrt(drawn.size) + (0.2 * beside if mean_e < 100.0 else 0.0)
    assert float(charge.neighbour_correlation(electrons)[1]) == pytest.approx(beside, abs=tolerance)
    # of a variance the mean of N squares scatters by sqrt(2 / N)
    assert float(charge.shot_e2(electrons)) / mean_e == pytest.approx(
        variance / mean_e, abs=np.sqrt(2.0) * tolerance + (0.2 * (1.0 - variance / mean_e) if mean_e < 100.0 else 0.0)
    )


def test_noise_that_lags_behind_reaches_the_second_packet() -> None:
    """To first order in what is lost, n loss, the packet k places behind shares n loss (1 - b) b^(k - 1), and the
    variance is less by 2 n loss. Terms of second order are (n loss)^2."""
    lost, release = 0.01, 3.0
    held = np.exp(-1.0 / release)
    law = Trails(0, lost / 50.0, ((1.0, release),), "first")
    own, first, second = law.noise(99, to_the_next=False)
    assert own == pytest.approx(1.0 - 2.0 * lost, abs=4.0 * lost**2)
    assert first == pytest.approx(lost * (1.0 - held), abs=4.0 * lost**2)
    assert second == pytest.approx(lost * (1.0 - held) * held, abs=4.0 * lost**2)


@pytest.mark.parametrize("release_px", [0.5, 3.0])
def test_noise_goes_to_the_next_packet_alone_where_each_fills_the_traps(release_px: float) -> None:
    """Traps that each packet fills to g of its charge keep g b of it, b = exp(-1 / release), and give the rest back to
    it. The next one fills them again: N'_i = (1 - g b) N_i + g b N_(i-1), whatever the release. Over N pixels the
    covariance with the next pixel, over the variance, is g b (1 - g b) / ((1 - g b)^2 + (g b)^2) within 3 / sqrt(N);
    the library's law averages over the frame's numbers of transfers, the same to first order."""
    lost = 0.03
    g = lost / np.exp(-1.0 / release_px)
    electrons = np.random.default_rng(4).poisson(1000.0, (200, 2000)).astype(float)
    held, read = g * np.exp(-1.0 / release_px) * electrons[0], [electrons[0]]
    for row in electrons[1:]:
        filled = g * row
        given = filled * (1.0 - np.exp(-1.0 / release_px))
        read.append(row - (filled - held) + given)
        held = filled - given
    away = np.array(read[1:]) - np.mean(read[1:])
    beside = float(np.mean(away[1:] * away[:-1]) / np.mean(np.square(away)))
    assert beside == pytest.approx(lost * (1.0 - lost) / ((1.0 - lost) ** 2 + lost**2), abs=3.0 / np.sqrt(away.size))

    ppm = 1e6 * lost / (0.5 * (CAMERA.rows + 1.0))
    law = ChargeTransferInefficiency(parallel_ppm=min(ppm, 1000.0), release_px=release_px, noise="to the next packet")
    mean_lost = 1e-6 * law.parallel_ppm * 0.5 * (CAMERA.rows + 1.0)
    shared = charge_of(CAMERA, (law,)).neighbour_correlation(np.array(1000.0))
    assert shared[1] == pytest.approx(mean_lost, rel=2.0 * mean_lost)
    assert shared[0] == 0.0
