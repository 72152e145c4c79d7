"""A new kind of capture takes one file: planning, capture, store, export, import and report handle it unchanged."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import httpx
import numpy as np
import pytest

from lab.capture.plan import full_plan
from lab.capture.session import CaptureSession
from lab.capture.station import Station
from lab.capture.store import Store
from lab.capture_kinds.base import CAPTURES, SEQUENCES, TARGETS, AnyCapture, in_folder, names_in, registered
from lab.cli.entry import main
from lab.errors import InputError
from lab.foreign_recordings import read_foreign
from lab.formats.recording_set import Manifest, inspect, read, write
from lab.formats.results import CameraFit, DiagnosisResult, FitResult, ValidationResult
from lab.report import provenance_of, write_report
from tests.api.conftest import serving
from tests.lab import fake_bench
from tests.lab.capture_kinds.step_wedge import WedgeCapture

LAYOUT = {"regions": [[2, 2, 10, 10], [2, 12, 10, 20], [12, 2, 20, 10]]}
WEDGE = {"kind": "step_wedge", "density": [0.0, 0.3, 0.6], "left": LAYOUT, "right": LAYOUT}


@pytest.fixture
def known() -> Iterator[None]:
    with registered(WedgeCapture):
        yield


def station() -> Station:
    table = fake_bench.station().model_dump(mode="json")
    return Station.model_validate(table | {"targets": table["targets"] | {"wedge": WEDGE}})


def taken(store: Store, bench: fake_bench.Bench) -> str:
    plan = full_plan(station(), quick=True, only=["wedge"])
    session = CaptureSession.start(store, station(), plan, connect=bench.drivers, name="wedges")
    assert session.run().state == "finished"
    return session.id


def test_the_kind_is_known_within_the_block_only() -> None:
    before = (CAPTURES.names, TARGETS.names, tuple(SEQUENCES))
    with registered(WedgeCapture):
        assert (CAPTURES.names[-1], TARGETS.names[-1], tuple(SEQUENCES)[-1]) == ("step_wedge", "step_wedge", "wedge")
        assert full_plan(station()).names[-1] == "wedge"
    assert (CAPTURES.names, TARGETS.names, tuple(SEQUENCES)) == before
    with pytest.raises(ValueError, match="unknown kind 'step_wedge' of target; the kinds are cap, "):
        station()


@pytest.mark.usefixtures("known")
def test_from_the_plan_to_the_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    monkeypatch.setenv("CALIBENCH_DATA", str(data))
    bench = fake_bench.Bench()
    store = Store(data)
    session = taken(store, bench)

    # Kept: the frames, the light, and what the trigger and the monochromator told.
    stored = store.recording_set(session)
    captures = stored.captures(WedgeCapture)
    assert [(c.id, c.side) for c in captures] == [
        ("wedge-1-left", "left"), ("wedge-1-right", "right"), ("wedge-2-left", "left"), ("wedge-2-right", "right"),
    ]  # fmt: skip
    assert {c.bandwidth_nm for c in captures} == {9.48}
    assert all(c.exposure_s > 0 and c.time is not None for c in captures)
    assert len({c.kind for c in store.captures(session)}) == 1

    # Exported and read again, bit by bit.
    assert main(["export", session, "--to", str(tmp_path / "set"), "--data", str(data)]) == 0
    again = read(tmp_path / "set")
    assert again.warnings == ()
    assert again.manifest.captures == stored.manifest.captures
    assert all(np.array_equal(again.frame(c), stored.frame(c)) for c in captures)
    assert again.spectrum(captures[0].radiance) == stored.spectrum(captures[0].radiance)

    # Joined to another set, everything that the kind names gets its folder.
    joined = again.joined(again, "later")
    assert joined.captures(WedgeCapture)[-1].radiance == f"later/{captures[0].radiance}"
    assert inspect(joined)[0] == []
    write(joined, tmp_path / "joined")

    # Listed, and in the report.
    capsys.readouterr()
    assert main(["kinds", session]) == 0
    (row,) = (line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("step_wedge"))
    assert (row[1], row[-1]) == ("wedge", "4")
    nothing = FitResult(source=session, cameras={side: CameraFit() for side in again.sides})
    page = write_report(
        tmp_path / "report.html",
        again,
        nothing,
        ValidationResult(source=session, checks=()),
        DiagnosisResult(source=session, verdict="no_mismatch"),
        provenance_of(again),
    ).read_text(encoding="utf-8")
    assert page.count("<td>step wedge</td>") == 4


def test_a_session_of_a_kind_that_is_gone_is_refused_by_name(tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    with registered(WedgeCapture):
        session = taken(store, fake_bench.Bench())
    with pytest.raises(InputError, match=f"session {session}: it has captures of the kind 'step_wedge', which this"):
        store.recording_set(session)


@pytest.mark.usefixtures("known")
def test_the_kinds_own_checks_are_made(tmp_path: Path) -> None:
    keys: dict[str, Any] = {
        "kind": "step_wedge",
        "side": "left",
        "frame": "f.npy",
        "exposure_s": 0.1,
        "radiance": "s.csv",
    }
    camera = {"rows": 24, "cols": 32, "cfa": "MONO", "bit_depth": 12}
    captures = [
        keys | {"id": "a", "density": [0.0], "regions": []},
        keys | {"id": "b", "density": [0.0], "regions": "?"},
    ]
    text = {"format": "calibench-recording", "version": 1, "cameras": {"left": camera}}
    (tmp_path / "manifest.json").write_text(json.dumps(text | {"captures": captures}))
    with pytest.raises(InputError, match=r"captures\[1\] \(b\): regions: input should be a valid tuple"):
        read(tmp_path)
    (tmp_path / "manifest.json").write_text(json.dumps(text | {"captures": captures[:1]}))
    with pytest.raises(InputError) as refused:
        read(tmp_path)
    assert "capture a: 1 densities and 0 regions; give one density a region" in str(refused.value)
    assert "s.csv (radiance of capture a): no such file" in str(refused.value)


@pytest.mark.usefixtures("known")
def test_a_folder_of_images_is_imported_with_the_kinds_lists(tmp_path: Path) -> None:
    np.save(tmp_path / "one.npy", np.full((24, 32), 500, np.uint16))
    (tmp_path / "light.csv").write_text("wavelength_nm,value\n400,0.1\n700,0.1\n")
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 12\n')
    (tmp_path / "index.csv").write_text(
        "frame,kind,exposure_s,radiance,density,regions\none.npy,step_wedge,0.1,light.csv,0 0.3,2 2 10 10 2 12 10 20\n"
    )
    (capture,) = read_foreign("raw-folder", tmp_path).captures(WedgeCapture)
    assert capture.density == (0.0, 0.3)
    assert capture.regions == ((2, 2, 10, 10), (2, 12, 10, 20))


@pytest.mark.usefixtures("known")
def test_the_service_offers_it(tmp_path: Path) -> None:
    with serving(tmp_path / "data") as service:
        session = taken(service.store, service.bench)
        with service.client("operate") as client:
            here = f"/api/v1/sessions/{session}/captures"
            listed = client.get(here, params={"kind": "step_wedge"}).json()
            assert [one["kind"] for one in listed] == ["step_wedge"] * 4
            refused: httpx.Response = client.get(here, params={"kind": "wedge"})
            assert refused.status_code == 422
            assert "step_wedge" in refused.text


@pytest.mark.usefixtures("known")
def test_the_manifests_json_schema_has_it() -> None:
    schema = Manifest.model_json_schema()
    kinds = {variant["properties"]["kind"]["const"] for variant in _variants(schema)}
    assert kinds == set(CAPTURES.names)


def _variants(schema: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for one in schema["properties"]["captures"]["items"]["oneOf"]:
        yield schema["$defs"][one["$ref"].rsplit("/", 1)[1]] if "$ref" in one else one


def test_every_kind_declares_what_others_ask() -> None:
    for name, kind in CAPTURES.models.items():
        assert kind.shows
        assert kind.sequence is None or SEQUENCES[kind.sequence.name] is kind.sequence, name
    steps = full_plan(fake_bench.station()).steps(fake_bench.station())
    # a full session leaves the lenses' aperture rings alone; only `standards_plan` shows the flare chart
    assert {c.kind for step in steps for c in step.captures} == set(CAPTURES.names) - {"stopped_edge", "flare"}
    for target in fake_bench.station().targets.values():
        assert target.instruction


def test_names_are_found_at_any_depth() -> None:
    steps = full_plan(fake_bench.station()).steps(fake_bench.station())
    shown: AnyCapture = next(c for step in steps for c in step.captures if c.kind == "bernoulli")
    named = {key: value for key, _, value in names_in(shown)}
    assert set(named) == {"id", "frame", "screen.pose", "screen.radiance", "target"}
    moved = {key: value for key, _, value in names_in(in_folder(shown, "later"))}
    assert moved == {key: f"later/{value}" for key, value in named.items()}
    assert in_folder(shown, "later").model_fields_set == shown.model_fields_set


def test_the_how_tos_examples_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = Path(__file__).parents[3] / "docs/how-to/add-a-capture-kind.md"
    files = [code for code in re.findall(r"```python\n(.*?)```", page.read_text(), re.S) if "KIND = " in code]
    assert len(files) == 2
    for number, code in enumerate(files):
        file = tmp_path / f"how_to_{number}.py"
        file.write_text(code)
        spec = importlib.util.spec_from_file_location(file.stem, file)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, file.stem, module)
        spec.loader.exec_module(module)
        (name,) = get_args(module.KIND.model_fields["kind"].annotation)
        if name in CAPTURES.models:  # whoever follows the page has added it
            continue
        with registered(module.KIND):
            steps = full_plan(fake_bench.station(), quick=True).steps(fake_bench.station())
            assert sum(isinstance(c, module.KIND) for step in steps for c in step.captures) >= 2 * 2


def test_a_name_is_taken_once() -> None:
    class OtherDark(CAPTURES.models["dark"]):  # type: ignore[misc, name-defined]
        """Another class of the kind `dark`."""

    with pytest.raises(ValueError, match="the capture kind 'dark' is taken"), registered(OtherDark):
        pass
