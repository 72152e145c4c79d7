"""The lens table as a value: checked, written to nothing, kept on disk whole or not at all."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim.optics.table import LensTable, load_cached, store_cached


def made(**changes: object) -> LensTable:
    psf = np.full((2, 3, 4, 4), 1 / 16)
    table = LensTable(
        wavelength_nm=np.array([500.0, 600.0]),
        field_deg=np.array([[0.0, 0.0], [0.0, 5.0], [0.0, 10.0]]),
        grid_shape=(3,),
        symmetric=True,
        reference_wavelength_nm=550.0,
        focal_length_mm=5.0,
        f_number=2.8,
        entrance_pupil_mm=1.8,
        chief_mm=np.zeros((3, 2)),
        relative_illumination=np.ones((2, 3)),
        psf=psf,
        window_um=np.zeros((3, 2)),
        sample_pitch_um=0.5,
        encircled_share=psf.sum(axis=(2, 3)),
        centroid_um=np.zeros((2, 3, 2)),
        warnings=("one", "two"),
        content_hash="abc",
    )
    return replace(table, **changes)  # type: ignore[arg-type]


def test_arrays_cannot_be_written_to() -> None:
    table = made()
    with pytest.raises(ValueError, match="read-only"):
        table.psf[0, 0, 0, 0] = 2.0


def test_comes_back_from_disk_as_it_was(tmp_path: Path) -> None:
    table = made()
    table.save(tmp_path / "t.npz")
    back = LensTable.load(tmp_path / "t.npz")
    assert back == table and back.warnings == table.warnings and back.grid_shape == (3,) and back.symmetric is True
    assert np.array_equal(back.psf, table.psf) and back.focal_length_mm == 5.0
    assert [path.name for path in tmp_path.iterdir()] == ["t.npz"]


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[: len(data) // 2],
        lambda data: b"",
        lambda data: b"not a zip file at all",
        lambda data: data[:400] + bytes([data[400] ^ 0xFF]) + data[401:],
    ],
)
def test_a_damaged_cache_file_counts_as_none(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    store_cached(tmp_path / "cache", made())
    file = tmp_path / "cache" / "abc.npz"
    assert load_cached(tmp_path / "cache", "abc") == made()
    file.write_bytes(damage(file.read_bytes()))
    assert load_cached(tmp_path / "cache", "abc") is None
    store_cached(tmp_path / "cache", made())
    assert load_cached(tmp_path / "cache", "abc") == made()


def test_another_lenss_table_under_the_name_counts_as_none(tmp_path: Path) -> None:
    made(content_hash="other").save(tmp_path / "abc.npz")
    assert load_cached(tmp_path, "abc") is None
    assert load_cached(tmp_path, "missing") is None


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"chief_mm": np.zeros((2, 2))}, "chief_mm"),
        ({"grid_shape": (2, 2)}, "grid_shape"),
        ({"wavelength_nm": np.array([600.0, 500.0])}, "ascend"),
        ({"focal_length_mm": -5.0}, "focal_length_mm"),
        ({"relative_illumination": np.full((2, 3), np.nan)}, "relative_illumination"),
    ],
)
def test_a_table_that_does_not_fit_together_is_refused(changes: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        made(**changes)
