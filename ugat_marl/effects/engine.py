"""Another engine for the same network and demand: SUMO's queue model in place of car following."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from ugat_marl.effects.base import Effect, Parameter
from ugat_marl.scenario import Scenario
from ugat_marl.scenario_settings import validated


@dataclass(frozen=True)
class QueueModel(Effect):
    """Vehicles wait in queues at the ends of segments of so many metres (SUMO's mesoscopic model).

    Vehicles have no position within a segment and no acceleration; what they look at are signals,
    and room in the next segment. An engine to train in, many times as fast: `--sim meso`. A
    diagnosis does not look for it.
    """

    name: ClassVar[str] = "queue_model"
    ranges: ClassVar[dict[str, Parameter]] = {"metres": Parameter("m", 20.0, 500.0)}
    metres: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Sets options of SUMO: signals and right of way are obeyed; agents' yellow becomes red.

        SUMO's queues go on through yellow at the full rate and start without delay, so a change of
        phases would cost them the all-red alone. On the street what is driven in yellow and what is
        lost at the start of green are about equal: queues have the green that is shown. (The
        network's own programmes keep their yellow, from which phases may be read.)
        (Not `meso-lane-queue`, with which SUMO 1.28 crashes on some networks.)
        """
        options = {
            "mesosim": "true",
            "meso-edgelength": f"{self.metres:g}",
            "meso-junction-control": "true",
        }
        settings = scenario.settings.model_dump()
        settings["sumo"] = {**settings["sumo"], **options}
        control = settings["control"]
        clearance_s = control["yellow_s"] + control["all_red_s"]
        settings["control"] = {**control, "yellow_s": 0.0, "all_red_s": clearance_s}
        return replace(
            scenario,
            settings=validated(settings, f"scenario {scenario.id!r}"),
            applied=(*scenario.applied, str(self)),
        )
