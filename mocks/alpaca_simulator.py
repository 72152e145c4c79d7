"""Runs the package `alpaca-simulators`, an Alpaca server of others: `python -m mocks.alpaca_simulator PORT CONFIG`.

Its camera draws the sky with the package cabaret, from a star catalogue on the network. A picture of plain noise stands
in for that: what a driver sees of the server is the server's own.
"""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray


def _no_sky() -> ModuleType:
    """Return what the simulator uses of cabaret."""
    stand_in = ModuleType("cabaret")

    def picture(camera: SimpleNamespace) -> NDArray[np.uint16]:
        rows, cols = camera.height // camera.bin_y, camera.width // camera.bin_x
        return np.random.default_rng(1).integers(900, 1100, (rows, cols)).astype(np.uint16)

    def keep(**attributes: Any) -> SimpleNamespace:
        return SimpleNamespace(**attributes)

    def observatory(camera: SimpleNamespace, site: Any, telescope: Any) -> SimpleNamespace:
        return SimpleNamespace(generate_image=lambda **arguments: picture(camera))

    stand_in.Camera = stand_in.Site = stand_in.Telescope = keep  # type: ignore[attr-defined]
    stand_in.Observatory = observatory  # type: ignore[attr-defined]
    return stand_in


if __name__ == "__main__":
    sys.modules["cabaret"] = _no_sky()
    from alpaca_simulators.run_simulator import main

    sys.argv[1:] = ["--host", "127.0.0.1", "--port", sys.argv[1], "--config", sys.argv[2]]
    main()
