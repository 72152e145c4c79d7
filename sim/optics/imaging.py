"""How a lens images a point: diffraction, an aberrated pupil, a measured point spread or transfer function, a traced lens.

Each model has `transfer`, its optical transfer function at one wavelength (for a lens that isn't the same everywhere: that of
the axis), and `cutoff_cy_per_um`, beyond which that is 0. Frequencies are cy/um on the sensor, fx along columns (to the right), fy
along rows (down). The models are told apart by `kind`; all but the traced lens hold their numbers in themselves, so that they
go to JSON or TOML and back.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_serializer, model_validator

from sim.optics.diffraction import diffraction_cutoff_cy_per_um, diffraction_otf
from sim.optics.table import LensTable
from sim.parameters import Frozen, Quantity
from sim.spectrum import FloatArray

ComplexArray = NDArray[np.complex128]

#: A point spread function's samples have to add up to 1 within this.
SUM_TOLERANCE = 1e-3


class DiffractionLimited(Frozen):
    """A perfect lens with a circular pupil."""

    shift_variant: ClassVar[bool] = False
    kind: Literal["diffraction_limited"] = "diffraction_limited"

    def transfer(
        self, fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float, f_number: float
    ) -> FloatArray | ComplexArray:
        """(2 / pi) (arccos s - s sqrt(1 - s^2)), s = f wavelength f_number; of the broadcast shape of the frequencies."""
        return diffraction_otf(np.hypot(fx_cy_per_um, fy_cy_per_um), wavelength_nm, f_number)

    def cutoff_cy_per_um(self, wavelength_nm: float, f_number: float) -> float:
        """Frequency beyond which nothing is passed: 1 / (wavelength f_number)."""
        return diffraction_cutoff_cy_per_um(wavelength_nm, f_number)


class ZernikePupil(Frozen):
    """A lens whose circular pupil has a path error (OPD) given by Zernike coefficients, the same in um at all wavelengths.

    Path error W(rho, phi) = sum_j c_j Z_j, Z_j normalised to an rms of 1 over the pupil, phi from the columns' direction towards
    the rows'; the phase is 2 pi W / wavelength. `coefficients` begin with the index scheme's first (`noll`: j = 1, piston;
    `osa`, that is ANSI Z80.28: j = 0, piston), in um, or in waves at `reference_wavelength_nm`.
    """

    shift_variant: ClassVar[bool] = False
    kind: Literal["zernike_pupil"] = "zernike_pupil"
    coefficients: tuple[float, ...]
    index: Literal["noll", "osa"]
    unit: Literal["um", "waves"]
    reference_wavelength_nm: Annotated[
        float | None, Quantity("nm", "wavelength of the waves that coefficients are in", lower=100.0, upper=20000.0)
    ] = None

    def transfer(
        self, fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float, f_number: float
    ) -> FloatArray | ComplexArray:
        """OTF by exact autocorrelation of the pupil; complex, of the broadcast shape of the frequencies."""
        raise NotImplementedError

    def cutoff_cy_per_um(self, wavelength_nm: float, f_number: float) -> float:
        """Frequency beyond which nothing is passed: 1 / (wavelength f_number)."""
        return diffraction_cutoff_cy_per_um(wavelength_nm, f_number)


class MeasuredPsf(Frozen):
    """A point spread function of the lens alone (without the pixel's aperture), by samples of a band-limited curve.

    `psf` is (wavelengths, rows, columns), or (1, rows, columns) for one that stands for all wavelengths; light a sample, sum 1
    within 1e-3. Rows run down, columns to the right; the light stands in the middle of the window (of sample n/2 - 1/2 each way).
    Linear between wavelengths, held beyond them. Beyond half a cycle a sample, the transfer is 0: take the pitch no
    wider than wavelength x f_number / 2, or detail is lost.
    """

    shift_variant: ClassVar[bool] = False
    kind: Literal["measured_psf"] = "measured_psf"
    wavelength_nm: tuple[float, ...]
    psf: tuple[tuple[tuple[float, ...], ...], ...]
    sample_pitch_um: Annotated[float, Quantity("um", "distance of neighbouring samples", lower=1e-3, upper=100.0)]

    def transfer(
        self, fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float, f_number: float
    ) -> FloatArray | ComplexArray:
        """Fourier sum of the samples, 1 at f = 0, of the broadcast shape of the frequencies. `f_number` doesn't matter."""
        raise NotImplementedError

    def cutoff_cy_per_um(self, wavelength_nm: float, f_number: float) -> float:
        """The highest frequency of the samples: half a cycle a sample each way, along the diagonal."""
        return float(np.sqrt(0.5)) / self.sample_pitch_um


class TracedLens(Frozen):
    """A lens traced from its prescription, that images differently over the field. Frames go through `sim.optics.scatter`.

    A dump names the table by its `content_hash` alone (many megabytes of samples don't belong into a camera file): trace the
    prescription again, or `LensTable.load` the table, to come back from it. Two such lenses are equal where their tables' hashes are.
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
        if isinstance(data, dict) and not isinstance(data.get("table"), LensTable):
            raise ValueError(
                f"a traced lens (content hash {data.get('content_hash', 'not given')}) is made of its table alone: trace its prescription or load the table, and give that as `table`"
            )
        return data

    def transfer(
        self, fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float, f_number: float
    ) -> FloatArray | ComplexArray:
        """OTF of the field point next to the axis, about its chief ray; 1 at f = 0, linear in wavelength between the table's,
        held beyond them. `f_number` doesn't matter: the table has its own."""
        raise NotImplementedError

    def cutoff_cy_per_um(self, wavelength_nm: float, f_number: float) -> float:
        """The table's highest frequency: half a cycle a sample each way, along the diagonal."""
        return float(np.sqrt(0.5)) / self.table.sample_pitch_um


#: What `Lens.imaging` holds.
Imaging = Annotated[DiffractionLimited | ZernikePupil | MeasuredPsf | TracedLens, Field(discriminator="kind")]
