"""Uncertainty-aware Grounded Action Transformation, network-wide: Algorithm 1 of the paper.

Da, Mei, Sharma, Wei: Uncertainty-aware Grounded Action Transformation towards Sim-to-Real Transfer
for Traffic Signal Control, CDC 2023.
"""

from __future__ import annotations

import concurrent.futures
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from ugat_marl.data import AgentLayout, Run, TransitionLog
from ugat_marl.envs import AnyParallelEnv
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.grounding.delays import TimedConfig
from ugat_marl.grounding.fit_config import FitConfig
from ugat_marl.grounding.fit_report import FitReport
from ugat_marl.grounding.fitting import fit
from ugat_marl.grounding.forward import ForwardConfig
from ugat_marl.grounding.gate import GateConfig, GateReport
from ugat_marl.grounding.inverse import InverseConfig
from ugat_marl.grounding.matching import Paid, episode_rewards
from ugat_marl.grounding.timed import TimedTransform
from ugat_marl.grounding.timed_fitting import fit_timed
from ugat_marl.grounding.timed_report import TimedReport
from ugat_marl.grounding.transform import GroundedActionTransform, Transform
from ugat_marl.grounding.view import InputsConfig, Neighbours
from ugat_marl.grounding.worlds import SimulatedWorld, World
from ugat_marl.grounding.wrapper import GroundedEnv
from ugat_marl.policies import Learner, Policy, device_of
from ugat_marl.seeding import derive_seed

CHUNK = 10
"""Episodes of plain training between two checkpoints."""

GROUNDINGS = ("phase", "timed")

DIRECT_LEARNER = "direct-learner.pt"
"""The learner as it was after plain training, in the run's folder: where controls start from."""


@dataclass(frozen=True)
class UgatConfig:
    """Settings of the algorithm.

    Attributes:
        grounding: What a grounded action is: "phase", another phase, as in the paper; "timed", the
            policy's own phase with a green that begins later.
        pretrain_episodes: M, episodes in plain sim before the first iteration.
        iterations: I, rounds of rolling out, fitting and grounded training.
        grounded_episodes: E, episodes of training in the grounded sim per iteration.
        sim_rollouts: Episodes added to D_sim per iteration.
        real_rollouts: Episodes added to D_real per iteration.
        rollout_epsilon: Chance of a random phase in these roll-outs.
        least_accuracy: Held-out accuracy h must have at an intersection before grounded actions
            are taken there; f and h must beat their trivial rivals, too, which is all that 0 asks.
            None obeys them from the start, as the paper does. With "timed" the share by which h
            must beat a guess.
        inputs: What f and h see beside the intersection's own state and action.
        forward: Shape of f.
        inverse: Shape of h.
        fit: How f and h are fitted.
        gate: How alpha is found.
        timed: How greens are delayed, with "timed".
    """

    grounding: Literal["phase", "timed"] = "phase"
    pretrain_episodes: int = 60
    iterations: int = 4
    grounded_episodes: int = 10
    sim_rollouts: int = 3
    real_rollouts: int = 3
    rollout_epsilon: float = 0.3
    least_accuracy: float | None = 0.0
    inputs: InputsConfig = field(default_factory=InputsConfig)
    forward: ForwardConfig = field(default_factory=ForwardConfig)
    inverse: InverseConfig = field(default_factory=InverseConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    gate: GateConfig = field(default_factory=GateConfig)
    timed: TimedConfig = field(default_factory=TimedConfig)

    @property
    def most_delay_s(self) -> int:
        """Longest of the random delays in the roll-outs for D_sim; 0 for none."""
        return self.timed.most_s if self.grounding == "timed" else 0

    @property
    def matches(self) -> bool:
        """Whether the simulation is asked under which delays it pays what the street pays."""
        return self.grounding == "timed" and self.timed.match

    @property
    def identity(self) -> dict[str, Any]:
        """The settings by which runs are told apart; later ones only if they are used."""
        settings = asdict(self)
        if not self.timed.match:  # runs from before it could can be resumed
            settings["timed"].pop("match")
        return settings

    def transform(
        self,
        layouts: Mapping[str, AgentLayout],
        seed: int,
        neighbours: Neighbours | None = None,
    ) -> Transform:
        """Unfitted models and gate for these agents.

        Args:
            layouts: Agent to the division of its observation.
            seed: Decides the initial weights.
            neighbours: Agent to the agents one road away (`grounding.view.neighbours_of`); needed
                for inputs with hops.
        """
        parts, around = (self.forward, self.inverse, self.gate), (self.inputs, neighbours)
        if self.grounding == "timed":
            return TimedTransform(layouts, seed, *parts, self.timed, *around)
        return GroundedActionTransform(layouts, seed, *parts, *around)

    def __post_init__(self) -> None:
        if self.grounding not in GROUNDINGS:
            raise UnknownNameError("grounding", self.grounding, GROUNDINGS)
        for name, least in (
            ("pretrain_episodes", 0),
            ("iterations", 0),
            ("grounded_episodes", 1),
            ("sim_rollouts", 1),
            ("real_rollouts", 1),
        ):
            if getattr(self, name) < least:
                raise OptionError(f"{name} = {getattr(self, name)}: must be at least {least}")
        for name in ("rollout_epsilon", "least_accuracy"):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= 1:
                raise OptionError(f"{name} = {value}: must be from 0 to 1")


@dataclass
class State:
    """Where a run stands; everything that a checkpoint holds.

    Attributes:
        learner: The policy in training.
        transform: f, h and gate.
        direct: The policy after plain training: direct transfer.
        simulated: D_sim.
        real: D_real.
        pretrained: Episodes of plain training so far.
        iteration: Iterations completed.
    """

    learner: Learner
    transform: Transform
    direct: Policy | None = None
    simulated: list[TransitionLog] = field(default_factory=list)
    real: list[TransitionLog] = field(default_factory=list)
    pretrained: int = 0
    iteration: int = 0


Probe = Callable[[Policy], Mapping[str, float]]
"""Measures a policy between iterations; the numbers are logged and never decide anything."""


def train_ugat(
    state: State,
    env: AnyParallelEnv,
    sim: SimulatedWorld,
    real: World,
    config: UgatConfig,
    seed: int,
    run: Run,
    probe: Probe | None = None,
    device: str = "cpu",
) -> Policy:
    """Algorithm 1: pre-train in sim, then iterate roll-outs, fitting and grounded training.

    Args:
        state: A fresh state, or one restored from a checkpoint.
        env: The simulation to train in.
        sim: Fills D_sim.
        real: Fills D_real.
        config: Settings.
        seed: Root of every random choice.
        run: Where metrics and checkpoints go.
        probe: Measures the policy after every iteration.
        device: Where f and h are fitted (`devices.device_of`); the learner has its own.

    Returns:
        The policy after the last iteration.
    """
    place = device_of(device)
    _pretrain(state, env, config, seed, run, probe)
    grounded = GroundedEnv(env, state.transform)
    while state.iteration < config.iterations:
        i = state.iteration
        policy = state.learner.policy()
        _collect(state, sim, real, policy, i, seed, run)
        paid = _pay(state, sim, policy, i, seed, run) if config.matches else None
        report = _fit(state, config, derive_seed(seed, "fit", i), run, i, place, paid)
        if config.least_accuracy is not None:
            state.transform.gate.trust(report.trusted(config.least_accuracy))
        state.transform.gate.begin(report.expected_u)
        _learn(state, grounded, config.grounded_episodes, seed, run, f"grounded, round {i + 1}")
        gate = _update_alpha(state, run)
        run.log("iteration", i + 1, _numbers(report, gate, state, probe))
        state.iteration += 1
        save(state, run)
    return state.learner.policy()


def _pretrain(
    state: State,
    env: AnyParallelEnv,
    config: UgatConfig,
    seed: int,
    run: Run,
    probe: Probe | None,
) -> None:
    while state.pretrained < config.pretrain_episodes:
        episodes = min(CHUNK, config.pretrain_episodes - state.pretrained)
        done = f"{state.pretrained + 1}-{state.pretrained + episodes}"
        _learn(state, env, episodes, seed, run, f"plain sim, episode {done}")
        state.pretrained += episodes
        if state.pretrained < config.pretrain_episodes:
            save(state, run)
    if state.direct is None:
        state.direct = state.learner.policy()
        state.learner.save(run.directory / DIRECT_LEARNER)
        if probe is not None:
            run.log("iteration", 0, probe(state.direct))
        save(state, run)


def _learn(
    state: State, env: AnyParallelEnv, episodes: int, seed: int, run: Run, title: str
) -> None:
    with run.reporter.task(title, episodes) as advance:

        def on_episode(number: int, numbers: Mapping[str, float]) -> None:
            run.log("episode", number, numbers)
            advance(note=f"return {numbers['return']:.0f}" if "return" in numbers else "")

        state.learner.learn(env, episodes, seed, on_episode)


def _collect(
    state: State, sim: World, real: World, policy: Policy, iteration: int, seed: int, run: Run
) -> None:
    """Rolls the policy out in both worlds at the same time."""
    with (
        run.reporter.task(f"roll-outs, round {iteration + 1}", 2) as advance,
        concurrent.futures.ThreadPoolExecutor(2) as pool,
    ):
        running = [pool.submit(world.collect, policy, iteration, seed) for world in (sim, real)]
        try:
            while concurrent.futures.wait(running, timeout=0.2).not_done:
                pass  # wakes up now and then, so that Ctrl-C is heard
        except BaseException:
            sim.stop()
            real.stop()
            raise
        for future, data in zip(running, (state.simulated, state.real), strict=True):
            log = future.result()
            if log is not None:
                data.append(log)
            advance()


def _pay(
    state: State, sim: SimulatedWorld, policy: Policy, iteration: int, seed: int, run: Run
) -> Paid:
    """What the policy gets in `sim` under each delay, beside what it just got in both worlds."""
    agents = state.transform.stack.agents
    title = f"under delays, round {iteration + 1}"
    with run.reporter.task(title, sim.roll_outs_under_delays) as advance:
        logs = sim.under_delays(policy, iteration, seed, advance)
    *before, street = [episode_rewards(log, agents) for log in state.real]
    return Paid(street, np.array([episode_rewards(log, agents) for log in logs]), before)


def _fit(
    state: State,
    config: UgatConfig,
    seed: int,
    run: Run,
    iteration: int,
    device: torch.device,
    paid: Paid | None,
) -> FitReport | TimedReport:
    transform = state.transform
    real, simulated = (TransitionLog.concatenate(logs) for logs in (state.real, state.simulated))
    most = 3 * config.fit.epochs  # f, a model of the simulation, and h
    with run.reporter.task(f"fitting f and h, round {iteration + 1}", most) as go:

        def on_epoch(model: str, _epoch: int, loss: float) -> None:
            go(note=f"{model} {loss:.2g}")

        if isinstance(transform, TimedTransform):
            how = config.fit, seed, on_epoch, device, paid
            report = fit_timed(transform, real, simulated, *how)
        else:
            assert isinstance(transform, GroundedActionTransform)
            models = transform.forward, transform.inverse
            report = fit(*models, real, simulated, config.fit, seed, on_epoch, device)
    for warning in report.warnings:
        run.reporter.say(f"round {iteration + 1}: {warning}")
    return report


def _update_alpha(state: State, run: Run) -> GateReport:
    """Sets alpha for the next iteration; what the gate warns of is said beside the bars."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        report = state.transform.gate.update()
    if report.warning:
        run.reporter.say(report.warning)
    return report


def _numbers(
    report: FitReport | TimedReport, gate: GateReport, state: State, probe: Probe | None
) -> dict[str, float]:
    numbers = {**report.as_dict(), **{f"gate/{k}": v for k, v in gate.as_dict().items()}}
    if probe is not None:
        numbers |= probe(state.learner.policy())
    return numbers


def save(state: State, run: Run) -> None:
    """Makes a checkpoint of `state`."""

    def write(folder: Path) -> None:
        state.learner.save(folder / "learner.pt")
        state.transform.save(folder / "grounding.pt")
        if state.direct is not None:
            _save_policy(state.direct, folder / "direct.pt")
        for name, logs in (("sim", state.simulated), ("real", state.real)):
            for number, log in enumerate(logs):
                log.write(folder / f"{name}-{number:03}.parquet")

    run.save({"pretrained": state.pretrained, "iteration": state.iteration}, write)


def restore(state: State, run: Run, load_policy: Callable[[Path], Policy]) -> None:
    """Brings a fresh `state` to where the run's checkpoint stands, if there is one.

    Raises:
        CheckpointError: The checkpoint cannot be used.
        LogError: One of its logs cannot.
    """
    if not run.resumable:
        return

    def read(folder: Path) -> None:
        state.learner.load(folder / "learner.pt")
        state.transform.load(folder / "grounding.pt")
        if (folder / "direct.pt").exists():
            state.direct = load_policy(folder / "direct.pt")
        state.simulated = _logs(folder, "sim")
        state.real = _logs(folder, "real")

    found = run.restore(read)
    state.pretrained = int(found["pretrained"])
    state.iteration = int(found["iteration"])


def _logs(folder: Path, name: str) -> list[TransitionLog]:
    return [TransitionLog.read(path) for path in sorted(folder.glob(f"{name}-*.parquet"))]


def _save_policy(policy: Any, path: Path) -> None:
    if not hasattr(policy, "save"):
        raise OptionError(
            f"a checkpoint needs policies that can be saved: give {type(policy).__name__} a method "
            "save(path)"
        )
    policy.save(path)
