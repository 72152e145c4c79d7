"""How the light falls off over the field: by law, by a maker's table, or from a flat field."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from sim.parameters import Frozen
from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from scipy.interpolate import PchipInterpolator, RectBivariateSpline


class CosineFourth(Frozen):
    """cos^4 of the chief ray's angle atan(r / focal length)."""

    kind: Literal["cosine_fourth"] = "cosine_fourth"


class RadialIllumination(Frozen):
    """A lens maker's curve: `relative_illumination` at `radius_mm` from the optical axis, monotone cubic between,
    constant beyond.

    It replaces cos^4, which it includes. Radii ascend from 0, where the value is 1.
    """

    kind: Literal["radial"] = "radial"
    radius_mm: tuple[float, ...]
    relative_illumination: tuple[float, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        radius, value = self.radius_mm, self.relative_illumination
        if len(radius) != len(value) or len(radius) < 2:
            raise ValueError(
                f"{len(radius)} radii and {len(value)} values: give as many of the one as of the other, two or more"
            )
        if radius[0] != 0.0 or np.any(np.diff(radius) <= 0):
            raise ValueError(f"radii {list(radius[:4])} mm have to ascend from 0: sort them, and begin on the axis")
        if abs(value[0] - 1.0) > 1e-6 or min(value) < 0:
            raise ValueError(
                f"relative illumination is {value[0]:g} on the axis and {min(value):g} at least: divide by its value "
                "on the axis, and leave out what is below 0"
            )
        return self

    @cached_property
    def _curve(self) -> PchipInterpolator:
        from scipy.interpolate import PchipInterpolator

        return PchipInterpolator(self.radius_mm, self.relative_illumination)

    def at(self, radius_mm: FloatArray) -> FloatArray:
        """Relative illumination at distances from the axis."""
        return np.asarray(self._curve(np.minimum(radius_mm, self.radius_mm[-1])))


class MeasuredIllumination(Frozen):
    """A map over the frame, measured on a flat field of a uniform source.

    `values` lie on an even grid from the first to the last pixel's centre in each direction, with cubic interpolation,
    and are divided by their value on the optical axis. The map replaces cos^4, which it includes.
    """

    kind: Literal["measured"] = "measured"
    values: tuple[tuple[float, ...], ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        lengths = {len(row) for row in self.values}
        if len(self.values) < 2 or len(lengths) != 1 or min(lengths) < 2:
            raise ValueError(
                f"an illumination map of {len(self.values)} rows of {sorted(lengths)} values: give two or more each "
                "way, rows of one length"
            )
        lowest = min(min(row) for row in self.values)
        if not lowest > 0:
            raise ValueError(
                f"illumination is {lowest:g} in the map, below the limit of 0: subtract no more than the dark frame"
            )
        return self

    @classmethod
    def from_flat(cls, flat: FloatArray, degree: int = 6, nodes: tuple[int, int] = (25, 33)) -> Self:
        """Return the map of a flat field (rows, cols): any unit, dark subtracted, one channel or an even mosaic's mean.

        A polynomial of total degree `degree` in x and y through the means of square blocks, by least squares: noise and
        dust average out, and so does anything sharper than about 1/degree of the frame. Raises ValueError for a flat
        that isn't positive on average.
        """
        rows, cols = flat.shape
        size = 2 * max(1, min(rows, cols) // 96)
        down, across = rows // size, cols // size
        if min(down, across) <= degree:
            raise ValueError(
                f"a flat of {rows} x {cols} px has too few blocks for degree {degree}: give a lower degree"
            )
        means = flat[: down * size, : across * size].reshape(down, size, across, size).mean(axis=(1, 3))
        if not float(np.mean(means)) > 0:
            raise ValueError(
                f"the flat's mean is {float(np.mean(means)):g}, not above the limit of 0: subtract the dark frame once"
            )
        y, x = (
            2.0 * ((np.arange(n) + 0.5) * size - 0.5) / (full - 1) - 1.0 for n, full in ((down, rows), (across, cols))
        )
        terms = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]

        def design(y: FloatArray, x: FloatArray) -> FloatArray:
            py, px = (np.polynomial.legendre.legvander(axis, degree) for axis in (y, x))
            return np.stack([np.outer(py[:, i], px[:, j]).ravel() for i, j in terms], axis=1)

        coefficients = np.linalg.lstsq(design(y, x), means.ravel() / means.mean(), rcond=None)[0]
        grid = design(np.linspace(-1.0, 1.0, nodes[0]), np.linspace(-1.0, 1.0, nodes[1])) @ coefficients
        return cls(values=tuple(map(tuple, grid.reshape(nodes).tolist())))

    @cached_property
    def _surface(self) -> RectBivariateSpline:
        from scipy.interpolate import RectBivariateSpline

        values = np.array(self.values)
        y, x = (np.linspace(0.0, 1.0, n) for n in values.shape)
        return RectBivariateSpline(y, x, values, kx=min(3, len(y) - 1), ky=min(3, len(x) - 1))

    def at(self, down: FloatArray, across: FloatArray) -> FloatArray:
        """Return the map at fractions 0..1 of the frame's height and width, which broadcast; constant beyond."""
        down, across = np.clip(down, 0.0, 1.0), np.clip(across, 0.0, 1.0)
        if down.ndim == across.ndim == 2 and down.shape[1] == 1 and across.shape[0] == 1:
            return np.asarray(self._surface(down[:, 0], across[0]))
        return np.asarray(self._surface.ev(*np.broadcast_arrays(down, across)))


#: What `Lens.illumination` holds.
Illumination = Annotated[CosineFourth | RadialIllumination | MeasuredIllumination, Field(discriminator="kind")]
