"""Slanted edges in the diagnosis: the prediction equals the estimator, the covariance is right, and blurs are told
apart."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator import laws as concealed
from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.errors import NotDetermined
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import Manifest, RecordingSet
from lab.observables.dataset import Dataset
from lab.observables.edges.mtf import read_mtf
from lab.observables.edges.region import check_phases
from lab.observables.edges.side import SideEdge, edges_of_side
from lab.observables.edges.slanted_edge import ASIDE, measure_slanted_edge, measure_stopped_edge
from lab.observables.edges.transfer import REAL_AT
from lab.observables.gaussian import chi2
from lab.observables.observable import Observable
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.effects.library import effect
from sim.point import optical_transfer
from sim.stages import Charge, Stray

EDGES = Plan(("dark", "slanted_edge"))


def _dataset(recordings: RecordingSet) -> Dataset:
    return Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))


def _edges(dataset: Dataset) -> list[SideEdge]:
    return edges_of_side(dataset, SlantedEdgeCapture, "slanted_edge")


def _recorded(
    *laws: Law, seed: int = 7, plan: Plan = EDGES, pitch: float | None = None, rows: int = 112, **camera: Any
) -> Dataset:
    former = ConcealedCamera(seed, laws, rows=rows, cols=rows, **camera)
    former.pitch_um = pitch or former.pitch_um
    return _dataset(recordings_of(former, plan))


def _misfit(block: Observable, *acting: Effect, aside: bool | None = None) -> float:
    """chi2 of n numbers over its limit 1.1 n + 3 sqrt(2 n): three standard deviations of chi2, and a tenth for errors
    that edges in the same place share. Above 1 the prediction is wrong. `aside`: of asymmetries (True) or contrasts
    (False) alone."""
    where = np.array([aside is None or label.condition.endswith(ASIDE) == aside for label in block.labels])
    n = int(where.sum())
    return _chi2(block, *acting, where=where) / (1.1 * n + 3.0 * np.sqrt(2.0 * n))


def _chi2(block: Observable, *acting: Effect, where: np.ndarray | slice = slice(None)) -> float:
    """chi2 of the numbers that `where` selects."""
    model = block.predict(acting)
    covariance = block.covariance + sum(np.outer(s, s) for s in model.jacobian.values())
    return chi2((block.value - model.mean)[where], covariance[where][:, where])


@pytest.mark.parametrize(("cfa", "f_number"), [("MONO", 2.0), ("RGGB", 2.0), ("MONO", 8.0)])
def test_a_models_numbers_are_its_transfer_function(cfa: str, f_number: float) -> None:
    """The estimator's rows applied to a model's profile give its transfer function at the measured frequencies, also of
    sharp lenses, whose detail lies far beyond the pixels' Nyquist frequency. A cubic between 11 frequencies is good to
    3e-3; the highest three depend on what lies beyond. Recording and prediction have the contrast of the recorded
    profile in common, which is known to the standard uncertainty of the lowest frequency's MTF: three of these."""
    dataset = _recorded(cfa=cfa, f_number=f_number, pitch=4.5)
    camera, block = dataset.camera, measure_slanted_edge(dataset)
    channel = camera.channels[0]
    labels = [label for label in block.labels if label.condition == "5 deg" and label.channel == channel]
    rows = [block.labels.index(label) for label in labels][: len(REAL_AT)]
    f, turn = np.array([block.labels[i].x for i in rows]), np.deg2rad(5.0)
    light = dataset.recordings.spectrum(str(dataset.recordings.captures("slanted_edge")[0].light_radiance))
    edge = next(e for e in _edges(dataset) if e.channel == channel and e.part[0].id in labels[0].captures)
    contrast_std = read_mtf(edge.summary, f[:1]).mtf_std[0]
    blurs: tuple[tuple[Effect, ...], ...] = (
        (), (effect("defocus")(defocus_um=0.8 * f_number**2),), (effect("pixel_aperture")(side_change_um=0.3),),
    )  # fmt: skip
    for acting in blurs:
        wanted = np.real(optical_transfer(camera, channel, light, f * np.cos(turn), f * np.sin(turn), acting))
        np.testing.assert_allclose(block.predict(acting).mean[rows[:-3]], wanted[:-3], atol=3e-3 + 3.0 * contrast_std)


def test_noise_is_what_the_covariance_says() -> None:
    """Of sharp and soft lenses, mono and colour: chi2 of n numbers is n within 3 sqrt(2 n), and a tenth."""
    for seed, cfa, f_number in ((11, "MONO", 2.0), (12, "RGGB", 2.8), (13, "MONO", 11.0), (14, "GRBG", 5.6)):
        block = measure_slanted_edge(_recorded(seed=seed, cfa=cfa, f_number=f_number))
        n = len(block.value)
        assert 0.9 * n - 3.0 * np.sqrt(2.0 * n) < _misfit(block) * (1.1 * n + 3.0 * np.sqrt(2.0 * n))
        assert _misfit(block) < 1.0


def test_coma_shows_in_the_asymmetry_with_its_direction() -> None:
    """Path error W131 r^2 (x cos t + y sin t) at a drawn angle t: the effect of that size and direction explains it.
    (Path errors are delays in the former, leads in the library.)"""
    law = concealed.ComaLaw(0.3, 0)
    block = measure_slanted_edge(_recorded(law, cfa="MONO", f_number=2.8))
    turn, coma = 2.0 * np.pi * law.uniform[0], effect("coma")
    right = coma(w131_x_um=-0.3 * np.cos(turn), w131_y_um=-0.3 * np.sin(turn))
    wrong = coma(w131_x_um=0.3 * np.cos(turn), w131_y_um=0.3 * np.sin(turn))
    assert _misfit(block, aside=True) > 2.0
    assert _misfit(block, right) < 1.0
    assert _misfit(block, wrong, aside=True) > 2.0 * _misfit(block, aside=True)


def test_a_blur_that_is_alike_on_both_sides_has_no_asymmetry() -> None:
    block = measure_slanted_edge(_recorded(concealed.DefocusLaw(10.0, 1), cfa="MONO", f_number=2.8))
    assert _misfit(block, aside=False) > 5.0
    assert _misfit(block, aside=True) < 1.0
    assert _misfit(block, effect("defocus")(defocus_um=10.0)) < 1.0


def test_crosstalk_between_colours_changes_their_edges() -> None:
    """In light of 460 and 640 nm much of a pixel's charge comes from neighbours of another colour: the transfer of the
    whole mosaic explains it, that of one channel doesn't. Of two cameras together, as the two greens, whose profiles
    differ then, are taken as one."""
    lit = Plan(EDGES.kinds, lights=True)
    of_one, of_all, count = 0.0, 0.0, 0
    for seed in (7, 31):
        block = measure_slanted_edge(
            _recorded(concealed.CrosstalkLaw(4.0, 0), seed=seed, cfa="RGGB", f_number=4.0, rows=96, plan=lit)
        )
        of_one, of_all = of_one + _chi2(block), of_all + _chi2(block, effect("crosstalk")(share_percent=4.0))
        count += len(block.value)
    limit = 1.1 * count + 3.0 * np.sqrt(2.0 * count)
    assert of_one > 1.2 * limit
    assert of_all < limit


class _EvenStray(Effect):
    """4 % of the light falls on the next pixels in the row and 2 % on those in the column, everywhere."""

    name: ClassVar[str] = "even_stray"
    family: ClassVar[Family] = Family.FIELD_OF_LIGHT

    def on_charge(self, charge: Charge) -> Charge:
        return charge.add_laws(
            strays=Stray(lambda _, x_um, y_um: (np.full(x_um.shape, 0.04), np.full(y_um.shape, 0.02)))
        )


def test_light_that_falls_on_the_next_pixels_blurs_as_charge_that_goes_there() -> None:
    """The same kernel once in the profiles and once in the transfer functions: alike to 5 % of the change, as a profile
    between distances of half a pixel is interpolated linearly."""
    block = measure_slanted_edge(_recorded(cfa="RGGB", f_number=4.0, rows=96))
    plain = block.predict(()).mean
    by_charge = block.predict((effect("crosstalk")(share_percent=1.5, row_excess=1.0 / 3.0),)).mean - plain
    by_light = block.predict((_EvenStray(),)).mean - plain
    assert np.abs(by_charge).max() > 0.01
    assert by_light == pytest.approx(by_charge, abs=0.05 * float(np.abs(by_charge).max()))


def test_shading_is_no_blur() -> None:
    """A fall-off towards the corners curves the light beside an edge; with the fall-off in the model the edges agree
    with the baseline."""
    block = measure_slanted_edge(_recorded(concealed.VignettingLaw(15.0, 0), cfa="MONO", f_number=4.0, rows=96))
    shaded = effect("vignetting")(corner_loss_percent=15.0)
    assert _misfit(block, shaded) < 1.0
    change = np.abs(block.predict((shaded,)).mean - block.predict(()).mean)
    assert change.max() > 1e-3  # or the test would show nothing


def test_directions_point_to_the_light() -> None:
    dataset = _recorded(cfa="MONO", f_number=4.0)
    found = sorted({round(e.direction_deg) for e in _edges(dataset)})
    assert found == [-40, 3, 5, 95]


def test_field_curvature_needs_more_than_one_place() -> None:
    """Edges in one place don't determine how focus changes over the field; edges in two places do."""
    former = ConcealedCamera(7, (), cfa="MONO", f_number=4.0, rows=112, cols=112)
    recordings = recordings_of(former, EDGES)
    manifest = recordings.manifest.model_dump(mode="json")
    bowl = effect("field_curvature")(curvature_um=30.0)
    changes = []
    for count in (1, 2):
        for k, capture in enumerate(c for c in manifest["captures"] if c["kind"] == "slanted_edge"):
            capture["field_mm"] = [0.1 * (k // 2 % count), 0.05]
        frames = {c.frame: np.array(recordings.frame(c)) for c in recordings.manifest.captures}
        paths = [*recordings.camera("left").quantum_efficiency.values()]
        paths += [str(c.light_radiance) for c in recordings.captures("slanted_edge")]
        moved = RecordingSet(
            Manifest.model_validate(manifest),
            frames,
            {path: recordings.spectrum(path) for path in dict.fromkeys(paths)},
        )
        block = measure_slanted_edge(_dataset(moved))
        changes.append(float(np.abs(block.predict((bowl,)).mean - block.predict(()).mean).max()))
    assert changes[0] == 0.0
    assert changes[1] > 1e-3


@pytest.mark.parametrize(
    ("cfa", "rows", "told"), [("MONO", 28, "23 lines are enough"), ("RGGB", 44, "45 lines are enough")]
)
def test_an_edge_that_crosses_less_than_a_period_is_left_out(cfa: str, rows: int, told: str) -> None:
    """At 2.6 deg over the region's lines, which are 8 fewer than the frame's: 0.91 of 1 px, and 1.63 of the 2 px
    between reds."""
    dataset = _recorded(cfa=cfa, rows=rows)
    labels = {(label.condition.removesuffix(ASIDE), label.channel) for label in measure_slanted_edge(dataset).labels}
    assert ("5 deg", dataset.camera.channels[0]) in labels
    assert ("2.6 deg", dataset.camera.channels[0]) not in labels
    capture = next(c for c in dataset.recordings.captures("slanted_edge") if c.angle_deg == 2.6)
    with pytest.raises(NotDetermined, match=told):
        check_phases("slanted_edge", dataset.stated.cfa, dataset.camera.channels[0], capture.region, 2.6)


def _stopped(*laws: Law, f_number: float, stated: float) -> Dataset:
    """Edges that the former takes at `f_number`, of a camera whose data sheet says `stated`."""
    former = ConcealedCamera(7, laws, cfa="MONO", f_number=f_number, rows=112, cols=112)
    document = recordings_of(former, EDGES)
    content = document.manifest.model_dump(mode="json", exclude_none=True)
    content["cameras"]["left"]["f_number"] = stated
    for capture in content["captures"]:
        if capture["kind"] == "slanted_edge":
            capture |= {"kind": "stopped_edge", "f_number": f_number}
    return _dataset(document.under(Manifest.model_validate(content)))


def test_edges_at_another_f_number_are_predicted_at_it() -> None:
    """A lens that stands 10 um out of focus, f/2.8 by its data sheet, at f/4: the second former's own pupil. The path
    error W040 at the rim of f/2.8 is (2.8 / 4)^4 of itself at that of f/4."""
    block = measure_stopped_edge(_stopped(concealed.DefocusLaw(10.0, 1), f_number=4.0, stated=2.8))
    assert {label.captures for label in block.labels} and block.measurement.name == "stopped_edge"
    assert _misfit(block) > 2.0
    assert _misfit(block, effect("defocus")(defocus_um=10.0)) < 1.0
    w040_um = 0.3
    at_stop = concealed.SphericalAberrationLaw(w040_um * (2.8 / 4.0) ** 4, 0)
    block = measure_stopped_edge(_stopped(at_stop, f_number=4.0, stated=2.8))
    assert _misfit(block, effect("spherical_aberration")(w040_um=w040_um)) < 1.0
    assert _misfit(block, effect("spherical_aberration")(w040_um=w040_um * (2.8 / 4.0) ** 4)) > 1.0


def test_edges_at_another_f_number_are_no_slanted_edges_of_the_data_sheets_lens() -> None:
    dataset = _stopped(f_number=4.0, stated=2.8)
    with pytest.raises(NotDetermined, match=r"^slanted_edge: no slanted_edge captures"):
        measure_slanted_edge(dataset)
    with pytest.raises(NotDetermined, match=r"^stopped_edge: no stopped_edge captures"):
        measure_stopped_edge(_recorded(cfa="MONO", f_number=4.0))
