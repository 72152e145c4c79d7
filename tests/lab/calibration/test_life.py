"""A calibration's life: candidate, certified, superseded, expired; bands, drift, and sessions that demand a certified
one."""

from __future__ import annotations

import math
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import get_args, get_origin

import numpy as np
import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from pydantic import ValidationError
from scipy import stats

from lab.calibration import life
from lab.calibration.limits import CalibrationLimits, Figure, Limit, figures_of, judge_figures, read_limits
from lab.capture.plan import CapturePlan
from lab.capture.records import RunRecord, now
from lab.capture.session import CaptureSession
from lab.capture.store import Store
from lab.capture.tables import Base, CalibrationRow, FigureRow, ResultRow
from lab.capture_kinds.dark import DarkSequence
from lab.cli import main
from lab.errors import InputError
from lab.fit.compare import FALSE_ALARM_RATE, NOT_COMPARED, NOT_COMPARED_FIELDS
from lab.formats.results import CameraFit, FitResult, GeometryFit, MtfCurve, NoiseFit, StereoFit
from lab.formats.results.words import NAMES, plain_name, unit_of
from sim.parameters import Frozen
from tests.lab import fake_bench

DARKS = CapturePlan((DarkSequence(exposures_s=(0.001, 0.1), frames=2),))
STATION = fake_bench.station()
SERIALS = {"left": "L1", "right": "R1"}
STD = 0.01
GEOMETRY = GeometryFit(
    camera_matrix=((2003.1, 0, 320.4), (0, 2003.4, 239.1), (0, 0, 1)),
    camera_matrix_std=((0.4, 0, 0.5), (0, 0.4, 0.5), (0, 0, 0)),
    distortion=(-0.11, 0.08, 0.0, 0.0, 0.0),
    distortion_std=(0.001, 0.004, 1e-5, 1e-5, 0.01),
    rms_px=0.09,
)


def fitted(read_noise_e: float, std: float = STD) -> FitResult:
    noise = NoiseFit(
        read_noise_e=read_noise_e,
        read_noise_e_std=std,
        conversion_gain_dn_per_e=0.4,
        conversion_gain_dn_per_e_std=0.001,
    )
    curve = MtfCurve(
        capture="edge-1", channel="G", frequency_cy_per_px=tuple(np.linspace(0, 0.5, 20)), mtf=(0.5,) * 20,
        mtf_std=(0.01,) * 20, mtf50_cy_per_px=0.25, mtf50_cy_per_px_std=0.002,
        angle_deg=5.0, angle_deg_std=0.01,
    )  # fmt: skip
    return FitResult(
        source="s", cameras={"left": CameraFit(noise=noise, mtf=(curve,)), "right": CameraFit(noise=noise)}
    )


def calibrated(store: Store, read_noise_e: float, serials: dict[str, str] = SERIALS, std: float = STD) -> str:
    """A fitted session of the rig of these serial numbers; the calibration's id."""
    session = store.create_session(STATION, DARKS.steps(STATION))
    identities = {
        f"camera {side}": {"maker": "m", "model": "c", "serial_number": serial, "firmware": ""}
        for side, serial in serials.items()
    }
    store.set_state(session, "finished", run=RunRecord(started=now(), instruments=identities, versions={}))
    return store.add_result("fit", session, fitted(read_noise_e, std).model_dump(mode="json"))


def limits(valid_days: float | None = None, good: tuple[float | None, float | None] = (None, 2.5)) -> CalibrationLimits:
    return CalibrationLimits(
        valid_days=valid_days, limit=(Limit(figure="noise read_noise_e", good=good, warn=(None, 3.0)),)
    )


def test_figures_are_all_numbers_with_an_uncertainty_but_curves() -> None:
    found = {(figure.side, figure.name): figure for figure in figures_of(fitted(2.0))}
    assert found["left", "noise read_noise_e"].value == 2.0 and found["left", "noise read_noise_e"].std == STD
    assert found["left", "mtf edge-1 G mtf50_cy_per_px"].value == 0.25
    assert not any(name.endswith(" mtf") for _, name in found)


@pytest.mark.parametrize(
    ("value", "std", "mark"),
    [
        (2.0, 0.01, "good"),
        (2.5, 0.0, "good"),
        (2.49, 0.01, "warn"),  # 2.49 + 2 x 0.01 > 2.5: not proven to be within the good band
        (2.47, 0.01, "good"),
        (2.7, 0.1, "warn"),
        (2.99, 0.01, "bad"),
        (3.1, 0.0, "bad"),
        (0.5, 0.0, "bad"),
    ],
)
def test_a_figure_is_judged_with_its_uncertainty(value: float, std: float, mark: str) -> None:
    limit = Limit(figure="noise *", side="left", good=(1.0, 2.5), warn=(0.9, 3.0))
    figure = Figure(name="noise read_noise_e", side="left", value=value, std=std)
    assert [one.mark for one in judge_figures((figure,), CalibrationLimits(limit=(limit,)))] == [mark]
    other = figure.model_copy(update={"side": "right"})
    assert [one.mark for one in judge_figures((other,), CalibrationLimits(limit=(limit,)))] == ["missing"]


@pytest.mark.parametrize(
    ("good", "warn", "said"),
    [
        ((2.0, 1.0), None, "below"),
        ((1.0, 2.0), (1.5, 3.0), "hold"),
        ((None, None), None, "no end"),
        ((0.0, 1.0), (2.0, 1.0), "below"),
    ],
)
def test_bands_that_contradict_themselves_are_refused(
    good: tuple[float, float], warn: tuple[float, float], said: str
) -> None:
    with pytest.raises(ValidationError, match=said):
        Limit(figure="x", good=good, warn=warn)


def test_a_life(store: Store) -> None:
    first, second, other = (
        calibrated(store, 2.0),
        calibrated(store, 2.01),
        calibrated(store, 2.0, {"left": "L9", "right": "R1"}),
    )
    assert [one.state for one in life.calibrations(store)] == ["candidate"] * 3
    assert life.calibration(store, first).cameras == {"left": "m c L1", "right": "m c R1"}
    done = life.certify(store, first, "ada", limits(valid_days=30))
    assert (done.state, done.certified_by, len(done.judgements)) == ("certified", "ada", 2)
    assert (
        done.expires is not None and done.certified is not None and done.expires - done.certified == timedelta(days=30)
    )
    with pytest.raises(InputError, match="is certified"):
        life.certify(store, first, "bob", limits())
    life.certify(store, other, "bob", limits())
    assert life.calibration(store, first).state == "certified"  # another rig supersedes nothing
    life.certify(store, second, "bob", limits())
    again = life.calibration(store, first)
    assert (again.state, again.superseded_by) == ("superseded", second)
    with store.transaction() as db:
        db.execute(sa.update(CalibrationRow).values(expires=now() - timedelta(seconds=1)))
    assert [life.calibration(store, id).state for id in (first, second)] == ["superseded", "expired"]
    assert len(life.calibrations(store, limit=2)) == 2 and life.count_calibrations(store) == 3
    assert [one.id for one in life.calibrations(store, after=other)] == [second, first]


def test_what_is_outside_its_limits_isnt_certified(store: Store) -> None:
    bad, near = calibrated(store, 3.5), calibrated(store, 2.6)
    with pytest.raises(
        InputError, match=r"left noise read_noise_e = 3\.5 \+- 0\.01 is bad.*can't be accepted"
    ) as refused:
        life.certify(store, bad, "ada", limits(), accept_warnings=True)
    assert len(str(refused.value).splitlines()) == 2  # a line for each side
    with pytest.raises(InputError, match="is warn"):
        life.certify(store, near, "ada", limits())
    assert life.certify(store, near, "ada", limits(), accept_warnings=True).state == "certified"
    lacking = CalibrationLimits(limit=(Limit(figure="geometry rms_px", good=(None, 0.2)),))
    with pytest.raises(InputError, match="doesn't have it"):
        life.certify(store, bad, "ada", lacking)
    with pytest.raises(InputError, match="isn't known"):
        life.certify(store, "0" * 16, "ada", limits())


def test_drift_is_told_as_compare_tells_it(store: Store) -> None:
    values = [2.0, 2.01, 1.99, 2.2]
    ids = [calibrated(store, value) for value in values]
    found = life.history(store, "m c L1", "noise read_noise_e")
    assert [point.calibration_id for point in found.points] == ids and found.limit is None
    assert [point.drifted for point in found.points] == [False, False, False, True]
    # 0.2 over sqrt(2) x 0.01
    assert found.points[3].significance_sigma == pytest.approx(0.2 / (np.sqrt(2) * STD), rel=1e-6)
    # Certified, the third is the reference; its limits mark the history.
    life.certify(store, ids[2], "ada", limits(good=(None, 2.05)))
    found = life.history(store, "m c L1", "noise read_noise_e")
    assert [point.mark for point in found.points] == ["good", "good", "good", "warn"]
    assert found.points[3].reference_id == ids[2] and found.points[1].reference_id == ids[0]
    assert life.history(store, "m c L1", "noise read_noise_e", limits=limits(good=(None, 2.1))).points[3].mark == "warn"
    for camera, figure in (("m c L2", "noise read_noise_e"), ("m c L1", "noise x")):
        with pytest.raises(InputError, match="no calibration of it"):
            life.history(store, camera, figure)
    assert ("m c L1", "noise read_noise_e", "") in life.figure_names(store)


def test_a_warmer_sensor_is_no_drift_and_a_figure_is_entered_once(store: Store) -> None:
    """Dark currents are compared at the temperature of the reference; a session that is fitted again is one calibration
    of the history."""
    for dark_e_per_s, temperature_c in ((5.0, 31.0), (5.05, 31.1), (5.5, 32.0), (6.5, 31.0)):
        noise = NoiseFit(
            dark_current_e_per_s=dark_e_per_s, dark_current_e_per_s_std=0.005, dark_temperature_c=temperature_c
        )
        document = FitResult(source="s", cameras={"left": CameraFit(noise=noise)}).model_dump(mode="json")
        session = store.create_session(STATION, DARKS.steps(STATION))
        identity = {"maker": "m", "model": "c", "serial_number": "L1", "firmware": ""}
        store.set_state(
            session, "finished", run=RunRecord(started=now(), instruments={"camera left": identity}, versions={})
        )
        for _ in range(2):
            newest = store.add_result("fit", session, document)
    found = life.history(store, "m c L1", "noise dark_current_e_per_s")
    assert [point.drifted for point in found.points] == [False, False, False, True]
    assert [point.temperature_c for point in found.points] == [31.0, 31.1, 32.0, 31.0]
    assert found.points[-1].calibration_id == newest and (found.title, found.unit) == ("dark current", "e/s")


def test_every_figure_has_a_plain_name_and_its_unit() -> None:
    """Every field with a standard deviation that `compare` reads is declared."""
    models = [CameraFit, StereoFit]
    for model in models:
        for name, field in model.model_fields.items():
            inside = [one for one in _models_in(field.annotation) if one not in (*models, *NOT_COMPARED)]
            models += inside
            if f"{name}_std" in model.model_fields and (model, name) not in NOT_COMPARED_FIELDS and not inside:
                assert name in NAMES, (model, name)
    for figure, place, name, unit in (
        ("mtf edge-1 G mtf50_cy_per_px", "", "MTF50, edge-1 G", "cy/px"),
        ("geometry camera_matrix", "fx", "focal length x", "px"),
        ("geometry channels R centre_shift_px", "[0]", "shift of the centre from green [0], R", "px"),
        ("spectral quantum_efficiency R", "", "quantum efficiency, R", "1"),
        ("stereo translation_mm", "x", "stereo translation x", "mm"),
        ("mtf * mtf50_cy_per_px", "", "MTF50, *", "cy/px"),
        ("some thing_e", "", "some thing e", "1"),
    ):
        assert (plain_name(figure, place), unit_of(figure)) == (name, unit)


def _models_in(annotation: object) -> list[type]:
    """The models that a field's type names, but those of its dictionaries: their figures are by channel, and not
    compared."""
    if isinstance(annotation, type) and issubclass(annotation, Frozen):
        return [annotation]
    return [] if get_origin(annotation) is dict else [one for part in get_args(annotation) for one in _models_in(part)]


def test_an_unchanged_camera_rarely_drifts(store: Store) -> None:
    """Over a history of 20, an alarm in one of a hundred cameras. 400 cameras of the binomial law: 4 +- 2 expected, 3
    sigma = 10."""
    rng = np.random.default_rng(5)
    alarms = 0
    threshold = life.sigma_of_probability(life.sidak_part(FALSE_ALARM_RATE, 19))
    kept = {"calibration_id": "x", "created": now(), "certified": None, "superseded": None, "expires": None, "std": STD}
    kept |= {"name": "n", "side": None, "place": "", "temperature_c": None, "doubling_c": None}
    for _ in range(400):
        rows = [SimpleNamespace(value=value, **kept) for value in 2.0 + STD * rng.standard_normal(20)]
        alarms += any(point.drifted for point in life._points(rows, None, threshold))
    assert alarms <= 10


def test_a_session_that_demands_a_certified_calibration_runs_only_with_one(store: Store) -> None:
    bench = fake_bench.Bench()

    def session() -> CaptureSession:
        return CaptureSession.start(
            store, STATION, DARKS, demands_certified=True, connect=bench.drivers, check_certified=life.check_certified
        )

    first = session()
    with pytest.raises(InputError, match="demands a certified calibration, and 0 calibrations"):
        first.run()
    assert store.session(first.id).state == "failed" and not bench.opened
    bench.settings["camera left"] = {"PixelFormat": "BayerRG12", "ExposureTime": 100.0}
    free = CaptureSession.start(store, STATION, DARKS, connect=bench.drivers)
    assert free.run().state == "finished"
    of_it = store.add_result("fit", free.id, fitted(2.0).model_dump(mode="json"))
    with pytest.raises(InputError, match="1 calibrations of it are known, none is certified"):
        session().run()
    life.certify(store, of_it, "ada", limits(valid_days=30))
    assert session().run().state == "finished"
    bench.settings["camera left"] = {"PixelFormat": "BayerRG10", "ExposureTime": 200.0}
    with pytest.raises(
        InputError, match="camera left: PixelFormat was BayerRG12, is BayerRG10: so the certified"
    ) as told:
        session().run()
    assert "\n" not in str(told.value) and "ExposureTime" not in str(told.value)
    bench.settings["camera left"] = {"PixelFormat": "BayerRG12", "ExposureTime": 300.0}
    bench.serials["camera left"] = "SN-2"
    with pytest.raises(InputError, match=f"{of_it}, is of other cameras: left was fake camera left SN-1, is .* SN-2"):
        session().run()
    bench.serials.clear()
    with pytest.raises(InputError, match="nothing here checks it"):
        CaptureSession(store, first.id, connect=bench.drivers).run()
    again = CaptureSession(store, first.id, connect=bench.drivers, check_certified=life.check_certified)
    assert again.run().state == "finished"  # a resumed one is looked at anew
    with store.transaction() as db:
        db.execute(sa.update(CalibrationRow).values(expires=now() - timedelta(days=1)))
    with pytest.raises(InputError, match="expired on"):
        session().run()


def test_an_older_store_gets_its_calibrations(tmp_path: Path) -> None:
    """A registry of the revision before: its sessions stay, and its fits become candidates."""
    from alembic import command
    from alembic.config import Config

    import lab.capture.tables

    store = Store(tmp_path)
    kept = calibrated(store, 2.0)
    config = Config()
    config.set_main_option("script_location", str(Path(lab.capture.tables.__file__).parent / "migrations"))
    with store.transaction() as db:
        config.attributes["connection"] = db.connection()
        command.downgrade(config, "0002")
    store.close()
    again = Store(tmp_path)
    assert [one.id for one in life.calibrations(again)] == [kept] and not again.sessions()[0].demands_certified
    with again.transaction() as db:
        assert compare_metadata(MigrationContext.configure(db.connection()), Base.metadata) == []
    again.close()


def test_from_the_command_line(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CALIBENCH_DATA", str(tmp_path / "data"))
    first, second = calibrated(store, 2.0), calibrated(store, 2.3)

    def said(*arguments: str, code: int = 0) -> str:
        assert main(["calibrations", *arguments]) == code
        found = capsys.readouterr()
        return found.out + found.err

    assert "limits" in said("certify", first, "--by", "ada", code=2)
    file = tmp_path / "data" / "limits.toml"
    file.write_text('valid_days = 90\n[[limit]]\nfigure = "noise read_noise_e"\ngood = [0.0, 2.1]\nwarn = [0.0, 2.5]\n')
    assert read_limits(file).valid_days == 90
    assert f"{first}: certified by ada, 2 figures within limits, until" in said("certify", first, "--by", "ada")
    assert "accept warnings" in said("certify", second, code=2)
    listed = said("list")
    assert "candidate" in listed and "certified" in listed
    assert "warn" in said("show", second) and '"mark": "warn"' in said("show", second, "--json", "-")
    assert "m c L1  noise read_noise_e" in said("history")
    assert "yes" in said("history", "m c L1", "noise read_noise_e", code=4)  # the newest drifted
    file.write_text('[[limit]]\nfigure = "x"\ngood = [2.0, 1.0]\n')
    assert "limits.toml: limit.0" in said("show", second, code=2)


def test_a_revoked_certificate_is_no_reference(store: Store) -> None:
    """The third differs from the second, which was certified and revoked, not from the first."""
    first, second = calibrated(store, 2.0), calibrated(store, 2.4)
    life.certify(store, second, "ada", limits())
    assert life.revoke(store, second, "bob", "a finger on the lens").state == "revoked"
    with pytest.raises(InputError, match="is revoked; only what is certified"):
        life.revoke(store, second, "bob", "again")
    with pytest.raises(InputError, match="is candidate; only what is certified"):
        life.revoke(store, first, "bob", "never was")
    with pytest.raises(InputError, match="is revoked, only a candidate"):
        life.certify(store, second, "ada", limits())
    calibrated(store, 2.0)
    points = life.history(store, "m c L1", "noise read_noise_e").points
    assert [point.reference_id for point in points] == [None, first, first] and not points[2].drifted


def test_key_figures_are_the_first_rows_of_a_board_and_constants_are_none(store: Store) -> None:
    """Of a camera matrix, the focal lengths and the principal point; also of calibrations that an earlier version
    registered with the matrix's constants."""
    id = calibrated(store, 2.0)
    with store.transaction() as db:
        row = db.get_one(ResultRow, id)
        fit = FitResult.model_validate(row.document)
        left = fit.cameras["left"].model_copy(update={"geometry": GEOMETRY})
        row.document = fit.model_copy(update={"cameras": {"left": left}}).model_dump(mode="json")
    board = life.drift_board(store, "m c L1")
    matrix = [(row.place, row.title) for row in board.rows if row.figure == "geometry camera_matrix"]
    assert [place for place, _ in matrix] == ["fx", "fy", "cx", "cy"] and matrix[0][1] == "focal length x"
    groups = [row.group for row in board.rows]
    assert groups == sorted(groups, key=("key", "other", "mtf").index) and set(groups) == {"key", "other", "mtf"}
    assert all((row.group == "mtf") == row.figure.startswith("mtf ") for row in board.rows)
    assert {"noise read_noise_e", "geometry camera_matrix"} <= {row.figure for row in board.rows if row.group == "key"}
    with store.transaction() as db:
        old = db.scalars(sa.select(FigureRow).where(FigureRow.place == "fx")).one()
        of = {"calibration_id": id, "camera": old.camera, "name": old.name, "side": old.side}
        db.add(FigureRow(**of, place="8", value=1.0, std=0.0))
    assert life.drift_board(store, "m c L1") == board
    assert "8" not in {place for _, _, place in life.figure_names(store)}
    assert "8" not in {figure.place for figure in life.figures(store, id)}


def test_a_board_has_every_figure_of_a_camera(store: Store) -> None:
    """One column a session, marks and drifts as in the histories."""
    ids = [calibrated(store, value) for value in (2.0, 2.01, 2.6)]
    life.certify(store, ids[0], "ada", limits())
    board = life.drift_board(store, "m c L1")
    assert [column.calibration_id for column in board.columns] == ids
    assert [column.state for column in board.columns] == ["certified", "candidate", "candidate"]
    rows = {row.figure: row for row in board.rows}
    noise = [cell for cell in rows["noise read_noise_e"].cells if cell is not None]
    history = life.history(store, "m c L1", "noise read_noise_e")
    assert (
        [(cell.value, cell.mark, cell.drifted) for cell in noise]
        == [(point.value, point.mark, point.drifted) for point in history.points]
        == [(2.0, "good", False), (2.01, "good", False), (2.6, "warn", True)]
    )
    assert rows["mtf edge-1 G mtf50_cy_per_px"].limit is None
    narrow = life.drift_board(store, "m c L1", newest=1)
    assert [column.calibration_id for column in narrow.columns] == [ids[0], ids[2]]  # the certified one, too
    with pytest.raises(InputError, match="no calibration of it is known"):
        life.drift_board(store, "nobody")


def test_a_board_corrects_dark_currents_to_one_temperature(store: Store) -> None:
    """A current that doubles every 7.2 C is the same at 31 and at 38.2 C: 1 and 2 e/s."""
    for current, temperature_c in ((1.0, 31.0), (2.0, 38.2)):
        fit = fitted(2.0)
        noise = fit.cameras["left"].noise
        assert noise is not None
        warm = noise.model_copy(
            update={
                "dark_current_e_per_s": current, "dark_current_e_per_s_std": 0.01, "dark_temperature_c": temperature_c
            }
        )  # fmt: skip
        id = calibrated(store, 2.0)
        camera = fit.cameras["left"].model_copy(update={"noise": warm})
        with store.transaction() as db:
            kept = fit.model_copy(update={"cameras": {"left": camera}})
            db.get_one(ResultRow, id).document = kept.model_dump(mode="json")
    board = life.drift_board(store, "m c L1", reference_c=31.0)
    row = next(row for row in board.rows if row.figure == "noise dark_current_e_per_s")
    assert row.reference_c == 31.0 and row.law == "doubles every 7.2 ± 1.4 °C"
    one, two = (cell for cell in row.cells if cell is not None)
    assert (one.value, two.value) == pytest.approx((1.0, 1.0)) and one.corrected and two.corrected
    # sigma of the factor: ln 2 hypot(7.2 x 1.4 / 7.2^2, sqrt(2) x 0.1 / 7.2) = 0.1355; the current's own 0.01/2
    assert two.std == pytest.approx(
        math.hypot(0.005, math.log(2.0) * math.hypot(1.4 / 7.2, math.sqrt(2.0) * 0.1 / 7.2))
    )


def test_limits_are_drafted_from_what_is_usual(store: Store) -> None:
    """Of values 2.0, 2.1, 2.2, 2.3 an unchanged camera's next one lies within t(3) s sqrt(1 + 1/4) of the mean."""
    for value in (2.0, 2.1, 2.2, 2.3):
        calibrated(store, value)
    newest = calibrated(store, 5.0)
    found, whence = life.draft_limits(store, newest)
    assert len(whence) == 4 and newest not in whence
    limit = next(one for one in found if one.figure == "noise read_noise_e" and one.side == "left")
    half = float(stats.t.ppf(0.995, 3)) * float(np.std([2.0, 2.1, 2.2, 2.3], ddof=1)) * math.sqrt(1.25) + 2.0 * STD
    low, high = limit.good
    assert low is None and high == pytest.approx(2.15 + half, abs=0.01 * 10 ** math.ceil(math.log10(half)))
    assert limit.judge(Figure(name="noise read_noise_e", value=5.0, std=STD)) == "bad"
    sharp = next(one for one in found if "mtf50" in one.figure)
    assert sharp.figure == "mtf * mtf50_cy_per_px" and sharp.good[1] is None
    single = calibrated(store, 2.0, {"left": "X1", "right": "X2"})
    alone, whence = life.draft_limits(store, single)
    assert whence == (single,) and alone
    # Whoever sends them, the certificate keeps that they aren't independent; not of limits that a laboratory set.
    own = life.certify(store, single, "Ada", CalibrationLimits(limit=alone))
    assert own.limits is not None and "this calibration alone" in (own.limits.dependence_on(single) or "")
    usual = life.certify(
        store, newest, "Ada", CalibrationLimits(limit=(limit.model_copy(update={"good": (0.0, 9.0)}),))
    )
    assert usual.limits is not None and usual.limits.dependence_on(newest) is None
