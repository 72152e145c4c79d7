"""A camera's sensor as ISETCam's `sensor` struct in a MATLAB file.

ISETCam counts in volts: 1 DN is `VOLT_PER_DN`. Its electrons are irradiance (photons) x photodetector area x filters,
as in `sim.uniform`, so that the filters are the quantum efficiency; its converter's step is the voltage swing over
2^bits.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lab.formats.camera_file import CameraFile
from lab.formats.raw_file import replacing

VOLT_PER_DN = 1e-3
#: Step (nm) of its wavelengths, which are even.
STEP_NM = 5.0
#: ISETCam's letters of the filters' colours: w is white, no filter.
_LETTERS = {"R": "r", "G": "g", "B": "b", "Y": "w"}
#: Layers above the photodetector (m, and refractive index from air to silicon): ISETCam's own, as no camera file says.
_LAYERS_M, _REFRACTIVE = (2e-6, 5e-6), (1.0, 2.0, 1.46, 3.5)


def write_isetcam(file: Path, content: CameraFile) -> tuple[str, ...]:
    """Write the struct `sensor` of ISETCam.

    file : .mat, to be written
    content : the camera

    Returns what the struct has no place for. Raises InputError where the folder can't be written to.

    >>> from tempfile import TemporaryDirectory
    >>> from scipy.io import loadmat
    >>> from lab.formats.camera_file import default_camera
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "left.mat"
    ...     _ = write_isetcam(file, default_camera())
    ...     "sensor" in loadmat(file)
    True
    """
    from scipy.io import savemat

    with replacing(file) as partial, partial.open("wb") as stream:
        savemat(stream, {"sensor": _sensor(content)}, do_compression=True)
    return tuple(_remarks(content))


def _sensor(content: CameraFile) -> dict[str, Any]:
    camera = content.camera
    volt_per_e = camera.conversion_gain_dn_per_e * VOLT_PER_DN
    curves = [camera.quantum_efficiency[channel] for channel in camera.channels]
    first = STEP_NM * np.floor(min(curve.wavelength_nm[0] for curve in curves) / STEP_NM)
    last = STEP_NM * np.ceil(max(curve.wavelength_nm[-1] for curve in curves) / STEP_NM)
    wavelength_nm = np.arange(first, last + 0.5 * STEP_NM, STEP_NM)
    column, empty = wavelength_nm[:, None], np.zeros((0, 0))
    pitch_m = camera.pixel_pitch_um * 1e-6
    detector_m = pitch_m * np.sqrt(camera.fill_factor)
    names = np.empty((1, len(camera.channels)), object)
    names[0] = [_LETTERS[channel] for channel in camera.channels]
    pattern = (
        np.ones((1, 1))
        if camera.cfa == "MONO"
        else np.array([1.0 + camera.channels.index(letter) for letter in camera.cfa]).reshape(2, 2)
    )
    return {
        "name": content.name or "calibench camera",
        "type": "sensor",
        "rows": float(camera.rows),
        "cols": float(camera.cols),
        "pixel": {
            "name": "aps",
            "type": "pixel",
            "width": pitch_m,
            "height": pitch_m,
            "widthGap": 0.0,
            "heightGap": 0.0,
            "pdWidth": detector_m,
            "pdHeight": detector_m,
            "pdXpos": 0.5 * (pitch_m - detector_m),
            "pdYpos": 0.5 * (pitch_m - detector_m),
            "conversionGain": volt_per_e,
            "voltageSwing": 2.0**camera.bit_depth * VOLT_PER_DN,
            "darkVoltage": camera.dark_current_e_per_s * volt_per_e,
            "readNoise": camera.read_noise_e * volt_per_e,
            "n": np.array([_REFRACTIVE]),
            "layerThickness": np.array([_LAYERS_M]),
            "spectrum": {"wave": column},
            "spectralQE": np.ones_like(column),
        },
        "spectrum": {"wave": column},
        "color": {
            "filterSpectra": np.stack([curve.at(wavelength_nm) for curve in curves], axis=1),
            "filterNames": names,
            "irFilter": np.ones_like(column),
        },
        "cfa": {"pattern": pattern},
        "data": empty,
        "sigmaOffsetFPN": camera.dsnu_e * volt_per_e,
        "sigmaGainFPN": camera.prnu_percent,
        "offsetFPNimage": empty,
        "gainFPNimage": empty,
        "columnFPN": np.array([[camera.column_noise_e * volt_per_e, 0.0]]),
        "analogGain": 1.0,
        "analogOffset": camera.black_level_dn * VOLT_PER_DN,
        "quantization": {"bits": float(camera.bit_depth), "method": "linear"},
        "integrationTime": 0.0,
        "AE": 1.0,
        "CDS": 0.0,
        "noiseFlag": 2.0,
        "chartP": empty,
    }


def _remarks(content: CameraFile) -> list[str]:
    camera = content.camera
    codes = 2**camera.bit_depth
    remarks = []
    well_e = codes / camera.conversion_gain_dn_per_e
    if abs(camera.full_well_e - well_e) > 1e-3 * well_e:
        remarks.append(
            f"full_well_e: {camera.full_well_e:g} e left out, ISETCam's well is its converter's: {well_e:.6g} e"
        )
    if camera.white_level_dn < codes - 1:
        remarks.append(f"white_level_dn: {camera.white_level_dn:g} DN left out, ISETCam's converter ends at {codes} DN")
    if camera.row_noise_e:
        remarks.append(f"row_noise_e: {camera.row_noise_e:g} e left out, ISETCam has no such noise")
    if camera.dark_current_doubling_c is not None and camera.dark_current_e_per_s:
        remarks.append(
            f"dark_current_doubling_c: {camera.dark_current_doubling_c:g} C left out, the dark voltage is that at "
            f"{camera.dark_current_reference_c:g} C"
        )
    if content.effects:
        remarks.append(f"effects: left out ({', '.join(effect.name for effect in content.effects)})")
    return remarks
