"""The experiment of transfers: what it draws, and what its page says. One whole camera takes minutes: it is slow."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from lab.challenge.draw import recordings_of
from lab.challenge.transfers import (
    TRANSFERS,
    CameraRun,
    TransferRun,
    case_names,
    concealed_camera,
    drawing,
    laws_of,
    run_all,
    run_case,
    section,
    write_lens,
)
from lab.challenge.truth import store
from lab.errors import InputError
from lab.twin import score as twin_score
from lab.twin.changes import Changes
from lab.twin.predict import predict
from mocks.former import Plan
from tests.lab.twin.test_twin import PLAN, captured, trained


def test_eight_cameras_of_each_kind_conceal_none_one_and_two_laws() -> None:
    names = case_names()
    assert len(set(names)) == 32
    for name in names:
        laws = laws_of(name)
        assert all(law.strength <= (0.6 if name.startswith("weak") else 1.0) * law.nominal for law in laws)
        assert (
            len({law.name for law in laws}) == {"healthy": 0, "single": 1, "double": 2, "weak": 1}[name.split("-")[0]]
        )
    assert [law.name for law in laws_of("double-3", 9)] != [law.name for law in laws_of("double-3", 10)]


@pytest.mark.parametrize("name", TRANSFERS)
def test_a_transfer_changes_the_camera_as_the_twin_is_told(name: str) -> None:
    """What is requested stays (exposures but for the factor, ids), and flats fill the camera as before."""
    transfer = TRANSFERS[name]
    plan = Plan(kinds=("dark", "flat"), lamp="led", repeats=1)
    camera = concealed_camera("healthy-2")
    before = recordings_of(camera, plan)
    after = recordings_of(concealed_camera("healthy-2", 1, **transfer.camera), replace(plan, **transfer.plan))
    longer = transfer.changes.exposure_factor or 1.0
    for a, b in zip(before.captures(side="left"), after.captures(side="left"), strict=True):
        assert a.id == b.id
        assert b.exposure_s == pytest.approx(longer * a.exposure_s, rel=1e-5)
    ratio = []
    for a, b in zip(before.captures("flat", "left"), after.captures("flat", "left"), strict=True):
        levels = [float(r.frame(c).mean()) - camera.black_level_dn for r, c in ((before, a), (after, b))]
        ratio.append(levels[1] / levels[0])
    m = camera.focal_length_mm / (150.0 - camera.focal_length_mm)
    # a near scene is dimmer by (1 + 4 N^2) / (1 + 4 N^2 (1 + m)^2); a lamp of another colour fills the brightest alike
    wanted = 65.0 / (1.0 + 64.0 * (1.0 + m) ** 2) if "mm" in name else 1.0
    assert np.median(ratio) == pytest.approx(wanted, rel=0.3 if "tungsten" in name else 0.01)


def _run(case: str, away: float) -> CameraRun:
    one = TransferRun(
        deviations={"chart": (away, -away), "slanted_edge": (0.001, 0.002)},
        inside={"chart": (away < 0.5, True), "slanted_edge": (True, True)},
        chi2_of={"chart": 2.0, "slanted_edge": 2.0},
        chi2=4.0,
        chi2_before=400.0,
        n=4,
    )
    right = laws_of(case)[0].effect if laws_of(case) else None
    tests = [
        twin_score.TestedEffect(
            side="left", name="defocus", effect="defocus", gain=-9.0, before=0.9, verdict="withdrawn"
        )
    ]
    if right:
        tests.append(
            twin_score.TestedEffect(
                side="left", name="a_family", effect="coma", gain=9.0, before=0.4, verdict="named", becomes=right
            )
        )
    return CameraRun(
        case=case,
        concealed=tuple(law.name for law in laws_of(case)),
        told=("defocus",),
        tested=tuple(tests),
        transfers={"f/4 to f/8": one},
    )


def test_the_page_counts_deviations_intervals_and_names(tmp_path: Path) -> None:
    runs = {case: _run(case, away) for case, away in (("healthy-1", 0.2), ("single-1", 0.8))}
    text = section(runs)
    assert "2 of 32 cameras (1 of 8 healthy, 1 of 8 single, 0 of 8 double, 0 of 8 weak)" in text
    assert "| patches of the chart | 0.5 % | 0.5 % | 0.8 % | 1 % | 75.0 % | 90 to 98 % |" in text
    assert "Families: 1, of which 1 became a name, 1 of them the right one." in text
    assert "Names: 2, 2 of them wrong, of which 2 were withdrawn;" in text
    assert "| f/4 to f/8 | 1.00 | 0 | 2 of 2 |" in text
    ElementTree.fromstring(drawing(runs))
    for case, run in runs.items():
        store(run, tmp_path / "results" / f"{case}.json")
    assert run_all(tmp_path, ["healthy-1", "single-1"], 4177) == runs
    with pytest.raises(InputError, match="is of seed 4177, not 5"):
        run_all(tmp_path, ["healthy-1"], 5)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_healthy_camera_is_predicted_within_what_is_wanted() -> None:
    run = run_case("healthy-2", 4178)
    assert not run.failed
    for transfer in run.transfers.values():
        inside = [one for values in transfer.inside.values() for one in values]
        # of some 300 numbers with common errors: 95 % within four standard deviations of 100 effective ones
        assert np.mean(inside) > 0.95 - 4.0 * np.sqrt(0.95 * 0.05 / 100.0)
        assert transfer.chi2 < 1.5 * transfer.n


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_prediction_of_a_lens_by_its_file_is_scored_with_that_lens_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CALIBENCH_CACHE", str(tmp_path / "cache"))
    changes = Changes(lens=write_lens(tmp_path, 8.0), radiance_factor=4.0)
    prediction = predict({"left": trained(1)}, PLAN, changes, light_std=0.0)
    aperture = Changes(f_number=8.0, radiance_factor=4.0)
    found = twin_score.score(prediction, captured(aperture, 7))
    scores = {q.quantity: q for q in found.quantities}
    assert found.missing == 0
    # 95 % of 144 patches within four standard deviations; of edges, coma of the lens off its axis costs some 0.01
    assert scores["chart"].within_95_percent_interval > 0.95 - 4.0 * np.sqrt(0.95 * 0.05 / 144.0)
    assert scores["slanted_edge"].largest_of_95_percent < 0.02
    shutil.rmtree(tmp_path / "cache")
    write_lens(tmp_path, 8.5)
    with pytest.raises(InputError, match="isn't the traced lens that was sealed"):
        twin_score.score(prediction, captured(aperture, 7))
