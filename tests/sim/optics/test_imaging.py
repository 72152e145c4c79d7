"""Imaging models of a lens: transfer functions with the right symmetry, and against closed forms."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from scipy.special import j1

from sim.optics.diffraction import diffraction_otf
from sim.optics.imaging import DiffractionLimited, Imaging, MeasuredOtf, MeasuredPsf, TracedLens, ZernikePupil
from sim.optics.pupil import pupil_otf, seidel
from sim.optics.table import LensTable
from sim.spectrum import FloatArray

ANY = TypeAdapter[Imaging](Imaging)
N, PITCH = 4.0, 0.5
LINE = np.linspace(0.0, 0.5, 60)
GRID = np.linspace(-0.5, 0.5, 41)


def airy(wavelength_um: float, n: int = 129, shift_um: tuple[float, float] = (0.0, 0.0)) -> FloatArray:
    """Light a sample of a perfect lens's image of a point, of all the light (not of the window's)."""
    place = (np.arange(n) - 0.5 * (n - 1)) * PITCH
    v = np.pi / (wavelength_um * N) * np.hypot(place[None, :] - shift_um[0], place[:, None] - shift_um[1])
    peak = np.pi / 4 * (PITCH / (wavelength_um * N)) ** 2
    return peak * np.where(v > 0, 2 * j1(v) / np.where(v > 0, v, 1.0), 1.0) ** 2


def nested(cube: FloatArray) -> tuple[tuple[tuple[float, ...], ...], ...]:
    return tuple(tuple(tuple(row) for row in plane) for plane in cube.tolist())


def measured(*planes: FloatArray, wavelength_nm: tuple[float, ...] = (550.0,)) -> MeasuredPsf:
    return MeasuredPsf(
        wavelength_nm=wavelength_nm, psf=nested(np.stack([p / p.sum() for p in planes])), sample_pitch_um=PITCH
    )


def table(n: int = 64) -> LensTable:
    """A perfect lens of two colours and two fields, its point spread windowed and normalised by all of the light."""
    wavelength = np.array([450.0, 650.0])
    psf = np.stack([np.stack([airy(w * 1e-3, n)] * 2) for w in wavelength])
    return LensTable(
        wavelength_nm=wavelength, field_deg=np.array([[0.0, 0.0], [0.0, 20.0]]), grid_shape=(2,), symmetric=True,
        reference_wavelength_nm=550.0, focal_length_mm=4.0, f_number=N, entrance_pupil_mm=1.0,
        chief_mm=np.array([[0.0, 0.0], [0.0, 1.4]]), relative_illumination=np.ones((2, 2)), psf=psf,
        window_um=np.zeros((2, 2)), sample_pitch_um=PITCH, encircled_share=psf.sum(axis=(2, 3)),
        centroid_um=np.zeros((2, 2, 2)), warnings=(), content_hash="0123",
    )  # fmt: skip


PUPIL = ZernikePupil(coefficients=(0, 0, 0, 0.05, 0.02, -0.03, 0.04, 0, 0, 0, 0.03), index="noll", unit="um")
OTF = MeasuredOtf(
    wavelength_nm=(500.0,),
    frequency_x_cy_per_um=(0.0, 0.2, 0.4),
    frequency_y_cy_per_um=(-0.4, -0.2, 0.0, 0.2, 0.4),
    modulus=(((0.1, 0.1, 0.0), (0.5, 0.3, 0.0), (1.0, 0.6, 0.2), (0.5, 0.4, 0.1), (0.1, 0.1, 0.0)),),
    phase_rad=(((0.2, 0.1, 0.0), (0.1, 0.0, -0.1), (0.0, -0.1, -0.2), (-0.1, 0.2, 0.3), (-0.2, 0.0, 0.0)),),
)
MODELS = [DiffractionLimited(), PUPIL, measured(airy(0.55)), OTF, TracedLens(table=table())]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.kind)
def test_every_model_is_a_transfer_function(model: Imaging) -> None:
    """1 at zero frequency, the conjugate at -f (an image is real), no gain, nothing beyond the cutoff; of the broadcast
    shape.
    """
    fx, fy = GRID[None, :], GRID[:, None]
    value = np.asarray(model.transfer(fx, fy, 520.0, N))
    assert value.shape == (41, 41)
    assert value[20, 20] == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(value, np.conj(value[::-1, ::-1]), atol=1e-9)
    assert np.max(np.abs(value)) <= 1.0 + 1e-9
    # the same at points that are no grid
    scattered = model.transfer(np.full(3, 0.1), np.array([0.0, -0.15, 0.35]), 520.0, N)
    np.testing.assert_allclose(scattered, value[[20, 14, 34], 24], atol=1e-6)
    cutoff = model.cutoff_cy_per_um(520.0, N)
    np.testing.assert_allclose(model.transfer(np.array([1.01 * cutoff]), np.zeros(1), 520.0, N), 0.0, atol=1e-3)
    assert model.shift_variant == isinstance(model, TracedLens)


@pytest.mark.parametrize("model", MODELS[:4], ids=lambda m: m.kind)
def test_models_go_to_json_and_toml_and_back(model: Imaging) -> None:
    assert ANY.validate_json(ANY.dump_json(model)) == model
    values = ANY.dump_python(model, mode="json", exclude_none=True)
    text = "\n".join(
        f"{key} = {value!r}".replace("(", "[").replace(")", "]").replace("'", '"') for key, value in values.items()
    )
    assert ANY.validate_python(tomllib.loads(text)) == model


def test_diffraction_limited_is_the_closed_form_bit_for_bit() -> None:
    fx, fy = GRID[None, :], GRID[:, None]
    np.testing.assert_array_equal(
        DiffractionLimited().transfer(fx, fy, 550.0, N), diffraction_otf(np.hypot(fx, fy), 550.0, N)
    )


# --- the Zernike pupil -----------------------------------------------------------------------------------------------


def test_zernike_pupil_without_aberration_is_diffraction() -> None:
    flat = ZernikePupil(coefficients=(0.3,), index="osa", unit="um")
    np.testing.assert_allclose(flat.transfer(LINE, 0 * LINE, 550.0, N), diffraction_otf(LINE, 550.0, N), atol=1e-12)


def test_zernike_coefficients_are_seidels_by_another_name() -> None:
    """Z11 = sqrt(5) (6 r^4 - 6 r^2 + 1), Z4 = sqrt(3) (2 r^2 - 1): c11 and c4 that leave W040 r^4 alone; 1 um = 2 waves
    at 500 nm.
    """
    c11 = 0.3 / (6 * np.sqrt(5))
    c4 = 6 * np.sqrt(5) * c11 / (2 * np.sqrt(3))
    noll = ZernikePupil(coefficients=(0, 0, 0, c4, 0, 0, 0, 0, 0, 0, c11), index="noll", unit="um")
    osa = ZernikePupil(
        coefficients=(0, 0, 0, 0, 2 * c4, 0, 0, 0, 0, 0, 0, 0, 2 * c11),
        index="osa",
        unit="waves",
        reference_wavelength_nm=500.0,
    )
    for wavelength_nm in (450.0, 650.0):
        wanted = pupil_otf(LINE, 0.2 * LINE, wavelength_nm, N, seidel(spherical_um=0.3))
        for model in (noll, osa):
            np.testing.assert_allclose(model.transfer(LINE, 0.2 * LINE, wavelength_nm, N), wanted, atol=1e-9)


def test_colours_have_their_focus_and_place() -> None:
    """Axial: dz = 16 um at 450 nm is W020 = 16 / (8 N^2); lateral: the image of 650 nm lies 1.5 um to the right;
    between: half.
    """
    model = ZernikePupil(
        coefficients=(),
        index="noll",
        unit="um",
        colour_wavelength_nm=(450.0, 550.0, 650.0),
        focus_shift_um=(16.0, 0.0, 0.0),
        image_shift_um=((0.0, 0.0), (0.0, 0.0), (1.5, 0.0)),
    )
    f, none = LINE, 0 * LINE
    np.testing.assert_allclose(
        model.transfer(f, none, 450.0, N), pupil_otf(f, none, 450.0, N, seidel(defocus_um=0.125)), atol=1e-9
    )
    np.testing.assert_allclose(
        model.transfer(f, none, 650.0, N), diffraction_otf(f, 650.0, N) * np.exp(-3j * np.pi * f), atol=1e-9
    )
    half = model.transfer(f, f, 600.0, N)
    np.testing.assert_allclose(half, diffraction_otf(f * np.sqrt(2), 600.0, N) * np.exp(-1.5j * np.pi * f), atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unit": "waves"}, "reference wavelength"),
        ({"reference_wavelength_nm": 550.0}, "waves need one, um none"),
        ({"focus_shift_um": (1.0, 2.0)}, "2 entries for 0"),
        ({"colour_wavelength_nm": (600.0, 500.0), "focus_shift_um": (1.0, 2.0)}, "ascend"),
        ({"coefficients": (0.0, float("nan"))}, "finite"),
    ],
)
def test_bad_pupils_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        ZernikePupil.model_validate({"coefficients": (0.0, 0.1), "index": "noll", "unit": "um"} | changes)


# --- measured --------------------------------------------------------------------------------------------------------


def test_a_perfect_lens_by_its_samples_is_the_perfect_lens() -> None:
    """Beyond a window of half-width R lies the share 2 lambda N / (pi^2 R) of the light; its transfer was at the lowest
    frequencies.
    """
    n = 257
    otf = measured(airy(0.55, n)).transfer(LINE, 0 * LINE, 550.0, N)
    beyond = 2 * 0.55 * N / (np.pi**2 * 0.5 * n * PITCH)
    np.testing.assert_allclose(otf, diffraction_otf(LINE, 550.0, N), atol=1.1 * beyond)
    assert beyond < 0.01


def test_rows_run_down_and_columns_to_the_right() -> None:
    """Light 1.5 um to the right and 0.5 um down: phase -2 pi (1.5 fx + 0.5 fy)."""
    samples = np.zeros((5, 9))
    samples[3, 7] = 1.0
    model = measured(samples)
    fx, fy = np.array([0.1, 0.0, 0.2]), np.array([0.0, 0.3, -0.1])
    np.testing.assert_allclose(
        model.transfer(fx, fy, 500.0, N), np.exp(-2j * np.pi * (1.5 * fx + 0.5 * fy)), atol=1e-12
    )


def test_wavelengths_between_are_linear_and_beyond_are_held() -> None:
    model = measured(airy(0.45), airy(0.65), wavelength_nm=(450.0, 650.0))
    low, high, third, beyond = (model.transfer(LINE, 0 * LINE, w, N) for w in (450.0, 650.0, 500.0, 800.0))
    np.testing.assert_allclose(third, 0.75 * low + 0.25 * high, atol=1e-12)
    np.testing.assert_array_equal(beyond, high)


def test_sums_within_a_thousandth_of_1_are_accepted() -> None:
    values = {
        "wavelength_nm": (550.0,),
        "psf": (((0.0, 0.3), (0.3, 0.4005)),),
        "sample_pitch_um": 1.0,
    }
    near = MeasuredPsf.model_validate(values)
    assert near.transfer(np.zeros(1), np.zeros(1), 550.0, N)[0] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"psf": (((0.5, 0.2), (0.1, 0.1)),)}, r"adds up to 0\.9 at 550 nm.*divide it by its sum"),
        ({"psf": (((0.6, 0.6), (-0.1, -0.1)),)}, "below the limit of 0"),
        ({"psf": (((0.6, float("nan")), (0.2, 0.2)),)}, "finite"),
        ({"psf": (((0.5, 0.5), (0.0,)),)}, "one length"),
        ({"wavelength_nm": (450.0, 550.0)}, "give 2, one a wavelength"),
        ({"wavelength_nm": ()}, "no wavelength"),
        ({"wavelength_nm": (-5.0,)}, "above 0"),
        ({"sample_pitch_um": 0.0}, "below the lower limit"),
    ],
)
def test_bad_point_spreads_are_refused(changes: dict[str, object], message: str) -> None:
    good = {"wavelength_nm": (550.0,), "psf": (((0.4, 0.2), (0.2, 0.2)),), "sample_pitch_um": 1.0}
    MeasuredPsf.model_validate(good)
    with pytest.raises(ValidationError, match=message):
        MeasuredPsf.model_validate(good | changes)


def test_a_given_transfer_is_looked_up() -> None:
    """At samples their values; between, the mean; on the other half-plane the conjugate; beyond, nothing."""
    value = np.asarray(
        OTF.transfer(np.array([0.2, -0.2, 0.2, 0.5]), np.array([0.2, -0.2, 0.1, 0.0]), 600.0, N), complex
    )
    node = 0.4 * np.exp(0.2j)
    assert value[0] == pytest.approx(node)
    assert value[1] == pytest.approx(np.conj(node))
    assert value[2] == pytest.approx(0.5 * (node + 0.6 * np.exp(-0.1j)))
    assert value[3] == 0.0


def test_a_contrast_curve_is_alike_in_all_directions() -> None:
    model = MeasuredOtf(wavelength_nm=(550.0,), frequency_x_cy_per_um=(0.0, 0.2, 0.4), modulus=(((1.0, 0.5, 0.0),),))
    np.testing.assert_allclose(model.transfer(np.array([0.0, 0.06, -0.1]), np.array([0.1, 0.08, 0.0]), 550.0, N), 0.75)
    quadrant = MeasuredOtf(
        wavelength_nm=(550.0,),
        frequency_x_cy_per_um=(0.0, 0.4),
        frequency_y_cy_per_um=(0.0, 0.2),
        modulus=(((1.0, 0.5), (0.6, 0.1)),),
    )
    np.testing.assert_allclose(quadrant.transfer(np.array([0.4, -0.4, 0.4]), np.array([0.2, 0.2, -0.2]), 550.0, N), 0.1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"modulus": (((0.9, 0.5),),)}, r"0\.9 at zero frequency.*divide"),
        ({"modulus": (((1.0, 1.5),),)}, "beyond the limits of 0 and 1"),
        ({"modulus": (((1.0, 0.5, 0.2),),)}, "fits the frequencies"),
        ({"frequency_x_cy_per_um": (0.1, 0.4)}, "from 0 along x"),
        ({"frequency_x_cy_per_um": (0.0, 0.0)}, "ascend"),
        ({"frequency_y_cy_per_um": (-0.1, 0.1)}, "through 0"),
        ({"phase_rad": (((0.0, 0.5),),)}, "one quadrant"),
    ],
)
def test_bad_transfers_are_refused(changes: dict[str, object], message: str) -> None:
    good = {"wavelength_nm": (550.0,), "frequency_x_cy_per_um": (0.0, 0.4), "modulus": (((1.0, 0.5),),)}
    MeasuredOtf.model_validate(good)
    with pytest.raises(ValidationError, match=message):
        MeasuredOtf.model_validate(good | changes)


# --- traced ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wavelength_nm", [450.0, 550.0, 650.0])
def test_a_windowed_table_gives_the_whole_lens(wavelength_nm: float) -> None:
    """What the window cuts off is put back: a perfect lens's table of 32 um gives its closed form. Left are the rings,
    1.2e-3 next to the cutoff. (Contrast renormalised to the window would be 3 % too high.)"""
    lens = TracedLens(table=table())
    assert 0.02 < 1 - lens.table.encircled_share[1, 0] < 0.04
    for fx, fy in ((LINE, 0 * LINE), (0.6 * LINE, 0.8 * LINE)):
        wanted = [np.asarray(diffraction_otf(LINE, w, N)) for w in (450.0, 650.0)]
        share = (wavelength_nm - 450.0) / 200.0
        value = lens.transfer(fx, fy, wavelength_nm, N)
        np.testing.assert_allclose(value, (1 - share) * wanted[0] + share * wanted[1], atol=1.5e-3)


def test_a_traced_lens_is_dumped_by_its_hash_and_asks_for_its_table() -> None:
    lens = TracedLens(table=table())
    dumped = ANY.dump_python(lens, mode="json")
    assert dumped == {"kind": "traced_lens", "content_hash": "0123"}
    with pytest.raises(ValidationError, match=r"0123.*trace its prescription or load the table"):
        ANY.validate_python(dumped)
    assert lens == TracedLens(table=table())
