"""Lenses of lensfun's database: which calibration serves a camera, in which unit, and what isn't one for it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.errors import InputError
from lab.formats.camera_file import CameraFile, default_camera
from lab.formats.lensfun import LensfunLens, read_lensfun, with_lens, write_lensfun
from sim.camera import CameraModel, Geometry
from sim.optics.illumination import relative_illumination
from tests.lab.formats.test_exchange import distorted, library

FULL_FRAME_MM = math.hypot(36.0, 24.0)


def camera_of(
    focal_length_mm: float = 14.0, f_number: float = 4.0, rows: int = 400, cols: int = 600, pitch_um: float = 37.0
) -> CameraFile:
    """A camera of APS-C's frame (14.8 x 22.2 mm, crop 1.622), unless stated."""
    content = default_camera()
    lens = content.camera.lens.model_copy(update={"focal_length_mm": focal_length_mm, "f_number": f_number})
    frame = {"rows": rows, "cols": cols, "pixel_pitch_um": pitch_um, "lens": lens}
    return replace(content, camera=content.camera.model_copy(update=frame))


def lens_file(
    folder: Path, body: str, head: str = "<cropfactor>1.622</cropfactor><aspect-ratio>3:2</aspect-ratio>"
) -> Path:
    """A database of one lens: its own elements, and its calibrations."""
    body = body if "<calibration" in body else f"<calibration>{body}</calibration>"
    file = folder / "lens.xml"
    file.write_text(
        f'<lensdatabase version="2"><lens><maker>M</maker><model>A 14-42</model>{head}{body}</lens></lensdatabase>'
    )
    return file


def imported(file: Path, content: CameraFile, model: str = "") -> tuple[Geometry, CameraModel, tuple[str, ...]]:
    made, remarks = with_lens(content, read_lensfun(file, content.camera, model))
    assert made.camera.geometry is not None
    return made.camera.geometry, made.camera, remarks


def radius_px(geometry: Geometry, slope: float) -> float:
    """Distance from the axis (px) at which a ray of this slope lands."""
    k1, k2, _, _, k3 = geometry.distortion
    return geometry.camera_matrix[0][0] * slope * (1.0 + k1 * slope**2 + k2 * slope**4 + k3 * slope**6)


# --- which lens -------------------------------------------------------------------------------------------------------

SAME = """<lensdatabase version="2">
<lens><maker>Test</maker><model>T 14-42</model><mount>X</mount><cropfactor>1.622</cropfactor>
<aspect-ratio>3:2</aspect-ratio><calibration><distortion model="poly3" focal="14" k1="-0.02"/></calibration></lens>
<lens><maker>Test</maker><model>T 14-42</model><mount>X</mount><cropfactor>1.0</cropfactor>
<aspect-ratio>3:2</aspect-ratio><calibration><distortion model="poly3" focal="14" k1="-0.06"/>
<distortion model="poly3" focal="42" k1="0.01"/></calibration></lens>
<lens><maker>Test</maker><model>T 14-42</model><mount>Y</mount><cropfactor>CROP</cropfactor>
<aspect-ratio>4:3</aspect-ratio><calibration><distortion model="poly3" focal="42" k1="0.03"/></calibration></lens>
</lensdatabase>"""


@pytest.mark.parametrize("crop", ["2.0", "1.622"])
@pytest.mark.parametrize("asked", ["", "T 14-42"])
def test_lenses_of_one_name_are_asked_about(tmp_path: Path, crop: str, asked: str) -> None:
    file = tmp_path / "same.xml"
    file.write_text(SAME.replace("CROP", crop))
    with pytest.raises(
        InputError, match=r"holds 3 lenses.*choose one by --lens: .*'T 14-42, Test, mount X, crop 1\.622'"
    ):
        read_lensfun(file, camera_of().camera, asked)
    geometry, _, remarks = imported(file, camera_of(), "T 14-42, Test, mount X, crop 1.622")
    # r_d = r (1.02 - 0.02 r^2), r in half of the shorter side (7.4 mm of this frame): k1 = -0.02 / 1.02 (14 / 7.4)^2
    half_mm = 0.5 * FULL_FRAME_MM / 1.622 / math.hypot(1.5, 1.0)
    assert geometry.distortion[0] == pytest.approx(-0.02 / 1.02 * (14.0 / half_mm) ** 2, rel=1e-9)
    assert geometry.distortion[0] == pytest.approx(-0.0702, abs=5e-5) and remarks == ()
    geometry, _, _ = imported(file, camera_of(), "T 14-42, Test, mount X, crop 1.0")
    assert geometry.distortion[0] == pytest.approx(-0.06 / 1.06 * (14.0 / 12.0) ** 2, rel=1e-9)


def test_lenses_alike_in_all_they_state_are_numbered(tmp_path: Path) -> None:
    file = tmp_path / "same.xml"
    twice = SAME.replace("<mount>Y</mount><cropfactor>CROP", "<mount>X</mount><cropfactor>1.0")
    file.write_text(twice)
    with pytest.raises(InputError, match=r"crop 1\.0 #1', 'T 14-42, Test, mount X, crop 1\.0 #2'"):
        read_lensfun(file, camera_of().camera)
    geometry, _, _ = imported(file, camera_of(focal_length_mm=42.0), "T 14-42, Test, mount X, crop 1.0 #2")
    assert geometry.camera_matrix[0][0] == pytest.approx(42.0 / 0.037 * 0.97)


@pytest.mark.parametrize(
    "projection", ["fisheye", "equisolid", "stereographic", "orthographic", "fisheye_thoby", "panoramic"]
)
def test_a_fisheye_is_no_pinhole(tmp_path: Path, projection: str) -> None:
    file = lens_file(
        tmp_path,
        '<distortion model="ptlens" focal="14" a="0.0138" b="-0.0657" c="0.0095"/>',
        f"<cropfactor>1.622</cropfactor><type>{projection}</type>",
    )
    with pytest.raises(InputError, match=f"has the projection '{projection}', and a camera file holds a pinhole"):
        read_lensfun(file, camera_of().camera)


# --- units ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "body", ['<distortion model="poly3" focal="14" k1="-0.02"/>', '<tca model="linear" focal="14" kr="1.001"/>']
)
def test_a_crop_factor_is_never_assumed(tmp_path: Path, body: str) -> None:
    with pytest.raises(InputError, match=r"has no cropfactor.*add that of the camera"):
        read_lensfun(lens_file(tmp_path, body, "<mount>X</mount>"), camera_of().camera)


def test_an_aspect_ratio_that_is_taken_is_reported(tmp_path: Path) -> None:
    file = lens_file(tmp_path, '<distortion model="poly5" focal="14" k1="-0.02"/>', "<cropfactor>1.5</cropfactor>")
    geometry, _, remarks = imported(file, camera_of())
    assert remarks == ("aspect-ratio isn't stated: 3:2 is taken, lensfun's default",)
    half_mm = 0.5 * FULL_FRAME_MM / 1.5 / math.hypot(1.5, 1.0)
    assert geometry.distortion[0] == pytest.approx(-0.02 * (14.0 / half_mm) ** 2, rel=1e-9)


@pytest.mark.parametrize("name", ['real-focal="13.0" a', "a"])
def test_the_real_focal_length_is_used(tmp_path: Path, name: str) -> None:
    """The file's real focal length is that of the image's centre, so what ptlens scales there isn't put on it again."""
    own = "" if "real" in name else '<real-focal-length focal="14" real-focal="13.0"/>'
    file = lens_file(tmp_path, f'{own}<distortion model="ptlens" focal="14" {name}="0.0138" b="-0.0657" c="0.0095"/>')
    geometry, camera, remarks = imported(file, camera_of())
    assert remarks == ("focal_length_mm 14 becomes 13, the real-focal stated",)
    assert geometry.camera_matrix[0][0] == pytest.approx(13.0 / 0.037, rel=0.002)  # even powers alone, over the frame
    assert camera.lens.focal_length_mm == 13.0
    # lensfun 0.3.95's normalised ptlens: r_d = r (a' r^3 + b' r^2 + c' r + 1), r over the real focal length
    scaling, d = 13.0 / (0.5 * FULL_FRAME_MM / 1.622 / math.hypot(1.5, 1.0)), 1.0 - 0.0138 + 0.0657 - 0.0095
    slope = np.linspace(0.1, 0.9, 5) * 13.34 / 13.0  # out to 0.9 of the corner
    law = 1.0 + sum(k * (scaling * slope / d) ** power / d for k, power in ((0.0138, 3), (-0.0657, 2), (0.0095, 1)))
    wanted = 13.0 / 0.037 * slope * law
    found = [radius_px(geometry, one) for one in slope]
    np.testing.assert_allclose(found, wanted, atol=0.05)  # TOLD_PX: what k1, k2, k3 leave is less


def test_each_correction_has_the_unit_of_its_calibration(tmp_path: Path) -> None:
    body = (
        '<calibration cropfactor="1.0" aspect-ratio="3:2">'
        '<vignetting model="pa" focal="14" aperture="4" distance="1000" k1="-0.3" k2="0" k3="0"/></calibration>'
        '<calibration cropfactor="1.622" aspect-ratio="3:2"><distortion model="poly3" focal="14" k1="-0.02"/>'
        "</calibration>"
    )
    content = camera_of()
    geometry, camera, remarks = imported(lens_file(tmp_path, body, "<cropfactor>1.0</cropfactor>"), content)
    assert geometry.distortion[0] == pytest.approx(-0.0702, abs=5e-5) and remarks == ()
    corner = relative_illumination(camera, np.array([-0.5]), np.array([-0.5]))
    # the camera's half diagonal is 13.34 mm, the calibration's 21.63 mm
    assert float(np.ravel(corner)[0]) == pytest.approx(1.0 - 0.3 * (13.3405 / 21.6333) ** 2, abs=1e-4)


def test_an_empty_calibration_hides_no_other(tmp_path: Path) -> None:
    body = (
        '<calibration cropfactor="1.622" aspect-ratio="3:2"/>'
        '<calibration cropfactor="1.0" aspect-ratio="3:2"><distortion model="poly3" focal="14" k1="-0.02"/>'
        "</calibration>"
    )
    geometry, _, _ = imported(lens_file(tmp_path, body), camera_of())
    assert geometry.distortion[0] == pytest.approx(-0.02 / 1.02 * (14.0 / 12.0) ** 2, rel=1e-9)


def test_the_smallest_frame_that_covers_the_cameras_is_taken(tmp_path: Path) -> None:
    """Of three, with sides of their own; and none of a camera larger than all."""
    sets = (("2.0", "4:3", -0.01), ("1.5", "16:9", -0.03), ("1.0", "3:2", -0.05))
    body = "".join(
        f'<calibration cropfactor="{crop}" aspect-ratio="{aspect}"><distortion model="poly5" focal="14" k1="{k1}"/>'
        "</calibration>"
        for crop, aspect, k1 in sets
    )
    file = lens_file(tmp_path, body)
    for content, crop, aspect, k1 in (
        (camera_of(rows=480, cols=640, pitch_um=10.0), 2.0, 4 / 3, -0.01),
        (camera_of(), 1.5, 16 / 9, -0.03),
        (camera_of(rows=600, cols=600, pitch_um=48.0), 1.0, 1.5, -0.05),
    ):
        geometry, _, _ = imported(file, content)
        half_mm = 0.5 * FULL_FRAME_MM / crop / math.hypot(aspect, 1.0)
        assert geometry.distortion[0] == pytest.approx(k1 * (14.0 / half_mm) ** 2, rel=1e-9)
    with pytest.raises(InputError, match=r"frame \(diagonal 43.27 mm\) is smaller than the camera's \(59.40 mm\)"):
        read_lensfun(file, camera_of(rows=600, cols=600, pitch_um=70.0).camera)


def test_a_square_frame_comes_back(tmp_path: Path) -> None:
    """lensfun takes 3:2 where a file states no sides, so a square's are written, too."""
    content = distorted(-0.12, 0.03)
    camera = content.camera.model_copy(update={"rows": 960, "cols": 960})
    content = replace(content, camera=camera)
    write_lensfun(tmp_path / "square.xml", content)
    geometry, _, _ = imported(tmp_path / "square.xml", content)
    np.testing.assert_allclose(geometry.distortion[:2], (-0.12, 0.03), atol=1e-6)


def test_a_centre_that_a_file_states_is_taken(tmp_path: Path) -> None:
    head = '<cropfactor>1.622</cropfactor><aspect-ratio>3:2</aspect-ratio><center x="0.02" y="-0.01"/>'
    geometry, _, _ = imported(
        lens_file(tmp_path, '<distortion model="poly5" focal="14" k1="-0.02"/>', head), camera_of()
    )
    assert geometry.camera_matrix[0][2] == pytest.approx(299.5 + 0.02 * 200)
    assert geometry.camera_matrix[1][2] == pytest.approx(199.5 - 0.01 * 200)


# --- models -----------------------------------------------------------------------------------------------------------


def test_acm_is_opencvs_law(tmp_path: Path) -> None:
    """Adobe's radii are in units of the focal length, as OpenCV's."""
    file = lens_file(tmp_path, '<distortion model="acm" focal="14" k1="-0.05" k2="0.01" k3="0"/>')
    geometry, _, remarks = imported(file, camera_of())
    np.testing.assert_allclose(geometry.distortion, (-0.05, 0.01, 0.0, 0.0, 0.0), atol=1e-9)
    assert geometry.camera_matrix[0][0] == pytest.approx(14.0 / 0.037) and remarks == ()
    file = lens_file(
        tmp_path, '<distortion model="acm" focal="20" k1="0.03" k2="-0.004" k3="0.002" k4="0.001" k5="-0.002"/>'
    )
    geometry, _, _ = imported(file, camera_of(focal_length_mm=20.0))
    np.testing.assert_allclose(geometry.distortion, (0.03, -0.004, 0.001, -0.002, 0.002), atol=1e-9)


def test_light_falls_off_as_stated(tmp_path: Path) -> None:
    body = (
        '<distortion model="poly3" focal="14" k1="-0.02"/>'
        '<vignetting model="pa" focal="14" aperture="4" distance="10" k1="-0.5" k2="0.1" k3="-0.05"/>'
    )
    _, camera, remarks = imported(lens_file(tmp_path, body), camera_of())
    assert remarks == ("vignetting: as calibrated at 14 mm, f/4, 10 m",)
    col = np.linspace(299.5, 599.5, 7)
    r2 = ((col - 299.5) * 0.037 / (0.5 * FULL_FRAME_MM / 1.622)) ** 2
    light = np.ravel(relative_illumination(camera, np.array([199.5]), col))
    np.testing.assert_allclose(
        light, 1.0 - 0.5 * r2 + 0.1 * r2**2 - 0.05 * r2**3, atol=2e-4
    )  # 41 samples, interpolated


def test_a_tca_that_isnt_a_scale_is_reported(tmp_path: Path) -> None:
    file = lens_file(tmp_path, '<tca model="poly3" focal="14" vr="1.0002" vb="0.9997" br="0.0004" bb="-0.0002"/>')
    lens = read_lensfun(file, camera_of().camera)
    assert lens.tca is not None
    corner_mm = camera_of().camera.half_diagonal_um * 1e-3
    r = corner_mm / (0.5 * FULL_FRAME_MM / 1.622 / math.hypot(1.5, 1.0))
    red, blue = lens.tca(np.array([corner_mm]))
    assert (float(red[0]), float(blue[0])) == pytest.approx((1.0002 + 0.0004 * r**2, 0.9997 - 0.0002 * r**2))
    _, remarks = with_lens(camera_of(), lens)
    assert len(remarks) == 1 and remarks[0].startswith("tca: one scale a channel, that of the corner, leaves 0.1")


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ('<distortion model="ptlens" focal="14" a="0,0138" b="-0,0657"/>', "is '0,0138'.*write 0.0138, with"),
        ('<distortion model="poly3" focal="14,5" k1="-0.02"/>', "focal of <distortion> is '14,5'.*write 14.5, with"),
        ('<distortion model="fov1" focal="14" omega="1"/>', "distortion of model 'fov1' isn't known"),
        ('<distortion model="poly3" focal="42" k1="-0.02"/>', "is calibrated at 42 mm and the camera file's"),
        ('<distortion model="none" focal="14"/>', "has no calibration that serves this camera"),
        (
            '<vignetting model="pa" focal="14" aperture="1.4" distance="10" k1="-0.5"/>',
            "is calibrated at f/1.4, too far from f/4",
        ),
    ],
)  # fmt: skip
def test_what_serves_no_such_camera_is_refused_in_one_line(tmp_path: Path, body: str, reason: str) -> None:
    with pytest.raises(InputError, match=reason) as refused:
        read_lensfun(lens_file(tmp_path, body), camera_of().camera)
    assert "\n" not in str(refused.value)


# --- between calibrations ---------------------------------------------------------------------------------------------


def test_coefficients_are_interpolated_over_focal_length(tmp_path: Path) -> None:
    """a, b and c times the focal length, by lensfun's spline: from 12 and 16 mm, with a neighbour at 42 mm."""
    file = lens_file(
        tmp_path,
        '<distortion model="ptlens" focal="12" a="0.03" b="-0.09" c="0.0095"/>'
        '<distortion model="ptlens" focal="16" a="0.0" b="-0.04" c="0.0095"/>'
        '<distortion model="ptlens" focal="42" a="0" b="0" c="0"/>',
    )
    lens = read_lensfun(file, camera_of().camera)
    assert lens.remarks == ("distortion: taken at 14 mm from calibrations at 12 to 16 mm",)
    # t = 0.5: (y2 + y3) / 2 + (m2 - m3) / 8, m2 = y3 - y2, m3 = (y4 - y2) / 2; y = coefficient times focal length
    terms = []
    for low, high, after in ((0.36, 0.0, 0.0), (-1.08, -0.64, 0.0), (0.114, 0.152, 0.0)):
        terms.append((0.5 * (low + high) + ((high - low) - 0.5 * (after - low)) / 8.0) / 14.0)
    a, b, c = terms
    half_mm = 0.5 * FULL_FRAME_MM / 1.622 / math.hypot(1.5, 1.0)
    r = np.linspace(0.0, 1.7, 7)
    assert lens.distortion is not None
    np.testing.assert_allclose(lens.distortion(r * half_mm), a * r**3 + b * r**2 + c * r + 1.0 - a - b - c, rtol=1e-12)


@pytest.mark.parametrize(("first", "last"), [(-0.02, -0.05), (-0.05, -0.02)])
def test_of_several_calibrations_at_one_place_the_last_is_taken_and_it_is_reported(
    tmp_path: Path, first: float, last: float
) -> None:
    """As lensfun 0.3.4 does: its `interpolate_distortion(14)` has the last k1. r_d = r (1 - k1 + k1 r^2)."""
    line = '<distortion model="poly3" focal="14" k1="{}"/>'
    file = lens_file(tmp_path, line.format(first) + line.format(last))
    lens = read_lensfun(file, camera_of().camera)
    half_mm = 0.5 * FULL_FRAME_MM / 1.622 / math.hypot(1.5, 1.0)
    assert lens.distortion is not None
    np.testing.assert_allclose(lens.distortion(np.array([half_mm * 2.0])), 1.0 - last + 4.0 * last, rtol=1e-12)
    (remark,) = lens.remarks
    assert remark == (
        "distortion: several calibrations at 14 mm differ, and the last one is taken, as lensfun does; remove those "
        "that don't apply"
    )
    file = lens_file(tmp_path, line.format(last) + line.format(last))
    assert read_lensfun(file, camera_of().camera).remarks == ()


def test_a_focal_length_next_to_the_calibrated_ones_is_reported(tmp_path: Path) -> None:
    file = lens_file(tmp_path, '<distortion model="poly5" focal="14.5" k1="-0.02"/>')
    assert read_lensfun(file, camera_of().camera).remarks == (
        "distortion: taken at 14 mm from calibrations at 14.5 mm",
    )
    body = '<distortion model="poly5" focal="14" k1="-0.02"/><tca model="linear" focal="30" kr="1.001" kb="1"/>'
    lens = read_lensfun(lens_file(tmp_path, body), camera_of().camera)
    assert lens.tca is None and lens.distortion is not None
    assert lens.remarks[0].startswith("tca: left out, as it is calibrated at 30 mm")


@pytest.mark.parametrize(
    ("model", "focals_mm", "f_number"),
    [
        ("Canon EF-S 18-135mm f/3.5-5.6 IS STM", (19.0, 42.0, 101.0), 7.0),
        ("LUMIX G VARIO 100-300/F4.0-5.6II", (110.0, 170.0, 262.0), 6.3),
        ("XF16-80mmF4 R OIS WR", (17.0, 21.0, 35.8), 5.0),
    ],
)
def test_lensfun_itself_interpolates_so(model: str, focals_mm: tuple[float, ...], f_number: float) -> None:
    """Lenses of its own database between their calibrations, against lensfun 0.3.4 in single precision."""
    lensfunpy = library("lensfunpy")
    lens = next(one for one in lensfunpy.Database().lenses if one.model == model)
    assert lensfunpy.__file__ is not None
    files = sorted((Path(lensfunpy.__file__).parent / "db_files").glob("*.xml"))
    file = next(one for one in files if f">{model}<" in one.read_text(encoding="utf-8"))
    half_mm, r = 0.5 * FULL_FRAME_MM / lens.crop_factor, np.linspace(0.0, 1.0, 5)
    for focal_mm in focals_mm:
        found: LensfunLens = read_lensfun(file, camera_of(focal_mm, f_number, rows=300, cols=400).camera, model)
        assert found.distortion is not None and found.tca is not None and found.vignetting is not None
        bent, colour = lens.interpolate_distortion(focal_mm), lens.interpolate_tca(focal_mm)
        dark = lens.interpolate_vignetting(focal_mm, f_number, 1000.0)
        assert (bent.model.name, colour.model.name, dark.model.name) == ("PTLENS", "POLY3", "PA")
        a, b, c = bent.terms
        short_mm = r * half_mm / math.hypot(4 / 3 if lens.crop_factor == 2.0 else 1.5, 1.0)  # 2.0: four thirds
        np.testing.assert_allclose(found.distortion(short_mm), a * r**3 + b * r**2 + c * r + 1.0 - a - b - c, atol=1e-6)
        vr, vb, cr, cb, br, bb = colour.terms
        red, blue = found.tca(short_mm)
        np.testing.assert_allclose(red, vr + cr * r + br * r**2, atol=1e-6)
        np.testing.assert_allclose(blue, vb + cb * r + bb * r**2, atol=1e-6)
        k1, k2, k3 = dark.terms
        np.testing.assert_allclose(found.vignetting(r * half_mm), 1.0 + k1 * r**2 + k2 * r**4 + k3 * r**6, atol=1e-5)
