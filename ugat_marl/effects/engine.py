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
        """Sets options of SUMO: signals and right of way are obeyed, each lane has its queue.

        (Not `meso-lane-queue`, with which SUMO 1.28 crashes on some networks.)
        """
        options = {
            "mesosim": "true",
            "meso-edgelength": f"{self.metres:g}",
            "meso-junction-control": "true",
        }
        settings = scenario.settings.model_dump()
        settings["sumo"] = {**settings["sumo"], **options}
        return replace(
            scenario,
            settings=validated(settings, f"scenario {scenario.id!r}"),
            applied=(*scenario.applied, str(self)),
        )
