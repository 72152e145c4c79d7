"""Lights, pictures and spectral cubes from files: units, scaling, and refusals in one line."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import spectral
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.errors import InputError
from lab.formats.scene_file import ENVI_UNITS, light, read_cube, read_light, read_picture, scene
from sim.camera import CameraModel, Lens
from sim.scene import ScreenImage, SpectralImage, UniformField
from sim.scene.light import luminance_cd_m2
from sim.spectrum import PHOTON_ENERGY_J_NM, Spectrum

WHITE = Spectrum.of([400.0, 700.0], [0.01, 0.01])
BANDS = (450.0, 550.0, 650.0)


def camera(rows: int = 6, cols: int = 8) -> CameraModel:
    return CameraModel(
        rows=rows,
        cols=cols,
        pixel_pitch_um=3.0,
        fill_factor=0.9,
        cfa="MONO",
        bit_depth=12,
        black_level_dn=64.0,
        white_level_dn=4095.0,
        conversion_gain_dn_per_e=0.4,
        full_well_e=9000.0,
        read_noise_e=2.0,
        dark_current_e_per_s=1.0,
        dsnu_e=0.5,
        prnu_percent=0.5,
        quantum_efficiency={"Y": Spectrum.of([400.0, 700.0], [0.5, 0.5])},
        lens=Lens(f_number=4.0, focal_length_mm=8.0),
    )


def one_line(error: pytest.ExceptionInfo[InputError]) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


# --- lights -----------------------------------------------------------------------------------------------------------


def test_a_measured_light_is_taken_in_its_unit(tmp_path: Path) -> None:
    energy, photons, relative = (tmp_path / name for name in ("energy.csv", "photons.csv", "relative.csv"))
    energy.write_text("wavelength_nm,radiance_w_sr_m2_nm\n500,0.2\n600,0.1\n")
    photons.write_text(
        f"wavelength_nm,photons_s_sr_m2_nm\n500,{0.2 * 500 / PHOTON_ENERGY_J_NM!r}\n600,{0.1 * 600 / PHOTON_ENERGY_J_NM!r}\n"  # noqa: E501
    )
    relative.write_text("wavelength_nm,relative\n500,2\n600,1\n")
    assert read_light(energy).value == (0.2, 0.1)
    np.testing.assert_allclose(read_light(photons).value, (0.2, 0.1), rtol=1e-14)
    assert luminance_cd_m2(light(str(relative), 50.0)) == pytest.approx(50.0, rel=1e-12)
    assert luminance_cd_m2(light(str(energy), 50.0)) == pytest.approx(50.0, rel=1e-12)
    with pytest.raises(InputError) as error:
        read_light(relative)
    assert "say its luminance" in one_line(error)


def test_a_named_light_has_the_luminance_asked_for() -> None:
    assert luminance_cd_m2(light("D65")) == pytest.approx(100.0, rel=1e-12)
    assert luminance_cd_m2(light("fl2", 7.0)) == pytest.approx(7.0, rel=1e-12)
    with pytest.raises(InputError) as error:
        light("D66")
    assert "D65" in one_line(error)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("wavelength_nm,value\n500,1\n600,1\n", "radiance_w_sr_m2_nm"),
        ("wavelength_um,radiance_w_sr_m2_nm\n.5,1\n.6,1\n", "write that header"),
        ("wavelength_nm,radiance_uw_cm2_nm\n500,1\n600,1\n", "write that header"),
        ("wavelength_nm,radiance_w_sr_m2_nm\n500,-1\n600,1\n", "-1 at 500 nm, below the limit of 0"),
        ("wavelength_nm,radiance_w_sr_m2_nm\n500,nan\n600,1\n", "isn't finite"),
        ("wavelength_nm,radiance_w_sr_m2_nm\n600,1\n500,1\n", "500 nm follows 600 nm"),
        ("wavelength_nm,radiance_w_sr_m2_nm\n500,1\n", "no width"),
        (f"wavelength_nm,radiance_w_sr_m2_nm\n{'1' * 200_000},1\n", "isn't CSV"),
        ("wavelength_nm,relative\n900,1\n990,1\n", "visible light"),
    ],
)
def test_a_light_that_cannot_be_is_refused_in_one_line(tmp_path: Path, text: str, says: str) -> None:
    file = tmp_path / "light.csv"
    file.write_text(text)
    with pytest.raises(InputError) as error:
        read_light(file, 100.0 if "relative" in text else None)
    line = one_line(error)
    assert line.startswith(str(file))
    assert says in line


@settings(max_examples=60)
@given(st.text(alphabet="wavelength_nm,radiance_sr2\n0123456789.-+eE \r\"'\x00\ufeff", max_size=80), st.booleans())
def test_any_text_is_a_light_or_an_input_error(text: str, headed: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "light.csv"
        file.write_text(("wavelength_nm,radiance_w_sr_m2_nm\n" if headed else "") + text, encoding="utf-8")
        try:
            found = read_light(file)
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert min(found.value) >= 0
            assert np.all(np.diff(found.wavelength_nm) > 0)


# --- pictures ---------------------------------------------------------------------------------------------------------


def test_a_picture_is_its_codes(tmp_path: Path) -> None:
    codes = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    for name in ("a.png", "a.tif"):
        cv2.imwrite(str(tmp_path / name), codes[:, :, ::-1])
        np.testing.assert_array_equal(read_picture(tmp_path / name), codes)
    cv2.imwrite(str(tmp_path / "deep.png"), codes[:, :, ::-1].astype(np.uint16) * 257)
    np.testing.assert_array_equal(read_picture(tmp_path / "deep.png"), codes)
    cv2.imwrite(str(tmp_path / "grey.png"), codes[:, :, 0])
    np.testing.assert_array_equal(read_picture(tmp_path / "grey.png"), np.repeat(codes[:, :, :1], 3, axis=2))
    opaque = np.dstack([codes[:, :, ::-1], np.full(codes.shape[:2], 255, np.uint8)])
    cv2.imwrite(str(tmp_path / "opaque.png"), opaque)
    np.testing.assert_array_equal(read_picture(tmp_path / "opaque.png"), codes)
    opaque[0, 0, 3] = 100
    cv2.imwrite(str(tmp_path / "glass.png"), opaque)
    with pytest.raises(InputError, match="transparent"):
        read_picture(tmp_path / "glass.png")


def test_a_damaged_picture_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((40, 40, 3), np.uint8))
    file = tmp_path / "cut.png"
    file.write_bytes((tmp_path / "a.png").read_bytes()[:-20])
    with pytest.raises(InputError) as error:
        read_picture(file)
    assert one_line(error).startswith(str(file))
    with pytest.raises(InputError, match="no such file"):
        read_picture(tmp_path / "none.png")


# --- cubes ------------------------------------------------------------------------------------------------------------


def values(dtype: type = float) -> np.ndarray:
    return (0.001 * np.arange(4 * 5 * 3).reshape(4, 5, 3)).astype(dtype)


def test_an_npz_cube_is_taken_in_its_unit(tmp_path: Path) -> None:
    file = tmp_path / "cube.npz"
    cube = values(np.float32)
    np.savez(file, wavelength_nm=np.array(BANDS), radiance_w_sr_m2_nm=cube)
    found = read_cube(file)
    assert found.wavelength_nm == BANDS
    assert found.radiance.dtype == np.float32
    np.testing.assert_array_equal(found.radiance, cube)
    np.savez_compressed(
        file, wavelength_nm=np.array(BANDS), photons_s_sr_m2_nm=values() * np.array(BANDS) / PHOTON_ENERGY_J_NM
    )
    np.testing.assert_allclose(read_cube(file).radiance, values(), rtol=1e-14)
    np.savez(file, wavelength_nm=np.array(BANDS), reflectance=values())
    np.testing.assert_allclose(read_cube(file, WHITE).radiance, 0.01 * values(), rtol=1e-14)
    with pytest.raises(InputError, match="say the illuminant"):
        read_cube(file)


@pytest.mark.parametrize("interleave", ["bsq", "bil", "bip"])
@pytest.mark.parametrize("byteorder", [0, 1])
def test_an_envi_cube_is_taken_in_its_unit(tmp_path: Path, interleave: str, byteorder: int) -> None:
    for unit, (quantity, factor) in ENVI_UNITS.items():
        file = tmp_path / "cube.hdr"
        metadata = {"wavelength": [0.45, 0.55, 0.65], "wavelength units": "Micrometers", "data units": unit}
        spectral.envi.save_image(
            str(file), values(), interleave=interleave, byteorder=byteorder, metadata=metadata, force=True, dtype=float
        )
        found = read_cube(file, WHITE)
        np.testing.assert_allclose(found.wavelength_nm, BANDS, rtol=1e-14)
        scale = {
            "radiance_w_sr_m2_nm": factor,
            "photons_s_sr_m2_nm": PHOTON_ENERGY_J_NM / np.array(BANDS),
            "reflectance": 0.01,
        }[quantity]
        np.testing.assert_allclose(found.radiance, values() * scale, rtol=1e-13)


def test_a_scaled_reflectance_is_scaled_back(tmp_path: Path) -> None:
    metadata = {
        "wavelength": [450, 550, 650],
        "wavelength units": "Nanometers",
        "data units": "Reflectance",
        "reflectance scale factor": 10000.0,
    }
    codes = np.rint(values() * 10000).astype(np.int16)
    spectral.envi.save_image(str(tmp_path / "cube.hdr"), codes, metadata=metadata)
    np.testing.assert_allclose(read_cube(tmp_path / "cube.hdr", WHITE).radiance, 0.01 * codes / 1e4, rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("data units = W/m^2/sr/nm", "data units = DN"), "data units is 'DN'"),
        (("wavelength units = Nanometers", "wavelength units = Unknown"), "wavelength units is 'Unknown'"),
        (("data units = W/m^2/sr/nm", "data units = {}"), "data units is '"),
        (("wavelength units = Nanometers", "wavelength units = {nm, nm}"), "wavelength units is '"),
        (
            ("data units = W/m^2/sr/nm", "data units = Reflectance\nreflectance scale factor = inf"),
            "scale factor is inf",
        ),
        (("450", "750"), "must ascend"),
        (("450", "first"), "not numbers"),
        (("lines = 4", "lines = 400"), "bytes where the header asks for"),
        (("lines = 4", "lines = -4"), "correct the header"),
        (("header offset = 0", "header offset = -80"), "correct the header"),
        (("byte order = 0", "byte order = 2"), "not one of 0, 1"),
        (("interleave = bip", "interleave = bop"), "not one of bsq, bil, bip"),
        (("samples = 5", "samples = 999999999999"), "correct the header"),
        (("data type = 5", "data type = 9"), "bytes where the header asks for"),
        (("bands = 3", "bands = 2"), "3"),
        (("ENVI", "ENV"), "can't be read as ENVI"),
    ],
)
def test_an_envi_header_that_cannot_be_is_refused_in_one_line(
    tmp_path: Path, change: tuple[str, str], says: str
) -> None:
    file = tmp_path / "cube.hdr"
    metadata = {"wavelength": [450, 550, 650], "wavelength units": "Nanometers", "data units": "W/m^2/sr/nm"}
    spectral.envi.save_image(str(file), values(), metadata=metadata, dtype=float)
    text = file.read_text()
    assert change[0] in text
    file.write_text(text.replace(change[0], change[1], 1))
    with pytest.raises(InputError) as error:
        read_cube(file)
    line = one_line(error)
    assert line.startswith(str(file))
    assert says in line


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"wavelength_nm": np.array(BANDS)}, "give wavelength_nm and one of"),
        ({"wavelength_nm": np.array(BANDS), "radiance": values()}, "give wavelength_nm and one of"),
        ({"wavelength_nm": np.array(BANDS), "radiance_w_sr_m2_nm": -values()}, "below the limit of 0"),
        ({"wavelength_nm": np.array(BANDS), "radiance_w_sr_m2_nm": values() * np.nan}, "radiance is nan"),
        ({"wavelength_nm": np.array(BANDS)[::-1], "radiance_w_sr_m2_nm": values()}, "must ascend"),
        ({"wavelength_nm": np.array(BANDS)[:2], "radiance_w_sr_m2_nm": values()}, "move the bands to the last axis"),
        ({"wavelength_nm": np.array(BANDS)[:2], "photons_s_sr_m2_nm": values()}, "move the bands to the last axis"),
        ({"wavelength_nm": np.array(BANDS)[:2], "reflectance": values()}, "move the bands to the last axis"),
        ({"wavelength_nm": np.array([BANDS]), "radiance_w_sr_m2_nm": values()}, "(bands,)"),
        ({"wavelength_nm": np.array(BANDS), "radiance_w_sr_m2_nm": values().astype(complex)}, "not real numbers"),
        ({"wavelength_nm": np.array([None] * 3), "radiance_w_sr_m2_nm": values()}, "damaged .npz"),
    ],
)
def test_an_npz_cube_that_cannot_be_is_refused_in_one_line(
    tmp_path: Path, arrays: dict[str, np.ndarray], says: str
) -> None:
    file = tmp_path / "cube.npz"
    np.savez(file, **arrays)
    with pytest.raises(InputError) as error:
        read_cube(file, WHITE)
    line = one_line(error)
    assert line.startswith(str(file))
    assert says in line


@settings(max_examples=80)
@given(st.integers(0, 10_000), st.integers(0, 255), st.integers(0, 10_000))
def test_a_damaged_npz_is_a_cube_or_an_input_error(at: int, byte: int, length: int) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, wavelength_nm=np.array(BANDS), radiance_w_sr_m2_nm=values())
    data = bytearray(buffer.getvalue())
    data[at % len(data)] = byte
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cube.npz"
        file.write_bytes(bytes(data[: length if length < len(data) else None]))
        try:
            assert np.all(read_cube(file).radiance >= 0)
        except InputError as error:
            assert "\n" not in str(error)


@settings(max_examples=80)
@given(st.data())
def test_a_damaged_envi_header_is_a_cube_or_an_input_error(data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cube.hdr"
        metadata = {"wavelength": [450, 550, 650], "wavelength units": "Nanometers", "data units": "W/m^2/sr/nm"}
        spectral.envi.save_image(str(file), values(), metadata=metadata, dtype=float)
        lines = file.read_text().splitlines()
        at = data.draw(st.integers(0, len(lines) - 1))
        what = data.draw(st.text(alphabet="0123456789.-{}=, abe\n", max_size=12))
        key = lines[at].split("=")[0] if data.draw(st.booleans()) else ""
        lines[at] = f"{key}= {what}" if key else what
        file.write_text("\n".join(lines))
        try:
            assert np.all(read_cube(file).radiance >= 0)
        except InputError as error:
            assert "\n" not in str(error)


# --- scenes -----------------------------------------------------------------------------------------------------------


def test_a_scene_is_a_name_a_picture_or_a_cube(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((3, 4, 3), 255, np.uint8))
    np.savez(tmp_path / "a.npz", wavelength_nm=np.array(BANDS), radiance_w_sr_m2_nm=np.ones((6, 8, 3)))
    assert isinstance(scene("uniform", camera(), WHITE), UniformField)
    shown = scene(str(tmp_path / "a.png"), camera(), WHITE, parameters={"gamma": "1.8", "fill": 0.5})
    assert isinstance(shown, ScreenImage)
    assert shown.screen.gamma == (1.8, 1.8, 1.8)
    assert luminance_cd_m2(shown.screen.white_radiance) == pytest.approx(luminance_cd_m2(WHITE), rel=1e-9)
    cube = scene(str(tmp_path / "a.npz"), camera(), WHITE)
    assert isinstance(cube, SpectralImage)
    assert cube.to_camera is None
    smaller = scene(str(tmp_path / "a.npz"), camera(), WHITE, parameters={"fill": 0.5})
    assert isinstance(smaller, SpectralImage)
    assert smaller.to_camera is not None


@pytest.mark.parametrize(
    ("name", "parameters", "distance_mm", "says"),
    [
        ("moon", {}, 1000.0, "zone-plate"),
        ("uniform", {"cell_px": 3}, 1000.0, "no parameter 'cell_px'"),
        ("checkerboard", {"cell_px": "wide"}, 1000.0, "cell_px"),
        ("checkerboard", {"cell_px": 0.0}, 1000.0, "below the lower limit 0.1 px"),
        ("checkerboard", {}, 8.0, "above the limit of the focal length"),
    ],
)
def test_a_scene_that_is_none_is_refused_in_one_line(
    name: str, parameters: dict[str, object], distance_mm: float, says: str
) -> None:
    with pytest.raises(InputError) as error:
        scene(name, camera(), WHITE, distance_mm=distance_mm, parameters=parameters)
    assert says in one_line(error)
