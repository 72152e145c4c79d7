"""A camera at another f-number than the one that its effects are stated for."""

from __future__ import annotations

from collections.abc import Sequence

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.coma import Coma
from sim.effects.spherical_aberration import SphericalAberration
from sim.optics.imaging import DiffractionLimited

#: Parameters that are path errors at the pupil's rim, with the power of the rim's height that they go with (Seidel).
#: Effects that are stated by a displacement of the image (defocus, astigmatism) follow the f-number by themselves.
RIM_POWERS: dict[type[Effect], dict[str, int]] = {
    SphericalAberration: {"w040_um": 4},
    Coma: {"w131_x_um": 3, "w131_y_um": 3},
}


def at_f_number(camera: CameraModel, f_number: float) -> CameraModel:
    """Return the camera with its lens at `f_number`. Raises ValueError for a lens that is known at one aperture
    alone."""
    if not isinstance(camera.lens.imaging, DiffractionLimited):
        raise ValueError(  # noqa: TRY004  (the lens is of the right type)
            f"a lens that is {camera.lens.imaging.kind} holds for f/{camera.lens.f_number:g} alone"
        )
    return camera.model_copy(update={"lens": camera.lens.model_copy(update={"f_number": f_number})})


def effects_at_f_number(effects: Sequence[Effect], stated: float, f_number: float) -> tuple[Effect, ...]:
    """Effects whose parameters hold at the f-number `stated`, as they are at `f_number`: a smaller pupil has its rim
    where the path errors are less."""
    share = stated / f_number
    found = []
    for effect in effects:
        powers = RIM_POWERS.get(type(effect), {}) if share != 1.0 else {}
        bounds = type(effect).quantities()
        values = {name: getattr(effect, name) * share**power for name, power in powers.items()}
        within = {name: min(max(v, bounds[name].lower), bounds[name].upper) for name, v in values.items()}
        found.append(effect.replace_fields(**within) if within else effect)
    return tuple(found)
