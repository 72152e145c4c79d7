"""The base class of the concealed laws, and the grid of wavelengths on which the simulator draws and integrates
spectra."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


Array = Any
WAVELENGTH_NM: NDArray[np.float64] = np.arange(380.0, 781.0)
BIT_DEPTH = 12  # of a converter that nobody asks otherwise
REFERENCE_NM = 550.0  # at which laws that depend on the wavelength have their stated strength

#: Kinds of capture that show a law; by default flats.
OPTICAL = frozenset({"slanted_edge"})
SPECTRAL = frozenset({"narrowband"})
DARK = frozenset({"dark"})


@dataclass(frozen=True)
class FrameTaken:
    """The frame that is exposed: `draw` selects its random numbers, `elapsed_s` is the time since the session began."""

    draw: int
    exposure_s: float
    elapsed_s: float
    temperature_c: float


class CameraProperties(Protocol):
    """What laws and lens read of the camera that they are built into (`ConcealedCamera`)."""

    seed: int
    rows: int
    cols: int
    cfa: str
    pitch_um: float
    fill_factor: float
    f_number: float
    working_f_number: float
    open_pupil: float
    full_code_dn: int
    gain_dn_per_e: float
    read_noise_e: float
    black_level_dn: float
    full_well_e: float
    quantum_efficiency: dict[str, Array]
    filter_transmittance: dict[str, Array]
    field_position: tuple[Array, Array]
    laws: tuple[Law, ...]

    @property
    def half_diagonal_px(self) -> float:
        """From the frame's centre to its corner."""


class Law:
    """One piece of physics that a camera conceals, built into the stages of `ConcealedCamera`.

    A subclass overrides the methods of the stages that it changes; by default none changes anything. `effect` is its
    name in the list of effects (docs/reference/results.md), None where that list has none. A law has a `strength` in
    `unit` and one of `variants` forms, which the subclass's docstring lists in their order. Frame numbers `k` select
    the random numbers, so that a frame can be drawn again."""

    name: ClassVar[str]
    effect: ClassVar[str | None] = None
    #: Other effects of the list that describe it rightly.
    accepts: ClassVar[frozenset[str]] = frozenset()
    #: Families of effects that describe it rightly, where the list has no effect of it.
    families: ClassVar[frozenset[str]] = frozenset()
    variants: ClassVar[int] = 1
    unit: ClassVar[str] = "1"
    nominal: ClassVar[float]
    limits: ClassVar[tuple[float, float]]
    #: The residual grows as strength ** power.
    power: ClassVar[float] = 1.0
    signed: ClassVar[bool] = False
    #: What a camera or session must have for it: "mono", "bayer", "temperature", or nothing.
    needs: ClassVar[str] = ""
    shown_by: ClassVar[frozenset[str]] = frozenset({"flat"})

    def __init__(self, strength: float, variant: int = 0, seed: int = 0) -> None:
        self.strength, self.variant, self.seed = float(strength), variant % self.variants, seed
        rng = np.random.default_rng([seed, 77])
        self.sign = float(rng.choice([-1.0, 1.0])) if self.signed else 1.0
        self.signed_strength = self.strength * self.sign
        #: Uniform random numbers 0..1 for directions, positions, phases and periods.
        self.uniform = rng.random(8)
        self.camera: CameraProperties
        #: The frame that is exposed now.
        self.frame: FrameTaken

    def bind(self, camera: CameraProperties) -> None:
        """Tell the law which camera it is built into."""
        self.camera = camera

    def rng(self, *key: int) -> np.random.Generator:
        """Yield a generator of the law's own; the same key gives the same numbers."""
        return np.random.default_rng([self.seed, 78, *key])

    @property
    def listed_effect(self) -> str | None:
        """Name of this variant in the list of effects; None where that list has none."""
        return self.effect

    def library_parameters(self) -> dict[str, float]:
        """True values of the parameters that the library's effect of this name has, where the variant defines the same
        quantity."""
        return {}

    # illumination

    def radiance(self, radiance: Array, kind: str) -> Array:
        """Spectral radiance (W sr^-1 m^-2 nm^-1, at WAVELENGTH_NM) that arrives where the radiometer read
        `radiance`."""
        return radiance

    def source_factor(self, elapsed_s: float) -> float:
        """Light of the source relative to its reading, `elapsed_s` after the session began."""
        return 1.0

    def row_factors(self, count: int, exposure_s: float, k: int) -> Array:
        """Relative light of each row of frame `k`; (count, 1) or a scalar."""
        return 1.0

    def ambient_e_per_s(self, channel: str) -> float:
        """Charge by light of the room, e-/s."""
        return 0.0

    def screen_pattern(self, pattern: Array, row: Array, col: Array) -> Array:
        """Return what a screen shows of `pattern` (0..1), at camera pixels (row, col) from the frame's centre."""
        return pattern

    def scene_factor(self, kind: str) -> float:
        """Signal of a capture of this kind relative to the camera without the law."""
        return 1.0

    # lens

    def transmittance(self, channel: str) -> Array:
        """Relative transmittance at WAVELENGTH_NM."""
        return 1.0

    def path_error_um(self, x: Array, y: Array, wavelength_nm: float) -> Array | None:
        """Optical path difference at pupil coordinates (x, y), the pupil's radius 1; None: no aberration."""
        return None

    def image_shift_px(self, x: Array, y: Array, wavelength_nm: float) -> tuple[Array, Array] | None:
        """Shift of the image to the right and down, at (x, y) half diagonals from the centre; None: no shift."""
        return None

    def spectral_transfer(self, frequency_cy_um: Array, wavelength_um: float) -> Array:
        """Factor on the optical transfer function at one wavelength, isotropic."""
        return 1.0

    def transfer(self, fx_cy_um: Array, fy_cy_um: Array) -> Array:
        """Factor on the optical transfer function at all wavelengths."""
        return 1.0

    def aperture_transfer(self, fx_cy_um: Array, fy_cy_um: Array, side_um: float) -> Array | None:
        """Transfer function of the pixel's aperture in place of a square of `side_um`; None: the square."""
        return None

    def relative_response(self, x: Array, y: Array) -> Array:
        """Relative signal of the pixels at (x, y) half diagonals from the centre."""
        return 1.0

    def colours(self, images: dict[str, Array]) -> dict[str, Array]:
        """Return what pixels of each channel see of the images on the sensor (e-/s, by channel)."""
        return images

    def image(self, image: Array) -> Array:
        """Return the image on the sensor (e-/s, one channel)."""
        return image

    # charge

    def collection_time_s(self, exposure_s: float) -> float:
        """Time for which light is collected when `exposure_s` is requested."""
        return exposure_s

    def collected_e(self, electrons: Array, rate_e_per_s: Array) -> Array:
        """Mean photoelectrons of an exposure."""
        return electrons

    def dark_rate(self, rate_e_per_s: Array, temperature_c: float) -> Array:
        """Dark current, e-/s."""
        return rate_e_per_s

    def lag_e(self, previous_e: Array | None) -> Array:
        """Mean electrons that the previous frame leaves in this one."""
        return 0.0

    def drawn_e(self, electrons: Array, mean_e: Array) -> Array:
        """Electrons after the Poisson draw, of the given mean."""
        return electrons

    # read-out

    def response(self, electrons: Array) -> Array:
        """Signal of the amplifier in electrons."""
        return electrons

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        """Noise or pattern that read-out adds to frame `k`."""
        return 0.0

    def offset_dn(self, elapsed_s: float, temperature_c: float) -> float:
        """Change of the black level."""
        return 0.0

    def adc_output(self, dn: Array) -> Array:
        """Output of the converter before rounding."""
        return dn

    def processed_dn(self, dn: Array) -> Array:
        """Output of the camera's digital processing."""
        return dn
