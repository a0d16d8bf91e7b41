"""Negative controls: data or models that hold nothing, with which grounding must do nothing.

`same-world`: D_real comes from the simulation itself. `shuffled`: in D_real, what followed is dealt
out anew among the rows of an agent (`worlds.ShuffledWorld`), so that it says nothing of state and
action. `noise`: f answers with noise of the scale of the data.
"""

from __future__ import annotations

import zlib
from typing import Literal, get_args

import torch
from torch import Tensor

from ugat_marl.grounding.forward import ForwardModel
from ugat_marl.seeding import torch_generator

Placebo = Literal["none", "same-world", "shuffled", "noise"]
PLACEBOS: tuple[str, ...] = get_args(Placebo)


def answer_with_noise(model: ForwardModel, seed: int) -> None:
    """Makes f answer with noise, whatever it has learnt and is yet to learn.

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
        asked = zlib.crc32(inputs.cpu().numpy().tobytes())
        drawn = torch.randn(answer.shape, generator=torch_generator(seed, "placebo", asked))
        return (
            0.0 * answer + drawn.to(answer.device) * model.valid_outputs
        )  # training goes on, and shows nowhere

    model.read = noise  # every way of asking f leads through it, and its network is made anew
