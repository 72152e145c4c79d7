"""The service describes what the models declare: parameters and effects."""

from __future__ import annotations

from lab.diagnose.visibility import effect_list
from sim.camera import CameraModel
from sim.parameters import read_quantities
from tests.api.conftest import Running


def test_parameters_are_those_of_the_camera_model(shared: Running) -> None:
    with shared.client("read") as client:
        told = {one["name"]: one for one in client.get("/api/v1/parameters").json()}
    for name, quantity in read_quantities(CameraModel).items():
        assert told[name]["unit"] == quantity.unit and told[name]["meaning"] == quantity.meaning
        assert told[name]["lower"] == quantity.lower and told[name]["upper"] == quantity.upper
    assert told["lens.f_number"]["unit"] == "1"


def test_effects_are_those_of_the_library(shared: Running) -> None:
    with shared.client("read") as client:
        told = client.get("/api/v1/effects").json()
        assert told == effect_list().model_dump(mode="json")["effects"]
        assert client.get("/api/v1/effects/optical_low_pass_filter").json() in told
        assert client.get("/api/v1/effects/magic").status_code == 404


def test_a_key_is_told_its_name_and_scope(shared: Running) -> None:
    for scope in shared.keys:
        with shared.client(scope) as client:
            assert client.get("/api/v1/me").json() == {"name": scope, "scope": scope}
