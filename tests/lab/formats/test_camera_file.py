"""Camera files: written and read back exactly, and wrong keys named in one line."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lab import cli
from lab.errors import InputError
from lab.formats.camera_file import CameraFile, default_camera, describe_quantity, lens_cache, read_camera, write_camera
from sim.camera import CameraModel, Geometry, Lens
from sim.effects.library import effect
from sim.optics.imaging import MeasuredOtf, MeasuredPsf, TracedLens, ZernikePupil
from sim.optics.table import LensTable
from sim.parameters import read_quantities

LENSES = Path(__file__).parents[3].parent / "shared" / "data" / "lenses"


def _with_lens(**changes: object) -> CameraFile:
    camera = default_camera().camera
    return CameraFile(
        "one", camera.model_copy(update={"lens": Lens(**{**camera.lens.model_dump(exclude={"imaging"}), **changes})})
    )


def _table() -> LensTable:
    return LensTable(
        wavelength_nm=np.array([500.0, 600.0]), field_deg=np.array([[0.0, 0.0], [0.0, 10.0]]), grid_shape=(2,),
        symmetric=True, reference_wavelength_nm=550.0,
        focal_length_mm=8.0, f_number=4.0, entrance_pupil_mm=2.0, chief_mm=np.array([[0.0, 0.0], [0.0, 1.4]]),
        relative_illumination=np.ones((2, 2)),
        psf=np.full((2, 2, 4, 4), 1 / 16), window_um=np.zeros((2, 2)), sample_pitch_um=0.5, encircled_share=np.ones((2,
        2)), centroid_um=np.zeros((2, 2, 2)),
        warnings=("a warning",), content_hash="abc",
    )  # fmt: skip


def _files() -> list[CameraFile]:
    psf = np.random.default_rng(1).random((2, 5, 7))
    psf /= psf.sum(axis=(1, 2), keepdims=True)
    full = default_camera().camera.model_copy(
        update={
            "geometry": Geometry(camera_matrix=((2318.8, 0.0, 640.1), (0.0, 2318.8, 479.7), (0.0, 0.0, 1.0)),
            distortion=(-0.1, 0.02, 1e-4, 0.0, 0.0)),
            "std": {"read_noise_e": 0.1, "full_well_e": 12.3},
            "quantum_efficiency_std": {"R": default_camera().camera.quantum_efficiency["R"].scale(0.01)},
            "dark_current_doubling_c": None,
        }
    )  # fmt: skip
    matrix = ((260.0, 0.0, 320.0), (0.0, 260.0, 240.0), (0.0, 0.0, 1.0))
    fisheyes = [
        Geometry(camera_matrix=matrix, distortion=(0.01, -0.02, 0.003, 0.0), projection="equidistant"),
        Geometry(
            camera_matrix=matrix, distortion=(0.01, -0.02, 0.0, 1e-4, -0.1, -0.1, -0.2, -0.2),
            projection="splined_stereographic", spline_angle_deg=88.5,
        ),
    ]  # fmt: skip
    return [
        *(
            CameraFile(one.projection, default_camera().camera.model_copy(update={"geometry": one}))
            for one in fisheyes
        ),
        default_camera(),
        CameraFile('quotes " and \\ and µ', full, (effect("veiling_glare")(share_percent=1.7),
        effect("defocus")(defocus_um=3.3))),
        _with_lens(imaging=ZernikePupil(coefficients=(0.0, 0.01, -0.02, 1 / 3), index="noll", unit="waves",
        reference_wavelength_nm=550.0)),
        _with_lens(imaging=ZernikePupil(coefficients=tuple(np.linspace(0, 0.05, 15).tolist()), index="osa", unit="um",
        colour_wavelength_nm=(450.0, 650.0), image_shift_um=((0.0, 0.1), (0.3, -0.1)))),
        _with_lens(imaging=MeasuredPsf(wavelength_nm=(450.0, 650.0), psf=psf.tolist(), sample_pitch_um=0.8)),
        _with_lens(imaging=MeasuredOtf(wavelength_nm=(550.0,), frequency_x_cy_per_um=(0.0, 0.1, 0.4), modulus=(((1.0,
        0.7, 0.0),),))),
        _with_lens(imaging=TracedLens(table=_table())),
    ]  # fmt: skip


@pytest.mark.parametrize("content", _files(), ids=lambda one: one.camera.lens.imaging.kind)
def test_what_is_written_is_read(tmp_path: Path, content: CameraFile) -> None:
    file = tmp_path / "camera.toml"
    write_camera(file, content)
    back = read_camera(file)
    assert back == content
    write_camera(file, back)
    assert read_camera(file) == content


@given(
    st.floats(0.5, 64.0), st.floats(0.0, 1e5), st.floats(1e-6, 1e3), st.integers(1, 5000),
    st.text(max_size=20).filter(str.isprintable)
)  # fmt: skip
@settings(max_examples=25)
def test_any_number_comes_back_to_the_last_bit(
    f_number: float, noise: float, gain: float, rows: int, name: str
) -> None:
    from tempfile import TemporaryDirectory

    camera = _with_lens(f_number=f_number).camera.model_copy(
        update={"read_noise_e": noise, "conversion_gain_dn_per_e": gain, "rows": rows}
    )
    with TemporaryDirectory() as folder:
        file = Path(folder) / "camera.toml"
        write_camera(file, CameraFile(name, camera))
        assert read_camera(file) == CameraFile(name, camera)


def test_every_parameter_has_its_unit_and_meaning_beside_it(tmp_path: Path) -> None:
    file = tmp_path / "camera.toml"
    write_camera(file, default_camera())
    text = file.read_text()
    for model in (CameraModel, Lens):
        for key, quantity in read_quantities(model).items():
            assert any(
                line.startswith((f"{key} = ", f"# {key} ")) and line.endswith(f"# {describe_quantity(quantity)}")
                for line in text.splitlines()
            )


def test_curves_may_lie_beside(tmp_path: Path) -> None:
    file = tmp_path / "camera.toml"
    write_camera(file, default_camera())
    curve = default_camera().camera.quantum_efficiency["R"]
    rows = "".join(f"{w},{v}\n" for w, v in zip(curve.wavelength_nm, curve.value, strict=True))
    (tmp_path / "red.csv").write_text("wavelength_nm,value\n" + rows)
    text = file.read_text()
    start, end = text.index("[quantum_efficiency.R]"), text.index("[quantum_efficiency.G]")
    file.write_text(text[:start] + '[quantum_efficiency]\nR = "red.csv"\n\n' + text[end:])
    assert read_camera(file) == default_camera()
    (tmp_path / "red.csv").write_text("nm,value\n")
    with pytest.raises(InputError, match=r"camera.toml: quantum_efficiency.R: .*red.csv: its first line is 'nm,value'"):
        read_camera(file)


def test_a_measured_psf_may_be_a_plain_array(tmp_path: Path) -> None:
    np.save(tmp_path / "psf.npy", np.full((3, 3), 1 / 9))
    file = _changed(
        tmp_path,
        'kind = "diffraction_limited"',
        'kind = "measured_psf"\nsamples = "psf.npy"\nwavelength_nm = [550.0]\nsample_pitch_um = 1.5',
    )
    imaging = read_camera(file).camera.lens.imaging
    assert isinstance(imaging, MeasuredPsf)
    assert np.array(imaging.psf).shape == (1, 3, 3)
    np.save(tmp_path / "psf.npy", np.full((3, 3), 0.5))
    with pytest.raises(InputError, match=r"psf adds up to 4.5 at 550 nm.*divide it by its sum"):
        read_camera(file)


def test_a_lens_is_traced_from_its_prescription(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tracer is called with the path as seen from the camera file; the path, not the table, is what is written
    back."""
    monkeypatch.setattr(
        "lab.formats.camera_file.trace_table",
        lambda path, cache, progress: _table() if path.name == "a.zmx" else 1 / 0,
    )
    (tmp_path / "lenses").mkdir()
    file = _changed(tmp_path, 'kind = "diffraction_limited"', 'kind = "traced_lens"\nprescription = "lenses/a.zmx"')
    content = read_camera(file)
    assert isinstance(content.camera.lens.imaging, TracedLens)
    assert content.prescription == tmp_path / "lenses" / "a.zmx"
    write_camera(file, content)
    assert tomllib.loads(file.read_text())["lens"]["imaging"] == {"kind": "traced_lens", "prescription": "lenses/a.zmx"}
    assert read_camera(file) == content


def test_an_unreadable_prescription_is_named(tmp_path: Path) -> None:
    file = _changed(tmp_path, 'kind = "diffraction_limited"', 'kind = "traced_lens"\nprescription = "none.zmx"')
    with pytest.raises(InputError, match=r"camera.toml: lens.imaging.prescription: .*none.zmx: can't be read"):
        read_camera(file, tmp_path / "cache")


def _changed(folder: Path, old: str, new: str) -> Path:
    """The default camera's file with one piece of text changed."""
    file = folder / "camera.toml"
    write_camera(file, default_camera())
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    return file


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("read_noise_e = 2.4", "read_noise_e = -2.4", (r"read_noise_e: .*: -2.4 e is below the lower limit 0.0 e; give "
            r"a value within the limits$")),
        ("read_noise_e = 2.4", 'read_noise_e = "low"', r"read_noise_e is 'low': .*number"),
        ("read_noise_e = 2.4", "read_noise_e = nan", r"read_noise_e is nan: .*finite"),
        ("read_noise_e = 2.4", "", r"read_noise_e is missing; add it \(e: temporal noise of a dark pixel"),
        ("read_noise_e = 2.4", "read_noise = 2.4\nread_noise_e = 2.4", (r"read_noise isn't a key of a camera file; "
            r"leave it out, or take one of format, ")),
        ("f_number = 4.0", "f_number = 0.0", r"lens.f_number: .*: 0.0 is below the lower limit 0.5"),
        ("f_number = 4.0", "f_number = 4.0\nzoom = 2", r"lens.zoom isn't a key .* take one of f_number, focal_length_mm"),  # noqa: E501
        ("focal_length_mm = 8.0", "focal_length_mm = -8.0", (r"lens.focal_length_mm: focal length: -8.0 mm is below "
            r"the lower limit 0.1 mm")),
        ('cfa = "RGGB"', 'cfa = "RGBG"', r"cfa is 'RGBG': .*RGGB"),
        ('cfa = "RGGB"', 'cfa = "MONO"', (r"quantum_efficiency has the channels R, G, B; a MONO camera's are Y, give "
            r"those")),
        ("white_level_dn = 4095.0", "white_level_dn = 5000.0", (r"white_level_dn is 5000 DN, above the limit of 4095 "
            r"DN of 12 bit")),
        ("black_level_dn = 64.0", "black_level_dn = 4095.0", (r"black_level_dn is 4095 DN, not below the limit of "
            r"white_level_dn")),
        ("380.0, 390.0", "390.0, 380.0", (r"quantum_efficiency.R.*wavelengths must ascend: 380.0 nm follows 390.0 nm; "
            r"sort the rows")),
        ("0.00013, 0.00091", "1.5, 0.00091", r"quantum_efficiency.R runs from .* to 1.5, beyond the limits of 0 and 1"),
        ('kind = "diffraction_limited"', 'kind = "perfect"', r"lens.imaging.*'perfect'.*diffraction_limited"),
        ('kind = "diffraction_limited"', 'kind = "traced_lens"', (r"lens.imaging of a traced lens has the keys kind; "
            r"give kind and either prescription")),
        ('kind = "diffraction_limited"', 'kind = "measured_psf"\nsamples = "none.npz"', (r"lens.imaging.samples: "
            r".*none.npz can't be read")),
        ("version = 1", "version = 2", r"format 'calibench-camera' version 2 is not 'calibench-camera' 1"),
        ("[lens]", "[lens", r"isn't TOML"),
        ("[lens]", '[[effects]]\nname = "glare"\n[lens]', (r"effects\[0\].name is 'glare', which isn't an effect; take "
            r"one of .*veiling_glare")),
        ("[lens]", '[[effects]]\nname = "veiling_glare"\nshare_percent = 200\n[lens]', (r"effects\[0\].share_percent: "
            r".*: 200.0 % is above the upper limit")),
        ("[lens]", '[[effects]]\nname = "veiling_glare"\nshare = 2\n[lens]', (r"effects\[0\].share isn't a key .*one "
            r"of share_percent")),
    ],
)  # fmt: skip
def test_errors_name_key_value_limit_and_remedy(tmp_path: Path, old: str, new: str, message: str) -> None:
    file = _changed(tmp_path, old, new)
    with pytest.raises(InputError, match=message) as caught:
        read_camera(file)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none.toml: can't be read"):
        read_camera(tmp_path / "none.toml")


def test_a_fitted_camera_is_a_camera_file(flats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """MONO flats of 0.5 DN/e: the file has the fitted gain and its uncertainty, and the assumed values are reported."""
    assert cli.main(["fit", str(flats), "--write-cameras", str(tmp_path / "cameras")]) == 0
    said = capsys.readouterr().err
    assert "left.toml (neither fitted nor stated: f_number taken as 8; " in said
    content = read_camera(tmp_path / "cameras" / "left.toml")
    assert content.name == "flats left"
    gain, std = content.camera.conversion_gain_dn_per_e, content.camera.std["conversion_gain_dn_per_e"]
    assert 0 < std < 0.02
    assert gain == pytest.approx(0.5, abs=4.5 * std)


def test_the_cache_is_where_the_environment_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CALIBENCH_CACHE", str(tmp_path))
    assert lens_cache() == tmp_path
    monkeypatch.delenv("CALIBENCH_CACHE")
    assert "calibench" in lens_cache().parts
