"""A buffer as a camera filled it, before its codes are unpacked: what every camera's frames have in common on the way
in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.camera.pixel_format import PIXEL_FORMATS, Payload, PixelFormat
from drivers.errors import Garbled


@dataclass(frozen=True, eq=False)
class Grabbed:
    """The payload, its layout, and what is wrong with it; nothing if it is whole.

    `camera_time_ns`: start of the exposure on the camera's own clock; None where it doesn't tell. `give_back`: called
    once the codes are unpacked; the payload's memory may be filled again.
    """

    payload: Payload
    rows: int
    cols: int
    code: int
    frame_id: int
    padding: int = 0
    damage: str = ""
    camera_time_ns: int | None = None
    give_back: Callable[[], None] = lambda: None

    def unpack(self, who: str) -> tuple[NDArray[np.uint16], PixelFormat]:
        """Return the codes, (rows, cols) DN, in memory of their own, and the pixel format.

        Raises `Garbled` for a frame that isn't whole, or whose pixel format isn't known.
        """
        if self.damage:
            raise Garbled(f"{who}: frame {self.frame_id} is torn: {self.damage}; use another cable or port")
        pixel_format = PIXEL_FORMATS.get(self.code)
        if pixel_format is None:
            raise Garbled(f"{who}: frame {self.frame_id} has the unknown pixel format {self.code:#010x}")
        try:
            return pixel_format.unpack(self.payload, self.rows, self.cols, self.padding), pixel_format
        except ValueError as error:
            raise Garbled(f"{who}: frame {self.frame_id} broke off: {error}; use another cable or port") from error
