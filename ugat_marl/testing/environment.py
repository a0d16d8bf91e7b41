"""What an environment must provide for the learners of the field to train in it."""

from __future__ import annotations

from ugat_marl.testing.behaviour import BEHAVIOUR, an_episode_runs
from ugat_marl.testing.declared import DECLARED
from ugat_marl.testing.episodes import EnvironmentCase, MakeEnv
from ugat_marl.testing.life import LIFE
from ugat_marl.testing.results import Result, run_checks

ENVIRONMENT_CHECKS = (an_episode_runs, *LIFE, *DECLARED, *BEHAVIOUR)
"""All checks of an environment; each takes an `EnvironmentCase`."""


def check_environment(make_env: MakeEnv, seed: int = 1) -> list[Result]:
    """Checks an environment, the suite's own, a wrapped or a third-party one.

    Plays about three whole episodes; give it short ones.

    Args:
        make_env: Makes a fresh environment.
        seed: Seed of the episodes.
    """
    case = EnvironmentCase(make_env, seed)
    try:
        return run_checks(ENVIRONMENT_CHECKS, case)
    finally:
        case.close()
