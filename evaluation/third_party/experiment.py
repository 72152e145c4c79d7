"""Does the diagnosis name and size effects on sets of third parties' simulators?

A set is drawn, the simulator is checked by a few lines of numpy, and the set is diagnosed. A name is right where it is
the effect's, or its family's; any other is a second name. A size is right within two standard deviations, or in the
interval that is reported in their place.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from evaluation.third_party import galsim_models as by_galsim
from evaluation.third_party import pyxel_models as by_pyxel
from evaluation.third_party.camera import DrawnCamera, draw_camera, record_optics, record_sensor
from evaluation.third_party.models import SimulatedOptics, SimulatedSensor, SimulatorCheck
from evaluation.third_party.score import Diagnosed, ScoredSize
from lab.diagnose import diagnose
from lab.formats.recording_set import RecordingSet
from lab.formats.results import NamedEffect

#: Seed of the sets: one for development.
SEED = 5011
SIGMAS = 2.0

Draw = Callable[[np.random.Generator, DrawnCamera], SimulatedSensor | SimulatedOptics]


@dataclass(frozen=True)
class Source:
    """A model of a simulator. `effect`: the library's name of it, None of healthy cameras. `also`: of a
    second effect of the camera. `pitch_um`: of its pixels, in place of the drawn camera's."""

    simulator: str
    draw: Draw
    effect: str | None
    also: str | None = None
    pitch_um: float | None = None


#: Models by the name under which they are asked for.
SOURCES: dict[str, Source] = {
    "healthy_sensor": Source("Pyxel", lambda rng, camera: SimulatedSensor(), None),
    "charge_transfer_inefficiency": Source(
        "Pyxel", by_pyxel.PyxelTransfer.draw, "charge_transfer_inefficiency", "hot_pixels"
    ),
    "persistence": Source("Pyxel", by_pyxel.PyxelPersistence.draw, "persistence"),
    "inter_pixel_capacitance": Source("Pyxel", by_pyxel.Capacitance.draw, "inter_pixel_capacitance"),
    "nonlinearity": Source("Pyxel", by_pyxel.Bend.draw, "nonlinearity"),
    "amplifier_crosstalk": Source("Pyxel", by_pyxel.PyxelCrosstalk.draw, "amplifier_crosstalk"),
    "excess_noise": Source("Pyxel", by_pyxel.Avalanche.draw, "excess_noise"),
    "reading_order_noise": Source("Pyxel", by_pyxel.PinkNoise.draw, "reading_order_noise"),
    "brighter_fatter": Source("GalSim", by_galsim.Silicon.draw, "brighter_fatter"),
    "healthy_lens": Source("GalSim", by_galsim.airy, None),
    "moffat_blur": Source("GalSim", by_galsim.moffat, "moffat_blur"),
    "turbulent_air": Source("GalSim", by_galsim.kolmogorov, "turbulent_air"),
    "defocus": Source("GalSim", by_galsim.defocus, "defocus"),
    "astigmatism": Source("GalSim", by_galsim.astigmatism, "astigmatism"),
    "coma": Source("GalSim", by_galsim.coma, "coma"),
    "trefoil": Source("GalSim", by_galsim.trefoil, "trefoil"),
    "secondary_coma": Source("GalSim", by_galsim.secondary_coma, "secondary_coma"),
    "tetrafoil": Source("GalSim", by_galsim.tetrafoil, "tetrafoil"),
    # new ones at the end: a set's seed holds the model's place
    "healthy_dark_current": Source("Pyxel", by_pyxel.PyxelDark.draw, None),
    "persistence_of_three_traps": Source("Pyxel", by_pyxel.PyxelPersistence.draw_several, "persistence"),
    "column_gain": Source("Pyxel", by_pyxel.Columns.draw, "column_gain"),
    "cosmic_rays": Source("Pyxel", by_pyxel.Protons.draw, "cosmic_rays", pitch_um=24.0),
    "charge_transfer_into_overscan": Source("Pyxel", by_pyxel.OverscanTransfer.draw, "charge_transfer_inefficiency"),
}


def draw_set(source: str, number: int) -> tuple[RecordingSet, dict[str, float], SimulatorCheck]:
    """Return set `number` of a source, the truth by the library's parameters, and the check of its simulator."""
    rng = np.random.default_rng([SEED, list(SOURCES).index(source), number])
    camera = draw_camera(rng)
    if (pitch_um := SOURCES[source].pitch_um) is not None:
        camera = replace(camera, pitch_um=pitch_um)
    model = SOURCES[source].draw(rng, camera)
    record = (
        partial(record_optics, optics=model)
        if isinstance(model, SimulatedOptics)
        else partial(record_sensor, sensor=model)
    )
    return record(name=f"{source}-{number}", camera=camera, rng=rng), dict(model.truth), model.check()


def diagnose_sets(file: Path, sets: int, sources: Sequence[str]) -> list[Diagnosed]:
    """Return the results of `sets` sets of each source. Those in `file` aren't diagnosed again; 0: all of those, and no
    more."""
    results = list(_kept(file))
    done = {(one.source, one.set) for one in results}
    for number in range(1, sets + 1):
        for source in sources:
            if (source, number) in done:
                continue
            result = diagnose_set(source, number)
            with file.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(asdict(result)) + "\n")
            results.append(result)
    return [one for one in results if one.source in sources and (sets == 0 or one.set <= sets)]


def diagnose_set(source: str, number: int) -> Diagnosed:
    """Draw, check and diagnose one set. A set whose simulator doesn't do what it was asked for isn't diagnosed."""
    recordings, truth, checked = draw_set(source, number)
    simulator, effect = SOURCES[source].simulator, SOURCES[source].effect
    undiagnosed = Diagnosed(
        source, simulator, effect, number, asked=float(checked.asked), measured=float(checked.measured),
        is_checked=checked.is_right, verdict="", names={}, sizes=(), cpu_s=0.0,
        also=SOURCES[source].also,
    )  # fmt: skip
    if not checked.is_right:
        return undiagnosed
    began_s = time.process_time()
    result = diagnose(recordings, at_once=False)
    sizes = tuple(size for named in result.effects if named.name == effect for size in _sizes(named, truth))
    names = {named.name: named.probability for named in result.effects}
    cpu_s = time.process_time() - began_s
    return replace(undiagnosed, verdict=result.verdict, names=names, sizes=sizes, cpu_s=cpu_s)


def _sizes(named: NamedEffect, truth: dict[str, float]) -> Iterator[ScoredSize]:
    for name, value in truth.items():
        found = named.parameters.get(name)
        if found is None:
            continue
        turn = -1.0 if not found.sign_known and found.value * value < 0.0 else 1.0
        if found.interval is not None:
            low, high = sorted(turn * end for end in found.interval)
        elif found.std is not None:
            low, high = (turn * found.value + side * SIGMAS * found.std for side in (-1.0, 1.0))
        else:
            continue
        yield ScoredSize(name, value, turn * found.value, low, high)


def _kept(file: Path) -> Iterator[Diagnosed]:
    if file.exists():
        for line in file.read_text(encoding="utf-8").splitlines():
            text = json.loads(line)
            yield Diagnosed(**text | {"sizes": tuple(ScoredSize(**size) for size in text["sizes"])})
