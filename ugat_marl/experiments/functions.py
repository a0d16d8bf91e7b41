"""Functions of scripts and notebooks: train across a gap, and evaluate policies.

They do what the commands ``train`` and ``evaluate`` do with the options used most, and take objects
of Python where a command takes names.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from os import PathLike
from pathlib import Path
from types import NoneType
from typing import Any, Literal, TypeVar, get_args

import numpy as np
import polars as pl

from ugat_marl.data import LogCallback
from ugat_marl.effects import Domain, domain_label, is_one_domain, load_scenario
from ugat_marl.envs import ObservationName, RewardName, is_count
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.experiments.evaluation import OwnPolicyFactory, evaluation_of, policy_factory
from ugat_marl.experiments.jobs import EVALUATION_SEED, file_stem, shortened
from ugat_marl.experiments.scores import Evaluation
from ugat_marl.experiments.transfers import TransferConfig, transfer
from ugat_marl.grounding import USUAL_REWARD, UgatConfig
from ugat_marl.parallel import Workers, parts_at_a_time
from ugat_marl.policies import (
    DQNConfig,
    PolicyFactory,
    UsualValue,
    own_name,
    setting_texts,
)
from ugat_marl.progress import Reporter, usual, usual_of_long_work
from ugat_marl.scenarios import Scenario


@dataclass(frozen=True)
class Training:
    """Result of `train`.

    Attributes:
        folder: Folder of the run, for ``ugat-marl report`` and ``resume``.
        evaluation: Every episode of the evaluation.
    """

    folder: Path
    evaluation: Evaluation

    @property
    def table(self) -> pl.DataFrame:
        """One row per policy and domain (`Evaluation.frame`)."""
        return self.evaluation.frame()

    @property
    def policies(self) -> dict[str, Path]:
        """Files of the policies, by the name of the file without suffix; one may hold a rule."""
        return {path.stem: path for path in sorted((self.folder / "policies").glob("*.pt"))}

    def __repr__(self) -> str:
        """Return the folder and the table."""
        return f"Training in {self.folder}\n{self.table}"


def train(
    scenario: str | Path,
    *,
    real: str | None = "V4",
    sim: str = "sim",
    learner: str | type[Any] | Any = "",
    learner_settings: Mapping[str, Any] | Sequence[str] = (),
    grounding: Literal["street", "timed", "phase"] = UgatConfig.grounding,
    pretrain_episodes: int = UgatConfig.pretrain_episodes,
    iterations: int = UgatConfig.iterations,
    grounded_episodes: int = UgatConfig.grounded_episodes,
    real_rollouts: int = UgatConfig.real_rollouts,
    observation: str | None = None,
    reward: str = USUAL_REWARD,
    control: bool = True,
    evaluation_seeds: int = 5,
    duration_s: float | None = None,
    seed: int = 0,
    preset: Literal["paper"] | None = None,
    real_log: str | Path | None = None,
    ugat: UgatConfig | None = None,
    dqn: DQNConfig | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    workers: Workers = None,
    reporter: Reporter | None = None,
    callback: LogCallback | None = None,
) -> Training:
    """Train policies in a simulation for a domain that differs, and judge them in both.

    Args:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        real: The real domain, such as "V4" or "startup_delay=1+deceleration=2"; None if only the
            log of it is known.
        sim: The domain to train in.
        learner: Name of a learner, ``module:name``, or a class with ``learn(env, episodes)`` and
            ``policy()``, or a function of ``env`` and ``seed`` that makes such an object.
        learner_settings: Settings of the learner: a dictionary of plain data, or texts
            ``NAME=VALUE``.
        grounding: "street", "timed" or "phase".
        pretrain_episodes: Episodes of plain training; the policy after them is direct transfer.
        iterations: Number of times to roll out, fit and train.
        grounded_episodes: Episodes of training in each iteration.
        real_rollouts: Episodes recorded in the real domain in each iteration.
        observation: Kind of observation; None for the one that the learner needs, or "count". No
            function, since a resumed run reads its options from a file.
        reward: Kind of reward; no function either.
        control: Also train direct transfer for as many further episodes in plain sim.
        evaluation_seeds: Number of evaluation episodes of each policy in each domain.
        duration_s: Length of an episode in s; None for the scenario's own.
        seed: Root of every random choice.
        preset: "paper" for Algorithm 1 as published.
        real_log: Transition log in place of roll-outs in the real domain.
        ugat: All settings of the algorithm; then leave out grounding and numbers of episodes.
        dqn: Settings of the learners universal and dqn.
        out: Folder of the run; None for runs/SCENARIO-REAL-sSEED.
        resume: Continue the run in that folder.
        workers: Simulations at a time, or an executor; None for one per core.
        reporter: Shows progress; None for bars on standard error, `ugat_marl.progress.Silent()` for
            nothing.
        callback: Called as ``callback(stage, step, numbers)`` for what the training across the gap
            measures: stage "episode" with the number of the episode, "rival episode" (and
            "rival 3 s late episode") with that of a rival in a fitted street, "iteration" with
            that of the iteration, and at the end "evaluation" with ``POLICY/DOMAIN/att_s`` in s.
            What it raises ends the run, which can be resumed.

    Returns:
        The table and the folder of the run.

    Raises:
        UgatMarlError: An option, the scenario or the learner is at fault; the message names it.
    """
    alone = UgatConfig(
        grounding=grounding,
        pretrain_episodes=pretrain_episodes,
        iterations=iterations,
        grounded_episodes=grounded_episodes,
        real_rollouts=real_rollouts,
    )
    own = (grounding, pretrain_episodes, iterations, grounded_episodes, real_rollouts)
    if ugat is not None and not all(isinstance(value, UsualValue) for value in own):
        raise OptionError(
            "ugat holds all settings of the algorithm; give grounding, pretrain_episodes, "
            "iterations, grounded_episodes and real_rollouts in it"
        )
    real = "none" if real is None else real
    _check_arguments(scenario, real, sim, seed, observation, reward, callback)
    _check_kinds(control=control, resume=resume, ugat=ugat, dqn=dqn, out=out, real_log=real_log)
    if not is_count(evaluation_seeds):
        raise OptionError(f"evaluation_seeds = {evaluation_seeds!r}: must be a whole number")
    parts_at_a_time(workers)  # refuses what is no number before anything is written
    name = learner if isinstance(learner, str) else own_name(learner)
    config = TransferConfig(
        str(scenario),
        real=real,
        sim=sim,
        preset=preset,
        real_log=None if real_log is None else Path(real_log),
        seed=seed,
        observation=observation,
        reward=reward,
        duration_s=duration_s,
        evaluation_seeds=evaluation_seeds,
        control=control,
        learner=name,
        learner_settings=_texts(name, learner_settings),
        ugat=ugat or alone,
        dqn=dqn or DQNConfig(),
    )
    config = _without_numpy(config)
    folder = Path(out) if out is not None else run_folder(config)
    table = transfer(
        config,
        folder,
        resume=resume,
        reporter=reporter or usual_of_long_work(),
        workers=workers,
        on_log=callback,
    )
    return Training(folder, table)


def evaluate(
    scenario: str | Path | Scenario,
    policies: Any = ("programme", "largest-queue:20", "max-pressure:10", "random"),
    domains: Domain | Sequence[Domain] = ("sim", "V1", "V2", "V3", "V4"),
    *,
    seeds: int | Sequence[int] = 5,
    duration_s: float | None = None,
    each_episode: bool = False,
    workers: Workers = None,
    reporter: Reporter | None = None,
) -> pl.DataFrame:
    """Play policies in domains with several seeds, and return their scores.

    Args:
        scenario: Id of a shipped scenario, directory, .sumocfg, resco:<map>, or a loaded scenario.
        policies: A policy, a sequence of them, or a dictionary from names to policies. Each is the
            spelling of a rule, the file of a trained policy, ``module:name``, an object with
            ``act(observations, infos)``, a function of the same arguments, or a class or a function
            of ``env`` that makes one.
        domains: Domains; gaps are differences from the first. A text is one domain, and so is a
            sequence of effects.
        seeds: Number of episodes of each policy in each domain, or the seeds themselves.
        duration_s: Length of an episode in s; None for the scenario's own.
        each_episode: Return one row per episode with all measures.
        workers: Simulations at a time, or an executor; None for one per core.
        reporter: Shows progress; None for the one of the program.

    Returns:
        One row per policy and domain (`Evaluation.frame`), or per episode.

    Raises:
        UgatMarlError: A name or an option is at fault; the message names it.
    """
    numbers = _seeds(seeds)
    given: Any = domains.tolist() if isinstance(domains, np.ndarray) else domains
    if not numbers or not given:
        raise OptionError("seeds and domains need at least one each")
    listed: Any = [given] if is_one_domain(given) else given
    played = evaluation_of(
        load_scenario(scenario, duration_s),
        _factories(policies),
        listed,
        numbers,
        duration_s=duration_s,
        workers=workers,
        reporter=reporter or usual(),
    )
    return played.episodes_frame() if each_episode else played.frame()


_KINDS: Mapping[str, Any] = {
    "control": bool | np.bool_,
    "resume": bool | np.bool_,
    "ugat": UgatConfig | None,
    "dqn": DQNConfig | None,
    "out": (str, PathLike, NoneType),
    "real_log": (str, PathLike, NoneType),
}
"""Kinds of arguments of `train`."""


def _check_kinds(**arguments: Any) -> None:
    for name, given in arguments.items():
        if not isinstance(given, _KINDS[name]):
            raise OptionError(f"{name} = {given!r}: train does not take a {type(given).__name__}")


def _check_arguments(
    scenario: Any, real: Any, sim: Any, seed: Any, observation: Any, reward: Any, callback: Any
) -> None:
    """Refuse arguments of `train` that no command could be given, before anything is written."""
    if not isinstance(scenario, str | Path):
        raise OptionError(
            "train takes the name or the path of a scenario, since a resumed run reads it again, "
            f"and not a {type(scenario).__name__}; scenario.write(folder) makes a folder to name"
        )
    for name, domain in (("real", real), ("sim", sim)):
        if not is_one_domain(domain):
            raise OptionError(
                f"{name} = {domain!r}: train takes one domain; join effects with +, such as "
                "'V3+headway=1.4', and train for each domain by itself"
            )
    if not is_count(seed):
        raise OptionError(f"seed = {seed!r}: must be a whole number from 0 on")
    for name, kind in (("observation", observation), ("reward", reward)):
        if kind is not None and not isinstance(kind, str):
            raise OptionError(
                f"{name} = {kind!r}: train takes the name of one, since a resumed run reads its "
                "options from a file; functions are for environments that you train in yourself"
            )
    for name, given, known in (
        ("observation", observation, get_args(ObservationName)),
        ("reward", reward, get_args(RewardName)),
    ):
        if given is not None and given not in known:
            raise UnknownNameError(name, given, known)
    if callback is not None and not callable(callback):
        raise OptionError(f"callback = {callback!r}: must be a function, or None")


def _texts(learner: str, settings: Any) -> tuple[str, ...]:
    """Return settings of a learner as ``NAME=VALUE``."""
    if isinstance(settings, Mapping):
        return setting_texts(learner, settings)
    return (settings,) if isinstance(settings, str) else tuple(settings or ())


_Config = TypeVar("_Config")


def _without_numpy(value: _Config) -> _Config:
    """Return settings with numbers of Python in place of NumPy's, which JSON cannot hold."""
    if isinstance(value, np.generic):
        return value.item()
    if not is_dataclass(value) or isinstance(value, type):
        return value
    held = {one.name: getattr(value, one.name) for one in fields(value) if one.init}
    plain = {name: _without_numpy(one) for name, one in held.items()}
    changed = {name: one for name, one in plain.items() if one is not held[name]}
    return replace(value, **changed) if changed else value


def run_folder(config: TransferConfig) -> Path:
    """Return the folder of a run that has been given none: runs/SCENARIO-REAL-sSEED."""
    scenario, real = config.scenario, domain_label(config.real)
    parts = (file_stem(scenario), Path(real).name)
    name = "-".join(re.sub(r"[^\w=+.]+", "-", part).strip("-.") for part in parts)
    return Path("runs") / f"{shortened(name)}-s{config.seed}"


def _seeds(given: Any) -> list[int]:
    """Return the seeds of episodes from their number, or from themselves."""
    several = isinstance(given, Iterable)
    listed: list[Any] = list(given) if several else [given]
    if not all(map(is_count, listed)):
        raise OptionError(f"seeds = {given!r}: give a number of episodes, or a list of seeds")
    numbers = [int(seed) for seed in listed]
    return numbers if several else [EVALUATION_SEED + number for number in range(numbers[0])]


def _factories(policies: Any) -> Mapping[str, PolicyFactory]:
    """Return makers of policies by name."""
    if isinstance(policies, Mapping):
        if not policies:
            raise OptionError("policies needs at least one")
        return {str(name): _factory(given, str(name)) for name, given in policies.items()}
    one = _is_name(policies) or callable(policies) or hasattr(policies, "act")
    several = [policies] if one or not isinstance(policies, Iterable) else list(policies)
    if not several:
        raise OptionError("policies needs at least one")
    named = [(_name(given), given) for given in several]
    if len(dict(named)) < len(named):
        raise OptionError(
            f"policies holds a name twice: {', '.join(name for name, _ in named)}; give a "
            "dictionary from names to policies"
        )
    return {name: _factory(given, name) for name, given in named}


def _factory(given: Any, name: str) -> PolicyFactory:
    return policy_factory(str(given)) if _is_name(given) else OwnPolicyFactory(given, name)


def _name(given: Any) -> str:
    if _is_name(given):
        return str(given)
    return str(getattr(given, "__name__", type(given).__name__))


def _is_name(given: Any) -> bool:
    return isinstance(given, str | Path)
