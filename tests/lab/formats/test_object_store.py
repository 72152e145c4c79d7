"""Recording sets below a URL: in memory, and in a real S3 server, from where workers of a cluster read them."""

from __future__ import annotations

import gc
import os
import pickle
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import fsspec
import numpy as np
import pytest

from lab import cli
from lab.errors import InputError
from lab.formats import recording_set as recording
from lab.formats.recording_set import Manifest, RecordingError, RecordingSet
from lab.formats.recording_set.object_store import ObjectStore, UrlFiles, is_url
from sim.spectrum import Spectrum
from tests.peers import missing

LAMP = Spectrum.of([400.0, 550.0, 700.0], [0.01, 0.03, 0.02])
ROWS, COLS = 6, 8


def made(captures: int = 4) -> RecordingSet:
    """Flats of random codes, one in four a TIFF, in the light of a lamp."""
    rng = np.random.default_rng(54)
    names = [f"frames/{n}.{'tif' if n % 4 == 3 else 'npy'}" for n in range(captures)]
    frames = {name: rng.integers(0, 4096, (ROWS, COLS)).astype(np.uint16) for name in names}
    manifest = {
        "cameras": {"left": {"rows": ROWS, "cols": COLS, "cfa": "MONO", "bit_depth": 12}},
        "captures": [
            {"id": f"flat/{n}", "kind": "flat", "side": "left", "exposure_s": 0.01, "frame": name,
             "radiance": "spectra/lamp.csv"}
            for n, name in enumerate(names)
        ],
    }  # fmt: skip
    return RecordingSet(Manifest.model_validate(manifest), frames, {"spectra/lamp.csv": LAMP})


def same(one: RecordingSet, other: RecordingSet) -> bool:
    assert one.manifest == other.manifest
    light = "spectra/lamp.csv"
    np.testing.assert_allclose(one.spectrum(light).value, other.spectrum(light).value, rtol=1e-12)
    return all(np.array_equal(one.frame(a), other.frame(a)) for a in one.captures())


@pytest.fixture
def url() -> Iterator[str]:
    """A place in fsspec's own memory."""
    yield "memory://lab/my-camera"
    fsspec.filesystem("memory").rm("/lab", recursive=True)


def test_names_of_places() -> None:
    assert is_url("s3://lab/set") and is_url("https://lab/set") and not is_url(Path("s3:/lab"))
    assert not any(map(is_url, ("/data/set", "C:\\data", "set", "://x", "s3://")))


def test_a_set_below_a_url_is_the_set(url: str) -> None:
    recordings = made()
    assert recording.write_url(recordings, url) == (url, 6)  # four frames, a spectrum, the manifest
    found = recording.read(url)
    assert found.source == url and same(found, recordings)
    assert same(recording.read(f"{url}/manifest.json"), recordings)
    sent = pickle.loads(pickle.dumps(found))
    assert same(sent, recordings)
    with pytest.raises(InputError, match=f"{url}: holds a recording set already"):
        recording.write_url(recordings, url)


def test_an_export_that_broke_off_is_taken_up_again(url: str) -> None:
    recordings = made()

    def break_off(capture: str, share: float) -> None:
        if share >= 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        recording.write_url(recordings, url, progress=break_off)
    with pytest.raises(RecordingError, match=r"manifest\.json: no such file"):
        recording.read(url)  # nothing half is read
    store = ObjectStore(url)
    store.put("frames/0.npy", b"half")
    assert recording.write_url(recordings, url)[1] == 5  # the second frame was there
    assert same(recording.read(url), recordings)


def test_what_is_missing_damaged_or_outside_is_one_line(url: str) -> None:
    recording.write_url(made(), url)
    files = UrlFiles(ObjectStore(url))
    for path in ("../secret", "/etc/passwd", "s3://other/x", "a\\b", ""):
        with pytest.raises(InputError, match="not a path relative to the folder"):
            files.store.content(path)
    files.store.put("frames/1.npy", b"damaged")
    fsspec.filesystem("memory").rm("/lab/my-camera/frames/2.npy")
    with pytest.raises(RecordingError) as refused:
        recording.read(url)
    lines = str(refused.value).splitlines()
    assert any("frames/1.npy" in line and "damaged .npy" in line for line in lines)
    assert any("frames/2.npy" in line and "no such file" in line for line in lines)
    for wrong, said in (
        ("nothing://x/y", "can't be reached"),
        ("memory://none/here", "no such file"),
        ("s3://user:secret@lab/set", "has a user or a password in it"),
    ):
        with pytest.raises(InputError, match=said) as caught:
            recording.read(wrong)
        assert "\n" not in str(caught.value) and "secret" not in str(caught.value)


def test_copies_on_this_computer_are_bounded(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lab.formats.recording_set.object_store._KEPT_FILES", 2)
    recordings = made()
    recording.write_url(recordings, url)
    files = UrlFiles(ObjectStore(url))
    for n in (0, 1, 2, 0):
        file = files.file(f"frames/{n}.npy")
        assert file is not None and np.array_equal(np.load(file), recordings.frame(recordings.captures()[n]))
    assert files._folder is not None and sum(one.is_file() for one in files._folder.rglob("*")) == 2
    folder = files._folder
    del files
    gc.collect()
    assert not folder.exists()


def test_commands_take_a_url(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    url = f"file://{tmp_path}/kept"
    recording.write_url(made(), url)
    assert cli.main(["kinds", url]) == 0 and "flat" in capsys.readouterr().out
    assert cli.main(["kinds", f"file://{tmp_path}/none"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


# --- a real S3 server -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """A bucket of moto's S3 server, a process of its own; credentials and address in the environment."""
    if find_spec("s3fs") is None:
        missing("s3fs isn't installed (calibench's extra s3)")
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    search = os.pathsep.join(filter(None, (os.environ.get("CALIBENCH_MOTO", ""), os.environ.get("PYTHONPATH", ""))))
    environment = os.environ | {"PYTHONPATH": search}
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    there = subprocess.run([sys.executable, "-c", "import moto"], env=environment, capture_output=True, check=False)
    if there.returncode:
        missing("moto isn't installed (`make peers`)")
    stated = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ACCESS_KEY_ID": "lab",
        "AWS_SECRET_ACCESS_KEY": "lab",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    with (
        pytest.MonkeyPatch.context() as patch,
        subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server,
    ):
        for name, value in stated.items():
            patch.setenv(name, value)
        try:
            until = time.monotonic() + 30.0
            while not _listens(port) and time.monotonic() < until:
                time.sleep(0.05)
            fsspec.filesystem("s3").mkdir("lab")
            yield "s3://lab"
        finally:
            server.kill()


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.mark.extra
def test_a_set_in_an_s3_server_is_read_by_workers(bucket: str) -> None:
    from distributed import Client, LocalCluster

    url, recordings = f"{bucket}/many", made(40)
    recording.write_url(recordings, url)
    found = recording.read(url)
    assert same(found, recordings)
    with (
        LocalCluster(n_workers=4, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,  # type: ignore[no-untyped-call]
        Client(cluster) as client,  # type: ignore[no-untyped-call]
    ):
        numbers = range(len(found.captures()))
        sums = client.gather(client.map(_sum_of, [found] * len(numbers), numbers, pure=False))
        assert sums == [int(recordings.frame(capture).sum()) for capture in recordings.captures()]


def _sum_of(recordings: RecordingSet, number: int) -> int:
    return int(recordings.frame(recordings.captures()[number]).sum())


@pytest.mark.extra
def test_nothing_half_is_read_where_an_export_is_killed(bucket: str, tmp_path: Path) -> None:
    folder, url, recordings = tmp_path / "set", f"{bucket}/killed", made(60)
    recording.write(recordings, folder)
    code = (
        "import sys; from lab.formats import recording_set as r\n"
        "tell = lambda id, share: print(share, flush=True)\n"
        "r.write_url(r.read(sys.argv[1]), sys.argv[2], progress=tell)"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])}
    with subprocess.Popen(
        [sys.executable, "-c", code, str(folder), url], stdout=subprocess.PIPE, env=environment, text=True
    ) as writer:
        assert writer.stdout is not None
        while float(writer.stdout.readline()) < 0.4:
            pass
        writer.kill()
    with pytest.raises(RecordingError, match=r"manifest\.json: no such file"):
        recording.read(url)
    _, written = recording.write_url(recordings, url)
    # At 0.4, 24 of 60 frames were there, and one more may have been under way.
    assert written <= 60 - 24 + 2
    assert same(recording.read(url), recordings)


@pytest.mark.extra
def test_a_bucket_that_is_not_there_is_one_line(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RecordingError, match=r"s3://none-such/set/manifest\.json: ") as caught:
        recording.read("s3://none-such/set")
    assert "\n" not in str(caught.value)
