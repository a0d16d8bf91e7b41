"""Multi-agent traffic-signal environments across the gap between simulation and street.

The names below are loaded when they are first used, so that importing the package is cheap.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ugat_marl.effects import load as load_scenario
    from ugat_marl.traffic_env import TrafficEnv, env, parallel_env
    from ugat_marl.transitions import TransitionLog
    from ugat_marl.vector import vector_env

__version__ = "0.1.0"

_HOMES = {
    "TrafficEnv": ("ugat_marl.traffic_env", "TrafficEnv"),
    "TransitionLog": ("ugat_marl.transitions", "TransitionLog"),
    "env": ("ugat_marl.traffic_env", "env"),
    "load_scenario": ("ugat_marl.effects", "load"),
    "parallel_env": ("ugat_marl.traffic_env", "parallel_env"),
    "vector_env": ("ugat_marl.vector", "vector_env"),
}

__all__ = [
    "TrafficEnv",
    "TransitionLog",
    "__version__",
    "env",
    "load_scenario",
    "parallel_env",
    "vector_env",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _HOMES[name]
    return getattr(importlib.import_module(module), attribute)
