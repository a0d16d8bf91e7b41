"""What measured data lack, and which hypotheses nobody can examine without it."""

from __future__ import annotations

from ugat_marl.measured.data import Finding, Measured
from ugat_marl.network import Network
from ugat_marl.scenario import Scenario


def coverage(measured: Measured, scenario: Scenario, network: Network) -> list[Finding]:
    """Findings on everything that is not there."""
    return []
