"""The contract of charts of other packages: drawn before a camera, each patch has the electrons of its reflectance.

`calibench check-chart PACKAGE` runs it on an installed package."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sim.camera import CameraModel, Lens
from sim.frame import Exposure, expected_electrons
from sim.optics.illumination import relative_illumination
from sim.scene.catalogue import scene_by_name
from sim.scene.chart import PatchChart
from sim.scene.scenes import ReflectanceChart
from sim.scene.warp import Warp
from sim.spectrum import Spectrum
from sim.uniform import electron_rate

_WAVELENGTH_NM = np.arange(380.0, 731.0)
WHITE = Spectrum.of(_WAVELENGTH_NM, np.full(_WAVELENGTH_NM.shape, 0.02))
PX = 16  # of a patch's side and its gap, of pixels much larger than the lens's blur
EXPOSURE_S = 0.01
#: Largest difference from the electrons of the patch's reflectance, over those of a perfect diffuser: the lens's blur
#: moves less than 1e-3 from the frame to the middle of a patch.
LARGEST_DIFFERENCE = 5e-3


def _camera(chart: PatchChart) -> CameraModel:
    flat = Spectrum.of([300.0, 1100.0], [0.5, 0.5])
    return CameraModel(
        rows=PX * (chart.rows + 1), cols=PX * (chart.cols + 1), pixel_pitch_um=20.0, fill_factor=1.0, cfa="MONO",
        bit_depth=12, black_level_dn=64.0, white_level_dn=4095.0, conversion_gain_dn_per_e=0.01, full_well_e=1e9,
        read_noise_e=2.0, dark_current_e_per_s=0.0, dsnu_e=0.0, prnu_percent=0.0, quantum_efficiency={"Y": flat},
        lens=Lens(f_number=2.0, focal_length_mm=25.0),
    )  # fmt: skip


def complaints(name: str, chart: PatchChart) -> tuple[str, ...]:
    """Return what of the contract an installed chart doesn't keep, a line each.

    name : of its entry point
    """
    return tuple(_complaints(name, chart))


def _complaints(name: str, chart: PatchChart) -> Iterator[str]:
    camera = _camera(chart)
    scene = scene_by_name(name, camera, WHITE, parameters={"fill": 1.0})
    assert isinstance(scene, ReflectanceChart)
    electrons = expected_electrons(camera, Exposure(scene, EXPOSURE_S))
    to_camera = Warp.from_corners(chart.cols - chart.gap, chart.rows - chart.gap, scene.corners).to_camera
    white = electron_rate(camera, "Y", WHITE) * EXPOSURE_S
    for index, (patch, reflectance) in enumerate(chart.reflectances.items()):
        half = 0.5 * (1.0 - chart.gap)
        row, col = (float(at[0]) for at in to_camera([index % chart.cols + half], [index // chart.cols + half]))
        middle = electrons[round(row) - 1 : round(row) + 2, round(col) - 1 : round(col) + 2].mean()
        rate = electron_rate(camera, "Y", WHITE, kind="chart", reflectance=reflectance)
        due = rate * EXPOSURE_S * float(relative_illumination(camera, row, col))
        if not abs(middle - due) <= LARGEST_DIFFERENCE * white:
            yield (
                f"patch {patch}: drawn it gives {middle / white:.4f} of a perfect diffuser's electrons, its "
                f"reflectance {due / white:.4f}: report this with the chart's file"
            )
