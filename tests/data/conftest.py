"""The crossing that the measured data of these tests are of."""

from __future__ import annotations

from pathlib import Path

import pytest

from ugat_marl.scenarios import Network, Scenario, read_scenario


@pytest.fixture(scope="module")
def scenario(data: Path) -> Scenario:
    return read_scenario(data / "crossing")


@pytest.fixture(scope="module")
def network(scenario: Scenario) -> Network:
    return Network.read(scenario)
