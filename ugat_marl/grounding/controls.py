"""Negative controls: data or models that hold nothing, with which grounding must do nothing.

`same-world`: D_real comes from the simulation itself. `shuffled`: in D_real, what followed is dealt
out anew among the rows of an agent (`ShuffledWorld`), so that it says nothing of state and
action. `noise`: f answers with noise of the scale of the data.
"""

from __future__ import annotations

import zlib
from typing import Literal, get_args

import polars as pl
import torch
from torch import Tensor

from ugat_marl.data import TransitionLog
from ugat_marl.grounding.forward import ForwardModel
from ugat_marl.grounding.worlds import World
from ugat_marl.policies import Policy
from ugat_marl.seeding import derive_seed, numpy_generator, torch_generator

Placebo = Literal["none", "same-world", "shuffled", "noise"]
PLACEBOS: tuple[str, ...] = get_args(Placebo)


def answer_with_noise(model: ForwardModel, seed: int) -> None:
    """Make f answer with noise, before and after it is fitted.

    f answers in units of its scale, the root mean square of the changes it was fitted to: standard
    normal noise is as large as what happens. It is drawn anew for every question but decided by
    question and seed, so that a resumed run hears the same.

    Args:
        model: Changed in place.
        seed: Of the noise.
    """
    learnt = model.read

    def noise(inputs: Tensor) -> Tensor:
        answer = learnt(inputs)
        question = zlib.crc32(inputs.cpu().numpy().tobytes())
        drawn = torch.randn(answer.shape, generator=torch_generator(seed, "placebo", question))
        # Training goes on, and shows nowhere.
        return 0.0 * answer + drawn.to(answer.device) * model.valid_outputs

    model.read = noise  # every way of asking f leads through it, and its network is made anew


class ShuffledWorld:
    """Another world whose transitions lead anywhere.

    Among the rows of an agent, outcomes are dealt out anew. States and outcomes stay as likely as
    they were, but no outcome belongs to its state any more.

    Args:
        world: Where the transitions come from.
    """

    def __init__(self, world: World) -> None:
        self._world = world

    def collect(self, policy: Policy, iteration: int, seed: int) -> TransitionLog | None:
        """Return the other world's transitions, shuffled."""
        log = self._world.collect(policy, iteration, seed)
        return None if log is None else shuffled(log, derive_seed(seed, "shuffled", iteration))

    def stop(self) -> None:
        """End what is under way in the other world."""
        self._world.stop()

    def close(self) -> None:
        """Give up what the other world holds."""
        self._world.close()


def shuffled(log: TransitionLog, seed: int) -> TransitionLog:
    """Return the log with the outcomes of each agent's rows in random order.

    What is seen next and what was served belong together, and stay so; state, action and reward
    stay where they are.

    Args:
        log: Any log; it does not change.
        seed: Of the order.
    """
    outcomes = ["next_observation", "served_features"]
    parts: list[pl.DataFrame] = []
    for agent in log.agents:
        own = log.frame.filter(pl.col("agent") == agent)
        order = numpy_generator(seed, "shuffled", agent).permutation(own.height)
        parts.append(own.with_columns(own[name].gather(order) for name in outcomes))
    frame = pl.concat(parts).sort("episode", "step", maintain_order=True)
    return TransitionLog(log.provenance, frame)
