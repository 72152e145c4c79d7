"""The reader of .zmx files: what it reads, what it refuses by name, and that damage is one line."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.optics.prescription import PrescriptionError
from sim.optics.zmx import decode, parse_zmx, read_zmx

LENSES = Path(__file__).parent / "lenses"
TEXT = (LENSES / "doublet.zmx").read_text()


def test_reads_every_surface_in_mm() -> None:
    lens = read_zmx(LENSES / "doublet.zmx")
    assert lens.name == "two aspheric elements"
    assert len(lens.surfaces) == 6 and lens.stop == 0 and lens.object_distance_mm is None
    first = lens.surfaces[1]
    assert first.kind == "even_asphere" and first.curvature_per_mm == 0.16 and first.conic == -0.6
    assert first.coefficients_mm == (0.0, -1.2e-3, 2.0e-5)
    assert first.glass is not None and first.glass.model and (first.glass.index_d, first.glass.abbe_d) == (1.5312, 56.0)
    assert lens.aperture_kind == "entrance_pupil_mm" and lens.aperture_value == 1.2
    assert lens.field_points == ((0.0, 0.0), (0.0, 18.0))
    assert lens.primary_wavelength_nm == pytest.approx(587.5618)
    assert lens.catalogues == ("SCHOTT",) and lens.is_centred and lens.warnings == ()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1"])
def test_reads_the_encodings_that_zemax_writes(encoding: str) -> None:
    assert parse_zmx(decode(TEXT.replace("\n", "\r\n").encode(encoding))) == parse_zmx(TEXT)


def test_latin_1_names_survive() -> None:
    assert decode("NAME Objektiv f\xfcr 5 \xb5m".encode("latin-1")) == "NAME Objektiv f\xfcr 5 \xb5m"


@pytest.mark.parametrize(("unit", "scale"), [("CM", 10.0), ("IN", 25.4), ("METER", 1000.0)])
def test_lengths_are_scaled_to_mm(unit: str, scale: float) -> None:
    lens, base = parse_zmx(TEXT.replace("UNIT MM", f"UNIT {unit}")), parse_zmx(TEXT)
    for surface, plain in zip(lens.surfaces, base.surfaces, strict=True):
        assert surface.thickness_mm == pytest.approx(plain.thickness_mm * scale)
        assert surface.curvature_per_mm == pytest.approx(plain.curvature_per_mm / scale)
        for k, (value, own) in enumerate(zip(surface.coefficients_mm, plain.coefficients_mm, strict=True), start=1):
            # sag = sum a_k r^(2 k): a_k has the unit length^(1 - 2 k)
            assert value == pytest.approx(own * scale ** (1 - 2 * k))
    assert lens.aperture_value == pytest.approx(1.2 * scale)
    assert lens.field_points == base.field_points  # angles have no length


def test_coordinate_breaks_keep_their_order() -> None:
    lens = read_zmx(LENSES / "tilted.zmx")
    first, second = lens.surfaces[1], lens.surfaces[4]
    assert not lens.is_centred
    assert first.decentre_mm == (0.15, -0.1) and first.tilt_deg == (3.0, -2.0, 10.0) and not first.tilt_first
    assert second.tilt_deg == (1.2, 0.0, 0.0) and second.tilt_first and second.thickness_mm == 18.4


def test_apertures() -> None:
    text = TEXT.replace("  DIAM 2.6 0\n", "  DIAM 2.6 1\n  FLAP 0 2.6 0\n").replace(
        "  DIAM 3.4 0\n", "  SQAP 2.0 1.5\n  OBDC 0.1 -0.2\n"
    )
    lens = parse_zmx(text)
    circle, rectangle = lens.surfaces[1].aperture, lens.surfaces[4].aperture
    assert circle is not None and circle.shape == "circle" and circle.half_width_mm == 2.6
    assert rectangle is not None and rectangle.shape == "rectangle" and rectangle.centre_mm == (0.1, -0.2)
    assert not lens.is_centred


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("TYPE EVENASPH", "TYPE TOROIDAL", "TOROIDAL"),
        ("  GLAS ___BLANK 1 0 1.6355 23.9 0", "  GLAS MIRROR 0 0", "mirror"),
        ("  DISZ 0.8", "  DISZ 0.8\n  OBSC 0 0.4", "obscuration"),
        ("  DISZ 0.8", "  DISZ 0.8\n  ELAP 1 2", "elliptical"),
        ("  DISZ 0.8", "  DISZ 0.8\n  CLAP 0.2 1.0 0", "inner radius"),
        ("  DISZ 6.7", "  DISZ INFINITY", "INFINITY"),
        ("  STOP\n", "", "STOP"),
        ("ENPD 1.2", "", "nothing"),
        ("ENPD 1.2", "ENPD -1", "above the limit of 0"),
        ("UNIT MM", "UNIT FURLONG", "FURLONG"),
        ("MODE SEQ", "MODE NSC", "NSC"),
        ("FTYP 0", "FTYP 7", "FTYP 7"),
        ("PWAV 2", "PWAV 9", "PWAV 9"),
        ("CURV 0.16", "CURV abc", "abc"),
        ("1.5312 56.0", "0.9 56.0", "nd 0.9"),
    ],
)
def test_what_is_not_traced_is_refused_by_name(old: str, new: str, said: str) -> None:
    assert old in TEXT
    with pytest.raises(PrescriptionError, match=said) as caught:
        parse_zmx(TEXT.replace(old, new, 1))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("ENVD 20 1 0", "ENVD 35 1 0", "35"),
        ("GCAT SCHOTT", "GCAT SCHOTT\nVCYN 0 0.3", "vignetting factors"),
        ("  DISZ 0.8", "  DISZ 0.8\n  COAT AR", "COAT AR"),
        ("  DISZ 0.8", "  DISZ 0.8\n  QXYZ 1 2", "QXYZ"),
        ("GCAT SCHOTT", "GCAT SCHOTT\nQXYZ 4", "QXYZ"),
    ],
)
def test_what_has_no_effect_is_a_warning_by_name(old: str, new: str, said: str) -> None:
    assert any(said in line for line in parse_zmx(TEXT.replace(old, new, 1)).warnings)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(PrescriptionError, match="can't be read"):
        read_zmx(tmp_path / "none.zmx")
    (tmp_path / "empty.zmx").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\0")
    with pytest.raises(PrescriptionError, match="surfaces found"):
        read_zmx(tmp_path / "empty.zmx")


def _read(text: str) -> None:
    try:
        lens = parse_zmx(text)
    except PrescriptionError as error:
        assert "\n" not in str(error)
    else:
        assert len(lens.surfaces) >= 2 and 0 <= lens.stop < len(lens.surfaces)


@settings(max_examples=60)
@given(st.integers(0, len(TEXT)), st.integers(0, 40), st.text(max_size=12))
def test_damage_anywhere_is_one_line_or_a_lens(start: int, length: int, put: str) -> None:
    _read(TEXT[:start] + put + TEXT[start + length :])


def test_a_curvature_that_is_no_number_a_lens_can_have_is_named() -> None:
    with pytest.raises(PrescriptionError, match=r"surface 0: curvature_per_mm inf: .*; correct it"):
        parse_zmx(TEXT.replace("CURV", "CURV 1E999", 2))


@settings(max_examples=60)
@given(st.binary(max_size=400))
def test_any_bytes_are_one_line(data: bytes) -> None:
    _read(decode(data))
