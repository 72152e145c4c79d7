"""What is changed between the session that a model was fitted to and the one that is predicted, and the model that
carries it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import ValidationError

from lab.errors import InputError
from lab.fit.noise.dark_current import DOUBLING_C_STD
from lab.formats.camera_file import CameraFile
from lab.formats.spectrum_csv import parse_spectrum
from lab.predict.simulate import with_lens
from sim.effects.dark_current_temperature import DarkCurrentTemperature
from sim.effects.other_f_number import OtherFNumber
from sim.optics.illumination import irradiance_factor
from sim.optics.imaging import DiffractionLimited
from sim.parameters import Frozen, Quantity
from sim.spectrum import Spectrum
from sim.stop_down import effects_at_f_number

#: Change of the temperature (C) that needs no law of dark current.
SAME_C = 0.5


class Changes(Frozen):
    """The changes of one session; None: as in the plan."""

    f_number: Annotated[float | None, Quantity("1", "f-number", lower=0.5, upper=64.0)] = None
    temperature_c: Annotated[float | None, Quantity("C", "sensor temperature", lower=-273.0, upper=200.0)] = None
    lamp: Path | Spectrum | None = None
    lens: Path | None = None
    distance_mm: Annotated[float | None, Quantity("mm", "distance of the scene", lower=1.0)] = None
    exposure_factor: Annotated[float | None, Quantity("1", "factor on exposures", lower=1e-4, upper=1e4)] = None
    gain_db: Annotated[float | None, Quantity("dB", "analogue gain", lower=-40.0, upper=80.0)] = None
    radiance_factor: Annotated[float | None, Quantity("1", "factor on the light", lower=1e-6, upper=1e6)] = None

    @property
    def changes_lens(self) -> bool:
        """Whether the lens, or its aperture, is another one."""
        return self.f_number is not None or self.lens is not None

    def spectrum(self) -> Spectrum | None:
        """Return the changed lamp's radiance, W sr^-1 m^-2 nm^-1; None: the plan's. Raises InputError for a file that
        can't be used."""
        if self.lamp is None or isinstance(self.lamp, Spectrum):
            return self.lamp
        try:
            return parse_spectrum(self.lamp.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(
                f"lamp: {self.lamp} can't be read ({getattr(error, 'strerror', error)}); name the CSV of its radiance"
            ) from error
        except InputError as error:
            raise InputError(f"lamp: {self.lamp}: {error}") from error


def parse_changes(text: str) -> Changes:
    """Return the changes of `key=value,key=value`. Raises InputError for an unknown key and a value that can't be used.

    >>> parse_changes("temperature_c=35, exposure_factor=2").temperature_c
    35.0
    """
    values: dict[str, str] = {}
    known = ", ".join(Changes.model_fields)
    for part in filter(None, (entry.strip() for entry in text.split(","))):
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if key not in Changes.model_fields:
            raise InputError(f"--change {part}: {key!r} isn't a change; take some of {known}")
        if not equals or not value or key in values:
            raise InputError(f"--change {part}: give {key}=VALUE, once")
        values[key] = value
    return validate_changes(values, "--change ")


def validate_changes(values: Mapping[str, Any], where: str) -> Changes:
    """Return changes of the camera or of the light, checked.

    values : by key, as a request or a command line states them
    where : beginning of the message

    Raises InputError for one that can't be used.

    >>> validate_changes({"temperature_c": 35.0}, "--change ").temperature_c
    35.0
    """
    try:
        return Changes.model_validate(values)
    except ValidationError as error:
        first = next((detail for detail in error.errors() if detail["type"] == "value_error"), error.errors()[0])
        reason = first["msg"].removeprefix("Value error, ")
        given = first["input"] if isinstance(first["input"], str | int | float) else "..."
        raise InputError(f"{where}{first['loc'][0]}={given}: {reason}; correct it") from error


def apply_changes(content: CameraFile, changes: Changes) -> CameraFile:
    """Return the model with the changes to its lens; aberrations state at which f-number they were fitted.

    content : the camera
    changes : of lens, aperture, temperature, distance and light

    Raises InputError where the model can't carry one of the changes.

    >>> from lab.formats.camera_file import default_camera
    >>> apply_changes(default_camera(), Changes(f_number=8.0)).camera.lens.f_number
    8.0
    """
    fitted_f_number = content.camera.lens.f_number
    if changes.lens is not None:
        if not changes.lens.is_file():
            raise InputError(f"lens: {changes.lens} isn't there; name the prescription, a .zmx file")
        content = with_lens(content, changes.lens)
    camera = content.camera
    if changes.f_number is not None:
        if not isinstance(camera.lens.imaging, DiffractionLimited):
            raise InputError(
                f"f_number={changes.f_number:g}: the model's lens is {camera.lens.imaging.kind}, which holds for "
                f"f/{camera.lens.f_number:g} alone; "
                "give lens=FILE.zmx at that aperture"
            )
        lens = camera.lens.model_copy(update={"f_number": changes.f_number})
        content = replace(content, camera=camera.model_copy(update={"lens": lens}))
    acting = effects_at_f_number(content.effects, fitted_f_number, content.camera.lens.f_number)
    content = replace(content, effects=acting)
    reference_c = reference_temperature_c(content)
    if changes.temperature_c is not None:
        if reference_c is None:
            raise InputError(
                f"temperature_c={changes.temperature_c:g}: the model doesn't say at which temperature its dark "
                "current holds; fit darks with temperature_c"
            )
        if abs(changes.temperature_c - reference_c) > SAME_C and not has_dark_law(content):
            raise InputError(
                f"temperature_c={changes.temperature_c:g}: the model has no law of dark current beyond "
                f"{reference_c:g} C; fit darks at two temperatures, or state "
                "dark_current_doubling_c in the camera file"
            )
    if changes.distance_mm is not None:
        focal_mm = content.camera.lens.focal_length_mm
        if focal_mm is None:
            raise InputError(
                f"distance_mm={changes.distance_mm:g}: the model's focal length isn't known; state focal_length_mm"
            )
        if changes.distance_mm <= 2.0 * focal_mm:
            raise InputError(
                f"distance_mm={changes.distance_mm:g}: isn't above twice the focal length, {focal_mm:g} mm; give a "
                "larger one, or state focal_length_mm"
            )
        # a near scene's image lies behind the focal plane: the cone is as much slimmer, for light and diffraction
        works = OtherFNumber(ratio=1.0 + focal_mm / (changes.distance_mm - focal_mm))
        content = replace(content, effects=(*content.effects, works))
    return content


def reference_temperature_c(content: CameraFile) -> float | None:
    """Return the temperature of the sensor, C, that the model's dark current holds for; None where nobody states it.

    >>> from lab.formats.camera_file import default_camera
    >>> reference_temperature_c(default_camera())
    25.0
    """
    if content.posterior is not None:
        return content.posterior.first.dark_temperature_c
    return content.camera.dark_current_reference_c


def has_dark_law(content: CameraFile) -> bool:
    """Return whether the model states how dark current changes with temperature.

    >>> from lab.formats.camera_file import default_camera
    >>> has_dark_law(default_camera())
    True
    """
    acts = any(isinstance(e, DarkCurrentTemperature) and e.doublings_per_c != 0.0 for e in content.effects)
    return acts or content.camera.dark_current_doubling_c is not None


def doubling_std_c(content: CameraFile) -> float:
    """Return the standard deviation of the camera's own doubling temperature, C."""
    return content.camera.std.get("dark_current_doubling_c", DOUBLING_C_STD)


def light_factor(content: CameraFile, changes: Changes) -> float:
    """Return the factor on the light of all lit captures: dimmer lamps, and a nearer scene, whose image is larger.

    >>> from lab.formats.camera_file import default_camera
    >>> light_factor(default_camera(), Changes(radiance_factor=0.5))
    0.5
    """
    factor = changes.radiance_factor or 1.0
    if changes.distance_mm is None:
        return factor
    lens = content.camera.lens
    focal_mm = lens.known_focal_length_mm
    magnification = focal_mm / (changes.distance_mm - focal_mm)
    return float(factor * irradiance_factor(lens.f_number, magnification) / irradiance_factor(lens.f_number))
