"""The contract of effects, of the library and of other packages: absent is the baseline exactly, what is declared, a
slope at zero, and prototypes.

`calibench check-effect PACKAGE` runs it on an installed package; `tests/sim/effects` on the library."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.camera import CameraModel, Lens
from sim.effects.base import STAGES, Effect
from sim.effects.library import may_change
from sim.frame import (
    Exposure,
    expect_sequence,
    pair_gain_factor,
    predict_frame,
    read_out,
    right_delay_s,
    screen_light,
    with_reflections,
)
from sim.point import displaced_um, even_share, halos, optical_transfer
from sim.scene.scenes import Darkness, UniformField
from sim.spectrum import Spectrum
from sim.stages import charge_of, light_of, signal_of
from sim.uniform import Uniform, electron_rate

WAVELENGTH = np.arange(380.0, 781.0)
LIGHT = Spectrum.of(WAVELENGTH, np.full(WAVELENGTH.shape, 0.02))
LINE_650 = Spectrum.of([649.999, 650.0, 650.001], [0.0, 1.0, 0.0])
LINE = Spectrum.of(WAVELENGTH, 0.02 * np.exp(-0.5 * ((WAVELENGTH - 560.0) / 6.0) ** 2))
RED_LINE = Spectrum.of(WAVELENGTH, 0.02 * np.exp(-0.5 * ((WAVELENGTH - 775.0) / 6.0) ** 2))  # its half is visible


def _camera() -> CameraModel:
    def bell(peak: float) -> Spectrum:
        return Spectrum.of(WAVELENGTH, 0.5 * np.exp(-0.5 * ((WAVELENGTH - peak) / 40.0) ** 2))

    return CameraModel(
        rows=24, cols=32, pixel_pitch_um=3.0, fill_factor=0.8, cfa="RGGB", bit_depth=12, black_level_dn=64.0,
        white_level_dn=4095.0,
        conversion_gain_dn_per_e=0.4, full_well_e=10000.0, read_noise_e=2.0, dark_current_e_per_s=5.0, dsnu_e=0.0,
        prnu_percent=0.0,
        quantum_efficiency={"R": bell(600), "G": bell(535), "B": bell(460)},
        lens=Lens(f_number=4.0, focal_length_mm=8.0),
    )  # fmt: skip


CAMERA = _camera()
FREQUENCY = np.linspace(0.0, 1.2, 25)


PLACE_UM = (30.0, -20.0)


def everything(acting: tuple[Effect, ...]) -> NDArray[Any]:
    """Return all quantities that stages can change, in one vector, each in units of its own size."""
    otf = [
        optical_transfer(CAMERA, c, LIGHT, f, g, acting, place_um=PLACE_UM)
        for c in "RGB"
        for f, g in ((FREQUENCY, 0 * FREQUENCY), (0.6 * FREQUENCY, 0.8 * FREQUENCY))
    ]
    rates = [
        electron_rate(CAMERA, c, light, acting, kind)
        for c in "RGB"
        for light, kind in ((LIGHT, "flat"), (LINE, "narrowband"), (RED_LINE, "narrowband"))
    ]
    frame = predict_frame(CAMERA, Exposure(UniformField(LIGHT), 0.01), acting)
    place = np.linspace(-40.0, 40.0, 5)
    even = Uniform(CAMERA, acting)
    moved = displaced_um(CAMERA, place, 0.5 * place, 620.0, acting)
    rest = [even.source(600.0), even.collected_s(0.02), even.ambient_e("G", 1.0) / 1e3,
            even.offset_dn(600.0, 30.0, 0.02), float(even.shot_e2(np.array(9e3))),
            even_share(CAMERA, acting), sum(h[0] for h in halos(CAMERA, acting)),
            1e3 * even.unsteadiness**2, *(light_of(CAMERA, acting).colour(c, 600.0) for c in "RGB"),
            signal_of(CAMERA, acting).changing_e2(600.0),
            *signal_of(CAMERA, acting).read_power(np.array([0.0, 0.2, 0.4])),
            *even.shade_light(np.ones(5), place, place),
            *np.ravel(np.zeros(10) if moved is None else moved)]  # fmt: skip
    # what acts on dark pixels, on the frame after, and on the read-out, in electrons or DN
    dark = Exposure(Darkness(), 0.5, temperature_c=32.0)
    after = list(expect_sequence(CAMERA, [Exposure(UniformField(LIGHT), 0.004), dark], acting))
    out = read_out(CAMERA, dark, acting)
    levels = np.linspace(0.0, 4000.0, 41)
    electronics = [np.broadcast_to(more, frame.shape).ravel() for more in (*after, out.added_e, out.added_e2)]
    codes = levels if out.codes is None else out.codes(levels)
    shared = np.zeros(5 * 41) if out.neighbours is None else out.neighbours(levels).ravel()
    asked = np.tile(np.linspace(0.0, 1.0, 5), (5, 1))
    shown = with_reflections(CAMERA, screen_light(CAMERA, asked, place[None, :], 0.5 * place[:, None], acting), acting)
    pair = [pair_gain_factor(CAMERA, acting), right_delay_s(CAMERA, acting)]
    full = np.zeros((7, 3))
    full[3, 1] = 2.0 * CAMERA.full_well_e
    full = charge_of(CAMERA, acting).overflow_wells(full)
    return np.concatenate(
        [
            np.real(np.concatenate(otf)),
            np.imag(np.concatenate(otf)),
            np.array(rates) / max(rates),
            frame.ravel() / frame.max(),
            rest,
            shown.ravel(),
            pair,
        ]
        + [values / 100.0 for values in (*electronics, codes, full.ravel(), 100.0 * shared)]
    )


#: What a prediction may be independent of.
INVARIANCES = frozenset({"f_number", "exposure", "wavelength", "field", "level", "orientation", "time"})
#: Steps of a parameter from absent, in standard deviations of its prior, and how far the change may be from
#: proportional: the next order is a few per cent of the first there.
SMALL, CURVED = 0.05, 0.1


def complaints(kind: type[Effect]) -> tuple[str, ...]:
    """Return what an effect doesn't keep of the contract, a line each."""
    return (*check_absence(kind), *check_declarations(kind), *slope_complaints(kind), *prototype_complaints(kind))


def check_absence(kind: type[Effect]) -> Iterator[str]:
    """Yield what is wrong with the effect without arguments: it has to be absent, the baseline exactly."""
    absent = kind()
    for name, quantity in kind.quantities().items():
        if getattr(absent, name) != quantity.absent:
            yield f"{name}: its default is {getattr(absent, name)}, not its `absent`, {quantity.absent}"
    if not np.array_equal(everything((absent,)), everything(())):
        yield "absent, it changes a prediction: give the states back as they came"


def check_declarations(kind: type[Effect]) -> Iterator[str]:
    """Yield what is missing of what a diagnosis reads."""
    stages = kind.stages()
    if not stages or not set(stages) <= set(STAGES):
        yield f"acts in {', '.join(stages) or 'no stage'}: override one of {', '.join(STAGES.values())}"
    if not may_change(kind):
        yield "changes no quantity of the stages at its prototypes"
    if not kind.reference:
        yield "reference: name the source of the law"
    if not kind.sentence.endswith("."):
        yield "sentence: write one that ends in a full stop"
    if not 0.0 < kind.form_tolerance < 0.5:
        yield f"form_tolerance: is {kind.form_tolerance:g}, which has to lie between 0 and 0.5"
    if unknown := kind.invariances - INVARIANCES:
        yield f"invariances: {', '.join(sorted(unknown))} isn't one of {', '.join(sorted(INVARIANCES))}"
    if not kind.quantities():
        yield "has no parameter: declare one with a Quantity"
    if strange := kind.shapes - set(kind.quantities()):
        yield f"shapes: {', '.join(sorted(strange))} isn't a parameter"


def slope_complaints(kind: type[Effect]) -> Iterator[str]:
    """Yield the parameters without a slope at zero.

    In u = parameter ** linear_power the change is proportional to u near absent: halving u halves it."""
    base = everything(())
    for name, quantity in kind.quantities().items():
        if name in kind.shapes:
            continue
        scale = SMALL * (quantity.prior[1] if quantity.prior else 1.0) ** quantity.linear_power
        full, half = (everything((kind.from_linear({name: u}),)) - base for u in (scale, 0.5 * scale))
        if not np.abs(half).max() > 0:
            yield f"{name}: changes nothing near absent; state linear_power, or mend the law"
        elif not np.linalg.norm(full - 2.0 * half) < CURVED * np.linalg.norm(full):
            yield f"{name}: the change isn't proportional to it near absent; state linear_power"


def prototype_complaints(kind: type[Effect]) -> Iterator[str]:
    """Yield the prototypes that change nothing."""
    base = everything(())
    for number, places in enumerate(kind.prototypes(CAMERA), 1):
        if not places:
            yield f"prototypes: group {number} is empty"
        for prototype in places:
            if not np.abs(everything((prototype,)) - base).max() > 0:
                yield f"prototypes: {prototype!r} changes nothing"
