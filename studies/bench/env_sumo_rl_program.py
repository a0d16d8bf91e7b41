"""Measured program: an episode of sumo-rl.

It runs in its own virtual environment (see `studies.bench.sumo_rl`), without this suite.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any


def episode(request: dict[str, Any]) -> dict[str, Any]:
    """Run one episode of sumo-rl's parallel environment.

    Args:
        request: ``network``, ``routes``, ``begin_s``, ``duration_s``, ``decision_interval_s``,
            ``yellow_s``, ``min_green_s``, ``seed`` (of SUMO), ``actions`` (one mapping of traffic
            light to green phase per decision; lights left out keep their only phase), and
            ``infos``: whether it collects its default metrics at every step.

    Returns:
        Wall seconds of the reset and of stepping to the end, seconds of CPU for the latter, and the
        vehicles that entered and arrived.
    """
    import sumo_rl  # pyright: ignore[reportMissingImports]

    env = sumo_rl.parallel_env(
        net_file=request["network"],
        route_file=request["routes"],
        begin_time=int(request["begin_s"]),
        num_seconds=int(request["duration_s"]),
        delta_time=int(request["decision_interval_s"]),
        yellow_time=int(request["yellow_s"]),
        min_green=int(request["min_green_s"]),
        sumo_seed=int(request["seed"]),
        sumo_warnings=False,
        add_system_info=request["infos"],
        add_per_agent_info=request["infos"],
        additional_sumo_cmd="--no-step-log true --duration-log.disable true",
    )
    began = time.perf_counter()
    env.reset(seed=int(request["seed"]))
    started, computed = time.perf_counter(), time.process_time()
    agents = env.agents
    for row in request["actions"]:
        env.step({agent: row.get(agent, 0) for agent in agents})
    over = not env.agents
    statistic = env.unwrapped.env.sumo.simulation.getParameter
    entered = int(statistic("", "stats.vehicles.inserted"))
    running = int(statistic("", "stats.vehicles.running"))
    env.close()
    ended, computed = time.perf_counter(), time.process_time() - computed
    if not over:
        raise SystemExit("the actions do not last to the end of the episode")
    return {
        "start_s": started - began,
        "steps_s": ended - started,
        "cpu_s": computed,
        "entered": entered,
        "arrived": entered - running,
    }


if __name__ == "__main__":
    asked, found = map(Path, sys.argv[1:3])
    found.write_text(json.dumps(episode(json.loads(asked.read_text()))))
