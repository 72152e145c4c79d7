"""The reader of .zmx files: what it reads, what it refuses by name, and that damage is one line."""

import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.predict.lens import parse_glasses, with_glasses
from sim.optics.prescription import PrescriptionError
from sim.optics.system import OpticalSystem
from sim.optics.traced_table import OpticalTable, TableSettings
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


# --- files of makers and of other programs ----------------------------------------------------------------------------


def maker(head: str = "", surface: str = "", glass: str = "N-BK7 0 0 0 0 0 0 0 0 0 0") -> str:
    """A catalogue lens as its maker writes it: one field on the axis, 24 wavelengths of which few count."""
    header = {
        "UNIT": "UNIT MM X W X CM MR CPMM",
        "ENPD": "ENPD 1.0E+1",
        "GCAT": "GCAT SCHOTT MISC",
        "FTYP": "FTYP 0 0 1 3 0 0 0",
        "XFLN": "XFLN" + " 0" * 12,
        "YFLN": "YFLN" + " 0" * 12,
        "WAVM": "WAVM 1 4.861E-1 1\nWAVM 2 5.876E-1 1\nWAVM 3 6.563E-1 1\nWAVM 4 5.5E-1 1\nWAVM 5 5.5E-1 1",
        "PWAV": "PWAV 2",
    }
    for line in head.splitlines():
        header[line.split()[0].removeprefix("-")] = "" if line.startswith("-") else line
    return "\n".join(
        [
            "VERS 120928 17 30221",
            "MODE SEQ",
            "NAME AL1815 \xd818 mm",
            *header.values(),
            'SURF 0\n  TYPE STANDARD\n  CURV 0.0 0 0 0 0 ""\n  DISZ INFINITY\n  DIAM 0 0 0 0 1 ""',
            f'SURF 1\n  COMM x\n  STOP\n  TYPE STANDARD\n  CURV 2.0E-002 0 0 0 0 ""\n{surface}  DISZ 4\n  GLAS {glass}',
            '  DIAM 9.0 1 0 0 1 ""\n  FLAP 0 9.0 0',
            'SURF 2\n  TYPE STANDARD\n  CURV -0.02 0 0 0 0 ""\n  DISZ 47.7\n  DIAM 9 0 0 0 1 ""',
            'SURF 3\n  TYPE STANDARD\n  CURV 0.0 0 0 0 0 ""\n  DISZ 0\n  DIAM 1 0 0 0 1 ""',
            'BLNK\nTOL TOFF   0   0\nMNUM 1 1\nMOFF   0   1 "" 0 0 0 1 1 0 0.0 ""',
        ]
    )


def focal_mm(text: str) -> float:
    return OpticalSystem(parse_zmx(text)).first_order.focal_length_mm


# 1 / f = (n - 1) (2 / R - (n - 1) t / (n R^2)) of a biconvex lens: n = 1.51680, R = 50 mm, t = 4 mm
FOCAL_MM = 1.0 / (0.5168 * (2.0 / 50.0 - 0.5168 * 4.0 / (1.5168 * 2500.0)))


def test_a_field_that_is_the_axis_alone_asks_for_its_corner() -> None:
    system = OpticalSystem(parse_zmx(maker()))
    assert system.first_order.focal_length_mm == pytest.approx(FOCAL_MM, rel=1e-4)
    with pytest.raises(
        PrescriptionError, match="only field is the axis; give the corner of the field in degrees, by --field-deg"
    ):
        OpticalTable(system, TableSettings(line=True))
    work = OpticalTable(system, TableSettings(line=True, maximum_field_deg=7.0))
    assert work.tangents[-1][1] == pytest.approx(math.tan(math.radians(7.0))) and work.warnings == []
    stated = parse_zmx(maker("FTYP 0 0 2 3 0 0 0\nYFLN 0 7"))
    assert OpticalTable(OpticalSystem(stated), TableSettings(line=True)).tangents == work.tangents


def test_what_a_header_leaves_out_is_reported() -> None:
    lens = parse_zmx(maker("-UNIT\n-PWAV\nFTYP 0 0 1 2 0 0 0"))
    assert lens.warnings == (
        "header: UNIT isn't stated: lengths are taken as mm (UNIT MM)",
        "header: PWAV isn't stated: 486.1 nm is taken as the primary",
    )
    assert lens.wavelength_nm == pytest.approx((486.1, 587.6))
    lens = parse_zmx(maker("-WAVM\n-PWAV"))
    assert lens.warnings == ("header: no wavelength is stated (WAVM): first-order quantities are those at 550 nm",)
    assert parse_zmx(maker()).warnings == ()


@pytest.mark.parametrize(
    "lines", ["WAVN 0.45 0.55 0.65", "WAVL 0.45 0.55 0.65 0.55", "WAVN 0.45 0.55 0.65\nWAVL 0.4 0.5 0.6"]
)
def test_old_lines_of_wavelengths_and_fields_are_read(lines: str) -> None:
    lens = parse_zmx(maker(f"-WAVM\n{lines}\n-XFLN\n-YFLN\nXFLD 0 0\nYFLD 0 12.5\nFTYP 0 0 2 3 0 0 0"))
    assert lens.wavelength_nm == pytest.approx((450.0, 550.0, 650.0))
    assert lens.primary_wavelength_nm == pytest.approx(550.0)
    assert lens.field_points == ((0.0, 0.0), (0.0, 12.5)) and lens.warnings == ()


def test_surfaces_without_blanks_before_their_lines_are_surfaces() -> None:
    flat = "\n".join(line.strip() for line in maker().splitlines())
    assert parse_zmx(flat) == parse_zmx(maker())


@pytest.mark.parametrize(
    ("before", "after", "reason"),
    [
        ("CURV 2.0E-002", "CURV 0,02", "surface 1: CURV curvature '0,02' is not a number; write 0.02"),
        ("DIAM 9.0 1", "DIAM 9,0 1", "'9,0' is not a number; write 9.0"),
        ("WAVM 2 5.876E-1", "WAVM 2 0,5876", "'0,5876' is not a number; write 0.5876"),
    ],
)
def test_decimal_commas_are_refused_with_the_number_to_write(before: str, after: str, reason: str) -> None:
    with pytest.raises(PrescriptionError, match=reason):
        parse_zmx(maker().replace(before, after, 1))


def test_a_tilt_of_a_surface_itself_is_refused() -> None:
    assert parse_zmx(maker(surface="  SCBD 0 0 0 0 0 0 0 0\n")).warnings == ()
    with pytest.raises(PrescriptionError, match=r"surface 1: SCBD .* isn't traced; write it as coordinate breaks"):
        parse_zmx(maker(surface="  SCBD 1 0 0 0.0 0.0 9.0E+01 0 0\n"))


@pytest.mark.parametrize("unit", ["MM", "IN"])
def test_an_extended_asphere_is_an_even_one(unit: str) -> None:
    """Terms of (r / norm radius)^2, ^4, ^6; and none is a sphere."""
    data = "".join(
        f'  XDAT {at} {value} 0 0 1 0 0 ""\n' for at, value in enumerate((3, 5.0, 0.0, -2e-2, 4e-3), start=1)
    )
    even = "".join(f"  PARM {at} {value!r}\n" for at, value in enumerate((0.0, -2e-2 / 5.0**4, 4e-3 / 5.0**6), start=1))
    head = f"UNIT {unit} X W X CM MR CPMM"
    extended = parse_zmx(
        maker(head, data).replace("TYPE STANDARD", "TYPE XASPHERE", 2).replace("TYPE XASPHERE", "TYPE STANDARD", 1)
    )
    written = parse_zmx(
        maker(head, even).replace("TYPE STANDARD", "TYPE EVENASPH", 2).replace("TYPE EVENASPH", "TYPE STANDARD", 1)
    )
    assert extended.surfaces[0].coefficients_mm == pytest.approx(written.surfaces[0].coefficients_mm)
    assert extended.surfaces[0].kind == "even_asphere" and extended.warnings == ()
    plain = maker().replace("STOP\n  TYPE STANDARD", "STOP\n  TYPE XASPHERE")
    assert focal_mm(plain) == pytest.approx(FOCAL_MM, rel=1e-4)
    with pytest.raises(PrescriptionError, match="surface 1: XDAT 2, the norm radius, is 0"):
        parse_zmx(maker(surface="  XDAT 1 2\n").replace("STOP\n  TYPE STANDARD", "STOP\n  TYPE XASPHERE"))


@pytest.mark.parametrize(
    ("glass", "index_d"),
    [("BK7 0 0 1.5 40 0 0 0", 1.5168), ("B270 0 0 0 0 0 0 0", 1.523), ("F_SILICA 0 0 1.5 40 0 0 0", 1.45846)],
)
def test_makers_glasses_are_traced(glass: str, index_d: float) -> None:
    n = index_d - 1.0
    assert focal_mm(maker(glass=glass)) == pytest.approx(
        1.0 / (n * (2.0 / 50.0 - n * 4.0 / (index_d * 2500.0))),
        rel=2e-4,  # glasses by line, to four places
    )


def test_the_nd_and_vd_that_a_file_states_are_the_remedy() -> None:
    lens = parse_zmx(maker(glass="EO-123 0 0 1.6725 32.21 0 0 0"))
    with pytest.raises(PrescriptionError, match=r"the glass EO-123 is in none .*give --glass EO-123=1.6725,32.21 "):
        OpticalSystem(lens)
    taken = with_glasses(lens, parse_glasses(["EO-123=1.6725,32.21"]))
    n = 0.6725
    assert OpticalSystem(taken).first_order.focal_length_mm == pytest.approx(
        1.0 / (n * (2.0 / 50.0 - n * 4.0 / (1.6725 * 2500.0))), rel=1e-4
    )
