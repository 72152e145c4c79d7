"""Raw files (.npy, .tif, .dng): the codes come back, and LibRaw sees the same mosaic, levels and colours."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rawpy
import tifffile

from lab.errors import InputError
from lab.formats.raw_file import (
    Frame,
    RawMetadata,
    _matching,
    _product,
    colour_matrix,
    daylight,
    electrons_of,
    replacing,
    write_raw,
)
from lab.formats.recording_set import load_frame
from sim.camera import CameraModel, Cfa, Lens
from sim.scene.colorchecker import reflectances
from sim.spectrum import Spectrum, photons_from_energy

WAVELENGTH = np.arange(380.0, 781.0, 10.0)


def _bell(peak_nm: float) -> Spectrum:
    return Spectrum.of(WAVELENGTH, 0.5 * np.exp(-0.5 * ((WAVELENGTH - peak_nm) / 40.0) ** 2))


def _camera(cfa: Cfa = "RGGB", rows: int = 48, cols: int = 64, bits: int = 12, black: float = 64.0) -> CameraModel:
    curves = {"Y": _bell(550)} if cfa == "MONO" else {"R": _bell(600), "G": _bell(535), "B": _bell(460)}
    return CameraModel(
        rows=rows, cols=cols, pixel_pitch_um=3.45, fill_factor=1.0, cfa=cfa, bit_depth=bits, black_level_dn=black,
        white_level_dn=2.0**bits - 1,
        conversion_gain_dn_per_e=0.4, full_well_e=10000.0, read_noise_e=2.0, dark_current_e_per_s=5.0, dsnu_e=0.0,
        prnu_percent=0.0,
        quantum_efficiency=curves, lens=Lens(f_number=4.0, focal_length_mm=8.0),
    )  # fmt: skip


def _frame(camera: CameraModel, seed: int = 1) -> Frame:
    rng = np.random.default_rng(seed)
    return rng.integers(0, int(camera.white_level_dn) + 1, (camera.rows, camera.cols), dtype=np.uint16)


METADATA = RawMetadata(exposure_s=0.0123, gain_db=6.0, camera_name="test camera")


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("ending", [".npy", ".tif", ".dng"])
def test_codes_come_back(tmp_path: Path, ending: str, bits: int) -> None:
    camera = _camera(bits=bits, black=7.0)
    frame, file = _frame(camera), tmp_path / f"frame{ending}"
    write_raw(file, frame, camera, METADATA)
    np.testing.assert_array_equal(load_frame(file), frame)
    assert [path.name for path in tmp_path.iterdir()] == [file.name]  # nothing is left beside it


@pytest.mark.parametrize("size", [(48, 64), (47, 63), (33, 50), (22, 25)])
@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG", "MONO"])
def test_a_raw_developer_sees_the_same_mosaic_and_levels(tmp_path: Path, cfa: Cfa, size: tuple[int, int]) -> None:
    camera = _camera(cfa, *size, black=101.0)
    frame, file = _frame(camera), tmp_path / "frame.dng"
    write_raw(file, frame, camera, METADATA)
    with rawpy.imread(str(file)) as raw:
        np.testing.assert_array_equal(raw.raw_image, frame)
        np.testing.assert_array_equal(raw.raw_image_visible, frame)
        assert set(raw.black_level_per_channel) <= {101}
        assert raw.white_level == 4095
        if cfa == "MONO":
            assert raw.num_colors == 1
        else:
            names = raw.color_desc.decode()
            assert "".join(names[raw.raw_color(i, j)] for i in (0, 1) for j in (0, 1)) == cfa


@pytest.mark.parametrize("patch", ["white", "orange", "cyan", "foliage"])
def test_a_raw_developer_sees_the_colours(tmp_path: Path, patch: str) -> None:
    """A patch under D65, developed with the file's white and matrix, against linear sRGB of the CIE observer.

    With these Gaussian filters, the residual of any matrix is up to 0.04 of white.
    """
    camera = _camera(rows=64, cols=64)
    white = {c: electrons_of(daylight(), curve) for c, curve in camera.quantum_efficiency.items()}
    of = {c: electrons_of(daylight(), curve, reflectances()[patch]) for c, curve in camera.quantum_efficiency.items()}
    frame = np.empty((64, 64), np.uint16)
    for index, letter in enumerate("RGGB"):
        frame[index // 2 :: 2, index % 2 :: 2] = round(64 + 0.7 * 4031 * of[letter] / max(white.values()))
    file = tmp_path / "patch.dng"
    write_raw(file, frame, camera, METADATA.model_copy(update={"neutral": white}))
    with rawpy.imread(str(file)) as raw:
        developed = raw.postprocess(use_camera_wb=True, no_auto_bright=True, gamma=(1, 1), output_bps=16)
    middle = developed[20:40, 20:40].reshape(-1, 3).mean(axis=0) / (
        0.7 * 65535
    )  # above three quarters of the white level, LibRaw stretches
    xyz = np.array([_product(daylight(), curve, reflectances()[patch]) for curve in _matching()])
    xyz /= _product(daylight(), _matching()[1])
    to_srgb = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
    np.testing.assert_allclose(middle, np.clip(to_srgb @ xyz, 0, 1), atol=0.04)


def test_what_a_dng_says(tmp_path: Path) -> None:
    file = tmp_path / "frame.dng"
    camera = _camera("GRBG", black=64.5)
    write_raw(file, _frame(camera), camera, METADATA)
    with tifffile.TiffFile(file) as tiff:
        tags = {tag.code: tag.value for tag in tiff.pages[0].tags.values()}
    assert bytes(tags[50706]) == bytes([1, 4, 0, 0])
    assert tags[50708] == "test camera"
    assert tags[33434][0] / tags[33434][1] == pytest.approx(0.0123)
    assert tags[50714][0] / tags[50714][1] == 64.5
    assert bytes(tags[33422]) == bytes([1, 0, 2, 1])
    matrix = np.reshape(tags[50721], (9, 2))
    np.testing.assert_allclose(matrix[:, 0] / matrix[:, 1], colour_matrix(camera).ravel(), atol=1e-6)


def test_what_a_tiff_says(tmp_path: Path) -> None:
    file = tmp_path / "frame.tif"
    write_raw(file, _frame(_camera()), _camera(), METADATA)
    with tifffile.TiffFile(file) as tiff:
        said = json.loads(tiff.pages[0].description)
    assert said["format"] == "calibench-raw"
    assert (said["cfa"], said["black_level_dn"], said["white_level_dn"]) == ("RGGB", 64.0, 4095.0)
    assert (said["exposure_s"], said["gain_db"]) == (0.0123, 6.0)


def test_the_colour_matrix_is_that_of_the_light_and_the_efficiency() -> None:
    """For a camera whose efficiencies combine colour-matching functions (per photon), the matrix is exact."""
    want = np.array([[1.3, -0.3, -0.1], [-0.4, 1.2, 0.2], [0.0, 0.1, 0.9]])
    wavelength_nm = np.arange(380.0, 781.0)
    curves = np.stack([curve.at(wavelength_nm) for curve in _matching()])
    per_photon = want @ curves / photons_from_energy(wavelength_nm, np.ones_like(wavelength_nm))
    camera = _camera().model_copy(
        update={
            "quantum_efficiency": {
                c: Spectrum.of(wavelength_nm, row / per_photon.max()) for c, row in zip("RGB", per_photon, strict=True)
            }
        }
    )
    found = colour_matrix(camera)
    # Efficiencies are linear between whole nm where the functions per photon aren't quite: 1e-4.
    np.testing.assert_allclose(found / found[1, 1] * want[1, 1], want, atol=1e-3)


def test_a_file_is_written_completely_or_not_at_all(tmp_path: Path) -> None:
    file = tmp_path / "frame.npy"
    file.write_bytes(b"before")
    with pytest.raises(RuntimeError), replacing(file) as partial:
        partial.write_bytes(b"half")
        raise RuntimeError
    assert file.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [file]


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    camera, frame = _camera(), _frame(_camera())
    with pytest.raises(InputError, match=r"can't be \.png; end it in"):
        write_raw(tmp_path / "frame.png", frame, camera, METADATA)
    with pytest.raises(InputError, match=r"can't be written .*name a file in a folder that exists"):
        write_raw(tmp_path / "none" / "frame.npy", frame, camera, METADATA)
    with pytest.raises(InputError, match=r"uint16 \(47, 64\), this camera's are uint16 \(48, 64\)"):
        write_raw(tmp_path / "frame.npy", frame[1:], camera, METADATA)
    with pytest.raises(InputError, match="holds 5000 DN, above the limit of the white level 4095 DN"):
        write_raw(tmp_path / "frame.npy", np.full_like(frame, 5000), camera, METADATA)
