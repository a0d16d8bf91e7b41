"""Checks that a seed decides an episode bit for bit, independent of all other episodes."""

from __future__ import annotations

import itertools

from ugat_marl.testing.episodes import (
    EnvironmentCase,
    Episode,
    MakeEnv,
    begin,
    different,
    moments,
    random_actions,
    replaying,
    require_same,
)
from ugat_marl.testing.results import CheckResult, ConformanceError, require, run_checks

_SEED_ALL = "draw every random number, SUMO's too, from the seed given to reset()"


def a_seed_repeats_its_episode(case: EnvironmentCase) -> None:
    """The same seed, used twice in one environment, gives the same episode."""
    case.need_episode()
    env = case.make()
    first, second = case.play(env, case.seed), case.play(env, case.seed)
    require_same(
        first,
        second,
        "the same seed twice in one environment gave different episodes",
        "clear in reset() what the last episode left, and start SUMO in a fresh process",
    )


def other_episodes_leave_no_trace(case: EnvironmentCase) -> None:
    """An episode does not depend on earlier episodes, whether these were finished or not."""
    case.need_episode()
    env = case.make()
    case.play(env, case.seed + 1)
    begin(env, case.seed + 2)
    second = case.play(env, case.seed)
    require_same(
        case.episode,
        second,
        "an episode differs after others ran in the same environment",
        "clear in reset() what they left, and start SUMO in a fresh process",
    )


def replayed_actions_repeat_the_episode(case: EnvironmentCase) -> None:
    """Recorded actions give the same episode again, even from dicts in another order."""
    env = case.make()
    again = case.play(env, case.seed, replaying(case.episode, reverse=True))
    cure = "let nothing depend on the order of the actions, and " + _SEED_ALL
    require_same(case.episode, again, "replayed actions gave another episode", cure)
    where = different(case.episode.scores, again.scores)
    require(not where, f"replayed actions gave other scores: {where}; {cure}")


def live_environments_are_independent(case: EnvironmentCase) -> None:
    """Two environments that are stepped in turn give the same episodes as each one alone."""
    case.need_episode()
    solo = case.make()
    alone = [case.episode, case.play(solo, case.seed + 1)]
    together = _in_lock_step(case, (case.seed, case.seed + 1))
    for a, b in zip(alone, together, strict=True):
        require_same(
            a,
            b,
            "an episode differs when another environment runs in turn with it",
            "share no state between environments; libsumo holds one simulation per process",
        )


def _in_lock_step(case: EnvironmentCase, seeds: tuple[int, ...]) -> list[Episode]:
    runs = [moments(case.make(), seed, random_actions(case.seed), case.max_steps) for seed in seeds]
    turns = itertools.zip_longest(*runs)  # a step of each in turn
    return [Episode(tuple(filter(None, run))) for run in zip(*turns, strict=True)]


def other_seeds_give_other_episodes(case: EnvironmentCase) -> None:
    """Different seeds give different episodes."""
    case.need_episode()
    env = case.make()
    for seed in (case.seed + 1, case.seed + 2):
        other = case.play(env, seed)  # the same random numbers, among what is permitted there
        if not case.episode.agrees(other):
            return
    raise ConformanceError(
        f"seeds {case.seed} to {case.seed + 2} gave the same episode; pass the seed on to SUMO, "
        "and make sure vehicles enter within the episode"
    )


def resets_without_seed_follow_from_the_last(case: EnvironmentCase) -> None:
    """After `reset(seed)`, that seed also decides all later episodes without a seed."""
    case.need_episode()
    runs: list[list[Episode]] = []
    for _ in range(2):
        env = case.make()
        begin(env, case.seed)
        runs.append([case.play(env, None) for _ in range(2)])
    for a, b in zip(*runs, strict=True):
        require_same(
            a,
            b,
            "after reset(seed), reset() without one gave different episodes in two runs",
            "draw the seed of an episode from a generator that reset(seed) sets",
        )


DETERMINISM_CHECKS = (
    a_seed_repeats_its_episode,
    other_episodes_leave_no_trace,
    replayed_actions_repeat_the_episode,
    live_environments_are_independent,
    other_seeds_give_other_episodes,
    resets_without_seed_follow_from_the_last,
)
"""All checks of determinism; each takes an `EnvironmentCase`."""


def check_determinism(make_env: MakeEnv, seed: int = 1) -> list[CheckResult]:
    """Check that episodes are reproducible bit for bit.

    The checks play about a dozen whole episodes, so use an environment with short episodes.

    Args:
        make_env: Function that returns a new environment.
        seed: Seed of the first episode.
    """
    case = EnvironmentCase(make_env, seed)
    try:
        return run_checks(DETERMINISM_CHECKS, case)
    finally:
        case.close()
