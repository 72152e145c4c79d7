"""A camera as a configuration of Pyxel, ESA's detector simulator: one exposure of even light, photons to codes.

What the two simulators share goes into it: photon noise, quantum efficiency, dark current with its noise, full well,
read noise, gain, black level and a converter that rounds. 1 DN is `VOLT_PER_DN`; Pyxel's converter truncates, so that
its range begins half a code lower.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from lab.errors import InputError
from lab.formats.camera_file import CameraFile
from lab.formats.raw_file import replacing

VOLT_PER_DN = 1e-3
#: Quantities of a camera file that Pyxel has no equal law for.
_LEFT_OUT = ("dsnu_e", "prnu_percent", "row_noise_e", "column_noise_e")


def write_pyxel(
    file: Path,
    content: CameraFile,
    *,
    exposure_s: float,
    photons_per_pixel: float,
    wavelength_nm: float = 550.0,
    channel: str = "",
    temperature_c: float | None = None,
) -> tuple[str, ...]:
    """Write a camera and an exposure as a configuration of Pyxel, which simulates it by independent code.

    file : YAML, to be written
    content : the camera
    exposure_s : s
    photons_per_pixel : mean
    wavelength_nm : nm
    channel : whose quantum efficiency is taken; by default green's, or the only one's
    temperature_c : of the sensor; by default that of the dark current's statement

    Returns remarks on what Pyxel has no law for. Raises InputError.

    >>> from tempfile import TemporaryDirectory
    >>> from lab.formats.camera_file import default_camera
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "left.yaml"
    ...     _ = write_pyxel(file, default_camera(), exposure_s=0.01, photons_per_pixel=1000.0)
    ...     "quantum_efficiency" in file.read_text()
    True
    """
    camera = content.camera
    channel = channel or ("Y" if camera.cfa == "MONO" else "G")
    if channel not in camera.quantum_efficiency:
        raise InputError(f"{file}: the camera has no channel {channel}; take one of {', '.join(camera.channels)}")
    for name, value in (("exposure_s", exposure_s), ("photons_per_pixel", photons_per_pixel)):
        if not 0 < value < float("inf"):
            raise InputError(f"{file}: {name} is {value:g}, not above the limit of 0; give a value above it")
    if camera.bit_depth < 4:
        raise InputError(f"{file}: bit_depth is {camera.bit_depth}, below the limit of 4 of Pyxel's converter")
    efficiency = float(camera.quantum_efficiency[channel].at(wavelength_nm))
    temperature = camera.dark_current_reference_c if temperature_c is None else temperature_c
    dark_e_per_s = camera.dark_current_e_per_s
    if camera.dark_current_doubling_c is not None:
        dark_e_per_s *= 2.0 ** ((temperature - camera.dark_current_reference_c) / camera.dark_current_doubling_c)
    codes = 2**camera.bit_depth
    groups: dict[str, dict[str, dict[str, Any]]] = {
        "photon_collection": {
            "illumination": {"level": photons_per_pixel, "time_scale": exposure_s},
            "shot_noise": {},
        },
        "charge_generation": {"simple_conversion": {}, "simple_dark_current": {"dark_rate": dark_e_per_s}},
        "charge_collection": {"simple_collection": {}, "simple_full_well": {}},
        "charge_measurement": {
            "simple_measurement": {},
            "output_node_noise": {
                "std_deviation": camera.read_noise_e * camera.conversion_gain_dn_per_e * VOLT_PER_DN,
            },
            "dc_offset": {"offset": camera.black_level_dn * VOLT_PER_DN},
        },
        "readout_electronics": {"simple_amplifier": {}, "simple_adc": {}},
    }
    document = {
        "exposure": {"readout": {"times": [exposure_s]}},
        "cmos_detector": {
            "geometry": {
                "row": camera.rows,
                "col": camera.cols,
                "pixel_vert_size": camera.pixel_pitch_um,
                "pixel_horz_size": camera.pixel_pitch_um,
            },
            "environment": {"temperature": temperature + 273.15, "wavelength": wavelength_nm},
            "characteristics": {
                "quantum_efficiency": efficiency,
                "charge_to_volt_conversion": camera.conversion_gain_dn_per_e * VOLT_PER_DN,
                "pre_amplification": 1.0,
                "full_well_capacity": camera.full_well_e,
                "adc_bit_resolution": camera.bit_depth,
                "adc_voltage_range": [-0.5 * VOLT_PER_DN, (codes - 1.5) * VOLT_PER_DN],
            },
        },
        "pipeline": {
            group: [
                {
                    "name": name,
                    "func": f"pyxel.models.{group}.{name}",
                    "enabled": True,
                    **({"arguments": arguments} if arguments else {}),
                }
                for name, arguments in models.items()
            ]
            for group, models in groups.items()
        },
    }
    with replacing(file) as partial:
        partial.write_text(
            f"# {content.name}: an exposure of even light for Pyxel, by calibench\n"
            + yaml.safe_dump(document, sort_keys=False),
            encoding="utf-8",
        )
    return tuple(_remarks(content))


def _remarks(content: CameraFile) -> list[str]:
    camera = content.camera
    remarks = [f"{name}: left out, Pyxel has no equal law" for name in _LEFT_OUT if getattr(camera, name)]
    if camera.white_level_dn < 2**camera.bit_depth - 1:
        remarks.append(f"white_level_dn: left out, Pyxel's converter ends at {2**camera.bit_depth - 1} DN")
    if content.effects:
        remarks.append(f"effects: left out ({', '.join(effect.name for effect in content.effects)})")
    return remarks
