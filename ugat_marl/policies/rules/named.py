"""A rule together with its spelling, which can be saved where a trained policy can."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ugat_marl.data import read_checkpoint, write_checkpoint
from ugat_marl.envs import Actions, AnyParallelEnv, Infos, Observations
from ugat_marl.errors import CheckpointError, UgatMarlError
from ugat_marl.policies.rules.catalogue import make_rule, parse_rule

KIND = "ugat_marl.rule"
"""Name of this kind of checkpoint, written into the file."""


class NamedRule:
    """A rule that knows its spelling.

    Args:
        spec: Spelling, such as ``"max-pressure:20"``.
        env: Any environment of the scenario; only its network is read.

    Raises:
        UnknownNameError: No rule has this name.
        OptionError: A parameter is not a number above 0, or there are too many.
    """

    def __init__(self, spec: str, env: AnyParallelEnv) -> None:
        self.spec = spec
        self._rule = make_rule(spec, env)
        self.env_options: Mapping[str, Any] = self._rule.env_options

    def reset(self, seed: int) -> None:
        """Forget the past."""
        self._rule.reset(seed)

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """Return the rule's phase for every agent."""
        return self._rule.act(observations, infos)

    def reads(self, env: AnyParallelEnv) -> bool:
        """Return True if an environment has the options that the rule relies on."""
        given: Any = getattr(env.unwrapped, "env_options", {})
        return all(given.get(name) == value for name, value in self.env_options.items())

    def save(self, path: Path) -> None:
        """Write the spelling to a file; `rule_in` reads it."""
        write_checkpoint(path, KIND, {"rule": self.spec})


def rule_in(path: Path) -> str | None:
    """Return the spelling of the rule in a file; None if the file holds something else."""
    try:
        spec = read_checkpoint(path, KIND)["rule"]
        parse_rule(spec)
    except (CheckpointError, KeyError):
        return None
    except (AttributeError, TypeError, UgatMarlError):
        raise CheckpointError(f"{path}: holds no rule of this version; train again") from None
    return spec
