"""The entry for whole frames: from a scene to mean electrons, moments, and frames drawn at random.

    radiance -> lens: irradiance factor, transmittance, fall-off -> blur -> quantum efficiency by
    mosaic -> electrons + dark current
    -> charge between pixels, full well -> shot noise -> read-out -> codes

Effects act on the stages (`sim.stages`); without effects, or with effects at their absent values, the result is the
baseline bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim.camera import CameraModel
from sim.detection import efficiency
from sim.effects.base import Effect
from sim.optics.illumination import irradiance_factor, relative_illumination
from sim.optics.imaging import TracedLens
from sim.plain_image import KeptTransfers as KeptTransfers  # noqa: PLC0414  whoever draws many scenes hands one to `scene_light`
from sim.plain_image import plain_images
from sim.scene.scenes import Darkness, Scene, SpectralImage
from sim.sensor import electrons as sensor
from sim.sensor import mosaic
from sim.sensor.electrons import Amplifiers, FixedPattern, ReadOut
from sim.sensor.margins import NO_MARGINS, Margins
from sim.spectrum import FloatArray, Spectrum
from sim.stages import Image, PatternNoise, charge_of, codes_of, image_of, laws_of, light_of, signal_of
from sim.traced_image import traced_image
from sim.uniform import Uniform


@dataclass(frozen=True)
class Exposure:
    """One exposure of a scene. `gain_db` is the analogue gain; `elapsed_s` the time after the session's first capture.
    Effects may depend on it and on the sensor's `temperature_c`, with which the dark current doubles as the camera
    model says. `magnification` of the scene dims the image as in ISET: pi / (1 + 4 N^2 (1 + |m|)^2); its blur stays
    that of `Lens.f_number`. `placed` matters to traced lenses, whose distortion moves the light: a scene's px are those
    of the ideal camera, or those of the image (a recording's corners), where the distortion is in them already.
    """

    scene: Scene
    exposure_s: float
    gain_db: float = 0.0
    temperature_c: float | None = None
    elapsed_s: float = 0.0
    magnification: float = 0.0
    placed: Literal["ideal", "image"] = "ideal"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.exposure_s) and self.exposure_s >= 0):
            raise ValueError(f"exposure {self.exposure_s} s is below the limit of 0 s or not finite: give seconds")


def expected_electrons(
    camera: CameraModel,
    exposure: Exposure,
    effects: Sequence[Effect] = (),
    *,
    oversample: int = 3,
    margin_px: int = 32,
    source: float = 1.0,
    margins: Margins = NO_MARGINS,
) -> FloatArray:
    """Mean electrons (rows, cols) of every pixel, light and dark current, after the effects on charge; not yet clipped.

    Scenes that aren't uniform or straight edges are drawn by area on `oversample` x `oversample` samples a pixel, with
    `margin_px` around the frame, and blurred channel by channel with the channel's transfer function. The light beyond
    the margin is taken as the scene's other end. On random cells of 2 px at f/4 and 3 um pixels, 2, 3, 4, 6 samples a
    pixel leave
    0.6, 0.2, 0.1, 0.05 % of white rms; a frame of 480 x 640 takes 0.5, 1.1, 2.4 s of one core at 2, 3, 4. Cells of a
    whole number of pixels whose borders are the pixels' alias alike all over the frame: at s samples a pixel an
    amplitude at f cy/px is drawn too high by (pi f / s)^2 / 3 along each axis, 3 % at 0.3 cy/px and 3 samples.
    `source`: factor on the scene's light, such as `unsteady_source` of the frame that is drawn. `margins`: around the
    active area in the frame that is returned.
    """
    check_overlap(camera, exposure.scene)
    light = scene_light(
        camera, exposure.scene, effects, oversample=oversample, margin_px=margin_px, placed=exposure.placed
    )
    return collect_electrons(light, camera, exposure, effects, source=source, margins=margins)


def unsteady_source(camera: CameraModel, effects: Sequence[Effect], elapsed_s: float) -> float:
    """Factor on the scene's light in the one frame that is taken at a time, of mean 1; 1 where the source is steady."""
    return light_of(camera, effects).unsteady(elapsed_s)


@dataclass(frozen=True, eq=False)
class SceneLight:
    """Electrons a second that light makes in every pixel, (rows, cols): of the scene, and of the room beside it."""

    scene: FloatArray
    room: FloatArray | float = 0.0


def scene_light(
    camera: CameraModel,
    scene: Scene,
    effects: Sequence[Effect] = (),
    *,
    oversample: int = 3,
    margin_px: int = 32,
    placed: Literal["ideal", "image"] = "ideal",
    transfers: KeptTransfers | None = None,
) -> SceneLight:
    """Return the part of `expected_electrons` that no exposure changes, and that takes nearly all its time."""
    shape = camera.rows, camera.cols
    if isinstance(scene, Darkness):
        return SceneLight(np.zeros(shape))
    row, col = np.arange(camera.rows, dtype=np.float64)[:, None], np.arange(camera.cols, dtype=np.float64)[None, :]
    if isinstance(camera.lens.imaging, TracedLens):
        traced = traced_image(camera, camera.lens.imaging.table, scene, effects, oversample, margin_px, placed)
        images = dict.fromkeys(camera.channels, traced)
        shade: FloatArray = np.ones(shape)
    else:
        images = plain_images(camera, scene, effects, oversample, margin_px, transfers)
        shade = relative_illumination(camera, row, col)
    before_lens, image_state = light_of(camera, effects), image_of(camera, effects)
    x_um: FloatArray = (col - 0.5 * (camera.cols - 1)) * camera.pixel_pitch_um
    y_um: FloatArray = (row - 0.5 * (camera.rows - 1)) * camera.pixel_pitch_um
    uniform = Uniform(camera, effects)
    shade = uniform.shade_light(shade, x_um, y_um)
    images = {channel: _scatter_light(image, image_state, shade) for channel, image in images.items()}
    if uniform.has_patterns and (light := _brightest_light(scene)) is not None:
        # of scenes with several lights it is that of the brightest
        images = {c: image * uniform.pattern(c, light, scene.kind, x_um, y_um) for c, image in images.items()}
    if not before_lens.ambient_e_per_s:
        return SceneLight(mosaic.assemble(images, camera.cfa))
    room = {channel: np.full(shape, before_lens.ambient(channel)) for channel in camera.channels}
    return SceneLight(mosaic.assemble(images, camera.cfa), mosaic.assemble(room, camera.cfa))


def collect_electrons(
    light: SceneLight,
    camera: CameraModel,
    exposure: Exposure,
    effects: Sequence[Effect] = (),
    *,
    source: float = 1.0,
    margins: Margins = NO_MARGINS,
) -> FloatArray:
    """`expected_electrons` of a scene whose light is known. `source`: factor on the scene's light at this time, beside
    the effects'. Light of the room is collected as long as the source's: for the time that the shutter is really
    open. `margins`: of the frame that is returned; neighbours and full wells act within the active area alone.
    """
    before_lens, charge = light_of(camera, effects), charge_of(camera, effects)
    source *= before_lens.source(exposure.elapsed_s)
    if exposure.magnification != 0.0:
        source *= irradiance_factor(camera.lens.f_number, exposure.magnification) / irradiance_factor(
            camera.lens.f_number
        )
    mean: FloatArray = light.scene * source  # an array of its own: what follows writes into it
    if before_lens.level_by_channel:
        for channel, places in mosaic.phases(camera.cfa).items():
            for row, col in places:
                step = mosaic.step(camera.cfa)
                mean[row::step, col::step] *= before_lens.colour(channel, exposure.elapsed_s)
    rows = before_lens.row_factors(camera.rows, exposure.exposure_s, exposure.elapsed_s)
    if rows is not None:
        mean *= rows[:, None]
    if isinstance(light.room, np.ndarray) or light.room:
        mean += light.room
    down, across = np.linspace(0.0, 1.0, camera.rows)[:, None], np.linspace(0.0, 1.0, camera.cols)[None, :]
    mean *= charge.collected_s(exposure.exposure_s) + charge.leaked_s(down, across)
    np.add(charge.collect_light(charge.stray_pixels(mean)), dark_electrons(camera, exposure, effects), out=mean)
    held = charge.overflow_wells(charge.move_charge(mean))
    if margins != NO_MARGINS:
        held = margins.surround(held, masked=_even_dark_electrons(camera, exposure, effects))
    return charge.clock_out(held, margins)


@dataclass(frozen=True, eq=False)
class Kept:
    """Mean electrons (rows, cols) that pixels keep when a frame has been read: `lag_e` are read with the next, and
    `trapped_e` are in each kind of traps. `end_s`: end of its exposure, after the first capture.
    """

    lag_e: FloatArray | float = 0.0
    trapped_e: tuple[FloatArray, ...] = ()
    end_s: float = 0.0


EMPTY = Kept()


def read_electrons(
    collected: FloatArray, camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = (), kept: Kept = EMPTY
) -> tuple[FloatArray, Kept]:
    """Return the electrons that a frame reads, and what the pixels keep afterwards.

    collected : mean electrons a pixel (rows, cols) that this exposure makes
    kept : by the frame before
    """
    charge = charge_of(camera, effects)
    if not (charge.lag or charge.traps):
        return collected, EMPTY
    since_s, total, held = exposure.elapsed_s - kept.end_s, collected + kept.lag_e, []
    empty: FloatArray = np.zeros(collected.shape)
    for traps, trapped_e in zip(charge.traps, kept.trapped_e or (empty,) * len(charge.traps), strict=True):
        released_e, left_e = traps.release(trapped_e, since_s, exposure.exposure_s)
        total = total + released_e
        held.append(left_e)
    lag_e = charge.hold_lag(np.minimum(total, camera.full_well_e))
    read = total - lag_e
    held_well = np.minimum(read, camera.full_well_e)
    filled = (traps.fill(e, held_well) for e, traps in zip(held, charge.traps, strict=True))
    return read, Kept(lag_e, tuple(filled), exposure.elapsed_s + exposure.exposure_s)


def is_steady(camera: CameraModel, effects: Sequence[Effect]) -> bool:
    """Return whether the light is the same in all frames of one setting, whenever they are taken."""
    light = light_of(camera, effects)
    return not light.level and not light.level_by_channel and not light.rows


def grows_with_exposure(camera: CameraModel, effects: Sequence[Effect]) -> bool:
    """Return whether mean electrons are in proportion to the exposure that is asked for."""
    return not laws_of(camera, effects) & {
        "charge.exposure_s",
        "charge.leak_s",
        "light.rows",
        "charge.overflow",
        "light.unsteadiness",
    }


def screen_light(
    camera: CameraModel, share: FloatArray, x_um: FloatArray, y_um: FloatArray, effects: Sequence[Effect]
) -> FloatArray:
    """Light of a screen, 0..1 of its lit state, where a pattern asks for `share` (rows, cols); places on the sensor in
    equal steps (um from its centre).
    """
    return light_of(camera, effects).show_share(share, x_um, y_um)


def with_reflections(camera: CameraModel, image: FloatArray, effects: Sequence[Effect]) -> FloatArray:
    """Return a channel's whole image (rows, cols), in any unit, with what the lens makes of it as a whole, such as a
    reflection of it.
    """
    return image_of(camera, effects).with_copies(image)


def collected_mosaic(
    camera: CameraModel, electrons: FloatArray, effects: Sequence[Effect], *, exposure_s: float, elapsed_s: float
) -> FloatArray:
    """Mean electrons (rows, cols) of light, in frames of any size, as pixels collect and share them, before they are
    clocked out."""
    rows = light_of(camera, effects).row_factors(len(electrons), exposure_s, elapsed_s)
    charge = charge_of(camera, effects)
    return charge.move_charge(charge.collect_light(electrons if rows is None else electrons * rows[:, None]))


def pair_gain_factor(camera: CameraModel, effects: Sequence[Effect]) -> float:
    """Factor on the right camera's signal over the left one's in a scene that both see, against what their own captures
    of uniform light say.
    """
    return float(np.prod(light_of(camera, effects).pair_gain))


def right_delay_s(camera: CameraModel, effects: Sequence[Effect]) -> float:
    """By how much the right camera of a pair captures later than the left one."""
    return sum(light_of(camera, effects).pair_delay_s, 0.0)


def check_overlap(camera: CameraModel, scene: Scene) -> None:
    """Raises ValueError for a scene that sheds light, none of which any channel can see: most likely a unit was
    mistaken.
    """
    shining = [light for light in _lights_of(scene) if max(light.value) > 0]
    sensitive = [_span_nm([efficiency(camera, channel)]) for channel in camera.channels]
    lit = _span_nm(shining)
    if shining and all(min(high, lit[1]) <= max(low, lit[0]) for low, high in sensitive):
        low, high = min(span[0] for span in sensitive), max(span[1] for span in sensitive)
        raise ValueError(
            f"the scene's light lies at {lit[0]:g} to {lit[1]:g} nm, outside the limits {low:g} to {high:g} nm of the "
            "quantum efficiency: give wavelengths in nm, or a curve that reaches the light"
        )


def _lights_of(scene: Scene) -> list[Spectrum]:
    """Return the spectra of a scene's lights."""
    if isinstance(scene, SpectralImage):
        brightest = np.max(scene.radiance.reshape(-1, scene.radiance.shape[2]), axis=0)
        return [Spectrum.of(scene.wavelength_nm, brightest)]
    lights = [value for item in vars(scene).values() for value in (item if isinstance(item, tuple) else (item,))]
    return [light for light in lights if isinstance(light, Spectrum)]


def _brightest_light(scene: Scene) -> Spectrum | None:
    """Return the light of the highest radiance at any wavelength; None of a scene without light."""
    return max(_lights_of(scene), key=lambda light: max(light.value), default=None)


def _span_nm(curves: Sequence[Spectrum]) -> tuple[float, float]:
    """Between which wavelengths any of some curves is above 0."""
    low, high = np.inf, -np.inf
    for curve in curves:
        wavelength_nm, value = curve.arrays
        above = np.flatnonzero(value > 0)
        if above.size:
            low = min(low, float(wavelength_nm[max(above[0] - 1, 0)]))
            high = max(high, float(wavelength_nm[min(above[-1] + 1, value.size - 1)]))
    return low, high


def check_not_saturated(camera: CameraModel, exposure: Exposure, electrons: FloatArray) -> None:
    """Raises ValueError where an exposure saturates every pixel: nothing of the scene would be left in the frame.

    `electrons`: of `expected_electrons`. The limit is the full well, or what the converter reads at the gain.
    (The physics of clipping is in `predict_frame` and `sample` all the same: whoever simulates calls this first.)
    """
    limit = sensor.capacity_e(camera, exposure.gain_db)
    darkest = float(np.min(electrons))
    if darkest >= limit:
        raise ValueError(
            f"exposure {exposure.exposure_s:g} s saturates all pixels: the darkest collects {darkest:.4g} e, and the "
            f"limit is {limit:.4g} e at {exposure.gain_db:g} dB; expose "
            f"{0.5 * exposure.exposure_s * limit / darkest:.2g} s, lower the gain or dim the light"
        )


def dark_electrons(
    camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = (), margins: Margins = NO_MARGINS
) -> FloatArray | float:
    """Mean electrons of the dark current in one exposure, at its temperature; (rows, cols) where effects, or `margins`,
    tell pixels apart.
    """
    rate: FloatArray | float = sensor.dark_current_e_per_s(camera, exposure.temperature_c)
    found = charge_of(camera, effects).dark_e_per_s(rate, exposure.temperature_c) * exposure.exposure_s
    if margins == NO_MARGINS:
        return found
    active: FloatArray = np.broadcast_to(found, (camera.rows, camera.cols))
    return margins.surround(active, masked=_even_dark_electrons(camera, exposure, effects))


def _even_dark_electrons(camera: CameraModel, exposure: Exposure, effects: Sequence[Effect]) -> float:
    """Return the mean electrons of the dark current of a masked pixel: the median of those that aren't defective."""
    rate: FloatArray | float = sensor.dark_current_e_per_s(camera, exposure.temperature_c)
    even = charge_of(camera, effects).even_dark_e_per_s(rate, exposure.temperature_c)
    return float(np.median(even)) * exposure.exposure_s


def moments(
    camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = (), *, oversample: int = 3, margin_px: int = 32
) -> tuple[FloatArray, FloatArray]:
    """`predict_frame` (DN) and `variance` (DN^2) at the price of one."""
    electrons = expected_electrons(camera, exposure, effects, oversample=oversample, margin_px=margin_px)
    return sensor.dn_moments(electrons, camera, exposure.gain_db, read_out(camera, exposure, effects))


def predict_frame(
    camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = (), *, oversample: int = 3, margin_px: int = 32
) -> FloatArray:
    """Mean frame (rows, cols) in DN of a camera whose pixels are all alike; clipping and rounding are averaged over
    noise.
    """
    return moments(camera, exposure, effects, oversample=oversample, margin_px=margin_px)[0]


def variance(
    camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = (), *, oversample: int = 3, margin_px: int = 32
) -> FloatArray:
    """Temporal variance (rows, cols) in DN^2: shot, read and row noise, the effects' own, clipping, and rounding."""
    return moments(camera, exposure, effects, oversample=oversample, margin_px=margin_px)[1]


def sample(
    camera: CameraModel,
    exposure: Exposure,
    rng: np.random.Generator,
    effects: Sequence[Effect] = (),
    fixed_pattern: FixedPattern | None = None,
    *,
    oversample: int = 3,
    margin_px: int = 32,
    margins: Margins = NO_MARGINS,
) -> NDArray[np.uint16]:
    """One raw frame (rows, cols) drawn from the model. `fixed_pattern` None: pixels that are all alike. `margins`: of
    the frame, and of the fixed pattern.

    For many frames of one scene take `expected_electrons` once and draw with `sim.sensor.electrons.sample_from`.
    """
    return sensor.sample_from(
        expected_electrons(
            camera,
            exposure,
            effects,
            oversample=oversample,
            margin_px=margin_px,
            source=unsteady_source(camera, effects, exposure.elapsed_s),
            margins=margins,
        ),
        camera,
        rng,
        fixed_pattern,
        dark_electrons=dark_electrons(camera, exposure, effects, margins),
        gain_db=exposure.gain_db,
        read_out=read_out(camera, exposure, effects, margins),
    )


def expect_sequence(
    camera: CameraModel,
    exposures: Iterable[Exposure],
    effects: Sequence[Effect] = (),
    *,
    oversample: int = 3,
    margin_px: int = 32,
    drawn: bool = False,
) -> Iterator[FloatArray]:
    """Mean electrons (rows, cols) that are read in each exposure of a sequence, one after the other: charge that
    isn't read with a frame (image lag) is read with the next, and traps release theirs over those that follow. The
    first follows empty pixels; an exposure that is the same object as the one before is drawn once.

    Drawing every frame's electrons from these means on their own is exact: of Poisson electrons that are told apart one
    by one, those read and those that stay are independent Poisson variables. `drawn`: of frames with an unsteady
    source's light as it was in each, not of its mean.
    """
    before: Exposure | None = None
    new: FloatArray = np.zeros(())
    kept = EMPTY
    for exposure in exposures:
        if exposure is not before:
            source = unsteady_source(camera, effects, exposure.elapsed_s) if drawn else 1.0
            new = expected_electrons(
                camera, exposure, effects, oversample=oversample, margin_px=margin_px, source=source
            )
            before = exposure
        read, kept = read_electrons(new, camera, exposure, effects, kept)
        yield read


def sample_sequence(
    camera: CameraModel,
    exposures: Iterable[Exposure],
    rng: np.random.Generator,
    effects: Sequence[Effect] = (),
    fixed_pattern: FixedPattern | None = None,
    *,
    oversample: int = 3,
    margin_px: int = 32,
) -> Iterator[NDArray[np.uint16]]:
    """Raw frames (rows, cols) of exposures taken one after the other, drawn as `sample` does from
    `expect_sequence`.
    """
    every = list(exposures)
    means = expect_sequence(camera, every, effects, oversample=oversample, margin_px=margin_px, drawn=True)
    for exposure, electrons in zip(every, means, strict=True):
        yield sensor.sample_from(
            electrons,
            camera,
            rng,
            fixed_pattern,
            dark_electrons=dark_electrons(camera, exposure, effects),
            gain_db=exposure.gain_db,
            read_out=read_out(camera, exposure, effects),
        )


@dataclass(frozen=True)
class _CoupledWithin:
    """Amplifiers that couple the active areas of frames with margins."""

    within: Amplifiers
    margins: Margins

    def _inside(self, law: Callable[[FloatArray], FloatArray], frame: FloatArray) -> FloatArray:
        out = np.array(frame)
        self.margins.active(out)[...] = law(self.margins.active(frame))
        return out

    def couple(self, electrons: FloatArray) -> FloatArray:
        return self._inside(self.within.couple, electrons)

    def couple_variances(self, variance_e2: FloatArray) -> FloatArray:
        return self._inside(self.within.couple_variances, variance_e2)

    def couple_noise(self, noise_e: FloatArray) -> FloatArray:
        return self._inside(self.within.couple_noise, noise_e)


def read_out(
    camera: CameraModel, exposure: Exposure, effects: Sequence[Effect], margins: Margins = NO_MARGINS
) -> ReadOut:
    """Collect the effects' laws of read-out and converter: responses, noise and offsets, one after the other.
    `margins`: of the frames that are read. Areas and patterns of the sensor stay those of its active area, and so do
    the moments of what is added."""
    if not effects:
        return sensor.LINEAR
    charge, signal, codes = charge_of(camera, effects), signal_of(camera, effects), codes_of(camera, effects)
    particles = (law.during(exposure.exposure_s, camera.pixel_pitch_um) for law in charge.particles)
    disturbances = (*signal.random_at(exposure.elapsed_s), *particles)

    def draw_disturbances(shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        return sum((disturbance.draw(shape, rng) for disturbance in of_frame), np.zeros((1, 1)))

    # Only where there is a law something acts, so that effects elsewhere leave the read-out the baseline's to the last
    # bit.
    shape = camera.rows, camera.cols
    of_frame = [
        disturbance.surrounded(margins, shape) if isinstance(disturbance, PatternNoise) else disturbance
        for disturbance in disturbances
    ]
    gain, amplifiers = signal.gain_map(shape), signal if signal.amplifiers else None
    return ReadOut(
        signal.read if signal.response else None,
        charge.shot_e2 if charge.variance_e2 else None,
        signal.shift_dn(exposure.elapsed_s, exposure.temperature_c, exposure.exposure_s),
        draw_disturbances if disturbances else None,
        sum((disturbance.mean_e(shape) for disturbance in disturbances), 0.0),
        sum((disturbance.variance_e2(shape) for disturbance in disturbances), 0.0),
        codes.convert if codes.codes else None,
        charge.neighbour_correlation if charge.correlation else None,
        signal.filter_kernel(),
        gain if gain is None or margins == NO_MARGINS else margins.surround(gain, 1.0, 1.0),
        signal.read_kernel(),
        charge.multiplication(exposure.gain_db),
        amplifiers if amplifiers is None or margins == NO_MARGINS else _CoupledWithin(amplifiers, margins),
    )


def _scatter_light(image: FloatArray, state: Image, shade: FloatArray) -> FloatArray:
    """Return a channel's irradiance with its reflections, the fall-off, and what is scattered evenly. A traced lens's
    image is a mosaic already: colour by colour.
    """
    traced = isinstance(state.camera.lens.imaging, TracedLens)

    def colours(frame: FloatArray) -> list[FloatArray]:
        return list(mosaic.planes(frame, state.camera.cfa).values()) if traced else [frame]

    reflected = image.copy()
    for plane in colours(reflected):
        plane[:] = state.with_copies(plane)
    shaded = reflected * shade
    for plane in colours(shaded):
        plane[:] = state.add_veil(plane)
    return shaded
