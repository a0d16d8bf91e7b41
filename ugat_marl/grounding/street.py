"""Fitted street: the worlds that a log of the street leaves possible, to train a policy in.

Where `PhaseTransform` and `TimedTransform` change single actions, this grounding changes the
simulation: its command channel, its detectors, the service of its lanes and its effects. Each part
is fitted from the transition log with its own uncertainty, and every training episode runs in
another draw.

    Input: policy pi, log D_real of pi, prior of worlds

     1  fit the command channel to D_real (`channel`)
     2  roll pi out in the simulation with this channel; fit the detectors (`eyes`)
     3  for i = 1, ..., N: draw a world from the prior, roll pi out in it with channel and detectors
     4  fit the posterior of worlds from the statistics of all logs (`posterior`)

With no data this is domain randomisation; the more a log tells, the nearer it is to a corrected
simulation. What no part explains is left to f and h on top of it (`residual`).
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pettingzoo.utils import BaseParallelWrapper
from torch import Tensor

from ugat_marl.data import TransitionLog, read_checkpoint, write_checkpoint
from ugat_marl.effects import ControllerPart, Effect
from ugat_marl.envs import AgentSet, ResetResult, TrafficEnv, parallel_env
from ugat_marl.errors import (
    CheckpointError,
    LogError,
    OptionError,
    ScenarioError,
    UnknownNameError,
    require_kinds,
    require_ranges,
)
from ugat_marl.files import MALFORMED
from ugat_marl.grounding.channel import (
    ChannelConfig,
    CommandChannel,
    fit_channel,
    require_histories,
)
from ugat_marl.grounding.eyes import (
    ZONES_M,
    Eyes,
    EyesConfig,
    fit_eyes,
    leave_unseen,
    zone_of_unseen,
)
from ugat_marl.grounding.posterior import (
    LIBRARY,
    FittedService,
    Posterior,
    SimulatedLog,
    WorldPrior,
    WorldValues,
)
from ugat_marl.grounding.residual import ResidualConfig, of_one_street
from ugat_marl.grounding.summaries import LaneView, Summary
from ugat_marl.grounding.worlds import RecordedCommands, delayed, explored
from ugat_marl.parallel import Stop, Workers, in_order, retry_on_crash
from ugat_marl.policies import Policy, roll_out, stop_callback
from ugat_marl.scenarios import Scenario
from ugat_marl.seeding import derive_seed, numpy_generator

KIND = "street"
"""Name of this kind of checkpoint, written into the file."""
VERSION = 3
"""Version of this kind of checkpoint. It changes with what a fit holds."""

PARTS = ("channel", "eyes", "service", "effects")
"""Parts of a street, each of which can be left out."""


RIVALS: dict[str, tuple[float | None, ...]] = {
    "none": (), "matched": (None,), "several": (None, 3.0, 5.0),
}  # fmt: skip
"""Policies that may compete with the one that was trained in the fitted street: how late the greens
are with which they train, in s; None for the delay that rewards ask for."""

RULE_BUDGET = 6
"""Budget of each rule in worlds of the fitted street, with a learner that rules teach."""

LEAST_DECISIONS = 30
"""Least decisions of a world, unless log or episodes are shorter: fewer are a few phases."""


@dataclass(frozen=True)
class StreetConfig:
    """Settings of the fit of a street.

    Attributes:
        parts: Parts that are fitted.
        simulations: N, worlds that are simulated for the first fit: six in ten from the prior,
            the others near the street, by a fit to these.
        further: Worlds that each further iteration adds, half of them drawn from the posterior.
        simulated_s: Length of an episode in such a world, in s; at least 30 decisions are always
            simulated. Of longer episodes of the street only this first part is compared. Detectors
            are compared over whole episodes.
        judged: Most worlds of the fitted street in which policies race after each iteration. All
            play in eight worlds, and those that are clearly slower leave before the next eight; the
            best one is kept. 0 keeps the last one.
        rule_budget: Budget that decides how many settings of each rule race in worlds of the fitted
            street. The best rule of all teaches the learner, and is kept if it is better than the
            trained policies. With 0 only trained policies are kept. None stands for 6 with a
            learner that rules teach, and for 0 with others.
        rival: "matched": a second learner trains in the simulation with greens that are late until
            rewards match, and its policy is compared with the others. "several": so do a third and
            a fourth one, with greens that are 3 and 5 s late. "none" goes without.
        without: Effects left out of the library.
        channel: Numbers of the fit of the command channel.
        eyes: Numbers of the fit of the detectors.
        residual: f, h and gate on top of the fitted street, for what its parts do not explain.
    """

    parts: tuple[str, ...] = PARTS
    simulations: int = 160
    further: int = 40
    simulated_s: float = 1800.0
    judged: int = 40
    rule_budget: int | None = None
    rival: Literal["none", "matched", "several"] = "several"
    without: tuple[str, ...] = ()
    channel: ChannelConfig = field(default_factory=ChannelConfig)
    eyes: EyesConfig = field(default_factory=EyesConfig)
    residual: ResidualConfig = field(default_factory=ResidualConfig)

    def __post_init__(self) -> None:
        if self.rival not in tuple(RIVALS):  # a list has no hash
            raise UnknownNameError("rival", self.rival, RIVALS)
        require_kinds(self, "street")
        object.__setattr__(self, "parts", tuple(self.parts))
        object.__setattr__(self, "without", tuple(self.without))
        for part in self.parts:
            if part not in PARTS:
                raise UnknownNameError("part of a street", part, PARTS)
        library = [item.name for item in LIBRARY]
        for effect in self.without:
            if effect not in library:
                raise UnknownNameError("effect of the library", effect, library)
        least = {"simulations": 20, "further": 0, "judged": 0}
        require_ranges(self, "street", at_least=least, positive=("simulated_s",))
        if self.rule_budget is not None and (self.rule_budget < 0 or self.rule_budget == 1):
            raise OptionError(
                f"street rule_budget is {self.rule_budget}; allowed: >= 2, or 0 for no rules"
            )

    def budget_of_rules(self, *, taught: bool) -> int:
        """Return the budget of the race of rules, or 0 without one.

        Args:
            taught: True if rules teach the learner.
        """
        if self.rule_budget is None:
            return RULE_BUDGET if taught else 0
        return self.rule_budget

    @property
    def longest_lag(self) -> int:
        """Longest delay of commands or counts that is looked for, in decisions; at least 1."""
        commands = self.channel.most_lag if "channel" in self.parts else 1
        counts = self.eyes.most_lag if "eyes" in self.parts else 1
        return max(1, commands, counts)

    @property
    def late_s(self) -> tuple[float | None, ...]:
        """Delay of the greens of each rival, in s; see `RIVALS`."""
        return RIVALS[self.rival] if self.judged > 0 else ()

    def of_log(self, real: TransitionLog) -> StreetConfig:
        """Return the settings for a log; estimated vehicles are no readings of detectors."""
        if not real.provenance.deviation:
            return self
        return replace(self, parts=tuple(part for part in self.parts if part != "eyes"))

    @property
    def simulates(self) -> bool:
        """True if worlds are simulated."""
        return "service" in self.parts or "effects" in self.parts


@dataclass(frozen=True)
class StreetWorld:
    """One world: effects of the library, and changes of commands, detectors and greens."""

    effects: tuple[Effect, ...] = ()
    parts: tuple[ControllerPart, ...] = ()


@dataclass(frozen=True)
class FittedStreet:
    """The fitted parts of a street; None for a part that was not fitted.

    Attributes:
        lanes: Ids of the lanes.
        interval_s: Seconds from one decision to the next.
        channel: The command channel.
        eyes: The faults of detectors.
        posterior: The worlds: effects, and service of lanes.
    """

    lanes: tuple[str, ...]
    interval_s: float
    channel: CommandChannel | None = None
    eyes: Eyes | None = None
    posterior: Posterior | None = None

    @property
    def commands(self) -> int:
        """Number of own commands that a policy has to see; 0 for none."""
        return 0 if self.channel is None else self.channel.memory

    @property
    def late(self) -> bool:
        """True if some commands act in a later decision."""
        return self.channel is not None and self.channel.late

    def world(self, seed: int) -> StreetWorld:
        """Draw the world of an episode."""
        if self.posterior is None:
            return StreetWorld(parts=self._parts(seed))
        return self.around(self.posterior.worlds, self.posterior.draw(seed), seed)

    def around(self, worlds: WorldPrior, values: WorldValues, seed: int) -> StreetWorld:
        """Draw the world of an episode, of which effects and service are given."""
        service = FittedService(self.lanes, values.service_s)
        return StreetWorld(worlds.effects(values), (*self._parts(seed), service))

    def _parts(self, seed: int) -> tuple[ControllerPart, ...]:
        """Draw what commands and detectors do in an episode."""
        parts: list[ControllerPart] = []
        if self.channel is not None and self.channel.changes:
            parts.append(self.channel)
        if self.eyes is not None:
            parts += self.eyes.parts(seed, self.lanes, self.interval_s)
        return tuple(parts)

    def describe(self) -> list[str]:
        """Return what was found, a line for each part."""
        lines = [part.describe() for part in (self.channel, self.eyes) if part is not None]
        if self.posterior is not None:
            lines += self.posterior.describe()
        return lines

    def as_dict(self, lanes_of: Mapping[str, Sequence[int]]) -> dict[str, float]:
        """Return flat numbers for the metrics of a run.

        Args:
            lanes_of: Agent to the positions of its lanes (`LaneView.lanes_of`).
        """
        numbers: dict[str, float] = {"street/commands": float(self.commands)}
        if self.channel is not None:
            numbers |= self.channel.as_dict(self.interval_s)
        if self.eyes is not None:
            numbers |= self.eyes.as_dict(lanes_of)
        if self.posterior is not None:
            numbers |= self.posterior.as_dict(lanes_of)
        return numbers

    def save(self, path: Path, simulated: Sequence[SimulatedLog] = ()) -> None:
        """Write the street to a file atomically.

        Args:
            path: The file.
            simulated: Simulated worlds for a further fit.
        """
        content: dict[str, Any] = {
            "version": VERSION,
            "lanes": list(self.lanes),
            "interval_s": self.interval_s,
        }
        for name in ("channel", "eyes", "posterior"):
            part = getattr(self, name)
            content[name] = None if part is None else part.state_dict()
        if self.posterior is not None:
            content["library"] = [vars(item) for item in self.posterior.worlds.library]
        content["simulated"] = _arrays(simulated)
        write_checkpoint(path, KIND, content)

    @classmethod
    def load(cls, path: Path, worlds: WorldPrior) -> tuple[FittedStreet, FitHistory]:
        """Read a file of `save`.

        Args:
            path: The file.
            worlds: Prior of the network.

        Returns:
            The street, and what a further fit continues.

        Raises:
            CheckpointError: The file is unreadable, or of another network.
        """
        content = read_checkpoint(path, KIND)
        if content.get("version") != VERSION:
            raise CheckpointError(
                f"{path}: the street was fitted by another version, in another way: begin the run "
                "anew"
            )
        if tuple(content.get("lanes", ())) != worlds.lanes:
            raise CheckpointError(f"{path}: the street has other lanes than this network")
        if content.get("library") not in (None, [vars(item) for item in worlds.library]):
            raise CheckpointError(f"{path}: the street was fitted with another library of effects")
        if "interval_s" not in content:
            raise CheckpointError(f"{path}: the street in the checkpoint is damaged: no interval_s")
        channel, eyes, posterior = (content.get(x) for x in ("channel", "eyes", "posterior"))
        street = cls(
            worlds.lanes,
            float(content["interval_s"]),
            None if channel is None else CommandChannel.from_state(channel),
            None if eyes is None else Eyes.from_state(eyes),
            None if posterior is None else Posterior.from_state(worlds, posterior),
        )
        return street, FitHistory(_simulated(content.get("simulated")), street.posterior)


ENOUGH = 100
"""Simulations below which the errors of a fit are known from too few worlds: by hand."""


@dataclass(frozen=True)
class Simulation:
    """The simulation in which worlds are drawn, and its settings.

    Attributes:
        scenario: The network and its traffic.
        options: Options of the environments.
        epsilon: Chance of a random phase in roll-outs.
        workers: Simulations at a time, or an executor.
        most_delay_s: Longest random delay of greens in roll-outs, in s; 0 for none.
    """

    scenario: Scenario
    options: Mapping[str, Any]
    epsilon: float
    workers: Workers = None
    most_delay_s: int = 0

    @property
    def longest_s(self) -> float:
        """Length of an episode in s."""
        return self.options.get("duration_s") or self.scenario.settings.duration_s

    def env(self, world: StreetWorld, **options: Any) -> TrafficEnv:
        """Return an environment of a world."""
        fitted = (*self.options.get("fitted", ()), *world.parts)
        given: dict[str, Any] = {**self.options, **options, "fitted": fitted}
        return parallel_env(self.scenario, world.effects, **given)

    def shown(self, commands: int) -> int:
        """Return how many own commands agents see, where a street asks for some.

        Agents that see commands in any case see no other number of them: their policies go on.
        """
        return int(self.options.get("commands", 0)) or commands

    def plain(self, commands: int) -> TrafficEnv:
        """Return the unchanged simulation, in which agents see their own commands.

        Args:
            commands: Number of commands, for agents that see none otherwise.
        """
        return self.env(StreetWorld(), commands=self.shown(commands))

    def play(self, world: StreetWorld, policy: Policy, seed: int, stop: Stop) -> TransitionLog:
        """Run one episode in a world and record it."""
        env = delayed(self.env(world, **policy.env_options, crossings=True), self.most_delay_s)
        return explored(env, policy, self.epsilon, seed, stop)

    def att_s(self, world: StreetWorld, policy: Policy, seed: int, stop: Stop) -> float:
        """Run one episode in a world; return the average travel time in s."""
        with contextlib.closing(self.env(world, **policy.env_options)) as env:
            acting, check = copy.deepcopy(policy), stop_callback(stop)
            retry_on_crash(lambda: roll_out(env, acting, seed, on_step=check))
            return env.scores().att_s

    def compare(
        self,
        worlds: Sequence[StreetWorld],
        policies: Sequence[Policy],
        seeds: Sequence[int],
        on_done: Callable[[], object],
    ) -> NDArray[np.float64]:
        """Run each policy in each world with the world's seed.

        Returns:
            Average travel times in s, ``(policies, worlds)``.
        """
        stop = Stop()
        pairs = list(zip(worlds, seeds, strict=True))
        parts = [(world, policy, seed, stop) for policy in policies for world, seed in pairs]
        alone = replace(self, workers=None)  # an executor cannot be sent to its own processes
        times_s = in_order(self.workers, alone.att_s, parts, stop, lambda _: on_done())
        return np.array(times_s).reshape(len(policies), len(worlds))

    def logs(
        self,
        worlds: Sequence[StreetWorld],
        policy: Policy,
        seeds: Sequence[int],
        duration_s: float | None,
        on_done: Callable[[], object],
    ) -> list[TransitionLog]:
        """Run one episode in each world; return the logs in their order."""
        stop = Stop()
        options = {**self.options}
        if duration_s is not None:
            options["duration_s"] = min(duration_s + _lead_s(policy), self.longest_s)
        short = replace(self, options=options, workers=None)
        parts = [(world, policy, seed, stop) for world, seed in zip(worlds, seeds, strict=True)]
        logs = in_order(self.workers, short.play, parts, stop, lambda _: on_done())
        if duration_s is None:
            return logs
        return [log.first(round(duration_s / log.provenance.decision_interval_s)) for log in logs]


def _lead_s(policy: Policy) -> float:
    """Return the seconds that a policy plays before the log whose commands it repeats begins."""
    return policy.longest_lead_s if isinstance(policy, RecordedCommands) else 0.0


AIMED = 0.4
"""Share of the worlds of a first fit that are drawn from the posterior of the others."""

LEARNT = 0.75
"""Chance of each effect in worlds that are simulated to learn from: by hand, from tries on streets
of `single-v1` (results/notes/how-often-does-the-posterior-hold-the-truth.md)."""

BASELINE_EPISODES = 2
"""Episodes of the plain simulation with which detectors are compared."""


@dataclass(frozen=True)
class FitHistory:
    """Results of earlier fits, which a further fit continues.

    Attributes:
        simulated: Simulated worlds and the statistics of their logs.
        posterior: The last posterior; None before the first one.
    """

    simulated: tuple[SimulatedLog, ...] = ()
    posterior: Posterior | None = None

    def new_worlds(self, config: StreetConfig) -> int:
        """Return how many worlds the next fit simulates."""
        return config.simulations if self.posterior is None else config.further

    def rounds(self, config: StreetConfig) -> list[tuple[int, int]]:
        """Return how many worlds of each round come from the prior and from the posterior so far.

        Few worlds of the prior are near any one street. Those of the posterior are, and the
        regression is most accurate where its worlds are.
        """
        worlds = self.new_worlds(config)
        if self.posterior is None:
            aimed = int(AIMED * worlds)
            return [(worlds - aimed, 0), (0, aimed)]
        return [(worlds // 2, worlds - worlds // 2)]


def require_room(policy: Policy, longest: int) -> None:
    """Refuse recorded commands of which episodes of the simulation hold too few.

    Args:
        policy: Policy that acts in the simulated worlds; only one that repeats a log is refused.
        longest: Decisions of an episode of the simulation.

    Raises:
        LogError: Behind the begin of an episode of the log too few decisions are left.
    """
    if not isinstance(policy, RecordedCommands):
        return
    for episode, decisions, left in policy.left(longest):
        if left < min(LEAST_DECISIONS, decisions, longest):
            raise LogError(
                f"only {left * policy.interval_s:g} s of an episode are left behind the begin of "
                f"episode {episode} of the log: choose a longer --duration-s (duration_s), or "
                "leave that episode out"
            )


def fit_street(
    real: TransitionLog,
    simulation: Simulation,
    policy: Policy,
    worlds: WorldPrior,
    view: LaneView,
    config: StreetConfig,
    seed: int,
    on_done: Callable[[], object] = lambda: None,
    history: FitHistory | None = None,
) -> tuple[FittedStreet, FitHistory]:
    """Fit the parts of a street to its log (lines 1 to 4).

    Args:
        real: Transitions of the street.
        simulation: The simulation.
        policy: Latest policy of the log; it acts in the simulated worlds, too.
        worlds: Prior of worlds.
        view: Lanes of the network, as the log shows them.
        config: Settings.
        seed: Root of every random choice.
        on_done: Called after each simulated episode, except the extra ones that estimate short
            detection zones.
        history: Results of earlier fits to the same street.

    Returns:
        The street, and the results for a further fit.

    Raises:
        LogError: Too many decisions are missing in the log, or they are not in sequence; or too few
            fit into an episode behind its begin.
    """
    require_histories(real, config.longest_lag)
    history = history or FitHistory()
    lanes, interval_s = worlds.lanes, real.provenance.decision_interval_s
    timing = simulation.scenario.timing
    held_s = timing.clearance_s + timing.min_green_s
    channel = fit_channel(real, config.channel, held_s) if "channel" in config.parts else None
    street = FittedStreet(lanes, interval_s, channel)
    longest = max(1, int(simulation.longest_s / interval_s + 1e-9))
    reached = real.first(longest)
    if isinstance(policy, RecordedCommands):
        reached = policy.within(real, longest)
    if "eyes" in config.parts:
        eyes = _eyes(reached, simulation, policy, street, view, config.eyes, seed, on_done)
        street = replace(street, eyes=eyes)
    if not config.simulates:
        return street, history
    require_room(policy, longest)
    # Queues grow through a peak: worlds of half an hour tell nothing of an hour's second half.
    wanted = max(int(config.simulated_s / interval_s), LEAST_DECISIONS)
    decisions = min(wanted, reached.decisions)
    begun = reached.first(decisions)
    seen = view.summary(begun)
    simulated, posterior = list(history.simulated), history.posterior
    for prior, aimed in history.rounds(config):
        first, number = len(simulated) - len(history.simulated), prior + aimed
        ids = [derive_seed(seed, "street", "values", first + k) for k in range(number)]
        values = [worlds.draw(one, LEARNT) for one in ids[:prior]]
        if posterior is not None:
            values += [posterior.draw(one, LEARNT) for one in ids[prior:]]
        seeds = [derive_seed(seed, "street", "world", first + k) for k in range(number)]
        drawn = [street.around(worlds, *pair) for pair in zip(values, seeds, strict=True)]
        logs = simulation.logs(drawn, policy, seeds, decisions * interval_s, on_done)
        simulated += [
            SimulatedLog(one, view.summary(_as_recorded(log, begun)))
            for one, log in zip(values, logs, strict=True)
        ]
        posterior = Posterior.fit(worlds, simulated, seen)
    street = FittedStreet(lanes, interval_s, channel, street.eyes, posterior)
    return street, FitHistory(tuple(simulated), posterior)


def _as_recorded(simulated: TransitionLog, street: TransitionLog) -> TransitionLog:
    """Return a simulated log without decisions of an agent that no episode of the street has.

    A light whose log begins late would else be compared with queues of a begin that it lacks.
    """
    rows = simulated.frame.join(street.frame, on=("agent", "step"), how="semi")
    return TransitionLog(simulated.provenance, rows)


def _eyes(
    real: TransitionLog,
    simulation: Simulation,
    policy: Policy,
    street: FittedStreet,
    view: LaneView,
    config: EyesConfig,
    seed: int,
    on_done: Callable[[], object],
) -> Eyes:
    """Fit the detectors of a street of which the command channel is fitted."""
    seeds = [derive_seed(seed, "street", "baseline", k) for k in range(BASELINE_EPISODES)]
    duration_s = real.decisions * street.interval_s
    plain = [street.world(one) for one in seeds]
    baseline = TransitionLog.concatenate(simulation.logs(plain, policy, seeds, duration_s, on_done))
    # Of equal length: queues grow through a peak, and a log that ends before it has none.
    begun = real.first(baseline.decisions)
    eyes = fit_eyes(begun, baseline, view, config)
    if eyes.changes or not leave_unseen(begun, baseline, view, config):
        return eyes
    first = seeds[0]
    short = [
        replace(street, eyes=replace(eyes, zone_m=(length, length))).world(first)
        for length in ZONES_M
    ]
    logs = simulation.logs(short, policy, [first] * len(short), duration_s, lambda: None)
    tried = dict(zip(ZONES_M, logs, strict=True))
    return replace(eyes, zone_m=zone_of_unseen(begun, tried, view, config))


def street_log(
    street: FittedStreet,
    simulation: Simulation,
    policy: Policy,
    seeds: Sequence[int],
    on_done: Callable[[], object] = lambda: None,
) -> TransitionLog:
    """Roll the policy out in worlds drawn from a fitted street.

    Args:
        street: The fitted street.
        simulation: The simulation; its delays are those of the roll-outs.
        policy: Policy that acts.
        seeds: A seed for each world.
        on_done: Called after each episode.
    """
    worlds = [street.world(seed) for seed in seeds]
    return of_one_street(simulation.logs(worlds, policy, seeds, None, on_done))


def episodes_of_fit(config: StreetConfig, history: FitHistory) -> int:
    """Return the number of episodes that `fit_street` simulates, without those of short zones."""
    baseline = BASELINE_EPISODES if "eyes" in config.parts else 0
    return baseline + history.new_worlds(config) * config.simulates


class DrawnEnv(BaseParallelWrapper[str, Any, Any]):
    """Environment with another world in every episode; the seed of `reset` decides the world.

    The simulation of an episode ends before the next one begins.

    Args:
        env: The simulation, before the first episode; its agents are those of every world.
        make_env: Makes the environment of the world of a seed.
    """

    def __init__(self, env: TrafficEnv, make_env: Callable[[int], TrafficEnv]) -> None:
        super().__init__(env)
        self._make_env = make_env
        self._agents = AgentSet.of(self.env)
        self._generator = numpy_generator(0, "worlds")

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """Start an episode in a newly drawn world.

        Args:
            seed: Seed of world and traffic; None to draw it from the generator of the last seed.
            options: Passed to the environment.

        Raises:
            ScenarioError: The world has other agents than the simulation.
        """
        if seed is not None:
            self._generator = numpy_generator(seed, "worlds")
        else:
            seed = int(self._generator.integers(2**31))
        self.env.close()
        self.env = self._make_env(seed)
        if AgentSet.of(self.env) != self._agents:
            raise ScenarioError(
                f"the world {self.env.domain} has other agents, observations or phases than the "
                f"simulation: {AgentSet.of(self.env)}, not {self._agents}; draw effects on vehicles"
            )
        return self.env.reset(seed=seed, options=options)


def street_env(street: FittedStreet, simulation: Simulation, commands: int) -> DrawnEnv:
    """Return an environment that draws every episode's world from a fitted street.

    Args:
        street: The fitted street.
        simulation: The simulation.
        commands: Number of own commands that agents see, if they see none otherwise.
    """
    shown = simulation.shown(commands)
    return DrawnEnv(
        simulation.plain(commands),
        lambda seed: simulation.env(street.world(seed), commands=shown),
    )


def street_prior(env: TrafficEnv, config: StreetConfig) -> WorldPrior:
    """Return the prior of the worlds of an environment's network."""
    view = LaneView.of(env.network, str(env.options.observation))
    everything = tuple(item.name for item in LIBRARY)
    left_out = config.without if "effects" in config.parts else everything
    return WorldPrior.of(view.lanes, left_out, "service" in config.parts, env.scenario)


def _arrays(simulated: Sequence[SimulatedLog]) -> dict[str, Tensor]:
    """Return simulated worlds as tensors; statistics of too few decisions become 0."""
    if not simulated:
        return {}
    values = np.nan_to_num(np.stack([item.summary.values for item in simulated]))
    return {
        "effects": torch.tensor(np.stack([item.values.effects for item in simulated])),
        "service_s": torch.tensor(np.stack([item.values.service_s for item in simulated])),
        "values": torch.tensor(values),
        "rows": torch.tensor(np.stack([item.summary.rows for item in simulated])),
    }


def _simulated(arrays: Any) -> tuple[SimulatedLog, ...]:
    """Restore `_arrays`.

    Raises:
        CheckpointError: A tensor is missing, or their lengths differ.
    """
    if not arrays:
        return ()
    try:
        names = ("effects", "service_s", "values", "rows")
        columns = [arrays[name].numpy() for name in names]
        return tuple(
            SimulatedLog(WorldValues(effects, service_s), Summary.of(values, rows))
            for effects, service_s, values, rows in zip(*columns, strict=True)
        )
    except MALFORMED as error:
        raise CheckpointError(f"simulated worlds of the checkpoint are damaged: {error}") from None
