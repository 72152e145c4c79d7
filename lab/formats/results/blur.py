"""Results of the blur fits: modulation transfer functions and point-spread functions."""

from __future__ import annotations

from sim.parameters import Frozen


class MtfCurve(Frozen):
    """Modulation transfer function of one edge in one channel (ISO 12233)."""

    capture: str
    channel: str
    angle_deg: float
    angle_deg_std: float | None = None
    field_mm: tuple[float, float] | None = None
    frequency_cy_per_px: tuple[float, ...]
    mtf: tuple[float, ...]
    mtf_std: tuple[float, ...]
    mtf50_cy_per_px: float | None = None
    mtf50_cy_per_px_std: float | None = None
    mtf10_cy_per_px: float | None = None
    mtf10_cy_per_px_std: float | None = None
    #: The edge's region in the frame (row0, col0, row1, col1, end excluded): the manifest's, or as it was found.
    region: tuple[int, int, int, int] | None = None


class PsfKernel(Frozen):
    """Point-spread function, normalised to a sum of 1; rows and columns are those of the frame."""

    capture: str
    channel: str
    field_mm: tuple[float, float] | None = None
    sample_pitch_px: float
    psf: tuple[tuple[float, ...], ...]
    psf_std: tuple[tuple[float, ...], ...]


class PsfSymmetry(Frozen):
    """Test of the rotational symmetry of the blur about the optical axis, on the second moments of kernels over the
    field.

    The symmetric model: radial variance a0 + a r^2, tangential variance a0 + b r^2, mixed moment 0, with r = 1 at the
    kernel that is farthest from the axis.
    """

    kernels: int
    chi2: float
    degrees_of_freedom: int
    probability: float  # of a chi2 at least as large, if the lens is symmetric
    symmetric: bool  # chi2 within its 99.9 % quantile
    variance_on_axis_px2: float
    radial_growth_px2: float
    tangential_growth_px2: float
    largest_mixed_sigma: float  # largest mixed moment over its standard uncertainty
