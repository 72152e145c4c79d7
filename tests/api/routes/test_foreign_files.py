"""Files of other programs that hold no recordings, over the network: spectra, tables of levels, lenses of lensfun's."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from api.client import ServiceClient, ServiceProblem
from lab.foreign_files import put_lens_before
from lab.formats.camera_file import CameraFile, default_camera, read_camera, write_camera
from lab.formats.cgats import CgatsSpectra, write_cgats
from lab.formats.lensfun import write_lensfun
from sim.spectrum import Spectrum
from tests.api.conftest import Running

ZIP = {"Content-Type": "application/zip"}


def zipped(**files: bytes | str) -> bytes:
    """An archive of files; `__` in a name is the dot."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as to:
        for name, content in files.items():
            to.writestr(name.replace("__", "."), content)
    return packed.getvalue()


@pytest.fixture
def levels(tmp_path: Path) -> Path:
    """A table of ten levels of a sensor of 0.4 DN/e and 5 e, exact; its camera.toml beside it."""
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 12\n')
    lines = ["kind,exposure_s,photons_per_pixel,mean_dn,variance_dn2,pixels,repeats"]
    for step in range(1, 11):
        for kind, electrons in (("dark", 0.0), ("flat", 900.0 * step)):
            photons = 2000 * step if electrons else ""
            variance = 0.16 * (electrons + 25) + 1 / 12
            lines.append(f"{kind},{0.01 * step:g},{photons},{64 + 0.4 * electrons:g},{variance:.4f},40000,4")
    table = tmp_path / "levels.csv"
    table.write_text("\n".join(lines) + "\n")
    return table


def test_a_table_of_levels_becomes_a_fit(shared: Running, levels: Path) -> None:
    with ServiceClient(shared.url, shared.keys["calibrate"]) as client:
        made = client.fit_table("photon-transfer-table", levels, levels.with_name("camera.toml"))
    noise = made.fit.cameras["left"].noise
    assert noise is not None and noise.conversion_gain_dn_per_e is not None
    # The table is exact but for its rounding to 1e-4 DN^2, of 10 levels whose variances differ by 1440.
    assert noise.conversion_gain_dn_per_e == pytest.approx(0.4, rel=1e-4)
    assert made.warnings == ()


def test_spectra_are_read(shared: Running, tmp_path: Path) -> None:
    nm = np.arange(400.0, 701.0, 10.0)
    written = {"lamp": Spectrum.of(nm, nm / 1e5), "screen": Spectrum.of(nm, 2.0 - nm / 1e3)}
    file = tmp_path / "lights.ti3"
    write_cgats(file, CgatsSpectra(written, "radiance"))
    with ServiceClient(shared.url, shared.keys["calibrate"]) as client:
        found = client.read_spectra(file)
    assert found.quantity == "radiance" and set(found.spectra) == set(written)
    for name, spectrum in written.items():
        assert found.spectra[name].wavelength_nm == spectrum.wavelength_nm
        np.testing.assert_allclose(found.spectra[name].value, spectrum.value, rtol=1e-5)  # digits of the file


def test_a_lens_is_put_before_the_cameras_that_are_sent_in(shared: Running, tmp_path: Path) -> None:
    camera: CameraFile = default_camera()
    write_camera(tmp_path / "left.toml", camera)
    write_lensfun(tmp_path / "lens.xml", camera)
    files = {one.name: one.read_bytes() for one in tmp_path.iterdir()}
    archive = tmp_path / "cameras.zip"
    archive.write_bytes(zipped(**files))
    expected = put_lens_before(tmp_path / "lens.xml", read_camera(tmp_path / "left.toml"), tmp_path / "left.toml")
    with ServiceClient(shared.url, shared.keys["calibrate"]) as client:
        came = client.send_camera_model(archive, lensfun="lens.xml")
        assert came.warnings == tuple(line.removeprefix(f"{tmp_path}/") for line in expected.remarks)
        back = client.fetch_camera_model(came.id, tmp_path / "back.zip")
        with zipfile.ZipFile(back) as packed:
            packed.extractall(tmp_path / "back")
        with pytest.raises(ServiceProblem, match=r"422: lens\.xml: .*no-such-lens"):
            client.send_camera_model(archive, lensfun="lens.xml", lens="no-such-lens")
        with pytest.raises(ServiceProblem, match="lens: is one of a lensfun file"):
            client.send_camera_model(archive, lens="A")
        with pytest.raises(ServiceProblem, match="isn't a path inside it"):
            client.send_camera_model(archive, lensfun="../lens.xml")
        with pytest.raises(ServiceProblem, match=r"lensfun 'other\.xml': isn't in the archive"):
            client.send_camera_model(archive, lensfun="other.xml")
        client.delete_camera_model(came.id)
    found = read_camera(tmp_path / "back" / "left.toml").camera
    assert found.geometry == expected.content.camera.geometry
    assert found.lens.illumination == expected.content.camera.lens.illumination


CAMERA = 'cfa = "MONO"\nbit_depth = 12\n'
TABLE = {"format": "photon-transfer-table"}


@pytest.mark.parametrize(
    ("route", "params", "files", "said"),
    [
        ("spectra", {}, {"a__sp": "no CGATS"}, "a.sp: "),
        ("spectra", {}, {"a__png": b"x"}, "path: the archive has 0 files that end in .sp, .ti3"),
        ("spectra", {}, {"a__sp": "x", "b__sp": "x"}, "path: the archive has 2 files"),
        ("spectra", {"path": "c.sp"}, {"a__sp": "x"}, "path 'c.sp': isn't in the archive"),
        ("spectra", {"path": "../registry.sqlite"}, {"a__sp": "x"}, "isn't a path inside it"),
        ("spectra", {"wrong": 1}, {"a__sp": "x"}, "wrong"),
        ("table", {}, {"a__csv": "x"}, "format"),
        ("table", {"format": "raw-folder"}, {"a__csv": "x"}, "format"),
        ("table", TABLE, {"a__csv": "x"}, "camera 'camera.toml': isn't in the archive"),
        ("table", TABLE | {"camera": "/etc/passwd"}, {"a__csv": "x"}, "isn't a path inside it"),
        ("table", TABLE, {"a__csv": "kind,mean\nflat,1\n", "camera__toml": CAMERA}, "a.csv: "),
        ("table", TABLE, {"a__csv": "x", "camera__toml": "cfa = 1"}, "camera.toml"),
    ],
)
def test_what_cannot_be_read_is_refused_in_one_line(
    shared: Running, route: str, params: dict[str, Any], files: dict[str, bytes | str], said: str
) -> None:
    with shared.client("calibrate") as client:
        refused = client.post(f"/api/v1/foreign/{route}", content=zipped(**files), headers=ZIP, params=params)
    detail = refused.json()["detail"]
    assert refused.status_code == 422 and said in detail, detail
    assert "\n" not in detail and str(shared.store.root) not in detail and "incoming" not in detail


def test_limits_hold_and_a_key_is_needed(shared: Running) -> None:
    with shared.client("read") as reader:
        assert reader.post("/api/v1/foreign/spectra", content=zipped(a__sp="x"), headers=ZIP).status_code == 403
    many = zipped(**{f"{n}__sp": "x" for n in range(65)})
    with shared.client("calibrate") as client:
        refused = client.post("/api/v1/foreign/spectra", content=many, headers=ZIP, params={"path": "1.sp"})
        assert refused.status_code == 413 and "64" in refused.json()["detail"], refused.text
        bare = client.post("/api/v1/foreign/spectra", content=b"CGATS", headers={"Content-Type": "text/plain"})
        assert bare.status_code == 422 and "Content-Type 'text/plain': send the archive" in bare.json()["detail"]
