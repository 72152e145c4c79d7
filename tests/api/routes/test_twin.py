"""Predictions, scores and budgets over the network."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from api.client import ServiceClient, ServiceProblem
from api.schemas import ChangesAsked, LampAsked, PredictionStart, SetAsked
from lab.calibration import camera_models
from lab.formats.recording_set import RecordingSet, archive
from lab.twin.changes import Changes
from lab.twin.session import future_session
from tests.api.conftest import Running
from tests.lab.twin.test_twin import LAMP, PLAN, TRUTH, captured, trained

CHANGES = Changes(f_number=8.0, radiance_factor=4.0)


@pytest.fixture
def client(running: Running) -> Iterator[ServiceClient]:
    with ServiceClient(running.url, running.keys["calibrate"], timeout_s=120.0) as found:
        yield found


def _sent(client: ServiceClient, recordings: RecordingSet, folder: Path, name: str) -> str:
    file = folder / f"{name}.zip"
    file.write_bytes(b"".join(archive(recordings, "zip")))
    return client.send_recordings(file).id


def test_a_prediction_is_sealed_and_opened_over_the_network(
    running: Running, client: ServiceClient, tmp_path: Path
) -> None:
    model = camera_models.bring_in(running.store, {"left": trained(1)})
    plan = _sent(client, future_session(TRUTH, PLAN, "left", Changes(), 1), tmp_path, "plan")
    taken = _sent(client, captured(CHANGES, 7), tmp_path, "taken")
    asked = PredictionStart(
        camera_model=model, plan=SetAsked(recordings_id=plan), changes=ChangesAsked(f_number=8.0, radiance_factor=4.0)
    )
    found = client.predict(asked)
    assert found.sha256.startswith(found.id) and found.numbers["left"] > 100 and found.plan == plan
    assert found.names == {"left": ("dark_current_temperature",)}
    assert client.predict(asked).id == found.id  # the same model and plan give the same prediction
    assert [one.id for one in client.predictions()] == [found.id] and client.prediction(found.id) == found
    assert hashlib.sha256(client.sealed_prediction(found.id)).hexdigest() == found.sha256
    score = client.score_prediction(found.id, SetAsked(recordings_id=taken))
    assert score.source == taken and score.n > 100 and score.effects[0].verdict == "survives"
    with pytest.raises(ServiceProblem) as refused:
        client.score_prediction(found.id, SetAsked(recordings_id=plan))
    assert refused.value.status == 422 and "isn't the session that was predicted" in refused.value.detail
    assert str(running.store.root) not in refused.value.detail + client.sealed_prediction(found.id).decode()
    for changes, said in (
        (ChangesAsked(temperature_c=4000.0), "changes.temperature_c=4000"),
        (ChangesAsked(distance_mm=9.0), "twice the focal length"),
        (ChangesAsked(lamp=LampAsked(wavelength_nm=(500.0, 400.0), value=(1.0, 1.0))), "must ascend"),
    ):
        with pytest.raises(ServiceProblem) as refused:
            client.predict(asked.model_copy(update={"changes": changes}))
        assert refused.value.status == 422 and said in refused.value.detail and "\n" not in refused.value.detail
    tungsten = LampAsked(wavelength_nm=LAMP.wavelength_nm, value=LAMP.value)
    again = client.predict(asked.model_copy(update={"changes": ChangesAsked(lamp=tungsten)}))
    assert again.changes["lamp"]["value"][0] == LAMP.value[0]
    file = running.store.root / "predictions" / f"{again.id}.json"
    file.write_text(file.read_text().replace('"n', '"m', 1))
    with pytest.raises(ServiceProblem, match="was edited"):
        client.score_prediction(again.id, SetAsked(recordings_id=taken))
    client.delete_prediction(found.id)
    with pytest.raises(ServiceProblem, match="no prediction"):
        client.prediction(found.id)


def test_a_budget_ranks_the_sequences_of_a_station(running: Running, client: ServiceClient) -> None:
    model = camera_models.bring_in(running.store, {"left": trained(1)})
    (use,) = client.budget(model, "variance", "fakes")["left"].uses
    assert use.captures and use.captures == tuple(sorted(use.captures, key=lambda c: -c.reduced_percent_per_minute))
    assert not client.budget(model, "variance")["left"].uses[0].captures
    with pytest.raises(ServiceProblem, match="use 'colour': colour isn't a use") as refused:
        client.budget(model, "colour")
    assert refused.value.status == 422
