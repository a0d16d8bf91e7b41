"""Ways to train a policy without grounding, and the worlds that grounding learns from."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ugat_marl.data import Run
from ugat_marl.effects import Domain, describe, in_domain
from ugat_marl.envs import AnyParallelEnv, TrafficEnv, parallel_env
from ugat_marl.errors import OptionError
from ugat_marl.grounding import CHUNK, MATCHED_REWARD, SimulatedWorld, UgatConfig
from ugat_marl.parallel import Workers
from ugat_marl.policies import Learner, LearnerFactory, Policy
from ugat_marl.progress import Reporter
from ugat_marl.scenarios import Scenario, begins_when_asked


def train_until(
    learner: Learner,
    env: AnyParallelEnv,
    episodes: int,
    seed: int,
    progress: Path,
    reporter: Reporter,
    title: str,
) -> None:
    """Trains a learner until it has had so many episodes in its life.

    Args:
        learner: Fresh, or as it was saved.
        env: Where.
        episodes: In all, those it has had already included.
        seed: Root of every random choice.
        progress: File it is saved to every few episodes, where an interrupted training goes on.
        reporter: Shows progress.
        title: What to call the work there.
    """
    left = episodes - learner.episodes
    with reporter.task(title, max(left, 0)) as advance:
        while left > 0:
            chunk = min(CHUNK, left)
            learner.learn(env, chunk, seed, lambda _number, _numbers: advance())
            learner.save(progress)
            left -= chunk


def check_worlds(scenario: Scenario, sim: Domain, real: Domain, timed: bool = False) -> None:
    """Checks that what is seen and rewarded is the same in two worlds.

    Args:
        scenario: The network and its traffic.
        sim: The simulation.
        real: The real domain.
        timed: Whether greens are to be delayed: one that begins a decision later than it was asked
            for has no delay that could be told, or executed.

    Raises:
        UnknownNameError: No such domain.
        OptionError: Agents look farther in one of them, or greens begin too late to be delayed.
    """
    here, there = (in_domain(scenario, world) for world in (sim, real))
    for world in (here, there) if timed else ():
        timing, interval_s = world.timing, world.control.decision_interval_s
        if not begins_when_asked(timing, interval_s):
            raise OptionError(
                "timed grounding delays a green in the decision that asks for it, and here some "
                f"begin later: decision_interval_s = {interval_s:g} must be "
                f"longer than yellow_s + all_red_s = {timing.clearance_s:g} by min_green_s = "
                f"{timing.min_green_s:g} or more; change them in scenario.toml, or use the "
                "grounding phase"
            )
    here_m, there_m = here.control.reach_m, there.control.reach_m
    if here_m != there_m:
        raise OptionError(
            f"agents look {here_m:g} m upstream in {describe(sim)!r} and {there_m:g} m in "
            f"{describe(real)!r}, so that counts and rewards are not the same; give both the same "
            "reach, such as +reach=100"
        )


def simulated_worlds(
    scenario: Scenario,
    sim: Domain,
    real: Domain,
    ugat: UgatConfig,
    options: Mapping[str, Any],
    workers: Workers = None,
) -> tuple[SimulatedWorld, SimulatedWorld]:
    """Where D_sim and D_real come from if both worlds can be played.

    Args:
        scenario: The network and its traffic.
        sim: The simulation.
        real: The real domain.
        ugat: How often is rolled out, and whether greens are delayed by chance.
        options: Of both environments.
        workers: As for `SimulatedWorld`.

    Raises:
        OptionError: As `check_worlds`, or rewards that cannot be matched.
    """
    check_worlds(scenario, sim, real, ugat.grounding == "timed")
    reward = options.get("reward", MATCHED_REWARD)
    if ugat.matches and reward != MATCHED_REWARD:
        raise OptionError(
            f"timed match compares mean rewards of the kind {MATCHED_REWARD!r}, not {reward!r}; "
            "leave one of the two options out"
        )

    def world(domain: Domain, name: str, episodes: int, most_delay_s: int = 0) -> SimulatedWorld:
        crossings = ugat.most_delay_s > 0  # they tell best when a green began
        make = partial(parallel_env, scenario, domain, crossings=crossings, **options)
        return SimulatedWorld(make, name, episodes, ugat.rollout_epsilon, most_delay_s, workers)

    return (
        world(sim, "sim", ugat.sim_rollouts, ugat.most_delay_s),
        world(real, "real", ugat.real_rollouts),
    )


@dataclass(frozen=True)
class Control:
    """A policy to be trained without any grounding.

    Attributes:
        name: What the table calls it.
        env: Where it is trained.
        episodes: Of its life, those of direct transfer included where it goes on from there.
        from_direct: Whether it goes on from direct transfer, or begins from scratch.
        file: Where its learner is kept, in the folder of the run; "" for a name like its own.
        title: What its progress is called; "" for its name.
    """

    name: str
    env: AnyParallelEnv
    episodes: int
    from_direct: bool = True
    file: str = ""
    title: str = ""

    def learner_path(self, run: Run) -> Path:
        """Where its learner is saved every few episodes."""
        return run.directory / (self.file or f"{file_name(self.name)}-learner.pt")


def train_control(
    control: Control, make: LearnerFactory, seed: int, run: Run, direct: Path
) -> Policy:
    """Trains until the learner has its episodes; where it was interrupted, it goes on.

    Args:
        control: What to train.
        make: Makes the learner.
        seed: Root of every random choice.
        run: Where it is saved.
        direct: The learner of direct transfer.
    """
    learner = make(control.env, seed)
    progress = control.learner_path(run)
    if progress.exists():
        learner.load(progress)
    elif control.from_direct:
        learner.load(direct)
    title = control.title or control.name
    train_until(learner, control.env, control.episodes, seed, progress, run.reporter, title)
    return learner.policy()


def further(domain: str, env: TrafficEnv, episodes: int) -> Control:
    """Direct transfer trained on in another domain, kept by the name and the content of it.

    Args:
        domain: How it is spelled.
        env: The domain.
        episodes: As for `Control`.
    """
    name = f"further in {domain}"
    own = f"{file_name(name)}-{env.scenario.hash[:8]}-learner.pt"
    return Control(name, env, episodes, file=own)


def file_name(name: str) -> str:
    """The name of a policy as the name of a file."""
    return re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-")


def file_names(names: Iterable[str]) -> list[str]:
    """The names of policies as names of files, all different: a second one of a kind ends in -2."""
    found: list[str] = []
    for name in names:
        own = [file_name(name), *(f"{file_name(name)}-{k}" for k in range(2, len(found) + 2))]
        found.append(next(file for file in own if file not in found))
    return found
