"""A camera at another f-number than the one that its effects are stated for."""

from __future__ import annotations

from collections.abc import Sequence

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.optics.imaging import DiffractionLimited

#: Field of the effects that are path errors at the pupil's rim.
STATED = "stated_f_number"


def at_f_number(camera: CameraModel, f_number: float) -> CameraModel:
    """Return the camera with its lens at `f_number`. Raises ValueError for a lens that is known at one aperture
    alone."""
    if not isinstance(camera.lens.imaging, DiffractionLimited):
        raise ValueError(  # noqa: TRY004  (the lens is of the right type)
            f"a lens that is {camera.lens.imaging.kind} holds for f/{camera.lens.f_number:g} alone"
        )
    return camera.model_copy(update={"lens": camera.lens.model_copy(update={"f_number": f_number})})


def effects_at_f_number(effects: Sequence[Effect], stated: float, f_number: float) -> tuple[Effect, ...]:
    """Effects that hold for a lens of f-number `stated`, as they act when it is at `f_number`: a path error says at
    which f-number it is stated, unless it does already. Displacements of the image follow the f-number by
    themselves."""
    if stated == f_number:
        return tuple(effects)
    return tuple(
        effect.model_copy(update={STATED: stated}) if _lacks_f_number(effect) else effect for effect in effects
    )


def _lacks_f_number(effect: Effect) -> bool:
    return STATED in type(effect).model_fields and getattr(effect, STATED) is None
