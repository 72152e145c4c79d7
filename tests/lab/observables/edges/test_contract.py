"""What holds of every edge that is accepted: its numbers are unbiased, their covariance is true, their prediction is
the mean of drawn frames, and no statement of the manifest enters them.

Frames are drawn by the chain of light that also predicts, so that nothing but the estimator is tested.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_triangular

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.errors import InputError, NotDetermined
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import Manifest, RecordingSet
from lab.observables.dataset import Dataset
from lab.observables.edges.finding import region_planes
from lab.observables.edges.measured import measure_edge
from lab.observables.edges.prediction import EDGE_FLOOR, PredictedEdges
from lab.observables.edges.profile import summarise_edge
from lab.observables.edges.side import SideEdge
from lab.observables.edges.slanted_edge import measure_slanted_edge
from lab.observables.gaussian import chi2
from sim.camera import CameraModel
from sim.frame import Exposure, dark_electrons, expected_electrons, read_out
from sim.scene.scenes import EdgeRegion, KnifeEdge
from sim.sensor import electrons as sensor
from sim.spectrum import Spectrum

DARK_SIDE, LIGHT_SIDE = 0.08, 0.55  # of the light side; of the full well
EDGES = 24
NUMBERS = 17
#: Least side of a square region, px, by steps of 4, from which edges of all channels are accepted.
LEAST_PX = {"MONO": 20, "RGGB": 36, "GRBG": 36, "GBRG": 36, "BGGR": 36}


class Drawn:
    """Edges at many angles and places, in a frame each, as the baseline model of a camera draws them."""

    def __init__(self, cfa: str, bits: int, size: int, edges: int = EDGES, seed: int = 7) -> None:
        self._rng = np.random.default_rng(seed)
        former = ConcealedCamera(seed, (), rows=size, cols=size, cfa=cfa, f_number=4.0, bit_depth=bits)
        self._given = recordings_of(former, Plan(("dark", "slanted_edge")))
        self._dataset = Dataset(self._given, "left", camera_model(self._given, "left", None, maker_curves=True))
        self.camera: CameraModel = self._dataset.camera
        document = self._given.manifest.model_dump(mode="json", exclude_none=True)
        example = next(c for c in document["captures"] if c["kind"] == "slanted_edge")
        bright = self._given.spectrum(example["light_radiance"])
        dark = Spectrum.of(bright.arrays[0], DARK_SIDE * bright.arrays[1])
        region = (0, 0, size, size)
        captures, self._frames, self.means = [], {}, []
        angle_deg = np.repeat([0.0, 90.0], (edges + 1) // 2)[:edges] + np.linspace(12.0, 30.0, edges)
        for k, angle in enumerate(angle_deg):
            scene = KnifeEdge((EdgeRegion(region, float(angle), float(self._rng.uniform(-0.5, 0.5))),), dark, bright)
            lit = expected_electrons(self.camera, Exposure(scene, 1.0, placed="image"))
            level = LIGHT_SIDE * self._rng.uniform(0.9, 1.0) * self.camera.full_well_e
            exposure = Exposure(scene, float(level / lit.max()), placed="image")
            path = f"frames/drawn{k}.npy"
            captures.append(
                example
                | {"id": f"drawn{k}", "frame": path, "angle_deg": float(angle), "region": list(region)}
                | {"exposure_s": exposure.exposure_s}
            )
            mean = expected_electrons(self.camera, exposure)
            self._frames[path] = sensor.sample_from(
                mean, self.camera, self._rng, sensor.FixedPattern.draw(self.camera, self._rng),
                dark_electrons=dark_electrons(self.camera, exposure, ()), read_out=read_out(self.camera, exposure, ()),
            )  # fmt: skip
            self.means.append(sensor.dn_moments(mean, self.camera, 0.0, read_out(self.camera, exposure, ()))[0])
        others = [c for c in document["captures"] if c["kind"] != "slanted_edge"]
        self.document = document | {"captures": others + captures}

    def recordings(self, document: dict[str, Any] | None = None) -> RecordingSet:
        """Return the frames as a manifest describes them."""
        return self._given.with_frames(self._frames).under(Manifest.model_validate(document or self.document))

    def dataset(self, document: dict[str, Any] | None = None) -> Dataset:
        """Return the dataset of the frames, with the camera that drew them."""
        return Dataset(
            self.recordings(document), "left", self.camera, self._dataset.saturation_dn, noise=self._dataset.noise
        )


@pytest.mark.parametrize("bits", [12, pytest.param(8, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "cfa", ["MONO", "GBRG", *(pytest.param(c, marks=pytest.mark.slow) for c in ("RGGB", "GRBG", "BGGR"))]
)
def test_the_numbers_of_the_least_region_are_unbiased_and_their_covariance_is_true(cfa: str, bits: int) -> None:
    """chi2 of n numbers is n within three standard deviations: sqrt(2 n) of normal numbers, and those of the variance
    of each edge's noise, sqrt(2 / 120) of some 120 samples beside it. The means of m whitened edges are normal with a
    variance of 1 / m: of 17 numbers, chi2 is 17 + 3 sqrt(34) at most."""
    block = measure_slanted_edge(Drawn(cfa, bits, LEAST_PX[cfa]).dataset())
    n = len(block.value)
    assert {label.channel for label in block.labels} == set("Y" if cfa == "MONO" else "RGB")
    residual = block.value - block.predict(()).mean
    variance = 2.0 * n + NUMBERS * n * 2.0 / 120.0
    assert abs(chi2(residual, block.covariance) - n) < 3.0 * np.sqrt(variance)
    white = []
    for first in range(0, n, NUMBERS):
        own = slice(first, first + NUMBERS)
        white.append(solve_triangular(np.linalg.cholesky(block.covariance[own, own]), residual[own], lower=True))
    mean = np.mean(white, axis=0) * np.sqrt(len(white))
    assert mean @ mean < NUMBERS + 3.0 * np.sqrt(2.0 * NUMBERS)


@pytest.mark.parametrize("cfa", ["MONO", "RGGB", "GRBG", "GBRG", "BGGR"])
@pytest.mark.parametrize("size", [32, 64])
def test_a_prediction_is_what_the_estimator_reports_of_the_mean_frame(cfa: str, size: int) -> None:
    """Without noise and rounding: within three times the floor of the model's sampling of wavelengths and places."""
    drawn = Drawn(cfa, 12, size, edges=2)
    dataset = drawn.dataset()
    edges = []
    for capture, mean in zip(dataset.recordings.captures(SlantedEdgeCapture), drawn.means, strict=True):
        for channel in dataset.channels:
            # weights as of a noisy frame
            region = (0, 0, size, size)
            summary = summarise_edge(region_planes(mean, region, drawn.camera.cfa, channel), noise_std=2.0)
            edges.append(SideEdge((capture,), channel, summary, False, region, 0.0))
    predicted = PredictedEdges(dataset, edges, drawn.camera)
    np.testing.assert_allclose(predicted.value, predicted.predict(()), atol=3.0 * EDGE_FLOOR)


@pytest.mark.parametrize("cfa", ["RGGB", "GRBG", "GBRG", "BGGR"])
@pytest.mark.parametrize(("rows", "cols"), [(150, 98), (98, 150)])
def test_edges_of_tall_and_wide_frames_of_another_simulator_are_predicted(cfa: str, rows: int, cols: int) -> None:
    """chi2 of n numbers is n within four standard deviations, those of each edge's noise included. The camera's own
    spectra and lens are stated, and its regions lie in the frame."""
    former = ConcealedCamera(7, (), rows=rows, cols=cols, cfa=cfa, bit_depth=10)
    given = recordings_of(former, Plan(("dark", "slanted_edge")))
    for capture in given.captures():
        assert not list(capture.problems(rows, cols))
    dataset = Dataset(given, "left", camera_model(given, "left", None, maker_curves=True))
    block = measure_slanted_edge(dataset)
    n = len(block.value)
    prediction = block.predict(())
    nuisances = np.reshape(list(prediction.jacobian.values()), (-1, n))
    found = chi2(block.value - prediction.mean, block.covariance + nuisances.T @ nuisances)
    assert found - n < 4.0 * np.sqrt(2.0 * n + NUMBERS * n * 2.0 / 120.0)


def test_a_region_outside_the_frame_is_refused() -> None:
    with pytest.raises(InputError, match=r"region \[4, -22, 146, 120\] isn't inside the frame of 150 x 98"):
        region_planes(np.zeros((150, 98)), (4, -22, 146, 120), "GBRG", "R")


def test_a_region_that_reaches_too_little_is_refused() -> None:
    with pytest.raises(NotDetermined, match=r"reach 7\.\d px from the edge, 8 px are needed: widen the region"):
        measure_slanted_edge(Drawn("MONO", 12, LEAST_PX["MONO"] - 4, edges=2).dataset())


def test_too_few_samples_are_refused() -> None:
    """28 x 28 px hold 14 x 14 reds, and twice as many greens."""
    block = measure_slanted_edge(Drawn("GBRG", 12, LEAST_PX["GBRG"] - 8, edges=2).dataset())
    assert {label.channel for label in block.labels} == {"G"}


@pytest.mark.parametrize(
    ("of_camera", "of_edges"),
    [
        ({"black_level_dn": 0.0}, {}),
        ({"f_number": 8.0}, {}),
        ({"pixel_pitch_um": 9.0, "fill_factor": 0.3}, {}),
        ({"conversion_gain_dn_per_e": 3.0}, {}),
        ({}, {"exposure_s": 12.0}),
        ({}, {"angle_deg": 40.0}),
        ({}, {"light_radiance": None}),
    ],
    ids=["black level", "f-number", "pitch", "gain", "exposure", "angle", "light"],
)
def test_no_statement_enters_the_numbers(of_camera: dict[str, Any], of_edges: dict[str, Any]) -> None:
    """Bit for bit. Numbers of the edges are added to what is stated, so that edges don't become repeats."""
    drawn = Drawn("GRBG", 12, 32, edges=2)
    captures = [dict(c) for c in drawn.document["captures"]]
    for capture in captures:
        for key, value in of_edges.items() if capture["kind"] == "slanted_edge" else ():
            capture[key] = value if value is None else capture[key] + value
    changed = drawn.document | {
        "cameras": {"left": drawn.document["cameras"]["left"] | of_camera}, "captures": captures
    }  # fmt: skip
    values = []
    for document in (drawn.document, changed):
        recordings = drawn.recordings(document)
        camera = camera_model(recordings, "left", None, maker_curves=True)
        values.append(measure_slanted_edge(Dataset(recordings, "left", camera)).value)
    np.testing.assert_array_equal(values[0], values[1])


@pytest.mark.parametrize(("cfa", "other"), [("GRBG", "GBRG"), ("RGGB", "BGGR")])
def test_a_plane_is_summarised_alike_under_another_mosaic(cfa: str, other: str) -> None:
    """Bit for bit: the red plane of one is the blue plane of the other, the greens are the same."""
    drawn = Drawn(cfa, 12, 32, edges=1)
    swapped = drawn.document | {"cameras": {"left": drawn.document["cameras"]["left"] | {"cfa": other}}}
    first, second = drawn.recordings(), drawn.recordings(swapped)
    for here, there in (("R", "B"), ("B", "R"), ("G", "G")):
        one = measure_edge(first, first.captures(SlantedEdgeCapture), here)
        two = measure_edge(second, second.captures(SlantedEdgeCapture), there)
        np.testing.assert_array_equal(one.gram, two.gram)
        np.testing.assert_array_equal(one.solution, two.solution)
        assert one.levels == two.levels


def test_an_edge_is_summarised_once_for_all_statements() -> None:
    """Sets of the same frames have their summaries in common."""
    drawn = Drawn("MONO", 12, 32, edges=1)
    recordings = drawn.recordings()
    (capture,) = recordings.captures(SlantedEdgeCapture)
    summary = measure_edge(recordings, [capture], "Y")
    assert measure_edge(recordings.without({"none"}), [capture], "Y") is summary
    other = {capture.frame: np.array(recordings.frame(capture))}
    assert measure_edge(recordings.with_frames(other), [capture], "Y") is not summary


@pytest.mark.parametrize("cfa", ["MONO", "GRBG"])
def test_edges_of_unstated_angles_are_told_apart_by_the_frames(cfa: str) -> None:
    """Four edges of two repeats each in one region: without `angle_deg` they are the same eight captures in pairs,
    and the numbers are equal bit for bit."""
    stated = recordings_of(ConcealedCamera(5, cfa=cfa, rows=120, cols=160), Plan(("dark", "slanted_edge")))
    document = stated.manifest.model_dump(mode="json", exclude_none=True)
    for capture in document["captures"]:
        capture.pop("angle_deg", None)
    bare = stated.under(Manifest.model_validate(document))
    of_stated, of_bare = (
        measure_slanted_edge(Dataset(one, "left", camera_model(one, "left", None, maker_curves=True)))
        for one in (stated, bare)
    )
    assert len({label.captures for label in of_bare.labels}) == 8  # one of two repeats is held out
    assert [label.captures for label in of_bare.labels] == [label.captures for label in of_stated.labels]
    np.testing.assert_array_equal(of_bare.value, of_stated.value)
