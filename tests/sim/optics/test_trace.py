"""Tracing: analytic limits, an independent tracer's rays, known lenses, and the table that comes of it."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.special import j1

from sim.optics import rays as rt
from sim.optics.diffraction import diffraction_otf
from sim.optics.planewaves import interpolate_rays, point_spread
from sim.optics.prescription import Aperture, GlassName, Prescription, PrescriptionError, Surface
from sim.optics.system import OpticalSystem
from sim.optics.traced_table import OpticalTable, TableSettings, lens_table, read_or_trace_table
from sim.optics.zmx import read_zmx

HERE = Path(__file__).parent
SHARED = Path(__file__).parents[3] / "../shared/data/lenses"
needs_lenses = pytest.mark.skipif(not SHARED.is_dir(), reason="the lens prescriptions aren't beside the repository")
N = 1.5
# No dispersion: what the normal line says at that Vd is taken back by the deviation.
GLASS = GlassName(name="dispersionless", model=True, index_d=N, abbe_d=1e9, partial_dispersion_deviation=0.001682 * 1e9)
D_NM = 587.5618


def lens(*surfaces: Surface, pupil_mm: float = 2.0, field_deg: float = 5.0, **more: object) -> Prescription:
    """A lens behind its stop, which is the first surface, in the plane of the first vertex."""
    values: dict[str, object] = {
        "name": "test",
        "surfaces": (Surface(), *surfaces, Surface()),
        "stop": 0,
        "aperture_kind": "entrance_pupil_mm",
        "aperture_value": pupil_mm,
        "field_points": ((0.0, 0.0), (0.0, field_deg)),
        "primary_wavelength_nm": D_NM,
    }
    return Prescription.model_validate(values | more)


def ellipsoid(pupil_mm: float = 2.0, radius_mm: float = 8.0, **more: object) -> Prescription:
    """The surface that images what is far away without any path error on its axis, in glass: conic -1 / n^2."""
    return lens(
        Surface(curvature_per_mm=1 / radius_mm, conic=-1 / N**2, thickness_mm=N * radius_mm / (N - 1), glass=GLASS),
        pupil_mm=pupil_mm,
        **more,
    )


def doublet() -> Prescription:
    return read_zmx(HERE / "lenses/doublet.zmx")


# --- analytic limits
# ---------------------------------------------------------------------------------------------------


def test_one_refracting_surface() -> None:
    first = OpticalSystem(ellipsoid()).first_order
    assert first.focal_length_mm == pytest.approx(8.0 / (N - 1), rel=1e-6)  # R / (n - 1), the power's reciprocal
    assert first.back_focus_mm == pytest.approx(N * 8.0 / (N - 1), rel=1e-6)
    assert first.entrance_pupil_mm == 2.0 and first.f_number == pytest.approx(8.0, rel=1e-6)


def test_a_ball_lens_has_its_textbook_focal_length() -> None:
    # f = n D / (4 (n - 1)), back focus f - D / 2.
    ball = lens(
        Surface(curvature_per_mm=0.5, thickness_mm=4.0, glass=GLASS),
        Surface(curvature_per_mm=-0.5, thickness_mm=1.0),
        pupil_mm=0.2,
    )
    first = OpticalSystem(ball).first_order
    assert first.focal_length_mm == pytest.approx(N * 4 / (4 * (N - 1)), rel=1e-9)
    assert first.back_focus_mm == pytest.approx(3.0 - 2.0, rel=1e-6)


def test_a_plane_parallel_plate_moves_the_focus() -> None:
    def image(plate_mm: float) -> float:
        glass = Surface(thickness_mm=plate_mm, glass=GLASS)
        thin = Surface(curvature_per_mm=0.1, thickness_mm=1e-9, glass=GLASS)
        system = OpticalSystem(lens(thin, Surface(curvature_per_mm=-0.1, thickness_mm=2.0), glass, Surface()))
        return system.first_order.back_focus_mm + plate_mm

    assert image(1.5) - image(1e-9) == pytest.approx(1.5 * (1 - 1 / N), rel=1e-6)


def test_pupils_of_a_stop_behind_a_lens() -> None:
    # A thin lens of f = 10 mm with the stop 2 mm behind: 1 / s' = 1 / 2 - 1 / 10, magnification s' / 2.
    thin = (
        Surface(curvature_per_mm=0.1, thickness_mm=1e-9, glass=GLASS),
        Surface(curvature_per_mm=-0.1, thickness_mm=2.0),
        Surface(thickness_mm=8.0),
        Surface(),
    )
    first = OpticalSystem(
        Prescription(
            name="t",
            surfaces=thin,
            stop=2,
            aperture_kind="entrance_pupil_mm",
            aperture_value=1.0,
            primary_wavelength_nm=D_NM,
        )
    ).first_order
    assert first.focal_length_mm == pytest.approx(10.0, rel=1e-6)
    assert first.entrance_pupil_position_mm == pytest.approx(2.5, rel=1e-6)
    assert first.stop_semi_diameter_mm == pytest.approx(0.5 * 2 / 2.5, rel=2e-3)  # the real ray's, with its aberration
    assert first.exit_pupil_position_mm == pytest.approx(0.0, abs=1e-9)


def test_an_ellipsoid_images_its_axis_without_path_error() -> None:
    rays = OpticalSystem(ellipsoid()).pupil((0.0, 0.0), D_NM, 30.0)
    assert rays is not None
    assert np.max(np.hypot(rays.x_mm, rays.y_mm)) < 1e-10
    assert np.ptp(rays.plane_path_mm(0.0, 0.0)) < 1e-9  # of a wave of 5.9e-4 mm


def test_the_derivatives_of_rays_are_those_of_differences() -> None:
    system = OpticalSystem(doublet())
    h = 1e-5
    tangent = (0.05, 0.2)
    centre = system.trace(tangent, 550.0, 0.4, -0.7)[0]
    for places, step in (
        ((rt.DL_DX, rt.DM_DX, rt.DX_DX, rt.DY_DX), (h, 0.0)),
        ((rt.DL_DY, rt.DM_DY, rt.DX_DY, rt.DY_DY), (0.0, h)),
    ):
        ahead = system.trace(tangent, 550.0, 0.4 + step[0], -0.7 + step[1])[0]
        behind = system.trace(tangent, 550.0, 0.4 - step[0], -0.7 - step[1])[0]
        for place, value in zip(places, (rt.L, rt.M, rt.X, rt.Y), strict=True):
            assert centre[place] == pytest.approx((ahead[value] - behind[value]) / (2 * h), abs=1e-7)


# --- an independent tracer
# ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["doublet", "tilted"])
def test_rays_agree_with_batoid(name: str) -> None:
    system = OpticalSystem(read_zmx(HERE / f"lenses/{name}.zmx"))
    with (HERE / "data/batoid.csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["lens"] == name]
    assert len(rows) == 20
    for row in rows:
        v = {key: float(value) for key, value in row.items() if key != "lens"}
        ray = system.trace((v["tan_x"], v["tan_y"]), D_NM, v["px_mm"], v["py_mm"])[0]
        assert ray[rt.STATUS] == rt.ARRIVED
        for place, key in (
            (rt.X, "x_mm"),
            (rt.Y, "y_mm"),
            (rt.L, "cosine_x"),
            (rt.M, "cosine_y"),
            (rt.PATH, "path_mm"),
        ):
            assert ray[place] == pytest.approx(v[key], abs=1e-10)  # both in double precision


# --- images
# ------------------------------------------------------------------------------------------------------------


def test_a_perfect_image_is_airys() -> None:
    system = OpticalSystem(ellipsoid(pupil_mm=1.0))
    rays = system.pupil((0.0, 0.0), 550.0, 60.0)
    assert rays is not None
    samples, pitch_um = 48, 1.0
    psf = point_spread(rays, (0.0, 0.0), samples, pitch_um)
    place = (np.arange(samples) - 0.5 * (samples - 1)) * pitch_um
    r = np.hypot(*np.meshgrid(place, place))
    # In glass: wavelength / n, sine of the marginal ray of half the pupil over the image distance.
    sine = float(np.max(np.hypot(rays.rim_cosine_x, rays.rim_cosine_y)))
    v = 2 * np.pi * N / 0.55 * sine * r
    airy = np.pi * (N * sine / 0.55) ** 2 * (2 * j1(v) / v) ** 2 * pitch_um**2
    # The pupil of sin^2 = 4e-4 is not quite evenly lit in direction cosines.
    assert np.max(np.abs(psf - airy)) < 1e-3 * airy.max()
    assert psf.sum() == pytest.approx(airy.sum(), abs=1e-4)


def test_a_perfect_lens_has_the_diffraction_mtf() -> None:
    system = OpticalSystem(ellipsoid(pupil_mm=0.25))
    rays = system.pupil((0.0, 0.0), 550.0, 20.0)
    assert rays is not None
    sine = float(np.max(np.hypot(rays.rim_cosine_x, rays.rim_cosine_y)))
    f = np.array([0.0, 5.0, 10.0, 20.0, 27.0])
    expected = diffraction_otf(f * 1e-3, 550.0 / N, 0.5 / sine)
    for mtf in system.mtf((0.0, 0.0), 550.0, f):
        assert mtf == pytest.approx(expected, abs=5e-5)  # evenly lit to sin^2 = 3e-5


def test_what_leaves_the_lens_arrives() -> None:
    """The light in ever larger windows comes to 1: Airy's tail outside a square of half side a is
    2 / (pi^2 a NA / wavelength) x 0.9.
    """
    system = OpticalSystem(ellipsoid(pupil_mm=4.0))
    missing = []
    for samples in (32, 64, 128):
        half_mm = 0.5e-3 * samples
        k = 2e6 * math.pi * N / 550.0
        rays = system.pupil((0.0, 0.0), 550.0, k * 0.09 * half_mm * math.sqrt(2))
        assert rays is not None
        missing.append(1 - point_spread(rays, (0.0, 0.0), samples, 1.0).sum())
    assert 0 < missing[2] < missing[1] < missing[0] < 0.1
    # The tail falls as 1 / a: what is missing halves with twice the window, to a few per cent of rings.
    assert missing[1] / missing[2] == pytest.approx(2.0, rel=0.1)
    assert 2 * missing[2] - missing[1] == pytest.approx(0.0, abs=2e-3)


def test_the_axis_of_a_centred_lens_is_symmetric() -> None:
    table = lens_table(doublet(), TableSettings(wavelength_nm=(550.0,), fields=2, samples=32))
    axis = table.psf[0, 0]
    for turned in (axis[::-1], axis[:, ::-1], axis.T):
        assert turned == pytest.approx(axis, abs=1e-6 * axis.max())
    off = table.psf[0, 1]
    assert off[:, ::-1] == pytest.approx(off, abs=1e-12)
    assert np.max(np.abs(off[::-1] - off)) > 0.05 * off.max()  # off the axis it isn't, along y


def test_a_window_too_small_for_the_spread_is_told() -> None:
    told = lens_table(doublet(), TableSettings(wavelength_nm=(550.0,), fields=2, samples=8))
    assert told.encircled_share.min() < 0.9
    assert any("arrives within" in line and "take more samples" in line for line in told.warnings)
    wide = lens_table(doublet(), TableSettings(wavelength_nm=(550.0,), fields=2, samples=64, maximum_field_deg=0.5))
    assert wide.encircled_share.min() > 0.9
    assert not any("arrives within" in line for line in wide.warnings)


def test_far_rays_left_out_keep_the_light_in_the_window() -> None:
    system = OpticalSystem(doublet())
    rays = system.pupil((0.0, math.tan(math.radians(18.0))), 550.0, 100.0)
    assert rays is not None
    centre = rays.centroid_mm
    half_diagonal = 0.5e-3 * 16 * 0.8 * math.sqrt(2)
    assert np.max(np.hypot(rays.x_mm, rays.y_mm - centre[1])) > 4.2 * half_diagonal
    whole, near = (point_spread(rays, centre, 16, 0.8, reach) for reach in (math.inf, 4 * half_diagonal))
    # What far rays send into the window is diffracted at the rim: thousandths of the light, which move its fine
    # fringes.
    assert near.sum() == pytest.approx(whole.sum(), abs=5e-3)
    assert np.sqrt(np.mean((near - whole) ** 2)) < 0.25 * np.sqrt(np.mean(whole**2))


def test_rays_between_traced_wavelengths_are_interpolated() -> None:
    system = OpticalSystem(doublet())
    tangent = (0.0, 0.3)
    centre = system.open_centre(tangent, [550.0])
    nodes = [720.0, 640.0, 580.0, 530.0, 490.0, 450.0, 420.0, 400.0]
    traced = []
    for w in nodes:
        rays = system.pupil(tangent, w, 20.0, centre)
        assert rays is not None
        traced.append(rays)
    own = system.pupil(tangent, 505.0, 20.0, centre)
    between = interpolate_rays(traced, [505.0], [1.0])[0]
    assert own is not None
    # The path that all rays have in common is 2.5e-8 mm off; 1e-9 mm between rays is 2e-6 of a wave.
    error = between.plane_path_mm(0.0, 3.0) - own.plane_path_mm(0.0, 3.0)
    assert np.max(np.abs(error)) < 1e-7 and np.ptp(error) < 5e-9
    assert between.x_mm == pytest.approx(own.x_mm, abs=1e-7)
    assert between.energy == pytest.approx(own.energy, rel=1e-9)


# --- tables
# ------------------------------------------------------------------------------------------------------------

SMALL = TableSettings(wavelength_nm=(450.0, 550.0, 650.0), fields=4, samples=24)


def test_a_table_holds_what_single_rays_say() -> None:
    system = OpticalSystem(doublet())
    table = OpticalTable(system, SMALL).table()
    assert table.symmetric and table.grid_shape == (4,) and table.reference_wavelength_nm == 550.0
    tangents = np.tan(np.deg2rad(table.field_deg))
    assert tangents[:, 1] == pytest.approx(np.linspace(0, math.tan(math.radians(18)), 4))
    for f in range(4):
        chief = system.chief((0.0, float(tangents[f, 1])), 550.0)
        assert chief is not None
        assert table.chief_mm[f] == pytest.approx(chief[[rt.X, rt.Y]], abs=1e-9)
        assert math.hypot(chief[rt.STOP_X], chief[rt.STOP_Y]) < 1e-9
    assert table.relative_illumination[:, 0] == pytest.approx(1.0)
    assert table.encircled_share == pytest.approx(table.psf.sum(axis=(2, 3)), abs=1e-12)
    assert np.all(table.encircled_share < 1) and np.all(table.psf >= 0)
    # Lateral colour is in the centroids, not in the chief ray: it is there once.
    assert abs(table.centroid_um[0, -1, 1] - table.centroid_um[2, -1, 1]) > 0.5
    assert all("arrives within" in line for line in table.warnings)  # of a small window


def test_vignetting_by_an_aperture_that_is_not_the_stop() -> None:
    """Two equal circles, the second seen shifted by d tan(theta): the share that overlaps, by their lens-shaped
    area.
    """
    radius, gap, theta = 1.0, 3.0, math.radians(20.0)
    circle = Aperture(shape="circle", half_width_mm=radius, half_height_mm=radius)
    f = 1000.0  # so weak that rays stay parallel to 1e-3
    prescription = Prescription(
        name="two holes",
        surfaces=(
            Surface(thickness_mm=gap),
            Surface(aperture=circle, thickness_mm=1e-6),
            Surface(curvature_per_mm=1 / (f * (N - 1)), thickness_mm=1e-6, glass=GLASS),
            Surface(thickness_mm=f),
            Surface(),
        ),
        stop=0,
        aperture_kind="entrance_pupil_mm",
        aperture_value=2 * radius,
        primary_wavelength_nm=D_NM,
    )
    rays = OpticalSystem(prescription).pupil((0.0, math.tan(theta)), D_NM, 0.0)
    assert rays is not None
    s = gap * math.tan(theta) / (2 * radius)
    expected = 2 * radius**2 * (math.acos(s) - s * math.sqrt(1 - s * s))
    assert rays.energy == pytest.approx(expected, rel=1e-3)  # kinks of the rim between 96 directions


def test_a_field_at_which_the_lens_fails_limits_the_table() -> None:
    # A hemisphere behind the stop: the rays of steep fields miss it.
    steep = lens(
        Surface(thickness_mm=1.0),
        Surface(curvature_per_mm=0.5, thickness_mm=2.0, glass=GLASS),
        Surface(curvature_per_mm=0.0, thickness_mm=2.0),
        pupil_mm=0.4,
        field_deg=65.0,
    )
    table = lens_table(steep, TableSettings(wavelength_nm=(550.0,), fields=5, samples=16))
    assert any("the table ends at" in line for line in table.warnings)
    assert 10 < table.field_deg[-1, 1] < 65
    assert np.all(np.diff(table.chief_mm[:, 1]) > 0)


def test_finite_objects_have_their_magnification() -> None:
    # Thin lens of 10 mm, object at 50 mm: image at 12.5 mm, m = -0.25.
    thin = (
        Surface(curvature_per_mm=0.1, thickness_mm=1e-9, glass=GLASS),
        Surface(curvature_per_mm=-0.1, thickness_mm=12.5),
    )
    system = OpticalSystem(
        lens(*thin, pupil_mm=0.5, object_distance_mm=50.0, field_kind="object_height_mm", field_points=((0.0, 4.0),))
    )
    assert system.first_order.magnification == pytest.approx(-0.25, rel=1e-6)
    assert system.first_order.paraxial_image_mm == pytest.approx(12.5, rel=1e-6)
    assert system.file_field_tangent() == pytest.approx(4.0 / 50.0, rel=1e-9)
    chief = system.chief((0.0, 4.0 / 50.0), D_NM)
    assert chief is not None and chief[rt.Y] == pytest.approx(1.0, rel=1e-3)


def test_best_focus_finds_the_focus() -> None:
    moved = ellipsoid(pupil_mm=2.0)
    surface = moved.surfaces[1].model_copy(update={"thickness_mm": moved.surfaces[1].thickness_mm + 0.03})
    system = OpticalSystem(
        moved.model_copy(update={"surfaces": (moved.surfaces[0], surface, moved.surfaces[2])}), "best"
    )
    assert system.image_shift_mm == pytest.approx(-0.03, rel=2e-3)


def test_a_decentred_lens_gets_a_grid_of_fields() -> None:
    table = lens_table(
        read_zmx(HERE / "lenses/tilted.zmx"), TableSettings(wavelength_nm=(550.0,), grid=3, fields=3, samples=24)
    )
    assert not table.symmetric and table.grid_shape == (3, 3) and len(table.field_deg) == 9
    assert table.field_deg[4] == pytest.approx([0.0, 0.0])
    # Fields run along x first, then along y.
    assert table.field_deg[5, 0] > 0 and table.field_deg[7, 1] > 0
    assert np.hypot(*table.chief_mm[4]) > 0.05  # the axis isn't imaged on the axis
    assert np.max(np.abs(table.psf[0, 3] - table.psf[0, 5][:, ::-1])) > 1e-3 * table.psf[0, 3].max()


def test_two_breaks_that_cancel_leave_a_centred_lens() -> None:
    plain = doublet()
    there = Surface(kind="coordinate_break", decentre_mm=(0.3, -0.2), tilt_deg=(4.0, 2.0, 30.0))
    back = Surface(kind="coordinate_break", decentre_mm=(-0.3, 0.2), tilt_deg=(-4.0, -2.0, -30.0), tilt_first=True)
    first, *rest = plain.surfaces
    broken = plain.model_copy(
        update={
            "surfaces": (
                first.model_copy(update={"thickness_mm": 0.0}),
                there,
                back.model_copy(update={"thickness_mm": first.thickness_mm}),
                *rest,
            )
        }
    )
    tangent = (0.1, 0.2)
    one = OpticalSystem(plain).trace(tangent, 550.0, 0.5, -0.4)[0]
    other = OpticalSystem(broken).trace(tangent, 550.0, 0.5, -0.4)[0]
    for place in (rt.X, rt.Y, rt.L, rt.M, rt.PATH, rt.DL_DX, rt.DM_DY):
        assert other[place] == pytest.approx(one[place], abs=1e-11)


def test_a_centred_lens_turned_to_the_grid_gives_the_same_images() -> None:
    """The general way of summing waves against the mirrored one."""
    plain = doublet()
    break_of_nothing = Surface(kind="coordinate_break", tilt_deg=(1e-12, 0.0, 0.0))
    broken = plain.model_copy(update={"surfaces": (plain.surfaces[0], break_of_nothing, *plain.surfaces[1:])})
    shifted = plain.surfaces[0].model_copy(update={"thickness_mm": 0.0})
    moved = break_of_nothing.model_copy(update={"thickness_mm": plain.surfaces[0].thickness_mm})
    broken = plain.model_copy(update={"surfaces": (shifted, moved, *plain.surfaces[1:])})
    settings = SMALL.model_copy(update={"line": True, "fields": 2, "wavelength_nm": (550.0,)})
    a, b = lens_table(plain, settings), lens_table(broken, settings)
    assert not b.symmetric and b.grid_shape == (2,)
    assert b.psf == pytest.approx(a.psf, abs=1e-5 * a.psf.max())
    assert b.relative_illumination == pytest.approx(a.relative_illumination, rel=1e-6)


@pytest.mark.parametrize(
    ("prescription", "said"),
    [
        (lens(Surface(curvature_per_mm=-0.1, thickness_mm=5.0, glass=GLASS), Surface(thickness_mm=5.0)), "limit of 0"),
        (lens(Surface(thickness_mm=5.0, glass=GLASS), Surface(thickness_mm=5.0)), "no power"),
        (lens(Surface(curvature_per_mm=0.1, thickness_mm=5.0, glass=GlassName(name="NOGLASS"))), "NOGLASS"),
    ],
)
def test_a_lens_that_makes_no_image_is_refused(prescription: Prescription, said: str) -> None:
    with pytest.raises(PrescriptionError, match=said):
        OpticalSystem(prescription)


def test_a_damaged_cache_is_computed_again(tmp_path: Path) -> None:
    settings = TableSettings(wavelength_nm=(550.0,), fields=2, samples=8)
    table = read_or_trace_table(doublet(), tmp_path, settings)
    file = tmp_path / f"{table.content_hash}.npz"
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    again = read_or_trace_table(doublet(), tmp_path, settings)
    assert np.array_equal(again.psf, table.psf) and file.read_bytes()[: len(data) // 2] == data[: len(data) // 2]
    other = read_or_trace_table(doublet(), tmp_path, settings.model_copy(update={"samples": 10}))
    assert other.content_hash != table.content_hash and other != table


# --- known lenses
# ------------------------------------------------------------------------------------------------------


@needs_lenses
@pytest.mark.parametrize(
    ("name", "focal_length_mm", "f_number", "digits_mm"),
    [
        ("7558005a.zmx", 4.55, 2.96, 0.005),
        ("6744570a.zmx", 7.27, 4.0, 0.005),
        ("10281683.zmx", 4.69, 1.7, 0.005),
        ("Smith1998a.zmx", 52.09, 3.5, 0.01),
        ("Smith1998b.zmx", 52.09, 3.5, 0.01),
        ("EO54852_glassfixed.zmx", 6.00001, None, 5e-6),
        ("US00583336-2-scaled.zmx", 49.4, 4.5, 0.05),
    ],
)
def test_known_focal_lengths(name: str, focal_length_mm: float, f_number: float | None, digits_mm: float) -> None:
    first = OpticalSystem(read_zmx(SHARED / name)).first_order
    assert first.focal_length_mm == pytest.approx(focal_length_mm, abs=digits_mm)
    if f_number is not None:
        assert first.f_number == pytest.approx(f_number, abs=0.01)


@needs_lenses
def test_known_pupils_of_a_board_lens() -> None:
    first = OpticalSystem(read_zmx(SHARED / "EO54852_glassfixed.zmx")).first_order
    assert first.entrance_pupil_position_mm == pytest.approx(4.0580, abs=6e-5)
    assert first.entrance_pupil_mm == pytest.approx(3.381, abs=6e-4)
    assert first.stop_semi_diameter_mm == pytest.approx(1.572530, rel=1e-4)  # the file's own
    assert first.working_f_number == pytest.approx(1.8, rel=1e-9)


@needs_lenses
def test_known_illumination_and_distortion() -> None:
    system = OpticalSystem(read_zmx(SHARED / "7558005a.zmx"))
    settings = TableSettings(wavelength_nm=(550.0,), fields=5, samples=8, maximum_field_deg=30.0)
    table = OpticalTable(system, settings).table()
    # Given to three digits; the glasses are nd and Vd only, so that another law of dispersion moves the third.
    assert table.relative_illumination[0] == pytest.approx([1.0, 0.946, 0.829, 0.714, 0.574], abs=1.2e-3)
    mobile = OpticalSystem(read_zmx(SHARED / "6744570a.zmx"))
    tangent = math.tan(math.radians(28.0))
    chief = mobile.chief((0.0, tangent), D_NM)
    assert chief is not None
    assert chief[rt.Y] / (mobile.first_order.focal_length_mm * tangent) - 1 == pytest.approx(-0.061, abs=5e-4)


@needs_lenses
def test_known_mtf_on_axis() -> None:
    system = OpticalSystem(read_zmx(SHARED / "7558005a.zmx"))
    sagittal, tangential = system.mtf((0.0, 0.0), 550.0, [30.0, 60.0, 100.0])
    assert sagittal == pytest.approx([0.9372, 0.8752, 0.7925], abs=5e-3)
    assert tangential == pytest.approx(sagittal, abs=1e-4)


@needs_lenses
def test_unknown_glasses_of_known_files_are_errors() -> None:
    for name, glass in (("EO54852_excerpt.zmx", "LAK10C"), ("US08427765-1.ZMX", "L-TIM28_MOLD")):
        with pytest.raises(PrescriptionError, match=glass):
            OpticalSystem(read_zmx(SHARED / name))


@needs_lenses
def test_a_stop_of_the_file_is_met() -> None:
    system = OpticalSystem(read_zmx(SHARED / "US00583336-2-scaled.zmx"))
    assert system.first_order.stop_semi_diameter_mm == pytest.approx(4.215000499256, rel=1e-9)
    assert not any("states" in line for line in system.warnings)
