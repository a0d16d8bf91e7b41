"""Lessons: a rule that is good in an environment plays there, and a learner watches.

A learner that begins with nothing needs many episodes to be as good as a rule. One that has watched
the rule is as good from the first episode, and learning goes on from there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ugat_marl.envs import AnyParallelEnv
from ugat_marl.errors import OptionError
from ugat_marl.policies.protocols import Learner, Policy, Taught
from ugat_marl.policies.rollout import roll_out
from ugat_marl.policies.rules.catalogue import STANDARD_RULES
from ugat_marl.policies.rules.named import NamedRule
from ugat_marl.progress import Reporter
from ugat_marl.seeding import derive_seed

BEST = "best"
"""Name of the teacher that is looked for among `STANDARD_RULES`."""

FINALISTS = 3
"""Rules that play again after the first episode of all."""

FINAL_EPISODES = 2
"""Episodes that each of them plays then."""

OnPlay = Callable[[str], None]
"""Called after an episode with the rule that played it."""


def has_first_lessons(learner: Learner) -> bool:
    """Return False if a learner begins with the weights of a policy, which no rule has to teach."""
    return not getattr(learner, "begins_taught", False)


def attended(
    learner: Learner,
    env: AnyParallelEnv,
    seed: int,
    reporter: Reporter,
    title: str,
    best: str | None = None,
) -> str | None:
    """Let a learner watch the rule that is good in an environment, with a progress bar.

    Args:
        learner: The learner.
        env: The environment.
        seed: Root of the seeds of the episodes.
        reporter: Shows progress.
        title: Name of the progress bar.
        best: The best rule there, if it is known.

    Returns:
        Spelling of the rule; None if the learner has no teacher.
    """
    if not isinstance(learner, Taught) or not (number := learner.plays(env, best)):
        return None
    with reporter.task(title, number) as advance:
        return learner.attend(env, seed, lambda rule: advance(note=rule), best)


def find_teacher(
    env: AnyParallelEnv, name: str, seed: int, on_play: OnPlay | None = None
) -> tuple[str, Policy] | None:
    """Return the rule that teaches in an environment, and its spelling; None if none can.

    For `BEST` all standard rules that read this environment's observations play one episode, and
    the best of them play again. The greatest mean reward wins. All play the same seeds. Most rules
    read `movements`, so that other observations may leave none.

    Args:
        env: The environment; it is reset.
        name: Spelling of a rule, or `BEST`.
        seed: Root of the seeds of the episodes.
        on_play: Called after every episode.

    Raises:
        UnknownNameError: No rule has this name.
        OptionError: The rule reads other observations than the environment's.
    """
    if name != BEST:
        rule = NamedRule(name, env.unwrapped)
        if not rule.reads(env):
            raise OptionError(
                f"teacher {name}: it needs environments with {dict(rule.env_options)}; train in "
                f"such ones, or leave the teacher out"
            )
        return name, rule
    if not (rules := dict(_candidates(env))):
        return None
    rewards: dict[str, list[float]] = {spec: [] for spec in rules}
    running = list(rules)
    for first, episodes in ((0, 1), (1, FINAL_EPISODES)):
        for spec in running:
            for episode in range(first, first + episodes):
                played = roll_out(env, rules[spec], derive_seed(seed, "teacher", episode))
                rewards[spec].append(played.mean_reward)
                if on_play is not None:
                    on_play(spec)
        # the sort is stable: of equal rules, the one named first stays first
        running.sort(key=lambda spec: -float(np.mean(rewards[spec])))
        running = running[:FINALISTS]
    return running[0], rules[running[0]]


def plays(name: str, shown: int, env: AnyParallelEnv | None = None) -> int:
    """Return the number of episodes that lessons play.

    Args:
        name: Spelling of a rule, or `BEST`.
        shown: Episodes that the teacher shows.
        env: The environment; None for one in which all rules play.
    """
    if name != BEST:
        return shown
    candidates = len(STANDARD_RULES if env is None else _candidates(env))
    return candidates + FINAL_EPISODES * min(FINALISTS, candidates) + shown if candidates else 0


def _candidates(env: AnyParallelEnv) -> Sequence[tuple[str, Policy]]:
    """Return the rules that read what an environment shows; none reads stacked observations."""
    if getattr(env.unwrapped, "frames", 1) > 1:
        return []
    rules = [NamedRule(spec, env.unwrapped) for spec in STANDARD_RULES]
    return [(rule.spec, rule) for rule in rules if rule.reads(env)]
