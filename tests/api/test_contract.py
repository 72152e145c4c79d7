"""The API does what its OpenAPI description says, and the description is the committed one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis.core.failures import Failure, FailureGroup
from schemathesis.specs.openapi.checks import positive_data_acceptance

from tests.api.conftest import Running

DESCRIPTION = Path(__file__).parents[2] / "docs" / "reference" / "openapi.json"


@schemathesis.serializer("application/zip", "application/x-tar", "application/gzip")
def as_sent(context: object, value: object) -> bytes:
    """A body that is bytes already."""
    return value if isinstance(value, bytes) else str(value).encode()


@pytest.fixture(scope="module")
def described(shared: Running) -> schemathesis.BaseSchema:
    """The API of a running service, without its streams, which don't end while what they follow goes on."""
    schema = schemathesis.openapi.from_url(f"{shared.url}/openapi.json")
    return schema.exclude(path_regex="/events$|^/logout$")


def test_every_answer_is_one_that_is_described(described: schemathesis.BaseSchema, shared: Running) -> None:
    """Status, headers and body of made-up requests, good and bad, to every operation."""
    failures = []
    operations = [found.ok() for found in described.get_all_operations()]
    assert len(operations) > 25
    for operation in operations:

        @settings(
            max_examples=5,
            phases=[Phase.explicit, Phase.generate],
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
        )
        @given(case=operation.as_strategy())
        def answered(case: schemathesis.Case) -> None:
            # A cursor that nothing has, an archive that is no archive: well-formed, and refused with 422 all the same.
            case.call_and_validate(
                headers={"Authorization": f"Bearer {shared.keys['admin']}"},
                timeout=20,
                excluded_checks=[positive_data_acceptance],
            )

        try:
            answered()
        except (FailureGroup, Failure) as failure:
            failures.append(f"{operation.label}: {failure}")
    assert failures == [], "\n\n".join(failures)


def test_a_method_that_a_path_has_not_is_answered_with_those_that_it_has(shared: Running) -> None:
    with shared.client() as client:
        for path, allowed in (("/api/v1/sessions", {"GET", "POST"}), ("/login", {"POST"}), ("/api/v1/jobs", {"GET"})):
            response = client.patch(path)
            assert response.status_code == 405 and response.headers["content-type"] == "application/problem+json"
            assert set(response.headers["allow"].split(", ")) == allowed


def test_the_description_is_the_committed_one(shared: Running) -> None:
    """A change of the API is a change that a reader sees: `python docs/write_tables.py openapi` writes it."""
    assert json.loads(DESCRIPTION.read_text()) == json.loads(json.dumps(shared.app.openapi()))
