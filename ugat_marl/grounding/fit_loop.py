"""The training loop of f and h: held-out episodes, early stopping, the best weights kept.

Whether an episode is held out depends on its number alone, so a log that grows by concatenation
never moves an episode from one side to the other and a warm start never meets a held-out episode it
was trained on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ugat_marl.errors import LogError
from ugat_marl.grounding.fit_config import FitConfig
from ugat_marl.grounding.fit_report import TrainingRecord
from ugat_marl.grounding.forward import ForwardModel
from ugat_marl.grounding.inverse import AnswerModel
from ugat_marl.grounding.products import full_width, rows_at_once
from ugat_marl.grounding.stacked import Stack, StackedTransitions

EpochCallback = Callable[[str, int, float], None]
"""Called as ``callback("forward" or "inverse", epoch, held_out_loss)`` after every epoch."""

RowLoss = Callable[[Tensor, int], Tensor]
"""Loss of some columns of the data in an epoch (-1: the final form, of held-out rows).

Columns are ``(batch,)`` and losses ``(agents, batch)``; in an ensemble, where every member has an
order of its own, columns are ``(members, batch)`` and losses ``(agents, members, batch)``.
"""


@dataclass(frozen=True)
class Split:
    """Weights ``(agents, n)`` of the rows trained on and held out, and how they were parted."""

    train: Tensor
    held_out: Tensor
    kind: str

    def to(self, device: torch.device) -> Split:
        """The same on a device."""
        return Split(self.train.to(device), self.held_out.to(device), self.kind)


def split(data: StackedTransitions, every: int, stack: Stack) -> Split:
    """Holds out episodes 1, 1 + every, ...; of a single episode, the last of `every` parts.

    Raises:
        LogError: An agent would have nothing to train on or nothing held out.
    """
    if int(data.episode.max()) > 0:
        held, kind = data.episode % every == 1 % every, "episodes"
    else:
        last = torch.where(data.weight.bool(), data.step, 0).amax(1, keepdim=True)
        held, kind = data.step > last * (1 - 1 / every), "steps"
    train, held_out = data.weight * ~held, data.weight * held
    for agent, rows, others in zip(stack.agents, train.sum(1), held_out.sum(1), strict=True):
        if not rows or not others:
            raise LogError(
                f"{agent} has {int(rows)} rows to train on and {int(others)} to hold out; "
                "record at least two whole episodes"
            )
    return Split(train, held_out, kind)


class _Best:
    """The weights with the lowest held-out loss, each of `units` parts of the model for itself."""

    def __init__(self, model: nn.Module, units: int, device: torch.device) -> None:
        self._model = model
        self._weights = {name: p.detach().clone() for name, p in model.named_parameters()}
        self.loss = torch.full((units,), torch.inf, device=device)

    def offer(self, loss: Tensor) -> bool:
        """Keeps the model's current weights where `loss`, ``(units,)``, is lower than before."""
        better = loss < self.loss
        if not better.any():
            return False
        self.loss = torch.where(better, loss, self.loss)
        units = len(better)
        for name, parameter in self._model.named_parameters():
            self._weights[name].view(units, -1)[better] = parameter.detach().view(units, -1)[better]
        return True

    def restore(self) -> None:
        """Puts the kept weights back into the model."""
        self._model.load_state_dict(self._weights, strict=False)


def train_model(
    name: str,
    model: ForwardModel | AnswerModel,
    loss: RowLoss,
    parts: Split,
    config: FitConfig,
    generator: torch.Generator,
    on_epoch: EpochCallback | None,
    annealed: int = 0,
) -> TrainingRecord:
    """Trains until the held-out loss has stopped falling; the model keeps its best weights.

    Model, columns of the data and `parts` are on one device; `generator` is on the CPU. The
    held-out loss has all its terms from the start: that it does not fall in the `annealed` epochs,
    in which they come into training one by one, says nothing.
    """
    # Agents of f and members of h share no weight, so each may keep its own best.
    h = model if isinstance(model, AnswerModel) else None
    members = h.net.members if h else 1
    best = _Best(model, members if h else len(parts.train), parts.train.device)

    def held_out() -> Tensor:
        found = _mean_loss(loss, parts.held_out, members)
        return found.mean(0).view(-1) if h else found

    if bool(model.fitted):  # a warm start that only makes things worse must change nothing
        best.offer(held_out())
    optimiser = torch.optim.Adam(model.parameters(), lr=config.learning_rate, fused=True)
    columns = parts.train.any(0).nonzero()[:, 0]
    waited = epoch = 0
    train_loss = float("nan")
    while epoch < config.epochs and waited < config.patience:
        batches = _shuffled(columns, members, generator).split(config.batch_size, dim=-1)
        with full_width(len(parts.train) * members):
            train_loss = _epoch(loss, parts.train, batches, epoch, optimiser)
            held_out_loss = held_out()
        improved = best.offer(held_out_loss)
        epoch += 1
        waited = 0 if improved or epoch <= annealed else waited + 1
        if on_epoch is not None:
            on_epoch(name, epoch, float(held_out_loss.mean()))
    best.restore()
    model.fitted.fill_(True)
    return TrainingRecord(
        epochs=epoch,
        train_loss=train_loss,
        held_out_loss=float(best.loss.mean()),
        split=parts.kind,
        train_rows=int(parts.train.sum()),
        held_out_rows=int(parts.held_out.sum()),
    )


def taken(data: Tensor, columns: Tensor) -> Tensor:
    """Some columns of ``(agents, n, ...)``, of which each member may have its own."""
    # The same as indexing, which takes seven times as long.
    return data.index_select(1, columns) if columns.dim() == 1 else data[:, columns]


def _shuffled(columns: Tensor, members: int, generator: torch.Generator) -> Tensor:
    """Columns in random order, ``(n,)``; of several members each in its own, ``(members, n)``."""
    orders = [torch.randperm(len(columns), generator=generator) for _ in range(members)]
    order = orders[0] if members == 1 else torch.stack(orders)
    return columns[order.to(columns.device)]


def _epoch(
    loss: RowLoss,
    weight: Tensor,
    batches: Sequence[Tensor],
    epoch: int,
    optimiser: torch.optim.Optimizer,
) -> float:
    """One pass over the batches of columns; the mean loss over agents, members and batches."""
    found: list[Tensor] = []
    for batch in batches:
        own = taken(weight, batch)
        # Each agent's mean, summed: an agent learns as fast among many as it would alone.
        mean = (loss(batch, epoch) * own).sum(-1) / own.sum(-1).clamp(min=1.0)
        optimiser.zero_grad(set_to_none=True)
        mean.sum().backward()
        optimiser.step()
        found.append(mean.detach().mean())
    # Read once at the end: a GPU would be waited for at every batch.
    return sum(torch.stack(found).cpu().tolist()) / len(batches)


@torch.no_grad()
def _mean_loss(loss: RowLoss, weight: Tensor, members: int) -> Tensor:
    """Mean loss over the rows with weight, ``(agents,)`` or, of several, ``(agents, members)``."""
    chunk = rows_at_once(len(weight) * members)
    total, rows = weight.new_zeros(()), weight.new_zeros(())
    for batch in weight.any(0).nonzero()[:, 0].split(chunk):
        columns = batch if members == 1 else batch.expand(members, -1)
        own = taken(weight, columns)
        total, rows = total + (loss(columns, -1) * own).sum(-1), rows + own.sum(-1)
    return total / rows
