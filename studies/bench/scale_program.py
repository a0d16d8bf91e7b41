"""Measured program of ``bench scale``; ``request["work"]`` names a function of `WORK`."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import json
import os
import signal
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.bench.memory_program import family, look, processes
from ugat_marl.envs import AnyParallelEnv, VectorEnv, VectorStep, parallel_env, vector_env
from ugat_marl.seeding import numpy_generator

Request = Mapping[str, Any]
_HELD = 3
"""Decisions for which `cycle` holds each green, so that traffic flows."""


def cycle(masks: NDArray[np.int8], decision: int) -> NDArray[np.int64]:
    """Choose the allowed greens in turn, each for `_HELD` decisions."""
    counts = masks.sum(axis=-1)
    wanted = np.full(masks.shape[:-1], decision // _HELD) % np.maximum(counts, 1)
    order = np.cumsum(masks, axis=-1) - 1
    return ((order == wanted[..., None]) & (masks > 0)).argmax(axis=-1)


def steps(request: Request) -> dict[str, Any]:
    """Measure decisions of `n` simulations together, after some that are not measured."""
    with vector_env(request["scenario"], request["n"], duration_s=request["duration_s"]) as env:
        batch = env.reset(request["seed"])
        for decision in range(request["settled"]):
            batch = env.step(cycle(batch.masks, decision))
        computed, simulated = time.process_time(), _cpu_s(env)
        began = time.perf_counter()
        last = request["settled"] + request["decisions"]
        if request["stepping"] == "halves":
            _by_halves(env, batch, request["settled"], last)
        elif request["stepping"] == "ready":
            _as_they_are_ready(env, batch, request["settled"], last)
        else:
            for decision in range(request["settled"], last):
                batch = env.step(cycle(batch.masks, decision))
        seconds = time.perf_counter() - began
        return {
            "seconds": seconds,
            "user_cpu_s": time.process_time() - computed,
            "simulation_cpu_s": _cpu_s(env) - simulated,
            "steps": env.n * request["decisions"],
            "agents": len(env.agents),
            "memory_mib": _memory_mib(),
            "vehicles": _vehicles(batch.observations),
        }


def _by_halves(env: VectorEnv, batch: VectorStep, first: int, last: int) -> None:
    """Step two halves in turn: one half decides while the other is simulated."""
    halves = env.halves()
    masks = [batch.masks[: halves[0].n], batch.masks[halves[0].n :]]
    for half, own in zip(halves, masks, strict=True):
        half.step_async(cycle(own, first))
    for decision in range(first + 1, last + 1):
        for half in halves:
            found = half.step_wait()
            if decision < last:
                half.step_async(cycle(found.masks, decision))


def _as_they_are_ready(env: VectorEnv, batch: VectorStep, first: int, last: int) -> None:
    """Step each simulation as soon as its last step is done."""
    decisions = [first] * env.n
    env.send(cycle(batch.masks, first))
    while min(decisions) < last:
        found = env.recv()
        (number,) = found.numbers.tolist()
        decisions[number] += 1
        if decisions[number] < last:
            env.send(cycle(found.masks, decisions[number]), where=[number])


def split(request: Request) -> dict[str, Any]:
    """Measure the CPU time per agent and step in SUMO and in the rest, in one process."""
    env = parallel_env(request["scenario"], duration_s=request["duration_s"], simulator="inprocess")
    _, infos = env.reset(seed=request["seed"])
    simulator: Any = env._simulator
    inside = {"advance": 0.0, "_snapshot": 0.0}

    def timed(name: str) -> Callable[..., Any]:
        plain = getattr(simulator, name)

        def call(*arguments: Any) -> Any:
            began = time.process_time()
            found = plain(*arguments)
            inside[name] += time.process_time() - began
            return found

        return call

    for name in inside:
        setattr(simulator, name, timed(name))
    began = 0.0
    for decision in range(request["settled"] + request["decisions"]):
        if decision == request["settled"]:
            inside.update(advance=0.0, _snapshot=0.0)
            began = time.process_time()
        masks = {agent: infos[agent]["action_mask"] for agent in env.agents}
        chosen = {agent: int(cycle(mask, decision)) for agent, mask in masks.items()}
        _, _, _, _, infos = env.step(chosen)
    total = time.process_time() - began
    vehicles = env.snapshot.vehicles.sum()
    env.close()
    sumo = inside["advance"] - inside["_snapshot"]  # reading the lanes is not part of SUMO's step
    agents, steps = len(env.possible_agents), request["decisions"]
    return {
        "sumo_ms": 1e3 * sumo / (agents * steps),
        "rest_ms": 1e3 * (total - sumo) / (agents * steps),
        "us_per_vehicle_s": 1e6 * sumo / (10.0 * steps * max(float(vehicles), 1.0)),
    }


def grounded(request: Request) -> dict[str, Any]:
    """Time an episode without or with models; their answers are not used, so traffic is equal."""
    from ugat_marl.grounding import GateConfig, GroundedEnv, PhaseTransform, TimedTransform

    inner = parallel_env(request["scenario"], duration_s=request["duration_s"])
    env: AnyParallelEnv = inner
    if request["grounding"] is not None:
        never = GateConfig(mode="static", static_alpha=1e-12)
        kinds = {"phase": PhaseTransform, "timed": TimedTransform}
        kind: Any = kinds[request["grounding"]]
        transform = kind(inner.layouts, request["seed"], gate=never)
        for model in (transform.forward, transform.inverse):
            model.fitted.fill_(True)  # unfitted models raise an error; the answers are not used
        env = GroundedEnv(inner, transform)
    env.reset(seed=request["seed"])  # the first reset also starts the warm parent
    _, infos = env.reset(seed=request["seed"])
    began = time.perf_counter()
    decision = 0
    while env.agents:
        masks = {agent: infos[agent]["action_mask"] for agent in env.agents}
        chosen = {agent: int(cycle(mask, decision)) for agent, mask in masks.items()}
        _, _, _, _, infos = env.step(chosen)
        decision += 1
    seconds = time.perf_counter() - began
    scores = inner.scores()
    env.close()
    return {
        "seconds": seconds,
        "steps": decision,
        "vehicles": scores.departed,
        "att_s": scores.att_s,
    }


def leaks(request: Request) -> dict[str, Any]:
    """Open, reset, step and close environments many times; measure memory and files."""
    seen: list[dict[str, float]] = []
    resets = 0
    for turn in range(request["turns"]):
        env = vector_env(request["scenario"], request["n"], duration_s=request["duration_s"])
        for _ in range(request["resets"]):
            batch = env.reset(request["seed"] + turn)
            env.step(cycle(batch.masks, 0))
            resets += env.n
        env.close()
        del env
        seen.append(look())
    return {"early": seen[0], "late": seen[-1], "resets": resets}


def kills(request: Request) -> dict[str, Any]:
    """Kill processes at random; return a digest of all episodes and the number of kills."""
    generator = numpy_generator(request["seed"], "bench", "kills")
    n, per_lane = request["n"], request["episodes"] // request["n"]
    with vector_env(request["scenario"], n, duration_s=request["duration_s"]) as env:
        decisions = per_lane * int(request["duration_s"] // 10)
        moments = generator.permutation(decisions)[: request["kills"]]
        victims = dict(zip(moments.tolist(), generator.integers(n, size=len(moments)), strict=True))
        batch = env.reset(request["seed"])
        digest, ended = hashlib.sha256(batch.observations.tobytes()), 0
        began = time.perf_counter()
        for decision in range(decisions):
            if decision in victims:
                _kill(env, int(victims[decision]))
            batch = env.step(cycle(batch.masks, decision))
            ended += len(batch.ended)
            scores = repr([(one.episode, one.scores) for one in batch.ended])
            digest.update(batch.observations.tobytes() + batch.rewards.tobytes() + scores.encode())
        seconds = time.perf_counter() - began
    return {
        "digest": digest.hexdigest(),
        "killed": len(victims),
        "episodes": ended,
        "seconds": seconds,
    }


def decide(request: Request) -> dict[str, Any]:
    """Measure the time of a decision for all intersections, on one core."""
    import torch

    from ugat_marl.policies import DQN, DQNConfig

    torch.set_num_threads(1)
    env = parallel_env(request["scenario"], duration_s=100)
    observations, infos = env.reset(seed=request["seed"])
    found: dict[str, Any] = {"agents": len(env.agents)}
    for name, shared in (("one network each", False), ("one network for all", True)):
        policy = DQN.of(env, DQNConfig(shared=shared), request["seed"]).policy()
        policy.reset(0)
        times: list[float] = []
        for _ in range(request["repetitions"]):
            began = time.perf_counter()
            policy.act(observations, infos)
            times.append(time.perf_counter() - began)
        found[name] = statistics.median(times)
    env.close()
    return found


def ray(request: Request) -> dict[str, Any]:
    """Time the same evaluation on a local cluster of one or two nodes with a core each."""
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    from ugat_marl.effects import load_scenario
    from ugat_marl.experiments import evaluation_of, rule_factory
    from ugat_marl.parallel import RayExecutor

    cluster: Any = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
    )
    for _ in range(request["nodes"] - 1):
        cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    scenario, rules = load_scenario(request["scenario"]), {"rule": rule_factory("fixed-time:30")}
    try:
        with RayExecutor(cluster.address) as workers:

            def play(count: int, length_s: float) -> tuple[float, str]:
                began = time.perf_counter()
                seeds = range(count)
                found = evaluation_of(
                    scenario, rules, ["sim"], seeds, duration_s=length_s, workers=workers
                )
                return time.perf_counter() - began, repr(found.results)

            play(4 * request["nodes"], 50.0)  # imports, warm parents
            seconds, results = play(request["episodes"], request["duration_s"])
    finally:
        cluster.shutdown()
    return {"seconds": seconds, "digest": hashlib.sha256(results.encode()).hexdigest()}


def learner(request: Request) -> dict[str, Any]:
    """Measure the CPU time of a training in SUMO, in torch and in all else, in one process."""
    from ugat_marl.policies import learner_factory

    env = parallel_env(request["scenario"], duration_s=request["duration_s"], simulator="inprocess")
    learning = learner_factory(request["learner"])(env, request["seed"])
    learning.learn(env, 1, seed=request["seed"])  # imports and other work that is done once
    with CpuShares({name: folder_of(name) for name in ("libsumo", "torch")}) as shares:
        learning.learn(env, request["episodes"], seed=request["seed"])
    env.close()
    return shares.seconds


def _cpu_s(env: VectorEnv) -> float:
    """Return CPU seconds of the simulations; nan if the system does not tell them."""
    total = 0.0
    for remote in env._environments:
        stat = Path(f"/proc/{remote._worker._pid if remote._worker else 0}/stat")
        if not stat.exists():
            return float("nan")
        user, system = stat.read_text().rpartition(")")[2].split()[11:13]
        total += (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
    return total


def _memory_mib() -> float:
    """Return the memory of this process and its descendants; shared pages count by share."""
    total = 0.0
    for pid, resident in family(processes(), os.getpid()).items():
        try:
            text = Path(f"/proc/{pid}/smaps_rollup").read_text()
        except OSError:  # no Linux, or the process has ended meanwhile
            total += resident
        else:
            total += int(text.partition("\nPss:")[2].split()[0]) / 1024
    return total


def _vehicles(counts: NDArray[np.float32]) -> float:
    """Return the vehicles on incoming lanes.

    The observation `count` holds vehicles / 40 for each lane, and a one-hot of the phase, whose sum
    is 1 per agent.
    """
    return 40.0 * (float(counts.sum()) - counts.shape[0] * counts.shape[1])


def _kill(env: VectorEnv, number: int) -> None:
    worker = env._environments[number]._worker
    if worker is not None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(worker._pid, signal.SIGKILL)


INTERVAL_S = 0.001
"""CPU seconds between two samples of `CpuShares`."""


class CpuShares:
    """CPU seconds of the main thread, by the package of the innermost Python function.

    A timer of CPU time interrupts the process. The time since the last sample is charged to the
    Python function that runs at this moment. A long call into compiled code is interrupted when it
    returns, and its whole time is charged to the Python function that called it.

    Args:
        packages: Name of a share to the folder of its package; all other code is "rest".

    Attributes:
        seconds: CPU seconds of each share so far.
    """

    def __init__(self, packages: Mapping[str, Path]) -> None:
        self._folders = {str(folder) + "/": name for name, folder in packages.items()}
        self._known: dict[str, str] = {}
        self._last = 0.0
        self._before: Any = None
        self.seconds = dict.fromkeys([*packages, "rest"], 0.0)

    def __enter__(self) -> CpuShares:
        self._before = signal.signal(signal.SIGPROF, self._sample)
        self._last = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, INTERVAL_S, INTERVAL_S)
        return self

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        self._sample(signal.SIGPROF, sys._getframe())
        signal.signal(signal.SIGPROF, self._before)

    def _sample(self, _: int, frame: FrameType | None) -> None:
        now = time.process_time()
        file = frame.f_code.co_filename if frame is not None else ""
        self.seconds[self._share(file)] += now - self._last
        self._last = now

    def _share(self, file: str) -> str:
        if file not in self._known:
            owners = (name for folder, name in self._folders.items() if file.startswith(folder))
            self._known[file] = next(owners, "rest")
        return self._known[file]


def folder_of(package: str) -> Path:
    """Return the folder of an importable package."""
    module = importlib.import_module(package)
    assert module.__file__ is not None
    return Path(module.__file__).parent


WORK: Mapping[str, Callable[[Request], dict[str, Any]]] = {
    "steps": steps, "split": split, "grounded": grounded, "leaks": leaks, "kills": kills,
    "decide": decide, "ray": ray, "learner": learner,
}  # fmt: skip


if __name__ == "__main__":
    asked, answer = map(Path, sys.argv[1:3])
    told = json.loads(asked.read_text())
    answer.write_text(json.dumps(WORK[told["work"]](told)))
