"""Recording sets: written and read again bit for bit, and one line for everything that the format refuses."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.errors import InputError, NotDetermined
from lab.formats.recording_set import Manifest, RecordingError, RecordingSet, Summaries, read, write
from sim.spectrum import Spectrum
from tests.lab.formats.damaged_sets import edit, only, problems

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"


# --- what is fine -----------------------------------------------------------------------------------------------------


def test_written_set_reads_back_bit_for_bit(small_set: Callable[..., RecordingSet], folder: Path) -> None:
    before, after = small_set(), read(folder)
    assert after.warnings == ()
    assert after.manifest == before.manifest
    assert after.sides == ("left", "right")
    for capture in before.captures():
        np.testing.assert_array_equal(after.frame(capture), before.frame(capture))
        assert after.frame(capture).dtype == np.uint16
    assert after.spectrum("spectra/lamp.csv") == before.spectrum("spectra/lamp.csv")
    np.testing.assert_array_equal(after.target("targets/bernoulli.npy"), before.target("targets/bernoulli.npy"))


def test_a_copy_of_a_folder_keeps_the_files_bytes_and_the_unknown_keys(folder: Path, tmp_path: Path) -> None:
    edit(folder, lambda m: m["captures"][0].update(operator="Ada", iso=None) or m.update(lab={"room": 7}))
    again = write(read(folder), tmp_path / "again")
    for file in sorted((folder / "frames").iterdir()):
        assert (again / "frames" / file.name).read_bytes() == file.read_bytes()
    manifest = json.loads((again / "manifest.json").read_text())
    assert manifest == json.loads((folder / "manifest.json").read_text())
    assert manifest["captures"][0]["operator"] == "Ada"


#: No control characters, which `lab.plain_text` refuses.
PLAIN = st.characters(
    codec="utf-8",
    exclude_categories=("Cc", "Zl", "Zp"),
    exclude_characters="\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069",
)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    frame=hnp.arrays(np.uint16, st.tuples(st.integers(1, 9), st.integers(1, 9))),
    name=st.text(PLAIN, max_size=20),
    exposure_s=st.floats(0, 1e6),
    suffix=st.sampled_from(["npy", "tif"]),
    wavelengths=st.lists(st.floats(1, 1e4), min_size=1, max_size=8, unique=True).map(sorted),
    value=st.floats(allow_nan=False, allow_infinity=False),
)
def test_any_set_survives_writing_and_reading(
    *,
    tmp_path: Path,
    frame: np.ndarray[Any, Any],
    name: str,
    exposure_s: float,
    suffix: str,
    wavelengths: list[float],
    value: float,
) -> None:
    camera = {"rows": frame.shape[0], "cols": frame.shape[1], "cfa": "MONO", "bit_depth": 16}
    capture = {"id": name, "kind": "dark", "side": "left", "frame": f"frames/a.{suffix}", "exposure_s": exposure_s}
    lit = capture | {
        "id": name + "'",
        "kind": "narrowband",
        "frame": "frames/b.npy",
        "wavelength_nm": 500,
        "radiance": "s.csv",
    }
    manifest = Manifest.model_validate({"name": name, "cameras": {"left": camera}, "captures": [capture, lit]})
    spectrum = Spectrum.of(wavelengths, [value] * len(wavelengths))
    before = RecordingSet(manifest, {capture["frame"]: frame, "frames/b.npy": frame}, {"s.csv": spectrum})
    folder = tmp_path / "any"
    shutil.rmtree(folder, ignore_errors=True)
    after = read(write(before, folder))
    assert after.manifest.name == name
    assert after.captures("dark")[0].exposure_s == exposure_s
    np.testing.assert_array_equal(after.frame(after.captures("dark")[0]), frame)
    assert after.spectrum("s.csv") == spectrum


def test_captures_by_kind_class_and_side(small_set: Callable[..., RecordingSet]) -> None:
    recordings = small_set()
    assert [c.id for c in recordings.captures("dark", "left")] == ["dark-000", "dark-006"]
    assert recordings.captures(DarkCapture, "left") == recordings.captures("dark", "left")
    assert all(isinstance(c, FlatCapture) for c in recordings.captures("flat"))
    assert len(recordings.captures()) == len(recordings.manifest.captures)
    assert recordings.capture("dark-006").side == "left"
    with pytest.raises(InputError, match="no capture 'nope'"):
        recordings.capture("nope")


def test_frames_are_read_only_and_the_cache_keeps_to_its_size(folder: Path) -> None:
    recordings = read(folder)
    first, second = recordings.captures()[:2]
    with pytest.raises(ValueError, match="read-only"):
        recordings.frame(first)[0, 0] = 1
    one = recordings.frame(first).nbytes
    small = RecordingSet(recordings.manifest, files=recordings._files, cache_bytes=one)
    kept = small.frame(first)
    assert small.frame(first) is kept
    small.frame(second)
    assert small.frame(first) is not kept
    kept = small.frame(first)
    small.let_go()
    assert small.frame(first) is not kept
    halved = small.for_one_of(2)  # less than a frame
    assert halved.frame(first) is not halved.frame(first)
    np.testing.assert_array_equal(halved.frame(first), small.frame(first))


def test_a_set_travels_to_another_process(folder: Path) -> None:
    recordings = read(folder)
    again = pickle.loads(pickle.dumps(recordings))
    capture = recordings.captures()[0]
    np.testing.assert_array_equal(again.frame(capture), recordings.frame(capture))


def test_unknown_kind_and_unknown_keys_are_reported_and_passed_over(folder: Path) -> None:
    edit(folder, lambda m: m["captures"].append({"id": "x", "kind": "hologram", "anything": 1}))
    edit(folder, lambda m: m["cameras"]["left"].update(coating="broadband"))
    edit(folder, lambda m: next(c for c in m["captures"] if c["kind"] == "white")["screen"].update(nits=300))
    recordings = read(folder)
    assert len(recordings.warnings) == 3
    assert "unknown kind 'hologram'" in recordings.warnings[0]
    assert any("'coating'" in line and "camera left" in line for line in recordings.warnings)
    assert any("'nits'" in line and "screen" in line for line in recordings.warnings)
    assert recordings.camera("left").unknown_keys() == {"coating": "broadband"}


def test_only_unknown_kinds_leave_nothing_to_work_with(folder: Path) -> None:
    edit(folder, lambda m: m.update(captures=[{"id": "x", "kind": "hologram"}]))
    lines = problems(folder)
    assert "hologram" in lines[0]
    assert "no capture that can be used" in lines[1]


def test_byte_order_and_memory_order_of_a_frame_do_not_matter(folder: Path) -> None:
    frame = np.load(folder / "frames/dark-000.npy")
    np.save(folder / "frames/dark-000.npy", np.asfortranarray(frame.astype(">u2")))
    recordings = read(folder)
    loaded = recordings.frame(recordings.capture("dark-000"))
    np.testing.assert_array_equal(loaded, frame)
    assert loaded.dtype == np.uint16
    assert loaded.flags.c_contiguous


# --- what is refused: paths -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    [
        "../outside.npy",
        "frames/../../outside.npy",
        "/etc/hostname",
        "C:/frame.npy",
        "frames\\dark-000.npy",
        "",
        "a\0b.npy",
    ],
)
def test_path_that_leaves_the_folder(folder: Path, path: str) -> None:
    np.save(folder.parent / "outside.npy", np.zeros((24, 32), np.uint16))
    edit(folder, lambda m: m["captures"][0].update(frame=path))
    only(folder, "dark-000")


def test_link_out_of_the_folder(folder: Path) -> None:
    outside = folder.parent / "outside.npy"
    shutil.move(folder / "frames/dark-000.npy", outside)
    (folder / "frames/dark-000.npy").symlink_to(outside)
    only(folder, "frames/dark-000.npy", "leads out of the folder", "copy the file")


def test_linked_folder_and_loop_of_links(folder: Path) -> None:
    shutil.move(folder / "spectra", folder.parent / "spectra")
    (folder / "spectra").symlink_to(folder.parent / "spectra")
    (folder / "frames/dark-000.npy").unlink()
    (folder / "frames/dark-000.npy").symlink_to("dark-000.npy")
    lines = problems(folder)
    assert sum("leads out of the folder" in line for line in lines) == 5  # five spectra are named
    assert sum("dark-000" in line for line in lines) == 1


def test_link_within_the_folder_is_fine_and_so_is_a_linked_set(folder: Path) -> None:
    shutil.move(folder / "frames/dark-000.npy", folder / "frames/first.npy")
    (folder / "frames/dark-000.npy").symlink_to("first.npy")
    (folder.parent / "link").symlink_to(folder)
    assert read(folder.parent / "link").warnings == ()


# --- what is refused: the manifest ------------------------------------------------------------------------------------


def test_folder_or_manifest_missing_or_no_json(folder: Path) -> None:
    assert "no such folder" in problems(folder.parent / "nowhere")[0]
    (folder / "manifest.json").write_text("{")
    only(folder, "manifest.json", "isn't JSON")
    (folder / "manifest.json").write_text("[]")
    only(folder, "isn't a JSON object")
    (folder / "manifest.json").unlink()
    only(folder, "manifest.json", "it has no manifest.json")


def test_another_version(folder: Path) -> None:
    edit(folder, lambda m: m.update(version=2))
    only(folder, "version 2", "'calibench-recording' 1")


def test_everything_wrong_with_a_manifest_is_named_at_once(folder: Path) -> None:
    def spoil(manifest: dict[str, Any]) -> None:
        captures = manifest["captures"]
        captures[1]["exposure_s"] = -1
        del captures[2]["frame"]
        captures[3]["side"] = "top"
        captures[4]["exposure_s"] = float("nan")
        captures.append(17)
        manifest["cameras"]["left"]["rows"] = 0
        manifest["cameras"]["right"]["cfa"] = "XTRANS"

    edit(folder, spoil)
    lines = problems(folder)
    assert len(lines) == 7
    for word in ("exposure_s", "'frame' is missing", "side", "captures[40]", "left.rows", "right.cfa"):
        assert any(word in line for line in lines), word


def test_duplicate_id_and_capture_of_a_camera_that_is_not_there(folder: Path) -> None:
    edit(folder, lambda m: m["captures"][1].update(id="dark-000"))
    only(folder, "'dark-000' is used 2 times")
    edit(folder, lambda m: m["captures"][1].update(id="flat-001") or m["cameras"].pop("right"))
    lines = problems(folder)
    assert len(lines) == 20  # every capture of the right side
    assert all("no camera 'right'" in line for line in lines)


@pytest.mark.parametrize(
    ("kind", "change", "word"),
    [
        ("slanted_edge", {"region": [2, 2, 22, 33]}, "isn't inside the frame"),
        ("slanted_edge", {"region": [22, 2, 2, 30]}, "isn't inside the frame"),
        ("chart", {"corners": [[2, 2], [2, 29], [21, 40], [21, 2]]}, "outside the frame"),
        ("charuco", {"marker_mm": None}, "marker_mm"),
        ("charuco", {"marker_mm": 25.0}, "don't fit"),
        ("narrowband", {"radiance": None}, "radiance"),
        ("narrowband", {"wavelength_nm": 0}, "wavelength_nm"),
    ],
)
def test_capture_that_contradicts_itself(folder: Path, kind: str, change: dict[str, Any], word: str) -> None:
    edit(folder, lambda m: next(c for c in m["captures"] if c["kind"] == kind).update(change))
    only(folder, kind, word)


def test_a_narrowband_light_that_lies_off_its_name_is_remarked_on(folder: Path) -> None:
    def call_it(wavelength_nm: float) -> None:
        def change(manifest: dict[str, Any]) -> None:
            for capture in manifest["captures"]:
                if capture["kind"] == "narrowband":
                    capture["wavelength_nm"] = wavelength_nm

        edit(folder, change)

    assert not any("narrowband" in line for line in read(folder).warnings)
    call_it(554.0)  # within 3 nm and a quarter of the 10 nm
    assert not any("narrowband" in line for line in read(folder).warnings)
    call_it(556.0)
    assert [line for line in read(folder).warnings if "1 narrowband lights are centred elsewhere" in line]


def test_one_remark_on_several_captures_is_one_warning(folder: Path) -> None:
    flats = [capture.id for capture in read(folder).captures(FlatCapture)]
    edit(folder, lambda m: [c.update(radiance=None) for c in m["captures"] if c["kind"] == "flat"])
    (warning,) = (line for line in read(folder).warnings if "no sensitivity" in line)
    assert f": {len(flats)} captures ({flats[0]}, " in warning


@pytest.mark.parametrize(("square_mm", "place"), [(0.025, "below"), (0.1016, "below"), (25400.0, "above")])
def test_squares_in_another_unit_are_asked_about_where_they_are_read(
    folder: Path, square_mm: float, place: str
) -> None:
    def board(manifest: dict[str, Any]) -> None:
        capture = manifest["captures"][0]
        same = {key: capture[key] for key in ("side", "frame", "exposure_s")}
        more = {"id": "board", "kind": "charuco", "dictionary": "none", "squares": [7, 10], "pose": "a"}
        manifest["captures"].append(same | more | {"square_mm": square_mm})

    edit(folder, board)
    (warning,) = (line for line in read(folder).warnings if "square_mm" in line)
    assert f"{place} the limit" in warning and "give it in mm" in warning


def test_levels_that_contradict_each_other(folder: Path) -> None:
    edit(
        folder, lambda m: m["cameras"]["left"].update(black_level_dn=4095) or m["cameras"]["right"].update(bit_depth=11)
    )
    lines = problems(folder)
    assert any("black_level_dn = 4095" in line for line in lines)
    assert any("white_level_dn = 4095 is above what 11 bits hold" in line for line in lines)


def test_channel_that_the_sensor_has_not(folder: Path) -> None:
    edit(folder, lambda m: m["cameras"]["left"]["quantum_efficiency"].update(Y="spectra/qe_R.csv"))
    only(folder, "channel 'Y'", "RGGB")


# --- writing ----------------------------------------------------------------------------------------------------------


def test_a_refused_set_is_not_written(small_set: Callable[..., RecordingSet], tmp_path: Path) -> None:
    recordings = small_set()
    recordings._files.spectra.pop("spectra/lamp.csv")
    with pytest.raises(RecordingError, match=r"lamp\.csv"):
        write(recordings, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_failure_while_writing_leaves_nothing(
    small_set: Callable[..., RecordingSet], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("lab.formats.recording_set.folder.manifest_json", full)
    with pytest.raises(InputError, match="No space left"):
        write(small_set(), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_not_touched(small_set: Callable[..., RecordingSet], tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    write(small_set(), out)  # an empty one is taken
    with pytest.raises(InputError, match="already exists"):
        write(small_set(), out)


def test_a_set_whose_paths_leave_the_folder_is_not_written(tmp_path: Path) -> None:
    camera = {"rows": 2, "cols": 2, "cfa": "MONO", "bit_depth": 8}
    capture = {"id": "a", "kind": "dark", "side": "left", "frame": "../a.npy", "exposure_s": 0.1}
    manifest = Manifest.model_validate({"cameras": {"left": camera}, "captures": [capture]})
    with pytest.raises(InputError, match="leaves the folder"):
        write(RecordingSet(manifest, {"../a.npy": np.zeros((2, 2), np.uint16)}), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


# --- sets that others made --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["foreign_healthy", "foreign_two_effects"])
def test_foreign_sets_are_read_and_survive_a_copy(name: str, tmp_path: Path) -> None:
    if not (DATA / name).is_dir():
        pytest.skip("the shared data are not here")
    before = read(DATA / name)
    after = read(write(before, tmp_path / "copy"))
    assert after.manifest == before.manifest
    for capture in before.captures():
        np.testing.assert_array_equal(after.frame(capture), before.frame(capture))


def test_joined_sets_keep_apart_what_they_name_alike(small_set: Callable[..., RecordingSet]) -> None:
    """A set joined to itself with other frames: the later ids, paths and poses begin with the folder."""
    first = small_set()
    later = first.with_frames({c.frame: np.full_like(first.frame(c), 7) for c in first.captures()})
    both = first.joined(later, "resolve")
    n = len(first.captures())
    assert [c.id for c in both.captures()] == [c.id for c in first.captures()] + [
        f"resolve/{c.id}" for c in first.captures()
    ]
    for old, new in zip(first.captures(), both.captures()[n:], strict=True):
        np.testing.assert_array_equal(both.frame(both.capture(old.id)), first.frame(old))
        assert np.all(both.frame(new) == 7)
        told = old.model_dump(exclude_unset=True)
        for key in ("radiance", "light_radiance"):
            if told.get(key) is not None:
                assert both.spectrum(getattr(new, key)) == first.spectrum(told[key])
        if "screen" in told:
            assert new.screen.pose == f"resolve/{old.screen.pose}"


@pytest.mark.parametrize(
    ("key", "value", "limit"),
    [("f_number", 0.3, "0.5"), ("pixel_pitch_um", 0.00345, "0.1 um"), ("focal_length_mm", 0.008, "0.1 mm")],
)
def test_a_stated_value_that_no_camera_has_is_refused(folder: Path, key: str, value: float, limit: str) -> None:
    """Before it meets a model's own limits: an f-number of a lens faster than f/0.5, a pitch in mm, a length in m."""
    edit(folder, lambda manifest: manifest["cameras"]["left"].update({key: value}))
    found = problems(folder)
    assert any(f"{key} = {value:g}" in line and f"is below the limit of {limit}" in line for line in found)


# --- summaries --------------------------------------------------------------------------------------------------------


def test_a_summary_is_made_once_and_goes_with_frames_and_manifest(small_set: Callable[..., RecordingSet]) -> None:
    one, made = small_set(), []

    def summary() -> float:
        made.append(1)
        return float(one.frame(one.captures()[0]).mean())

    assert one.once(("mean", "left"), summary) == one.once(("mean", "left"), summary)
    one.let_go()
    one.once(("mean", "left"), summary)
    assert len(made) == 1
    for same in (pickle.loads(pickle.dumps(one)), one.for_one_of(2)):
        assert same.summaries == one.summaries
    for other in (one.under(one.manifest), one.without(["none"]), one.with_frames({})):
        assert other.summaries.of_manifest == {}
    other.keep(one.summaries)
    assert other.once(("mean", "left"), summary) == one.once(("mean", "left"), summary)
    assert len(made) == 1


def test_a_summary_of_frames_alone_holds_whatever_is_stated(small_set: Callable[..., RecordingSet]) -> None:
    one, made = small_set(), []

    def summary(of: RecordingSet) -> float:
        return of.once("frames", lambda: made.append(1) or 7.0, whatever_is_stated=True)

    assert summary(one) == 7.0
    for same in (one.under(one.manifest), one.without(["none"]), pickle.loads(pickle.dumps(one))):
        assert summary(same) == 7.0
    assert len(made) == 1
    assert one.with_frames({}).summaries == Summaries()


def test_a_summary_that_frames_do_not_determine_is_refused_again(small_set: Callable[..., RecordingSet]) -> None:
    one, tried = small_set(), []

    def refused() -> None:
        tried.append(1)
        raise NotDetermined("boards", "no board in any frame")

    for _ in range(2):
        with pytest.raises(NotDetermined, match="boards: no board in any frame"):
            one.once("boards", refused)
    assert len(tried) == 1
    assert pickle.loads(pickle.dumps(one)).summaries == Summaries()


# --- frames with masked pixels and overscan ---------------------------------------------------------------------------

MARGINS = {"masked_rows": [2, 0], "overscan_rows": [0, 3], "overscan_cols": [0, 4]}


def _with_margins(small_set: Callable[..., RecordingSet], margins: dict[str, Any]) -> RecordingSet:
    """Return the small set whose frames have margins of code 5 around the same images."""
    plain = small_set()
    document = plain.manifest.model_dump(mode="json", exclude_unset=True)
    for camera in document["cameras"].values():
        camera["margins"] = margins
    manifest = Manifest.model_validate(document)
    sheet = manifest.cameras["left"]
    frames = {c.frame: sheet.margins.surround(plain.frame(c), 5, 5) for c in plain.captures()}
    return plain.under(manifest).with_frames(frames)


def test_a_frame_is_its_active_area_and_the_whole_is_kept(
    small_set: Callable[..., RecordingSet], tmp_path: Path
) -> None:
    plain, wide = small_set(), _with_margins(small_set, MARGINS)
    again = read(write(wide, tmp_path / "set"))
    assert again.warnings == ()
    assert json.loads((tmp_path / "set" / "manifest.json").read_text())["cameras"]["left"]["margins"] == MARGINS
    for capture in plain.captures():
        np.testing.assert_array_equal(again.frame(capture), plain.frame(capture))
        whole = again.whole_frame(capture)
        assert whole.shape == again.camera(capture.side).frame_shape
        assert np.all(whole[-3:] == 5)
        assert np.all(whole[:, -4:] == 5)
        assert again.codes(capture).every.mean_dn == plain.codes(capture).every.mean_dn


def test_a_frame_without_its_margins_is_the_active_area(small_set: Callable[..., RecordingSet]) -> None:
    plain = small_set()
    wide = _with_margins(small_set, MARGINS).with_frames({c.frame: plain.frame(c) for c in plain.captures()})
    capture = plain.captures()[0]
    np.testing.assert_array_equal(wide.whole_frame(capture), plain.frame(capture))


def test_frames_of_another_shape_and_margins_that_shift_the_mosaic_are_refused(
    small_set: Callable[..., RecordingSet],
) -> None:
    wide = _with_margins(small_set, MARGINS)
    capture = wide.captures()[0]
    off = wide.with_frames({capture.frame: wide.whole_frame(capture)[1:]})
    with pytest.raises(InputError, match=r"with the margins; recapture, or correct rows and cols, or margins"):
        off.frame(capture)
    with pytest.raises(ValueError, match="1 rows and 0 columns before the active area shift the colour filters"):
        _with_margins(small_set, {"masked_rows": [1, 0]})
