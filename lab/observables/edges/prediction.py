"""What the chain of light predicts of the edges of one side, at one f-number: their transfer functions through the very
estimator that read the recorded ones (`transfer.py`), shading and a nonlinear response included.

The OTF of the model along each edge's normal becomes a profile by a quadrature over frequency, which is moved to where
the recorded edge lies. A pair (channel, light) is called a sight.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray
from scipy.special import ndtr

from lab.observables.dataset import Dataset
from lab.observables.edges.profile import GRID_PX
from lab.observables.edges.quadrature import Quadrature
from lab.observables.edges.side import SideEdge
from lab.observables.edges.transfer import departure_shapes, highest_frequency, measured_at, read_transfer
from lab.observables.reads import acting
from sim.camera import CameraModel
from sim.effects.base import Effect, Effects
from sim.optics.illumination import optical_axis_px, relative_illumination
from sim.point import (
    MOST_SHARES,
    TRANSFER_AT,
    common_wavelengths,
    detected_transfer,
    halos,
    mix_channels,
    transfer_at,
    varies_over_field,
    wavelength_shares,
    wide_contrast,
)
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum, gauss_rule, lagrange_shares, linear_shares
from sim.stop_down import effects_at_f_number
from sim.uniform import SHADING, SPECTRAL, STRAYS, FieldPoints, Uniform, electron_rate

ComplexArray = NDArray[np.complex128]
#: Standard deviation of the OTF beside noise: numerical error of the model's wavelength sampling.
EDGE_FLOOR = 3e-4
#: Prior standard deviation of the curvature of the target's illumination across the edge: relative change of the level
#: at `UNEVEN_PX`.
UNEVEN_STD, UNEVEN_PX = 0.003, 50.0
UNEVEN_ORDER = 4  # of the polynomial in the distance from the edge that describes shading
#: Edges whose directions differ by less (deg) share one direction.
ALIKE_DEG = 0.35
#: Prior relative standard deviations of a spectrum that isn't stated: of a tilt over 150 nm, and of triangles of
#: half-width `PART_NM`.
TILT_STD, PART_STD, PART_NM = 0.5, 0.6, 60.0
#: Number of wavelengths for the OTF with effects; for unstated spectra; and step (nm) for the diffraction-limited OTF,
#: whose cutoff has a kink.
WAVELENGTHS, FINE_WAVELENGTHS, FINE_NM = 10, 48, 2.0
HIGHEST_CY_PER_PX = 10.0  # of the quadrature
MOST_MOVES, MOVED_TO_PX = 4, 1e-5  # of a profile to where the recorded edge lies
KEPT = 64  # most entries of each cache
#: Quantities of the stages that change an edge's profile otherwise than by the OTF.
CHANGING = SHADING | STRAYS | {"signal.response", "image.veils", "charge.exchange"}
KERNELS = frozenset({"charge.kernels", "charge.trails"})
K = TypeVar("K")
V = TypeVar("V")
_Key = tuple[Effect, ...]


def _kept(store: dict[K, V], key: K, make: Callable[[], V]) -> V:
    """Return the value of `key` in the cache `store`, computed by `make` if it is missing. The oldest of `KEPT` entries
    is dropped."""
    if key not in store:
        if len(store) >= KEPT:
            store.pop(next(iter(store)))
        store[key] = make()
    return store[key]


class PredictedEdges:
    """Edges of one side at one f-number, that of `camera`: their measured OTFs and the model's predictions. Effects are
    stated for the dataset's f-number."""

    def __init__(self, dataset: Dataset, edges: list[SideEdge], camera: CameraModel) -> None:
        self._dataset, self._camera = dataset, camera
        self.edges = edges
        lights = list(dict.fromkeys(e.part[0].light_radiance for e in self.edges))
        #: All channels in every light, as charge may come from neighbours of other channels.
        self._sights = [(c, light) for light in lights for c in dataset.channels]
        self._sight = np.array([self._sights.index((e.channel, e.part[0].light_radiance)) for e in self.edges])
        self._turns, self._turn = _clusters(np.array([e.direction_deg for e in self.edges]), ALIKE_DEG)
        places = [_place_um(dataset, e) for e in self.edges]
        if len(set(places)) == 1:  # edges at one place can't tell a change over the field
            places = [(0.0, 0.0)] * len(places)
        self._places = list(dict.fromkeys(places))
        self._place = np.array([self._places.index(p) for p in places])
        spectra = [self._light(light) for _, light in self._sights]
        self._lit = list(zip((c for c, _ in self._sights), spectra, strict=True))
        self._spectral: dict[tuple[_Key, bool], tuple[FloatArray, FloatArray, ComplexArray]] = {}
        self._blurred: dict[tuple[_Key, _Key, tuple[float, float]], ComplexArray] = {}
        self._changes: dict[_Key, FloatArray | None] = {}
        self._numbers_of: dict[_Key, FloatArray] = {}

        reach = max(e.summary.reach_px for e in edges) + 3 * GRID_PX
        highest = dataset.highest_cy_per_px or highest_frequency([e.summary for e in edges])
        #: Frequencies (cy/px) of the real parts, then of the imaginary parts.
        self.frequencies = measured_at(highest)
        shapes = departure_shapes(highest, reach)
        self._read = [read_transfer(e.summary, highest, shapes) for e in edges]
        self._shift_px = np.array([one.shift_px for one in self._read])
        self.value = np.array([one.value for one in self._read])
        self._quadrature = Quadrature.of(min(self._cutoff_cy_per_px(), HIGHEST_CY_PER_PX), reach)
        #: Tables (nodes, distances) from the real part of an OTF, and from its imaginary part over frequency.
        self._odd, self._even = self._quadrature.both_sides()
        half = self._odd.shape[1] // 2
        self._distance_px = GRID_PX * np.arange(-half, half + 1, dtype=float)
        #: Level of the dark side above the black level, over the contrast.
        self._offset = np.array(
            [max(e.summary.levels[0] - dataset.noise.black, 0.0) / e.summary.contrast for e in edges]
        )
        self._shaded = np.array([self._shade(k, ()) for k in range(len(edges))])
        self._operators = self._made_operators()
        self._baseline = self._otf(())

    def _light(self, path: str | None) -> Spectrum | None:
        return self._dataset.spectrum(path) if path else None

    def _cutoff_cy_per_px(self) -> float:
        """Return the lens's cutoff at the shortest detected wavelength."""
        shortest = float(common_wavelengths(self._camera, self._lit)[0][0])
        lens = self._camera.lens
        return self._camera.pixel_pitch_um * lens.imaging.cutoff_cy_per_um(shortest, lens.f_number)

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance (n, n) of all edges' numbers: noise, rounding and floor. Edges on the same pixels in the same
        direction share the fixed part of their noise (PRNU)."""
        size = self.value.shape[1]
        noise = [one.covariance_of(share) for one, share in zip(self._read, self._offset, strict=True)]
        factors = [np.linalg.cholesky(one + 1e-16 * np.eye(size)) for one in noise]
        out = np.zeros((self.value.size,) * 2)
        for i, a in enumerate(self.edges):
            for j, b in enumerate(self.edges[: i + 1]):
                if a.setting == b.setting:
                    share = 1.0 if i == j else np.sqrt(a.fixed_share * b.fixed_share)
                    out[i * size : (i + 1) * size, j * size : (j + 1) * size] = share * factors[i] @ factors[j].T
                    out[j * size : (j + 1) * size, i * size : (i + 1) * size] = share * factors[j] @ factors[i].T
        for i, one in enumerate(self._read):
            out[i * size : (i + 1) * size, i * size : (i + 1) * size] += one.rounding.T @ one.rounding
        return np.asarray(out + EDGE_FLOOR**2 * np.eye(len(out)))

    # --- the model ---

    def predict(self, effects: Effects) -> FloatArray:
        """Predicted OTFs of all edges at `frequencies`, (edges, frequencies)."""
        key = effects_at_f_number(effects, self._dataset.camera.lens.f_number, self._camera.lens.f_number)
        return _kept(self._numbers_of, key, lambda: self._numbers(self._reported(key)))

    def _numbers(self, rows: FloatArray) -> FloatArray:
        """OTFs at `frequencies`, (edges, frequencies), from the estimators' `rows` (edges, rows)."""
        return np.array(
            [one.predicted(row, share) for one, row, share in zip(self._read, rows, self._offset, strict=True)]
        )

    def _reported(
        self, effects: tuple[Effect, ...], more: FloatArray | None = None, otf: ComplexArray | None = None
    ) -> FloatArray:
        """Return the estimators' rows (edges, rows) for the model, whose profiles are shifted to the recorded ones'
        position. `more` (edges, distances): a further change of the profiles; `otf` (edges, nodes): in place of the
        effects'."""
        otf, change = self._otf(effects) if otf is None else otf, self._change(effects)
        if more is not None:
            change = more if change is None else change + more
        f = self._quadrature.frequency
        moved = np.zeros(len(otf))
        rows = self._rows(otf, change)
        for _ in range(MOST_MOVES):
            short = self._shift_px - rows[:, 1] / rows[:, 0]
            if np.all(np.abs(short) < MOVED_TO_PX):
                break
            moved += np.clip(short, -0.5, 0.5)
            rows = self._rows(otf * np.exp(2j * np.pi * moved[:, None] * f), change)
        return rows

    def _rows(self, otf: ComplexArray, change: FloatArray | None) -> FloatArray:
        """Return the estimators' rows (edges, rows) for a model's OTFs (edges, nodes), and a further `change` of its
        profiles (edges, distances)."""
        constant, by_odd, by_even, by_profile = self._operators
        rows = constant + (by_odd @ np.real(otf)[..., None])[..., 0]
        if np.any(np.imag(otf)):
            rows = rows + (by_even @ (np.imag(otf) / self._quadrature.frequency)[..., None])[..., 0]
        if change is not None:
            rows = rows + (by_profile @ change[..., None])[..., 0]
        return np.asarray(rows)

    def _made_operators(self) -> tuple[FloatArray, ...]:
        """Return the estimators of all edges as operators on OTFs: rows (edges, rows) by the constant part of the
        profile, (edges, rows, nodes) on the real part and on the imaginary part over frequency, and (edges, rows,
        distances) on any other change of the profile. They contain the relative illumination."""
        found = []
        for one, offset, shade in zip(self._read, self._offset, self._shaded, strict=True):
            beyond = (len(self._distance_px) - one.operator.shape[1]) // 2
            rows = np.pad(one.operator, ((0, 0), (beyond, beyond)))
            shaded = rows * shade
            constant = shaded.sum(axis=1) * (0.5 + offset) - rows.sum(axis=1) * offset
            found.append((constant, shaded @ self._odd.T, shaded @ self._even.T, rows))
        return tuple(np.array(part) for part in zip(*found, strict=True))

    def _otf(self, effects: tuple[Effect, ...]) -> ComplexArray:
        """OTFs along the edges' normals, (edges, nodes)."""
        local = self._places if varies_over_field(self._camera, effects) else [(0.0, 0.0)] * len(self._places)
        found = {place: self._sights_otf(effects, place) for place in dict.fromkeys(local)}
        table = np.array([found[place] for place in local])
        # halos are part of the profile (`_change`), as their OTF falls off below the first node of the quadrature
        veiled = wide_contrast(self._camera, effects, self._quadrature.frequency)
        return np.asarray(table[self._place, self._sight, self._turn] / veiled)

    def _sights_otf(self, effects: tuple[Effect, ...], place_um: tuple[float, float]) -> ComplexArray:
        """OTFs of all sights and directions at a place, (sights, directions, nodes)."""
        spectral = acting(effects, SPECTRAL)
        nodes, shares, kink = self._wavelengths(spectral, bool(acting(effects, frozenset({"image.shift"}))))
        fx, fy = self._frequencies
        moving = acting(effects, KERNELS) if self._camera.cfa != "MONO" else ()
        optical = acting(tuple(e for e in effects if e not in moving), TRANSFER_AT)

        def blurred() -> ComplexArray:
            whole = np.array([transfer_at(self._camera, float(w), fx, fy, optical, place_um=place_um) for w in nodes])
            return detected_transfer(self._camera, nodes, shares, whole, fx, fy, optical, [place_um]) + kink

        otf = _kept(self._blurred, (spectral, optical, place_um), blurred)
        return self._mixed(otf, moving, place_um) if moving else otf

    @cached_property
    def _frequencies(self) -> tuple[FloatArray, FloatArray]:
        """fx and fy of the quadrature's nodes along each direction, (directions, nodes), cy/px."""
        turn = np.deg2rad(self._turns)
        return np.outer(np.cos(turn), self._quadrature.frequency), np.outer(np.sin(turn), self._quadrature.frequency)

    def _wavelengths(
        self, spectral: tuple[Effect, ...], dispersed: bool
    ) -> tuple[FloatArray, FloatArray, ComplexArray]:
        """Return a few wavelengths (w,), nm, their weights (sights, w), and the error of the diffraction-limited OTF
        with these few (sights, directions, nodes).

        Where the image is displaced by wavelength (`dispersed`), or weights would be large, the wavelengths are chosen
        for this spectrum."""

        def worked_out() -> tuple[FloatArray, FloatArray, ComplexArray]:
            grid, perfect = self._perfect
            fine = wavelength_shares(self._camera, self._lit, grid, spectral)
            few = self._few
            share = lagrange_shares(grid, fine, few)
            if dispersed or np.abs(share).sum(axis=1).max() > MOST_SHARES:
                few, _ = gauss_rule(grid, fine.mean(axis=0), WAVELENGTHS)
                share = lagrange_shares(grid, fine, few)
            missed = fine - np.array([linear_shares(few, own, grid) for own in share])
            return few, share, np.tensordot(missed, perfect, 1)

        return _kept(self._spectral, (spectral, dispersed), worked_out)

    @cached_property
    def _few(self) -> FloatArray:
        """Wavelengths (w,), nm, chosen for the baseline's spectra. OTFs at them are cached, and serve most changes of
        the spectrum."""
        grid, _ = self._perfect
        return gauss_rule(grid, wavelength_shares(self._camera, self._lit, grid).mean(axis=0), WAVELENGTHS)[0]

    @cached_property
    def _perfect(self) -> tuple[FloatArray, ComplexArray]:
        """Wavelengths (w,), nm, `FINE_NM` apart, and the baseline's OTF at each, (w, directions, nodes)."""
        curves = self._camera.quantum_efficiency.values()
        low, high = min(c.wavelength_nm[0] for c in curves), max(c.wavelength_nm[-1] for c in curves)
        grid = np.linspace(low, high, 2 + int((high - low) / FINE_NM))
        return grid, np.array([transfer_at(self._camera, float(w), *self._frequencies) for w in grid])

    def _mixed(self, otf: ComplexArray, moving: tuple[Effect, ...], place_um: tuple[float, float]) -> ComplexArray:
        """OTFs (sights, directions, nodes) with charge that moves between pixels of different colours."""
        count = len(self._camera.channels)
        parts = [slice(first, first + count) for first in range(0, len(otf), count)]
        rates = np.array([max(self._rate(k), 0.0) for k in range(len(otf))])
        return np.concatenate(
            [mix_channels(self._camera, otf[p], rates[p], *self._frequencies, moving, place_um) for p in parts]
        )

    def _rate(self, sight: int) -> float:
        """Electrons a second of a sight; 1 where its light isn't stated."""
        channel, light = self._lit[sight]
        if light is None:
            return 1.0
        return electron_rate(self._camera, channel, light)

    # --- what changes a profile beside its transfer ---

    def _change(self, effects: tuple[Effect, ...]) -> FloatArray | None:
        """Change of the profiles (edges, distances) by shading, a nonlinear response, exchanged charge and halos; None
        where there is none."""
        changing = acting(effects, CHANGING)
        return _kept(self._changes, changing, lambda: self._changed(changing))

    def _changed(self, effects: tuple[Effect, ...]) -> FloatArray | None:
        model = Uniform(self._camera, effects)
        shading = acting(effects, SHADING | STRAYS)
        spread = halos(self._camera, effects)
        if not shading and model.is_linear and not spread and not model.exchanges_charge:
            return None
        light = self._light_profile
        change = np.zeros_like(light)
        if not model.is_linear:
            for i, edge in enumerate(self.edges):
                scale = edge.summary.contrast / self._dataset.noise.gain
                level = np.linspace(0.0, 1.1, 45) * float(light[i].max())
                bent = model.response(level * scale)
                change[i] += np.interp(light[i], level, bent / scale) - light[i]
        if model.exchanges_charge:
            change += self._exchanged(model)
        if model.strays:
            change += self._strayed(model)
        if shading:
            for i in range(len(self.edges)):
                ratio = self._shade(i, shading) / self._shaded[i]
                change[i] += (light[i] + change[i]) * (ratio - 1.0)
        for share, std_px in spread:
            change += share / wide_contrast(self._camera, effects) * (ndtr(self._distance_px / std_px) - 0.5)
        return change

    def _exchanged(self, model: Uniform) -> FloatArray:
        """Change of the profiles (edges, distances) by charge that unequal neighbours exchange, averaged over the
        places of each edge's channel in the mosaic."""
        change = [
            model.exchanged_e(squares).reshape(-1, len(self._distance_px)).mean(axis=0) / scale
            for squares, scale in self._squares
        ]
        return np.array(change)

    def _strayed(self, model: Uniform) -> FloatArray:
        """Change of the profiles (edges, distances) by light that falls on the next pixels, at the level that it leaves
        in even light."""
        cfa, count = self._camera.cfa, len(self._distance_px)
        step, places = mosaic.step(cfa), mosaic.phases(cfa)
        channel = {place: c for c, mine in places.items() for place in mine}
        found = []
        for edge, lighting, (squares, scale) in zip(self.edges, self._lighting, self._squares, strict=True):
            # their mean along the edge
            shares = {c: [float(s.mean()) for s in model.stray_shares(c, *lighting[:2])] for c in self._camera.channels}
            mine = places[edge.channel]
            change = np.zeros(count)
            for (row, col), square in zip(mine, squares.reshape(len(mine), count, 3, 3), strict=True):
                kernel = np.zeros((3, 3))
                kernel[1, 1] = 1.0 - sum(shares[edge.channel])
                for i, j in ((1, 0), (1, 2), (0, 1), (2, 1)):
                    kernel[i, j] = 0.5 * shares[channel[(row + i - 1) % step, (col + j - 1) % step]][int(j == 1)]
                mixed = square.reshape(count, 9) @ kernel.ravel()
                # far on the bright side all neighbours are lit
                change += (mixed * square[-1, 1, 1] / mixed[-1] - square[:, 1, 1]) / len(mine)
            found.append(change / scale)
        return np.array(found)

    @cached_property
    def _squares(self) -> list[tuple[FloatArray, float]]:
        """Of every edge: the electrons of the 3 x 3 pixels about each distance, (places in the mosaic x distances, 3,
        3), and those of the edge's contrast. Neighbours of other colours have the same profile, at the level of their
        rate in this light."""
        cfa, distance, found = self._camera.cfa, self._distance_px, []
        step, places = mosaic.step(cfa), mosaic.phases(cfa)
        channel = {place: c for c, mine in places.items() for place in mine}
        for edge, profile in zip(self.edges, self._light_profile, strict=True):
            scale = edge.summary.contrast / self._dataset.noise.gain
            turn, light = np.deg2rad(edge.direction_deg), edge.part[0].light_radiance
            rates = {c: self._rate(self._sights.index((c, light))) for c in self._camera.channels}
            own = max(rates[edge.channel], 1e-9)
            mine = places[edge.channel]
            squares = np.empty((len(mine), len(distance), 3, 3))
            for i, j in np.ndindex(3, 3):
                away = distance + np.sin(turn) * (i - 1) + np.cos(turn) * (j - 1)
                there = scale * np.interp(away, distance, profile)
                for k, (row, col) in enumerate(mine):
                    squares[k, :, i, j] = there * rates[channel[(row + i - 1) % step, (col + j - 1) % step]] / own
            found.append((squares.reshape(-1, 3, 3), scale))
        return found

    @cached_property
    def _light_profile(self) -> FloatArray:
        """The baseline's profiles (edges, distances) above the dark level, over the contrast."""
        rising = np.real(self._baseline) @ self._odd
        return np.asarray((0.5 + rising + self._offset[:, None]) * self._shaded)

    def _shade(self, edge: int, effects: Effects) -> FloatArray:
        """Illumination (distances,) over that at the edge, averaged along the edge, with effects."""
        x_um, y_um, light, fit = self._lighting[edge]
        model = Uniform(self._camera, effects)
        light = model.shade_light(light, x_um, y_um)
        if model.strays:
            radiance, place = self.edges[edge].part[0].light_radiance, FieldPoints(x_um, y_um, light)
            rates = {c: light * self._rate(self._sights.index((c, radiance))) for c in self._camera.channels}
            light = model.stray_light(rates, place)[self.edges[edge].channel]
        terms = fit @ light
        reach = self.edges[edge].summary.reach_px
        return np.asarray(polynomial.polyval(np.clip(self._distance_px, -reach, reach) / UNEVEN_PX, terms / terms[0]))

    @cached_property
    def _lighting(self) -> list[tuple[FloatArray, ...]]:
        """Of every edge: x and y of points around it (points,), um from the optical axis; the baseline's illumination
        there; and the matrix (terms, points) that fits a polynomial in the distance from the edge to the illumination
        by least squares."""
        camera = self._camera
        axis, pitch = optical_axis_px(camera), camera.pixel_pitch_um
        found: list[tuple[FloatArray, ...]] = []
        for edge in self.edges:
            row0, col0, row1, col1 = edge.region
            every = max(1, (row1 - row0) // 40), max(1, (col1 - col0) // 40)
            row, col = (a.astype(float) for a in np.mgrid[row0 : row1 : every[0], col0 : col1 : every[1]])
            turn = np.deg2rad(edge.direction_deg)
            middle = 0.5 * (row0 + row1 - 1), 0.5 * (col0 + col1 - 1)
            away = np.cos(turn) * (col - middle[1]) + np.sin(turn) * (row - middle[0])
            near = np.abs(away) < edge.summary.reach_px
            row, col = row[near], col[near]
            light = np.asarray(relative_illumination(camera, row, col), float)
            fit = np.linalg.pinv(polynomial.polyvander(away[near] / UNEVEN_PX, UNEVEN_ORDER))
            found.append(((col - axis[1]) * pitch, (row - axis[0]) * pitch, light, fit))
        return found

    @cached_property
    def jacobian(self) -> dict[str, FloatArray]:
        """Name of a nuisance parameter -> derivative (n,) per prior standard deviation: curvature of the illumination,
        for each region, direction and light; and spectra that aren't stated."""
        base = self.predict(())
        bend = self._light_profile * np.square(self._distance_px / UNEVEN_PX) * UNEVEN_STD
        moved = self._numbers(self._reported((), bend))
        settings = [(e.region, round(e.direction_deg), e.part[0].light_radiance) for e in self.edges]
        found = {}
        for k, setting in enumerate(dict.fromkeys(settings)):
            mine = np.array([s == setting for s in settings])[:, None]
            found[f"edge light:{k}"] = np.where(mine, moved - base, 0.0).ravel()
        for k, change in enumerate(self._other_colours()):
            moved = self._numbers(self._reported((), otf=self._baseline + change[self._sight, self._turn]))
            found[f"edge colour:{k}"] = (moved - base).ravel()
        return found

    def _other_colours(self) -> FloatArray:
        """Changes (ways, sights, directions, nodes) of the OTFs of sights whose light isn't stated, one prior standard
        deviation each.

        An equal-energy spectrum stands for such light. It may be tilted, and differ by triangles along the wavelength.
        """
        blind = np.array([light is None for _, light in self._lit])
        shape = len(blind), *self._frequencies[0].shape
        if not blind.any():
            return np.zeros((0, *shape))
        wavelength_nm = np.arange(300.0, 1101.0, 5.0)
        middle = np.arange(wavelength_nm[0], wavelength_nm[-1] + 1.0, PART_NM)[:, None]
        parts = 1.0 + PART_STD * np.maximum(1.0 - np.abs(wavelength_nm - middle) / PART_NM, 0.0)
        tilted = 1.0 + TILT_STD * np.clip((wavelength_nm - 550.0) / 150.0, -1.5, 1.5)
        ways = [Spectrum.of(wavelength_nm, value) for value in (tilted, *parts)]
        sights = [(channel, way if light is None else light) for way in [None, *ways] for channel, light in self._lit]
        nodes, shares = common_wavelengths(self._camera, sights, count=FINE_WAVELENGTHS)
        apart = shares.reshape(len(ways) + 1, len(self._lit), -1)
        whole = np.array([np.real(transfer_at(self._camera, float(w), *self._frequencies)) for w in nodes])
        return np.tensordot(apart[1:] - apart[:1], whole, 1)


def _clusters(angle_deg: FloatArray, width: float) -> tuple[FloatArray, NDArray[np.intp]]:
    """Clusters of angles with gaps of more than `width` (deg) between them: mean angles (clusters,), and the cluster
    (angles,) of each."""
    order = np.argsort(angle_deg)
    start = np.concatenate([[True], np.diff(angle_deg[order]) > width])
    label = np.cumsum(start) - 1
    which = np.empty(len(order), np.intp)
    which[order] = label
    count = np.bincount(which)
    return np.bincount(which, angle_deg) / count, which


def _place_um(dataset: Dataset, edge: SideEdge) -> tuple[float, float]:
    """(x, y) of the edge's middle from the sensor's centre, um."""
    field_mm = edge.part[0].field_mm
    if field_mm is not None and edge.part[0].region is not None:
        return 1000.0 * field_mm[1], 1000.0 * field_mm[0]
    pitch = dataset.camera.pixel_pitch_um
    row0, col0, row1, col1 = edge.region
    return 0.5 * pitch * (col0 + col1 - dataset.camera.cols), 0.5 * pitch * (row0 + row1 - dataset.camera.rows)
