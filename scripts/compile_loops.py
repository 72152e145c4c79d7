"""Compile what a new installation would compile at first use, into the packages' `__pycache__`.

The modules, and the loops of drawing, fitting and tracing. It takes about half a minute; a first session, and
processes that begin beside each other, find it done.
"""

from __future__ import annotations

import compileall

import api
import drivers
import lab
import mocks
import sim
from lab.diagnose.reference_study import reference_study
from lab.fit import fit_recording_set
from mocks.bench import Bench
from sim.optics.prescription import GlassName, Prescription, Surface
from sim.optics.system import OpticalSystem


def compile_loops() -> None:
    """Draw and fit the reference session, and trace a lens of one surface."""
    Bench(seed=1).compile_loops()
    fit_recording_set(reference_study())
    glass = GlassName(name="glass", model=True, index_d=1.5, abbe_d=60.0)
    front = Surface(curvature_per_mm=0.1, thickness_mm=30.0, glass=glass, semi_diameter_mm=2.0)
    lens = Prescription(
        name="one surface",
        surfaces=(front, Surface()),
        stop=0,
        aperture_kind="entrance_pupil_mm",
        aperture_value=2.0,
        field_points=((0.0, 0.0), (0.0, 2.0)),
        wavelength_nm=(550.0,),
        primary_wavelength_nm=550.0,
    )
    OpticalSystem(lens).mtf((0.0, 0.01), 550.0, (0.0, 10.0))


if __name__ == "__main__":
    for package in (sim, drivers, lab, mocks, api):
        for folder in package.__path__:
            compileall.compile_dir(folder, quiet=1)
    compile_loops()
