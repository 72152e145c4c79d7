"""Residual pictures of recordings: structure without the effect in the model, noise with it."""

from __future__ import annotations

import numpy as np
import pytest

from lab.challenge.draw import recordings_of
from lab.diagnose.outcome.improved_model import residual_pictures
from lab.formats.camera_file import CameraFile
from lab.formats.camera_model import camera_model
from mocks.former import ConcealedCamera, Plan
from mocks.former import laws as concealed_laws
from sim.effects.optical_low_pass_filter import OpticalLowPassFilter
from tests.lab.diagnose.outcome.filtered_edges import filtered_edges


def test_pictures_show_what_the_model_lacks_and_noise_once_it_has_it() -> None:
    """Cells' residuals of a right model are normal, of rms 1; the sensor's own patterns differ from their mean standard
    deviation by some per cent."""
    law = concealed_laws.OpticalLowPassFilterLaw(1.8)
    camera = ConcealedCamera(20771, [law], cfa="MONO", f_number=4.0, rows=160, cols=200)
    recordings = recordings_of(camera, Plan(("flat", "slanted_edge")))
    model = camera_model(recordings, "left").model_copy(
        update={"black_level_dn": camera.black_level_dn, "conversion_gain_dn_per_e": camera.gain_dn_per_e,
        "read_noise_e": camera.read_noise_e,
                "prnu_percent": camera.prnu_percent, "dark_current_e_per_s": camera.dark_e_per_s,
                "full_well_e": camera.full_well_e}
    )  # fmt: skip
    known = CameraFile("known", model, (OpticalLowPassFilter(displacement_x_um=1.8, displacement_y_um=1.8),))
    found = {p.kind: p for p in residual_pictures(recordings, "left", filtered_edges().model, known)}
    assert set(found) == {"flat", "slanted_edge"}

    def rms(table: tuple[tuple[float, ...], ...]) -> float:
        return float(np.sqrt(np.mean(np.square(table))))

    edge = found["slanted_edge"]
    # where the edge lies is known to some hundredths of a pixel only: it keeps a thin trace
    assert rms(edge.after) < 1.4
    assert rms(edge.before) > rms(edge.after) + 0.1
    assert rms(found["flat"].after) == pytest.approx(1.0, abs=0.15)
