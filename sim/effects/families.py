"""The families of effects: what a lab calls the physics, where a single law doesn't hold exactly or several fit
alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Family(StrEnum):
    """Every effect belongs to one. Its value is the family's identifier, as results state it."""

    ISOTROPIC_CONTRAST = "isotropic_contrast_loss"
    DIRECTIONAL_CONTRAST = "directional_contrast_loss"
    COPIES_AND_VEILS = "copies_and_veils"
    COLOUR_BLUR = "colour_dependent_blur"
    SPECTRAL_FILTER = "spectral_filter"
    RESPONSE = "response_to_light"
    CONVERTER = "converter"
    DEFECTIVE_PIXELS = "defective_pixels"
    LINE_NOISE = "line_noise"
    READ_NOISE = "read_noise"
    PHOTON_NOISE = "photon_noise"
    READ_OUT_AREAS = "areas_of_read_out"
    DARK_SIGNAL = "dark_signal"
    RADIATION = "radiation"
    CHARGE_BETWEEN_NEIGHBOURS = "charge_between_neighbours"
    FRAME_MEMORY = "memory_of_the_last_frame"
    ON_CHIP_PROCESSING = "on_chip_processing"
    SOURCE_IN_TIME = "source_in_time"
    SOURCE_IN_WAVELENGTH = "source_in_wavelength"
    FIELD_OF_LIGHT = "field_of_light"
    SCREEN = "screen"
    GEOMETRY = "geometry"
    METADATA = "wrong_metadata"
    DISCREPANCY = "discrepancy"

    @property
    def words(self) -> str:
        """The physics, as a noun."""
        return _TOLD[self].words

    @property
    def sentence(self) -> str:
        """Return the sentence that says what recordings show where the family is named."""
        return _TOLD[self].sentence

    @property
    def separating_capture(self) -> str:
        """The capture that tells its members apart, as a clause; empty for a family of one member."""
        return _TOLD[self].told_apart_by


@dataclass(frozen=True)
class _Told:
    words: str
    sentence: str
    told_apart_by: str = ""


_TOLD = {
    Family.ISOTROPIC_CONTRAST: _Told(
        "loss of contrast, alike in all directions",
        "Fine detail has less contrast than lens and pixels leave it, alike in all directions.",
        "slanted edges at another f-number (diffraction and defocus change with it, a filter doesn't), in narrowband "
        "light (diffusion grows to the red), and at frequencies where a filter's contrast passes zero",
    ),
    Family.DIRECTIONAL_CONTRAST: _Told(
        "loss of contrast along a direction",
        "Fine detail has less contrast than lens and pixels leave it, along one direction more than along others.",
        "slanted edges at another exposure (motion grows with it) and another f-number (aberrations shrink with it)",
    ),
    Family.COPIES_AND_VEILS: _Told(
        "copies and veils of light",
        "Light lands away from its image: as a copy of the scene, or as a veil over it.",
        "a bright point or a coarse pattern in the dark: a copy has its shape, a veil hasn't",
    ),
    Family.COLOUR_BLUR: _Told(
        "colour-dependent blur or scale",
        "The lens images colours differently: at another focus, or another scale.",
        "slanted edges in narrowband light, in the middle and in the corners",
    ),
    Family.SPECTRAL_FILTER: _Told(
        "spectral filter or leak",
        "Something in the light's way passes other wavelengths than stated.",
        "narrowband light in finer steps: fringes come again evenly in the inverse of the wavelength, a filter has one "
        "edge",
    ),
    Family.RESPONSE: _Told(
        "response to light",
        "Signals aren't in proportion to the light, or pixels of one colour answer it differently.",
        "the same levels once by exposure and once by the light's radiance: the camera's response follows the signal, "
        "the shutter follows the time",
    ),
    Family.CONVERTER: _Told(
        "converter",
        "The converter's codes are unequal.",
        "many flat frames over the whole range of codes: wrong bit weights are steps at their codes, a ripple returns "
        "with its period",
    ),
    Family.DEFECTIVE_PIXELS: _Told(
        "defective pixels",
        "A few pixels, always the same ones, are far from the others.",
        "dark frames at two exposures, with many repeats: a hot pixel grows with the exposure, a blinking one changes "
        "from repeat to repeat",
    ),
    Family.LINE_NOISE: _Told(
        "line noise",
        "Pixels of a row or a column share a part of their noise or offset.",
        "more repeats of the dark frames: what stays is the columns' pattern, what changes is noise",
    ),
    Family.READ_NOISE: _Told(
        "read noise",
        "The noise of the read-out isn't alike and independent from pixel to pixel.",
        "dark frames with many repeats, and flats: shot noise hides what read-out does the more, the brighter they are",
    ),
    Family.PHOTON_NOISE: _Told(
        "noise of photoelectrons",
        "The noise of light isn't that of single electrons.",
    ),
    Family.READ_OUT_AREAS: _Told(
        "areas of the read-out",
        "Parts of the frame are read with another gain or another offset.",
        "flat and dark frames with many repeats: areas differ from the line where they meet on, columns one by one",
    ),
    Family.DARK_SIGNAL: _Told(
        "dark signal and offset",
        "Dark frames aren't at their level: it moves with time or temperature, or is uneven over the frame.",
        "dark frames at two exposures and two temperatures, and again at the end: an offset doesn't grow with the "
        "exposure",
    ),
    Family.RADIATION: _Told(
        "single particles",
        "Pixels are bright in one frame alone.",
    ),
    Family.CHARGE_BETWEEN_NEIGHBOURS: _Told(
        "charge between neighbours",
        "Charge, or the signal that it makes, is shared between neighbouring pixels.",
        "flat pairs from dark to full: coupling shares noise in proportion at every level, repelled charge the more "
        "the fuller the pixels are",
    ),
    Family.FRAME_MEMORY: _Told(
        "memory of the last frame",
        "A frame holds a part of those before.",
        "dark frames seconds and minutes after bright ones",
    ),
    Family.ON_CHIP_PROCESSING: _Told(
        "processing on the chip",
        "The camera filters its raw data, signal and noise alike.",
        "dark frames with many repeats",
    ),
    Family.SOURCE_IN_TIME: _Told(
        "source in time",
        "The source's light isn't constant while the recordings are taken.",
        "one setting repeated often, in equal steps of time, at a short and a long exposure: drift follows the clock, "
        "flicker the exposure",
    ),
    Family.SOURCE_IN_WAVELENGTH: _Told(
        "source in wavelength",
        "The source's spectrum, or the reading of it, isn't what is stated.",
        "the same wavelengths with an order-sorting filter, and with a narrower slit",
    ),
    Family.FIELD_OF_LIGHT: _Told(
        "field of light",
        "Even light isn't even on the sensor, or other light joins it.",
        "flat frames with the source or the camera turned by a quarter: what turns along is the camera's",
    ),
    Family.SCREEN: _Told(
        "screen",
        "The screen shows a pattern otherwise than it was asked to.",
        "the pattern at another distance, and with cells twice as large",
    ),
    Family.GEOMETRY: _Told(
        "geometry",
        "Images lie elsewhere than the geometry says.",
        "boards in every corner of the field, at two distances, at rest",
    ),
    Family.METADATA: _Told("metadata is wrong", "Something is stated of the camera that it isn't."),
    Family.DISCREPANCY: _Told(
        "model discrepancy", "Recordings depart from the model, and no effect of the library says why."
    ),
}
