"""The hidden truth of the mock bench: what its cameras really are. Known to the bench and to tests, never on a wire.

Each camera does what its data sheet says to within a smooth few per cent. By default the left one conceals two pieces
of physics that a first model leaves out: a birefringent anti-alias filter and an infrared-cut filter; the right one
conceals none. Beyond that there is a little of what no model of ours has (the filter's dispersion, pattern noise of
neighbours that is a little alike), at levels that don't matter. A bench that is told what to conceal conceals that, and
nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation
from scipy.special import expit

from mocks.conceal import OF_THE_RADIOMETER, SIDES, Concealed, check
from sim.camera import CameraModel, Geometry, Lens, Shutter, Side
from sim.effects.base import Effect
from sim.effects.dark_current_temperature import DarkCurrentTemperature
from sim.effects.infrared_cut_filter import InfraredCutFilter
from sim.effects.lamp_ageing import LAMP_LIT, PIVOT_NM, LampAgeing
from sim.effects.optical_low_pass_filter import OpticalLowPassFilter
from sim.effects.shutter_leakage import ShutterLeakage
from sim.effects.source_drift import SETTLES_NEVER_MIN, SourceDrift
from sim.optics.filters import SODIUM_NM
from sim.sensor.electrons import FixedPattern
from sim.sensor.margins import NO_MARGINS, Margins
from sim.spectrum import FloatArray, Spectrum
from sim.stages import ComplexArray, Image, Light, image_of

ROWS, COLS, PITCH_UM = 480, 640, 3.0
#: Distance of the cameras, and from them to where targets stand (mm). Both look at the same point there.
BASELINE_MM, DISTANCE_MM = 60.0, 900.0
#: Every so many degrees the dark current doubles.
DOUBLING_C = 7.0
#: Air at the bench, and by how much a camera's sensor is warmer. The models' dark currents hold there.
AIR_C = 23.0
SELF_HEATING_C: dict[Side, float] = {"left": 8.0, "right": 7.8}


class DispersingLowPassFilter(OpticalLowPassFilter):
    """The anti-alias filter with quartz's dispersion: its displacement is as stated at 589 nm and 4 % more at 440
    nm."""

    def on_image(self, image: Image) -> Image:
        split = image_of(image.camera, (OpticalLowPassFilter(**dict(self)),)).transfer

        def birefringence(nm: float) -> float:  # quartz, fitted to 0.00964 at 400 nm and 0.00904 at 650 nm
            return 0.00867 + 0.000155 / (nm * 1e-3) ** 2

        def transfer(fx: FloatArray, fy: FloatArray, wavelength_nm: float) -> FloatArray | ComplexArray:
            factor = birefringence(wavelength_nm) / birefringence(SODIUM_NM)
            return split[0](fx * factor, fy * factor, wavelength_nm)

        return image.add_laws(transfer=transfer) if split else image


class RipplingInfraredCutFilter(InfraredCutFilter):
    """The infrared-cut filter with the ripple that a coating's pass band has: 0.3 %."""

    def on_image(self, image: Image) -> Image:
        def rippled(wavelength_nm: FloatArray, sin_theta: FloatArray) -> FloatArray:
            return np.asarray(1.0 - 0.0015 * (1.0 + np.cos(2 * np.pi * wavelength_nm / 60.0)))

        return super().on_image(image).add_laws(transmittance=rippled)


class TwoStageWarmUp(SourceDrift):
    """A lamp that warms up in two stages, as lamps do: 6 % of the drift's first slope settles four times as fast as the
    rest. Its end is 4.5 % short of the one time constant's that is stated."""

    def on_light(self, light: Light) -> Light:
        if self.drift_percent_per_min == 0.0 or self.settling_min == SETTLES_NEVER_MIN:
            return super().on_light(light)

        def level(elapsed_s: float) -> float:
            settled = [
                share * settling_min * -float(np.expm1(-elapsed_s / 60.0 / settling_min))
                for share, settling_min in ((0.94, self.settling_min), (0.06, 0.25 * self.settling_min))
            ]
            return 1.0 + self.drift_percent_per_min / 100.0 * sum(settled)

        return light.add_laws(level=level)


class BendingLampAgeing(LampAgeing):
    """A lamp that has aged as absorbers do, more steeply towards the blue: the logarithm of its change bends by 5 % for
    each 100 nm."""

    def on_light(self, light: Light) -> Light:
        def bent(wavelength_nm: FloatArray, radiance: FloatArray, kind: str) -> FloatArray:
            if kind not in LAMP_LIT:
                return radiance
            off = (wavelength_nm - PIVOT_NM) / 100.0
            aged = radiance * np.exp(0.01 * self.reddening_percent * (off - 0.05 * np.square(off)))
            total = float(np.trapezoid(aged, wavelength_nm))
            return radiance if total <= 0.0 else np.asarray(aged * (np.trapezoid(radiance, wavelength_nm) / total))

        return light.add_laws(spectrum=bent) if self.reddening_percent else light


#: How the bench renders effects of the lamp: finer than the laws that a diagnosis fits.
FINER: dict[type[Effect], type[Effect]] = {SourceDrift: TwoStageWarmUp, LampAgeing: BendingLampAgeing}


def _finer(effect: Effect) -> Effect:
    kind = FINER.get(type(effect))
    return effect if kind is None else kind(**dict(effect))


@dataclass(frozen=True, eq=False)
class HiddenCamera:
    """One camera: model and concealed effects, its pixels' pattern, where it stands, and what its maker says.

    A point X of the rig's frame (mm; origin amid the cameras, z forward) is `rotation` (X - `centre_mm`) in the
    camera's. `pattern` is that of whole frames, `margins` around the active area included."""

    model: CameraModel
    effects: tuple[Effect, ...]
    pattern: FixedPattern
    rotation: FloatArray
    centre_mm: FloatArray
    datasheet: Mapping[str, Any]
    margins: Margins = NO_MARGINS

    @property
    def geometry(self) -> Geometry:
        """Pinhole and distortion; every hidden camera has one."""
        assert self.model.geometry is not None
        return self.model.geometry

    @property
    def acting(self) -> tuple[Effect, ...]:
        """The effects that change the camera's frames: all but those of what the radiometer says."""
        return tuple(effect for effect in self.effects if effect.name not in OF_THE_RADIOMETER)


@dataclass(frozen=True, eq=False)
class Truth:
    """Both cameras of the bench."""

    cameras: Mapping[Side, HiddenCamera]

    def stereo(self) -> tuple[FloatArray, FloatArray]:
        """(rotation, translation_mm) from the left camera's frame to the right one's, in OpenCV's convention."""
        left, right = self.cameras["left"], self.cameras["right"]
        rotation = right.rotation @ left.rotation.T
        return rotation, right.rotation @ (left.centre_mm - right.centre_mm)


def makers_efficiency() -> dict[str, Spectrum]:
    """Return the maker's QE curves (electrons a photon, 380..780 nm by 5), without infrared filter.

    >>> list(makers_efficiency())
    ['R', 'G', 'B']
    """
    w = np.arange(380.0, 780.1, 5.0)
    return {channel: Spectrum.of(w, np.round(curve, 4)) for channel, curve in _efficiency(w).items()}


def _efficiency(w: FloatArray) -> dict[str, FloatArray]:
    def bell(centre: float, below: float, above: float) -> FloatArray:
        return np.asarray(np.exp(-0.5 * ((w - centre) / np.where(w < centre, below, above)) ** 2))

    silicon = expit((w - 388.0) / 9.0) * np.clip((1010.0 - w) / 380.0, 0.0, 1.0) ** 0.5
    return {
        "R": silicon
        * (0.56 * expit((w - 583.0) / 8.5) * bell(600.0, 400.0, 210.0) + 0.035 * bell(455.0, 40.0, 45.0) + 0.01),
        "G": silicon * (0.61 * bell(531.0, 33.0, 41.0) + 0.07 * expit((w - 705.0) / 22.0) + 0.015),
        "B": silicon * (0.59 * bell(459.0, 30.0, 34.0) + 0.05 * expit((w - 720.0) / 26.0) + 0.012),
    }


def _true_efficiency(rng: np.random.Generator) -> dict[str, Spectrum]:
    """Return the maker's curves, off by a scale of 2 %, a tilt of 1.5 % and a bend of 0.5 % (one sd each), on 1 nm up
    to 1000 nm."""
    w = np.arange(370.0, 1000.1, 1.0)
    x = (w - 560.0) / 180.0
    curves = {}
    for channel, curve in _efficiency(w).items():
        scale, tilt, bend = rng.normal(0.0, [0.02, 0.015, 0.005])
        # the scale of a curve is limited, so that no seed gives an untypical camera
        factor = 1.0 + np.clip(scale, -0.03, 0.03) + np.clip(tilt, -0.02, 0.02) * x + bend * (x**2 - 0.4)
        curves[channel] = Spectrum.of(w, curve * factor)
    return curves


def _pattern(
    rng: np.random.Generator, shape: tuple[int, int], prnu_percent: float, dsnu_e: float, white: bool
) -> FixedPattern:
    """Pattern noise with the stated standard deviations. White, as the data sheet's figures mean it, or with a tenth of
    the PRNU's variance shared by neighbours and a fiftieth of the DSNU's by columns."""
    independent, shared = (
        rng.standard_normal(shape),
        ndimage.gaussian_filter(rng.standard_normal(shape), 1.0, mode="wrap"),
    )
    dark, columns = rng.standard_normal(shape), rng.standard_normal((1, shape[1]))
    prnu = independent if white else np.sqrt(0.9) * independent + np.sqrt(0.1) * shared / shared.std()
    dsnu = dark if white else np.sqrt(0.98) * dark + np.sqrt(0.02) * columns
    prnu, dsnu = prnu - prnu.mean(), dsnu - dsnu.mean()
    return FixedPattern(prnu=prnu / prnu.std() * prnu_percent / 100.0, dsnu_e=dsnu / dsnu.std() * dsnu_e)


def _shutter(effects: tuple[Effect, ...]) -> Shutter:
    """Rows are exposed one after the other: light that flickers shows as bands. But a store that leaks is there."""
    return "global" if any(isinstance(effect, ShutterLeakage) for effect in effects) else "rolling"


#: Margins of a bench whose cameras have some: masked rows and columns, and overscan behind the last ones.
MARGINS = Margins(masked_rows=(4, 0), masked_cols=(8, 0), overscan_rows=(0, 12), overscan_cols=(0, 16))


def _datasheet(shape: tuple[int, int], shutter: Shutter, margins: Margins) -> dict[str, Any]:
    stated = {} if margins == NO_MARGINS else {"margins": margins.model_dump(exclude_defaults=True)}
    return stated | {
        "rows": shape[0],
        "cols": shape[1],
        "pixel_pitch_um": PITCH_UM,
        "fill_factor": 0.8,
        "cfa": "RGGB",
        "shutter": shutter,
        "bit_depth": 12,
        "black_level_dn": 64.0,
        "white_level_dn": 4095.0,
        "conversion_gain_dn_per_e": 0.4,
        "full_well_e": 9500.0,
        "read_noise_e": 2.5,
        "dark_current_e_per_s": 5.0,
        "dsnu_e": 1.0,
        "prnu_percent": 0.8,
        "f_number": 4.0,
        "focal_length_mm": 6.0,
        "lens_transmittance": 0.92,
        "quantum_efficiency": {
            channel: {"wavelength_nm": list(curve.wavelength_nm), "value": list(curve.value)}
            for channel, curve in makers_efficiency().items()
        },
    }


#: What differs from camera to camera, before the seed's share.
_UNITS: dict[Side, dict[str, float]] = {
    "left": {
        "conversion_gain_dn_per_e": 0.412,
        "read_noise_e": 2.31,
        "dark_current_e_per_s": 5.8,
        "black_level_dn": 64.3,
    },
    "right": {
        "conversion_gain_dn_per_e": 0.395,
        "read_noise_e": 2.64,
        "dark_current_e_per_s": 4.4,
        "black_level_dn": 63.6,
    },
}


def _camera(
    side: Side,
    rng: np.random.Generator,
    effects: tuple[Effect, ...],
    shape: tuple[int, int],
    plain: bool,
    margins: Margins,
) -> HiddenCamera:
    sheet = _datasheet(shape, _shutter(effects), margins)
    rows, cols = shape
    unit = _UNITS[side]
    vary = rng.uniform(0.99, 1.01, 6)
    focal_px = 6.0 / (PITCH_UM * 1e-3) * rng.uniform(0.997, 1.003)
    model = CameraModel(
        rows=rows,
        cols=cols,
        pixel_pitch_um=PITCH_UM,
        fill_factor=sheet["fill_factor"],
        cfa="RGGB",
        shutter=sheet["shutter"],
        bit_depth=12,
        black_level_dn=unit["black_level_dn"],
        white_level_dn=4095.0,
        conversion_gain_dn_per_e=unit["conversion_gain_dn_per_e"] * vary[0],
        full_well_e=9300.0 * vary[1],
        read_noise_e=unit["read_noise_e"] * vary[2],
        dark_current_e_per_s=unit["dark_current_e_per_s"] * vary[3],
        dsnu_e=1.05 * vary[4],
        prnu_percent=0.74 * vary[5],
        dark_current_reference_c=AIR_C + SELF_HEATING_C[side],
        # how it changes with the temperature, either the camera says or what is concealed
        dark_current_doubling_c=None if any(isinstance(e, DarkCurrentTemperature) for e in effects) else DOUBLING_C,
        quantum_efficiency=_true_efficiency(rng),
        lens=Lens(f_number=4.0, focal_length_mm=6.0, transmittance=0.92),
        geometry=Geometry(
            camera_matrix=(
                (focal_px, 0.0, (cols - 1) / 2 + rng.uniform(-4, 4)),
                (0.0, focal_px * rng.uniform(0.9998, 1.0002), (rows - 1) / 2 + rng.uniform(-4, 4)),
                (0.0, 0.0, 1.0),
            ),
            distortion=(rng.uniform(-0.13, -0.10), rng.uniform(0.04, 0.10), *rng.uniform(-2e-4, 2e-4, 2), 0.0),
        ),
    )
    outwards = -1.0 if side == "left" else 1.0
    toe_in_deg = np.rad2deg(np.arctan2(BASELINE_MM / 2, DISTANCE_MM))
    # turned about y so that its z axis meets the other camera's at the targets; crooked by up to 0.2 degrees
    turn = Rotation.from_euler("yxz", [outwards * toe_in_deg, *rng.uniform(-0.2, 0.2, 2)], degrees=True)
    return HiddenCamera(
        model=model,
        effects=effects,
        pattern=_pattern(rng, shape, model.prnu_percent, model.dsnu_e, white=plain).surrounded(margins),
        rotation=turn.as_matrix(),
        centre_mm=np.array([outwards * BASELINE_MM / 2, 0.0, 0.0]) + rng.uniform(-0.3, 0.3, 3),
        datasheet=sheet,
        margins=margins,
    )


#: What the default bench conceals.
CONCEALED: Concealed = {
    "left": (
        DispersingLowPassFilter(displacement_x_um=2.06, displacement_y_um=1.94),
        RipplingInfraredCutFilter(cut_wavelength_nm=651.5, width_nm=3.2),
    ),
    "right": (),
}


def hidden_truth(
    seed: int = 1,
    concealed: Concealed | None = None,
    shape: tuple[int, int] = (ROWS, COLS),
    margins: Margins = NO_MARGINS,
) -> Truth:
    """Return the truth of a seed. `concealed` None: `CONCEALED`, and structure in the pixels' patterns; else that
    alone, in cameras that are otherwise the same. `shape`: rows and columns that see light; the same lens before a
    smaller sensor sees less. `margins`: around these in each frame.

    Raises `mocks.conceal.ConcealError` for what the bench can't show.
    """
    effects = CONCEALED if concealed is None else concealed
    check(effects)
    return Truth(
        {
            side: _camera(
                side,
                np.random.default_rng([seed, index]),
                tuple(map(_finer, effects.get(side, ()))),
                shape,
                concealed is not None,
                margins,
            )
            for index, side in enumerate(SIDES)
        }
    )
