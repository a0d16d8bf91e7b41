"""Learners: algorithms that improve a policy by acting in an environment.

The names below are loaded when they are first used, so that what needs no torch (`AgentSet`, and
with it exported policies) does not load it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ugat_marl.policies.learners.dqn import DQN, DQNConfig
    from ugat_marl.policies.learners.dqn_policy import DQNPolicy

_HOMES = {"DQN": "dqn", "DQNConfig": "dqn_config", "DQNPolicy": "dqn_policy"}

__all__ = ["DQN", "DQNConfig", "DQNPolicy"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"ugat_marl.policies.learners.{_HOMES[name]}"), name)
