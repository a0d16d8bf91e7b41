"""A crossing with dense traffic, on which effects are hidden and have to be found again.

All cases share their simulated days, so that each of them costs seconds.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from ugat_marl.data import MeasuredData
from ugat_marl.diagnosis import Diagnosis, DiagnosisConfig, diagnose
from ugat_marl.diagnosis.hypotheses import library
from ugat_marl.diagnosis.thresholds import Effort
from ugat_marl.effects import load_scenario
from ugat_marl.experiments import policy_factory, record
from ugat_marl.scenarios import Scenario

DURATION_S = 1200
VEHICLE_EVERY_S = 9
DEMAND = f"""<routes>
    <vType id="car" vClass="passenger" accel="2.6" decel="4.5" tau="1.0" sigma="0.5"
           speedFactor="1" speedDev="0.1"/>
    <route id="north" edges="S_C C_N"/>
    <route id="east" edges="W_C C_E"/>
    <flow id="north" route="north" type="car" departSpeed="max" begin="0" end="{DURATION_S}"
          period="{VEHICLE_EVERY_S}"/>
    <flow id="east" route="east" type="car" departSpeed="max" begin="0" end="{DURATION_S}"
          period="{VEHICLE_EVERY_S}"/>
</routes>
"""

LIBRARY = frozenset(
    {
        "acceleration", "headway", "startup_delay", "desired_speed", "heavy_share", "late_green",
        "signal_clock", "undercount", "dropout", "demand_level", "demand_surge", "lane_closure",
        "local_speed",
    }
)  # fmt: skip
"""Rivals of all families. The whole library takes longer than these tests may."""


@dataclass(frozen=True)
class Street:
    """The crossing, and the days that were simulated for it so far."""

    scenario: Scenario
    cache: Path

    def measure(self, domain: str, *, seed: int = 5, periods: int = 5) -> MeasuredData:
        """Days on which an effect is hidden, under fixed times."""
        policy = policy_factory("fixed-time:30")
        return record(self.scenario, domain, policy, periods=periods, seed=seed)

    def diagnose(
        self,
        measured: MeasuredData,
        out: Path,
        *,
        among: Collection[str] = LIBRARY,
        effort: Effort | None = None,
        **options: Any,
    ) -> dict[str, Any]:
        """The diagnosis with a smaller library and fewer days."""
        config = DiagnosisConfig(
            leave_out=tuple(sorted(library() - set(among))),
            effort=effort or Effort(base=32, bank=2, fit=5, test=16),
            # The answer is tested, not the time: on a busy computer ten minutes may not do.
            **{"cache": self.cache, "budget_s": 3600.0, **options},
        )
        diagnosis = diagnose(self.scenario, measured, out, config)
        assert Diagnosis.read(out) == diagnosis
        return diagnosis.to_json()


@pytest.fixture(scope="session")
def street(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Street:
    """The crossing with more vehicles, and with yellow and all-red."""
    directory = tmp_path_factory.mktemp("planted") / "crossing-v1"
    shutil.copytree(data / "crossing", directory)
    (directory / "demand.rou.xml").write_text(DEMAND)
    settings = (directory / "scenario.toml").read_text()
    for before, after in (
        ("duration_s = 200", f"duration_s = {DURATION_S}"),
        ("yellow_s = 0", "yellow_s = 3"),
        ("all_red_s = 0", "all_red_s = 2"),
    ):
        assert before in settings
        settings = settings.replace(before, after)
    (directory / "scenario.toml").write_text(settings)
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:  # their folders lie side by side; all share the days
        base = base.parent
    return Street(load_scenario(directory), base / "planted-days")
