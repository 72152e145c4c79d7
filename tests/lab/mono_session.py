"""Flats and darks of a MONO camera of known truth before light of one wavelength, as an EMVA 1288 session states
them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lab.formats.recording_set import Manifest, RecordingSet


@dataclass(frozen=True)
class MonoSession:
    """The truth, and what is stated. Shares: `prnu` of pixels, `column_gain` and `row_gain` of lines (standard
    deviations), `fall_off` of the light in the corners, `bend` of the response at `full_e`."""

    shape: tuple[int, int] = (64, 80)
    seed: int = 1
    efficiency: float = 0.5
    gain: float = 0.25  # DN/e
    read_e: float = 5.0
    black_dn: float = 40.0
    full_e: float = 12000.0
    levels: int = 12
    stacked: int = 2  # images of the level at half of the series
    prnu: float = 0.01
    column_gain: float = 0.0
    row_gain: float = 0.0
    fall_off: float = 0.0
    bend: float = 0.0
    photons_stated: float = 1.0  # over the true ones
    wavelength_nm: float | None = 530.0
    bits: int = 12

    def light(self) -> np.ndarray:
        """Return the light (rows, cols), 1 in the middle."""
        row, col = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in self.shape), indexing="ij")
        return 1.0 - 0.5 * self.fall_off * (row**2 + col**2)

    def recordings(self) -> RecordingSet:
        """Return the session. Photon noise is drawn of the charge, the response is bent after it."""
        rng = np.random.default_rng(self.seed)
        even = self.light()
        even *= 1.0 + self.prnu * rng.standard_normal(self.shape)
        even *= 1.0 + self.column_gain * rng.standard_normal(self.shape[1])
        even *= 1.0 + self.row_gain * rng.standard_normal(self.shape[0])[:, None]
        captures, frames = [], {}
        for level in range(1, self.levels + 1):
            charge_e = 0.95 * self.full_e * level / self.levels
            for kind in ("flat", "dark"):
                for number in range(self.stacked if level == round(0.55 * self.levels) else 2):
                    name = f"{kind}-{level}-{number}"
                    drawn = rng.poisson(charge_e * even if kind == "flat" else np.zeros(self.shape)).astype(float)
                    drawn *= 1.0 + self.bend * drawn / self.full_e
                    code = self.black_dn + self.gain * (drawn + self.read_e * rng.standard_normal(self.shape))
                    frames[name] = np.clip(np.rint(code), 0, 2**self.bits - 1).astype(np.uint16)
                    capture = {
                        "id": name, "kind": kind, "side": "left", "frame": name, "exposure_s": 1e-3 * level,
                    }  # fmt: skip
                    if kind == "flat":
                        photons = charge_e / self.efficiency * self.photons_stated
                        capture |= {"photons_per_pixel": photons, "wavelength_nm": self.wavelength_nm}
                    captures.append(capture)
        sheet = {"rows": self.shape[0], "cols": self.shape[1], "cfa": "MONO", "bit_depth": self.bits}
        manifest = Manifest.model_validate({"cameras": {"left": sheet}, "captures": captures})
        return RecordingSet(manifest, frames, {}, {})
