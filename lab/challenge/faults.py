"""Faults of metadata or rig around a healthy camera: mismatches that no effect explains."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mocks.former import WAVELENGTH_NM, DrawnSession

Spoil = Callable[[dict[str, Any], dict[str, Any], dict[str, Any], np.random.Generator], None]


@dataclass(frozen=True)
class CaseFault:
    """One fault. `spoil` changes manifest, frames and spectra in place; `accepts`: effects whose name is right for
    it."""

    name: str
    spoil: Spoil
    accepts: tuple[str, ...] = ()
    colour_only: bool = False


def spoilt(session: DrawnSession, fault: CaseFault, rng: np.random.Generator) -> DrawnSession:
    """Return a copy of a session with the fault."""
    manifest, frames, spectra = deepcopy(session.manifest), dict(session.frames), dict(session.spectra)
    fault.spoil(manifest, frames, spectra, rng)
    return replace(session, manifest=manifest, frames=frames, spectra=spectra)


def _misstated(key: str, factor: Callable[[np.random.Generator], float]) -> Spoil:
    def spoil(manifest: dict[str, Any], _frames: Any, _spectra: Any, rng: np.random.Generator) -> None:
        camera = manifest["cameras"]["left"]
        camera[key] = float(camera[key] * factor(rng))

    return spoil


def _exposure_unit(manifest: dict[str, Any], _frames: Any, _spectra: Any, _rng: np.random.Generator) -> None:
    for capture in manifest["captures"]:
        if capture["kind"] == "flat":
            capture["exposure_s"] *= 1000.0


def _cfa_phase(manifest: dict[str, Any], _frames: Any, _spectra: Any, _rng: np.random.Generator) -> None:
    camera = manifest["cameras"]["left"]
    camera["cfa"] = {"RGGB": "GRBG", "GRBG": "RGGB", "BGGR": "GBRG", "GBRG": "BGGR"}[camera["cfa"]]


def _wavelength_axis(manifest: dict[str, Any], _frames: Any, spectra: dict[str, Any], rng: np.random.Generator) -> None:
    offset_nm = float(rng.choice([-8.0, 8.0]))
    for path in manifest["cameras"]["left"]["quantum_efficiency"].values():
        spectra[path] = np.interp(WAVELENGTH_NM - offset_nm, WAVELENGTH_NM, spectra[path])


def _frames_of(manifest: dict[str, Any], kind: str) -> list[str]:
    return [c["frame"] for c in manifest["captures"] if c["kind"] == kind]


def _lamp_out(manifest: dict[str, Any], frames: dict[str, Any], _spectra: Any, rng: np.random.Generator) -> None:
    flats, darks = _frames_of(manifest, "flat"), _frames_of(manifest, "dark")
    frames[str(rng.choice(flats[6:]))] = frames[darks[0]].copy()


def _frames_swapped(manifest: dict[str, Any], frames: dict[str, Any], _spectra: Any, rng: np.random.Generator) -> None:
    sweep = _frames_of(manifest, "narrowband")
    i = int(rng.integers(8, 18))
    frames[sweep[i]], frames[sweep[i + 2]] = frames[sweep[i + 2]], frames[sweep[i]]


def _stale_frame(manifest: dict[str, Any], frames: dict[str, Any], _spectra: Any, rng: np.random.Generator) -> None:
    sweep = _frames_of(manifest, "narrowband")
    i = int(rng.integers(6, 20))
    frames[sweep[i]] = frames[sweep[i - 1]].copy()


FAULTS: tuple[CaseFault, ...] = (
    CaseFault("f_number_misstated", _misstated("f_number", lambda rng: float(rng.choice([0.7, 1.4])))),
    CaseFault("exposure_unit", _exposure_unit),
    CaseFault("black_level_misstated", _misstated("black_level_dn", lambda rng: 1.25)),
    CaseFault("pitch_misstated", _misstated("pixel_pitch_um", lambda rng: float(rng.choice([0.8, 1.25])))),
    CaseFault("focal_length_misstated", _misstated("focal_length_mm", lambda rng: 0.6), ("vignetting",)),
    CaseFault("cfa_phase_swapped", _cfa_phase, colour_only=True),
    CaseFault("wavelength_axis_shifted", _wavelength_axis, ("wavelength_offset",)),
    CaseFault("lamp_out", _lamp_out),
    CaseFault("frames_swapped", _frames_swapped),
    CaseFault("stale_frame", _stale_frame),
)
