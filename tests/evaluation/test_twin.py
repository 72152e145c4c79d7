"""The experiment of transfers: what it draws, and what its page says. One whole camera takes minutes: it is slow."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from evaluation.budgets import BudgetCheck, check_budget
from evaluation.draw import recordings_of
from evaluation.independent_simulator import WAVELENGTH_NM, ConcealedCamera, Plan
from evaluation.truth import store
from evaluation.twin import (
    DARK_LAW,
    TRANSFERS,
    CameraRun,
    TransferRun,
    TwinProof,
    budget_names,
    case_names,
    concealed_camera,
    drawing,
    laws_of,
    run_case,
    section,
    write_lens,
)
from lab.errors import InputError
from lab.formats.camera_file import CameraFile
from lab.formats.model_posterior import ModelPosterior
from lab.twin import score as twin_score
from lab.twin.changes import Changes
from lab.twin.predict import predict
from sim.camera import CameraModel, Lens
from sim.effects.dark_current_temperature import DarkCurrentTemperature
from sim.spectrum import Spectrum
from tests.lab.twin.test_budget import FIRST
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
    sure = BudgetCheck(
        use="MTF50", stated={"defocus": 2.0, "gain": 0.1}, found={"defocus": 1.0, "gain": 0.1}, std_percent=2.0,
        error_percent=1.0, probability=0.97,
    )  # fmt: skip
    doubtful = sure.model_copy(update={"use": "patches", "found": {"defocus": 0.1, "gain": 5.0}, "probability": 0.5,
                                       "error_percent": 5.0})  # fmt: skip
    return CameraRun(
        case=case,
        budget=(sure, doubtful),
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
    assert "Families: 1, of which 1 (100 %) became a name, 1 of them the right one; wanted: 80 %." in text
    assert "Names: 2, 2 of them wrong, of which 2 were withdrawn;" in text
    assert "| f/4 to f/8 | 1.00 | 0 | 2 of 2 |" in text
    assert "| MTF50 | 2 | 100 % | 97 % | 2 | 100 % | 90 % | 100 % |" in text
    assert "| patches | 2 | 0 % | 50 % | 0 | - | 90 % | 0 % |" in text
    assert "| all | 4 | 50 % | 74 % | 2 | 100 % | 90 % | 50 % |" in text
    ElementTree.fromstring(drawing(runs))
    for case, run in runs.items():
        store(run, tmp_path / "results" / f"{case}.json")
    assert TwinProof(4177).run(tmp_path, ["healthy-1", "single-1"]) == runs
    with pytest.raises(InputError, match="is of seed 4177, not 5"):
        TwinProof(5).run(tmp_path, ["healthy-1"])


def test_a_case_for_the_budget_alone_is_no_camera_of_the_transfers() -> None:
    assert len(set(budget_names())) == 18 and not set(budget_names()) & set(case_names())
    assert {len(laws_of(case)) for case in budget_names()} == {1, 2}
    one = _run("single-9", 0.2).model_copy(update={"transfers": {}, "tested": ()})
    assert section({"single-9": one}).startswith("0 of 32 cameras") and "| MTF50 | 1 | 100 % |" in section({"9": one})


def _fitted(truth: ConcealedCamera, std: dict[str, float], **wrong: float) -> CameraFile:
    """The model of a simulated camera as it is, but for what is `wrong`, with a posterior of `std`."""
    curves = {c: Spectrum.of(WAVELENGTH_NM, q) for c, q in truth.quantum_efficiency.items()}
    camera = CameraModel(
        rows=truth.rows, cols=truth.cols, pixel_pitch_um=truth.pitch_um, fill_factor=truth.fill_factor, cfa=truth.cfa,
        bit_depth=12, black_level_dn=truth.black_level_dn, white_level_dn=4095.0,
        conversion_gain_dn_per_e=truth.gain_dn_per_e, full_well_e=truth.full_well_e,
        read_noise_e=truth.read_noise_e, dark_current_e_per_s=truth.dark_e_per_s, dark_current_reference_c=25.0,
        dsnu_e=1.0, prnu_percent=0.5, quantum_efficiency=curves,
        lens=Lens(f_number=truth.f_number, focal_length_mm=truth.focal_length_mm),
    )  # fmt: skip
    effects = (DarkCurrentTemperature(doublings_per_c=wrong.pop("doublings_per_c", 0.13)),)
    posterior = ModelPosterior.of(FIRST, tuple(std), np.zeros(len(std)), np.diag(np.square(list(std.values()))))
    return CameraFile("fitted", camera.model_copy(update=wrong), effects, posterior=posterior)


def test_a_budget_is_held_against_what_its_parameters_are_wrong_by() -> None:
    """Doublings that are 0.01 a degree off make ten degrees' dark signal wrong by 10 ln 2 x 0.01, one at the reference
    not: rms over the two. The budget's first is the truth's where the largest error is its largest doubt."""
    truth = concealed_camera("healthy-1", f_number=4.0)
    name = "dark_current_temperature.doublings_per_c"

    def dark(std: dict[str, float], **wrong: float) -> BudgetCheck:
        return {one.use: one for one in check_budget(_fitted(truth, std, **wrong), truth, truth.laws)}["dark mean"]

    first = dark({name: 0.02, "dark": 0.01}, doublings_per_c=0.14)
    wanted = 100.0 * 0.01 * 10.0 * np.log(2.0) / np.sqrt(2.0)
    # a derivative in place of a difference of 7 %
    assert first.found["dark_current_temperature"] == pytest.approx(wanted, rel=0.04)
    assert first.found["dark"] == pytest.approx(0.0, abs=1e-9)
    assert first.is_first and first.probability > 0.9
    assert first.stated["dark_current_temperature"] == pytest.approx(2.0 * wanted, rel=0.08)
    brighter = dark({name: 0.02, "dark": 0.01}, dark_current_e_per_s=1.1 * truth.dark_e_per_s)
    assert not brighter.is_first and brighter.found["dark"] == pytest.approx(100.0 / 11.0, rel=0.01)


def test_a_size_that_the_law_has_no_parameter_for_is_left_out() -> None:
    """The quadratic form of the concealed law has no doubling: its contribution is compared with nothing."""
    dark = DARK_LAW(1.3, 1, 5)
    truth = concealed_camera("healthy-1", f_number=4.0)
    name = "dark_current_temperature.doublings_per_c"
    checks = check_budget(_fitted(truth, {name: 0.02, "dark": 0.01}), truth, [dark])
    assert not dark.library_parameters() and "dark mean" not in {one.use for one in checks}


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
