"""Text of other programs: encodings, semicolons and decimal commas, and column names that are nearly known."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.errors import InputError
from lab.formats.cgats import in_its_unit, nearest_name, plain_csv, read_foreign_csv, read_foreign_text, remarks_on
from lab.formats.spectrum_csv import parse_spectrum

COLUMNS = ("frame", "kind", "exposure_s", "temperature_c", "wavelength_nm", "screen.pose")


@pytest.mark.parametrize(
    ("encoding", "remarks"),
    [
        ("utf-8", ()),
        ("utf-8-sig", ()),
        ("utf-16", ("read as UTF-16",)),
        ("utf-16-le", ("read as UTF-16",)),
        ("utf-16-be", ("read as UTF-16",)),
        ("cp1252", ("read as Latin-1, since it isn't UTF-8; check names with accents",)),
    ],
)
def test_encodings_are_told(tmp_path: Path, encoding: str, remarks: tuple[str, ...]) -> None:
    text = "frame,kind\ndunkel-ö.tif,dark\n"
    (tmp_path / "a.csv").write_bytes(text.encode(encoding))
    found = read_foreign_text(tmp_path / "a.csv")
    assert (found.text, found.remarks) == (text, remarks)


@pytest.mark.parametrize("data", [b"\x89PNG\0\0\0\0", b"\xff\xfea", b"a\0\0b"])
def test_what_is_no_text_is_refused_in_one_line(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.csv").write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_foreign_text(tmp_path / "a.csv")
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="No such file"):
        read_foreign_text(tmp_path / "b.csv")


def test_semicolons_and_decimal_commas_become_plain(tmp_path: Path) -> None:
    text = 'wavelength_nm;value\n400;0,125\n"410";-1,5e-3\n\n420;2\n'
    (tmp_path / "s.csv").write_text(text)
    found = read_foreign_csv(tmp_path / "s.csv")
    assert parse_spectrum(found.text).value == (0.125, -1.5e-3, 2.0)
    assert found.text.count("\n") == text.count("\n")  # rows keep their numbers
    assert found.remarks == ("read with semicolons between cells and decimal commas",)
    for name in ("t.csv", "u.csv"):
        (tmp_path / name).write_text(text.replace(";", "\t").replace("0,125", "0.125").replace("1,5", "1.5"))
    assert remarks_on(tmp_path, ["s.csv", "t.csv", "u.csv", "missing.csv", "../s.csv"]) == [
        f"{tmp_path}/s.csv: read with semicolons between cells and decimal commas",
        f"{tmp_path}/t.csv and 1 more files: read with tabs between cells",
    ]


def test_commas_between_cells_stay_as_they_are() -> None:
    text = 'frame,squares\na.png,"7;10"\nb.png,7 10\n'
    assert plain_csv(text) == (text, ())


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ("0,5;0.25", "row 2 has 0,5 and row 2 has 0.25; write all numbers with decimal points, or all with commas"),
        ("1,250;20,500", "row 2: 1,250 may be 1.250 or 1250"),
    ],
)
def test_a_mark_that_may_be_either_is_refused(cells: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        plain_csv(f"a;b\n{cells}\n")
    assert words in str(caught.value)


@given(st.lists(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=2, max_size=2), min_size=1))
def test_numbers_are_the_same_in_either_form(rows: list[list[float]]) -> None:
    """`repr` gives shortest numbers; those with three digits after a comma may be thousands, so one that isn't stands
    first."""
    plain = "a,b\n0.5,0.5\n" + "".join(f"{a!r},{b!r}\n" for a, b in rows)
    text, _ = plain_csv(plain.replace(",", ";").replace(".", ","))
    assert text == plain


@given(st.text())
def test_any_text_is_a_table_or_refused_in_one_line(text: str) -> None:
    try:
        plain_csv(text)
    except InputError as error:
        assert len(str(error).splitlines()) == 1


@given(st.binary())
def test_any_bytes_are_text_or_refused_in_one_line(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    file = tmp_path_factory.getbasetemp() / "any.csv"
    file.write_bytes(data)
    try:
        read_foreign_csv(file)
    except InputError as error:
        assert len(str(error).splitlines()) == 1


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("exposure_ms", "exposure_s, in seconds"),
        ("ExposureTime", "exposure_s, in seconds"),
        ("exposure", "exposure_s, in seconds"),
        ("temp", "temperature_c, in degrees Celsius"),
        ("wavelength", "wavelength_nm, in nanometres"),
        ("Frame", "frame"),
        ("pose", None),
        ("operator", None),
    ],
)
def test_a_column_is_told_by_the_one_that_was_meant(name: str, known: str | None) -> None:
    found = nearest_name(name, COLUMNS)
    assert (None if found is None else in_its_unit(found)) == known
