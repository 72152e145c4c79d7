"""What the mock bench keeps for the next frame."""

from __future__ import annotations

import numpy as np

from mocks.bench import NOMINAL_STOP, STOPS, Bench


def test_a_change_of_the_stop_frees_the_transfers_of_the_one_before() -> None:
    bench = Bench(shape=(48, 64))
    bench.set_wavelength(0.0)
    bench.set_shutter(True)
    bench.place("charuco-01")
    first = bench._light_rate("left").copy()
    kept = bench._transfers
    bench.place(NOMINAL_STOP)
    assert bench._transfers is kept  # the same stop: of use for the next scene
    for stop in (*(stop for stop in STOPS if stop != NOMINAL_STOP), NOMINAL_STOP):
        bench.place(stop)
        bench._lights.clear()
        again = bench._light_rate("left")
        assert bench._transfers is not kept
        assert np.array_equal(again, first) == (stop == NOMINAL_STOP)  # never drawn with another stop's transfers
