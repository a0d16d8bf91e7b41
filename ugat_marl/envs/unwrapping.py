"""The environment inside wrappers, with its type."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from ugat_marl.envs.types import AnyParallelEnv

if TYPE_CHECKING:
    from ugat_marl.envs.traffic_env import TrafficEnv


def as_traffic_env(env: AnyParallelEnv) -> TrafficEnv:
    """Return what `env.unwrapped` returns for an environment of the suite, wrapped or not.

    It may be a `Wrapper`, which has every public attribute of a `TrafficEnv`, agents under its own
    names included.
    """
    return cast("TrafficEnv", env.unwrapped)
