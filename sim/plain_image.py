"""Images of scenes behind a lens that blurs alike everywhere: electrons a second of every channel, before the fall-off
of light.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.interpolate import CubicSpline
from scipy.ndimage import map_coordinates

from sim.camera import CameraModel
from sim.detection import collection_m2_sr, detect_light, otf_wavelengths
from sim.effects.base import Effect
from sim.optics.diffraction import aperture_otf
from sim.optics.illumination import sin_theta as sin_theta_at
from sim.optics.imaging import DiffractionLimited
from sim.point import HIGHEST_CY_PER_PX, Blur, edge_profile
from sim.scene.render import EVERYWHERE, Drawing, Grid, LitSurface, cell_means, draw
from sim.scene.scenes import KnifeEdge, PosedEdges, Scene, ScreenPattern, SpectralImage, UniformField
from sim.spectrum import FloatArray, Spectrum, lagrange_shares
from sim.stages import ComplexArray, image_of, light_of
from sim.uniform import electron_rate

#: Wavelengths at which a whole frame's transfer function is averaged: within 1e-3 near the cutoff, where little
#: contrast is left.
FRAME_WAVELENGTHS = 5

#: How near wavelengths land to each other that are moved as one.
ALIKE_PX = 1e-6
MIDDLE_NM = 550.0


class KeptTransfers:
    """The transfers that whole frames were blurred with, for the next scene in the same lights; of one camera with one
    set of effects. The latest `most` are kept, one a channel and light, of 12 MB at 480 x 640 px and 3 samples a
    pixel.
    """

    def __init__(self, most: int = 3) -> None:
        self._kept: OrderedDict[Hashable, list[NDArray[np.complex64]]] = OrderedDict()
        self._most = most

    def get(self, key: Hashable, make: Callable[[], list[NDArray[np.complex64]]]) -> list[NDArray[np.complex64]]:
        """Return the transfers that are kept for `key`; without any, call `make` and keep its result."""
        if key not in self._kept:
            self._kept[key] = make()
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]


def plain_images(
    camera: CameraModel,
    scene: Scene,
    effects: Sequence[Effect],
    oversample: int,
    margin_px: int,
    transfers: KeptTransfers | None = None,
) -> dict[str, FloatArray]:
    """Electrons a second of every channel behind a lens that blurs alike everywhere, (rows, cols) each, before
    cos^4.
    """
    shape = camera.rows, camera.cols
    if isinstance(scene, UniformField):
        images = {c: _uniform_image(camera, c, scene, effects) for c in camera.channels}
    elif isinstance(scene, KnifeEdge):
        images = {c: _edge_image(camera, c, scene, effects) for c in camera.channels}
    elif isinstance(scene, PosedEdges):
        images = _draw_posed_edges(camera, scene, effects)
    elif isinstance(scene, SpectralImage):
        images = _cube_images(camera, scene, effects, oversample, _margin_for(camera, effects, margin_px))
    else:
        grid = Grid(*shape, oversample, _margin_for(camera, effects, margin_px))
        images = _blur_images(camera, scene, effects, grid, transfers)
    return images


def _field_of_rates(
    camera: CameraModel, channel: str, lights: Sequence[LitSurface], effects: Sequence[Effect], kind: str
) -> list[CubicSpline] | None:
    """Electron rates relative to the axis as functions of sin^2 of the chief ray's angle, one a light, where an
    effect's transmittance depends on the angle; None where none does.
    """
    if not image_of(camera, effects).transmittance:
        return None
    corners = sin_theta_at(
        camera, np.array([0, 0, camera.rows - 1, camera.rows - 1]), np.array([0, camera.cols - 1] * 2)
    )
    square = np.linspace(0.0, float(np.max(corners)) ** 2, 17)
    _, weight = detect_light(camera, channel, lights, effects, kind, np.sqrt(square))
    rate = np.sum(weight, axis=-1)
    if np.all(rate == rate[0]):
        return None
    relative = rate / np.where(rate[0] > 0, rate[0], 1.0)
    return [CubicSpline(square, column) for column in relative.T]


def _uniform_image(camera: CameraModel, channel: str, scene: UniformField, effects: Sequence[Effect]) -> FloatArray:
    image = np.full((camera.rows, camera.cols), electron_rate(camera, channel, scene.radiance, effects, scene.kind))
    field = _field_of_rates(camera, channel, [(scene.radiance, None)], effects, scene.kind)
    if field is not None:
        row, col = np.arange(camera.rows)[:, None], np.arange(camera.cols)[None, :]
        image *= field[0](sin_theta_at(camera, row, col) ** 2)
    return image


def _edge_image(camera: CameraModel, channel: str, scene: KnifeEdge, effects: Sequence[Effect]) -> FloatArray:
    """Straight edges need no drawing: every pixel takes the profile of the nearest region's edge at its own
    distance.
    """
    if not scene.regions:
        raise ValueError("a knife edge with no region shows nothing: give at least one edge region")
    row, col = np.meshgrid(np.arange(camera.rows, dtype=float), np.arange(camera.cols, dtype=float), indexing="ij")
    away = []
    for edge in scene.regions:
        row0, col0, row1, col1 = edge.region
        down = np.maximum(np.maximum(row0 - row, row - (row1 - 1)), 0.0)
        across = np.maximum(np.maximum(col0 - col, col - (col1 - 1)), 0.0)
        away.append(np.hypot(down, across))
    owner = np.argmin(np.stack(away), axis=0)
    spectra = scene.dark_radiance, scene.light_radiance
    rates = [electron_rate(camera, channel, radiance, effects, scene.kind) for radiance in spectra]
    field = _field_of_rates(camera, channel, [(radiance, None) for radiance in spectra], effects, scene.kind)
    image = np.empty(row.shape)
    moves = image_of(camera, effects).moves
    if moves:
        mean_nm = _mean_wavelength(camera, channel, scene.light_radiance, effects, scene.kind)
        from_px = _undo_shift_px(camera, row, col, mean_nm, effects)
    for index, edge in enumerate(scene.regions):
        mine = owner == index
        if not np.any(mine):
            continue
        dark, light = rates
        if field is not None:
            square = sin_theta_at(camera, row[mine], col[mine]) ** 2
            dark, light = dark * field[0](square), light * field[1](square)
        row0, col0, row1, col1 = edge.region
        middle = 0.5 * (row0 + row1 - 1), 0.5 * (col0 + col1 - 1)
        if moves:
            # by place as the channel's mean wavelength is moved; what others differ from that, alike over a region,
            # blurs
            distance, angle_deg = _bend_edge(edge.distance_px(*from_px), middle)
            distance = distance[mine]
        else:
            distance, angle_deg = edge.distance_px(row[mine], col[mine]), edge.angle_deg
        pitch = camera.pixel_pitch_um
        place_um = (middle[1] - 0.5 * (camera.cols - 1)) * pitch, (middle[0] - 0.5 * (camera.rows - 1)) * pitch
        dim, bright = (
            edge_profile(
                camera,
                channel,
                radiance,
                angle_deg,
                distance,
                effects,
                scene.kind,
                place_um=place_um,
                collected=True,
            )
            for radiance in spectra
        )
        image[mine] = light * bright + dark * (1.0 - dim)
    return image


def _draw_posed_edges(camera: CameraModel, scene: PosedEdges, effects: Sequence[Effect]) -> dict[str, FloatArray]:
    """Electrons a second of every channel, before cos^4: a pixel sees the profile of its edge at its own distance, and
    lens and perspective bend distance and slope along the edge. The transfer is that of the place where the edge's
    middle is seen.
    """
    moves = image_of(camera, effects).moves
    margin = _margin_for(camera, effects, 1)
    axes = [np.arange(-margin, n + margin, dtype=float) for n in (camera.rows, camera.cols)]
    owner, away_mm = scene.distances(*axes)
    slopes = [np.gradient(distance) for distance in away_mm]
    pixels = np.meshgrid(np.arange(camera.rows, dtype=float), np.arange(camera.cols, dtype=float), indexing="ij")
    square = sin_theta_at(camera, *pixels) ** 2
    inner = slice(margin, margin + camera.rows), slice(margin, margin + camera.cols)
    spectra = scene.dark_radiance, scene.light_radiance
    images: dict[str, FloatArray] = {}
    for channel in camera.channels:
        place = None
        if moves:
            mean_nm = _mean_wavelength(camera, channel, scene.light_radiance, effects, scene.kind)
            place = np.stack(_undo_shift_px(camera, pixels[0], pixels[1], mean_nm, effects)) + margin
        mine = owner[inner] if place is None else map_coordinates(owner, place, order=0, mode="nearest")
        rates = [electron_rate(camera, channel, radiance, effects, scene.kind) for radiance in spectra]
        field = _field_of_rates(camera, channel, [(radiance, None) for radiance in spectra], effects, scene.kind)
        image = np.empty((camera.rows, camera.cols))
        for index, (edge, distance, (down, across)) in enumerate(zip(scene.edges, away_mm, slopes, strict=True)):
            use = mine == index
            if not np.any(use):
                continue
            at = np.array([np.clip(float(v), 0.0, n - 1.0) for v,
                           n in zip(scene.warp().to_camera(*edge.centre_mm), (camera.rows, camera.cols),
                                    strict=True)])  # fmt: skip
            if place is None:
                near = tuple(np.rint(at).astype(int) + margin)
                angle_deg = float(np.rad2deg(np.arctan2(down[near], across[near])))
                across_px = (distance / np.hypot(down, across))[inner][use]
            else:
                at = at + np.ravel(_shift_px(camera, at[:1], at[1:], mean_nm, effects))
                there = np.asarray(map_coordinates(distance, place, order=3, mode="nearest"))
                bent, angle_deg = _bend_edge(there, (float(at[0]), float(at[1])))
                across_px = bent[use]
            from_centre_um = (at - 0.5 * (np.array([camera.rows, camera.cols]) - 1.0)) * camera.pixel_pitch_um
            profile = partial(
                edge_profile, camera, channel, angle_deg=angle_deg, distance_px=across_px, kind=scene.kind,
                collected=True, place_um=(float(from_centre_um[1]), float(from_centre_um[0])),
            )  # fmt: skip
            profiles = [profile(radiance=scene.light_radiance, effects=effects)]
            if not _have_same_colour(*spectra):
                profiles.append(profile(radiance=scene.dark_radiance, effects=effects))
            dark, light = rates[0] * np.ones(1), rates[1] * np.ones(1)
            if field is not None:
                dark, light = dark * field[0](square[use]), light * field[1](square[use])
            image[use] = light * profiles[0] + dark * (1.0 - profiles[-1])
        images[channel] = np.maximum(image, 0.0)
    return images


def _bend_edge(distance: FloatArray, at_px: tuple[float, float]) -> tuple[FloatArray, float]:
    """Compute distances from an edge that the lens bends, to first order.

    distance : distance (px) from the straight edge of the place where each pixel's light comes from (rows, cols)
    at_px : (row, col) of the place at which the angle is wanted

    Returns each pixel's distance from the bent edge (px), and the edge's angle at the place (degrees).
    """
    down, across = (np.asarray(part) for part in np.gradient(distance))
    near = tuple(int(np.clip(np.rint(v), 0, n - 1)) for v, n in zip(at_px, distance.shape, strict=True))
    return distance / np.hypot(down, across), float(np.rad2deg(np.arctan2(down[near], across[near])))


def _have_same_colour(first: Spectrum, other: Spectrum) -> bool:
    """Return whether two lights have the same colour."""
    (w, a), (x, b) = first.arrays, other.arrays
    return (
        w.shape == x.shape and bool(np.all(w == x)) and np.allclose(a * np.sum(b), b * np.sum(a), rtol=1e-9, atol=0.0)
    )


def _blur_images(
    camera: CameraModel, scene: Scene, effects: Sequence[Effect], grid: Grid, kept: KeptTransfers | None = None
) -> dict[str, FloatArray]:
    """Electrons a second (rows, cols) of every channel, of a scene drawn by area and convolved, before cos^4.

    With OTF_k at a few wavelengths, w_lk the share of light l's electrons that goes with each, and F the Fourier
    transform, the image is sum_k OTF_k F[sum_l w_lk picture_l]. The ground's picture is 1 minus all others', so that
    only the differences to the ground are transformed. `kept`: transfers of scenes before in the same lights, and those
    of this one.
    """
    drawing = draw(scene, grid)
    if isinstance(scene, ScreenPattern):
        drawing = _show_on_screen(drawing, grid, camera, effects)
    lights: list[LitSurface] = [drawing.ground, *(layer.light for layer in drawing.layers)]
    m = grid.margin_px
    ny, nx = grid.shape
    fy, fx, pixel_y, pixel_x = pixel_on_grid(camera, grid)
    images: dict[str, FloatArray] = {}
    moved = _Moved(camera, grid, effects) if image_of(camera, effects).moves else None
    blur = Blur(camera, effects, collected=True)
    transformed: list[NDArray[np.complex64]] = []
    for channel in camera.channels:
        wavelength_nm, weight = detect_light(camera, channel, lights, effects, scene.kind)
        weight = weight * collection_m2_sr(camera)
        nodes, _ = otf_wavelengths(camera, channel, wavelength_nm, np.sum(weight, axis=0), FRAME_WAVELENGTHS)
        shares = lagrange_shares(wavelength_nm, weight, nodes)
        field = _field_of_rates(camera, channel, lights, effects, scene.kind)
        pictures: list[NDArray[np.floating[Any]]] = [layer.coverage for layer in drawing.layers]
        # lights of one colour change alike over the field
        apart = field is not None and any(not np.allclose(f.c, field[0].c, rtol=0.0, atol=1e-12) for f in field)
        if field is not None and apart:
            pictures = [
                picture * _relative_to_ground(camera, grid, layer.window, field[index], field[0])
                for index, (layer, picture) in enumerate(zip(drawing.layers, pictures, strict=True), 1)
            ]
        windows = [layer.window for layer in drawing.layers]
        over = shares[1:] - shares[0]
        # Few pictures are transformed one by one, once for all channels; of many, one sum a wavelength.
        few = len(pictures) <= nodes.size
        if moved is not None and few and (apart or not transformed) and moved.alike:
            pictures = [moved.picture(_whole(grid, [w], [p], [1.0])) for w, p in zip(windows, pictures, strict=True)]
            windows = [EVERYWHERE] * len(pictures)
        if few and (apart or not transformed) and (moved is None or moved.alike):
            transformed = [_transform(grid, [w], [p], [1.0]) for w, p in zip(windows, pictures, strict=True)]

        spectrum = np.zeros((ny, nx // 2 + 1), np.complex64)
        if transformed and few:
            key = (channel, nodes.tobytes(), over.tobytes(), grid)
            make = partial(_layer_transfers, blur, nodes, over, grid)
            for transfer, picture in zip(make() if kept is None else kept.get(key, make), transformed, strict=True):
                spectrum += transfer * picture
        else:
            for node, factors in zip(nodes, over.T.tolist(), strict=True):
                total = _whole(grid, windows, pictures, factors)
                if moved is not None:
                    total = moved.picture(total, float(node))
                acting = blur.at(float(node), fx, fy) * pixel_x * pixel_y
                spectrum += acting.astype(np.complex64) * np.asarray(fft.rfft2(total), np.complex64)
        image = _at_pixels(spectrum, grid.oversample, nx)[m : m + grid.rows, m : m + grid.cols].astype(float)
        image = np.maximum(image + np.sum(weight[0]), 0.0)
        if field is not None:
            row, col = np.arange(camera.rows)[:, None], np.arange(camera.cols)[None, :]
            image *= field[0](sin_theta_at(camera, row, col) ** 2)
        images[channel] = image
    return images


def _layer_transfers(blur: Blur, nodes: FloatArray, over: FloatArray, grid: Grid) -> list[NDArray[np.complex64]]:
    """Compute the factor on the transform of each layer's picture: sum_k over_lk OTF_k with the pixel's aperture.

    nodes : wavelengths (K,) in nm
    over : weights of the nodes in each layer (L, K)

    Returns L arrays over the frequencies of `grid`.
    """
    fy, fx, pixel_y, pixel_x = pixel_on_grid(blur.camera, grid)
    total = np.zeros((len(over), fy.size, fx.size))
    for node, factors in zip(nodes, over.T, strict=True):
        transfer = blur.at(float(node), fx, fy)
        total = total.astype(np.result_type(total, transfer), copy=False)  # real of a symmetrical lens
        for index, factor in enumerate(factors):
            total[index] += factor * transfer
    pixel = (pixel_x * pixel_y).astype(np.complex64)
    single = np.complex64 if np.iscomplexobj(total) else np.float32
    return [part.astype(single) * pixel for part in total]


def _show_on_screen(drawing: Drawing, grid: Grid, camera: CameraModel, effects: Sequence[Effect]) -> Drawing:
    """Return a screen's pattern as the screen shows it, given what was asked for."""
    light = light_of(camera, effects)
    if not light.screen:
        return drawing
    row, col = grid.axes_px()
    y_um = (row[:, None] - 0.5 * (camera.rows - 1)) * camera.pixel_pitch_um
    x_um = (col[None, :] - 0.5 * (camera.cols - 1)) * camera.pixel_pitch_um
    (lit,) = drawing.layers
    return replace(drawing, layers=(replace(lit, coverage=light.show_share(lit.coverage, x_um, y_um)),))


def _cube_images(
    camera: CameraModel, scene: SpectralImage, effects: Sequence[Effect], oversample: int, margin_px: int
) -> dict[str, FloatArray]:
    """Electrons a second (rows, cols) of every channel, of a cube of spectra, before cos^4.

    As in `_blur_images`, image = sum_k OTF_k F[sum_b w_bk band_b]: a cube of any number of bands becomes one picture
    a wavelength of the rule. A cube whose samples are the camera's pixels needs no finer grid: its transfer is folded.
    """
    moves = image_of(camera, effects).moves
    blur = Blur(camera, effects, collected=True)
    aligned = scene.to_camera is None and not moves
    grid = Grid(camera.rows, camera.cols, 1 if aligned else oversample, margin_px)
    # An aligned picture starts at pixel [0, 0]; what is left of the grid keeps its two ends apart.
    shape = tuple(fft.next_fast_len(n, real=True) for n in grid.shape) if aligned else grid.shape
    ny, nx = shape
    start = 0 if aligned else margin_px
    fy, fx, pixel_y, pixel_x = pixel_on_grid(camera, grid)
    moved = _Moved(camera, grid, effects) if moves else None
    images: dict[str, FloatArray] = {}
    for channel in camera.channels:
        nodes, pictures = _node_pictures(camera, channel, scene, effects)
        spectrum = np.zeros((ny, nx // 2 + 1), np.complex64)
        for node, picture in zip(nodes, pictures, strict=True):
            if aligned:
                transfer = _fold_transfer(blur, float(node), (ny, nx))
                fine = np.zeros((ny, nx), np.float32)
                covered = picture[: camera.rows + margin_px, : camera.cols + margin_px]
                fine[: covered.shape[0], : covered.shape[1]] = covered
            else:
                transfer = blur.at(float(node), fx, fy)
                drawn = cell_means(picture.astype(float), scene.warp(), grid, 0.0)
                fine = drawn.astype(np.float32) if moved is None else moved.picture(drawn, float(node))
            transformed = fft.rfft2(fine)
            transformed *= transfer.astype(np.complex64 if np.iscomplexobj(transfer) else np.float32)
            spectrum += transformed
        if not aligned:
            spectrum *= (pixel_y * pixel_x).astype(np.complex64)
        image = _at_pixels(spectrum, grid.oversample, nx)[start : start + grid.rows, start : start + grid.cols]
        images[channel] = np.maximum(image, 0.0).astype(float)
    return images


def _node_pictures(
    camera: CameraModel, channel: str, scene: SpectralImage, effects: Sequence[Effect]
) -> tuple[FloatArray, NDArray[np.float32]]:
    """Wavelengths (nm) of the frame's rule, and the electrons a second that the cube's samples give at each:
    (nodes, rows, cols).
    """
    lights: list[LitSurface] = [(band, None) for band in scene.bands()]
    wavelength_nm, weight = detect_light(camera, channel, lights, effects, scene.kind)
    weight = weight * collection_m2_sr(camera)
    nodes, _ = otf_wavelengths(camera, channel, wavelength_nm, np.sum(weight, axis=0), FRAME_WAVELENGTHS)
    shares = lagrange_shares(wavelength_nm, weight, nodes)
    field = _field_of_rates(camera, channel, lights, effects, scene.kind)
    rows, cols, bands = scene.radiance.shape
    out = np.empty((nodes.size, rows, cols), np.float32)
    strip = max(1, 4_000_000 // (cols * bands))
    for top in range(0, rows, strip):
        part = scene.radiance[top : top + strip].reshape(-1, bands)
        if field is not None:
            v, u = np.meshgrid(np.arange(top, min(top + strip, rows)) + 0.5, np.arange(cols) + 0.5, indexing="ij")
            square = np.minimum(sin_theta_at(camera, *scene.warp().to_camera(u, v)) ** 2, field[0].x[-1]).ravel()
            part = part * np.stack([spline(square) for spline in field], axis=1)
        out[:, top : top + strip] = (shares.T.astype(part.dtype) @ part.T).reshape(nodes.size, -1, cols)
    return nodes, out


def _fold_transfer(blur: Blur, wavelength_nm: float, shape: tuple[int, int]) -> FloatArray | ComplexArray:
    """Return the transfer of lens and effects with the pixel's aperture and a picture's square of one pixel, folded
    onto samples of one pixel.
    """
    from sim.optics.fold import fold_diffraction, fold_transfer  # here: the compiler's library takes a while to load

    camera, imaging = blur.camera, blur.camera.lens.imaging
    cutoff = camera.pixel_pitch_um * imaging.cutoff_cy_per_um(wavelength_nm, camera.lens.f_number)
    if isinstance(imaging, DiffractionLimited) and blur.is_lens_alone:
        return fold_diffraction(shape, camera.fill_factor, cutoff)
    return fold_transfer(
        lambda fx, fy: blur.at(wavelength_nm, fx, fy),
        shape,
        camera.fill_factor,
        min(cutoff, HIGHEST_CY_PER_PX / 8.0),
    )


def pixel_on_grid(camera: CameraModel, grid: Grid) -> tuple[FloatArray, FloatArray, ComplexArray, ComplexArray]:
    """Frequencies fy (n, 1) and fx (1, n), cy/px, of a drawing's transform, and the factors on each that make samples
    pixels.

    The pixel's aperture; a sample is a mean over its square, which is undone; a pixel's centre lies between even
    samples.
    """
    s = grid.oversample
    ny, nx = grid.shape
    fy, fx = fft.fftfreq(ny, 1.0 / s)[:, None], fft.rfftfreq(nx, 1.0 / s)[None, :]
    shift = 1j * np.pi * (1.0 - 1.0 / s)
    pixel_x, pixel_y = (aperture_otf(f, 0.0, camera.fill_factor) * np.exp(shift * f) / np.sinc(f / s) for f in (fx, fy))
    return fy, fx, pixel_y, pixel_x


def _at_pixels(spectrum: ComplexArray | NDArray[np.complex64], oversample: int, cols: int) -> FloatArray:
    """Back from a transform to every `oversample`-th row and column: the rows are folded first."""
    folded_rows = spectrum.reshape(oversample, len(spectrum) // oversample, -1).sum(axis=0) / oversample
    return np.asarray(fft.irfft(fft.ifft(folded_rows, axis=0), cols, axis=1)[:, ::oversample])


def _shift_px(
    camera: CameraModel, row: FloatArray, col: FloatArray, wavelength_nm: float, effects: Sequence[Effect]
) -> tuple[FloatArray, FloatArray]:
    """Return how far (rows, columns) the light of one wavelength lands from where the baseline has it, at points in
    px."""
    pitch = camera.pixel_pitch_um
    x_um, y_um = (col - 0.5 * (camera.cols - 1)) * pitch, (row - 0.5 * (camera.rows - 1)) * pitch
    right, down = image_of(camera, effects).shift_um(x_um, y_um, wavelength_nm)
    shape = np.broadcast_shapes(row.shape, col.shape)
    return np.broadcast_to(np.asarray(down) / pitch, shape), np.broadcast_to(np.asarray(right) / pitch, shape)


def _mean_wavelength(
    camera: CameraModel, channel: str, radiance: Spectrum | None, effects: Sequence[Effect], kind: str
) -> float:
    """Mean wavelength (nm) of the light that a channel detects."""
    wavelength_nm, weight = detect_light(camera, channel, [(radiance, None)], effects, kind)
    nodes, share = otf_wavelengths(camera, channel, wavelength_nm, weight[0], 1)
    return float(nodes @ share)


def _undo_shift_px(
    camera: CameraModel, row: FloatArray, col: FloatArray, wavelength_nm: float, effects: Sequence[Effect]
) -> tuple[FloatArray, FloatArray]:
    """Return the places p with p + shift(p) = (row, col), by fixed-point steps to 1e-4 px: shifts change by less than
    they are.
    """
    from_row, from_col = row, col
    for _ in range(200):  # the steps of a fisheye shrink by sin^2 of the angle from the axis each
        down, right = _shift_px(camera, from_row, from_col, wavelength_nm, effects)
        step = max(np.max(np.abs(row - down - from_row)), np.max(np.abs(col - right - from_col)))
        from_row, from_col = row - down, col - right
        if step < 1e-4:
            return from_row, from_col
        if step > camera.rows + camera.cols:
            break
    raise ValueError(
        f"light is moved by {max(np.max(np.abs(down)), np.max(np.abs(right))):.3g} px, and by steps of {step:.3g} px "
        "back no place is found that it comes from: the distortion folds the image; give less of it"
    )


def _margin_for(camera: CameraModel, effects: Sequence[Effect], margin_px: int) -> int:
    """Return the margin that a frame needs for light that is moved in from outside it."""
    if not image_of(camera, effects).moves:
        return margin_px
    row, col = (np.linspace(0.0, n - 1.0, 33) for n in (camera.rows, camera.cols))
    rim_row = np.concatenate([row, row, np.zeros(33), np.full(33, camera.rows - 1.0)])
    rim_col = np.concatenate([np.zeros(33), np.full(33, camera.cols - 1.0), col, col])
    out = 0.0
    for wavelength_nm in (400.0, 550.0, 700.0):
        from_row, from_col = _undo_shift_px(camera, rim_row, rim_col, wavelength_nm, effects)
        out = max(out, *(float(np.max(np.abs(a - b))) for a, b in ((from_row, rim_row), (from_col, rim_col))))
    return margin_px + int(np.ceil(out))


class _Moved:
    """Drawing on a grid, moved by the lens's geometry before anything blurs it.

    A sample is taken where its light would be without the effects' shifts; between the drawing's samples by splines of
    the third order: 3e-3 of the contrast up to 1/2 cy/px and 3 samples a pixel.
    """

    def __init__(self, camera: CameraModel, grid: Grid, effects: Sequence[Effect]) -> None:
        self._camera, self._grid, self._effects = camera, grid, effects
        #: Pixels of the drawing, and one more all round.
        self._rows, self._cols = (
            np.arange(-grid.margin_px - 1.0, n + grid.margin_px + 1.0) for n in (camera.rows, camera.cols)
        )
        ends = [np.stack(self._from_px(nm)) for nm in (400.0, 550.0, 700.0)]
        #: Whether all wavelengths are moved alike.
        self.alike = bool(np.ptp(ends, axis=0).max() < ALIKE_PX)

    def picture(self, drawn: NDArray[np.floating[Any]], wavelength_nm: float = MIDDLE_NM) -> NDArray[np.float32]:
        """Return a picture on the grid, moved as light of a wavelength is."""
        from sim.scene.displace import displace_drawing  # here: the compiler's library takes a while to load

        row, col = (part + self._grid.margin_px for part in self._from_px(wavelength_nm))
        return displace_drawing(drawn, row, col, self._grid.oversample).astype(np.float32)

    def _from_px(self, wavelength_nm: float) -> tuple[FloatArray, FloatArray]:
        row, col = np.meshgrid(self._rows, self._cols, indexing="ij")
        return _undo_shift_px(self._camera, row, col, wavelength_nm, self._effects)


def _relative_to_ground(
    camera: CameraModel, grid: Grid, window: tuple[slice, slice], field: CubicSpline, ground: CubicSpline
) -> FloatArray:
    """Return how a light's rate changes over the field, over how the ground's does, on a window of the grid."""
    row, col = grid.axes_px()
    square = np.minimum(sin_theta_at(camera, row[window[0], None], col[None, window[1]]) ** 2, field.x[-1])
    return np.asarray(field(square) / np.maximum(ground(square), 1e-12))


def _whole(
    grid: Grid,
    windows: Sequence[tuple[slice, slice]],
    pictures: Sequence[NDArray[np.floating[Any]]],
    factors: Sequence[float],
) -> NDArray[np.float32]:
    """Return the sum of factor x picture, each on its window of the grid."""
    total = np.zeros(grid.shape, np.float32)
    for window, picture, factor in zip(windows, pictures, factors, strict=True):
        total[window] += factor * picture
    return total


def _transform(
    grid: Grid,
    windows: Sequence[tuple[slice, slice]],
    pictures: Sequence[NDArray[np.floating[Any]]],
    factors: Sequence[float],
) -> NDArray[np.complex64]:
    """Fourier transform of the sum of factor x picture."""
    return np.asarray(fft.rfft2(_whole(grid, windows, pictures, factors)), np.complex64)
