"""Calibrates against the mock bench over the network, and fails where a figure drifted from the kept reference."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def fit(calibench_client):
    """Darks and flats of both cameras, fitted."""
    session = calibench_client.capture("bench", quick=True, sequences=("dark", "flat"), name="nightly")
    return calibench_client.fit(session.id)


def test_figures_have_not_drifted(fit, calibench_reference):
    rules = ["noise read_noise_e>5%", "noise conversion_gain_dn_per_e>2%", "noise dark_current_e_per_s"]
    calibench_reference.check(fit, fail_on=rules)


def test_both_cameras_were_fitted(fit, calibench_station):
    assert set(fit.cameras) == set(calibench_station.sides)
