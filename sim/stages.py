"""The stages of the chain of light, each with its state: what the camera model leaves to effects, as laws that act one
after the other.

    Light (what reaches the lens) -> Image (irradiance by wavelength and place) -> Charge (electrons in the pixels)
    -> Signal (after read-out) -> Codes

A state is immutable. Its fields are tuples of laws; a state without laws is the baseline. An effect takes the state of
its stage and returns it with a law added (`State.adding`). The methods of a state apply its laws in their order. Only
`sim` applies them: other code asks the three entries `sim.uniform`, `sim.point` and `sim.frame`.

Places are in um from the sensor's centre, x along columns (to the right), y along rows (down). Frequencies follow the
same axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import reduce
from typing import Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve

from sim.camera import CameraModel
from sim.optics.filters import veil_otf
from sim.optics.pupil import Wavefront, pupil_ratio
from sim.sensor import mosaic
from sim.sensor.amplifiers import CoupledAmplifiers
from sim.sensor.defects import Defects, Jumps
from sim.sensor.electrons import NEIGHBOURS, NO_MULTIPLICATION, Multiplication
from sim.sensor.lines import LineGains, LineNoise
from sim.sensor.margins import NO_MARGINS, Margins
from sim.sensor.particles import Particles
from sim.sensor.reading_order import ReadOutNoise
from sim.sensor.trails import Trails, read_combs
from sim.spectrum import FloatArray

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class State:
    """Base of the five states: the camera model, and laws in the order in which effects added them."""

    camera: CameraModel

    def add_laws(self, **laws: Any) -> Self:
        """This state with one more law in each field that is named. Raises TypeError for a field that the stage doesn't
        have.
        """
        changed: dict[str, Any] = {name: (*getattr(self, name), law) for name, law in laws.items()}
        return replace(self, **changed)

    def list_laws(self) -> frozenset[str]:
        """Names of the fields that hold a law, as `stage.field`."""
        stage = type(self).__name__.lower()
        return frozenset(f"{stage}.{f.name}" for f in fields(self) if f.name != "camera" and getattr(self, f.name))


@dataclass(frozen=True)
class Unsteadiness:
    """A factor on the source that differs at random from frame to frame: normal about 1, the same for a frame whenever
    it is asked for.
    """

    relative_std: float
    seed: int

    def factor(self, elapsed_s: float) -> float:
        """Draw the factor on the source of the frame that is taken `elapsed_s` after the first capture."""
        rng = np.random.default_rng([self.seed, 3, round(1e3 * max(elapsed_s, 0.0))])
        return 1.0 + self.relative_std * float(rng.standard_normal())


@dataclass(frozen=True)
class RowLight:
    """Light that changes while a frame is taken. `factors`: (number of rows, exposure_s, elapsed_s) -> factor (rows,)
    on the source's light, periodic in elapsed_s with `period_s`.
    """

    period_s: float
    factors: Callable[[int, float, float], FloatArray]


@dataclass(frozen=True)
class Light(State):
    """State of the light that reaches the lens, given what the radiometer measured and the screen was asked to show.

    `spectrum`: (wavelength_nm, radiance, kind of capture) -> radiance. `level`: elapsed_s -> factor on the source;
    `level_by_channel`: (channel, elapsed_s) -> the same of what one channel sees of it.
    `rows`: factors on the source's light by row of one frame. `shading`: (x_um, y_um) -> factor by place on the sensor.
    `ambient_e_per_s`: channel -> electrons a second of light beside the source. `screen`: (share asked for, x_um, y_um)
    -> share of the lit state that is shown. `pair_gain`: factors on the right camera's signal over the left one's in
    one scene. `pair_delay_s`: by how much the right camera captures later. `unsteadiness`: random factors on the
    source, one a frame.
    """

    spectrum: tuple[Callable[[FloatArray, FloatArray, str], FloatArray], ...] = ()
    level: tuple[Callable[[float], float], ...] = ()
    level_by_channel: tuple[Callable[[str, float], float], ...] = ()
    rows: tuple[RowLight, ...] = ()
    shading: tuple[Callable[[FloatArray, FloatArray], FloatArray], ...] = ()
    ambient_e_per_s: tuple[Callable[[str], float], ...] = ()
    screen: tuple[Callable[[FloatArray, FloatArray, FloatArray], FloatArray], ...] = ()
    pair_gain: tuple[float, ...] = ()
    pair_delay_s: tuple[float, ...] = ()
    unsteadiness: tuple[Unsteadiness, ...] = ()

    def radiance(self, wavelength_nm: FloatArray, radiance: FloatArray, kind: str) -> FloatArray:
        """Return the radiance in front of the lens, given what the radiometer said; `kind` is the capture's."""
        return reduce(lambda value, law: law(wavelength_nm, value, kind), self.spectrum, radiance)

    def source(self, elapsed_s: float) -> float:
        """Factor on the source's radiance at a time after the first capture; of an unsteady source the mean."""
        return reduce(lambda value, law: value * max(law(elapsed_s), 0.0), self.level, 1.0)

    def colour(self, channel: str, elapsed_s: float) -> float:
        """Return the factor on what one channel sees of the source, beside `source`."""
        return reduce(lambda value, law: value * max(law(channel, elapsed_s), 0.0), self.level_by_channel, 1.0)

    def unsteady(self, elapsed_s: float) -> float:
        """Random factor besides, of mean 1, in the one frame that is taken at that time."""
        return reduce(lambda value, law: value * max(law.factor(elapsed_s), 0.0), self.unsteadiness, 1.0)

    def row_factors(self, rows: int, exposure_s: float, elapsed_s: float) -> FloatArray | None:
        """Factor (rows,) on the source's light in each row of one frame; None where no law says one."""
        if not self.rows:
            return None
        return reduce(lambda value, law: value * law.factors(rows, exposure_s, elapsed_s), self.rows, np.ones(rows))

    def ambient(self, channel: str) -> float:
        """Electrons a second that reach a pixel of a channel beside the source while the shutter is open."""
        return sum((law(channel) for law in self.ambient_e_per_s), 0.0)

    def show_share(self, share: FloatArray, x_um: FloatArray, y_um: FloatArray) -> FloatArray:
        """Apply the screen's laws.

        share : share of the screen's lit state that is asked for, 0..1 (rows, cols)
        x_um, y_um : places in equal steps

        Returns the share that is shown (rows, cols).
        """
        return reduce(lambda value, law: law(value, x_um, y_um), self.screen, share)


@dataclass(frozen=True)
class Veil:
    """Light that the lens scatters: `even_share` of it evenly over the frame, `halo_share` about its place by a normal
    distribution of `halo_std_um`, too wide for an edge's surroundings to show and narrower than the frame.
    """

    even_share: float
    halo_share: float = 0.0
    halo_std_um: float = 1.0


#: Values of a pattern's coordinate at which its factor is known; between them it is interpolated. 20 to a period of
#: 200 periods over the frame: an error of 1.2 % of the amplitude.
PATTERN_GRID = 4096
#: Share of the electrons below which a wavelength has no part in a pattern.
LEAST_SHARE = 1e-5


@dataclass(frozen=True)
class GainPattern:
    """Sensitivity that differs over a frame by a coordinate of its own, such as a layer's thickness. `coordinate`:
    (x_um, y_um) -> its value; `factor`: (wavelength_nm, coordinate), which broadcast -> factor. `is_grey`: it is the
    same for all wavelengths.
    """

    coordinate: Callable[[FloatArray, FloatArray], FloatArray]
    factor: Callable[[FloatArray, FloatArray], FloatArray]
    is_grey: bool = False

    def at(self, wavelength_nm: FloatArray, share: FloatArray, x_um: FloatArray, y_um: FloatArray) -> FloatArray:
        """Return the factor at places for light of which each wavelength makes the share `share` of the electrons."""
        place = self.coordinate(x_um, y_um)
        if self.is_grey:
            return self.factor(wavelength_nm[:1], place)
        grid = np.linspace(place.min(), place.max(), min(PATTERN_GRID, place.size))
        by_grid = np.zeros(grid.shape)
        use = share > LEAST_SHARE
        for nm, part in zip(wavelength_nm[use], share[use] / share[use].sum(), strict=True):
            by_grid += part * self.factor(np.asarray(nm), grid)
        return np.interp(place, grid, by_grid)


@dataclass(frozen=True)
class Image(State):
    """Irradiance on the sensor by wavelength and place.

    `transmittance`: (wavelength_nm, sine of the chief ray's angle) -> factor. `ripple`: wavelength_nm -> factor that
    changes too fast with the wavelength for a blur in white light to feel it. `pupil`: wavelength_nm -> path error;
    `pupil_at`: (wavelength_nm, x_um, y_um) -> path error at a place: path errors add up before the transfer function is
    formed. `transfer`: (fx, fy in cy/um, wavelength_nm) -> factor on the optical transfer function, 1 at zero
    frequency. `veils`: scattered light. `shading`: (x_um, y_um) -> factor. `shift`: (x_um, y_um, wavelength_nm) -> (dx,
    dy) in um by which light lands off. `copies`: whole image of a channel (rows, cols) -> image with reflections,
    linear in it. `patterns`: sensitivity that differs by place and wavelength, of mean 1 over the frame, as levels
    don't ask it.
    """

    transmittance: tuple[Callable[[FloatArray, FloatArray], FloatArray], ...] = ()
    ripple: tuple[Callable[[FloatArray], FloatArray], ...] = ()
    pupil: tuple[Callable[[float], Wavefront], ...] = ()
    pupil_at: tuple[Callable[[float, float, float], Wavefront], ...] = ()
    transfer: tuple[Callable[[FloatArray, FloatArray, float], FloatArray | ComplexArray], ...] = ()
    veils: tuple[Veil, ...] = ()
    shading: tuple[Callable[[FloatArray, FloatArray], FloatArray], ...] = ()
    shift: tuple[Callable[[FloatArray, FloatArray, float], tuple[FloatArray, FloatArray]], ...] = ()
    copies: tuple[Callable[[FloatArray], FloatArray], ...] = ()
    patterns: tuple[GainPattern, ...] = ()

    def transmit(self, wavelength_nm: FloatArray, sin_theta: FloatArray | float) -> FloatArray:
        """Factor on the light by wavelength and sine of the chief ray's angle at the sensor, which broadcast."""
        sine = np.asarray(sin_theta, float)
        none = np.ones(np.broadcast_shapes(np.shape(wavelength_nm), sine.shape))
        passed = reduce(lambda value, law: value * law(wavelength_nm, sine), self.transmittance, none)
        return reduce(lambda value, law: value * law(wavelength_nm), self.ripple, passed)

    def wavefront(self, wavelength_nm: float, place_um: tuple[float, float] = (0.0, 0.0)) -> Wavefront:
        """Return the sum of all path errors (um) at a place."""
        total = reduce(lambda value, law: value + law(wavelength_nm), self.pupil, Wavefront(()))
        return reduce(lambda value, law: value + law(wavelength_nm, *place_um), self.pupil_at, total)

    def otf(
        self,
        fx_cy_per_um: FloatArray,
        fy_cy_per_um: FloatArray,
        wavelength_nm: float,
        place_um: tuple[float, float] = (0.0, 0.0),
    ) -> FloatArray | ComplexArray:
        """Transfer function of the lens with all of this at one wavelength and place."""
        value = self.camera.lens.imaging.transfer(
            fx_cy_per_um,
            fy_cy_per_um,
            wavelength_nm,
            self.camera.lens.f_number,
            self.wavefront(wavelength_nm, place_um),
        )
        return self._apply_blur(value, fx_cy_per_um, fy_cy_per_um, wavelength_nm)

    def otf_beside_lens(
        self,
        fx_cy_per_um: FloatArray,
        fy_cy_per_um: FloatArray,
        wavelength_nm: float,
        place_um: tuple[float, float] = (0.0, 0.0),
    ) -> FloatArray | ComplexArray:
        """Return the same over the lens's own; path errors as those of a perfect lens's pupil over that lens."""
        value: FloatArray | ComplexArray = np.ones(np.broadcast_shapes(np.shape(fx_cy_per_um), np.shape(fy_cy_per_um)))
        path = self.wavefront(wavelength_nm, place_um)
        if path.terms:
            value = pupil_ratio(fx_cy_per_um, fy_cy_per_um, wavelength_nm, self.camera.lens.f_number, path)
        return self._apply_blur(value, fx_cy_per_um, fy_cy_per_um, wavelength_nm)

    def _apply_blur(
        self, value: FloatArray | ComplexArray, fx: FloatArray, fy: FloatArray, wavelength_nm: float
    ) -> FloatArray | ComplexArray:
        for law in self.transfer:
            value = value * law(fx, fy, wavelength_nm)
        for veil in self.veils:
            even = veil_otf(fx, fy, veil.even_share)
            value = value * (even + veil_otf(fx, fy, veil.halo_share, veil.halo_std_um) - 1.0)
        return value

    @property
    def moves(self) -> bool:
        """Return whether any law lets light land elsewhere."""
        return bool(self.shift)

    def shift_um(
        self, x_um: FloatArray, y_um: FloatArray, wavelength_nm: float
    ) -> tuple[FloatArray | float, FloatArray | float]:
        """Return how far (dx, dy) light of one wavelength lands from where the baseline has it."""
        right: FloatArray | float = 0.0
        down: FloatArray | float = 0.0
        for law in self.shift:
            dx, dy = law(x_um, y_um, wavelength_nm)
            right, down = right + dx, down + dy
        return right, down

    def remove_veil(self) -> Image:
        """This without the light that is scattered evenly over a frame."""
        return replace(self, veils=tuple(replace(veil, even_share=0.0) for veil in self.veils))

    def add_veil(self, image: FloatArray) -> FloatArray:
        """Return a channel's irradiance (rows, cols) with what is scattered evenly over the frame: (1 - s) I + s <I>.
        Scattered light has met the lens's fall-off already and has none of its own.
        """
        return reduce(lambda v, veil: v + veil.even_share * (np.mean(v) - v), self.veils, image)

    def pattern(
        self, wavelength_nm: FloatArray, electrons: FloatArray, x_um: FloatArray, y_um: FloatArray
    ) -> FloatArray:
        """Return the factor of `patterns` at places that stand for the frame, of mean 1, in light of which each
        wavelength makes so many `electrons`."""
        total = float(np.sum(electrons))
        if not self.patterns or total <= 0.0:
            return np.ones(np.broadcast_shapes(np.shape(x_um), np.shape(y_um)))
        each = [law.at(wavelength_nm, electrons / total, x_um, y_um) for law in self.patterns]
        pattern = np.prod(each, axis=0)
        return np.asarray(pattern / pattern.mean())

    def with_copies(self, image: FloatArray) -> FloatArray:
        """Return a channel's whole image (rows, cols) with its reflections."""
        return reduce(lambda value, law: law(value), self.copies, image)


@dataclass(frozen=True)
class Traps:
    """Traps that take the share `share` of the charge that a frame reads, and release it with the time constant
    `release_s`. What is released before an exposure begins is reset with the pixels. `capacity_e`: electrons that a
    pixel's traps hold when they are full.
    """

    share: float
    release_s: float
    capacity_e: float = np.inf

    def release(self, trapped_e: FloatArray, since_s: float, exposure_s: float) -> tuple[FloatArray, FloatArray]:
        """Return the electrons that an exposure collects from the traps, and those that they hold at its end.

        trapped_e : electrons in the traps when the exposure before ended
        since_s : from that end to this exposure's beginning, s
        """
        held = trapped_e * np.exp(-max(since_s, 0.0) / self.release_s)
        left = held * np.exp(-exposure_s / self.release_s)
        return held - left, left

    def fill(self, trapped_e: FloatArray, read_e: FloatArray) -> FloatArray:
        """Return the electrons in the traps after a frame of `read_e` electrons: an electron is taken with a
        probability in proportion to the traps that are empty, (c - t)(1 - exp(-q x / c)) of x with c the capacity and
        t in the traps, q x without a limit.
        """
        if not np.isfinite(self.capacity_e):
            return trapped_e + self.share * read_e
        empty = np.maximum(self.capacity_e - trapped_e, 0.0)
        return np.asarray(trapped_e - empty * np.expm1(-self.share * read_e / self.capacity_e))


#: The colours of the four next pixels in the mosaic, half of them each where there are two.
NEXT = {"R": ("G",), "G": ("R", "B"), "B": ("G",), "Y": ("Y",)}
#: A half for each of the next pixels in the row.
BESIDE = np.array([[0.5, 0.0, 0.5]])


@dataclass(frozen=True)
class Stray:
    """Light that misses its pixel and falls on the next ones. `shares`: (channel, x_um, y_um) -> shares of a pixel's
    light that fall, half each, on the two next pixels in its row and on those in its column. They change little from a
    pixel to the next.
    """

    shares: Callable[[str, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

    def exchange_pixels(self, electrons: FloatArray, camera: CameraModel) -> FloatArray:
        """Return the electrons of a whole frame (rows, cols), mirrored about the outermost pixels' centres."""
        row, col = (np.arange(float(n)) - 0.5 * (n - 1) for n in electrons.shape)
        x_um, y_um = (v * camera.pixel_pitch_um for v in np.meshgrid(col, row))
        by_channel = {c: self.shares(c, x_um, y_um) for c in camera.channels}
        mixed = electrons
        for axis, kernel in enumerate((BESIDE, BESIDE.T)):
            stray = electrons * mosaic.assemble({c: both[axis] for c, both in by_channel.items()}, camera.cfa)
            mixed = mixed - stray + convolve(stray, kernel, mode="mirror")
        return np.asarray(mixed)

    def exchange_channels(
        self, electrons: Mapping[str, FloatArray], x_um: FloatArray, y_um: FloatArray
    ) -> dict[str, FloatArray]:
        """Return the electrons of each channel in light that is even over neighbours, (..., places), of G the mean of
        both greens. A channel that isn't given is taken as bright as the one beside it.
        """
        stray = {c: sum(self.shares(c, x_um, y_um)) * e for c, e in electrons.items()}
        return {
            c: e - stray[c] + sum(stray.get(n, stray[c]) for n in NEXT[c]) / len(NEXT[c]) for c, e in electrons.items()
        }

    def part_greens(self, electrons: Mapping[str, FloatArray], x_um: FloatArray, y_um: FloatArray) -> FloatArray:
        """Return by how much green pixels on red rows have more electrons than those on blue rows (..., places)."""
        red, blue = ((along - down) * electrons[c] for c in "RB" for along, down in (self.shares(c, x_um, y_um),))
        return np.asarray(red - blue)


@dataclass(frozen=True)
class Charge(State):
    """Electrons in the pixels: where they come from and where they end up.

    `exposure_s`: time asked for -> time in which light is collected. `leak_s`: places down and across the frame, 0
    first line .. 1 last -> time in which light is collected besides, whatever is asked for. `collected`: electrons of
    light (rows, cols) -> electrons, pixel by pixel and in proportion; it depends on the place by a short period alone,
    a part of `mosaic.PERIOD_PX`, as measurements ask it on small tiles, and keeps each colour's mean, as levels don't
    ask it at all. `strays`: light that falls on the next pixels instead, by channel and place: none is lost.
    `dark_current`: (e/s, sensor temperature) -> e/s, of all pixels or of each (rows, cols). `defects`:
    pixels with additional dark current. `transfer`: (fx, fy in cy/um, wavelength_nm) -> factor on the transfer
    function, 1 at zero frequency, alike for all colours. `kernels`: where the charge of a pixel ends up, (odd, odd) of
    sum 1, so that none is lost: they act on whole frames, and on transfer functions (`sim.point.mix_channels` for a
    mosaic). `exchange`: mean electrons (rows, cols) -> the same after neighbours have exchanged charge by how much they
    hold: their sum stays, and equal neighbours exchange none. `overflow`: mean electrons (rows, cols) -> the same after
    full wells have run over. `lag`: electrons collected -> electrons that stay for the next frame, from none to all.
    `traps`: what fills in a frame and empties over the frames that follow. `trails`: what packets leave behind on their
    way to the output; in even light each finds nearly all that it loses. `particles`: charge of single particles.
    `variance_e2`: (mean electrons, shot noise's variance) -> variance. `correlation`: mean electrons (...) ->
    correlation (5, ...) of the shot noise with each neighbour, by the kinds of `sim.sensor.electrons.NEIGHBOURS`.
    `excess`: gain setting in dB -> random multiplication of each electron, whose factor on the shot noise's variance is
    1 and more.
    """

    exposure_s: tuple[Callable[[float], float], ...] = ()
    leak_s: tuple[Callable[[FloatArray, FloatArray], FloatArray], ...] = ()
    collected: tuple[Callable[[FloatArray], FloatArray], ...] = ()
    strays: tuple[Stray, ...] = ()
    dark_current: tuple[Callable[[FloatArray | float, float | None], FloatArray | float], ...] = ()
    defects: tuple[Defects, ...] = ()
    transfer: tuple[Callable[[FloatArray, FloatArray, float], FloatArray], ...] = ()
    kernels: tuple[FloatArray, ...] = ()
    exchange: tuple[Callable[[FloatArray], FloatArray], ...] = ()
    overflow: tuple[Callable[[FloatArray], FloatArray], ...] = ()
    lag: tuple[Callable[[FloatArray], FloatArray], ...] = ()
    traps: tuple[Traps, ...] = ()
    trails: tuple[Trails, ...] = ()
    particles: tuple[Particles, ...] = ()
    variance_e2: tuple[Callable[[FloatArray, FloatArray], FloatArray], ...] = ()
    correlation: tuple[Callable[[FloatArray], FloatArray], ...] = ()
    excess: tuple[Callable[[float], Multiplication], ...] = ()

    def collected_s(self, exposure_s: float) -> float:
        """Return the time in which light is collected, given the time that was asked for."""
        return reduce(lambda value, law: law(value), self.exposure_s, exposure_s)

    def leaked_s(self, down: FloatArray, across: FloatArray) -> FloatArray | float:
        """Return the time in which light is collected beside the exposure, at places down and across the frame, 0..1,
        which broadcast."""
        return sum((law(down, across) for law in self.leak_s), 0.0)

    def collect_light(self, electrons: FloatArray) -> FloatArray:
        """Mean electrons of light (rows, cols) as the pixels collect them."""
        return reduce(lambda value, law: law(value), self.collected, electrons)

    def stray_pixels(self, electrons: FloatArray) -> FloatArray:
        """Mean electrons of light of a whole frame (rows, cols) after what misses its pixel fell on the next ones."""
        return reduce(lambda value, law: law.exchange_pixels(value, self.camera), self.strays, electrons)

    def stray_channels(
        self, electrons: Mapping[str, FloatArray], x_um: FloatArray, y_um: FloatArray
    ) -> Mapping[str, FloatArray]:
        """Return the same of each channel at places (..., places) where the light is even over neighbours."""
        return reduce(lambda value, law: law.exchange_channels(value, x_um, y_um), self.strays, electrons)

    def even_dark_e_per_s(self, e_per_s: FloatArray | float, temperature_c: float | None) -> FloatArray | float:
        """Dark current of pixels that aren't defective, given what the camera model says for that temperature."""
        return reduce(lambda value, law: law(value, temperature_c), self.dark_current, e_per_s)

    def dark_e_per_s(self, e_per_s: FloatArray | float, temperature_c: float | None) -> FloatArray | float:
        """Dark current of every pixel, defective ones with their own."""
        shape = self.camera.rows, self.camera.cols
        even = self.even_dark_e_per_s(e_per_s, temperature_c)
        return reduce(lambda value, defects: value + defects.sizes(shape), self.defects, even)

    def otf(self, fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float) -> FloatArray | float:
        """Factor on the transfer function, alike for all colours, without `kernels`."""
        value: FloatArray | float = 1.0
        for law in self.transfer:
            value = value * law(fx_cy_per_um, fy_cy_per_um, wavelength_nm)
        return value

    def move_charge(self, electrons: FloatArray) -> FloatArray:
        """Electrons of a whole frame (rows, cols) where they end up. The frame goes on as its mirror image about the
        outermost pixels' centres, which keeps the mosaic's phases.
        """
        mixed = reduce(
            lambda value, kernel: np.asarray(convolve(value, kernel, mode="mirror")), self.kernels, electrons
        )
        return reduce(lambda value, law: law(value), self.exchange, mixed)

    @property
    def mixes(self) -> bool:
        """Return whether charge moves between neighbouring pixels."""
        return bool(self.kernels or self.exchange or self.trails)

    def part_greens(self, electrons: Mapping[str, FloatArray], x_um: FloatArray, y_um: FloatArray) -> FloatArray:
        """By how much green pixels on red rows have more light than those on blue rows (..., places)."""
        return sum((law.part_greens(electrons, x_um, y_um) for law in self.strays), np.zeros(1))

    def overflow_wells(self, electrons: FloatArray) -> FloatArray:
        """Mean electrons of a whole frame after what is above the full well has run over."""
        return reduce(lambda value, law: law(value), self.overflow, electrons)

    def clock_out(self, electrons: FloatArray, margins: Margins = NO_MARGINS) -> FloatArray:
        """Mean electrons of a whole frame (rows, cols) as they arrive at the output: rows first, then columns.
        `margins`: of the frame. A packet leaves no more behind than one of a full well does, and five standard
        deviations of its shot noise, above which pixels stay saturated."""
        if not self.trails:
            return electrons
        full_e = self.camera.full_well_e
        held = np.minimum(electrons, full_e + 5.0 * math.sqrt(full_e))
        return reduce(lambda value, law: law.clock(value, margins.lines[law.axis]), self.trails, held)

    def clock_profile(self, axis: Literal[0, 1], profile: FloatArray, margins: Margins) -> FloatArray:
        """Return the means of all lines of a frame along an axis, margins included, given those of the active lines
        (n,), none elsewhere. Each law is linear in the packets, and so in their means."""
        lines = margins.lines[axis]
        laws = (replace(law, axis=0) for law in self.trails if law.axis == axis)
        return np.asarray(
            reduce(lambda value, law: law.clock(value, lines), laws, np.pad(profile, lines)[:, None])[:, 0]
        )

    def _transfers(self, place_um: tuple[float, float]) -> list[float]:
        """How often a packet of a place is transferred by each of `trails`."""
        transfers = []
        for law in self.trails:
            lines, at_um = ((self.camera.rows, place_um[1]), (self.camera.cols, place_um[0]))[law.axis]
            line = np.clip(at_um / self.camera.pixel_pitch_um + 0.5 * (lines - 1), 0.0, lines - 1.0)
            transfers.append(float(law.transfers(np.asarray(line), lines)))
        return transfers

    def trail_otf(
        self, fx_cy_per_px: FloatArray, fy_cy_per_px: FloatArray, place_um: tuple[float, float]
    ) -> ComplexArray | float:
        """Return the transfer function of `trails` at a place."""
        value: ComplexArray | float = 1.0
        for law, transfers in zip(self.trails, self._transfers(place_um), strict=True):
            value = value * law.otf(fx_cy_per_px, fy_cy_per_px, transfers)
        return value

    def trail_kernels(self, place_um: tuple[float, float]) -> list[FloatArray]:
        """Where the charge of a pixel at a place ends up by each of `trails`, (odd, odd)."""
        return [law.kernel(n) for law, n in zip(self.trails, self._transfers(place_um), strict=True)]

    def read_combs(self, axis: Literal[0, 1], step: int) -> FloatArray:
        """Electrons (step, lines) that are read of the lines along an axis of the frame, given one electron in each
        line of one phase of a mosaic of this period."""
        lines = (self.camera.rows, self.camera.cols)[axis]
        return read_combs(tuple(law for law in self.trails if law.axis == axis), lines, step)

    def multiplication(self, gain_db: float) -> Multiplication:
        """Random multiplication of each electron at a gain setting; of several in turn the factors multiply."""
        acting = [law(gain_db) for law in self.excess]
        if len(acting) <= 1:
            return acting[0] if acting else NO_MULTIPLICATION
        return replace(acting[0], excess=math.prod(register.excess for register in acting))

    def hold_lag(self, electrons: FloatArray) -> FloatArray | float:
        """Return how many of a frame's electrons aren't read but stay for the next frame: image lag."""
        return sum((law(electrons) for law in self.lag), 0.0)

    def shot_e2(self, electrons: FloatArray) -> FloatArray:
        """Variance of the shot noise at mean signals, in e^2."""
        return reduce(lambda value, law: law(electrons, value), self.variance_e2, electrons)

    def neighbour_correlation(self, electrons: FloatArray) -> FloatArray:
        """Correlation (5, ...) of a pixel's shot noise with each neighbour, by kind (`NEIGHBOURS`)."""
        return sum((law(electrons) for law in self.correlation), np.zeros((len(NEIGHBOURS), *np.shape(electrons))))


class Disturbance(Protocol):
    """Signal that read-out adds to the pixels of a frame, drawn anew in each: how it is drawn, and its moments."""

    def draw(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Electrons of one frame; they broadcast to `shape`."""

    def mean_e(self, shape: tuple[int, ...]) -> FloatArray | float:
        """Mean of what is drawn, pixel by pixel."""

    def variance_e2(self, shape: tuple[int, ...]) -> FloatArray | float:
        """Temporal variance of what is drawn, pixel by pixel."""


@dataclass(frozen=True)
class PatternNoise:
    """Offsets that stand in every frame, and noise beside them, of rows (rows, 1), of columns (1, cols) or of pixels: a
    `Disturbance`.
    """

    offset_e: FloatArray | float
    added_e2: FloatArray | float

    def surrounded(self, margins: Margins, shape: tuple[int, int]) -> PatternNoise:
        """Return it in frames with margins around an active area of that shape: these have neither."""
        return PatternNoise(margins.embed(self.offset_e, *shape), margins.embed(self.added_e2, *shape))

    def draw(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Draw the offsets of one frame, in electrons."""
        if not np.any(self.added_e2):
            return np.asarray(self.offset_e)
        return np.asarray(self.offset_e + np.sqrt(self.added_e2) * rng.standard_normal(shape))

    def mean_e(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the offsets of every pixel."""
        return np.broadcast_to(self.offset_e, shape)

    def variance_e2(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the variance of every pixel beside the read noise's."""
        return np.broadcast_to(self.added_e2, shape)


@dataclass(frozen=True)
class SharedNoise:
    """Noise that pixels of a line share with those of the next one: a `Disturbance`. `shared_e2` (lines,): the
    covariance of each line with the next; `axis`: 0 of rows, 1 of columns.
    """

    shared_e2: FloatArray
    axis: int

    def draw(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Draw the noise of one frame, in electrons."""
        scale = np.sqrt(self.shared_e2)
        shared = np.moveaxis(rng.standard_normal(shape), self.axis, 0) * scale[:, None]
        shared[-1] = 0.0  # no line follows the last one
        return np.moveaxis(shared + np.roll(shared, 1, axis=0), 0, self.axis)

    def mean_e(self, shape: tuple[int, ...]) -> float:
        """None."""
        return 0.0

    def variance_e2(self, shape: tuple[int, ...]) -> FloatArray:
        """Return what both neighbours share with each line."""
        shared_e2 = np.append(self.shared_e2[:-1], 0.0)
        line = shared_e2 + np.roll(shared_e2, 1)
        return np.broadcast_to(line[:, None] if self.axis == 0 else line[None, :], shape)


#: Pixels along a row to either side of which read noise depends on each other, and the grid of its spectrum.
READ_REACH, READ_GRID = 12, 256


@dataclass(frozen=True)
class Signal(State):
    """State of the electrons' read-out, up to the converter.

    `response`: electrons -> electrons, point by point; none stay none. `gains`: (row, col in px, which broadcast) ->
    factor on what is read, noise alike, of mean 1 over the frame, as levels don't ask it. `line_gains`: the same of
    lines, at random. `amplifiers`: how areas that are read at the same time couple. `offset_dn`: (elapsed_s,
    sensor temperature) -> DN added to the black level; `exposure_offset_dn`: exposure_s -> the same. `noise_e2`:
    elapsed_s -> variance of every pixel beside the read noise's. `lines`: noise that rows or columns share.
    `reading_order`: noise in the order in which pixels are read.
    `telegraph`: pixels that jump between two levels. `disturbances`: signals that are added at random. `filters`:
    kernels (odd, odd) of sum 1 that the chip runs over each colour's plane, signal and noise alike, before rounding.
    `read_spectrum`: frequency along the row in cycles per pixel, 0 to 0.5 -> factor on the read noise's power, of mean
    1, as the camera states its variance.
    """

    response: tuple[Callable[[FloatArray], FloatArray], ...] = ()
    gains: tuple[Callable[[FloatArray, FloatArray], FloatArray], ...] = ()
    line_gains: tuple[LineGains, ...] = ()
    amplifiers: tuple[CoupledAmplifiers, ...] = ()
    offset_dn: tuple[Callable[[float, float | None], float], ...] = ()
    exposure_offset_dn: tuple[Callable[[float], float], ...] = ()
    noise_e2: tuple[Callable[[float], float], ...] = ()
    lines: tuple[LineNoise, ...] = ()
    reading_order: tuple[ReadOutNoise, ...] = ()
    telegraph: tuple[Jumps, ...] = ()
    disturbances: tuple[Disturbance, ...] = ()
    filters: tuple[FloatArray, ...] = ()
    read_spectrum: tuple[Callable[[FloatArray], FloatArray], ...] = ()

    def read(self, electrons: FloatArray) -> FloatArray:
        """Apply the read-out's responses to signals in electrons, point by point."""
        return reduce(lambda value, law: law(value), self.response, electrons)

    def gain_map(self, shape: tuple[int, int]) -> FloatArray | None:
        """Factor (rows, cols) on what is read of every pixel; None where no law says one."""
        if not (self.gains or self.line_gains):
            return None
        row, col = np.arange(float(shape[0]))[:, None], np.arange(float(shape[1]))[None, :]
        areas = reduce(lambda value, law: value * law(row, col), self.gains, np.ones(shape))
        return reduce(lambda value, law: value * law.factors(shape), self.line_gains, areas)

    def couple(self, electrons: FloatArray) -> FloatArray:
        """Return what amplifiers read of the signals of a whole frame (rows, cols)."""
        return reduce(lambda value, law: law.couple(value), self.amplifiers, electrons)

    def couple_variances(self, variance_e2: FloatArray) -> FloatArray:
        """Return the variances of what they read, of independent signals (rows, cols)."""
        return reduce(lambda value, law: law.couple_variances(value), self.amplifiers, variance_e2)

    def couple_noise(self, noise_e: FloatArray) -> FloatArray:
        """Return the read noise (rows, cols) after it was coupled, where it is."""
        return reduce(lambda value, law: law.couple(value) if law.of_noise else value, self.amplifiers, noise_e)

    def shift_dn(self, elapsed_s: float, temperature_c: float | None, exposure_s: float) -> float:
        """DN added to the black level."""
        by_exposure = sum((law(exposure_s) for law in self.exposure_offset_dn), 0.0)
        return by_exposure + sum((law(elapsed_s, temperature_c) for law in self.offset_dn), 0.0)

    def changing_e2(self, elapsed_s: float) -> float:
        """Variance of every pixel beside the read noise's at a time after the first capture, e^2."""
        return sum((law(elapsed_s) for law in self.noise_e2), 0.0)

    @property
    def random(self) -> tuple[Disturbance, ...]:
        """Everything that is drawn anew in each frame, but for `noise_e2`."""
        jumps = (Telegraph(jumps) for jumps in self.telegraph)
        return (*self.lines, *self.reading_order, *jumps, *self.disturbances)

    def random_at(self, elapsed_s: float) -> tuple[Disturbance, ...]:
        """Everything that is drawn anew in the frame taken at a time after the first capture."""
        return (*self.random, PatternNoise(0.0, self.changing_e2(elapsed_s))) if self.noise_e2 else self.random

    def read_power(self, frequency_cy_per_px: FloatArray) -> FloatArray:
        """Factor on the read noise's power at frequencies along the row."""
        return reduce(
            lambda value, law: value * law(frequency_cy_per_px),
            self.read_spectrum,
            np.ones(np.shape(frequency_cy_per_px)),
        )

    def read_kernel(self) -> FloatArray | None:
        """Kernel (2 `READ_REACH` + 1,) along the row that makes read noise of white noise; None for none."""
        if not self.read_spectrum:
            return None
        power = self.read_power(np.asarray(np.fft.rfftfreq(READ_GRID), float))
        kernel = np.roll(np.fft.irfft(np.sqrt(np.maximum(power, 0.0)), READ_GRID), READ_REACH)[: 2 * READ_REACH + 1]
        return np.asarray(kernel / np.sqrt(np.sum(np.square(kernel))))

    def filter_kernel(self) -> FloatArray | None:
        """Kernel of all filters, one after the other; None for none."""
        if len(self.filters) > 1:
            from scipy.signal import convolve2d  # here: the library takes a while to load

            return np.asarray(reduce(convolve2d, self.filters))
        return self.filters[0] if self.filters else None


@dataclass(frozen=True)
class Telegraph:
    """Random telegraph noise: each pixel of `jumps` is read with +(1 - p) A in a share p of the frames, else with -p A,
    anew in every frame.
    """

    jumps: Jumps

    def draw(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Electrons (rows, cols) of one frame."""
        jump, pixels = np.zeros(shape), self.jumps.pixels(shape)
        share = self.jumps.high_share
        jump.flat[pixels] = self.jumps.sizes(shape).flat[pixels] * ((rng.random(pixels.size) < share) - share)
        return jump

    def mean_e(self, shape: tuple[int, ...]) -> float:
        """None."""
        return 0.0

    def variance_e2(self, shape: tuple[int, ...]) -> FloatArray:
        """p (1 - p) A^2 in these pixels."""
        share = self.jumps.high_share
        return np.asarray(share * (1.0 - share) * self.jumps.sizes(shape) ** 2)


@dataclass(frozen=True)
class Codes(State):
    """`codes`: level in DN before rounding -> what the converter makes of it."""

    codes: tuple[Callable[[FloatArray], FloatArray], ...] = ()

    def convert(self, dn: FloatArray) -> FloatArray:
        """Levels in DN after the converter, before rounding."""
        return reduce(lambda value, law: law(value), self.codes, dn)


def kernel_otf(kernel: FloatArray, fx_cy_per_px: FloatArray, fy_cy_per_px: FloatArray) -> FloatArray | ComplexArray:
    """Compute the transfer function sum_ij k_ij exp(-2 pi i (fx (j - c) + fy (i - c))) of a kernel.

    kernel : (odd, odd); fx_cy_per_px, fy_cy_per_px : arrays that broadcast, cycles per px

    Returns the transfer function, real where the kernel is symmetric.

    >>> kernel_otf(np.array([[0.25, 0.5, 0.25]]), np.array([0.0, 0.5]), np.zeros(2)).tolist()  # cos^2(pi f)
    [1.0, 0.0]
    """
    half = kernel.shape[0] // 2, kernel.shape[1] // 2
    even = np.array_equal(kernel, kernel[::-1, ::-1])
    total: FloatArray | ComplexArray = np.zeros(np.broadcast_shapes(np.shape(fx_cy_per_px), np.shape(fy_cy_per_px)))
    for (i, j), weight in np.ndenumerate(kernel):
        down, right = i - half[0], j - half[1]
        if weight == 0.0 or (even and (down, right) < (0, 0)):
            continue
        turn = 2.0 * np.pi * (fx_cy_per_px * right + fy_cy_per_px * down)
        twice = 2.0 if even and (down, right) != (0, 0) else 1.0
        total = total + (twice * weight * np.cos(turn) if even else weight * np.exp(-1j * turn))
    return total


class Acts(Protocol):
    """Interface of an effect to the chain: `sim.effects.base.Effect` says when to write which method."""

    def on_light(self, light: Light) -> Light: ...

    def on_image(self, image: Image) -> Image: ...

    def on_charge(self, charge: Charge) -> Charge: ...

    def on_signal(self, signal: Signal) -> Signal: ...

    def on_codes(self, codes: Codes) -> Codes: ...


def light_of(camera: CameraModel, effects: Iterable[Acts]) -> Light:
    """Return the light's state with all that effects add."""
    return reduce(lambda state, effect: effect.on_light(state), effects, Light(camera))


def image_of(camera: CameraModel, effects: Iterable[Acts]) -> Image:
    """Return the image's."""
    return reduce(lambda state, effect: effect.on_image(state), effects, Image(camera))


def charge_of(camera: CameraModel, effects: Iterable[Acts]) -> Charge:
    """Return the charge's."""
    return reduce(lambda state, effect: effect.on_charge(state), effects, Charge(camera))


def signal_of(camera: CameraModel, effects: Iterable[Acts]) -> Signal:
    """Return the signal's."""
    return reduce(lambda state, effect: effect.on_signal(state), effects, Signal(camera))


def codes_of(camera: CameraModel, effects: Iterable[Acts]) -> Codes:
    """Return the codes'."""
    return reduce(lambda state, effect: effect.on_codes(state), effects, Codes(camera))


def laws_of(camera: CameraModel, effects: Iterable[Acts]) -> frozenset[str]:
    """Return which quantities effects change, as `stage.field`."""
    acting = tuple(effects)
    states = (f(camera, acting) for f in (light_of, image_of, charge_of, signal_of, codes_of))
    return frozenset().union(*(state.list_laws() for state in states))
