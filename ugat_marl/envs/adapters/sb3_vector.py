"""Simulations in worker processes as a `VecEnv` of Stable-Baselines3.

from ugat_marl.envs.adapters.sb3_vector import SimulationsVecEnv

wraps = ["ugat_marl.envs.wrappers:pad_spaces", "ugat_marl.envs.wrappers:agent_indicator"]
env = SimulationsVecEnv(ugat_marl.vector_env("grid4x4-v1", 4, wrap=wraps))
MaskablePPO("MlpPolicy", env, seed=1).learn(100_000)
"""
# pyright: reportMissingImports=false

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.envs.adapters.sb3 import AgentsVecEnv, Step
from ugat_marl.envs.vector.environment import VectorEnv, VectorStep
from ugat_marl.errors import OptionError

_ELSEWHERE = (
    "simulations are in processes of their own; give options to ugat_marl.vector_env, or use "
    "ugat_marl.envs.adapters.sb3.AgentsVecEnv"
)


class SimulationsVecEnv(AgentsVecEnv):
    """`VecEnv` with one row for each agent of each simulation; the simulations step together.

    Args:
        simulations: The environments. Their agents must have equal spaces
            (``wrap="ugat_marl.envs.wrappers:pad_spaces"``). Their mode must be ``"same-step"``,
            the only one that Stable-Baselines3 supports.
        masks_in_observation: True to append masks to observations, as for `AgentsVecEnv`.

    Raises:
        OptionError: The spaces are unequal, or the vector has another mode.
    """

    def __init__(self, simulations: VectorEnv, *, masks_in_observation: bool = False) -> None:
        if simulations.autoreset != "same-step":
            raise OptionError(
                f"autoreset = {simulations.autoreset!r}: Stable-Baselines3 needs 'same-step'"
            )
        self.simulations = simulations
        super().__init__(
            [simulations.plain] * simulations.n, masks_in_observation=masks_in_observation
        )

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in every simulation, with the seeds set by `seed`."""
        seeds = [self._seeds[int(start)] for start in self._starts[:-1]]
        given = [seed for seed in seeds if seed is not None]
        batch = self.simulations.reset(given if len(given) == len(seeds) else None)
        self.reset_infos = self._infos(batch)
        self._reset_seeds()
        self._reset_options()
        return self._seen(batch)

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """Begin a step of every simulation."""
        self.simulations.step_async(np.asarray(actions).reshape(self.simulations.n, -1))

    def step_wait(self) -> Step:
        """Wait for the step of all simulations."""
        batch = self.simulations.step_wait()
        infos, agents = self._infos(batch), len(self.simulations.agents)
        for ended in batch.ended_here:
            last = self._with_masks(ended.observations, ended.masks)
            for row, seen in enumerate(last, ended.environment * agents):
                infos[row] |= {"terminal_observation": seen, "TimeLimit.truncated": True}
        rewards = batch.rewards.reshape(-1).astype(np.float32)
        return self._seen(batch), rewards, np.repeat(batch.truncated, agents), infos

    def close(self) -> None:
        """End the simulations; a second call does nothing."""
        self.simulations.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return ``action_masks``, ``render_mode`` or ``metadata`` of each agent's environment.

        Raises:
            AttributeError: The attribute is another one, which is in another process.
        """
        if attr_name not in ("action_masks", "render_mode", "metadata"):
            raise AttributeError(f"{attr_name}: {_ELSEWHERE}")
        return super().get_attr(attr_name, indices)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse, because the environments run in other processes."""
        raise OptionError(f"set_attr({attr_name!r}): {_ELSEWHERE}")

    def set_options(self, options: Any = None) -> None:
        """Refuse options, because a reset of simulations takes seeds only."""
        if options:
            raise OptionError(f"set_options({options!r}): a reset of simulations takes seeds only")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Return one mask for each agent for ``action_masks``; other methods are refused."""
        if method_name != "action_masks":
            raise OptionError(f"env_method({method_name!r}): {_ELSEWHERE}")
        return super().env_method(method_name, indices=indices)

    def _seen(self, batch: VectorStep) -> NDArray[np.float32]:
        """Return the observations of all agents, ``(rows, size)``, and keep the masks."""
        masks = batch.masks.reshape(len(self.rows), -1)
        self._masks = masks.astype(np.bool_)
        return self._with_masks(batch.observations.reshape(len(self.rows), -1), masks)

    def _with_masks(
        self, seen: NDArray[np.float32], masks: NDArray[np.int8]
    ) -> NDArray[np.float32]:
        if not self.masks_in_observation:
            return seen
        return np.concatenate((seen, masks.astype(np.float32)), axis=1)

    def _infos(self, batch: VectorStep) -> list[dict[str, Any]]:
        masks = batch.masks.reshape(len(self.rows), -1)
        shown = batch.executed.reshape(-1).tolist()
        return [
            {"action_mask": mask, "executed_action": executed}
            for mask, executed in zip(masks, shown, strict=True)
        ]
