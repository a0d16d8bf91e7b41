"""One training, judged every few episodes, in a folder where it goes on if it was interrupted."""

from __future__ import annotations

import contextlib
import json
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ugat_marl.data import versions_of
from ugat_marl.effects import load_scenario
from ugat_marl.envs import parallel_env
from ugat_marl.errors import CheckpointError, OptionError
from ugat_marl.experiments.baseline import FIRST_SEED
from ugat_marl.experiments.evaluation import evaluate, fixed_policy
from ugat_marl.files import write_whole
from ugat_marl.policies import PolicyFactory, is_installed, learner_factory, library_of, settings_of
from ugat_marl.scenarios import Scenario

CURVE = "curve.json"
DOMAIN = "sim"
"""Where learners are trained and judged."""


@dataclass(frozen=True)
class Training:
    """One training, and when it is judged.

    Attributes:
        scenario: As a user names it.
        learner: Name.
        seed: Of all that is drawn.
        episodes: Of training.
        evaluate_every: Episodes from one evaluation to the next; the last one ends with one too.
        evaluation_seeds: Episodes of an evaluation, always the same.
    """

    scenario: str
    learner: str
    seed: int
    episodes: int
    evaluate_every: int
    evaluation_seeds: int

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{word(self.scenario)}-{self.learner}-s{self.seed}"

    @property
    def marks(self) -> tuple[int, ...]:
        """After how many episodes it is judged."""
        return (*range(self.evaluate_every, self.episodes, self.evaluate_every), self.episodes)


@dataclass
class Curve:
    """What is known of a training.

    Attributes:
        made_with: Scenario, settings and versions; a training with others is another one.
        att_s: By episodes trained the mean travel time of each evaluation seed, s.
        decisions: Decisions of all agents together, in training.
        seconds: Time they took, learning included, evaluations not.
        own_seconds: Processor time of the learner's process in them; the simulation has another.
        learner: File of the learner as it was after the last evaluation.
    """

    made_with: Mapping[str, Any]
    att_s: dict[int, list[float]] = field(default_factory=dict)
    decisions: int = 0
    seconds: float = 0.0
    own_seconds: float = 0.0
    learner: str = ""

    @classmethod
    def read(cls, folder: Path) -> Curve | None:
        """What `write` wrote; None if there is nothing.

        Raises:
            CheckpointError: The file is broken.
        """
        file = folder / CURVE
        if not file.exists():
            return None
        try:
            found = cls(**json.loads(file.read_text()))
            found.att_s = {int(k): [float(x) for x in v] for k, v in found.att_s.items()}
        except (ValueError, TypeError, AttributeError) as error:
            raise CheckpointError(f"{file}: broken ({error!r}); remove {folder}") from None
        return found

    def write(self, folder: Path) -> None:
        """Whole or not at all."""
        write_whole(folder / CURVE, json.dumps(asdict(self), indent=1) + "\n")

    def has(self, training: Training) -> bool:
        """Whether every evaluation was made, with as many episodes."""
        counts = [len(self.att_s.get(mark, ())) for mark in training.marks]
        return min(counts) >= training.evaluation_seeds

    @property
    def speed(self) -> float:
        """Decisions a second."""
        return self.decisions / self.seconds

    @property
    def own_ms(self) -> float:
        """Processor time of a decision outside the simulation, in ms."""
        return 1000 * self.own_seconds / self.decisions

    def means(self, training: Training) -> list[float]:
        """Mean travel time of each evaluation, in their order, s."""
        count = training.evaluation_seeds
        return [float(np.mean(self.att_s[mark][:count])) for mark in training.marks]


def perform(training: Training, folder: Path) -> None:
    """Trains and judges what is missing; after each evaluation everything is saved.

    Raises:
        OptionError: What lies in the folder was made with other settings or versions.
    """
    scenario, name = load_scenario(training.scenario), training.learner
    seeds = evaluation_seeds(training.evaluation_seeds)
    with contextlib.closing(parallel_env(scenario, domain=DOMAIN)) as env:
        learner: Any = learner_factory(name)(env, training.seed)
        made_with = made_now(training.scenario, name)
        curve = Curve.read(folder) or Curve(made_with)
        _require_same(folder, curve.made_with, made_with)
        if curve.learner:
            learner.load(folder / curve.learner)
        for mark in training.marks:
            if len(curve.att_s.get(mark, ())) >= len(seeds):
                continue
            if mark < learner.episodes:
                raise OptionError(
                    f"{folder} has no evaluation of {len(seeds)} episodes after {mark} of "
                    "training and is beyond it; remove it, or name another --runs"
                )
            begin, own = time.perf_counter(), time.process_time()
            policy = learner.learn(env, mark - learner.episodes, training.seed)
            curve.seconds += time.perf_counter() - begin
            curve.own_seconds += time.process_time() - own
            curve.decisions = learner.episodes * scenario.decisions
            curve.att_s[mark] = played(scenario, fixed_policy(policy), seeds)
            before, curve.learner = curve.learner, f"learner-{mark}.pt"
            learner.save(folder / curve.learner)
            policy.save(folder / "policy.pt")
            curve.write(folder)
            if before not in ("", curve.learner):
                (folder / before).unlink(missing_ok=True)


def made_now(scenario: str, learner: str) -> Mapping[str, Any]:
    """What a training is made with today, as JSON has it; its library must be installed."""
    made = {
        "scenario": load_scenario(scenario).hash,
        "library": library_of(learner),
        "settings": settings_of(learner),
        "versions": versions_of("eclipse-sumo", "torch"),
    }
    return json.loads(json.dumps(made))


def _require_same(folder: Path, one: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    differences = ", ".join(
        f"{key} {one.get(key)} (now {now.get(key)})"
        for key in {**one, **now}
        if one.get(key) != now.get(key)
    )
    if differences:
        raise OptionError(
            f"{folder} was made with {differences}; remove it, or name another --runs"
        )


def evaluation_seeds(count: int) -> range:
    """Those of every evaluation here; the first are those of a run's own table."""
    return range(FIRST_SEED, FIRST_SEED + count)


def played(scenario: Scenario, policy: PolicyFactory, seeds: Sequence[int]) -> list[float]:
    """Mean travel time of each seed, s."""
    found = evaluate(scenario, {"it": policy}, [DOMAIN], list(seeds), workers=1)
    return [result.scores.att_s for result in found.results]


def found(training: Training, runs: Path) -> Curve | None:
    """A training that has all its evaluations.

    Raises:
        OptionError: It was made with other settings or versions; not asked where the learner's
            library is not installed.
    """
    folder = runs / training.name
    curve = Curve.read(folder)
    if curve is None or not curve.has(training):
        return None
    if is_installed(training.learner):
        _require_same(folder, curve.made_with, made_now(training.scenario, training.learner))
    return curve


def word(text: str) -> str:
    """A scenario as a part of a file's name."""
    return re.sub(r"[^\w.+-]+", "-", Path(text).name.removesuffix(".sumocfg")).strip("-")
