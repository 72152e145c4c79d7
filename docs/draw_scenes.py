"""Draws docs/reference/scenes.png and prints the table of parameters in docs/reference/scene-parameters.md: `python
docs/draw_scenes.py docs/reference/scenes.png`.

Every tile is the scene itself, without lens and noise, in the camera's pixels: the lights' luminances and colours by
the CIE's observer of 1931, in sRGB.
"""

from __future__ import annotations

import sys

import cv2
import numpy as np

from sim.camera import CameraModel, Lens
from sim.scene import Scene, SpectralImage
from sim.scene.catalogue import SCENES, Cube, PictureOnScreen, View, scene_by_name
from sim.scene.light import colour_science, illuminant
from sim.scene.render import Grid, Light, draw
from sim.spectrum import FloatArray, Spectrum, blackbody_radiance

ROWS, COLS, CAPTION = 240, 320, 22
PAPER = 225
WAVELENGTHS = np.arange(400.0, 701.0, 5.0)
#: What a small tile needs that a frame doesn't.
PARAMETERS: dict[str, dict[str, object]] = {
    "bernoulli": {"cell_px": 8},
    "checkerboard": {"cell_px": 20},
    "zone-plate": {"highest_cy_per_px": 0.4},
    "points": {"spacing_px": 20.3, "side_px": 2},
}


def main(file: str) -> None:
    """Writes the contact sheet and prints the table."""
    camera = CameraModel.model_validate(
        {
            "rows": ROWS,
            "cols": COLS,
            "pixel_pitch_um": 3.0,
            "fill_factor": 1.0,
            "cfa": "MONO",
            "bit_depth": 12,
            "black_level_dn": 0.0,
            "white_level_dn": 4095.0,
            "conversion_gain_dn_per_e": 1.0,
            "full_well_e": 1e4,
            "read_noise_e": 0.0,
            "dark_current_e_per_s": 0.0,
            "dsnu_e": 0.0,
            "prnu_percent": 0.0,
            "quantum_efficiency": {"Y": {"wavelength_nm": [400.0, 700.0], "value": [1.0, 1.0]}},
            "lens": Lens(f_number=4.0, focal_length_mm=4.0),
        }
    )
    white, view = illuminant("D65", 100.0), View.of(camera, 1000.0)
    tiles: list[tuple[str, Scene]] = [
        (name, scene_by_name(name, camera, white, parameters=PARAMETERS.get(name))) for name in SCENES
    ]
    tiles.append(("picture (PNG) on a screen", PictureOnScreen().show(_picture(), view, white)))
    near = PictureOnScreen.choose({"stripes": 1, "fill": 6.0}).show(_picture()[20:35, 30:50], view, white)
    tiles.append(("its sub-pixels", near))
    tiles.append(("cube: black bodies, 2000 to 10000 K", Cube(fill=0.9).show(_cube(), view)))
    to_rgb = _to_rgb(white)
    pictures = [_tile(name, scene, to_rgb) for name, scene in tiles]
    blank = np.full_like(pictures[0], PAPER)
    while len(pictures) % 4:
        pictures.append(blank)
    sheet = np.vstack([np.hstack(pictures[k : k + 4]) for k in range(0, len(pictures), 4)])
    cv2.imwrite(file, sheet, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    for item in (*SCENES.values(), PictureOnScreen, Cube):
        print(f"\n**`{item.name}`**: {item.shows}.\n")
        if item.model_fields:
            print("| parameter | unit | default | limits | meaning |\n| --- | --- | --- | --- | --- |")
        for field, quantity in item.quantities().items():
            limits = "..".join("" if n is None else f"{n:g}" for n in (quantity.lower, quantity.upper))
            default = item.model_fields[field].default
            print(
                f"| `{field}` | {quantity.unit} | {default:g} | {limits.strip('.') and limits} | {quantity.meaning} |"
            )


def _to_rgb(white: Spectrum) -> FloatArray:
    """(wavelengths, 3): radiance at WAVELENGTHS to linear sRGB, 1 for `white`'s luminance."""
    observer = colour_science().MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    xyz = np.stack([np.interp(WAVELENGTHS, observer.wavelengths, column) for column in observer.values.T], axis=1)
    xyz /= white.at(WAVELENGTHS) @ xyz[:, 1]
    return np.asarray(xyz @ colour_science().RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB.T)


def _tile(name: str, scene: Scene, to_rgb: FloatArray) -> FloatArray:
    grid = Grid(ROWS, COLS, 3, 0)
    drawing = draw(scene, grid)
    ground = _rgb(drawing.ground, to_rgb)
    image = np.tile(ground, (*grid.shape, 1))
    for layer in drawing.layers:
        image[layer.window] += layer.coverage[:, :, None] * (_rgb(layer.light, to_rgb) - ground)
    image = image.reshape(ROWS, 3, COLS, 3, 3).mean(axis=(1, 3))
    image /= max(1.0, float(image.max()))
    tile = np.full((ROWS + CAPTION + 6, COLS + 6, 3), PAPER, np.uint8)
    encoded = np.where(image < 0.0031308, 12.92 * image, 1.055 * np.maximum(image, 0.0) ** (1 / 2.4) - 0.055)
    tile[CAPTION : CAPTION + ROWS, 3 : 3 + COLS] = np.clip(255 * encoded[:, :, ::-1], 0, 255).astype(np.uint8)
    cv2.putText(tile, name, (4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.48, (40, 40, 40), 1, cv2.LINE_AA)
    return tile


def _rgb(light: Light, to_rgb: FloatArray) -> FloatArray:
    radiance, reflectance = light
    curve = np.ones(WAVELENGTHS.size) if radiance is None else radiance.at(WAVELENGTHS)
    return np.asarray((curve if reflectance is None else curve * reflectance.at(WAVELENGTHS)) @ to_rgb)


def _picture() -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Hues across, saturation down."""
    rows, cols = 60, 80
    hue = np.tile(np.linspace(0, 179, cols), (rows, 1))
    saturation = np.tile(np.linspace(255, 0, rows)[:, None], (1, cols))
    hsv = np.stack([hue, saturation, np.full((rows, cols), 255.0)], axis=-1).astype(np.uint8)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), np.uint8)


def _cube() -> SpectralImage:
    """Black bodies of one luminance, hotter to the right, dimmer downwards."""
    columns = [blackbody_radiance(t, WAVELENGTHS).value for t in np.geomspace(2000.0, 10000.0, 40)]
    curves = np.array(columns) / np.max(columns, axis=1, keepdims=True)
    return SpectralImage(tuple(WAVELENGTHS.tolist()), 0.002 * np.linspace(1.0, 0.1, 30)[:, None, None] * curves)


if __name__ == "__main__":
    main(sys.argv[1])
