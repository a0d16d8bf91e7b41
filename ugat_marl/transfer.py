"""One experiment: train across the gap, judge in both worlds, say what was won."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from ugat_marl.controllers import STANDARD_RULES
from ugat_marl.effects import describe, in_domain, load
from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.evaluation import (
    TUNING_SEED,
    Evaluation,
    PolicyFactory,
    best_rules,
    evaluate,
    fixed_policy,
    rule_factory,
)
from ugat_marl.grounding.view import neighbours_of
from ugat_marl.learners.agents import AgentSet
from ugat_marl.learners.dqn import DQN
from ugat_marl.learners.dqn_config import DQNConfig
from ugat_marl.learners.dqn_policy import DQNPolicy
from ugat_marl.policy import Policy
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenario import Scenario
from ugat_marl.traffic_env import TrafficEnv, parallel_env
from ugat_marl.training import Run
from ugat_marl.transitions import TransitionLog
from ugat_marl.tuning import LEAST_BUDGET, TUNED_RULES, tuned_rules
from ugat_marl.ugat import (
    CHUNK,
    DIRECT_LEARNER,
    State,
    UgatConfig,
    restore,
    train_ugat,
)
from ugat_marl.worlds import RecordedWorld, SimulatedWorld, World

EVALUATION_SEED = 1000
"""First seed of the reported episodes; apart from those of training and of the search for rules."""

DIRECT, UGAT, TIMED = "direct transfer", "UGAT", "UGAT, timed"
CONTROL = "more plain sim"
CORRECTED = "corrected sim"


@dataclass(frozen=True)
class TransferConfig:
    """What to train, where, and how to judge it.

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        real: The real domain: V1..V4 or an alias, effect=value+..., or a scenario directory. "none"
            with `real_log`: nothing but the log is known of the real world.
        sim: The simulation to train in; "sim", or a domain like `real`.
        real_log: Recorded transitions that take the place of roll-outs in the real domain.
        seed: Root of every random choice in training.
        observation: What agents see: count, queue, pressure, waiting, density, movements.
        reward: What agents want: queue, pressure, waiting.
        neighbours: How many roads away intersections are seen too.
        duration_s: Length of an episode in s; default: the scenario's own.
        evaluation_seeds: Episodes behind every number of the table.
        tuning_seeds: Episodes behind the choice of the best rule.
        rule_budget: Tune every rule in every domain with up to so many episodes before the best is
            chosen; without it the rules are taken with their usual settings.
        control: Also train as many further episodes in plain sim, for comparison.
        further: Domains in which direct transfer is trained on as long as the control is, for one
            policy each: "late_green=*,3" is a constant delay of all greens, "V4" is fine-tuning in
            the real domain itself.
        corrected: A corrected simulation, as `ugat-marl diagnose` writes it, or any other domain: a
            further policy is trained there from scratch, for as many episodes as UGAT in all.
        ugat: Settings of the algorithm.
        dqn: Settings of the learner.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    real: str = "V4"
    sim: str = "sim"
    real_log: Path | None = None
    seed: int = 0
    observation: str = "count"
    reward: str = "queue"
    neighbours: int = 0
    duration_s: float | None = None
    evaluation_seeds: int = 5
    tuning_seeds: int = 2
    rule_budget: int | None = None
    control: bool = True
    further: tuple[str, ...] = ()
    corrected: str | None = None
    ugat: Annotated[UgatConfig, arg(name="")] = field(default_factory=UgatConfig)
    dqn: DQNConfig = field(default_factory=DQNConfig)

    def __post_init__(self) -> None:
        for name in ("evaluation_seeds", "tuning_seeds"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} = {getattr(self, name)}: must be at least 1")
        if self.rule_budget is not None and self.rule_budget < LEAST_BUDGET:
            raise OptionError(f"rule_budget = {self.rule_budget}: must be at least {LEAST_BUDGET}")
        if describe(self.real) == describe(self.sim):
            raise OptionError(
                f"real = {self.real!r} is the simulation itself; name another domain, such as V4"
            )
        if len({describe(domain) for domain in self.further}) < len(self.further):
            raise OptionError(f"further holds one twice: {' '.join(self.further)}")
        if self.corrected is not None and describe(self.corrected) == describe(self.sim):
            raise OptionError(
                f"corrected = {self.corrected!r} is the simulation itself; name the scenario that "
                "`ugat-marl diagnose` wrote, or another domain"
            )
        if self.real == "none" and self.real_log is None:
            raise OptionError('real = "none" needs a real_log: something must be known of the real')

    @property
    def env_options(self) -> dict[str, Any]:
        """Options of every environment of the experiment."""
        return {
            "observation": self.observation,
            "reward": self.reward,
            "neighbours": self.neighbours,
            "duration_s": self.duration_s,
        }

    @property
    def domains(self) -> list[str]:
        """The domains the policies are judged in."""
        return [self.sim] if self.real == "none" else [self.sim, self.real]

    @property
    def episodes(self) -> int:
        """Episodes that UGAT trains for in all, and so do the control and corrected sim."""
        return self.ugat.pretrain_episodes + self.ugat.iterations * self.ugat.grounded_episodes


def transfer(
    config: TransferConfig,
    directory: Path,
    *,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> Evaluation:
    """Trains by UGAT, evaluates, and leaves everything in `directory`.

    Args:
        config: What to do.
        directory: Folder of the run; ``table.json``, ``metrics.parquet``, ``policies``,
            TensorBoard files and checkpoints go there.
        resume: Go on with the run in the folder.
        reporter: Shows progress.
    """
    reporter = reporter or Silent()
    scenario = load(config.scenario)
    env = parallel_env(scenario, config.sim, **config.env_options)
    recorded: RecordedWorld | None = None
    if config.real_log is not None:
        log = TransitionLog.read(config.real_log)
        recorded = RecordedWorld(log, env)  # refuses a misfit before anything is written
        _say_if_from_elsewhere(log, config, reporter)
    others = {
        f"further in {describe(domain)}": _other_env(config, scenario, env, "further", domain)
        for domain in config.further
    }
    corrected: TrafficEnv | None = None
    if config.corrected is not None:
        corrected = _other_env(config, scenario, env, "corrected", config.corrected)
    learner = DQN.of(env, config.dqn, config.seed)
    transform = config.ugat.transform(env.layouts, config.seed, neighbours_of(env))
    run = Run(directory, _identity(config, scenario, env, corrected), resume, reporter)
    try:
        state = State(learner, transform)
        restore(state, run, DQNPolicy.load)
        policy = _train(config, scenario, env, recorded, state, run)
        policies: dict[str, Policy] = {}
        if state.direct is not None:
            policies[DIRECT] = state.direct
        policies[UGAT if config.ugat.grounding == "phase" else TIMED] = policy
        if config.control:
            title = "control: more plain sim"
            policies[CONTROL] = _further(config, env, run, "control-learner.pt", title)
        for name, other in others.items():
            policies[name] = _further(config, other, run, f"{_file(name)}-learner.pt", name)
        if corrected is not None:
            policies[CORRECTED] = _from_scratch(config, corrected, run)
    finally:
        for made in (env, corrected, *others.values()):
            if made is not None:
                made.close()
        run.close()
    for name, trained in policies.items():
        if isinstance(trained, DQNPolicy):
            trained.save(directory / "policies" / f"{_file(name)}.pt")
    table = judge(config, scenario, policies, reporter)
    table.write(directory / "table.json")
    return table


def _say_if_from_elsewhere(log: TransitionLog, config: TransferConfig, reporter: Reporter) -> None:
    recorded = log.provenance.domain
    if config.real != "none" and recorded != describe(config.real):
        reporter.say(
            f"note: the real log was recorded in {recorded!r}, the policies are judged in "
            f"{describe(config.real)!r}"
        )


def judge(
    config: TransferConfig,
    scenario: Scenario,
    policies: Mapping[str, Policy],
    reporter: Reporter,
) -> Evaluation:
    """Evaluates policies beside the rules that are best in each domain."""
    seeds = [TUNING_SEED + k for k in range(config.tuning_seeds)]
    options: dict[str, Any] = {"duration_s": config.duration_s, "reporter": reporter}
    budget = config.rule_budget
    if budget is None:
        rules = best_rules(scenario, config.domains, seeds=seeds, **options)
        searched = ", ".join(STANDARD_RULES)
    else:
        rules = tuned_rules(scenario, config.domains, budget, seeds=seeds, **options)
        searched = f"{', '.join(TUNED_RULES)}; each tuned with up to {budget} episodes"
    factories: dict[str, PolicyFactory] = {
        name: fixed_policy(policy) for name, policy in policies.items()
    }
    for rule in rules.values():
        factories.setdefault(f"rule {rule}", rule_factory(rule))
    return evaluate(
        scenario,
        factories,
        config.domains,
        [EVALUATION_SEED + k for k in range(config.evaluation_seeds)],
        duration_s=config.duration_s,
        reporter=reporter,
        notes={
            **{f"best rule in {domain}": rule for domain, rule in rules.items()},
            "rules searched": searched,
            "training seed": str(config.seed),
            **({} if config.corrected is None else {CORRECTED: describe(config.corrected)}),
        },
    )


def _train(
    config: TransferConfig,
    scenario: Scenario,
    env: TrafficEnv,
    recorded: RecordedWorld | None,
    state: State,
    run: Run,
) -> Policy:
    def probe(policy: Policy) -> dict[str, float]:
        """ATT after each iteration, on a seed that is not reported."""
        found = evaluate(
            scenario,
            {"policy": fixed_policy(policy)},
            config.domains,
            [TUNING_SEED],
            duration_s=config.duration_s,
        )
        return {f"att_s/{d}": found.estimate("policy", d, "att_s").mean for d in found.domains}

    def world(domain: str, name: str, episodes: int, most_delay_s: int = 0) -> SimulatedWorld:
        def make() -> TrafficEnv:
            crossings = config.ugat.most_delay_s > 0  # they tell best when a green began
            return parallel_env(scenario, domain, crossings=crossings, **config.env_options)

        return SimulatedWorld(make, name, episodes, config.ugat.rollout_epsilon, most_delay_s)

    sim: World = world(config.sim, "sim", config.ugat.sim_rollouts, config.ugat.most_delay_s)
    real: World = recorded or world(config.real, "real", config.ugat.real_rollouts)
    try:
        return train_ugat(state, env, sim, real, config.ugat, config.seed, run, probe)
    finally:
        sim.close()
        real.close()


def _further(config: TransferConfig, env: TrafficEnv, run: Run, file: str, title: str) -> Policy:
    """Direct transfer trained on in `env`, for as many episodes as the iterations had."""
    progress = run.directory / file
    start = progress if progress.exists() else run.directory / DIRECT_LEARNER
    return _trained_on(config, env, run, start, progress, title)


def _other_env(
    config: TransferConfig, scenario: Scenario, sim: TrafficEnv, option: str, domain: str
) -> TrafficEnv:
    """Another domain to train in; its policies must fit the others' worlds."""
    env = parallel_env(scenario, domain, **config.env_options)
    if AgentSet.of(env) != AgentSet.of(sim):
        raise ScenarioError(
            f"{option} = {domain!r} has other agents, observations or phases than "
            f"scenario {scenario.id!r}: {AgentSet.of(env)}, not {AgentSet.of(sim)}; take a "
            "corrected scenario of this one"
        )
    return env


def _from_scratch(config: TransferConfig, env: TrafficEnv, run: Run) -> Policy:
    """The same learner from the same seed, with all its episodes in `env`."""
    progress = run.directory / "corrected-learner.pt"
    start = progress if progress.exists() else None
    return _trained_on(config, env, run, start, progress, CORRECTED)


def _trained_on(
    config: TransferConfig,
    env: TrafficEnv,
    run: Run,
    start: Path | None,
    progress: Path,
    title: str,
) -> Policy:
    """The learner in `start`, or a fresh one, trained until it has the episodes UGAT has.

    It is saved to `progress` every few episodes, where an interrupted run goes on.
    """
    learner = DQN.of(env, config.dqn, config.seed)
    if start is not None:
        learner.load(start)
    left = config.episodes - learner.episodes
    with run.reporter.task(title, max(left, 0)) as advance:
        while left > 0:
            episodes = min(CHUNK, left)
            learner.learn(env, episodes, config.seed, lambda _number, _numbers: advance())
            learner.save(progress)
            left -= episodes
    return learner.policy()


def _file(name: str) -> str:
    """The name of a policy as the name of a file."""
    return re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-")


def _digest(path: Path) -> str:
    """A log is the same if its content is, wherever it lies."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _identity(
    config: TransferConfig, scenario: Scenario, env: TrafficEnv, corrected: TrafficEnv | None
) -> dict[str, Any]:
    settings = asdict(config)
    for judging in ("evaluation_seeds", "tuning_seeds", "rule_budget", "control", "further"):
        settings.pop(judging)
    settings.pop("corrected")  # a scenario is the same if its hash is, wherever it lies
    settings["real_log"] = _digest(config.real_log) if config.real_log else None
    hashes = {"sim": env.scenario.hash}
    if config.real != "none":
        hashes["real"] = in_domain(scenario, config.real).hash
    if corrected is not None:
        hashes["corrected"] = corrected.scenario.hash
    return {**settings, "scenario_hash": hashes, "domains": [describe(d) for d in config.domains]}
