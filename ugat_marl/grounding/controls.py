"""Negative controls: data or models that hold nothing. Grounding must win nothing with them.

- `same-world`: D_real comes from the simulation itself.
- `shuffled`: the outcomes in D_real are permuted among the rows of an agent (`ShuffledWorld`), so
  they do not depend on state and action.
- `noise`: f answers with noise of the scale of the data.
"""

from __future__ import annotations

import zlib
from typing import Literal, get_args

import polars as pl
import torch
from torch import Tensor

from ugat_marl.data import TransitionLog
from ugat_marl.errors import UnknownNameError
from ugat_marl.grounding.forward import ForwardModel
from ugat_marl.grounding.worlds import TransitionSource
from ugat_marl.policies import Policy
from ugat_marl.seeding import derive_seed, numpy_generator, torch_generator

NegativeControl = Literal["none", "same-world", "shuffled", "noise"]


def require_negative_control(name: str) -> None:
    """Refuse the name of a negative control that does not exist.

    Raises:
        UnknownNameError: There is no such negative control.
    """
    known: tuple[str, ...] = get_args(NegativeControl)
    if name not in known:
        raise UnknownNameError("negative control", name, known)


def answer_with_noise(model: ForwardModel, seed: int) -> None:
    """Make f answer with noise, before and after it is fitted.

    f answers in units of its scale, the root mean square of the changes it was fitted to. Standard
    normal noise is therefore as large as the changes. Question and seed decide the noise, so a
    resumed run gets the same answers. Several networks give the same noise, whose mean is as large.

    Args:
        model: Forward model, changed in place.
        seed: Seed of the noise.
    """
    learnt = model.read_each

    def noise(inputs: Tensor) -> Tensor:
        answer = learnt(inputs)
        question = zlib.crc32(inputs.cpu().numpy().tobytes())
        shape = (len(answer), 1, *answer.shape[2:])
        drawn = torch.randn(shape, generator=torch_generator(seed, "placebo", question))
        # 0 * answer keeps the gradient graph, so training runs without an effect.
        return 0.0 * answer + drawn.to(answer.device) * model.valid_outputs[:, None]

    model.read_each = noise  # all predictions call it; `renew` replaces the network but not this


class ShuffledWorld:
    """Source that returns the transitions of another source with permuted outcomes.

    Outcomes are permuted among the rows of an agent. The frequencies of states and of outcomes stay
    the same, but outcomes do not depend on their states.

    Args:
        world: Source of the transitions.
    """

    def __init__(self, world: TransitionSource) -> None:
        self._world = world

    def collect(self, policy: Policy, iteration: int, seed: int) -> TransitionLog | None:
        """Return the other world's transitions, shuffled."""
        log = self._world.collect(policy, iteration, seed)
        return None if log is None else shuffled(log, derive_seed(seed, "shuffled", iteration))

    def replay(self) -> Policy | None:
        """Return the other world's policy."""
        return self._world.replay()

    def stop(self) -> None:
        """Stop the roll-outs of the other world."""
        self._world.stop()


def shuffled(log: TransitionLog, seed: int) -> TransitionLog:
    """Return the log with the outcomes of each agent's rows in random order.

    Next observation and served features of a row move together. State, action and reward stay in
    their rows.

    Args:
        log: Any log; it does not change.
        seed: Seed of the order.
    """
    outcomes = ["next_observation", "served_features"]
    parts: list[pl.DataFrame] = []
    for agent in log.agents:
        agent_rows = log.frame.filter(pl.col("agent") == agent)
        order = numpy_generator(seed, "shuffled", agent).permutation(agent_rows.height)
        parts.append(agent_rows.with_columns(agent_rows[name].gather(order) for name in outcomes))
    frame = pl.concat(parts).sort("episode", "step", maintain_order=True)
    return TransitionLog(log.provenance, frame)
