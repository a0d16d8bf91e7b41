"""Types of the arguments and results of environments, by agent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

Observations = Mapping[str, NDArray[np.float32]]


Infos = Mapping[str, Mapping[str, Any]]


Actions = dict[str, int]


AnyParallelEnv = ParallelEnv[str, Any, Any]


ResetResult = tuple[dict[str, Any], dict[str, dict[str, Any]]]
"""Result of an environment's `reset`: observations and infos, by agent."""


StepResult = tuple[
    dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
]
"""Result of `step`: observations, rewards, terminations, truncations and infos, by agent."""
