"""Images of scenes behind a traced lens, which blurs, distorts and shades differently over the field."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from sim.camera import CameraModel
from sim.detection import collection_m2_sr, detect_light
from sim.effects.base import Effect
from sim.optics.illumination import optical_axis_px
from sim.optics.table import LensTable
from sim.plain_image import FRAME_WAVELENGTHS, pixel_on_grid
from sim.point import Blur
from sim.scene.render import Grid, Layer, LitSurface, cell_means, draw
from sim.scene.scenes import Scene, SpectralImage
from sim.sensor import mosaic
from sim.spectrum import FloatArray, gauss_rule
from sim.stages import ComplexArray, image_of

#: Share of the strongest picture's light below which a picture of a traced lens's scene is left out.
LEAST_SHARE = 1e-4


def traced_image(
    camera: CameraModel,
    table: LensTable,
    scene: Scene,
    effects: Sequence[Effect],
    oversample: int,
    margin_px: int,
    placed: str,
) -> FloatArray:
    """Electrons a second behind a traced lens: every pixel that of its own channel, (rows, cols).

    A sum over few pictures: each blurred channel by channel with the point spread functions of its light
    (summed over the table's wavelengths as it is detected). The effects' `transfer`, alike all over the frame, acts on
    the picture in the image before it is blurred: the two commute but for what the lens changes within the reach of the
    effect, some 1e-3 of the blur.
    """
    # here: the compiler's library takes a while to load
    from sim.optics.distorted import distort
    from sim.optics.field_mapping import ImageFrame, illumination, source_grid
    from sim.optics.field_mapping import margin_px as blur_margin_px
    from sim.optics.kernels import Kernels, Tile
    from sim.optics.superposition import superpose

    if image_of(camera, effects).moves:
        raise ValueError(
            "an effect moves the light of a traced lens, which does that itself: leave distortion and lateral colour "
            "to the prescription, or image by another model"
        )
    axis = optical_axis_px(camera)
    frame = ImageFrame(camera.rows, camera.cols, camera.pixel_pitch_um, camera.fill_factor, axis)
    margin_px = max(margin_px, blur_margin_px(table, camera.pixel_pitch_um))
    target = Grid(camera.rows, camera.cols, oversample, margin_px)
    distorted = placed == "ideal"
    grid = source_grid(table, frame, oversample, margin_px) if distorted else target
    period, phases = mosaic.step(camera.cfa), mosaic.phases(camera.cfa)
    image = np.zeros((camera.rows, camera.cols))
    ground, over, pictures = _pictures_by_rank(camera, table, scene, effects, grid)
    for channel, light in zip(camera.channels, ground, strict=True):
        for row0, col0 in phases[channel]:
            image[row0::period, col0::period] += illumination(table, light, frame, (row0, col0), period)
    blur = Blur(camera, effects, collected=True)
    blurs = not blur.is_lens_alone
    tiles: list[Tile] | None = None
    for weight, picture in zip(over, pictures, strict=True):
        imaged = distort(picture, grid, target, table, frame) if distorted else picture.astype(np.float32)
        # Without blurring effects one picture serves all channels.
        shared = [list(range(len(weight)))] if not blurs else [[k] for k in range(len(weight))]
        spectrum = fft.rfft2(imaged) if blurs else None
        for members in shared:
            kernels = Kernels(table, weight[members], frame, oversample, distorted=distorted)
            # The first picture, with most of the light, says how large tiles may be.
            tiles = kernels.tiles(target) if tiles is None else tiles
            blurred = imaged
            if spectrum is not None:
                light = np.sum(weight[members[0]], axis=0)
                transfer = _effects_transfer(blur, table, light, target)
                blurred = np.asarray(fft.irfft2(spectrum * transfer, imaged.shape), np.float32)
            superpose(blurred, target, kernels, [phases[camera.channels[k]] for k in members], period, image, tiles)
    return np.maximum(image, 0.0)


def _pictures_by_rank(
    camera: CameraModel, table: LensTable, scene: Scene, effects: Sequence[Effect], grid: Grid
) -> tuple[FloatArray, FloatArray, Iterator[FloatArray]]:
    """Yield a scene as an even ground (channels, F, W) and pictures on a grid with their lights (pictures, channels, F,
    W): the fewest that leave 1e-4 of the strongest's light.
    """
    if isinstance(scene, SpectralImage):
        rows, cols, bands = scene.radiance.shape
        lights: list[LitSurface] = [(band, None) for band in scene.bands()]
        weight = _table_light(camera, table, lights, effects, scene.kind)
        flat = scene.radiance.reshape(-1, bands)
        # The spectra's own correlations make the rank smaller still: cube = (cube E) E^T with orthogonal pictures.
        energy, basis = np.linalg.eigh(flat.T.astype(float) @ flat if flat.dtype == float else _gram(flat))
        size = np.sqrt(np.maximum(energy, 0.0))
        u, strength, vt = np.linalg.svd(size[:, None] * (basis.T @ weight.reshape(bands, -1)), full_matrices=False)
        kept = strength > LEAST_SHARE * max(float(strength[0]), 1e-300)
        mix = basis @ (u[:, kept] / np.where(size > 0, size, 1.0)[:, None])
        over = (strength[kept, None] * vt[kept]).reshape(-1, *weight.shape[1:])
        drawn = (
            cell_means((flat @ column.astype(flat.dtype)).reshape(rows, cols).astype(float), scene.warp(), grid, 0.0)
            for column in mix.T
        )
        return np.zeros(weight.shape[1:]), over, drawn
    drawing = draw(scene, grid)
    lights = [drawing.ground, *(layer.light for layer in drawing.layers)]
    weight = _table_light(camera, table, lights, effects, scene.kind)
    layers = drawing.layers
    if len(layers) <= 1:
        return weight[0], weight[1:] - weight[0], (_on_grid(grid, layers, [1.0]) for _ in layers)
    u, strength, vt = np.linalg.svd((weight[1:] - weight[0]).reshape(len(layers), -1), full_matrices=False)
    kept = strength > LEAST_SHARE * max(float(strength[0]), 1e-300)
    over = (strength[kept, None] * vt[kept]).reshape(-1, *weight.shape[1:])
    return weight[0], over, (_on_grid(grid, layers, column.tolist()) for column in u[:, kept].T)


def _gram(flat: NDArray[np.floating]) -> FloatArray:
    """flat^T flat in double precision, without a copy of all of it."""
    total = np.zeros((flat.shape[1], flat.shape[1]))
    for start in range(0, len(flat), 65536):
        part = flat[start : start + 65536].astype(float)
        total += part.T @ part
    return total


def _on_grid(grid: Grid, layers: Sequence[Layer], factors: Sequence[float]) -> FloatArray:
    """Return the sum of factor x coverage of some layers."""
    if len(layers) == 1 and factors[0] == 1.0 and layers[0].coverage.shape == grid.shape:
        return layers[0].coverage
    total = np.zeros(grid.shape)
    for layer, factor in zip(layers, factors, strict=True):
        total[layer.window] += factor * layer.coverage
    return total


def _table_light(
    camera: CameraModel, table: LensTable, lights: Sequence[LitSurface], effects: Sequence[Effect], kind: str
) -> FloatArray:
    """Electrons a second that each light gives every channel at every field and wavelength of a table, on an even field
    and without relative illumination: (lights, channels, F, W). Between the table's wavelengths its functions are
    linear.
    """
    radius_mm = np.hypot(*table.chief_mm.T)
    sine = radius_mm / np.hypot(radius_mm, table.focal_length_mm)
    out = np.empty((len(lights), len(camera.channels), sine.size, table.wavelength_nm.size))
    for k, channel in enumerate(camera.channels):
        wavelength_nm, weight = detect_light(camera, channel, lights, effects, kind, sine)
        hats = [np.interp(wavelength_nm, table.wavelength_nm, unit) for unit in np.eye(table.wavelength_nm.size)]
        light = (weight @ np.stack(hats, axis=1)) * collection_m2_sr(camera)
        # An angle makes a difference only where an effect says so: (F, lights, W), or (lights, W) for all fields.
        out[:, k] = np.moveaxis(np.broadcast_to(light, (sine.size, *light.shape[-2:])), 0, 1)
    return out


def _effects_transfer(blur: Blur, table: LensTable, light: FloatArray, grid: Grid) -> NDArray[np.inexact]:
    """Product of the effects' transfers on a grid's frequencies, averaged over the table's wavelengths with `light`
    (W,).
    """
    fy, fx, _, _ = pixel_on_grid(blur.camera, grid)
    share = np.abs(light) / max(float(np.sum(np.abs(light))), 1e-300)
    nodes, share = gauss_rule(table.wavelength_nm, share, FRAME_WAVELENGTHS)
    total: FloatArray | ComplexArray = np.zeros((fy.size, fx.size))
    for node, part in zip(nodes, share, strict=True):
        total = total + part * blur.beside_lens(float(node), fx, fy)
    return np.asarray(total, np.complex64 if np.iscomplexobj(total) else np.float32)
