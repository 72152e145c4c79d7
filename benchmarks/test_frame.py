"""Whole frames, from light to codes: CPU time beside the limit that transforms, memory and random numbers set, and peak
memory.

Prints the tables of docs/explanation/cost-of-a-frame.md.
"""

from __future__ import annotations

import cProfile
import pstats
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import fft, ndimage, signal
from scipy.interpolate import CubicSpline

from benchmarks.table import Row, show
from lab.formats.camera_file import default_camera
from sim import plain_image
from sim.camera import CameraModel, Lens
from sim.frame import Exposure, sample
from sim.optics.field_mapping import ImageFrame, field_mapping
from sim.optics.imaging import TracedLens
from sim.optics.kernels import Kernels
from sim.optics.superposition import superpose
from sim.optics.table import LensTable
from sim.optics.traced_table import TableSettings, lens_table
from sim.optics.zmx import read_zmx
from sim.scene import ScreenPattern, SpectralImage, Warp
from sim.scene.render import Grid, draw
from sim.sensor.electrons import FixedPattern
from sim.spectrum import FloatArray, blackbody_radiance

PRESCRIPTION = Path(__file__).parents[2] / "shared" / "data" / "lenses" / "7558005a.zmx"
LAMP = blackbody_radiance(3000.0, np.arange(380.0, 781.0, 5.0)).scale(3e-7)
#: Published by the peers' makers and users on other machines; not measured here.
PYISETCAM_S, ISETCAM_S = 3.8, 9.7
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


def cpu(work: Callable[[], object], repeats: int = 3) -> float:
    """The least CPU time (s) of several runs, after one that compiles."""
    work()
    spent = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        spent.append(time.process_time() - start)
    return min(spent)


def profile(title: str, work: Callable[[], object], most: int = 8) -> None:
    """Where the CPU time goes, by function."""
    watch = cProfile.Profile(time.process_time)
    watch.runcall(work)
    stats = pstats.Stats(watch).stats  # type: ignore[attr-defined]
    rows = sorted(((entry[2], where) for where, entry in stats.items()), reverse=True)[:most]
    print(f"\n{title}")
    for seconds, (file, _, name) in rows:
        print(f"{1e3 * seconds:8.0f} ms  {Path(file).name}:{name}")


def _camera(rows: int, cols: int) -> CameraModel:
    return default_camera().camera.model_copy(update={"rows": rows, "cols": cols})


def test_a_spectral_scene_through_diffraction_and_all_noise() -> None:
    rng = np.random.default_rng(0)
    camera = _camera(512, 512)
    wavelength_nm = tuple(np.arange(400.0, 701.0, 10.0).tolist())
    cube = rng.random((512, 512, 31)) * LAMP.at(wavelength_nm)
    exposure = Exposure(SpectralImage(wavelength_nm, cube), 0.02)
    pattern = FixedPattern.draw(camera, rng)

    def chain() -> None:
        sample(camera, exposure, rng, fixed_pattern=pattern)

    pictures = np.zeros((15, 576, 576), np.float32)
    factors = rng.random((31, 15))

    def limit() -> (
        None
    ):  # five pictures a channel out of the cube, there and back; one Poisson and one normal variable a pixel
        np.dot(cube.reshape(-1, 31), factors)
        fft.rfft2(pictures)
        fft.irfft2(fft.rfft2(pictures[:3]), (576, 576))
        rng.poisson(1000.0, (512, 512))
        rng.standard_normal((512, 512), dtype=np.float32)

    ours = cpu(chain)
    show(
        "512 x 512 x 31 bands, diffraction and sensor with all noise (asked for: 0.4 s)",
        [
            Row("the chain", ours, cpu(limit), "CPU s", "projection, transforms and random numbers alone"),
            Row("the chain", ours, PYISETCAM_S, "CPU s", "pyisetcam, as published, on another machine"),
            Row("the chain", ours, ISETCAM_S, "CPU s", "ISETCam in Octave, as published, on another machine"),
        ],
    )
    profile("where it goes", chain)


def traced_camera(rows: int = 960, cols: int = 1280) -> CameraModel:
    """The default camera behind a real lens, its pixels such that the frame's corner is the lens's outermost field."""
    table = lens_table(read_zmx(PRESCRIPTION), TableSettings())
    corner_um = 1e3 * float(np.hypot(*table.chief_mm.T).max())
    pitch_um = round(corner_um / np.hypot(0.5 * rows, 0.5 * cols), 2)
    lens = Lens(f_number=table.f_number, focal_length_mm=table.focal_length_mm, imaging=TracedLens(table=table))
    return _camera(rows, cols).model_copy(update={"pixel_pitch_um": pitch_um, "lens": lens})


def screen(rows: int, cols: int) -> ScreenPattern:
    """Random cells of 2 px, a little askew."""
    pattern = np.random.default_rng(0).integers(0, 2, (rows // 2, cols // 2)).astype(np.uint8)
    corners = [(3.0, 2.0), (2.0, cols - 5.0), (rows - 3.0, cols - 3.0), (rows - 5.0, 4.0)]
    return ScreenPattern(pattern, Warp.from_corners(cols // 2, rows // 2, corners), LAMP.scale(0.005), LAMP)


@pytest.mark.skipif(not PRESCRIPTION.is_file(), reason="the lens prescriptions are not beside the repository")
def test_a_screen_through_a_traced_lens() -> None:
    camera = traced_camera()
    assert isinstance(camera.lens.imaging, TracedLens)
    table = camera.lens.imaging.table
    rng = np.random.default_rng(0)
    scene = screen(camera.rows, camera.cols)

    def frame() -> None:
        sample(camera, Exposure(scene, 0.02), rng)

    size = Kernels(
        table,
        np.ones((1, len(table.field_deg), table.wavelength_nm.size)),
        ImageFrame(camera.rows, camera.cols, camera.pixel_pitch_um, camera.fill_factor, (479.5, 639.5)),
        3,
        distorted=True,
    ).size
    grid = Grid(camera.rows, camera.cols, 3, 32)
    taps, samples = rng.random((4, size * size), np.float32), rng.random((size * size, 64), np.float32)
    rows_of_64 = camera.rows * camera.cols // 64

    def sums() -> None:  # the least that four blended kernels ask for: their products with every pixel's samples
        for _ in range(rows_of_64):
            np.dot(taps, samples)

    drawing, products = cpu(lambda: draw(scene, grid)), cpu(sums, 1)
    moving = cpu(lambda: np.zeros(grid.shape, np.float32) + np.float32(1.0))
    ours = cpu(frame)
    show(
        f"1280 x 960 Bayer frame of a random screen through {PRESCRIPTION.name}, f/{table.f_number:.2g}, pixels of "
        f"{camera.pixel_pitch_um} um (asked for: 2 s)",
        [
            Row("the frame", ours, products, "CPU s", f"{size} x {size} samples a pixel times four kernels, by BLAS"),
            Row("of it, drawing the screen", drawing, moving, "CPU s", "writing that many samples"),
        ],
    )
    profile("where it goes", frame, 12)


class Waves:
    """Thirty waves below 0.8 cy/px around 0: values, or means over squares of `side` px."""

    def __init__(self) -> None:
        rng = np.random.default_rng(5)
        self.waves = rng.uniform((-0.8, -0.8, 0.0), (0.8, 0.8, 2.0 * np.pi), (30, 3))

    def at(self, row: FloatArray, col: FloatArray, side: float) -> FloatArray:
        out = np.zeros((row.size, col.size))
        for fy, fx, phase in self.waves:
            wave = np.cos(2 * np.pi * (fy * row[:, None] + fx * col[None, :]) + phase)
            out += np.sinc(fx * side) * np.sinc(fy * side) * wave
        return out


def exact_region(table: LensTable, light: FloatArray, frame: ImageFrame, picture: Waves) -> FloatArray:
    """The sum over all sources: each one's own function, in between the table's samples by cubic splines in height, row
    and column, averaged over a full pixel by 5 x 5 Gauss nodes. Sources are 4 x 4 a pixel, which for such a picture and
    a lens that passes less than 3.2 cy/px is the integral."""
    n, pitch = table.psf.shape[-1], table.sample_pitch_um
    functions = np.einsum("fw,wfab->fab", light * table.relative_illumination.T, table.psf)
    at = (np.arange(n) - 0.5 * (n - 1)) * pitch
    functions *= np.clip((0.5 * n * pitch - np.hypot(at[:, None], at[None, :])) / (2.0 * pitch), 0.0, 1.0)
    heights = np.linspace(0.0, 20.0, 161)
    functions = CubicSpline(np.arange(21.0), functions)(heights)
    functions = signal.resample(signal.resample(functions, 2 * n, axis=1), 2 * n, axis=2)  # by Fourier series
    spline = ndimage.spline_filter(functions.astype(np.float32), output=np.float32)
    radius, place = field_mapping(table).heights(heights.size)
    node, share = np.polynomial.legendre.leggauss(5)
    reach = int(np.ceil(0.5 * n * pitch / frame.pitch_um + 0.5))
    offset = (np.arange(-4 * reach, 4 * (reach + 1)) + 0.5) / 4.0 - 0.5
    image = np.zeros((frame.rows, frame.cols))
    for i in range(frame.rows):
        for j in range(frame.cols):
            row, col = i + offset, j + offset
            x, y = frame.um(row[:, None], col[None, :])
            r = np.hypot(x, y)
            height = np.interp(r, radius, place)
            value = picture.at(row, col, 0.0) / (16.0 * pitch**2) * frame.pitch_um**2
            for a, down in zip(share, node, strict=True):
                for b, across in zip(share, node, strict=True):
                    u = (j + 0.5 * across - frame.axis[1]) * frame.pitch_um - x
                    v = (i + 0.5 * down - frame.axis[0]) * frame.pitch_um - y
                    along, aside = (u * x + v * y) / r, (u * y - v * x) / r
                    # The table's field lies along y: its rows go outwards, its columns (y, -x) / r aside.
                    where = [height, along / (0.5 * pitch) + n - 1.0, aside / (0.5 * pitch) + n - 1.0]
                    seen = ndimage.map_coordinates(spline, where, prefilter=False)
                    image[i, j] += 0.25 * a * b * float(np.sum(value * seen))
    return image


@pytest.mark.skipif(not PRESCRIPTION.is_file(), reason="the lens prescriptions are not beside the repository")
def test_accuracy_of_a_traced_frame() -> None:
    """Regions of 8 x 8 px of the real lens, against the exact sum over their sources: 3e-3 of the contrast are asked
    for."""
    camera = traced_camera()
    assert isinstance(camera.lens.imaging, TracedLens)
    table = camera.lens.imaging.table
    light = np.ones((len(table.field_deg), 1)) * LAMP.at(table.wavelength_nm) * (np.abs(table.wavelength_nm - 550) < 60)
    light /= np.max(light) * table.wavelength_nm.size
    picture, rows = Waves(), []
    for place, (row, col) in {"axis": (476, 636), "half way": (700, 900), "corner": (945, 1265)}.items():
        frame = ImageFrame(8, 8, camera.pixel_pitch_um, 1.0, (479.5 - row, 639.5 - col))
        grid = Grid(8, 8, 3, 64)
        kernels = Kernels(table, light[None], frame, 3, distorted=False)
        kernels.lost = np.zeros_like(kernels.lost)  # what lies beyond the table's circle isn't in the sum
        got = np.zeros((8, 8))
        drawn = picture.at(*grid.axes_px(), 1.0 / 3.0).astype(np.float32)
        superpose(drawn, grid, kernels, [[(0, 0)]], 1, got)
        wanted = exact_region(table, light, frame, picture)
        error = float(np.sqrt(np.mean((got - wanted) ** 2)) / np.std(wanted))
        rows.append(Row(f"rms error, {place}", 1e3 * error, 3.0, "1e-3 of the contrast", "the error asked for"))
        assert error < 3e-3
    show(f"Scattering through {PRESCRIPTION.name} against the exact sum over sources", rows)


MEMORY = """
import resource, sys
import numpy as np
sys.path.insert(0, ".")
from benchmarks.test_frame import LAMP, traced_camera
from sim.frame import Exposure, expected
from sim.scene import SpectralImage
camera = traced_camera()
wavelength_nm = tuple(np.linspace(400.0, 720.0, 33).tolist())
rng = np.random.default_rng(0)
light = LAMP.at(wavelength_nm).astype(np.float32)
cube = np.empty((960, 1280, 33), np.float32)
low, high = rng.random((960, 1280), np.float32), rng.random((960, 1280), np.float32)
for k in range(33):  # reflectances that rise or fall, with a bump: ranks as natural scenes have them
    cube[..., k] = (low + (high - low) * (k / 32) + 0.2 * np.exp(-((k - 16) / 4.0) ** 2)) * light[k]
import time
start = time.process_time()
expected(camera, Exposure(SpectralImage(wavelength_nm, cube), 0.02))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, time.process_time() - start)
"""


@pytest.mark.skipif(not PRESCRIPTION.is_file(), reason="the lens prescriptions are not beside the repository")
def test_memory_of_a_traced_cube() -> None:
    done = subprocess.run(
        [sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True, cwd=Path(__file__).parents[1]
    )
    peak, seconds = map(float, done.stdout.split())
    show(
        "1280 x 960 x 33 bands through the traced lens, in a process of its own (asked for: 1.5 GiB)",
        [
            Row("peak memory", peak, 960 * 1280 * 33 * 4 / 2**30, "GiB", "the cube in single precision"),
            Row("time", seconds, None, "CPU s", ""),
        ],
    )


def test_of_what_machine() -> None:
    """The figures' unit: what a transform and a normal variable cost here, and how busy the machine was."""
    rng = np.random.default_rng(0)
    picture = rng.random((2880, 3840), np.float32)
    show(
        "the machine",
        [
            Row(
                "real transform of 2880 x 3840, single precision",
                1e3 * cpu(lambda: fft.rfft2(picture)),
                None,
                "CPU ms",
                "",
            ),
            Row(
                "1280 x 960 normal variables",
                1e3 * cpu(lambda: rng.standard_normal((960, 1280), np.float32)),
                None,
                "CPU ms",
                "",
            ),
        ],
    )
    print(f"peak memory of this process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")
    assert plain_image.FRAME_WAVELENGTHS == 5  # the limit above counts five pictures a channel
