"""What a physical effect declares and where it acts. One effect, one file; `sim.effects.library` lists them.

A first-order camera model leaves physics out. Each effect is one such piece, written as a change to a stage of the
forward model. Every hook's default changes nothing, so a model without effects is the baseline bit for bit.
"""

from __future__ import annotations

from enum import StrEnum
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from sim.camera import CameraModel
from sim.parameters import Frozen, Quantity, declared
from sim.spectrum import FloatArray

#: Lines of pixels that may share a disturbance.
Lines = Literal["rows", "columns"]


class Stage(StrEnum):
    """Where an effect acts, in the order of the light."""

    RIG = "rig"  # the light source, the target, the radiometer: what reaches the lens
    OPTICS = "optics"  # lens, filters: what reaches the pixel
    CHARGE = "charge"  # in the silicon: where an electron ends up
    ELECTRONICS = "electronics"  # from charge to DN


class Effect(Frozen):
    """Base of all effects. Parameters are fields annotated with `sim.parameters.Quantity` (unit, bounds, prior, `absent`,
    `slope_power`), each with its `absent` value as default, so that `TheEffect()` is the baseline."""

    name: ClassVar[str]
    stage: ClassVar[Stage]
    reference: ClassVar[str]
    #: Fraction of its own effect by which the textbook law may be wrong (one standard deviation).
    form_tolerance: ClassVar[float] = 0.05
    #: What the effect doesn't depend on, of: f_number exposure wavelength field level orientation time.
    invariances: ClassVar[frozenset[str]] = frozenset()
    #: Parameters that shape the effect without sizing it (a filter's edge): a score takes them from the prototype as they are.
    shapes: ClassVar[frozenset[str]] = frozenset()
    #: Kinds of capture that can show it (`dark`, `flat`, `narrowband`, `slanted_edge`, ...); none: a part that a camera is known to
    #: have, which acts like another effect and so is never looked for.
    shown_by: ClassVar[frozenset[str]] = frozenset()
    #: Names of effects that can look the same in some set of captures.
    rivals: ClassVar[frozenset[str]] = frozenset()
    #: One sentence for the report: what physics was left out and how that shows.
    sentence: ClassVar[str]

    @classmethod
    def quantities(cls) -> dict[str, Quantity]:
        """The declared parameters, by field name."""
        return declared(cls)

    def having(self, **values: float) -> Self:
        """The same effect with other values of its fields, checked as any are."""
        return type(self)(**{name: getattr(self, name) for name in type(self).model_fields} | values)

    @classmethod
    def from_slopes(cls, slopes: dict[str, float]) -> Self:
        """The effect at given slope coordinates u = parameter ** slope_power (measured from `absent`)."""
        values = {}
        for field, quantity in cls.quantities().items():
            u = slopes.get(field, 0.0)
            absent = quantity.absent or 0.0
            values[field] = absent + (
                u if quantity.slope_power == 1 else np.sign(u) * abs(u) ** (1 / quantity.slope_power)
            )
        return cls(**values)

    def usual_nats(self) -> float:
        """By how much this combination of values is less likely than the priors of the single ones say, at most 0: hardware
        has its habits, that a rival with as many parameters hasn't."""
        return 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        """Small or typical instances whose change of the prediction is the effect's signature in the score test.

        Each inner tuple is one set of signatures that may be combined with coefficients >= 0 (a two-sided parameter
        gives both signs). Several inner tuples are alternatives (an effect that isn't a slope at `absent`, such as a filter's
        edge, gives one for each place it may lie). The default is one set: 0.3 standard deviations of each parameter's prior from `absent`, within its bounds.
        """
        steps: list[Self] = []
        for field, quantity in cls.quantities().items():
            if field in cls.shapes:
                continue
            absent = quantity.absent or 0.0
            size = quantity.prior[1] if quantity.prior is not None else 1.0
            for sign in (1.0, -1.0):
                value = absent + sign * 0.3 * size
                if (quantity.lower is None or value >= quantity.lower) and (
                    quantity.upper is None or value <= quantity.upper
                ):
                    steps.append(cls(**{field: value}))
        return (tuple(steps),)

    # --- hooks, in the order of the light; each returns its input changed -------------------------------------------

    def radiance(self, wavelength_nm: FloatArray, radiance: FloatArray, kind: str) -> FloatArray:
        """RIG: the radiance in front of the lens, given what the radiometer said; `kind` is the capture's."""
        return radiance

    def drift(self, elapsed_s: float) -> float:
        """RIG: factor on the source's radiance at a time after the first capture, given what the radiometer said."""
        return 1.0

    def exposure(self, exposure_s: float) -> float:
        """RIG or ELECTRONICS: the time that light was really collected, given the time that was asked for (s)."""
        return exposure_s

    def illumination(self, x_um: FloatArray, y_um: FloatArray, camera: CameraModel) -> FloatArray:
        """RIG or OPTICS: factor on the light by place on the sensor (um from its centre, x along columns, y along rows)."""
        return np.ones(np.broadcast_shapes(np.shape(x_um), np.shape(y_um)))

    def ambient_e_per_s(self, channel: str, camera: CameraModel) -> float:
        """RIG: electrons a second that reach a pixel beside the source while the shutter is open."""
        return 0.0

    def screen(self, share: FloatArray, x_um: FloatArray, y_um: FloatArray, camera: CameraModel) -> FloatArray:
        """RIG: light of a screen, 0..1 of its lit state, where a pattern asks for `share` (rows, cols); by place on the sensor (um from
        its centre, in equal steps along columns, x, and rows, y)."""
        return share

    def scene_gain(self) -> float:
        """RIG or ELECTRONICS: factor on the right camera's signal over the left one's in a scene that both see, against what their
        own captures of uniform light say."""
        return 1.0

    def capture_delay_s(self) -> float:
        """RIG: by how much the right camera of a pair captures later than the left one."""
        return 0.0

    def transmittance(self, wavelength_nm: FloatArray, sin_theta: FloatArray | float) -> FloatArray:
        """OPTICS: factor on the light, by wavelength and sine of the chief ray's angle at the sensor."""
        return np.ones(np.broadcast_shapes(np.shape(wavelength_nm), np.shape(sin_theta)))

    def transfer(
        self, fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float, camera: CameraModel
    ) -> FloatArray | NDArray[np.complex128] | None:
        """OPTICS or CHARGE: factor on the optical transfer function (1 at zero frequency), or None for none.

        fx runs along columns (x, to the right), fy along rows (y, down). May be complex. An effect of the pupil is an
        `Aberration`: it returns the aberrated pupil's ratio to the perfect one's, and adds up with others of its kind.
        An effect that has `charge` or `processing` too acts through that on whole frames; its `transfer` is for edges and
        kernels of one channel, where there's no mosaic to move charge on (see `acts_on_frames`).
        """
        return None

    def at_place(self, x_um: float, y_um: float, camera: CameraModel) -> Self:
        """OPTICS: the effect whose `transfer` an edge at one place of the sensor shows (um from its centre, x along columns, y along
        rows): of most effects the same everywhere."""
        return self

    @classmethod
    def acts_on_frames(cls) -> bool:
        """Whether the effect acts on whole frames through `charge` or `processing`, and so not through `transfer`: never twice."""
        return cls.charge is not Effect.charge or cls.processing is not Effect.processing

    def image_shift_um(
        self, x_um: FloatArray, y_um: FloatArray, wavelength_nm: float, camera: CameraModel
    ) -> tuple[FloatArray, FloatArray] | None:
        """OPTICS: how far (dx, dy) light of one wavelength lands from the place on the sensor where the baseline has it; None where
        the effect is absent, whatever the wavelength. Places are in um from the sensor's centre, x along columns, y along rows, and broadcast."""
        return None

    def image(self, irradiance: FloatArray, camera: CameraModel) -> FloatArray:
        """OPTICS: irradiance of a channel's whole image (rows, cols), in any unit, with what the lens makes of it as a whole, such as
        a reflection of it; linear in it."""
        return irradiance

    def veil(self) -> float:
        """OPTICS: share of the light that is spread evenly over the whole frame; `transfer` has it too, as a step at f = 0."""
        return 0.0

    def halo(self, camera: CameraModel) -> tuple[float, float]:
        """OPTICS: share of the light that is spread about its place by a normal distribution, too wide for an edge's surroundings
        to tell its transfer but narrower than the frame, and its standard deviation in um; `transfer` has it too."""
        return 0.0, 1.0

    def lit(self, electrons: FloatArray, exposure_s: float, elapsed_s: float, camera: CameraModel) -> FloatArray:
        """RIG or CHARGE: mean electrons that light alone makes in the pixels of a whole frame (rows, cols)."""
        return electrons

    def dark_current(
        self, e_per_s: FloatArray | float, temperature_c: float | None, camera: CameraModel
    ) -> FloatArray | float:
        """CHARGE: mean dark current, of all pixels or of each (rows, cols), given what the camera model says for that
        temperature of the sensor."""
        return self.even_dark_current(e_per_s, temperature_c, camera)

    def even_dark_current(
        self, e_per_s: FloatArray | float, temperature_c: float | None, camera: CameraModel
    ) -> FloatArray | float:
        """CHARGE: the same of effects that treat neighbours alike; of those that pick single pixels `odd_dark_current` tells."""
        return e_per_s

    def charge(self, electrons: FloatArray, exposure_s: float, camera: CameraModel) -> FloatArray:
        """CHARGE: mean electrons of a whole frame (rows, cols), after light and dark current were added. What it does to
        them, `transfer` says of one channel alone; in a frame only this acts."""
        return electrons

    def overflow(self, electrons: FloatArray, camera: CameraModel) -> FloatArray:
        """CHARGE: mean electrons of a whole frame after what is above the full well has run over; after `charge`."""
        return electrons

    def left_behind(self, electrons: FloatArray, camera: CameraModel) -> FloatArray | float:
        """CHARGE: how many of a frame's mean electrons aren't read but stay in the pixels for the next frame."""
        return 0.0

    def response(self, electrons: FloatArray, camera: CameraModel) -> FloatArray:
        """ELECTRONICS: what the read-out makes of a mean signal in electrons, point by point (linear: the same)."""
        return electrons

    def offset_dn(self, elapsed_s: float, temperature_c: float | None, camera: CameraModel) -> float:
        """ELECTRONICS: DN added to the black level, by time after the first capture and temperature."""
        return 0.0

    def noise_e2(self, electrons: FloatArray, noise_e2: FloatArray, camera: CameraModel) -> FloatArray:
        """CHARGE or ELECTRONICS: temporal variance of a pixel in e^2 at a mean signal in electrons."""
        return noise_e2

    def neighbour_correlation(self, electrons: FloatArray, camera: CameraModel) -> FloatArray | float:
        """CHARGE: correlation of a pixel's shot noise with that of each of its four neighbours, of the same mean signal in
        electrons; between 0 and 1/4. `noise_e2` has the variance that this leaves."""
        return 0.0

    def added(self, shape: tuple[int, ...], rng: np.random.Generator, camera: CameraModel) -> FloatArray | None:
        """ELECTRONICS: electrons that one frame's read-out adds to the pixels, drawn anew in each, or None for none; they
        broadcast to the frame's `shape`. Of mean `added_e` and variance `added_e2`."""
        return None

    def added_e(self, shape: tuple[int, ...], camera: CameraModel) -> FloatArray | float:
        """ELECTRONICS: mean of what `added` draws, pixel by pixel."""
        return 0.0

    def added_e2(self, shape: tuple[int, ...], camera: CameraModel) -> FloatArray | float:
        """ELECTRONICS: temporal variance (e^2) of what `added` draws, pixel by pixel."""
        return 0.0

    def odd_dark_current(self) -> tuple[FloatArray, FloatArray] | None:
        """CHARGE: which dark current `dark_current` gives to pixels that are unlike the others: their shares of all pixels (k,) and
        additional e/s (k,), nodes of its distribution; None for none."""
        return None

    def odd_jumps(self) -> tuple[FloatArray, FloatArray] | None:
        """ELECTRONICS: by how much `added` lets pixels that are unlike the others jump between two levels: their shares of all
        pixels (k,) and the levels' distances in e (k,), nodes of its distribution; None for none."""
        return None

    def line_spectrum_e2(self, frequency_cy_per_px: FloatArray, lines: Lines, fixed: bool) -> FloatArray | float:
        """ELECTRONICS: power spectrum over the rows (or columns) of what `added` gives to all pixels of a row (column) alike, anew
        in every frame or, `fixed`, the same in all; e^2, its mean over -0.5..0.5 cy/px is the variance."""
        return 0.0

    def line_parity_e(self, lines: Lines) -> float:
        """ELECTRONICS: by how many electrons odd rows (or columns) are read above even ones; not in `line_spectrum_e2`."""
        return 0.0

    def codes(self, dn: FloatArray, camera: CameraModel) -> FloatArray:
        """ELECTRONICS: what the converter makes of a level in DN before it rounds (ideal: the same)."""
        return dn

    def processing(self, camera: CameraModel) -> FloatArray | None:
        """ELECTRONICS: kernel (odd, odd) of sum 1 of the linear filter that the chip runs over each colour's plane, signal and
        noise alike, before its codes are rounded; None for none."""
        return None
