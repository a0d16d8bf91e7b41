"""A vector of environments as Gymnasium's `VectorEnv`."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import vector
from gymnasium.spaces import Box, Discrete
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ugat_marl.envs.vector.environment import VectorEnv, VectorStep
from ugat_marl.envs.wrappers import common_box
from ugat_marl.errors import ActionError, OptionError

_MODES = {"same-step": "SAME_STEP", "next-step": "NEXT_STEP", "disabled": "DISABLED"}


class GymnasiumVectorEnv(vector.VectorEnv[Any, Any, Any]):
    """One sub-environment for each intersection of each simulation, for shared parameters.

    Sub-environment ``i * agents + j`` is agent ``j`` of simulation ``i``. All have equal, padded
    spaces. Infos hold ``action_mask`` ``(num_envs, actions)`` and ``executed_action``
    ``(num_envs,)``. In mode ``"same-step"``, the infos of ended episodes also hold ``final_obs``
    and ``final_info``, as those of Gymnasium do. An action that an intersection does not have
    raises an `ActionError`.

    Args:
        env: The simulations; closing this object closes them.
    """

    def __init__(self, env: VectorEnv) -> None:
        self.env = env
        self.num_envs = env.n * len(env.agents)
        boxes: list[Any] = [env.observation_spaces[agent] for agent in env.agents]
        self.single_observation_space: Box = common_box(boxes)
        self.single_action_space = Discrete(env.agent_set.most_actions)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        modes: Any = getattr(vector, "AutoresetMode", None)  # gymnasium 1.0 has none
        self.metadata = {"name": "ugat_marl_v1", "render_modes": []}
        if modes is not None:
            self.metadata["autoreset_mode"] = modes[_MODES[env.autoreset]]

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: One seed for each simulation, as for `VectorEnv.reset`.
            options: ``{"reset_mask": bool (num_envs,)}`` resets some simulations only. The mask
                must be equal for all intersections of a simulation.
        """
        mask = (options or {}).get("reset_mask")
        where = None if mask is None else self._simulations(np.asarray(mask))
        batch = self.env.reset(seed, where)
        return self._flat(batch.observations), self._infos(batch)

    def step(
        self, actions: Any
    ) -> tuple[
        NDArray[np.float32],
        NDArray[np.float64],
        NDArray[np.bool_],
        NDArray[np.bool_],
        dict[str, Any],
    ]:
        """Show the chosen phases; `actions` are ``(num_envs,)``."""
        self.step_async(actions)
        return self.step_wait()

    def step_async(self, actions: Any) -> None:
        """Begin a step, which `step_wait` ends; a learner may work in between."""
        requested = np.asarray(actions)
        if requested.shape != (self.num_envs,):
            raise ActionError(f"actions have shape {requested.shape}; allowed: ({self.num_envs},)")
        self.env.step_async(requested.reshape(self.env.n, -1))

    def step_wait(
        self,
    ) -> tuple[
        NDArray[np.float32],
        NDArray[np.float64],
        NDArray[np.bool_],
        NDArray[np.bool_],
        dict[str, Any],
    ]:
        """Wait for the step that `step_async` began."""
        batch = self.env.step_wait()
        truncated = np.repeat(batch.truncated, len(self.env.agents))
        none = np.zeros(self.num_envs, dtype=np.bool_)
        infos = self._infos(batch)
        if batch.ended and self.env.autoreset == "same-step":
            infos |= self._final(batch, truncated)
        return self._flat(batch.observations), self._flat(batch.rewards), none, truncated, infos

    def close_extras(self, **_: Any) -> None:
        """End the simulations."""
        self.env.close()

    def _flat(self, values: NDArray[Any]) -> NDArray[Any]:
        return values.reshape(self.num_envs, *values.shape[2:])

    def _infos(self, batch: VectorStep) -> dict[str, Any]:
        everyone = np.ones(self.num_envs, dtype=np.bool_)
        return {
            "action_mask": self._flat(batch.masks),
            "_action_mask": everyone,
            "executed_action": self._flat(batch.executed),
            "_executed_action": everyone.copy(),
        }

    def _final(self, batch: VectorStep, truncated: NDArray[np.bool_]) -> dict[str, Any]:
        """Return final observations and infos in Gymnasium's form, None for running episodes."""
        observations = np.full(self.num_envs, None, dtype=object)
        masks = np.zeros((self.num_envs, self.env.agent_set.most_actions), dtype=np.int8)
        travel_time_s = np.full(self.num_envs, np.nan)
        for ended in batch.ended_here:
            first = ended.environment * len(self.env.agents)
            for row, (vector_seen, mask) in enumerate(
                zip(ended.observations, ended.masks, strict=True)
            ):
                observations[first + row] = vector_seen
                masks[first + row] = mask
            if ended.scores is not None:
                travel_time_s[first : first + len(self.env.agents)] = ended.scores.att_s
        final = {
            "action_mask": masks,
            "_action_mask": truncated,
            "executed_action": self._flat(batch.executed).copy(),
            "_executed_action": truncated,
            "att_s": travel_time_s,
            "_att_s": truncated,
        }
        return {
            "final_obs": observations,
            "_final_obs": truncated,
            "final_info": final,
            "_final_info": truncated,
        }

    def _simulations(self, mask: NDArray[Any]) -> NDArray[np.bool_]:
        rows = mask.reshape(self.env.n, -1) if mask.shape == (self.num_envs,) else None
        if rows is None or (rows.any(axis=1) != rows.all(axis=1)).any():
            raise OptionError(
                f"reset_mask must be {self.num_envs} truth values, the same for the "
                f"{len(self.env.agents)} intersections of a simulation"
            )
        return np.asarray(rows.all(axis=1))
