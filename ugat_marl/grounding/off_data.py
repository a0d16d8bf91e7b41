"""Inputs of h that the simulation never produces, to teach and to test that u rises there.

The evidential loss alone says nothing about inputs far from the data, where a network of ReLUs
grows ever more confident: on planted dynamics u was 0.26 on the data and 0.10 off it. So a state is
drawn from a box around the observed ones, and so is the change of its features; the phases shown
stay valid ones, or they alone would give the invented rows away.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from ugat_marl.grounding.view import View

REACH = 1.5
"""Half-width of the box in units of the observed range: three times as wide as the data."""


@dataclass(frozen=True)
class OffData:
    """The box around the training inputs of every agent.

    Attributes:
        inputs: ``(agents, n, width)`` unscaled inputs of h.
        candidates: Columns of `inputs` to start from, ``(m,)``.
        low: ``(agents, 1, width)`` lower end of the box; ``high`` the upper.
        kept: ``(agents, 1, width)`` bool, phases: never redrawn.
        change: ``(agents, 1, width)`` bool, the change of the features.
    """

    inputs: Tensor
    candidates: Tensor
    low: Tensor
    high: Tensor
    kept: Tensor
    change: Tensor

    @classmethod
    def around(
        cls, inputs: Tensor, weight: Tensor, view: View, fixed: Tensor | None = None
    ) -> OffData:
        """The box around the rows of `inputs` with weight, ``(agents, n)``.

        Args:
            inputs: ``(agents, n, width)``: the observation, and directly behind it the change.
            weight: ``(agents, n)``.
            view: Says how long an observation is, and where it shows phases.
            fixed: ``(agents, 1, width)`` bool, what else is never redrawn.
        """
        own = weight.bool()[..., None]
        low = torch.where(own, inputs, torch.inf).amin(1, keepdim=True)
        high = torch.where(own, inputs, -torch.inf).amax(1, keepdim=True)
        centre, reach = (high + low) / 2, (high - low) * REACH
        kept = nn.functional.pad(view.lights, (0, low.shape[-1] - view.width))
        change = torch.zeros(low.shape, dtype=torch.bool)
        for i, size in enumerate(view.sizes):
            change[i, 0, size:] = True
        if fixed is not None:
            kept = kept | fixed
        candidates = weight.bool().all(0).nonzero()[:, 0]
        if not len(candidates):  # agents measured at different times share no column
            candidates = weight.bool().any(0).nonzero()[:, 0]
        return cls(inputs, candidates, centre - reach, centre + reach, kept, change)

    def to(self, device: torch.device) -> OffData:
        """The same on a device."""
        return replace(self, **{name: part.to(device) for name, part in vars(self).items()})

    def draw(self, count: int, generator: torch.Generator, state_share: float) -> Tensor:
        """Invented inputs ``(agents, count, width)``.

        Args:
            count: Rows per agent.
            generator: Source of the draws, on the CPU wherever the inputs are.
            state_share: Share of rows in which the state is drawn, too; in the others it is an
                observed one with a change that it never had.
        """
        device = self.inputs.device
        rows = torch.randint(len(self.candidates), (count,), generator=generator).to(device)
        observed = self.inputs.index_select(1, self.candidates[rows])
        noise = torch.rand(observed.shape, generator=generator).to(device)
        drawn = torch.addcmul(self.low, self.high - self.low, noise)
        whole = torch.rand(1, count, 1, generator=generator).to(device) < state_share
        return torch.where((self.change | whole) & ~self.kept, drawn, observed)
