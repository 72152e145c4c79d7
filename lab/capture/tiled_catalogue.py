"""A stored session in a Tiled catalogue: bluesky's documents as its runs, and every capture's frame beside them.

    CATALOGUE/SESSION/captures/ID   the frame (rows, cols) in DN; its metadata are the capture's keys
                      spectra/NAME  (2, samples): wavelength (nm) and value
                      targets/NAME  what the screen showed
    CATALOGUE/SESSION/runs/UID      each run, as bluesky's own TiledWriter writes it

The metadata of SESSION is the manifest without its captures: cameras, instruments with all their settings, notes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.base import Names, names_in
from lab.errors import InputError, one_line
from lab.formats.recording_set import RecordingSet, manifest_json, parse_manifest
from sim.spectrum import Spectrum

#: Name of the catalogue's database in a folder.
DATABASE = "catalog.db"
#: The environment variable with the key of a Tiled server.
KEY = "TILED_API_KEY"


def open_catalogue(where: str) -> Any:
    """Return a Tiled client of a server's address, or of a catalogue in a folder, which is made if it isn't there.

    Raises InputError where calibench's extra `tiled` isn't installed, or the catalogue can't be opened.
    """
    try:
        from tiled.catalog import from_uri as folder_catalogue
        from tiled.client import Context, from_context, from_uri
        from tiled.server.app import build_app
    except ImportError as error:
        raise InputError(f"{where}: needs Tiled ({one_line(error)}); install calibench with its extra tiled") from error
    try:
        if "://" in where:
            return from_uri(where, api_key=os.environ.get(KEY))
        folder = Path(where).resolve()
        (folder / "data").mkdir(parents=True, exist_ok=True)
        database = folder / DATABASE
        tree = folder_catalogue(
            f"sqlite:///{database}",
            writable_storage=[str(folder / "data"), f"duckdb:///{folder / 'tables.duckdb'}"],
            init_if_not_exists=True,
        )
        return from_context(Context.from_app(build_app(tree)))
    except Exception as error:
        raise InputError(f"{where}: can't be opened as a Tiled catalogue ({one_line(error)}); check it") from error


def write_session(
    client: Any,
    recordings: RecordingSet,
    documents: Path,
    progress: Callable[[str, float], None] | None = None,
) -> str:
    """Write a session into a catalogue; returns its key there, the session's id.

    `documents`: bluesky's documents as the session kept them. Raises InputError where the catalogue has the session.
    """
    key = Path(recordings.source).name
    if key in client:
        raise InputError(f"{key}: the catalogue has it already; delete it there first")
    about = json.loads(manifest_json(recordings.manifest.model_copy(update={"captures": ()})))
    session = client.create_container(
        key, metadata={"session": key, **{k: v for k, v in about.items() if k != "captures"}}
    )
    listed = recordings.captures()
    captures = session.create_container("captures")
    for number, capture in enumerate(listed, start=1):
        keys = capture.model_dump(mode="json", exclude_unset=True)
        captures.write_array(recordings.whole_frame(capture), key=capture.id.replace("/", "."), metadata=keys)
        if progress:
            progress(capture.id, number / len(listed))
    named = {(what, path) for capture in listed for _, what, path in names_in(capture)}
    for camera in recordings.manifest.cameras.values():
        named |= {(Names.SPECTRUM, path) for path in (camera.quantum_efficiency or {}).values()}
    spectra, targets = session.create_container("spectra"), session.create_container("targets")
    for what, path in sorted(named, key=lambda pair: pair[1]):  # a lens's prescription has no place in it
        name, about_it = Path(path).stem, {"path": path}
        if what is Names.SPECTRUM:
            spectra.write_array(np.stack(recordings.spectrum(path).arrays), key=name, metadata=about_it)
        elif what is Names.TARGET:
            targets.write_array(recordings.target(path), key=name, metadata=about_it)
    _write_runs(session.create_container("runs"), documents)
    return key


def read_session(client: Any, key: str) -> RecordingSet:
    """Return a session that `write_session` wrote, as a recording set; frames are fetched when asked for.

    Raises InputError where the catalogue has no such session, or what it has under the key isn't one.
    """
    if key not in client:
        raise InputError(f"{key}: the catalogue has no such session; it has {', '.join(list(client)[:5]) or 'none'}")
    session = client[key]
    try:
        nodes = {node.metadata["frame"]: node for node in session["captures"].values()}
        captures = [dict(node.metadata) for node in session["captures"].values()]
        spectra = {node.metadata["path"]: Spectrum.of(*node.read()) for node in session["spectra"].values()}
        targets = {node.metadata["path"]: node.read() for node in session["targets"].values()}
        about = json.loads(json.dumps(dict(session.metadata)))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{key}: isn't a session that calibench wrote ({one_line(error)}); name another") from error
    about.pop("session", None)
    about["cameras"] = {
        side: {k: v for k, v in camera.items() if k != "lens_file"} for side, camera in about["cameras"].items()
    }
    manifest, warnings = parse_manifest(json.dumps(about | {"captures": captures}), key)
    return RecordingSet(manifest, _Fetched(nodes), spectra, targets, source=key, warnings=tuple(warnings))


class _Fetched(Mapping[str, NDArray[Any]]):
    """Frames by their paths, each fetched from the catalogue when it is asked for."""

    def __init__(self, nodes: Mapping[str, Any]) -> None:
        self._nodes = nodes

    def __getitem__(self, path: str) -> NDArray[Any]:
        return np.asarray(self._nodes[path].read())

    def __iter__(self) -> Iterator[str]:
        return iter(self._nodes)

    def __len__(self) -> int:
        return len(self._nodes)


def _write_runs(runs: Any, documents: Path) -> None:
    """Replay bluesky's documents of the session's runs, those that were cut off included."""
    from bluesky_tiled_plugins import TiledWriter

    for run in _runs(documents):
        writer = TiledWriter(runs)
        for name, document in run:
            writer(name, document)


def _runs(documents: Path) -> Iterator[list[tuple[str, dict[str, Any]]]]:
    """Yield the documents of each run; a run that was killed gets the stop document that it lacks."""
    run: list[tuple[str, dict[str, Any]]] = []
    lines = documents.read_text(encoding="utf-8").splitlines() if documents.is_file() else []
    for line in [*lines, '["start", {}]']:
        try:
            name, document = json.loads(line)
        except ValueError:
            continue  # the last line before a power cut
        if name == "start":
            if run and run[-1][0] != "stop":
                began = run[0][1]
                stop = {"uid": f"{began['uid']}-cut", "run_start": began["uid"], "time": began["time"]}
                run.append(("stop", stop | {"exit_status": "abort", "reason": "the run was cut off"}))
            if run:
                yield run
            run = []
        run.append((name, document))
