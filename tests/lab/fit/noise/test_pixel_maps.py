"""Maps of single pixels against known offsets, dark currents and gains, and of a real camera."""

from __future__ import annotations

import itertools
import re
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.fit.noise.pixel_maps import PixelMaps, pixel_maps
from lab.formats.importers.images import read_image
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet

DATA = Path(__file__).parents[5] / "shared" / "data" / "llanos_colorchecker"
SHAPE = (48, 64)


def recordings(kinds: dict[str, dict[float, list[np.ndarray]]], bit_depth: int = 12, cfa: str = "MONO") -> RecordingSet:
    captures, frames = [], {}
    for kind, levels in kinds.items():
        for exposure, stack in levels.items():
            for frame in stack:
                name = f"{kind}-{len(captures)}"
                captures.append({"id": name, "kind": kind, "side": "left", "frame": name, "exposure_s": exposure})
                frames[name] = frame.astype(np.uint16)
    rows, cols = next(iter(frames.values())).shape
    camera = DataSheet(rows=rows, cols=cols, cfa=cfa, bit_depth=bit_depth)
    return RecordingSet(Manifest(cameras={"left": camera}, captures=tuple(captures)), frames)


def test_maps_find_every_pixels_offset_rate_and_gain() -> None:
    rng = np.random.default_rng(1)
    offset, rate = 100.0 + 5.0 * rng.standard_normal(SHAPE), 8.0 + rng.standard_normal(SHAPE)
    gain = 1.0 + 0.02 * rng.standard_normal(SHAPE)
    rate[7, 9] = 300.0

    def drawn(mean: np.ndarray, repeats: int) -> list[np.ndarray]:
        return [np.rint(mean + 2.0 * rng.standard_normal(SHAPE)) for _ in range(repeats)]

    darks = {t: drawn(offset + rate * t, 8) for t in (0.01, 1.0, 3.0)}
    flats = {t: drawn(offset + rate * t + 3000.0 * t * gain, 8) for t in (0.4, 0.6, 0.8)}
    found = pixel_maps(recordings({"dark": darks, "flat": flats}), "left")
    assert found.dark_dn_per_s is not None
    assert found.gain is not None
    assert set(map(tuple, np.argwhere(found.defective))) == {(7, 9)}
    good = ~found.defective
    for value, std, truth in (
        (found.offset_dn, found.offset_dn_std, offset),
        (found.dark_dn_per_s, found.dark_dn_per_s_std, rate),
    ):
        score = ((value - truth) / std)[good]
        # 3071 normal scores: their rms is 1 within 3 / sqrt(2 x 3071) = 4 %, and rounding's 1/12 is in the noise.
        assert np.sqrt(np.mean(score**2)) == pytest.approx(1.0, abs=0.05)
    # The surface takes up to 49 of 3072 degrees of freedom of the gains' pattern along: 0.02 sqrt(49 / 3072).
    score = (found.gain - gain / gain.mean())[good]
    assert np.sqrt(np.mean(score**2)) < np.hypot(float(found.gain_std[0, 0]), 0.02 * np.sqrt(49 / 3072)) * 1.3


def test_maps_need_darks_and_say_what_they_lack() -> None:
    flat = [np.full(SHAPE, 500)] * 2
    with pytest.raises(NotDetermined, match="no darks"):
        pixel_maps(recordings({"flat": {0.1: flat}}), "left")
    found = pixel_maps(recordings({"dark": {0.1: [np.full(SHAPE, 50)] * 2}}), "left")
    assert found.dark_dn_per_s is None
    assert found.gain is None


needs_llanos = pytest.mark.skipif(not DATA.exists(), reason="the shared recordings aren't here")


def llanos_darks(date: str) -> dict[float, list[np.ndarray]]:
    found: dict[float, list[np.ndarray]] = defaultdict(list)
    for file in sorted((DATA / "dark").glob(f"{date}_dark_*.tif")):
        exposure = re.search(r"_(\d+)ms_", file.name)
        assert exposure is not None
        found[int(exposure[1]) / 1000.0].append(read_image(file))
    return dict(found)


@needs_llanos
def test_hot_pixels_of_a_real_camera_grow_with_exposure() -> None:
    darks = llanos_darks("d1")
    found: PixelMaps = pixel_maps(recordings({"dark": darks}, 8, "GBRG"), "left")
    assert found.dark_dn_per_s is not None
    assert 20 <= np.count_nonzero(found.defective) <= 200
    strongest = tuple(np.argwhere(found.dark_dn_per_s == found.dark_dn_per_s.max())[0])
    assert found.defective[strongest]
    at = {exposure: float(np.mean([frame[strongest] for frame in stack])) for exposure, stack in darks.items()}
    # 12 DN at 250 ms, 174 at 3916 ms: 44 to 48 DN/s, a dark current that grows in proportion to the exposure.
    assert at[3.916] == pytest.approx(174.5, abs=3.0)
    assert at[0.25] == pytest.approx(12.0, abs=2.0)
    assert found.dark_dn_per_s[strongest] == pytest.approx(at[3.916] / 3.916, rel=0.05)
    # The others stand still: this camera's black is clipped near 0.
    assert abs(np.median(found.dark_dn_per_s)) < 1e-3


@needs_llanos
def test_shutter_of_a_real_camera_is_linear() -> None:
    exposures = (25, 50, 100, 250, 500, 2000, 3916)
    dark = {exposure: np.mean(stack, axis=0) for exposure, stack in llanos_darks("d2").items()}
    ratios = []
    for filter_nm in (450, 500, 600, 650):
        frames = {}
        for exposure in exposures:
            file = next((DATA / "frames").glob(f"d2_colorChecker30cm_{filter_nm}nm_{exposure}ms_*.tif"))
            frames[exposure] = read_image(file) - dark[exposure / 1000.0]
        for shorter, longer in itertools.pairwise(exposures):
            # Down-sampled pixels near saturation hold some that saturate: only low ones are whole.
            chosen = (frames[shorter] > 12) & (frames[longer] < 110)
            if np.count_nonzero(chosen) < 2000:
                continue
            growth = np.median(frames[longer][chosen] / frames[shorter][chosen])
            ratios.append(growth / (longer / shorter))
    assert len(ratios) >= 16
    # Found by others on these frames: 0.98 to 1.005 of nominal; black clipped near 0 and eight bits leave 2 % more
    # here.
    assert 0.96 < min(ratios) < max(ratios) < 1.025
    assert np.median(ratios) == pytest.approx(1.0, abs=0.01)
