"""The optical transfer function of an aberrated lens with a circular pupil, by autocorrelation of the pupil: no FFT, no
sampling of the pupil, any frequency.

H(f) = (1 / pi) integral over the overlap of two unit discs of exp(-2 pi i [W(p + s/2) - W(p - s/2)] / wavelength), with
s = 2 wavelength f_number f: the discs' centres are |s| apart, 2 at the cutoff. A path error W = a x so moves the image
by 2 f_number a along +x. (H. H. Hopkins, Proc. R. Soc. A 231, 91 (1955); J. Goodman, Introduction to Fourier Optics,
section 6.4.)

One rule serves all: what H is of the perfect pupil's, the mean of that phase over the overlap, is smooth up to the
cutoff and is what is integrated (Gauss-Legendre in coordinates in which the overlap's rim is no edge). A tilt is taken
out as the phase it is; where W is quadratic the integral across is a sinc, and one along the frequency remains; where W
depends on the radius only, one direction stands for all. For many frequencies the mean is integrated at few points of a
polar grid and interpolated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import comb, factorial, isclose

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from sim.optics.diffraction import diffraction_otf
from sim.spectrum import FloatArray

ComplexArray = NDArray[np.complex128]

#: Path errors below this are rounding: 1e-12 um.
NIL_UM = 1e-12
#: More frequencies than `FEW` are interpolated, as integrating each would take longer; up to `SOME` along each
#: direction where that has `MANY_A_DIRECTION` of them.
FEW, SOME, MANY_A_DIRECTION = 600, 20_000, 40
#: Steps of a table over the radius that lines are drawn through, to 1e-6; least steps of one over radius and angle, for
#: splines.
RADII_LINE = 4096
RADII, ANGLES, PAD = 256, 256, 8
#: Points that are summed at once: their arrays stay in the processor's cache.
IN_CACHE = 20_000
#: A polar grid is fine enough where the last coefficients of its expansion are below this.
SETTLED = 1e-7
#: Sizes of path errors, as the largest coefficient in waves, are tabulated by octaves: up to `FIRST_WAVES`, to twice
#: that, and so on to the octave `LAST_OCTAVE`; each at `SIZES` sizes at most.
FIRST_WAVES, LAST_OCTAVE, SIZES = 0.125, 3, 32


@dataclass(frozen=True)
class Wavefront:
    """Path error in um over the pupil of radius 1: W(x, y) = sum of um x^i y^j over `terms` (i, j, um); x along
    columns, y along rows.
    """

    terms: tuple[tuple[int, int, float], ...]

    @classmethod
    def of(cls, coefficients: Mapping[tuple[int, int], float]) -> Wavefront:
        """From {(i, j): um}."""
        return cls(tuple(sorted((i, j, float(um)) for (i, j), um in coefficients.items() if abs(um) > NIL_UM)))

    def __call__(self, x: FloatArray, y: FloatArray) -> FloatArray:
        total = np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
        # Horner in x, of Horner in y
        rows: dict[int, dict[int, float]] = {}
        for i, j, um in self.terms:
            rows.setdefault(i, {})[j] = um
        for i in range(max(rows, default=-1), -1, -1):
            total = total * x
            row = rows.get(i)
            if row is not None:
                inner: FloatArray | float = 0.0
                for j in range(max(row), -1, -1):
                    inner = inner * y + row.get(j, 0.0)
                total = total + inner
        return total

    def at_square(self, square: FloatArray) -> FloatArray:
        """Return an isotropic W at squared radii."""
        radial = {i // 2: um for i, j, um in self.terms if j == 0}
        total: FloatArray | float = 0.0
        for power in range(max(radial, default=0), -1, -1):
            total = total * square + radial.get(power, 0.0)
        return np.asarray(total)

    def __add__(self, other: Wavefront) -> Wavefront:
        return self.plus(dict(other.coefficients))

    def scale(self, factor: float) -> Wavefront:
        """Times a number."""
        return Wavefront(tuple((i, j, um * factor) for i, j, um in self.terms if factor != 0.0))

    def stopped(self, share: float) -> Wavefront:
        """Return W(share x, share y): of the pupil that reaches `share` as far out, over its own rim. A term of degree
        k goes with share^k: W040 with the fourth power, W131 with the third, W222 and W020 with the second.
        """
        return Wavefront(tuple((i, j, um * share ** (i + j)) for i, j, um in self.terms))

    def plus(self, coefficients: Mapping[tuple[int, int], float]) -> Wavefront:
        """With {(i, j): um} added."""
        total = dict(self.coefficients)
        for at, um in coefficients.items():
            total[at] = total.get(at, 0.0) + um
        return Wavefront.of(total)

    @cached_property
    def coefficients(self) -> dict[tuple[int, int], float]:
        """{(i, j): um}."""
        return {(i, j): um for i, j, um in self.terms}

    @property
    def tilt_um(self) -> tuple[float, float]:
        """Coefficients of x and y."""
        return self.coefficients.get((1, 0), 0.0), self.coefficients.get((0, 1), 0.0)

    @cached_property
    def bend(self) -> Wavefront:
        """Without piston and tilt."""
        return Wavefront(tuple(term for term in self.terms if term[0] + term[1] > 1))

    def part(self, odd: int) -> Wavefront:
        """Return the terms of odd (1) or even (0) degree."""
        return Wavefront(tuple(term for term in self.terms if (term[0] + term[1]) % 2 == odd))

    @cached_property
    def is_isotropic(self) -> bool:
        """Return whether W depends on the radius only: the binomials of (x^2 + y^2)^k, to rounding."""
        degrees = {i + j for i, j, _ in self.terms}
        if any(i % 2 or j % 2 for i, j, _ in self.terms):
            return False
        for degree in degrees:
            k = degree // 2
            first = self.coefficients.get((degree, 0), 0.0)
            if not all(
                isclose(self.coefficients.get((2 * a, degree - 2 * a), 0.0), comb(k, a) * first, rel_tol=1e-9)
                for a in range(k + 1)
            ):
                return False
        return True

    @cached_property
    def size_um(self) -> float:
        """Largest coefficient's magnitude."""
        return max((abs(um) for *_, um in self.terms), default=0.0)

    @cached_property
    def shape(self) -> Wavefront:
        """W over its size, to 12 digits: the same for errors that differ by their size alone."""
        return Wavefront(tuple((i, j, float(f"{um / self.size_um:.12g}")) for i, j, um in self.terms))

    @cached_property
    def range_um(self) -> float:
        """Highest less lowest path over the pupil."""
        return _range_um(self)


@lru_cache(maxsize=1)
def _places() -> tuple[FloatArray, FloatArray]:
    """Points (x, y) all over the pupil."""
    x = np.linspace(-1.0, 1.0, 41)
    xs, ys = np.meshgrid(x, x)
    pupil = np.hypot(xs, ys) <= 1.0
    return xs[pupil], ys[pupil]


@lru_cache(maxsize=64)
def _range_um(path: Wavefront) -> float:
    return float(np.ptp(path(*_places())))


@lru_cache(maxsize=256)
def seidel(
    *,
    defocus_um: float = 0.0,
    spherical_um: float = 0.0,
    coma_um: tuple[float, float] = (0.0, 0.0),
    astigmatism_um: float = 0.0,
    astigmatism_deg: float = 0.0,
) -> Wavefront:
    """W(x, y) = W020 r^2 + W040 r^4 + r^2 (W131x x + W131y y) + W222 u^2, u along `astigmatism_deg` from x; um at the
    rim.

    W020 = dz / (8 N^2) for a sensor that is dz away from the focus.
    """
    cos, sin = np.cos(np.deg2rad(astigmatism_deg)), np.sin(np.deg2rad(astigmatism_deg))
    cx, cy = coma_um
    return Wavefront.of(
        {
            (2, 0): defocus_um + astigmatism_um * float(cos * cos),
            (0, 2): defocus_um + astigmatism_um * float(sin * sin),
            (1, 1): 2.0 * astigmatism_um * float(cos * sin),
            (4, 0): spherical_um,
            (2, 2): 2.0 * spherical_um,
            (0, 4): spherical_um,
            (3, 0): cx,
            (1, 2): cx,
            (2, 1): cy,
            (0, 3): cy,
        }
    )


def zernike(n: int, m: int) -> Wavefront:
    """Z_n^m as a polynomial, rms 1 over the pupil: sqrt((2 - [m = 0]) (n + 1)) R_n^|m|(rho) cos(m phi) or, for m < 0,
    sin(|m| phi); phi from x towards y. (R. Noll, J. Opt. Soc. Am. 66, 207 (1976).)
    """
    a = abs(m)
    if n < a or (n - a) % 2:
        raise ValueError(f"there is no Zernike polynomial of order n = {n}, m = {m}: n - |m| has to be even and >= 0")
    norm = np.sqrt((n + 1) * (1 if m == 0 else 2))
    total: dict[tuple[int, int], float] = {}
    for k in range((n - a) // 2 + 1):
        radial = (
            (-1) ** k * factorial(n - k) // (factorial(k) * factorial((n + a) // 2 - k) * factorial((n - a) // 2 - k))
        )
        half = (n - a) // 2 - k
        # rho^(n - 2k) cos(m phi) = (x^2 + y^2)^half Re (x + i y)^a, or Im for the sine
        for p in range(a + 1):
            if p % 2 != (1 if m < 0 else 0):
                continue
            angular = comb(a, p) * (-1) ** (p // 2)
            for q in range(half + 1):
                at = (a - p + 2 * (half - q), p + 2 * q)
                total[at] = total.get(at, 0.0) + float(norm * radial * angular * comb(half, q))
    return Wavefront.of(total)


def noll_order(j: int) -> tuple[int, int]:
    """(n, m) of Noll's index j = 1, 2, ...; even j are cosines."""
    n = int((np.sqrt(8 * j - 7) - 1) // 2)
    rest = j - n * (n + 1) // 2 - 1
    a = 2 * ((rest + (n + 1) % 2) // 2) + n % 2
    return n, (a if j % 2 == 0 else -a)


def osa_order(j: int) -> tuple[int, int]:
    """(n, m) of the index of OSA and ANSI Z80.28, j = (n (n + 2) + m) / 2 = 0, 1, ..."""
    n = int((np.sqrt(8 * j + 1) - 1) // 2)
    return n, 2 * j - n * (n + 2)


def pupil_otf(
    fx_cy_per_um: ArrayLike, fy_cy_per_um: ArrayLike, wavelength_nm: float, f_number: float, wavefront: Wavefront
) -> ComplexArray:
    """OTF of a circular pupil with path error `wavefront`, complex, of the broadcast shape of the frequencies; 0 beyond
    the cutoff. To 1e-6 below 10 waves.
    """
    fx, fy = np.asarray(fx_cy_per_um, float), np.asarray(fy_cy_per_um, float)
    perfect = diffraction_otf(np.hypot(fx, fy), wavelength_nm, f_number)
    return np.asarray(perfect * pupil_ratio(fx, fy, wavelength_nm, f_number, wavefront), complex)


def pupil_ratio(
    fx_cy_per_um: ArrayLike, fy_cy_per_um: ArrayLike, wavelength_nm: float, f_number: float, wavefront: Wavefront
) -> FloatArray | ComplexArray:
    """OTF of a circular pupil with path error `wavefront` over that of the perfect one: the mean of the phase over the
    overlap.

    Of the broadcast shape of the frequencies; real where W(-p) = W(p); 1 beyond the cutoff, where both are 0.
    """
    fx, fy = np.asarray(fx_cy_per_um, float), np.asarray(fy_cy_per_um, float)
    wavelength_um = wavelength_nm * 1e-3
    ratio = _bend_ratio(fx, fy, wavelength_um, f_number, wavefront.bend)
    if any(wavefront.tilt_um):
        ax, ay = wavefront.tilt_um
        inside = np.hypot(fx, fy) * (wavelength_um * f_number) < 1.0
        ratio = ratio * np.where(inside, np.exp(-4j * np.pi * f_number * (ax * fx + ay * fy)), 1.0)
    return ratio


def _bend_ratio(
    fx: FloatArray, fy: FloatArray, wavelength_um: float, f_number: float, bend: Wavefront
) -> FloatArray | ComplexArray:
    shape = np.broadcast_shapes(fx.shape, fy.shape)
    if not bend.terms:
        return np.ones(shape)
    share = np.hypot(fx, fy) * (wavelength_um * f_number)
    if bend.is_isotropic:
        return _ratio_along(share, 0.0, wavelength_um, bend)
    if share.size <= FEW:
        safe = np.where(share > 0, share, 1.0) / (wavelength_um * f_number)
        cos, sin = np.where(share > 0, fx / safe, 1.0).ravel(), np.broadcast_to(fy / safe, shape).ravel()
        points = share.ravel(), cos, sin
        return _mean_of_few(*(part.tobytes() for part in points), wavelength_um, bend).reshape(shape)
    if share.size <= SOME:
        # edges ask for many frequencies in few directions
        directions, which = np.unique(np.round(np.arctan2(fy, fx), 9), return_inverse=True)
        if directions.size <= share.size // MANY_A_DIRECTION:
            which = which.reshape(shape)
            total = np.empty(shape, complex)
            for k, angle in enumerate(directions):
                total[which == k] = _ratio_along(share[which == k], float(angle), wavelength_um, bend)
            return np.asarray(total if bend.part(1).terms else np.real(total))
    from sim.optics.polar import look_up  # here, as the compiler takes a second to import

    fx, fy = (np.atleast_2d(np.broadcast_to(f, shape)) for f in (fx, fy))
    whole = tuple(f.reshape(-1, f.shape[-1]) for f in (fx, fy))
    ratio = look_up(*whole, wavelength_um * f_number, PAD, _polar_table(bend, wavelength_um)).reshape(shape)
    return np.asarray(ratio if bend.part(1).terms else np.real(ratio))


def _ratio_along(share: FloatArray, angle: float, wavelength_um: float, bend: Wavefront) -> FloatArray | ComplexArray:
    """Return the ratio at shares of the cutoff in one direction."""
    odd = bool(bend.part(1).terms)
    if share.size > SOME:
        radius, value = _line(angle, wavelength_um, bend)
        ratio: FloatArray | ComplexArray = np.interp(share, radius, value if odd else np.real(value))
    else:
        series = _series(angle, wavelength_um, bend)
        at = 2.0 * np.minimum(share, 1.0) - 1.0
        ratio = np.asarray(chebyshev.chebval(at, series), complex)
        ratio = ratio if odd else np.real(ratio)
    return np.where((share > 0.0) & (share < 1.0), ratio, 1.0)


def _mean(
    share: FloatArray, cos: FloatArray, sin: FloatArray, wavelength_um: float, bend: Wavefront
) -> FloatArray | ComplexArray:
    """Mean phase over the overlap at shares of the cutoff and directions (cos, sin), (K,) each; 1 from the cutoff
    on.
    """
    half = np.clip(share, 0.0, 1.0 - 1e-9)
    waves = bend.range_um / wavelength_um
    if all(i + j == 2 for i, j, _ in bend.terms):
        ratio: FloatArray | ComplexArray = _mean_of_quadratic(half, cos, sin, wavelength_um, bend, int(32 + 4 * waves))
    else:
        ratio = _mean_of_any(half, cos, sin, wavelength_um, bend, int(min(10 + 5.0 * waves, 200)))
    return np.where(share < 1.0, ratio, 1.0)


@lru_cache(maxsize=1024)
def _mean_of_few(
    share: bytes, cos: bytes, sin: bytes, wavelength_um: float, bend: Wavefront
) -> FloatArray | ComplexArray:
    """Return the same of arrays' bytes, kept: whoever changes something else asks for the same again."""
    half, along, across = (np.frombuffer(part) for part in (share, cos, sin))
    return _mean(half, along, across, wavelength_um, bend)


@lru_cache(maxsize=16)
def _nodes(count: int) -> tuple[FloatArray, FloatArray]:
    """Gauss-Legendre on 0..1."""
    node, weight = np.polynomial.legendre.leggauss(count)
    return 0.5 * (node + 1.0), 0.5 * weight


def _mean_of_quadratic(
    half: FloatArray, cos: FloatArray, sin: FloatArray, wavelength_um: float, bend: Wavefront, nodes: int
) -> FloatArray:
    """W = p' Q p: the path difference 2 s' Q p is linear over the overlap."""
    xx, xy, yy = (bend.coefficients.get(at, 0.0) for at in ((2, 0), (1, 1), (0, 2)))
    wave = 2.0 * np.pi / wavelength_um * 4.0 * half
    along = wave * (xx * cos**2 + xy * cos * sin + yy * sin**2)
    across = wave * ((yy - xx) * cos * sin + 0.5 * xy * (cos**2 - sin**2))
    node, weight = _nodes(nodes)
    c = half[:, None]
    # u = (1 - c) (1 - t^2) takes the chord's square root at the rim away
    u = (1.0 - c) * (1.0 - node**2)
    chord = np.sqrt(np.maximum(1.0 - (u + c) ** 2, 0.0))
    area = weight * node * chord
    wavy = np.cos(along[:, None] * u)
    if np.any(across):
        wavy = wavy * np.sinc(across[:, None] * chord / np.pi)
    return np.asarray((area * wavy).sum(1) / np.maximum(area.sum(1), 1e-300))


def _mean_of_any(
    half: FloatArray, cos: FloatArray, sin: FloatArray, wavelength_um: float, bend: Wavefront, nodes: int
) -> FloatArray | ComplexArray:
    """Points (u, v) of one half of the overlap, u along the frequency: u + c = cos(theta), v = t sin(theta), |t| <= 1,
    so that dA = sin^2(theta) d(theta) dt. At -p the difference of the even part of W has the other sign, that of the
    odd part the same.
    """
    even, odd = bend.part(0), bend.part(1)
    node, weight = _nodes(nodes)
    t, t_weight = 2.0 * node - 1.0, weight
    if bend.is_isotropic:  # alike at v and -v
        t, t_weight = t[(nodes // 2) :], t_weight[(nodes // 2) :] * np.where(t[(nodes // 2) :] == 0.0, 0.5, 1.0)
    ratio = np.empty(half.size, float if not odd.terms else complex)
    k = 2.0 * np.pi / wavelength_um
    block = max(1, IN_CACHE // (node.size * t.size))
    for start in range(0, half.size, block):
        at = slice(start, start + block)
        c = half[at, None, None]
        limit = np.arccos(c)
        theta = limit * node[None, :, None]
        sine = np.sin(theta)
        u, v = np.cos(theta) - c, sine * t
        area = weight[None, :, None] * t_weight * sine * sine
        if bend.is_isotropic:
            squares = v * v
            difference = even.at_square((u + c) ** 2 + squares) - even.at_square((u - c) ** 2 + squares)
            ratio[at] = np.sum(area * np.cos(k * difference), axis=(1, 2)) / np.maximum(
                np.sum(area, axis=(1, 2)), 1e-300
            )
            continue
        ca, sa = cos[at, None, None], sin[at, None, None]
        x, y, step_x, step_y = u * ca - v * sa, u * sa + v * ca, c * ca, c * sa
        far, near = (x + step_x, y + step_y), (x - step_x, y - step_y)
        part = area * np.cos(k * (even(*far) - even(*near))) if even.terms else area
        norm = np.maximum(np.sum(area, axis=(1, 2)), 1e-300)
        if odd.terms:
            phase = k * (odd(*far) - odd(*near))
            ratio[at] = np.sum(part * np.cos(phase), axis=(1, 2)) / norm
            ratio.imag[at] = -np.sum(part * np.sin(phase), axis=(1, 2)) / norm
        else:
            ratio[at] = np.sum(part, axis=(1, 2)) / norm
    return ratio


@lru_cache(maxsize=16)
def _to_series(count: int) -> FloatArray:
    """From values at Chebyshev's nodes to the coefficients of the polynomial through them, (count, count)."""
    angle = np.pi * (np.arange(count) + 0.5) / count
    table = 2.0 / count * np.cos(np.arange(count)[:, None] * angle)
    table[0] *= 0.5
    return np.asarray(table)


def _series(angle: float, wavelength_um: float, bend: Wavefront) -> ComplexArray:
    """Chebyshev's expansion of the ratio in one direction over the share of the cutoff: smooth, so that few terms do.

    At a share and in a direction the ratio depends on the path error in waves alone: a table over its size serves all
    wavelengths, f-numbers and sizes of an error of one shape.
    """
    waves = bend.size_um / wavelength_um
    octave = max(int(np.ceil(np.log2(waves / FIRST_WAVES))), 0)
    table = _octave(angle, bend.shape, octave) if octave <= LAST_OCTAVE else None
    if table is None:
        return _expand(angle, bend.shape, waves)
    low, high = _waves_of(octave)
    return np.asarray(chebyshev.chebval(2.0 * (waves - low) / (high - low) - 1.0, table), complex)


def _waves_of(octave: int) -> tuple[float, float]:
    """Least and largest size in waves; the first octave begins at 0."""
    high = FIRST_WAVES * 2.0**octave
    return (0.5 * high if octave else 0.0), high


@lru_cache(maxsize=1024)
def _octave(angle: float, shape: Wavefront, octave: int) -> ComplexArray | None:
    """Chebyshev's coefficients over the size in waves of those over the share, (sizes, shares); None where `SIZES`
    don't do.
    """
    low, high = _waves_of(octave)
    count = 8
    while count <= SIZES:
        node = np.cos(np.pi * (np.arange(count) + 0.5) / count)
        series = [_expand(angle, shape, float(low + 0.5 * (at + 1.0) * (high - low))) for at in node]
        table = np.zeros((count, max(len(coefficients) for coefficients in series)), complex)
        for k, terms in enumerate(series):
            table[k, : len(terms)] = terms
        table = _to_series(count) @ table
        if np.max(np.sum(np.abs(table[-2:]), axis=1)) < SETTLED:
            return np.asarray(table)
        count *= 2
    return None


def _expand(angle: float, shape: Wavefront, waves: float) -> ComplexArray:
    """Return the expansion over the share, of `waves` times a shape."""
    bend, count = shape.scale(waves), 16
    while True:
        node = np.cos(np.pi * (np.arange(count) + 0.5) / count)
        cos, sin = np.full(count, np.cos(angle)), np.full(count, np.sin(angle))
        value = _mean(0.5 * (node + 1.0), cos, sin, 1.0, bend)
        series = np.asarray(_to_series(count) @ value, complex)
        if np.max(np.abs(series[-3:])) < SETTLED or count >= 512:
            return series
        count *= 2


@lru_cache(maxsize=32)
def _line(angle: float, wavelength_um: float, bend: Wavefront) -> tuple[FloatArray, ComplexArray]:
    """Return the ratio in one direction on even steps of the share of the cutoff."""
    radius = np.linspace(0.0, 1.0, RADII_LINE + 1)
    series = _series(angle, wavelength_um, bend)
    return radius, np.asarray(chebyshev.chebval(2.0 * radius - 1.0, series), complex)


@lru_cache(maxsize=32)
def _polar_table(bend: Wavefront, wavelength_um: float) -> ComplexArray:
    """Spline coefficients (PAD + radii + PAD, angles) of the ratio over share 0..1 and angle 0..2 pi.

    The ratio is smooth in both: Chebyshev's expansion in the share, Fourier's in the angle, over half a turn, as the
    ratio of the other half is the conjugate. Both are doubled until the last coefficients are nil.
    """
    radii, angles = 16, 16
    while True:
        node = np.cos(np.pi * (np.arange(radii) + 0.5) / radii)
        turn = 2.0 * np.pi / angles * np.arange(angles // 2)
        share, angle = (a.ravel() for a in np.meshgrid(0.5 * (node + 1.0), turn, indexing="ij"))
        first = _mean(share, np.cos(angle), np.sin(angle), wavelength_um, bend).reshape(radii, -1)
        value = np.concatenate([first, np.conj(first)], axis=1)
        series = np.fft.fft(_to_series(radii) @ value, axis=1) / angles
        loose_radii = np.max(np.abs(series[-3:])) > SETTLED and radii < 128
        middle = angles // 2
        loose_angles = np.max(np.abs(series[:, middle - 1 : middle + 2])) > SETTLED and angles < 256
        if not (loose_radii or loose_angles):
            break
        radii, angles = radii * (1 + loose_radii), angles * (1 + loose_angles)
    rows, columns = 1 + max(RADII, 8 * radii), max(ANGLES, 8 * angles)
    wide = np.zeros((radii, columns), complex)
    wide[:, : angles // 2], wide[:, -(angles // 2) :] = series[:, : angles // 2], series[:, -(angles // 2) :]
    dense = chebyshev.chebvander(np.linspace(-1.0, 1.0, rows), radii - 1) @ (np.fft.ifft(wide, axis=1) * columns)
    # a spline takes what lies beyond its ends for a mirror image: continue the table, so that this happens further out
    steps = np.arange(1, PAD + 1, dtype=float)
    low, high = (_extrapolate(edge, steps) for edge in (dense[:4], dense[:-5:-1]))
    dense = np.concatenate([low[::-1], dense, high])

    from scipy.ndimage import spline_filter1d

    along = spline_filter1d(dense, axis=0, mode="mirror", output=complex)
    return np.asarray(spline_filter1d(along, axis=1, mode="grid-wrap", output=complex))


def _extrapolate(edge: ComplexArray, steps: FloatArray) -> ComplexArray:
    """Return a cubic through four rows (the outermost first), 1, 2, ... rows beyond the first."""
    x = -steps[:, None]
    basis = np.ones((steps.size, 4))
    for a in range(4):
        for b in range(4):
            if a != b:
                basis[:, a] *= (x[:, 0] - b) / (a - b)
    return np.asarray(basis @ edge)
