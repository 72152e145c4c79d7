"""Single-channel pixel formats of GenICam's Pixel Format Naming Convention (PFNC): their codes, and how to unpack a
payload."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: The bytes of a frame's pixels.
Payload = bytes | bytearray | NDArray[np.uint8]


@dataclass(frozen=True)
class PixelFormat:
    """Layout of the pixels in the payload."""

    name: str
    code: int
    cfa: str
    bits: int
    packed: bool  # 12p, 10p: a stream of bits, least significant first; else 8 or 16 bits a pixel

    def payload_bytes(self, pixels: int) -> int:
        """Return the bytes of that number of pixels."""
        return (pixels * self.bits + 7) // 8 if self.packed else pixels * (1 if self.bits == 8 else 2)

    def unpack(self, payload: Payload, rows: int, cols: int, padding: int = 0) -> NDArray[np.uint16]:
        """Return (rows, cols) uint16 of a payload whose rows are followed by `padding` bytes. Raises ValueError if it
        is short.
        """
        line = self.payload_bytes(cols) + padding
        if padding == 0:
            flat = self._unpack_flat(np.frombuffer(payload, np.uint8), rows * cols)
            return flat.reshape(rows, cols)
        data = np.frombuffer(payload, np.uint8, rows * line).reshape(rows, line)
        return np.stack([self._unpack_flat(row[: line - padding], cols) for row in data])

    def _unpack_flat(self, data: NDArray[np.uint8], pixels: int) -> NDArray[np.uint16]:
        need = self.payload_bytes(pixels)
        if data.size < need:
            raise ValueError(f"{data.size} bytes are too few for {pixels} pixels of {self.name}")
        data = data[:need]
        if not self.packed:
            return data.astype(np.uint16) if self.bits == 8 else data.view("<u2").astype(np.uint16)
        if self.bits == 12:
            padded = np.append(data, 0) if need % 3 else data
            low, middle, high = (padded[k::3].astype(np.uint16) for k in range(3))
            pairs = (len(padded) + 2) // 3
            out = np.zeros((pairs, 2), np.uint16)
            out[:, 0] = low | ((middle & 0x0F) << 8)
            out[: len(high), 1] = (middle[: len(high)] >> 4) | (high << 4)
            return out.reshape(-1)[:pixels]
        bits = np.unpackbits(data, bitorder="little")[: pixels * self.bits].reshape(pixels, self.bits)
        return bits.astype(np.uint16) @ (1 << np.arange(self.bits)).astype(np.uint16)


def _formats() -> dict[int, PixelFormat]:
    """PFNC's single-channel formats: code -> format. The pixel at [0, 0] names the Bayer phase."""
    phases = {"GR": "GRBG", "RG": "RGGB", "GB": "GBRG", "BG": "BGGR"}
    first = {8: 0x01080008, 10: 0x0110000C, 12: 0x01100010, 16: 0x0110002E}
    packed = {
        10: {"BG": 0x010A0052, "GB": 0x010A0054, "GR": 0x010A0056, "RG": 0x010A0058},
        12: {"BG": 0x010C0053, "GB": 0x010C0055, "GR": 0x010C0057, "RG": 0x010C0059},
    }
    mono = {8: 0x01080001, 10: 0x01100003, 12: 0x01100005, 14: 0x01100025, 16: 0x01100007}
    formats = [PixelFormat(f"Mono{bits}", code, "MONO", bits, False) for bits, code in mono.items()]
    formats += [
        PixelFormat("Mono10p", 0x010A0046, "MONO", 10, True),
        PixelFormat("Mono12p", 0x010C0047, "MONO", 12, True),
    ]
    for index, (short, cfa) in enumerate(phases.items()):
        formats += [PixelFormat(f"Bayer{short}{bits}", code + index, cfa, bits, False) for bits, code in first.items()]
        formats += [
            PixelFormat(f"Bayer{short}{bits}p", codes[short], cfa, bits, True) for bits, codes in packed.items()
        ]
    return {item.code: item for item in formats}


PIXEL_FORMATS = _formats()
#: Order in which formats are preferred: the deepest first, plain before packed. 16 bits come last: most cameras only
#: shift their 10 or 12 bits up in it, and codes should be the converter's.
PREFERENCE = sorted(PIXEL_FORMATS.values(), key=lambda item: (item.bits == 16, -item.bits, item.packed, item.name))
