"""The transfer at a place, edge profiles and kernels against their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate
from scipy.ndimage import convolve

from sim import frame as sim_frame
from sim.camera import CameraModel, Cfa, Lens
from sim.effects.crosstalk import Crosstalk
from sim.effects.infrared_cut_filter import InfraredCutFilter
from sim.effects.inter_pixel_capacitance import InterPixelCapacitance
from sim.frame import Exposure
from sim.optics.diffraction import aperture_otf, diffraction_otf
from sim.optics.illumination import relative_illumination
from sim.point import common_wavelengths, edge_profile, kernel, mix_channels, optical_transfer, wavelength_shares
from sim.scene import (
    ScreenPattern,
    Warp,
)
from sim.sensor.mosaic import phases
from sim.spectrum import Spectrum, photons_from_energy
from sim.stages import charge_of, kernel_otf
from sim.uniform import electron_rate
from tests.sim.local_effects import Birefringent, Shift, Veil


def test_transfer_is_the_wavelengths_average(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """Ten Gauss wavelengths against 1 nm steps: 1e-4, up to beyond the cutoff."""
    f = np.linspace(0.0, 2.0, 81)
    for channel in "RGB":
        w = np.arange(380.0, 780.5, 1.0)
        weight = photons_from_energy(w, lamp.at(w)) * colour_camera.quantum_efficiency[channel].at(w)
        sums = sum(a * diffraction_otf(f / 3.0, b, 4.0) for a, b in zip(weight / weight.sum(), w, strict=True))
        wanted = sums * aperture_otf(f, 0.0, 0.9)
        np.testing.assert_allclose(optical_transfer(colour_camera, channel, lamp, f, 0 * f), wanted, atol=1e-4)


def test_transfer_in_a_line_is_diffraction_times_aperture_times_the_effect(colour_camera: CameraModel) -> None:
    line = Spectrum.of([549.9, 550.0, 550.1], [0.0, 1.0, 0.0])
    fx, fy = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(0, 1, 5))
    wanted = diffraction_otf(np.hypot(fx, fy) / 3.0, 550.0, 4.0) * aperture_otf(fx, fy, 0.9)
    wanted = wanted * np.cos(np.pi * fx * 0.7) * np.cos(np.pi * fy * 0.7)
    got = optical_transfer(colour_camera, "G", line, fx, fy, (Birefringent(d_um=2.1),))
    np.testing.assert_allclose(got, wanted, atol=1e-6)
    assert got.dtype == complex and got[0, 4] == pytest.approx(1.0)


@pytest.mark.parametrize("angle_deg", [0.0, 7.0, -83.0, 135.0])
def test_edge_profile_is_the_integral_of_its_definition(
    colour_camera: CameraModel, lamp: Spectrum, angle_deg: float
) -> None:
    effects = (Shift(x_um=1.2, y_um=-0.6), Birefringent(d_um=1.5))
    a = np.deg2rad(angle_deg)
    d = np.array([-6.0, -1.3, -0.2, 0.0, 0.35, 0.8, 2.0, 9.0])
    f = np.linspace(1e-6, 2.5, 40_001)
    h = optical_transfer(colour_camera, "G", lamp, f * np.cos(a), f * np.sin(a), effects)
    wanted = [
        0.5
        + integrate.simpson(
            (h.real * np.sin(2 * np.pi * f * x) + h.imag * np.cos(2 * np.pi * f * x)) / (np.pi * f), x=f
        )
        for x in d
    ]
    # The table's period of 1024 px leaves tails of 1e-6; its cubic spline 2e-6; the integral from 0 to 1e-6 cy/px 2e-6
    # d.
    np.testing.assert_allclose(edge_profile(colour_camera, "G", lamp, angle_deg, d, effects), wanted, atol=3e-5)


def test_edge_profile_of_an_aperture_alone_is_a_ramp(colour_camera: CameraModel) -> None:
    """At f/0.5 and 100 um the lens blurs by 0.003 px: what is left is the square. 64 cy/px end the integral:
    1 / (2 pi^2 64) = 0.0008 at the ramp's ends, and the lens rounds them by 0.0011.
    """
    camera = colour_camera.model_copy(
        update={"pixel_pitch_um": 100.0, "fill_factor": 1.0, "lens": Lens(f_number=0.5, focal_length_mm=8.0)}
    )
    d = np.linspace(-1.0, 1.0, 41)
    np.testing.assert_allclose(edge_profile(camera, "G", None, 0.0, d), np.clip(d + 0.5, 0, 1), atol=2.5e-3)


def test_edge_profile_moves_with_the_image(colour_camera: CameraModel, lamp: Spectrum) -> None:
    d = np.linspace(-5.0, 5.0, 101)
    moved = edge_profile(colour_camera, "G", lamp, 30.0, d, (Shift(x_um=3.0, y_um=1.5),))
    along = np.cos(np.deg2rad(30.0)) + 0.5 * np.sin(np.deg2rad(30.0))
    np.testing.assert_allclose(moved, edge_profile(colour_camera, "G", lamp, 30.0, d - along), atol=1e-5)


def test_a_veil_lies_even_on_both_sides_of_an_edge(colour_camera: CameraModel, lamp: Spectrum) -> None:
    d = np.array([-60.0, -2.0, 0.0, 2.0, 60.0])
    clear = edge_profile(colour_camera, "G", lamp, 0.0, d)
    veiled = edge_profile(colour_camera, "G", lamp, 0.0, d, (Veil(share=0.04),))
    np.testing.assert_allclose(veiled, 0.96 * clear + 0.02, atol=1e-6)


def test_a_kernel_is_normalised_centred_and_consistent(colour_camera: CameraModel, lamp: Spectrum) -> None:
    psf = kernel(colour_camera, "G", lamp, 85, 5, (Shift(x_um=1.5, y_um=-0.75),))
    at = (np.arange(85) - 42) / 5
    assert psf.sum() == pytest.approx(1.0, abs=1e-12)
    # The centre of mass moves by 0.5 and -0.25 px; the tails beyond +-8 px and their renormalisation leave 1 %.
    assert (psf.sum(0) @ at, psf.sum(1) @ at) == pytest.approx((0.5, -0.25), abs=0.01)
    plain = kernel(colour_camera, "G", lamp, 85, 5)
    np.testing.assert_allclose(plain, plain[::-1, ::-1], atol=1e-12)
    # What light of a whole pixel does is what its 5 x 5 parts do together.
    coarse = kernel(colour_camera, "G", lamp, 17, 1)
    np.testing.assert_allclose(coarse, plain.reshape(17, 5, 17, 5).sum(axis=(1, 3)), atol=1e-5)


def test_a_coarse_kernel_convolves_pixel_aligned_cells(mono_camera: CameraModel, lamp: Spectrum) -> None:
    """One lit cell of exactly one pixel: the frame around it is the kernel."""
    cell = np.zeros((41, 41), np.uint8)
    cell[20, 20] = 1
    at = np.array([(-0.5, -0.5), (-0.5, 40.5), (40.5, 40.5), (40.5, -0.5)]) + np.array([15.0, 27.0])
    camera = mono_camera.model_copy(update={"dark_current_e_per_s": 0.0})
    scene = ScreenPattern(cell, Warp.from_corners(41, 41, at), lamp.scale(0.0), lamp)
    frame = sim_frame.expected_electrons(camera, Exposure(scene, 1.0), (Shift(x_um=1.5, y_um=0.0),), oversample=8)
    frame /= electron_rate(camera, "Y", lamp) * relative_illumination(camera, 35.0, 47.0)
    wanted = kernel(camera, "Y", lamp, 33, 1, (Shift(x_um=1.5, y_um=0.0),))
    # The kernel's share outside its support (1 %) is put back by the sum; drawing on 8 x 8 samples leaves 2e-3 of
    # white.
    np.testing.assert_allclose(
        frame[35 - 5 : 35 + 6, 47 - 5 : 47 + 6], wanted[11:22, 11:22] * frame[19:52, 31:64].sum(), atol=3e-3
    )
    assert frame[35, 48] > frame[35, 46]  # moved to the right


def test_wavelength_weights_are_shares_of_the_detected_light(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """Means of what is linear in the wavelength are those of the detected light, and an effect on its colour is in
    them.
    """
    grid = np.linspace(380.0, 780.0, 90)
    sights = [(channel, light) for channel in "RGB" for light in (lamp, None)]
    shares = wavelength_shares(colour_camera, sights, grid)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, rtol=1e-12)
    nodes, few = common_wavelengths(colour_camera, sights)
    np.testing.assert_allclose(shares @ grid, few @ nodes, rtol=1e-10)
    cut = InfraredCutFilter(cut_wavelength_nm=600.0, width_nm=1.0)
    without_red = wavelength_shares(colour_camera, sights, grid, (cut,))
    assert np.all(without_red[:, grid > 615.0].sum(axis=1) < 1e-5)  # e^-12 of a width's light behind the edge


@pytest.mark.parametrize("cfa", ["RGGB", "GBRG"])
def test_charge_brings_the_transfer_of_neighbours_of_other_colours(colour_camera: CameraModel, cfa: Cfa) -> None:
    """Against plane waves on the mosaic's pixels, each channel with its own signal and transfer, whose charge is moved
    in the frame.
    """
    camera = colour_camera.model_copy(update={"cfa": cfa})
    effects = (Crosstalk(share_percent=3.0, row_excess=0.4, corner_share=0.3), InterPixelCapacitance(share_percent=1.0))
    signals = np.array([0.7, 2.0, 0.4])
    size, across, down = 48, 11, 7
    fx, fy = across / size, down / size
    transfers = np.array([0.5 + 0.1j, 0.8, 0.3 - 0.2j])
    row, col = np.mgrid[:size, :size]
    wave = np.exp(2j * np.pi * (fx * col + fy * row))
    amplitude, level, channel = np.zeros((size, size), complex), np.zeros((size, size)), np.zeros((size, size), int)
    for i, name in enumerate(camera.channels):
        for r, c in phases(cfa)[name]:
            amplitude[r::2, c::2], level[r::2, c::2], channel[r::2, c::2] = signals[i] * transfers[i], signals[i], i
    for moves in charge_of(camera, effects).kernels:
        amplitude, level = (
            convolve(part * phase, moves, mode="wrap") / phase
            for part, phase in ((amplitude, wave), (level, np.ones_like(level)))
        )
    wanted = [(amplitude[channel == i].mean() / level[channel == i].mean()) for i in range(3)]
    got = mix_channels(camera, transfers[:, None], signals, np.array([fx]), np.array([fy]), effects)[:, 0]
    assert np.allclose(got, wanted, rtol=0, atol=1e-12)


def test_charge_between_colours_takes_more_contrast_of_the_fainter(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """Where all channels have one transfer, what neighbours bring grows with their signal over a pixel's own; of one
    colour's pixels alone, the factor is the kernel's.
    """
    effects, f = (Crosstalk(share_percent=2.0),), np.array([0.0, 0.2])
    of_camera = {c: optical_transfer(colour_camera, c, lamp, f, 0 * f, effects) for c in "RGB"}
    plain = {c: optical_transfer(colour_camera, c, lamp, f, 0 * f) for c in "RGB"}
    rate = {c: electron_rate(colour_camera, c, lamp) for c in "RGB"}
    assert all(value[0] == pytest.approx(1.0, abs=1e-12) for value in of_camera.values())
    kept = {c: float(np.real(of_camera[c][1] / plain[c][1])) for c in "RGB"}
    faint, bright = min(rate, key=lambda c: rate[c]), max(rate, key=lambda c: rate[c])
    assert kept[faint] < kept[bright]
    mono = kernel_otf(effects[0].kernel(), f, 0 * f)[1]
    assert kept[faint] < mono < kept[bright]
