"""Colour filter mosaics: phases, planes, channels."""

from __future__ import annotations

import numpy as np
import pytest

from sim.sensor import mosaic


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_phases_spell_the_mosaic(cfa: str) -> None:
    places = {place: channel for channel, where in mosaic.phases(cfa).items() for place in where}
    assert "".join(places[i, j] for i in (0, 1) for j in (0, 1)) == cfa
    red_row = mosaic.phases(cfa)["R"][0][0]
    assert [row == red_row for row, _ in mosaic.phases(cfa)["G"]] == [True, False]


def test_planes_are_views_and_assemble_puts_them_back() -> None:
    frame = np.arange(6 * 8).reshape(6, 8)
    planes = mosaic.planes(frame, "GBRG")
    assert list(planes) == ["R", "G1", "G2", "B"]
    assert planes["G2"][0, 0] == 0 and planes["B"][0, 0] == 1 and planes["R"][0, 0] == 8 and planes["G1"][0, 0] == 9
    assert all(np.shares_memory(plane, frame) for plane in planes.values())
    images = {"R": frame, "G": frame + 100, "B": frame + 200}
    together = mosaic.planes(mosaic.assemble(images, "GBRG"), "GBRG")
    for name, plane in planes.items():
        np.testing.assert_array_equal(together[name], plane + {"R": 0, "G": 100, "B": 200}[name[0]])


def test_mono_has_one_plane() -> None:
    frame = np.arange(6).reshape(2, 3)
    assert mosaic.phases("MONO") == {"Y": [(0, 0)]}
    np.testing.assert_array_equal(mosaic.planes(frame, "MONO")["Y"], frame)
    np.testing.assert_array_equal(mosaic.assemble({"Y": frame}, "MONO"), frame)


def test_missing_or_unequal_channels_are_named() -> None:
    frame = np.zeros((2, 2))
    with pytest.raises(ValueError, match="no image came for B"):
        mosaic.assemble({"R": frame, "G": frame}, "RGGB")
    with pytest.raises(ValueError, match="differ in shape"):
        mosaic.assemble({"R": frame, "G": frame, "B": np.zeros((4, 4))}, "RGGB")
