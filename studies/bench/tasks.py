"""One hour of traffic, done by SUMO alone, by the suite and by sumo-rl."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from studies.bench.measured import in_fresh_process
from studies.bench.rival import Rival
from ugat_marl.effects import load_scenario
from ugat_marl.errors import MeasurementError

_FOLDER = Path(__file__).parent
Run = dict[str, Any]
"""Wall seconds ``start_s`` and ``steps_s``, ``cpu_s``, ``decisions``; vehicles ``entered`` and
``arrived``."""

SUMO_RL_TIMING: Mapping[str, float] = {"yellow_s": 2.0, "all_red_s": 0.0, "min_green_s": 5.0}
"""The clearance and minimum green sumo-rl has by default; it knows no all-red."""


@dataclass(frozen=True)
class Task:
    """An episode whose actions are fixed.

    Attributes:
        request: What `studies.bench.episode` is told.
        bare: What `studies.bench.bare` is told: the signal states of that very episode.
        sumo_rl: What `studies.bench.sumo_rl_episode` is told: the same actions.
    """

    request: dict[str, Any]
    bare: dict[str, Any]
    sumo_rl: dict[str, Any]

    @classmethod
    def record(
        cls,
        scenario: str | Path,
        control: Mapping[str, float],
        folder: Path,
        *,
        duration_s: float,
        seed: int,
    ) -> Task:
        """Runs an episode with random actions and notes what is needed to repeat it.

        Args:
            scenario: What to simulate.
            control: Changes to its signal timing.
            folder: An empty folder that lives as long as the task.
            duration_s: Simulated seconds.
            seed: Seed of simulation and actions.
        """
        request = {
            "scenario": str(scenario),
            "control": dict(control),
            "duration_s": duration_s,
            "seed": seed,
            "record": None,
        }
        kept = folder / "kept"
        kept.mkdir()
        recorded = _episode({**request, "simulator": "inprocess", "record": str(kept)})
        bare = recorded["bare"]
        loaded = load_scenario(scenario).with_control(**control)
        written = loaded.write(folder / "scenario")
        sumo_rl = {
            "network": str(written / loaded.network.name),
            "routes": ",".join(str(written / document.name) for document in loaded.routes),
            "begin_s": bare["begin_s"],
            "duration_s": duration_s,
            "decision_interval_s": loaded.control.decision_interval_s,
            "yellow_s": loaded.control.yellow_s,
            "min_green_s": loaded.control.min_green_s,
            "seed": int(bare["arguments"][bare["arguments"].index("--seed") + 1]),
            "actions": recorded["actions"],
        }
        return cls(request, bare, sumo_rl)

    def by_libsumo(self) -> Run:
        """SUMO alone shows the recorded signal states."""
        return self._counted(in_fresh_process([_FOLDER / "bare.py"], self.bare))

    def by_suite(self, simulator: str) -> Run:
        """The environment, its simulator in this or in another process."""
        return self._counted(_episode({**self.request, "simulator": simulator}))

    def by_sumo_rl(self, rival: Rival, *, metrics: bool) -> Run:
        """sumo-rl with the same actions, with or without the metrics it collects by default."""
        run = in_fresh_process(
            [_FOLDER / "sumo_rl_episode.py"],
            {**self.sumo_rl, "infos": metrics},
            python=rival.python,
            variables=rival.variables(),
        )
        return self._counted(run)

    def _counted(self, run: Run) -> Run:
        return {**run, "decisions": len(self.sumo_rl["actions"])}


def _episode(request: Mapping[str, Any]) -> dict[str, Any]:
    return in_fresh_process(["-m", "studies.bench.episode"], request)


def find_scenario(name: str, rival: Rival | None) -> tuple[str | Path, str | None]:
    """Where to load a scenario from, and what to tell the reader about it.

    RESCO networks come from an installed sumo-rl wheel, from the environment the bench made for
    sumo-rl, or are replaced by the shipped 4x4 grid.
    """
    if not name.startswith("resco:") or find_spec("sumo_rl") is not None:
        return name, None
    if rival is not None:
        found = sorted((rival.networks / name.removeprefix("resco:")).glob("*.sumocfg"))
        if found:
            return found[0], None
    return "grid4x4-v1", (
        f"{name} is not installed (pip install 'ugat-marl[resco]'): grid4x4-v1 was measured instead"
    )


def require_same_work(runs: Mapping[str, Run], tolerance: float = 0.0) -> None:
    """Refuses to compare episodes with different traffic.

    Args:
        runs: Name to run; the first is what the others are compared with.
        tolerance: Difference of the vehicles that entered and arrived that is let pass, as a share.

    Raises:
        MeasurementError: They differ by more.
    """
    first = next(iter(runs.values()))
    for run in runs.values():
        for what in ("entered", "arrived"):
            if abs(run[what] - first[what]) > tolerance * first[what]:
                work = {name: (own["entered"], own["arrived"]) for name, own in runs.items()}
                raise MeasurementError(
                    f"not the same work, (entered, arrived) vehicles differ: {work}; "
                    "was the package changed meanwhile?"
                )
