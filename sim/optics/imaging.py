"""How a lens images a point: diffraction, an aberrated pupil, a measured point spread or transfer function, a traced
lens.

Each model has `transfer`, its optical transfer function at one wavelength (on the axis, where it varies over the
field), and `cutoff_cy_per_um`, beyond which that is 0. A further path error over the pupil, `aberration`, adds to the
model's own where the model has a pupil. Where it has none, the transfer function is multiplied by the ratio by which
the aberration would change a perfect lens's. Frequencies are cy/um on the sensor, fx along columns (to the right), fy
along rows (down). The models are distinguished by `kind`. All but the traced lens contain their numbers, so that they
can be written as JSON or TOML.
"""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_serializer, model_validator

from sim.optics.diffraction import diffraction_cutoff_cy_per_um, diffraction_otf
from sim.optics.pupil import Wavefront, noll_order, osa_order, pupil_otf, pupil_ratio, seidel, zernike
from sim.optics.table import LensTable
from sim.parameters import Frozen, Quantity
from sim.spectrum import FloatArray

ComplexArray = NDArray[np.complex128]

#: A pupil without error.
NONE = Wavefront(())

#: A point spread function's samples have to add up to 1 within this.
SUM_TOLERANCE = 1e-3


class DiffractionLimited(Frozen):
    """A perfect lens with a circular pupil."""

    shift_variant: ClassVar[bool] = False
    kind: Literal["diffraction_limited"] = "diffraction_limited"

    def transfer(
        self,
        fx_cy_per_um: FloatArray,
        fy_cy_per_um: FloatArray,
        wavelength_nm: float,
        f_number: float,
        aberration: Wavefront = NONE,
    ) -> FloatArray | ComplexArray:
        """(2 / pi) (arccos s - s sqrt(1 - s^2)), s = f wavelength f_number; frequencies broadcast."""
        if aberration.terms:
            return pupil_otf(fx_cy_per_um, fy_cy_per_um, wavelength_nm, f_number, aberration)
        if np.ndim(fx_cy_per_um) == 2 and np.ndim(fy_cy_per_um) == 2 and np.shape(fy_cy_per_um)[1] == 1:
            # the frequencies of a picture's transform: rows of fy and -fy are alike
            fy, row = np.unique(np.abs(fy_cy_per_um[:, 0]), return_inverse=True)
            return diffraction_otf(np.hypot(fx_cy_per_um, fy[:, None]), wavelength_nm, f_number)[row]
        return diffraction_otf(np.hypot(fx_cy_per_um, fy_cy_per_um), wavelength_nm, f_number)

    def cutoff_cy_per_um(self, wavelength_nm: float, f_number: float) -> float:
        """Frequency above which the transfer function is 0: 1 / (wavelength f_number)."""
        return diffraction_cutoff_cy_per_um(wavelength_nm, f_number)


class ZernikePupil(Frozen):
    """A lens whose circular pupil has a path error (OPD) given by Zernike coefficients, in um the same at all
    wavelengths.

    W(rho, phi) = sum_j c_j Z_j(rho, phi), Z_j of rms 1 over the pupil, phi from the columns' direction towards the
    rows'; the phase is 2 pi W / wavelength. `coefficients` begin with the index scheme's first (`noll`: j = 1; `osa`,
    that is ANSI Z80.28: j = 0; both piston) and are in um, or in waves at `reference_wavelength_nm`. A W that rises
    along x moves the image along +x.

    Colours may differ: at `colour_wavelength_nm` (linear between, held beyond) the sensor lies `focus_shift_um` dz from
    the focus (axial colour, W = dz / (8 N^2) rho^2 on top), and the image is moved by `image_shift_um` (x, y)
    (lateral colour).
    """

    shift_variant: ClassVar[bool] = False
    kind: Literal["zernike_pupil"] = "zernike_pupil"
    coefficients: tuple[float, ...]
    index: Literal["noll", "osa"]
    unit: Literal["um", "waves"]
    reference_wavelength_nm: Annotated[
        float | None, Quantity("nm", "wavelength of the waves that coefficients are in", lower=100.0, upper=20000.0)
    ] = None
    colour_wavelength_nm: tuple[float, ...] = ()
    focus_shift_um: tuple[float, ...] = ()
    image_shift_um: tuple[tuple[float, float], ...] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.unit == "waves") != (self.reference_wavelength_nm is not None):
            raise ValueError(
                f"coefficients in {self.unit} with a reference wavelength of {self.reference_wavelength_nm} nm: waves "
                "need one, um none"
            )
        _check_wavelengths(self.colour_wavelength_nm, empty=True)
        for name, given in (("focus_shift_um", self.focus_shift_um), ("image_shift_um", self.image_shift_um)):
            if given and len(given) != len(self.colour_wavelength_nm):
                raise ValueError(
                    f"{name} has {len(given)} entries for {len(self.colour_wavelength_nm)} of colour_wavelength_nm: "
                    "give one a wavelength"
                )
        return self

    @cached_property
    def _base(self) -> Wavefront:
        order, first = (noll_order, 1) if self.index == "noll" else (osa_order, 0)
        scale = 1.0 if self.reference_wavelength_nm is None else self.reference_wavelength_nm * 1e-3
        total = Wavefront(())
        for j, coefficient in enumerate(self.coefficients, first):
            if coefficient != 0.0:
                total += zernike(*order(j)).scale(coefficient * scale)
        return total

    def wavefront(self, wavelength_nm: float, f_number: float) -> Wavefront:
        """Path error over the pupil at one wavelength, with the focus and image shifts of that wavelength."""
        total = self._base
        if self.focus_shift_um:
            shift = float(np.interp(wavelength_nm, self.colour_wavelength_nm, self.focus_shift_um))
            total += seidel(defocus_um=shift / (8.0 * f_number**2))
        if self.image_shift_um:
            x, y = (float(np.interp(wavelength_nm, self.colour_wavelength_nm,
                                    along)) for along in zip(*self.image_shift_um, strict=True))  # fmt: skip
            total = total.plus({(1, 0): x / (2.0 * f_number), (0, 1): y / (2.0 * f_number)})
        return total

    def transfer(
        self,
        fx_cy_per_um: FloatArray,
        fy_cy_per_um: FloatArray,
        wavelength_nm: float,
        f_number: float,
        aberration: Wavefront = NONE,
    ) -> FloatArray | ComplexArray:
        """OTF by autocorrelation of the pupil (`sim.optics.pupil`), of the broadcast shape of the frequencies."""
        path = self.wavefront(wavelength_nm, f_number) + aberration
        return pupil_otf(fx_cy_per_um, fy_cy_per_um, wavelength_nm, f_number, path)

    def cutoff_cy_per_um(self, wavelength_nm: float, f_number: float) -> float:
        """Frequency above which the transfer function is 0: 1 / (wavelength f_number)."""
        return diffraction_cutoff_cy_per_um(wavelength_nm, f_number)


class MeasuredPsf(Frozen):
    """A point spread function of the lens alone (without the pixel's aperture), as samples of a band-limited function.

    `psf` (wavelengths, rows, columns): light a sample, >= 0, sum 1 within 1e-3 at each wavelength. A single wavelength
    holds for all; several are interpolated linearly, constant beyond. Rows run down, columns to the right. The image
    point is the centre of the window, sample (n - 1) / 2 in each direction. Above half a cycle a sample the transfer
    function is 0: a pitch wider than wavelength x f_number / 2 loses detail.
    """

    shift_variant: ClassVar[bool] = False
    kind: Literal["measured_psf"] = "measured_psf"
    wavelength_nm: tuple[float, ...]
    psf: tuple[tuple[tuple[float, ...], ...], ...]
    sample_pitch_um: Annotated[float, Quantity("um", "distance of neighbouring samples", lower=1e-3, upper=100.0)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_wavelengths(self.wavelength_nm)
        _check_cube("psf", self.psf, len(self.wavelength_nm))
        for wavelength_nm, samples in zip(self.wavelength_nm, np.array(self.psf), strict=True):
            if samples.min() < 0:
                raise ValueError(
                    f"psf is {samples.min():g} at {wavelength_nm:g} nm, below the limit of 0: subtract no more than "
                    "the background"
                )
            if abs(samples.sum() - 1.0) > SUM_TOLERANCE:
                raise ValueError(
                    f"psf adds up to {samples.sum():.6g} at {wavelength_nm:g} nm, which isn't 1 within "
                    f"{SUM_TOLERANCE:g}: divide it by its sum"
                )
        return self

    @cached_property
    def _samples(self) -> FloatArray:
        cube = np.array(self.psf)
        cube /= cube.sum(axis=(1, 2), keepdims=True)
        cube.flags.writeable = False
        return cube

    def transfer(
        self,
        fx_cy_per_um: FloatArray,
        fy_cy_per_um: FloatArray,
        wavelength_nm: float,
        f_number: float,
        aberration: Wavefront = NONE,
    ) -> FloatArray | ComplexArray:
        """Fourier sum of the samples, 1 at f = 0; frequencies broadcast. `f_number` isn't used."""
        samples = np.tensordot(_shares(self.wavelength_nm, wavelength_nm), self._samples, 1)
        value = _fourier_sum(samples, self.sample_pitch_um, fx_cy_per_um, fy_cy_per_um)
        return value * pupil_ratio(fx_cy_per_um, fy_cy_per_um, wavelength_nm, f_number, aberration)

    def cutoff_cy_per_um(self, wavelength_nm: float, f_number: float) -> float:
        """Return the highest frequency of the samples: half a cycle a sample each way, along the diagonal."""
        return float(np.sqrt(0.5)) / self.sample_pitch_um


class MeasuredOtf(Frozen):
    """An optical transfer function of the lens alone, as samples: linear between frequencies, 0 above the highest.

    `modulus` (wavelengths, fy, fx) is 1 at zero frequency within 1e-3; `phase_rad` has the same shape, or is empty for
    none (light shifted by d um has the phase -2 pi f d). `frequency_x_cy_per_um` ascends from 0.
    `frequency_y_cy_per_um` ascends from 0 (the same in all four quadrants, no phase) or from below 0. Where it is
    empty the transfer function is isotropic, `modulus` (wavelengths, 1, f). A single wavelength holds for all; several
    are interpolated linearly, constant beyond.
    """

    shift_variant: ClassVar[bool] = False
    kind: Literal["measured_otf"] = "measured_otf"
    wavelength_nm: tuple[float, ...]
    frequency_x_cy_per_um: tuple[float, ...]
    frequency_y_cy_per_um: tuple[float, ...] = ()
    modulus: tuple[tuple[tuple[float, ...], ...], ...]
    phase_rad: tuple[tuple[tuple[float, ...], ...], ...] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_wavelengths(self.wavelength_nm)
        x, y = np.array(self.frequency_x_cy_per_um), np.array(self.frequency_y_cy_per_um)
        if (
            x.size < 2
            or x[0] != 0.0
            or np.any(np.diff(x) <= 0)
            or np.any(np.diff(y) <= 0)
            or 0.0 not in [*y, *([0.0] if not y.size else [])]
        ):
            raise ValueError(
                f"frequencies {x[:3].tolist()}... and {y[:3].tolist()}... cy/um have to ascend, from 0 along x and "
                "from or through 0 along y: sort them, and give the transfer at 0"
            )
        shape = max(y.size, 1), x.size
        _check_cube("modulus", self.modulus, len(self.wavelength_nm), shape)
        if self.phase_rad:
            _check_cube("phase_rad", self.phase_rad, len(self.wavelength_nm), shape)
            if not y.size or y[0] == 0.0:
                raise ValueError(
                    "phase_rad is given with frequencies of one quadrant, where it has no sense: let "
                    "frequency_y_cy_per_um run through 0"
                )
        values = np.array(self.modulus)
        if values.min() < 0 or values.max() > 1 + SUM_TOLERANCE:
            raise ValueError(
                f"modulus runs from {values.min():g} to {values.max():g}, beyond the limits of 0 and 1: divide it by "
                "its value at zero frequency"
            )
        zero = values[:, self.frequency_y_cy_per_um.index(0.0) if y.size else 0, 0]
        if np.any(np.abs(zero - 1.0) > SUM_TOLERANCE):
            worst = zero[np.argmax(np.abs(zero - 1.0))]
            raise ValueError(
                f"modulus is {worst:.6g} at zero frequency, which isn't 1 within {SUM_TOLERANCE:g}: divide it by that"
            )
        return self

    @cached_property
    def _samples(self) -> ComplexArray:
        value = np.array(self.modulus) * np.exp(1j * np.array(self.phase_rad or 0.0))
        zero = self.frequency_y_cy_per_um.index(0.0) if self.frequency_y_cy_per_um else 0
        value = value / value[:, zero : zero + 1, :1]
        value.flags.writeable = False
        return value

    def transfer(
        self,
        fx_cy_per_um: FloatArray,
        fy_cy_per_um: FloatArray,
        wavelength_nm: float,
        f_number: float,
        aberration: Wavefront = NONE,
    ) -> FloatArray | ComplexArray:
        """Return the interpolated samples, the complex conjugate at -f; frequencies broadcast. `f_number` isn't
        used."""
        value = np.tensordot(_shares(self.wavelength_nm, wavelength_nm), self._samples, 1)
        ratio = pupil_ratio(fx_cy_per_um, fy_cy_per_um, wavelength_nm, f_number, aberration)
        fx, fy = np.broadcast_arrays(np.asarray(fx_cy_per_um, float), np.asarray(fy_cy_per_um, float))
        x, y = self.frequency_x_cy_per_um, self.frequency_y_cy_per_um
        if not y:
            return np.asarray(np.interp(np.hypot(fx, fy), x, np.real(value[0]), right=0.0) * ratio)
        turned = np.where(fx < 0, -1.0, 1.0)
        across = np.abs(fy) if y[0] == 0.0 else fy * turned
        from scipy.interpolate import RegularGridInterpolator

        table = RegularGridInterpolator((y, x), value if self.phase_rad else np.real(value), bounds_error=False,
                                        fill_value=0.0)  # fmt: skip
        sampled = table(np.stack([across, np.abs(fx)], axis=-1))
        return np.asarray(np.where(turned < 0, np.conj(sampled), sampled) * ratio)

    def cutoff_cy_per_um(self, wavelength_nm: float, f_number: float) -> float:
        """Return the highest frequency of the samples."""
        return float(np.hypot(self.frequency_x_cy_per_um[-1], max(np.abs(self.frequency_y_cy_per_um), default=0.0)))


class TracedLens(Frozen):
    """A lens traced from its prescription, whose image varies over the field. Its frames are blurred by
    `sim.optics.superposition`.

    A dump holds only the table's `content_hash` (the samples take many megabytes): trace the prescription again, or
    `LensTable.load` the table. Two such lenses are equal where their tables' hashes are.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    shift_variant: ClassVar[bool] = True
    kind: Literal["traced_lens"] = "traced_lens"
    table: LensTable

    @model_serializer
    def _by_hash(self) -> dict[str, Any]:
        return {"kind": self.kind, "content_hash": self.table.content_hash}

    @model_validator(mode="before")
    @classmethod
    def _needs_its_table(cls, data: Any) -> Any:
        if isinstance(data, dict) and "table" not in data:
            raise ValueError(
                f"a traced lens (content hash {data.get('content_hash', 'not given')}) is made of its table alone: "
                "trace its prescription or load the table, and give that as `table`"
            )
        return data

    def transfer(
        self,
        fx_cy_per_um: FloatArray,
        fy_cy_per_um: FloatArray,
        wavelength_nm: float,
        f_number: float,
        aberration: Wavefront = NONE,
    ) -> FloatArray | ComplexArray:
        """OTF of the field point closest to the axis, about its chief ray; 1 at f = 0, linear between the table's
        wavelengths, constant beyond. `f_number` isn't used: the table has its own.

        Light outside the table's window, 1 - `encircled_share`, is taken to fall as 1/r^3 around it, as an edge of the
        aperture diffracts it. It lowers the contrast at all but the lowest frequencies.
        """
        table = self.table
        axis = int(np.argmin(np.sum(table.field_deg**2, axis=1)))
        shares = _shares(table.wavelength_nm, wavelength_nm)
        samples, inside = np.tensordot(shares, table.psf[:, axis], 1), float(shares @ table.encircled_share[:, axis])
        fx, fy = np.asarray(fx_cy_per_um, float), np.asarray(fy_cy_per_um, float)
        x, y = table.window_um[axis]
        value = _fourier_sum(samples, table.sample_pitch_um, fx, fy) * np.exp(-2j * np.pi * (fx * x + fy * y))
        half_um = 0.5 * len(samples) * table.sample_pitch_um
        value = value + (1.0 - inside) * _transfer_beyond(fx, fy, half_um)
        return value * pupil_ratio(fx, fy, wavelength_nm, f_number, aberration)

    def cutoff_cy_per_um(self, wavelength_nm: float, f_number: float) -> float:
        """Return the table's highest frequency: half a cycle a sample each way, along the diagonal."""
        return float(np.sqrt(0.5)) / self.table.sample_pitch_um


#: What `Lens.imaging` holds.
Imaging = Annotated[
    DiffractionLimited | ZernikePupil | MeasuredPsf | MeasuredOtf | TracedLens, Field(discriminator="kind")
]


def _check_wavelengths(wavelength_nm: tuple[float, ...], *, empty: bool = False) -> None:
    if not wavelength_nm and not empty:
        raise ValueError("no wavelength is given: give at least one, in nm")
    if np.any(np.diff(wavelength_nm) <= 0) or (wavelength_nm and wavelength_nm[0] <= 0):
        raise ValueError(f"wavelengths {list(wavelength_nm)[:6]} nm have to be above 0 and ascend: sort them")


def _check_cube(
    name: str, cube: tuple[tuple[tuple[float, ...], ...], ...], planes: int, shape: tuple[int, int] | None = None
) -> None:
    """Raises ValueError unless the values are `planes` planes of equal rows, of the stated shape."""
    shapes = {(len(plane), len(row)) for plane in cube for row in plane}
    if len(cube) != planes or len(shapes) != 1 or (0 in next(iter(shapes))):
        raise ValueError(
            f"{name} holds {len(cube)} planes of the shapes {sorted(shapes)}: give {planes}, one a wavelength, with "
            "rows of one length"
        )
    if shape is not None and shapes != {shape}:
        raise ValueError(f"{name} has planes of {next(iter(shapes))}: {shape} (fy, fx) fits the frequencies")


def _shares(wavelength_nm: FloatArray | tuple[float, ...], at_nm: float) -> FloatArray:
    """Weights of the given wavelengths at another one: linear interpolation, constant beyond."""
    place = float(np.interp(at_nm, wavelength_nm, np.arange(len(wavelength_nm))))
    return np.maximum(0.0, 1.0 - np.abs(np.arange(len(wavelength_nm)) - place))


def _fourier_sum(samples: FloatArray, pitch_um: float, fx: FloatArray, fy: FloatArray) -> ComplexArray:
    """sum_ij samples_ij exp(-2 pi i (fx x_j + fy y_i)) about the window's middle; 0 beyond half a cycle a sample."""
    fx, fy = np.asarray(fx, float), np.asarray(fy, float)
    y, x = ((np.arange(n) - 0.5 * (n - 1)) * pitch_um for n in samples.shape)
    shape, limit = np.broadcast_shapes(fx.shape, fy.shape), 0.5 / pitch_um * (1 + 1e-9)
    if len(shape) == 2 and np.all(fx == fx[:1]) and np.all(fy == fy[:, :1]):
        # a grid: one product of matrices, of the frequencies that pass
        across, down = np.broadcast_to(fx, shape)[0], np.broadcast_to(fy, shape)[:, 0]
        in_x, in_y = np.abs(across) <= limit, np.abs(down) <= limit
        of_rows, of_cols = (np.exp(-2j * np.pi * np.outer(f, at)) for f, at in ((down[in_y], y), (across[in_x], x)))
        value = np.zeros(shape, complex)
        value[np.ix_(in_y, in_x)] = of_rows @ samples @ of_cols.T
        return value
    passed = (np.abs(fx) <= limit) & (np.abs(fy) <= limit)
    across, down = np.broadcast_to(fx, shape).ravel(), np.broadcast_to(fy, shape).ravel()
    total = np.empty(across.size, complex)
    block = max(1, 500_000 // max(samples.shape))
    for start in range(0, across.size, block):
        at = slice(start, start + block)
        rows = np.exp(-2j * np.pi * np.outer(down[at], y)) @ samples
        total[at] = np.sum(rows * np.exp(-2j * np.pi * np.outer(across[at], x)), axis=1)
    return np.where(passed, total.reshape(shape), 0.0)


def _transfer_beyond(fx: FloatArray, fy: FloatArray, half_um: float) -> FloatArray:
    """Transfer function of light that falls as 1/r^3 outside a square of half-width `half_um`, as an edge of the
    aperture diffracts it; 1 at f = 0.

    Along each direction from the square's border outwards, integral_1^inf cos(a t) / t^2 dt = cos a - a (pi/2 - Si a)
    with a = 2 pi f_along border; summed over the directions.
    """
    from scipy.special import sici

    phi = np.pi * (np.arange(96) + 0.5) / 96
    cos, sin = np.cos(phi), np.sin(phi)
    rim = half_um / np.maximum(np.abs(cos), np.abs(sin))
    fx, fy = np.broadcast_arrays(np.asarray(fx, float), np.asarray(fy, float))
    total = np.zeros(fx.shape)
    for c, s, r in zip(cos, sin, rim, strict=True):
        along = 2.0 * np.pi * r * np.abs(fx * c + fy * s)
        total += (np.cos(along) - along * (0.5 * np.pi - sici(along)[0])) / r
    return np.asarray(total / np.sum(1.0 / rim))
