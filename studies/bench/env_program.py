"""Measured program: an episode of the suite's environment with random actions."""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ugat_marl.effects import load_scenario
from ugat_marl.envs import TrafficEnv, parallel_env
from ugat_marl.seeding import numpy_generator
from ugat_marl.simulation import (
    Launch,
    LibsumoSimulator,
    SignalPlans,
    Snapshot,
    Trips,
    VehiclePositions,
)


class RecordingSimulator:
    """A simulator in this process that records its launch and every change of signals.

    Args:
        folder: Folder for the files of the simulation.

    Attributes:
        switches: Changes of signals, ``[time_s, [[traffic light, state], ...]]``, in order of time.
        launch: Launch of the simulation; None before the first start.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._simulator = LibsumoSimulator()
        self._now = 0.0
        self._shown: dict[str, str] = {}
        self.switches: list[tuple[float, list[tuple[str, str]]]] = []
        self.launch: Launch | None = None

    def start(self, launch: Launch) -> Snapshot:
        """Start a simulation and forget the earlier record."""
        self.launch, self._now, self._shown, self.switches = launch, launch.begin_s, {}, []
        snapshot = self._simulator.start(launch)
        shutil.copytree(launch.directory, self._folder, dirs_exist_ok=True)
        return snapshot

    def advance(
        self, seconds: float, plans: SignalPlans, meanwhile: Callable[[], object] | None = None
    ) -> Snapshot:
        """Simulate `seconds` and note every change of a signal."""
        changes: dict[float, list[tuple[str, str]]] = {}
        for light, segments in plans.items():
            when = self._now
            for duration, state in segments:
                if self._shown.get(light) != state:
                    changes.setdefault(when, []).append((light, state))
                    self._shown[light] = state
                when += duration
        self.switches += sorted(changes.items())
        self._now += seconds
        return self._simulator.advance(seconds, plans, meanwhile)

    def vehicles(self) -> VehiclePositions:
        """Return the current positions of all vehicles."""
        return self._simulator.vehicles()

    def signals(self) -> dict[str, str]:
        """Return the current state of every traffic light."""
        return self._simulator.signals()

    def finish(self) -> Trips:
        """End the simulation."""
        return self._simulator.finish()

    def close(self) -> None:
        """End the simulation."""
        self._simulator.close()

    def bare_request(self) -> dict[str, Any]:
        """Return the request for `studies.bench.env_libsumo_program` to repeat the episode."""
        assert self.launch is not None
        pairs = zip(self.launch.arguments[::2], self.launch.arguments[1::2], strict=True)
        kept = [
            part
            for option, value in pairs
            if not option.startswith("--tripinfo") and option != "--error-log"
            for part in (option, value)
        ]
        return {
            "arguments": [part.replace(self.launch.directory, str(self._folder)) for part in kept],
            "begin_s": self.launch.begin_s,
            "end_s": self._now,
            "switches": self.switches,
        }


def random_actions(env: TrafficEnv, seed: int) -> list[dict[str, int]]:
    """Return random actions of a whole episode, drawn before the time is measured.

    The first decision keeps every first phase, because sumo-rl always does so.
    """
    generator = numpy_generator(seed, "bench", "actions")
    agents = env.possible_agents
    counts = [int(env.action_space(agent).n) for agent in agents]
    drawn = generator.integers(counts, size=(env.scenario.decisions, len(counts)))
    drawn[0] = 0
    return [dict(zip(agents, row, strict=True)) for row in drawn.tolist()]


def episode(request: dict[str, Any]) -> dict[str, Any]:
    """Run one episode.

    Args:
        request: ``scenario``, ``control`` (changes to its timing), ``duration_s``, ``seed``,
            ``simulator`` (see `EnvOptions`), and ``record``: a folder for the requests to SUMO
            alone and to sumo-rl, or None.

    Returns:
        Wall seconds of the reset and of all steps (scores included), CPU seconds of this process
        for the steps, and the vehicles that entered and arrived.
    """
    simulator, seed = request["simulator"], request["seed"]
    scenario = load_scenario(request["scenario"]).with_control(**request["control"])
    env = parallel_env(scenario, duration_s=request["duration_s"], simulator=simulator)
    actions = random_actions(env, seed)
    recorder = RecordingSimulator(Path(request["record"])) if request["record"] else None
    if recorder is not None:
        env.simulate_with(recorder)
    if simulator != "inprocess":
        env.reset(seed=seed)  # the first reset also starts the warm parent, once per process
    began = time.perf_counter()
    env.reset(seed=seed)
    started, computed = time.perf_counter(), time.process_time()
    for action in actions:
        env.step(action)
    scores = env.scores()
    stepped, computed = time.perf_counter(), time.process_time() - computed
    recorded: dict[str, Any] = {}
    if recorder is not None:
        lights = [
            {env.intersection_of[agent]: action for agent, action in row.items()} for row in actions
        ]
        recorded = {"bare": recorder.bare_request(), "actions": lights}
    env.close()
    return {
        "start_s": started - began,
        "steps_s": stepped - started,
        "cpu_s": computed,
        "entered": int(scores.departed),
        "arrived": int(scores.throughput),
        **recorded,
    }


if __name__ == "__main__":
    asked, found = map(Path, sys.argv[1:3])
    found.write_text(json.dumps(episode(json.loads(asked.read_text()))))
