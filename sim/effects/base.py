"""What a physical effect declares and where it acts. One effect, one file; `sim.effects.library` lists them.

A first-order camera model leaves physics out. Each effect is one such piece: a change to a stage of the chain of light
(`sim.stages`). An effect writes those of the eight methods below that it needs, and its parameters as fields.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, ClassVar, Literal, Self, get_args, get_origin

import numpy as np
from pydantic import Field
from pydantic.fields import FieldInfo

from sim.camera import CameraModel
from sim.effects.families import Family
from sim.parameters import Frozen, Quantity, read_quantities
from sim.stages import Charge, Codes, Image, Light, Signal

#: The stages in the order of the light, and the method by which an effect acts on each.
STAGES = {"light": "on_light", "image": "on_image", "charge": "on_charge", "signal": "on_signal", "codes": "on_codes"}

#: The f-number at whose pupil an aberration's path error is stated. At another it is that of the part of the pupil that
#: is open there (`sim.optics.pupil.Wavefront.stopped`).
StatedFNumber = Annotated[
    float | None,
    Field(ge=0.5, le=64.0, description="f-number at which the path error is stated; not given: the camera's"),
]


def _is_told(field: FieldInfo) -> bool:
    types = [field.annotation]
    while types:
        kind = types.pop()
        if get_origin(kind) is Literal:
            return True
        types += get_args(kind)
    return field.annotation is int and any(hasattr(bound, "ge") or hasattr(bound, "le") for bound in field.metadata)


class Effect(Frozen):
    """Base of all effects. Parameters are fields annotated with `sim.parameters.Quantity` (unit, bounds, prior,
    `absent`, `linear_power`), each with its `absent` value as default, so that `TheEffect()` is the baseline. Other
    fields are choices, which no fit changes; each has a pydantic `Field` with a description.

    The methods that an effect may write; each default changes nothing:

    - `on_light`: it changes what reaches the lens: source, screen, room, the two cameras' common scene.
    - `on_image`: it changes the image on the sensor: transmittance, path error, transfer, shading, distortion,
      scattered light.
    - `on_charge`: it changes electrons in the pixels: how long they are collected, where they end up, their noise.
    - `on_signal`: it changes the read-out: response, offset, noise of lines and pixels, filters on the chip.
    - `on_codes`: it changes the converter.
    - `prototypes`: a small change of a parameter from `absent` isn't its signature.
    - `log_prior`: some combinations of its parameters are unusual.
    - `limits`: hardware bounds a parameter by what the camera is.
    """

    name: ClassVar[str]
    #: The name as a laboratory writes it within a sentence, where that isn't `name` with spaces in it.
    title: ClassVar[str] = ""
    #: The physics that it is one law of: the name where no member's law holds exactly, or several do.
    family: ClassVar[Family]
    reference: ClassVar[str]
    #: Fraction of its own effect by which the textbook law may be wrong (one standard deviation).
    form_tolerance: ClassVar[float] = 0.05
    #: What the effect doesn't depend on, of: f_number exposure wavelength field level orientation time.
    invariances: ClassVar[frozenset[str]] = frozenset()
    #: Parameters that shape the effect without sizing it (a filter's edge): a score takes them from the prototype as
    #: they are.
    shapes: ClassVar[frozenset[str]] = frozenset()
    #: Other forms of the law, one standard deviation from this one: values of fields that no fit changes, each by
    #: itself.
    forms: ClassVar[Mapping[str, object]] = {}
    #: Whether a diagnosis looks for it. False: a part that a camera is known to have, or a term of the diagnosis
    #: itself.
    is_candidate: ClassVar[bool] = True
    #: One sentence for the report: what physics was left out and how that shows.
    sentence: ClassVar[str]

    def pupil_share(self, f_number: float) -> float:
        """Return the radius of the pupil at `f_number` over that at which the effect's path error is stated."""
        stated: float | None = getattr(self, "stated_f_number", None)
        return 1.0 if stated is None else stated / f_number

    @classmethod
    def quantities(cls) -> dict[str, Quantity]:
        """Return the declared parameters, by field name."""
        return read_quantities(cls)

    @classmethod
    def choices(cls) -> dict[str, FieldInfo]:
        """Return the fields that no fit changes, by name: a material, a corner, the seed of a drawn pattern."""
        quantities = cls.quantities()
        return {name: field for name, field in cls.model_fields.items() if name not in quantities}

    @classmethod
    def told_choices(cls) -> tuple[str, ...]:
        """Names of the choices that a finding tells: those among listed values, and integers with declared bounds. The
        seed of a drawn pattern has none.
        """
        return tuple(name for name, field in cls.choices().items() if _is_told(field))

    @classmethod
    def stages(cls) -> tuple[str, ...]:
        """Names of the stages on which it acts, in the order of the light."""
        return tuple(stage for stage, method in STAGES.items() if getattr(cls, method) is not getattr(Effect, method))

    def replace_fields(self, **values: float) -> Self:
        """Return the same effect with other values of its fields, checked as any are."""
        return type(self)(**{name: getattr(self, name) for name in type(self).model_fields} | values)

    @classmethod
    def from_linear(cls, coordinates: dict[str, float]) -> Self:
        """Return the effect at given coordinates u = parameter ** linear_power (measured from `absent`)."""
        values = {}
        for field, quantity in cls.quantities().items():
            u = coordinates.get(field, 0.0)
            absent = quantity.absent or 0.0
            values[field] = absent + (
                u if quantity.linear_power == 1 else np.sign(u) * abs(u) ** (1 / quantity.linear_power)
            )
        return cls(**values)

    def log_prior(self) -> float:
        """Logarithm of this combination's prior probability over that of the single parameters' priors, at most 0:
        hardware has its habits, that a rival with as many parameters hasn't.
        """
        return 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        """Small or typical instances whose change of the prediction is the effect's signature in the score test.

        Each inner tuple is one set of signatures that may be combined with coefficients >= 0 (a two-sided parameter
        gives both signs). Several inner tuples are alternatives (an effect without a derivative at `absent`, such as a
        filter's edge, gives one for each place it may lie). The default is one set: 0.3 standard deviations of each
        parameter's prior from `absent`, within its bounds; of one that acts as its square, to one side.
        """
        steps: list[Self] = []
        for field, quantity in cls.quantities_of(camera).items():
            if field in cls.shapes:
                continue
            absent = quantity.absent or 0.0
            size = quantity.prior[1] if quantity.prior is not None else 1.0
            for sign in (1.0, -1.0) if quantity.linear_power != 2 else (1.0,):
                value = absent + sign * 0.3 * size
                if (quantity.lower is None or value >= quantity.lower) and (
                    quantity.upper is None or value <= quantity.upper
                ):
                    steps.append(cls(**{field: value}))
        return (tuple(steps),)

    @classmethod
    def limits(cls, camera: CameraModel) -> dict[str, tuple[float, float]]:
        """Return bounds (lower, upper) that hardware sets to parameters of this camera, by field name, in the field's
        unit.

        They lie within the declared ones. The default sets none.
        """
        return {}

    @classmethod
    def quantities_of(cls, camera: CameraModel) -> dict[str, Quantity]:
        """Return the declared parameters, by field name, with the bounds that hardware sets for this camera."""
        limits = cls.limits(camera)
        return {
            name: replace(q, lower=limits[name][0], upper=limits[name][1]) if name in limits else q
            for name, q in cls.quantities().items()
        }

    def other_forms(self) -> tuple[Self, ...]:
        """Return this effect by each of the other `forms` of its law.

        A diagnosis marginalises over the difference of each form from this one, with a standard normal coefficient. It
        is part of the law's error beside `form_tolerance`, and unlike that has the form's own shape.
        """
        others = ((name, value) for name, value in type(self).forms.items() if getattr(self, name) != value)
        return tuple(self.model_copy(update={name: value}) for name, value in others)

    def on_light(self, light: Light) -> Light:
        """Return `light` with the effect's laws of the light that reaches the lens.

        The laws act on what the radiometer measured and the screen was asked to show.
        """
        return light

    def on_image(self, image: Image) -> Image:
        """Return `image` with the effect's laws of the irradiance on the sensor, by wavelength and place."""
        return image

    def on_charge(self, charge: Charge) -> Charge:
        """Return `charge` with the effect's laws of the electrons in the pixels."""
        return charge

    def on_signal(self, signal: Signal) -> Signal:
        """Return `signal` with the effect's laws of the read-out: electrons to DN."""
        return signal

    def on_codes(self, codes: Codes) -> Codes:
        """Return `codes` with the effect's laws of the converter: DN to codes."""
        return codes


#: Effects that act together, in the order in which they were found.
Effects = Sequence[Effect]
