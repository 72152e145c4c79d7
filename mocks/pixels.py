"""Pixel formats of the mock cameras, written out a second time: a mistake shared with the driver would not be seen.

Source: EMVA, GenICam Pixel Format Naming Convention.
"""

from __future__ import annotations

import numpy as np

from mocks.bench import UInt16Array

BAYER_RG8, BAYER_RG12, BAYER_RG12P = 0x01080009, 0x01100011, 0x010C0059


def pack_12p(raw: UInt16Array) -> bytes:
    """12-bit pixels as a stream of bits, least significant first: two pixels in three bytes."""
    flat = np.append(raw.reshape(-1), np.zeros(raw.size % 2, np.uint16)).astype(np.uint32)
    pair = flat[0::2] | (flat[1::2] << 12)
    return (
        np.stack([pair & 0xFF, (pair >> 8) & 0xFF, (pair >> 16) & 0xFF], axis=1)
        .astype(np.uint8)
        .tobytes()[: (raw.size * 12 + 7) // 8]
    )


def payload_bytes(pixel_format: int, pixels: int) -> int:
    """Size of a frame's payload."""
    return (pixels * ((pixel_format >> 16) & 0xFF) + 7) // 8


def encode(raw: UInt16Array, pixel_format: int) -> bytes:
    """Return a 12-bit raw frame in one of the camera's formats."""
    if pixel_format == BAYER_RG12P:
        return pack_12p(raw)
    if pixel_format == BAYER_RG8:
        return (raw >> 4).astype(np.uint8).tobytes()
    return raw.astype("<u2").tobytes()
