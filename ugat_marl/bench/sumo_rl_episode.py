"""Measured program: an episode of sumo-rl with random actions.

Runs in an environment of its own (see `ugat_marl.bench.rival`), without this suite.
"""

from __future__ import annotations

import json
import random
import sys
import time
from pathlib import Path
from typing import Any


def episode(request: dict[str, Any]) -> dict[str, Any]:
    """Runs one episode of sumo-rl's parallel environment.

    Args:
        request: ``network``, ``routes``, ``begin_s``, ``duration_s``, ``decision_interval_s``,
            ``seed``, and ``infos``: whether it collects its default metrics for every step.

    Returns:
        Wall seconds of the reset and of stepping to the end, and the vehicles that arrived.
    """
    import sumo_rl  # pyright: ignore[reportMissingImports]

    env = sumo_rl.parallel_env(
        net_file=request["network"],
        route_file=request["routes"],
        begin_time=int(request["begin_s"]),
        num_seconds=int(request["duration_s"]),
        delta_time=int(request["decision_interval_s"]),
        sumo_seed=int(request["seed"]),
        sumo_warnings=False,
        add_system_info=request["infos"],
        add_per_agent_info=request["infos"],
        additional_sumo_cmd="--no-step-log true --duration-log.disable true",
    )
    began = time.perf_counter()
    env.reset(seed=int(request["seed"]))
    started = time.perf_counter()
    choices = random.Random(request["seed"])
    phases = {agent: int(env.action_space(agent).n) for agent in env.agents}
    decisions = 0
    while env.agents:
        env.step({agent: choices.randrange(count) for agent, count in phases.items()})
        decisions += 1
    statistic = env.unwrapped.env.sumo.simulation.getParameter
    entered = int(statistic("", "stats.vehicles.inserted"))
    running = int(statistic("", "stats.vehicles.running"))
    env.close()
    ended = time.perf_counter()
    return {
        "start_s": started - began,
        "steps_s": ended - started,
        "entered": entered,
        "arrived": entered - running,
        "decisions": decisions,
    }


if __name__ == "__main__":
    asked, found = map(Path, sys.argv[1:3])
    found.write_text(json.dumps(episode(json.loads(asked.read_text()))))
