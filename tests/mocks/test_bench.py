"""The bench: its light path, the statistics of its cameras, and the agreement of its station file with its frames."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.formats.recording_set import DataSheet
from mocks.bench import Bench, BenchError, Clock
from mocks.conceal import SIDES, parse
from mocks.lamp import tristimulus
from mocks.light_path import (
    LED_FWHM_NM,
    LED_RADIANCE,
    USUAL_LED_FWHM_NM,
    WAVELENGTH_NM,
    LightSettings,
    sphere_radiance,
)
from mocks.targets import BOARD_POSES, BOARD_SQUARES, EDGE_ANGLES_DEG, MIXES, SQUARE_MM, STOPS, board_pose, corners_px
from mocks.truth import hidden_truth
from sim.camera import Side
from sim.frame import Exposure, predict_frame
from sim.optics.illumination import irradiance_factor
from sim.point import edge_profile
from sim.scene.scenes import UniformField
from sim.sensor.electrons import dark_current_e_per_s
from sim.sensor.margins import Margins
from sim.sensor.mosaic import planes
from sim.spectrum import FloatArray, Spectrum


@pytest.fixture(scope="module")
def drawn() -> Bench:
    """A bench whose drawings are kept for the module."""
    bench = Bench(seed=1)
    bench.set_filter(2)
    bench.set_shutter(True)
    return bench


@pytest.fixture
def bench(drawn: Bench) -> Iterator[Bench]:
    drawn.set_wavelength(0.0)
    drawn.set_filter(2)
    drawn.set_shutter(True)
    drawn.set_slit_um(3000.0)
    drawn.place("sphere")
    yield drawn
    drawn.show(None)


def light(**settings: float | bool | int) -> FloatArray:
    return sphere_radiance(LightSettings(shutter_open=True, **settings), WAVELENGTH_NM)  # type: ignore[arg-type]


class TestLightPath:
    def test_closed_shutter_is_dark(self, bench: Bench) -> None:
        bench.set_shutter(False)
        assert max(bench.radiance().value) < 5 * 2e-9  # the radiometer's own noise

    @pytest.mark.parametrize("slit_um", [1000.0, 1600.0, 3000.0])
    def test_bandwidth_is_the_slit_times_the_dispersion(self, slit_um: float) -> None:
        line = light(wavelength_nm=550.0, slit_um=slit_um, filter_place=2)
        above = WAVELENGTH_NM[line >= line.max() / 2]
        # half-power points lie on a grid of 0.5 nm at either end
        assert above[-1] - above[0] == pytest.approx(slit_um * 1e-3 * 3.16, abs=1.0)
        assert np.sum(line * WAVELENGTH_NM) / np.sum(line) == pytest.approx(550.0, abs=0.5)

    def test_half_the_wavelength_passes_without_its_filter(self) -> None:
        open_wheel = light(wavelength_nm=840.0, filter_place=1)
        sorted_ = light(wavelength_nm=840.0, filter_place=3)
        blue = (WAVELENGTH_NM > 410) & (WAVELENGTH_NM < 430)
        assert open_wheel[blue].max() > 1e-4
        assert sorted_[blue].max() < 1e-4 * open_wheel[blue].max()

    def test_blank_place_passes_nothing(self) -> None:
        assert not light(filter_place=6).any()

    @pytest.mark.parametrize("led_nm", [460, 550, 635])
    def test_an_led_has_its_total_at_its_wavelength_and_its_width(self, led_nm: int) -> None:
        line = sphere_radiance(LightSettings(leds=((led_nm, 0.5),)), WAVELENGTH_NM)
        # The grid's sum of a normal line is exact; of the widest, 1.3e-6 lies below 350 nm, 4.7 sigma away.
        assert 0.5 * line.sum() == pytest.approx(0.5 * LED_RADIANCE, rel=2e-6)
        above = WAVELENGTH_NM[line >= line.max() / 2]
        # half-power points lie on a grid of 0.5 nm at either end
        width_nm = LED_FWHM_NM.get(led_nm, USUAL_LED_FWHM_NM)
        assert above[-1] - above[0] == pytest.approx(width_nm, abs=1.0)
        assert np.average(WAVELENGTH_NM, weights=line) == pytest.approx(led_nm, abs=0.01)

    def test_leds_add_to_what_the_shutter_lets_through(self) -> None:
        leds = ((460, 0.2), (635, 1.0))
        alone = sphere_radiance(LightSettings(leds=leds, wavelength_nm=500.0), WAVELENGTH_NM)
        both = sphere_radiance(LightSettings(leds=leds, shutter_open=True, filter_place=2), WAVELENGTH_NM)
        np.testing.assert_allclose(both - alone, light(filter_place=2), rtol=0, atol=1e-15)
        one_by_one = [sphere_radiance(LightSettings(leds=(led,)), WAVELENGTH_NM) for led in leds]
        np.testing.assert_allclose(alone, np.sum(one_by_one, axis=0), rtol=0, atol=1e-15)

    @pytest.mark.parametrize("kelvin", sorted(MIXES))
    def test_a_mix_has_the_colour_temperature_that_the_station_file_states(self, kelvin: float) -> None:
        mix = LightSettings(leds=tuple(MIXES[kelvin].items()))
        x, y, z = tristimulus(Spectrum.of(WAVELENGTH_NM, sphere_radiance(mix, WAVELENGTH_NM)))
        at_x, at_y = x / (x + y + z), y / (x + y + z)
        n = (at_x - 0.3320) / (0.1858 - at_y)
        # McCamy (1992): the correlated colour temperature, to 2 K of its definition; mixed to within 100 K
        assert 449 * n**3 + 3525 * n**2 + 6823.3 * n + 5520.33 == pytest.approx(kelvin, abs=100.0)

    def test_zero_order_is_white(self) -> None:
        white = light(filter_place=2)
        visible = (WAVELENGTH_NM > 410) & (WAVELENGTH_NM < 710)
        assert white[visible].min() > 0.05 * white.max()

    def test_radiometer_reads_what_is_there_to_its_noise(self, bench: Bench) -> None:
        readings = np.array([bench.radiance().value for _ in range(20)])
        grid = np.array(bench.radiance().wavelength_nm)
        truth = np.interp(grid, WAVELENGTH_NM, light(filter_place=2))
        used = truth > 1e-3
        # 0.15 % a reading, 20 readings, and the lamp's 0.04 %; the worst of 340 points may be 4 sd off
        assert np.max(np.abs(readings.mean(0)[used] / truth[used] - 1)) < 4 * 0.0015 / np.sqrt(20) + 0.0004

    @pytest.mark.parametrize(
        ("what", "value"),
        [
            ("set_wavelength", -1.0),
            ("set_wavelength", 1500.0),
            ("set_filter", 7),
            ("set_slit_um", 1.0),
            ("place", "moon"),
        ],
    )
    def test_what_cannot_be_set(self, bench: Bench, what: str, value: object) -> None:
        with pytest.raises(BenchError):
            getattr(bench, what)(value)

    def test_lamp_drifts_by_less_than_a_thousandth(self) -> None:
        bench = Bench()
        factors = [bench._drift(bench.clock.now() + t) for t in np.linspace(0, 5000, 300)]
        assert 1e-4 < np.ptp(factors) < 1e-3


class TestScreen:
    def test_the_spot_sees_what_is_shown_in_the_middle(self, bench: Bench) -> None:
        bench.place("screen")
        bench.show(np.ones((10, 10), np.uint8), 60)
        lit = max(bench.radiance().value)
        bench.show(None)
        dark = max(bench.radiance().value)
        bench.show(np.tile(np.array([[0, 1], [1, 0]], np.uint8), (100, 100)), 2)
        half = max(bench.radiance().value)
        assert dark / lit == pytest.approx(0.0015, rel=0.02)
        assert half / lit == pytest.approx(0.5, abs=0.02)

    def test_too_large_a_pattern_is_refused(self, bench: Bench) -> None:
        with pytest.raises(BenchError, match="doesn't fit"):
            bench.show(np.ones((600, 600), np.uint8), 2)

    def test_a_cell_covers_the_pixels_that_the_station_says(self, bench: Bench) -> None:
        """One lit square of 200 screen px: its area in the frame is (200 x camera px per screen px)^2."""
        bench.place("screen")
        bench.show(np.ones((1, 1), np.uint8), 200)
        per_px = bench.station_targets()["screen"]["left"]["camera_px_per_screen_px"]
        green = planes(bench._light_rate("left"), "RGGB")["G1"]
        area = 4 * np.sum(green > 0.5 * green.max())
        assert np.sqrt(area) == pytest.approx(200 * per_px, rel=0.02)

    def test_the_visible_rectangle_is_visible(self, bench: Bench) -> None:
        bench.place("screen")
        row0, col0, row1, col1 = bench.station_targets()["screen"]["right"]["visible"]
        pattern = np.zeros((540, 960), np.uint8)
        pattern[row0 // 2 : row1 // 2, col0 // 2 : col1 // 2] = 1
        bench.show(pattern, 2)
        lit = bench._light_rate("right")
        border = np.concatenate([lit[:4].ravel(), lit[-4:].ravel(), lit[:, :4].ravel(), lit[:, -4:].ravel()])
        assert border.max() < 0.05 * lit.max()
        assert np.mean(lit[1::2, 0::2] > 0.3 * lit[1::2, 0::2].max()) > 0.8


class TestFrames:
    @pytest.mark.parametrize("side", SIDES)
    def test_statistics_are_those_of_the_truth(self, bench: Bench, side: Side) -> None:
        """Pairs of flats: mean and temporal variance of every colour against the hidden camera's own numbers."""
        camera = hidden_truth(1).cameras[side].model
        exposure_s = 0.002 if side == "left" else 0.0008
        frames = np.array([bench.expose(side, exposure_s) for _ in range(8)], float)
        rate = bench._light_rate(side)
        gain = camera.conversion_gain_dn_per_e
        for name, plane in planes(rate * exposure_s, "RGGB").items():
            electrons = float(plane.mean())
            seen = planes(frames, "RGGB")[name]
            n = seen[0].size
            mean = camera.black_level_dn + gain * (electrons + camera.dark_current_e_per_s * exposure_s)
            variance = gain**2 * (electrons + camera.read_noise_e**2) + 1 / 12
            # the mean: shot noise of n x 8 values, PRNU and DSNU of n pixels, and the lamp's drift
            fixed = np.hypot(gain * electrons * camera.prnu_percent / 100, gain * camera.dsnu_e) / np.sqrt(n)
            tolerance = 4 * np.hypot(np.sqrt(variance / n / 8), fixed) + 4e-4 * gain * electrons
            assert seen.mean() == pytest.approx(mean, abs=tolerance)
            # the variance of 8 frames: relative sd sqrt(2 / (7 n)); the light isn't quite even over the field
            within = seen.var(axis=0, ddof=1).mean()
            assert within == pytest.approx(variance, rel=4 * np.sqrt(2 / 7 / n))

    def test_dark_frames(self, bench: Bench) -> None:
        bench.place("cap")
        camera = hidden_truth(1).cameras["left"]
        short = np.array([bench.expose("left", 1e-5) for _ in range(4)], float)
        long = np.array([bench.expose("left", 10.0) for _ in range(4)], float)
        gain = camera.model.conversion_gain_dn_per_e
        rate = (long.mean() - short.mean()) / gain / 10.0
        expected_rate = dark_current_e_per_s(camera.model, bench.sensor_temperature_c("left"))
        # 4 frames of 307,200 pixels, each with sqrt(58 + 5) e: 0.008 e in 10 s; the temperature swings by 0.1 degrees
        assert rate == pytest.approx(expected_rate, rel=0.015)
        pixels = short.mean(axis=0)
        spatial = pixels.var() - short.var(axis=0, ddof=1).mean() / 4
        # the fixed pattern is seen through rounding; its variance is known to a few per cent from 4 frames
        assert np.sqrt(spatial) / gain == pytest.approx(camera.model.dsnu_e, rel=0.03)

    def test_frames_saturate(self, bench: Bench) -> None:
        frame = bench.expose("left", 1.0)
        model = hidden_truth(1).cameras["left"].model
        full = min(4095.0, model.black_level_dn + model.conversion_gain_dn_per_e * model.full_well_e)
        assert frame.mean() == pytest.approx(full, abs=2.0)

    def test_gain(self, bench: Bench) -> None:
        one, two = (bench.expose("left", 0.001, gain_db=db).mean() - 64.3 for db in (0.0, 12.0412))
        assert two / one == pytest.approx(4.0, rel=3e-3)

    def test_frames_differ_and_come_again_from_the_same_seed(self) -> None:
        first, second = Bench(seed=9), Bench(seed=9)
        a, b = first.expose("left", 0.01), first.expose("left", 0.01)
        assert not np.array_equal(a, b)
        assert np.array_equal(a, second.expose("left", 0.01))
        assert not np.array_equal(a, Bench(seed=10).expose("left", 0.01))

    def test_uniform_field_is_the_forward_models(self, bench: Bench) -> None:
        """Without concealed effects the bench and `sim.frame` say the same of a flat."""
        camera = hidden_truth(1).cameras["right"].model
        radiance = Spectrum.of(WAVELENGTH_NM, light(filter_place=2))
        there = predict_frame(camera, Exposure(UniformField(radiance), 0.0008))
        rate = bench._light_rate("right")
        dark = camera.dark_current_e_per_s * 0.0008
        here = camera.black_level_dn + camera.conversion_gain_dn_per_e * (rate * 0.0008 + dark)
        assert np.allclose(here, there, rtol=1e-6)

    def test_one_clock_for_a_pair(self, bench: Bench) -> None:
        start = bench.clock.now()
        bench.expose("left", 0.5, start_s=start)
        bench.expose("right", 0.2, start_s=start)
        assert bench.clock.now() == pytest.approx(start + 0.5)

    def test_unknown_side(self, bench: Bench) -> None:
        with pytest.raises(BenchError, match="no camera 'middle'"):
            bench.expose("middle", 0.1)  # type: ignore[arg-type]

    def test_threads(self, bench: Bench) -> None:
        """Settings change while both cameras expose: every frame belongs to one setting, none mixes two."""
        failures: list[BaseException] = []

        def work(side: Side) -> None:
            try:
                for _ in range(15):
                    mean = bench.expose(side, 0.0005).mean()
                    assert mean < 70 or mean > 150
            except BaseException as error:
                failures.append(error)

        workers = [threading.Thread(target=work, args=(side,)) for side in SIDES]
        for worker in workers:
            worker.start()
        while any(worker.is_alive() for worker in workers):
            bench.set_shutter(False)
            bench.set_shutter(True)
        for worker in workers:
            worker.join()
        assert not failures


class TestTargets:
    @pytest.mark.parametrize("stop", ["f/5.6", "f/8"])
    def test_a_stop_of_the_aperture_ring_takes_light_and_stays_until_the_next(self, bench: Bench, stop: str) -> None:
        """Irradiance pi / (4 N^2 + 1) of the radiance; means over 1e5 pixels of a channel are known to 1e-4, and the
        lamp to 4e-4."""
        expected = irradiance_factor(STOPS[stop]) / irradiance_factor(4.0)
        black = hidden_truth(1).cameras["left"].model.black_level_dn
        try:
            wide = bench.expose("left", 2e-3).mean() - black
            bench.place(stop)
            assert bench.placed == "sphere"
            assert (bench.expose("left", 2e-3).mean() - black) / wide == pytest.approx(expected, rel=3e-3)
            bench.place("f/4")
            assert bench.expose("left", 2e-3).mean() - black == pytest.approx(wide, rel=2e-3)
        finally:
            bench.place("f/4")

    def test_a_turned_edge_leans_to_the_right_by_its_turn(self, bench: Bench) -> None:
        """By the places of half the light in 40 rows of a channel. Rounded to a pixel (0.29 px), their slope is known
        to 0.29 / (11.5 sqrt 40) = 0.004, a quarter of a degree at 45; the lens bends lines by as much."""

        def lean_deg() -> float:
            rate = bench._light_rate("left")[1:480:2, 1:640:2][100:140, 110:210]  # one channel, about the middle
            half = 0.5 * (rate.min() + rate.max())
            crossing = np.argmin(np.abs(rate - half), axis=1)
            return float(np.degrees(np.arctan(-np.polyfit(np.arange(len(crossing)), crossing, 1)[0])))

        bench.place("edge-1")
        try:
            straight = lean_deg()
            bench.place("turn 45")
            assert bench.placed == "edge-1"
            assert lean_deg() - straight == pytest.approx(45.0, abs=0.7)
        finally:
            bench.place("turn 0")

    def test_sensors_are_brought_to_a_temperature_and_back(self, bench: Bench) -> None:
        usual = bench.sensor_temperature_c("left")
        try:
            bench.place("35 C")
            assert bench.sensor_temperature_c("left") == bench.sensor_temperature_c("right") == 35.0
        finally:
            bench.place("usual")
        assert bench.sensor_temperature_c("left") == pytest.approx(usual, abs=0.2)  # the air's own change

    def test_every_target_has_a_layout(self, bench: Bench) -> None:
        assert set(bench.station_targets()) == set(bench.targets)

    @pytest.mark.parametrize("side", SIDES)
    def test_chart_is_where_the_station_says(self, bench: Bench, side: Side) -> None:
        """The neutral row falls off in order, and just outside the corners there is frame."""
        bench.place("colorchecker")
        rate = bench._light_rate(side)
        corners = np.array(bench.station_targets()["colorchecker"][side]["corners"])
        top = np.linspace(corners[0], corners[1], 6 * 2 + 1)[1::2]
        bottom = np.linspace(corners[3], corners[2], 6 * 2 + 1)[1::2]
        greys = []
        for k in range(6):
            row, col = (top[k] + (bottom[k] - top[k]) * 7 / 8).astype(int) // 2 * 2
            greys.append(planes(rate[row - 6 : row + 6, col - 6 : col + 6], "RGGB")["G1"].mean())
        assert np.all(np.diff(greys) < 0)
        outside = corners[0] - [8, 8]
        assert rate[tuple(outside.astype(int))] < greys[4] / 2

    @pytest.mark.parametrize("name", EDGE_ANGLES_DEG)
    @pytest.mark.parametrize("side", SIDES)
    def test_edges_cross_their_regions(self, bench: Bench, name: str, side: Side) -> None:
        bench.place(name)
        rate = bench._light_rate(side)
        regions = bench.station_targets()[name][side]["regions"]
        assert [region["name"] for region in regions] == ["centre", "mid", "corner"]
        for region in regions:
            row0, col0, row1, col1 = region["region"]
            assert row0 >= 16 and col0 >= 16 and row1 <= 464 and col1 <= 624
            green = planes(rate[row0:row1, col0:col1], "RGGB")["G1"] / rate.max()
            lit = green > 0.5 * green.max()
            assert 0.35 < lit.mean() < 0.65
            # the moments of the lit half give the edge's angle: its centre of mass lies along the normal
            rows, cols = np.indices(lit.shape)
            disc = np.hypot(rows - rows.mean(), cols - cols.mean()) < 0.45 * lit.shape[0]
            towards = (rows[lit & disc].mean() - rows.mean(), cols[lit & disc].mean() - cols.mean())
            angle = np.rad2deg(np.arctan2(*towards))
            assert (angle - region["angle_deg"] + 180) % 360 - 180 == pytest.approx(0, abs=1.5)

    def test_edge_profile_is_the_lens_and_filters(self, bench: Bench) -> None:
        """A row through the sharp camera's centre edge, against the profile of the forward model at the fitted
        place."""
        bench.place("edge-1")
        camera = hidden_truth(1).cameras["right"]
        rate = bench._light_rate("right")
        row0, col0, row1, col1 = bench.station_targets()["edge-1"]["right"]["regions"][0]["region"]
        radiance = Spectrum.of(WAVELENGTH_NM, light(filter_place=2))
        green = planes(rate[row0:row1, col0:col1], "RGGB")["G1"]
        level = (green - green.min()) / (green.max() - green.min())
        # straight line through the half-way points of every row, then the profile at the distances from it
        crossing = np.array([np.interp(0.5, row[10:-10], np.arange(10, row.size - 10)) for row in level])
        slope, at = np.polyfit(np.arange(crossing.size), crossing, 1)
        rows, cols = np.indices(level.shape)
        angle = -np.rad2deg(np.arctan(slope))
        distance = 2 * (cols - at - slope * rows) * np.cos(np.deg2rad(angle))
        profile = edge_profile(camera.model, "G", radiance, angle, distance, camera.effects)
        near = np.abs(distance) < 10
        # linear interpolation between samples 2 px apart places the edge to 0.05 px, where the slope is 0.5 / px
        assert np.max(np.abs(level - profile)[near]) < 0.03

    @pytest.mark.parametrize("name", ["charuco-01", "charuco-06", "charuco-10", "charuco-12"])
    @pytest.mark.parametrize("side", SIDES)
    def test_boards_are_found_whole(self, bench: Bench, name: str, side: Side) -> None:
        bench.place(name)
        # of one noisy frame a marker's bit may be misread, whatever the board
        frames = [bench.expose(side, 0.0025 if side == "left" else 0.0009) for _ in range(6)]
        grey = np.mean(frames, axis=0, dtype=np.float32) - 64
        grey = (grey[0::2, 0::2] + grey[0::2, 1::2] + grey[1::2, 0::2] + grey[1::2, 1::2]) / 4
        image = np.clip(grey / grey.max() * 255, 0, 255).astype(np.uint8)
        layout = bench.station_targets()[name]
        rows, cols = layout["squares"]
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, layout["dictionary"]))
        board = cv2.aruco.CharucoBoard((cols, rows), layout["square_mm"], layout["marker_mm"], dictionary)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(cv2.resize(image, None, fx=2, fy=2))
        assert corners is not None
        assert len(ids) == (rows - 1) * (cols - 1)

    def test_all_boards_lie_inside_both_frames(self, bench: Bench) -> None:
        rows, cols = BOARD_SQUARES
        for side in SIDES:
            camera = hidden_truth(1).cameras[side]
            for name in BOARD_POSES:
                warp = board_pose(name).warp(camera, SQUARE_MM, (-cols / 2 * SQUARE_MM, -rows / 2 * SQUARE_MM))
                points = corners_px(warp, cols, rows)
                assert points.min() > 8
                assert np.all(points < [480 - 9, 640 - 9])


class TestHidden:
    def test_the_left_camera_conceals_two_effects_and_the_right_none(self) -> None:
        truth = hidden_truth(1)
        assert [effect.name for effect in truth.cameras["left"].effects] == [
            "optical_low_pass_filter",
            "infrared_cut_filter",
        ]
        assert truth.cameras["right"].effects == ()

    def test_the_infrared_is_cut_on_the_left_only(self, bench: Bench) -> None:
        bench.set_wavelength(700.0)
        bench.set_filter(3)
        left, right = (planes(bench._light_rate(side), "RGGB")["R"].mean() for side in SIDES)
        assert left < 1e-4 * right

    def test_stereo_baseline(self) -> None:
        rotation, translation = hidden_truth(1).stereo()
        assert np.allclose(rotation @ rotation.T, np.eye(3))
        assert np.linalg.norm(translation) == pytest.approx(60.0, abs=1.0)
        assert translation[0] < 0  # the right camera is to the right of the left one

    @pytest.mark.parametrize("seed", range(5))
    def test_makers_curves_are_off_by_a_smooth_few_per_cent(self, seed: int) -> None:
        for camera in hidden_truth(seed).cameras.values():
            for channel, sheet in camera.datasheet["quantum_efficiency"].items():
                w, maker = np.array(sheet["wavelength_nm"]), np.array(sheet["value"])
                used = (maker > 0.02) & (w > 400) & (w < 700)
                ratio = camera.model.quantum_efficiency[channel].at(w[used]) / maker[used]
                assert np.abs(ratio - 1).max() < 0.07
                neighbours = np.diff(w[used]) < 6
                assert np.abs(np.diff(ratio)[neighbours]).max() < 0.005

    def test_nothing_hidden_is_told_to_the_station(self, bench: Bench) -> None:
        told = json.dumps({"cameras": bench.station_cameras(), "targets": bench.station_targets()})
        for camera in hidden_truth(1).cameras.values():
            model = camera.model
            secrets = [
                model.conversion_gain_dn_per_e,
                model.read_noise_e,
                model.dark_current_e_per_s,
                model.black_level_dn,
            ]
            secrets += [
                model.full_well_e,
                *(value for row in camera.geometry.camera_matrix[:2] for value in row if value),
            ]
            secrets += [value for value in camera.geometry.distortion if value]
            secrets += [value for e in camera.effects for value in e.model_dump().values() if value]
            assert not [secret for secret in secrets if f"{secret:.6g}" in told]

    def test_fixed_pattern_has_its_size(self) -> None:
        for camera in hidden_truth(1).cameras.values():
            assert camera.pattern.prnu.std() * 100 == pytest.approx(camera.model.prnu_percent)
            assert camera.pattern.dsnu_e.std() == pytest.approx(camera.model.dsnu_e)

    def test_other_effects_leave_the_rest_of_the_camera(self) -> None:
        plain, default = hidden_truth(1, {}).cameras["left"], hidden_truth(1).cameras["left"]
        assert plain.model == default.model
        assert plain.effects == ()


COMPILED = """
import sys

import numpy as np
from numba.core.dispatcher import Dispatcher

from mocks.bench import Bench


def kinds():
    names = [name for name in sys.modules if name.startswith("sim.")]
    loops = [loop for name in names for loop in vars(sys.modules[name]).values() if isinstance(loop, Dispatcher)]
    return {loop.py_func.__qualname__: len(loop.signatures) for loop in loops if loop.signatures}


bench = Bench()
bench.compile_loops()
before = kinds()
assert before
bench.set_shutter(True)
bench.show(np.eye(8, dtype=np.uint8), 8)
for target in ("cap", "sphere", "colorchecker", "edge-1", "screen", "charuco-01"):
    bench.place(target)
    bench.expose("left", 0.001)
bench.expose("right", 0.001)
assert kinds() == before, (before, kinds())
"""


def test_no_frame_waits_for_a_compiler() -> None:
    """In a process of its own: another test may have had the loops compiled."""
    subprocess.run([sys.executable, "-c", COMPILED], check=True, cwd=Path(__file__).parents[2], timeout=120)


def test_clock_is_virtual_unless_asked() -> None:
    clock = Clock()
    began = time.monotonic()
    start = clock.now()
    clock.sleep(100.0)
    clock.sleep_until(start + 50.0)  # has gone by
    assert clock.now() == pytest.approx(start + 100.0)
    assert time.monotonic() - began < 100.0
    slow = Clock(real_time_factor=0.05)
    began = time.monotonic()
    slow.sleep(1.0)
    slow.sleep_until(slow.now() + 1.0)
    assert time.monotonic() - began >= 0.1


def test_frames_with_margins_hold_the_image_and_what_is_around_it() -> None:
    """Deferred charge in the j-th row of overscan: (1 - b) b^(j - 1) of the most that any packet of a column has left
    in the traps, n loss after n transfers, b = exp(-1). A row of 64 pixels and 30 frames scatters by 2.3 / sqrt(1920) =
    0.05 e, and its shot noise."""
    margins = Margins(masked_rows=(2, 0), overscan_rows=(0, 8), overscan_cols=(0, 4))
    bench = Bench(
        1, concealed=parse(["left:charge_transfer_inefficiency:parallel_ppm=500,release_px=1"]), shape=(48, 64),
        margins=margins,
    )  # fmt: skip
    sheet = DataSheet.model_validate(bench.station_cameras()["left"] | {"quantum_efficiency": None})
    assert (sheet.rows, sheet.cols, sheet.frame_shape) == (48, 64, (58, 68))
    assert bench.sensor("left")[:2] == sheet.frame_shape
    bench.place("sphere")
    bench.set_shutter(True)
    frames = np.mean([bench.expose("left", 0.002) for _ in range(30)], axis=0)
    assert frames.shape == sheet.frame_shape
    camera = bench._truth.cameras["left"].model
    electrons = (frames - camera.black_level_dn) / camera.conversion_gain_dn_per_e
    assert electrons[:2, 10:50].mean() == pytest.approx(0.0, abs=0.5)
    behind_e, number, held = electrons[50:58, :64].mean(axis=1), np.arange(48), float(np.exp(-1.0))
    colours_e = [electrons[2:50, first:64:2].mean(axis=1) for first in (0, 1)]  # of even and of odd columns
    left_e = np.mean([np.max(500e-6 * (number + 1) * e * held ** (47 - number)) for e in colours_e])
    last_e, lost = np.mean(colours_e, axis=0)[-2:].mean(), 500e-6 * 48
    for lag in range(3):
        wanted_e = float(left_e) * (1.0 - held) * held**lag
        std_e = np.hypot(2.3, np.sqrt(wanted_e)) / np.sqrt(1920.0)
        # terms of second order: (n loss)^2 of the signal
        assert behind_e[lag] == pytest.approx(wanted_e, abs=4.0 * std_e + lost**2 * last_e)
    assert 500.0 < last_e < 8000.0
    assert bench.expose("right", 0.02).shape == sheet.frame_shape
