"""Camera models of fits and diagnoses, and comparisons, over the network."""

from __future__ import annotations

import io
import shutil
import zipfile
from pathlib import Path
from typing import Any

import pytest

import lab.diagnose
import lab.fit
from api.client import ServiceClient, ServiceProblem
from api.unpacking import TooMuch
from api.upload import take_cameras
from lab.calibration import camera_models
from lab.diagnose import Diagnosis
from lab.fit.compare import compare
from lab.formats.camera_file import CameraFile, default_camera, read_camera, write_camera
from lab.formats.recording_set import ArchiveForm, RecordingSet, packed
from lab.formats.results import DiagnosisResult, FitResult
from lab.pipeline import CaptureRequest, PipelineRequest, _Pipeline
from sim.camera import CameraModel
from sim.effects.library import effect
from sim.optics.imaging import MeasuredPsf
from sim.parameters import read_quantities
from tests.api.conftest import Running, until_state
from tests.lab.calibration.test_life import fitted


@pytest.fixture
def session(shared: Running) -> str:
    """The finished session."""
    with shared.client("read") as client:
        found: str = client.get("/api/v1/sessions").json()[-1]["id"]
        return found


def kept(running: Running, session: str, fit: FitResult) -> str:
    """A fit of a session in the registry; its id."""
    return running.store.add_result("fit", session, fit.model_dump(mode="json"))


# --- camera models ----------------------------------------------------------------------------------------------------


def test_a_fit_over_the_network_keeps_its_cameras(
    running: Running, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(lab.fit, "fit_recording_set", lambda *_: fitted(2.0))
    with ServiceClient(running.url, running.keys["admin"]) as client:
        session = client.capture("fakes", quick=True, sequences=("dark",), name="with models")
        client.fit(session.id)
        (listed,) = client.camera_models()
        assert listed.kind == "fitted" and listed.session_id == session.id and listed.sides == ("left", "right")
        assert not listed.cameras
        model = client.camera_model(listed.id)
        left = model.cameras["left"]
        noise = next(one for one in left.parameters if one.name == "read_noise_e")
        assert (noise.value, noise.std) == (2.0, fitted(2.0).cameras["left"].noise.read_noise_e_std)  # type: ignore[union-attr]
        for one in left.parameters:
            if not one.name.startswith("lens."):
                assert one.unit == read_quantities(CameraModel)[one.name].unit
        archive = client.fetch_camera_model(listed.id, tmp_path / "cameras.zip")
        with zipfile.ZipFile(archive) as packed:
            packed.extractall(tmp_path / "cameras")
        assert read_camera(tmp_path / "cameras" / "left.toml").camera.read_noise_e == 2.0
        # The session goes, its results stay.
        client.delete_session(session.id)
        assert client.camera_model(listed.id).cameras["right"] == model.cameras["right"]


def test_a_diagnosed_camera_has_the_effects_that_were_named(shared: Running, session: str) -> None:
    result = shared.store.add_result("diagnose", session, {})
    acting = CameraFile("found", default_camera().camera, (effect("veiling_glare")(share_percent=1.5),))
    camera_models.keep(shared.store, result, {"left": acting})
    with ServiceClient(shared.url, shared.keys["read"]) as client:
        found = client.camera_model(result)
        assert found.kind == "improved" and found.sides == ("left",)
        (named,) = found.cameras["left"].effects
        told = {one.name: (one.value, one.unit) for one in named.parameters}
        assert named.name == "veiling_glare" and told["share_percent"] == (1.5, "%")


def test_what_was_kept_without_files_says_so(shared: Running, session: str) -> None:
    old = kept(shared, session, fitted(2.0))
    with shared.client("read") as client:
        assert client.get(f"/api/v1/camera-models/{old}").json()["sides"] == []
        assert client.get(f"/api/v1/camera-models/{old}/archive.zip").status_code == 409
        missing = client.get("/api/v1/camera-models/0123456789abcdef")
        assert missing.status_code == 404 and "lists them" in missing.json()["detail"]
        page = client.get("/api/v1/camera-models", params={"limit": 1})
        assert "next" in page.headers["link"] and int(page.headers["x-total-count"]) >= 1


def archive_of(file: Path, files: dict[str, bytes]) -> Path:
    """A .zip or .tar of these files, as the service itself makes one."""
    form: ArchiveForm = "tar" if file.suffix == ".tar" else "zip"
    file.write_bytes(b"".join(packed(files.items(), form)))
    return file


@pytest.fixture
def camera(tmp_path: Path) -> dict[str, bytes]:
    """A camera file with arrays beside it."""
    psf = (((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0)),)
    imaging = MeasuredPsf(wavelength_nm=(550.0,), psf=psf, sample_pitch_um=1.0)
    lens = default_camera().camera.lens.model_copy(update={"imaging": imaging})
    content = CameraFile("from elsewhere", default_camera().camera.model_copy(update={"lens": lens}))
    (tmp_path / "camera").mkdir()
    write_camera(tmp_path / "camera" / "left.toml", content)
    return {file.name: file.read_bytes() for file in (tmp_path / "camera").iterdir()}


@pytest.mark.parametrize("form", ["zip", "tar"])
def test_a_camera_model_is_sent_in_fetched_and_deleted(
    shared: Running, camera: dict[str, bytes], tmp_path: Path, form: str
) -> None:
    with ServiceClient(shared.url, shared.keys["calibrate"]) as client:
        came = client.send_camera_model(archive_of(tmp_path / f"cameras.{form}", camera))
        assert came.kind == "sent" and came.sides == ("left",) and came.session_id is None
        assert came.cameras["left"].name == "from elsewhere" and came.cameras["left"].imaging == "measured_psf"
        assert client.camera_model(came.id) == came and came.id in {one.id for one in client.camera_models()}
        back = client.fetch_camera_model(came.id, tmp_path / f"back.{form}")
        shutil.unpack_archive(back, tmp_path / "back")
        assert {file.name: file.read_bytes() for file in (tmp_path / "back").iterdir()} == camera
        client.delete_camera_model(came.id)
        with pytest.raises(ServiceProblem, match="no camera model"):
            client.camera_model(came.id)
        assert not (shared.store.root / "cameras" / came.id).exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"left.toml": None}, "none of left.toml, right.toml"),
        ({"left.toml": b"format = 'calibench-camera'"}, "version None is not"),
        ({"left-psf.npz": None}, "lens.imaging.samples: left-psf.npz can't be read"),
        ({"left-psf.npz": b"no arrays"}, "can't be read"),
        ({"left-psf.npz": "../../registry.sqlite"}, "leaves the folder"),
        ({"../left.toml": b""}, "isn't a path inside it"),
    ],
)
def test_what_is_no_camera_model_changes_nothing(
    shared: Running, camera: dict[str, bytes], tmp_path: Path, change: dict[str, bytes | str | None], said: str
) -> None:
    files = dict(camera)
    for name, content in change.items():
        if isinstance(content, str):  # the camera file names it in place of `name`
            files["left.toml"] = files["left.toml"].replace(name.encode(), content.encode())
        elif content is None:
            del files[name]
        else:
            files[name] = content
    before = sorted((shared.store.root / "cameras").glob("*"))
    with ServiceClient(shared.url, shared.keys["calibrate"]) as client:
        known = [one.id for one in client.camera_models()]
        with pytest.raises(ServiceProblem) as refused:
            client.send_camera_model(archive_of(tmp_path / "bad.zip", files))
        assert refused.value.status == 422 and said in refused.value.detail, refused.value.detail
        assert str(shared.store.root) not in refused.value.detail and ".incoming" not in refused.value.detail
        assert [one.id for one in client.camera_models()] == known
    assert sorted((shared.store.root / "cameras").glob("*")) == before


def test_a_compressed_array_may_not_be_larger_than_the_cap(camera: dict[str, bytes], tmp_path: Path) -> None:
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as arrays:
        arrays.writestr("psf.npy", bytes(2 << 20))
    archive = archive_of(tmp_path / "bomb.zip", camera | {"left-psf.npz": bomb.getvalue()})
    (tmp_path / "place").mkdir()
    with pytest.raises(TooMuch, match="larger than 1048576 bytes"):
        take_cameras(tmp_path / "place", archive, 1 << 20)


def test_a_diagnosis_begins_with_a_camera_model(
    running: Running, camera: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began: list[dict[str, str]] = []

    def examine(recordings: RecordingSet, fit: FitResult, *_: object, baseline: Any, **__: object) -> Diagnosis:
        began.append({side: one.name for side, one in baseline.items()})
        return Diagnosis(DiagnosisResult(source="s", verdict="no_mismatch"), {}, ())

    monkeypatch.setattr(lab.fit, "fit_recording_set", lambda *_: fitted(2.0))
    monkeypatch.setattr(lab.diagnose, "examine", examine)
    with ServiceClient(running.url, running.keys["admin"]) as client:
        session = client.capture("fakes", quick=True, sequences=("dark",)).id
        one = client.send_camera_model(archive_of(tmp_path / "one.zip", camera)).id
        with pytest.raises(ServiceProblem, match="has no right camera"):
            client.wait_job(client.start_job("diagnose", session, one).id)
        both = camera | {"right.toml": camera["left.toml"]}
        model = client.send_camera_model(archive_of(tmp_path / "both.zip", both)).id
        job = client.wait_job(client.start_job("diagnose", session, model).id)
        told = client.request("GET", f"/jobs/{job.id}/result").json()
        assert began == [{"left": "from elsewhere", "right": "from elsewhere"}] and told["baseline"] == "from elsewhere"
        # What rests on a diagnosis takes one of the fitted cameras, not this.
        report = PipelineRequest("report", capture=CaptureRequest(session), source=session, reuse=True)
        pipeline = _Pipeline(report, None, running.store, None)
        assert pipeline._kept("diagnose", DiagnosisResult) is None
        for kind, named, status in (("fit", model, 422), ("diagnose", "0" * 16, 404)):
            with pytest.raises(ServiceProblem) as refused:
                client.start_job(kind, session, named)  # type: ignore[arg-type]
            assert refused.value.status == status


# --- comparisons ------------------------------------------------------------------------------------------------------


def test_two_calibrations_are_compared_as_on_the_command_line(shared: Running, session: str) -> None:
    a, b = kept(shared, session, fitted(2.0)), kept(shared, session, fitted(2.4))
    wanted = compare(fitted(2.0), fitted(2.4))
    with ServiceClient(shared.url, shared.keys["read"]) as client:
        found = client.compare(a, b, ["noise read_noise_e>5%", "right:noise read_noise_e>50%"])
        assert found.comparison.changes == wanted.changes and found.comparison.threshold_sigma == wanted.threshold_sigma
        assert (found.comparison.a, found.comparison.b) == (a, b)
        assert found.failing == ("left noise read_noise_e", "right noise read_noise_e")
        # A session stands for its newest fit.
        assert client.compare(a, session).comparison.changes == found.comparison.changes
        assert client.compare(a, a).comparison.changed is False
        with pytest.raises(ServiceProblem, match="fail_on 'magic': no such figure in both"):
            client.compare(a, b, ["magic"])
        with pytest.raises(ServiceProblem, match="b: '0123456789abcdef' has no fit") as missing:
            client.compare(a, "0123456789abcdef")
        assert missing.value.status == 404
        diagnosis = shared.store.add_result("diagnose", session, {})
        with pytest.raises(ServiceProblem, match="is a result of the kind diagnose"):
            client.compare(diagnosis, b)


def test_the_comparison_has_a_page(shared: Running, session: str) -> None:
    a, b = kept(shared, session, fitted(2.0)), kept(shared, session, fitted(2.4))
    with shared.client("read") as client:
        page = client.get("/api/v1/comparisons/page", params={"a": a, "b": b})
        assert page.status_code == 200 and "2 of " in page.text and a in page.text
        assert "default-src 'none'" in page.headers["content-security-policy"]
        assert client.get("/api/v1/comparisons/page", params={"a": a}).status_code == 422


def test_recordings_stand_for_their_newest_fit(running: Running) -> None:
    with running.client("admin") as client:
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"]}
        started = client.post("/api/v1/sessions", json=asked).json()["id"]
        until_state(client, started, "finished")
        content = client.get(f"/api/v1/sessions/{started}/archive.zip").content
        assert zipfile.is_zipfile(io.BytesIO(content))
        sent = client.post("/api/v1/recordings", content=content, headers={"Content-Type": "application/zip"}).json()
        folder = str(running.app.state.service.inbox.folder(sent["id"]))
        running.store.add_result("fit", folder, fitted(2.0).model_dump(mode="json"))
        here = kept(running, started, fitted(2.4))
        found = client.get("/api/v1/comparisons", params={"a": sent["id"], "b": here}).json()
        assert {one["name"] for one in found["comparison"]["changes"] if one["changed"]} == {"noise read_noise_e"}
