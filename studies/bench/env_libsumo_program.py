"""Measured program: SUMO alone shows given signal states at given seconds, and nothing else.

`studies.bench.env` compares all variants with it. It uses libsumo without the suite. Only this
file, `studies.bench.soak_program` and the simulator import libsumo.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import libsumo


def replay(request: dict[str, Any]) -> dict[str, Any]:
    """Replay signal states.

    Args:
        request: ``arguments`` (of SUMO), ``end_s``, and ``switches``: a list of
            ``[time_s, [[traffic light, state], ...]]`` in order of time.

    Returns:
        Wall seconds for the start and for stepping to the end (closing included), seconds of CPU
        for the latter, and the vehicles that entered and arrived.
    """
    switches = [
        (when, [(light, state) for light, state in states]) for when, states in request["switches"]
    ]
    began = time.perf_counter()
    libsumo.start(["sumo", *request["arguments"]])
    started, computed = time.perf_counter(), time.process_time()
    step, show = libsumo.simulation.step, libsumo.trafficlight.setRedYellowGreenState
    now = request["begin_s"]
    for when, states in switches:
        if when > now:
            step(when)
            now = when
        for light, state in states:
            show(light, state)
    step(request["end_s"])
    stepped = time.perf_counter()
    statistic = libsumo.simulation.getParameter
    entered = int(statistic("", "stats.vehicles.inserted"))
    running = int(statistic("", "stats.vehicles.running"))
    counted = time.perf_counter()
    libsumo.simulation.close()
    closed, computed = time.perf_counter(), time.process_time() - computed
    return {
        "start_s": started - began,
        "steps_s": (stepped - started) + (closed - counted),
        "cpu_s": computed,
        "entered": entered,
        "arrived": entered - running,
    }


if __name__ == "__main__":
    asked, found = map(Path, sys.argv[1:3])
    found.write_text(json.dumps(replay(json.loads(asked.read_text()))))
