"""CGATS files as makers' programs write them: tables, names of samples, decimal commas, percent."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from lab import cli
from lab.errors import InputError
from lab.formats.cgats import parse_cgats

NM = range(400, 701, 100)


def table(
    rows: Sequence[tuple[str, str, str]],
    field: str = "nm{}",
    head: Sequence[str] = (),
    columns: Sequence[str] = ("SAMPLE_ID", "SAMPLE_NAME"),
    separator: str = "\t",
) -> str:
    """A table of flat spectra: number, name and value of each sample."""
    fields = [*columns, *(field.format(nm) for nm in NM)]
    cells = [dict(zip(("SAMPLE_ID", "SAMPLE_NAME"), row[:2], strict=True)) for row in rows]
    lines = ["CGATS.17", 'ORIGINATOR "maker"', *head, "BEGIN_DATA_FORMAT", separator.join(fields), "END_DATA_FORMAT"]
    lines += [f"NUMBER_OF_SETS {len(rows)}", "BEGIN_DATA"]
    lines += [
        separator.join([*(cell[key] for key in columns), *[row[2]] * len(NM)])
        for cell, row in zip(cells, rows, strict=True)
    ]
    return "\n".join([*lines, "END_DATA", ""])


def levels(text: str) -> dict[str, float]:
    """The one value of each flat spectrum."""
    found = parse_cgats(text).spectra
    assert all(len(set(one.value)) == 1 and one.wavelength_nm == tuple(NM) for one in found.values())
    return {name: round(one.value[0], 12) for name, one in found.items()}


GREYS = (("1", "A1", "0.2000"), ("2", "A2", "0.9000"))


@pytest.mark.parametrize(
    "field", ["nm{}", "NM_{}", "SPECTRAL_NM{}", "SPECTRAL_NM_{}", "SPECTRAL_DEC{}", "SPEC_{}", "{}_NM", "{}nm", "R_{}"]
)
def test_makers_fields_are_read_and_names_kept(field: str) -> None:
    assert levels(table(GREYS, field)) == {"A1": 0.2, "A2": 0.9}


def test_percent_is_what_the_fields_or_the_quantity_state() -> None:
    greys = (("1", "A1", "20.0"), ("2", "A2", "90.0"))
    found = parse_cgats(table(greys, "SPECTRAL_PCT{}"))
    assert [one.value[0] for one in found.spectra.values()] == pytest.approx([0.2, 0.9])
    assert "the fields SPECTRAL_PCT are percent: divided by 100" in found.remarks
    unknown = parse_cgats(table(greys, "SPECTRAL_NM{}"))
    assert [one.value[0] for one in unknown.spectra.values()] == [20.0, 90.0] and unknown.quantity is None
    assert any("if they are percent of a reflectance, add the lines MEAS_TYPE" in one for one in unknown.remarks)
    followed = table(greys, "SPECTRAL_NM{}", ('MEAS_TYPE "REFLECTIVE"', 'SPECTRAL_NORM "100"'))
    assert parse_cgats(followed).remarks == () and levels(followed) == {"A1": 0.2, "A2": 0.9}
    stated = parse_cgats(table(greys, "SPECTRAL_NM{}", ('MEAS_TYPE "REFLECTIVE"',)))
    assert [one.value[0] for one in stated.spectra.values()] == pytest.approx([0.2, 0.9])
    assert stated.remarks == ("SPECTRAL_NORM isn't stated: values up to 90 are taken as percent of reflectance",)
    # a fluorescent paper and a dark one are shares as they are; a radiance (mW there) of 20 is one
    assert levels(table((("1", "p", "1.31"), ("2", "q", "0.01")), head=('MEAS_TYPE "REFLECTIVE"',))) == {
        "p": 1.31,
        "q": 0.01,
    }
    assert levels(table(greys, head=('MEAS_TYPE "EMISSION"',))) == {"A1": 0.02, "A2": 0.09}
    contradicted = parse_cgats(table(greys, head=('MEAS_TYPE "REFLECTIVE"', 'SPECTRAL_NORM "1"')))
    assert contradicted.remarks == ("a reflectance of 90 is above the limit of 2; check SPECTRAL_NORM",)
    with pytest.raises(InputError, match="a reflectance of 5000 is neither a share nor percent; state SPECTRAL_NORM"):
        parse_cgats(table((("1", "p", "5000"),), head=('MEAS_TYPE "REFLECTIVE"',)))


def test_decimal_commas_are_read_unless_they_may_be_thousands() -> None:
    text = table((("1", "A1", "0,2000"), ("2", "B,5", "0,9000")))
    assert levels(text) == {"A1": 0.2, "B,5": 0.9}
    assert "read with decimal commas" in parse_cgats(text).remarks
    with pytest.raises(InputError, match="write all numbers with decimal points, or all with commas"):
        parse_cgats(table((("1", "A1", "0,2"), ("2", "A2", "0.9"))))
    with pytest.raises(InputError, match=r"20,000 may be 20\.000 or 20000"):
        parse_cgats(table((("1", "A1", "20,000"), ("2", "A2", "90,000"))))


def test_samples_keep_names_that_tell_them_apart() -> None:
    assert levels(table((("1", "A1", "0.2"), ("1", "A2", "0.9")))) == {"A1": 0.2, "A2": 0.9}
    repeated = parse_cgats(table((("1", "A1", "0.2"), ("1", "A2", "0.9")))).remarks
    assert "SAMPLE_ID repeats: spectra are named by SAMPLE_NAME" in repeated
    assert levels(table((("1", "white", "0.8"), ("2", "white", "0.9")))) == {"1 white": 0.8, "2 white": 0.9}
    assert levels(table(GREYS, columns=("SAMPLE_ID",))) == {"1": 0.2, "2": 0.9}
    assert levels(table(GREYS, columns=("SAMPLE_NAME",))) == {"A1": 0.2, "A2": 0.9}
    assert levels(table(GREYS, columns=())) == {"1": 0.2, "2": 0.9}
    with pytest.raises(InputError, match="SAMPLE_ID 1 white stands twice"):
        parse_cgats(table((("1", "white", "0.8"), ("1", "white", "0.9"))))


def test_every_table_of_a_file_is_read() -> None:
    other = (("1", "A1", "0.3000"), ("2", "A2", "0.9000"))
    text = table(GREYS) + "\n" + table(other)
    assert levels(text) == {"table 1 A1": 0.2, "table 1 A2": 0.9, "table 2 A1": 0.3, "table 2 A2": 0.9}
    assert "2 tables with the same samples: named table 1, table 2" in parse_cgats(text).remarks
    conditions = ('MEASUREMENT_SOURCE "MeasurementCondition=M0"',), ('FILTER "M1"',)
    text = "".join(table(rows, head=head) for rows, head in zip((GREYS, other), conditions, strict=True))
    assert levels(text) == {"M0 A1": 0.2, "M0 A2": 0.9, "M1 A1": 0.3, "M1 A2": 0.9}
    different = table(GREYS) + table((("1", "B1", "0.4"), ("2", "B2", "0.5"), ("3", "B3", "0.6")))
    assert levels(different) == {"A1": 0.2, "A2": 0.9, "B1": 0.4, "B2": 0.5, "B3": 0.6}
    # a table that states no fields has those of the one before
    bare = table(GREYS) + "BEGIN_DATA\n3 C1 0.1 0.1 0.1 0.1\nEND_DATA\n"
    assert levels(bare) == {"A1": 0.2, "A2": 0.9, "C1": 0.1}


def test_tables_of_other_things_are_reported_and_damaged_ones_refused() -> None:
    calibration = "CAL\nBEGIN_DATA_FORMAT\nRGB_I RGB_R\nEND_DATA_FORMAT\nBEGIN_DATA\n0 0\n1 1\nEND_DATA\n"
    found = parse_cgats(table(GREYS) + calibration)
    assert list(found.spectra) == ["A1", "A2"]
    assert "table 2 is left out: it has no spectral fields" in found.remarks
    with pytest.raises(InputError, match="it has no END_DATA"):
        parse_cgats(table(GREYS) + table(GREYS).replace("END_DATA\n", ""))
    with pytest.raises(InputError, match="NUMBER_OF_SETS is 2, and 1 rows are there"):
        parse_cgats(table(GREYS[:1]).replace("NUMBER_OF_SETS 1", "NUMBER_OF_SETS 2"))
    with pytest.raises(InputError, match="table 2: row 1, nm400 is 'x', not a number"):
        parse_cgats(table(GREYS) + table((("1", "B", "x"),)))
    with pytest.raises(InputError, match=r"several quantities \(radiance, reflectance\)"):
        parse_cgats(table(GREYS, head=('MEAS_TYPE "EMISSION"',)) + table(GREYS, head=('MEAS_TYPE "REFLECTIVE"',)))


def test_the_command_writes_a_file_a_sample_and_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "m.txt").write_text(table(GREYS) + table((("1", "A1", "0.3"), ("2", "A2", "0.9"))))
    assert cli.main(["import", str(tmp_path / "m.txt"), "--from", "spectra", "--out", str(tmp_path / "o")]) == 0
    assert sorted(file.name for file in (tmp_path / "o").iterdir()) == [
        f"table_{number}_{name}.csv" for number in (1, 2) for name in ("A1", "A2")
    ]
    assert "400.0,0.3" in (tmp_path / "o" / "table_2_A1.csv").read_text()
    assert "2 tables with the same samples" in capsys.readouterr().err


def test_no_sample_becomes_a_hidden_file(tmp_path: Path) -> None:
    (tmp_path / "m.txt").write_text(table((("1", "../../x", "0.2"), ("2", ".y", "0.9"))))
    assert cli.main(["import", str(tmp_path / "m.txt"), "--from", "spectra", "--out", str(tmp_path / "o" / "p")]) == 0
    files = list(tmp_path.rglob("*.csv"))
    assert sorted(file.name for file in files) == ["___.._x.csv", "_y.csv"]
    assert {file.parent for file in files} == {tmp_path / "o" / "p"}
