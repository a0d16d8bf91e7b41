"""Command ``train``: UGAT and the settings compared with it, judged in both domains."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from ugat_marl.data import Run, TransitionLog, write_settings
from ugat_marl.effects import domain_label, load_scenario, scenario_in_domain
from ugat_marl.envs import AgentSet, TrafficEnv, parallel_env
from ugat_marl.errors import OptionError, ScenarioError, UnknownNameError
from ugat_marl.experiments.evaluation import (
    TUNING_SEED,
    Watch,
    best_rules,
    evaluate,
    fixed_policy,
    rule_factory,
)
from ugat_marl.experiments.jobs import Job, evaluation_seeds, file_names, train_job
from ugat_marl.experiments.queues import QUEUES, QueueRecord
from ugat_marl.experiments.scores import Evaluation
from ugat_marl.experiments.settings import (
    CONTROL,
    CORRECTED,
    DIRECT,
    FINE_TUNED,
    GROUNDED_NAME,
    ORACLE,
    RANDOM_DELAY,
    RANDOMISED,
    LearnerSpec,
    Setting,
)
from ugat_marl.experiments.training import simulated_worlds, train_grounded
from ugat_marl.experiments.tuning import LEAST_BUDGET, TUNED_RULES, tuned_rules
from ugat_marl.grounding import (
    DIRECT_LEARNER,
    NEGATIVE_CONTROLS,
    NegativeControl,
    RecordedWorld,
    RunState,
    SimulatedWorld,
    UgatConfig,
    World,
)
from ugat_marl.parallel import Workers
from ugat_marl.policies import (
    DQN_NAME,
    STANDARD_RULES,
    DQNConfig,
    LearnerFactory,
    NetworkPolicy,
    Policy,
    PolicyFactory,
    require_device_name,
    require_known,
)
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios import Scenario

TRAININGS = "trainings"
"""Folder in a run's folder; it holds the jobs of the settings compared with UGAT."""

ADDED = ("control", "further", "randomised", "random_delay_s", "fine_tuned", "oracle")
"""Options that add policies to the table and change no other policy."""


@dataclass(frozen=True)
class TransferConfig:
    """Options of ``train``: what to train, where, and how to judge it.

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        real: The real domain: V1..V4 or an alias, effect=value+..., or a scenario directory. "none"
            needs `real_log`: only the log is known of the real domain.
        sim: The simulation to train in; "sim", or a domain like `real`.
        real_log: Transition log that replaces the roll-outs in the real domain.
        seed: Root of every random choice in training.
        observation: Kind of observation: count, queue, pressure, waiting, density, movements.
        reward: Kind of reward: queue, pressure, waiting.
        neighbours: Agents also see the intersections up to so many roads away.
        duration_s: Length of an episode in s; default: the scenario's own.
        evaluation_seeds: Number of evaluation episodes of each policy in each domain.
        tuning_seeds: Number of episodes on which the best rule is chosen.
        rule_budget: Most episodes to tune each rule in each domain before the best is chosen;
            default: no tuning, rules with default parameters.
        control: Also train direct transfer for as many further episodes in plain sim.
        further: Domains in which direct transfer is trained further, as long as the control, with
            one policy each. "late_green=*,3" delays all greens by 3 s; "V4" fine-tunes in the real
            domain itself.
        corrected: A corrected scenario of `ugat-marl diagnose`, or any other domain: also train
            there from scratch, for as many episodes as UGAT in all.
        randomised: Also train from scratch, for as many episodes as UGAT in all. Each episode is in
            another world, drawn from the ranges of the effects.
        random_delay_s: Also train direct transfer further, as long as the control, while greens
            begin late by random whole seconds up to this value.
        fine_tuned: Also train direct transfer further in the real domain, for as many episodes as
            UGAT records there.
        oracle: Also train from scratch in the real domain, for as many episodes as UGAT in all.
        placebo: A negative control; grounding must win nothing with it. "same-world" records D_real
            in the simulation, "shuffled" permutes the outcomes in D_real, "noise" replaces f by
            noise.
        learner: The learner: dqn, the suite's own, or a baseline (docs/how-to/learners.md).
        learner_settings: Settings of a baseline as NAME=VALUE, such as learning_rate=0.001; commas
            separate the parts of a tuple.
        device: Device for dqn's updates and the fits of f and h: cpu, cuda, or cuda:N.
        ugat: Settings of the algorithm.
        dqn: Settings of dqn.
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
    randomised: bool = False
    random_delay_s: int | None = None
    fine_tuned: bool = False
    oracle: bool = False
    placebo: NegativeControl = "none"
    learner: str = DQN_NAME
    learner_settings: tuple[str, ...] = ()
    device: str = "cpu"
    ugat: Annotated[UgatConfig, arg(name="")] = field(default_factory=UgatConfig)
    dqn: DQNConfig = field(default_factory=DQNConfig)

    def __post_init__(self) -> None:
        for name in ("evaluation_seeds", "tuning_seeds"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} = {getattr(self, name)}: must be at least 1")
        if self.rule_budget is not None and self.rule_budget < LEAST_BUDGET:
            raise OptionError(f"rule_budget = {self.rule_budget}: must be at least {LEAST_BUDGET}")
        if domain_label(self.real) == domain_label(self.sim) and self.placebo != "same-world":
            raise OptionError(
                f"real = {self.real!r} is the simulation itself; name another domain, such as V4, "
                'or ask for the placebo "same-world"'
            )
        if len({domain_label(domain) for domain in self.further}) < len(self.further):
            raise OptionError(f"further holds one twice: {' '.join(self.further)}")
        if self.corrected is not None and domain_label(self.corrected) == domain_label(self.sim):
            raise OptionError(
                f"corrected = {self.corrected!r} is the simulation itself; name the scenario that "
                "`ugat-marl diagnose` wrote, or another domain"
            )
        if self.real == "none" and self.real_log is None:
            raise OptionError('real = "none" needs a real_log: something must be known of the real')
        self._refuse_impossible_controls()

    def _refuse_impossible_controls(self) -> None:
        require_known(self.learner)
        require_device_name(self.device)
        if self.placebo not in NEGATIVE_CONTROLS:
            raise UnknownNameError("placebo", self.placebo, NEGATIVE_CONTROLS)
        if self.placebo == "same-world" and self.real_log is not None:
            raise OptionError('the placebo "same-world" takes the place of a real_log; give one')
        if self.random_delay_s is not None and self.random_delay_s < 1:
            raise OptionError(f"random_delay_s = {self.random_delay_s}: must be at least 1")
        for name in ("fine_tuned", "oracle"):
            if getattr(self, name) and len(self.domains) < 2:
                raise OptionError(f"{name} needs a real domain to train in, not {self.real!r}")
        for who, acts in (("fine_tuned", self.fine_tuned), ("timed match", self.ugat.matches)):
            if acts and self.real_log is not None:
                raise OptionError(f"{who} acts in the real domain, which a real_log does not allow")

    @property
    def spec(self) -> LearnerSpec:
        """The learner of all policies."""
        return LearnerSpec(self.learner, self.learner_settings, self.dqn)

    @property
    def settings(self) -> list[Setting]:
        """Settings trained in addition to direct transfer and UGAT."""
        seen, spec = self.ugat.iterations * self.ugat.real_rollouts, self.spec
        found: list[Setting] = []
        if self.control:
            found.append(Setting(CONTROL, "further", self.sim, spec))
        found += [
            Setting(f"further in {domain_label(d)}", "further", d, spec) for d in self.further
        ]
        if (most_s := self.random_delay_s) is not None:
            name = f"{RANDOM_DELAY} 0-{most_s} s"
            found.append(Setting(name, "delays", self.sim, spec, most_delay_s=most_s))
        if self.fine_tuned:
            found.append(Setting(FINE_TUNED, "further", None, spec, episodes=seen))
        if self.randomised:
            found.append(Setting(RANDOMISED, "randomised", None, spec))
        if self.corrected is not None:
            found.append(Setting(CORRECTED, "scratch", self.corrected, spec))
        if self.oracle:
            found.append(Setting(ORACLE, "scratch", None, spec))
        return found

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
        """Domains in which the policies are judged."""
        only = self.real == "none" or domain_label(self.real) == domain_label(self.sim)
        return [self.sim] if only else [self.sim, self.real]

    @property
    def episodes(self) -> int:
        """All training episodes of UGAT; the control and corrected sim get the same number."""
        return self.ugat.pretrain_episodes + self.ugat.iterations * self.ugat.grounded_episodes


def transfer(
    config: TransferConfig,
    directory: Path,
    *,
    resume: bool = False,
    reporter: Reporter | None = None,
    workers: Workers = None,
) -> Evaluation:
    """Train by UGAT, evaluate, and write all results to `directory`.

    Args:
        config: Options of the run.
        directory: Folder of the run. It receives ``table.json``, ``metrics.parquet``,
            ``policies``, TensorBoard files, checkpoints and the data of `ugat-marl report`.
        resume: Continue the run in the folder.
        reporter: Shows progress.
        workers: Simulations at a time, or an executor, for roll-outs and the search for rules; the
            policies are evaluated on this machine.
    """
    reporter = reporter or Silent()
    make = config.spec.factory(config.device)  # impossible options are an error now, not later
    scenario = load_scenario(config.scenario)
    with contextlib.closing(parallel_env(scenario, config.sim, **config.env_options)) as env:
        worlds = _worlds(config, scenario, env, reporter, workers)
        jobs = _jobs(config, scenario, env)
        run = Run(directory, _identity(config, scenario, env), resume, reporter)
        write_settings(directory, asdict(config))
        with contextlib.closing(run):
            state = _train(config, make, scenario, env, worlds, run)
            policies = _policies(config, state)
            for job in jobs:
                folder = directory / TRAININGS / job.name
                job.write(folder)
                policies[job.setting.name] = train_job(job, folder, reporter)
    for file, trained in zip(file_names(policies), policies.values(), strict=True):
        if isinstance(trained, NetworkPolicy):
            trained.save(directory / "policies" / f"{file}.pt")
    queues = QueueRecord()
    table = judge(config, scenario, policies, reporter, queues.watch, workers)
    queues.write(directory / QUEUES)
    table.write(directory / "table.json")
    return table


def _policies(config: TransferConfig, state: RunState) -> dict[str, Policy]:
    """Return direct transfer and, if there was an iteration, the policy of UGAT."""
    assert state.direct is not None  # plain training comes first
    policies = {DIRECT: state.direct}
    if config.ugat.iterations:
        policies[GROUNDED_NAME[config.ugat.grounding]] = state.learner.policy()
    return policies


def _say_if_from_elsewhere(log: TransitionLog, config: TransferConfig, reporter: Reporter) -> None:
    recorded = log.provenance.domain
    if config.real != "none" and recorded != domain_label(config.real):
        reporter.say(
            f"note: the real log was recorded in {recorded!r}, the policies are judged in "
            f"{domain_label(config.real)!r}"
        )


def judge(
    config: TransferConfig,
    scenario: Scenario,
    policies: Mapping[str, Policy],
    reporter: Reporter,
    watch: Watch | None = None,
    workers: Workers = None,
) -> Evaluation:
    """Evaluate policies and the best rule of each domain; `workers` search for the rules."""
    seeds = [TUNING_SEED + k for k in range(config.tuning_seeds)]
    options: Any = {"duration_s": config.duration_s, "reporter": reporter, "workers": workers}
    if config.rule_budget is None:
        rules = best_rules(scenario, config.domains, seeds=seeds, **options)
        searched = ", ".join(STANDARD_RULES)
    else:
        rules = tuned_rules(scenario, config.domains, config.rule_budget, seeds=seeds, **options)
        searched = f"{', '.join(TUNED_RULES)}; each tuned with up to {config.rule_budget} episodes"
    factories: dict[str, PolicyFactory] = {
        name: fixed_policy(policy) for name, policy in policies.items()
    }
    for rule in rules.values():
        factories.setdefault(f"rule {rule}", rule_factory(rule))
    return evaluate(
        scenario,
        factories,
        config.domains,
        evaluation_seeds(config.evaluation_seeds),
        duration_s=config.duration_s,
        reporter=reporter,
        notes={
            **{f"best rule in {domain}": rule for domain, rule in rules.items()},
            "rules searched": searched,
            "training seed": str(config.seed),
            **({} if config.learner == DQN_NAME else {"learner": config.learner}),
            **({} if config.corrected is None else {CORRECTED: domain_label(config.corrected)}),
        },
        watch=watch,
    )


def _worlds(
    config: TransferConfig,
    scenario: Scenario,
    env: TrafficEnv,
    reporter: Reporter,
    workers: Workers,
) -> tuple[SimulatedWorld, World]:
    """Return the sources of D_sim and D_real; raise an error if the log does not fit."""
    recorded: RecordedWorld | None = None
    if config.real_log is not None:
        log = TransitionLog.read(config.real_log)
        recorded = RecordedWorld(log, env, config.ugat.fit.held_out_every)
        _say_if_from_elsewhere(log, config, reporter)
    street = config.sim if recorded or config.placebo == "same-world" else config.real
    sim, real = simulated_worlds(
        scenario, config.sim, street, config.ugat, config.env_options, workers
    )
    return sim, recorded or real


def _train(
    config: TransferConfig,
    make: LearnerFactory,
    scenario: Scenario,
    env: TrafficEnv,
    worlds: tuple[SimulatedWorld, World],
    run: Run,
) -> RunState:
    def probe(policy: Policy) -> dict[str, float]:
        """Return the ATT in s after an iteration, on a seed that no result is reported on."""
        found = evaluate(
            scenario,
            {"policy": fixed_policy(policy)},
            config.domains,
            [TUNING_SEED],
            duration_s=config.duration_s,
        )
        return {f"att_s/{d}": found.estimate("policy", d, "att_s").mean for d in found.domains}

    return train_grounded(
        config.ugat,
        make,
        env,
        worlds,
        config.seed,
        run,
        placebo=config.placebo,
        probe=probe,
        device=config.device,
    )


def _jobs(config: TransferConfig, scenario: Scenario, env: TrafficEnv) -> list[Job]:
    """Return the jobs of `config.settings`; raise an error if a domain has other agents."""
    for option in ("corrected", *(["real"] if config.fine_tuned or config.oracle else [])):
        if (domain := getattr(config, option)) is not None:
            _require_same_agents(config, scenario, env, option, domain)
    for domain in config.further:
        _require_same_agents(config, scenario, env, "further", domain)
    return [
        Job(
            setting=setting,
            scenario=config.scenario,
            sim=config.sim,
            target=config.real if setting.knows_target else None,
            seed=config.seed,
            episodes=config.episodes
            if setting.episodes is None
            else config.ugat.pretrain_episodes + setting.episodes,
            start=f"../{DIRECT_LEARNER}" if setting.begins_with_direct else None,
            options=config.env_options,
            device=config.device,
        )
        for setting in config.settings
    ]


def _require_same_agents(
    config: TransferConfig, scenario: Scenario, sim: TrafficEnv, option: str, domain: str
) -> None:
    """Raise an error if policies trained in a domain would not fit the simulation's agents."""
    with contextlib.closing(parallel_env(scenario, domain, **config.env_options)) as env:
        if AgentSet.of(env) != AgentSet.of(sim):
            raise ScenarioError(
                f"{option} = {domain!r} has other agents, observations or phases than "
                f"scenario {scenario.id!r}: {AgentSet.of(env)}, not {AgentSet.of(sim)}; take a "
                "corrected scenario of this one"
            )


def _identity(config: TransferConfig, scenario: Scenario, env: TrafficEnv) -> dict[str, Any]:
    """Return everything that must be the same when a run is resumed."""
    settings = asdict(config)
    for other in ("evaluation_seeds", "tuning_seeds", "rule_budget", "device", "corrected", *ADDED):
        settings.pop(other)
    log = config.real_log  # identified by its content, so the file may be moved
    settings["real_log"] = hashlib.sha256(log.read_bytes()).hexdigest() if log else None
    hashes = {"sim": env.scenario.hash}
    if config.real != "none":
        hashes["real"] = scenario_in_domain(scenario, config.real).hash
    if config.corrected is not None:  # identified by its content, so the folder may be moved
        hashes["corrected"] = scenario_in_domain(scenario, config.corrected).hash
    return {
        **settings,
        "scenario_hash": hashes,
        "domains": [domain_label(d) for d in config.domains],
    }
