"""Sealed cases: nothing in a set reveals its truth, seals can't be changed, a run can be resumed, seeds are kept
apart."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from evaluation.__main__ import main
from evaluation.blind import BlindProof
from evaluation.calibrate import DEFAULT, answers
from evaluation.draw import FAULTS, FOREIGN_BITS, FOREIGN_FRAMES, SHARES, DrawnFrame, draw, kind_of
from evaluation.independent_simulator import LISTED, OUTSIDE
from evaluation.make import make
from evaluation.score import broken_seals, score
from evaluation.truth import (
    FIRST_PROOF_SEED,
    CaseTruth,
    Concealed,
    SaltedTruth,
    Seals,
    Truths,
    canonical,
    load,
    salted,
    seal,
    store,
)
from lab.diagnose import DecisionPolicy
from lab.errors import InputError
from lab.formats import recording_set as recording
from lab.formats.results import DiagnosisResult
from lab.workers import Workers

#: Two cases of these kinds in a row: the quickest to draw.
SEED = next(s for s in range(1000) if (kind_of(s, 1), kind_of(s, 2)) == ("healthy", "healthy"))


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("sealed")
    folder, truths = root / "sets", root / "truths.json"
    options = {"--cases": 2, "--seed": SEED, "--truths": truths, "--size": "small", "--jobs": 1, "--cfa": "MONO"}
    words = [str(word) for option in options.items() for word in option]
    assert main(["make", "--out", str(folder), *words]) == 0
    return folder, truths


@pytest.fixture
def copy(sealed: tuple[Path, Path], tmp_path: Path) -> tuple[Path, Seals, Truths]:
    shutil.copytree(sealed[0], tmp_path / "sets")
    return tmp_path / "sets", load(Seals, tmp_path / "sets" / "seals.json"), load(Truths, sealed[1])


def test_seals_hold_and_break_when_anything_is_changed(copy: tuple[Path, Seals, Truths]) -> None:
    folder, seals, truths = copy
    assert broken_seals(folder, seals, truths) == ()
    case = truths.truths["case-0001"]
    other = case.truth.model_copy(update={"kind": "single"})
    for changed in (case.model_copy(update={"truth": other}), case.model_copy(update={"salt": "0" * 32})):
        bent = truths.model_copy(update={"truths": truths.truths | {"case-0001": changed}})
        assert broken_seals(folder, seals, bent) == ("case-0001",)
    resealed = Seals(seals=seals.seals | {"case-0002": "0" * 64})
    assert broken_seals(folder, resealed, truths) == ("case-0002",)
    file = folder / "case-0002" / "frames" / "0003.npy"
    frame = np.load(file)
    frame[0, 0] ^= 1
    np.save(file, frame)
    assert broken_seals(folder, seals, truths) == ("case-0002",)
    fewer = truths.model_copy(update={"truths": {"case-0001": case}})
    assert broken_seals(folder, seals, fewer) == ("case-0002",)


def test_a_seal_needs_its_salt() -> None:
    truth = CaseTruth(kind="healthy", cfa="MONO", f_number=2.8, frames=88, rows=96, cols=128)
    one, two = salted(truth), salted(truth)
    assert seal(one) != seal(two)
    assert seal(one) == seal(SaltedTruth(salt=one.salt, truth=CaseTruth.model_validate_json(canonical(truth))))


def test_nothing_in_a_set_betrays_its_truth(sealed: tuple[Path, Path]) -> None:
    folder, _ = sealed
    words = {kind.name for kind in (*LISTED, *OUTSIDE)} | {fault.name for fault in FAULTS}
    words |= {"healthy", "single", "compound", "outside", "seed", "salt", "truth", "variant", "noncentrality"}
    paths = sorted(folder.rglob("*"))
    texts = [p for p in paths if p.suffix in {".json", ".csv"}]
    for path in texts:
        text = path.read_text()
        assert not [w for w in words if w in text], path
    assert {p.stat().st_mtime for p in paths if "case" in str(p.relative_to(folder))} == {1_772_442_000.0}
    names = [
        sorted(p.relative_to(folder / c).as_posix() for p in (folder / c).rglob("*"))
        for c in ("case-0001", "case-0002")
    ]
    assert all(name.startswith(("frames", "spectra", "targets", "manifest.json")) for one in names for name in one)
    assert set(json.loads((folder / "seals.json").read_text())) == {"format", "version", "seals"}


def test_a_set_with_a_law_has_the_form_of_a_healthy_one() -> None:
    """The same keys, names and exposures of every kind of capture, whatever is concealed."""
    forms = []
    for kind, law in (("healthy", None), ("outside", OUTSIDE[0])):
        case = draw(3, 2, "small", cfa="MONO", kind=kind, law=law, sizing="unmeasured")  # type: ignore[arg-type]
        manifest = json.loads(recording.manifest_json(case.recordings.manifest))
        assert manifest["name"] == "camera"
        form = {(c["kind"], c["exposure_s"], c.get("radiance"), *sorted(c)) for c in manifest["captures"]}
        forms.append({f for f in form if f[0] in {"dark", "flat", "narrowband"}})
    assert forms[0] == forms[1]


def test_the_mix_is_the_stated_one() -> None:
    for block in range(3):
        kinds = [kind_of(77, 20 * block + i) for i in range(1, 21)]
        assert {k: kinds.count(k) for k in set(kinds)} == dict(SHARES)


def test_a_case_is_drawn_again_alike() -> None:
    one, two = (draw(9, 1, "small", kind="single", law=LISTED[0], cfa="MONO", sizing="nominal") for _ in range(2))
    assert one.truth == two.truth
    assert all(
        np.array_equal(one.recordings.frame(c), two.recordings.frame(c)) for c in one.recordings.captures()[::20]
    )
    # the simulator's own figure of how much it shows: a split of 1.5 um can't be missed on edges
    assert one.truth.concealed[0].noncentrality > 25.0


def test_foreign_frames_are_of_all_sizes_and_depths() -> None:
    """Of 200 frames: every size, every depth, and a third with aligned cells (+- 4 sigma of a binomial)."""
    frames = [DrawnFrame.drawn(np.random.default_rng([3, index, 2])) for index in range(200)]
    assert {(f.rows, f.cols) for f in frames} == set(FOREIGN_FRAMES)
    assert {f.bit_depth for f in frames} == set(FOREIGN_BITS)
    aligned = [f for f in frames if f.screen_turn_deg == 0.0]
    assert abs(len(aligned) / 200 - 1 / 3) < 4.0 * np.sqrt(2 / 9 / 200)
    assert all(f.screen_cell_px.is_integer() for f in aligned)
    assert all(2.0 <= f.screen_cell_px <= 6.0 and 0.0 <= f.screen_turn_deg <= 2.0 for f in frames)
    index = next(k for k, frame in enumerate(frames) if frame.rows == 24)
    case, expected = draw(3, index, "foreign", kind="healthy", sizing="unmeasured"), frames[index]
    camera = case.recordings.camera("left")
    assert (camera.rows, camera.cols, camera.bit_depth) == (expected.rows, expected.cols, expected.bit_depth)


def test_an_interrupted_one_goes_on(copy: tuple[Path, Seals, Truths], tmp_path: Path) -> None:
    folder, seals, truths = copy
    file = tmp_path / "truths.json"
    store(truths.model_copy(update={"truths": {"case-0001": truths.truths["case-0001"]}}), file)
    before = (folder / "case-0001" / "manifest.json").read_bytes()
    again = make(folder, 2, SEED, file, "small", Workers(), cfa="MONO")
    assert (folder / "case-0001" / "manifest.json").read_bytes() == before
    # drawn anew it is the same set, under a new salt
    assert again.truths["case-0002"].truth == truths.truths["case-0002"].truth
    assert broken_seals(folder, load(Seals, folder / "seals.json"), again) == ()
    assert load(Seals, folder / "seals.json").seals["case-0001"] == seals.seals["case-0001"]


def test_truths_beside_the_recordings_and_mixed_cases_are_refused(sealed: tuple[Path, Path], tmp_path: Path) -> None:
    folder, file = sealed
    with pytest.raises(InputError, match="outside it"):
        make(tmp_path / "a", 1, 1, tmp_path / "a" / "truths.json", "small", Workers())
    with pytest.raises(InputError, match="another seed"):
        make(folder, 2, SEED + 1, file, "small", Workers())
    with pytest.raises(InputError, match="isn't empty"):
        make(folder, 2, SEED, tmp_path / "none.json", "small", Workers())
    with pytest.raises(InputError, match="take one of small"):
        make(tmp_path / "b", 1, 1, tmp_path / "t.json", "huge", Workers())


def test_a_case_that_fails_does_not_end_the_run(copy: tuple[Path, Seals, Truths]) -> None:
    folder, seals, truths = copy
    (folder / "case-0001" / "manifest.json").write_text("{")
    proof = BlindProof(folder, ("case-0001", "case-0002"))
    runs = proof.run(folder)
    assert runs["case-0001"].error is not None
    assert runs["case-0001"].diagnosis is None
    assert isinstance(runs["case-0002"].diagnosis, DiagnosisResult)
    assert runs["case-0002"].memory_mib > 50
    # results are kept: nothing is diagnosed a second time
    written = (folder / "results" / "case-0002.json").read_bytes()
    assert proof.run(folder) == runs
    assert (folder / "results" / "case-0002.json").read_bytes() == written
    found = score(truths, seals, runs, broken_seals(folder, seals, truths))
    assert found.broken_seals == ("case-0001",)
    assert found.cases == 1
    assert not found.reached
    # the same decisions, taken under several policies at once, say the same
    told = answers(folder / "case-0002", {DEFAULT: DecisionPolicy()})[DEFAULT]
    diagnosis = runs["case-0002"].diagnosis
    assert set(told.named) == {e.name for e in diagnosis.effects}
    assert told.mismatch == (diagnosis.verdict != "no_mismatch")


def test_seeds_of_tuning_and_of_proofs_are_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "c"), "--cases", "1", "--size", "small"]
    assert main(["make", *out, "--seed", str(FIRST_PROOF_SEED)]) == 2
    assert "--proof" in capsys.readouterr().err
    assert main(["make", *out, "--seed", "12", "--proof"]) == 2
    assert "for tuning" in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


def test_a_scored_proof_seed_is_refused(tmp_path: Path) -> None:
    from evaluation.page import refuse_scored

    page = tmp_path / "proof.md"
    page.write_text("| for | seed |\n| proof | 1000007 | 200 | medium | `ab` |\n")
    refuse_scored(1000008, page)
    with pytest.raises(InputError, match="scored already"):
        refuse_scored(1000007, page)


def test_a_truth_s_names_are_those_of_the_list() -> None:
    hidden = Concealed(name="motion", strength=1.0, noncentrality=30.0)
    truth = CaseTruth(kind="outside", concealed=(hidden,), cfa="MONO", f_number=2.8, frames=1, rows=8, cols=8)
    assert truth.names == ()
