"""Measured program: updates of DQN and fits of f and h, on the CPU and on a GPU in turn."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from studies.bench.learning_program import Noise
from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.grounding import FitConfig, Fitter, PhaseTransform
from ugat_marl.policies import CPU, DQN, DQNConfig, device_of
from ugat_marl.seeding import numpy_generator, torch_generator

LAYOUT = AgentLayout(features=16, phases=8)
"""Layout of the observations of every intersection: a crossing with four lanes per approach."""

EPISODES = 4
"""Episodes of the log; one is held out."""


def random_log(agents: int, steps: int, seed: int) -> TransitionLog:
    """Draw random transitions in the form of a recorded log."""
    layouts = {f"agent_{index}": LAYOUT for index in range(agents)}
    seeds = tuple(range(EPISODES))
    told = Provenance("random", "", "sim", seeds, 10.0, "count", layouts)
    recorder = TransitionRecorder(told)
    generator = numpy_generator(seed, "bench", "log")
    size, paid = (agents, LAYOUT.size), dict.fromkeys(layouts, 0.0)
    for episode in range(EPISODES):
        for step in range(steps):
            now, then = (
                dict(zip(layouts, generator.random(size, np.float32), strict=True))
                for _ in range(2)
            )
            chosen = generator.integers(LAYOUT.phases, size=agents)
            actions = dict(zip(layouts, chosen.tolist(), strict=True))
            recorder.record(episode, step, now, actions, actions, paid, then)
    return recorder.log()


class Updates:
    """A learner with a filled replay memory, on a device."""

    def __init__(self, request: Mapping[str, Any], agents: int, device: torch.device) -> None:
        config = DQNConfig(batch_size=request["batch_size"], warmup_decisions=50)
        noise = Noise([(LAYOUT.size, LAYOUT.phases)] * agents, 60)
        self._learner = DQN.of(noise, config, request["seed"], device=device)
        self._learner.learn(noise, 1, request["seed"])
        self._generator = torch_generator(request["seed"], "bench", "updates")
        self._updates: int = request["updates"]

    def time(self) -> float:
        """Return wall ms of one update, including the copy of weights to the acting networks."""
        began = time.perf_counter()
        for _ in range(self._updates):
            self._learner.update(self._generator)
            self._learner._acting.network()
        return 1e3 * (time.perf_counter() - began) / self._updates


class Fits:
    """Models and the log they are fitted to, on a device."""

    def __init__(
        self, request: Mapping[str, Any], log: TransitionLog, device: torch.device
    ) -> None:
        self._log, self._device, self._seed = log, device, request["seed"]
        # held-out loss does not fall on noise, so less patience would end the fit at once
        self._config = FitConfig(epochs=request["epochs"], patience=request["epochs"])
        self._transform = PhaseTransform(log.provenance.layouts, self._seed)

    def time(self) -> float:
        """Return wall s of a whole fit, including reading the log and scoring the models."""
        fitter = Fitter(self._config, self._seed, device=self._device)
        began = time.perf_counter()
        self._transform.fit(self._log, self._log, fitter)
        return time.perf_counter() - began


def measure(request: Mapping[str, Any]) -> dict[str, Any]:
    """Measure one size on both devices, round by round, after a first fit that is not counted."""
    torch.set_num_threads(1)
    there = device_of(request["device"])
    devices = {"cpu": CPU, "device": there}
    agents = request["size"]
    log = random_log(agents, request["steps"], request["seed"])
    for place in devices.values():
        Fits({**request, "epochs": 1}, log, place).time()
    measured = {
        "update of DQN": {d: Updates(request, agents, place) for d, place in devices.items()},
        "fit of f and h": {d: Fits(request, log, place) for d, place in devices.items()},
    }
    times = {what: {name: list[float]() for name in both} for what, both in measured.items()}
    for _ in range(request["rounds"]):
        for what, both in measured.items():
            for name, one in both.items():
                times[what][name].append(one.time())
    known = torch.cuda.get_device_name(there) if there.type == "cuda" else there.type
    return {"name": known, "times": times}


if __name__ == "__main__":
    asked, result = map(Path, sys.argv[1:3])
    result.write_text(json.dumps(measure(json.loads(asked.read_text()))))
