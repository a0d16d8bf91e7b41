"""Fits f on real transitions and h on simulated ones.

Episodes are split into those trained on and those held out; a training ends when the held-out loss
has stopped falling, and the best weights are kept. Whether an episode is held out depends on its
number alone, so a log that grows by concatenation never moves an episode from one side to the other
and a warm start never meets a held-out episode it was trained on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ugat_marl.batched import one_thread
from ugat_marl.errors import LogError, OptionError
from ugat_marl.grounding.evidential import annealing
from ugat_marl.grounding.fit_report import (
    FitReport,
    ForwardReport,
    InverseReport,
    TrainingRecord,
    forward_report,
    inverse_report,
    on_predictions,
    on_transitions,
)
from ugat_marl.grounding.forward import ForwardModel
from ugat_marl.grounding.inverse import InverseModel
from ugat_marl.grounding.off_data import OffData
from ugat_marl.grounding.stacked import Stack, StackedTransitions, stack_log
from ugat_marl.grounding.uncertainty import Lesson, Method, MethodName
from ugat_marl.seeding import torch_generator
from ugat_marl.transitions import TransitionLog

EpochCallback = Callable[[str, int, float], None]
"""Called as ``callback("forward" or "inverse", epoch, held_out_loss)`` after every epoch."""

RowLoss = Callable[[Tensor, int], Tensor]
"""Loss of some columns of the data in an epoch (-1: the final form, of held-out rows).

Columns are ``(batch,)`` and losses ``(agents, batch)``; in an ensemble, where every member has an
order of its own, columns are ``(members, batch)`` and losses ``(agents, members, batch)``.
"""


@dataclass(frozen=True)
class FitConfig:
    """How the models are trained.

    Attributes:
        uncertainty: How h says that it is unsure: "edl" (evidential), "dropout" (Concrete Dropout),
            "ensemble" (Deep Ensembles), or "none", with which every grounded action is taken.
        members: Networks of an ensemble.
        passes: Thinned networks that dropout averages over.
        epochs: Most passes over the training rows.
        batch_size: Rows per agent and update.
        learning_rate: Of Adam.
        patience: Epochs without a lower held-out loss after which training ends.
        held_out_every: Every n-th episode is held out; of a single episode, the last n-th part.
        kl_epochs: Epochs over which the divergence term of the evidential loss and the certainty on
            invented inputs are annealed in.
        kl_weight: Final weight of that divergence, for "edl"; 1 is Sensoy et al. With eight phases
            that often look alike, 1 keeps h from learning: on grid2x2-v1 its held-out accuracy is
            0.60 (u 0.90, AUROC of u 0.72) against 0.70 (0.48, 0.73) at 0.1.
        off_data_weight: Weight of the certainty h shows on invented inputs (`off_data`), for all
            but "none"; 0 is each method as its paper has it, under which u need not rise off the
            data.
        warm_start: Go on from the current weights instead of drawing new ones.
    """

    uncertainty: MethodName = "edl"
    members: int = 5
    passes: int = 20
    epochs: int = 100
    batch_size: int = 64
    learning_rate: float = 1e-3
    patience: int = 10
    held_out_every: int = 4
    kl_epochs: int = 10
    kl_weight: float = 0.1
    off_data_weight: float = 0.1
    warm_start: bool = False

    @property
    def method(self) -> Method:
        """Which uncertainty h is given."""
        return Method(self.uncertainty, self.members, self.passes)

    def __post_init__(self) -> None:
        _ = self.method  # refuses what is impossible
        for name, least in (("epochs", 1), ("batch_size", 1), ("patience", 1), ("kl_epochs", 0)):
            if getattr(self, name) < least:
                raise OptionError(f"fit {name} is {getattr(self, name)}; allowed: >= {least}")
        if self.held_out_every < 2:
            raise OptionError(f"fit held_out_every is {self.held_out_every}; allowed: >= 2")
        if not 0 < self.learning_rate < math.inf:
            raise OptionError(f"fit learning_rate is {self.learning_rate}; allowed: > 0, finite")
        for name in ("kl_weight", "off_data_weight"):
            if not 0 <= getattr(self, name) < math.inf:
                raise OptionError(f"fit {name} is {getattr(self, name)}; allowed: >= 0, finite")


@dataclass(frozen=True)
class Split:
    """Weights ``(agents, n)`` of the rows trained on and held out, and how they were parted."""

    train: Tensor
    held_out: Tensor
    kind: str


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


@one_thread()
def fit(
    forward: ForwardModel,
    inverse: InverseModel,
    real: TransitionLog,
    simulated: TransitionLog,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None = None,
) -> FitReport:
    """Fits f on the real log, h on the simulated log, and measures both.

    Args:
        forward: Changed in place.
        inverse: Changed in place.
        real: Transitions of the world to be matched; f learns what the *asked* action does there.
        simulated: Transitions of the simulation; h learns which *executed* action did what.
        config: How to train.
        seed: Decides fresh weights, the order of batches, and the states drawn off the data.
        on_epoch: Called after every epoch.

    Raises:
        LogError: A log is of other agents, or too short to be split, or the logs differ in
            scenario, observation or decision interval.
    """
    _refuse_mismatch(real, simulated)
    f = fit_forward(forward, real, config, seed, on_epoch)
    h = fit_inverse(inverse, simulated, config, seed, on_epoch)
    ours, theirs = stack_log(simulated, inverse.stack), stack_log(real, inverse.stack)
    held_out = split(ours, config.held_out_every, inverse.stack).held_out
    held_out_real = split(theirs, config.held_out_every, inverse.stack).held_out
    agreement, u_on_predictions = on_predictions(forward, inverse, ours, held_out)
    accuracy_on_real, u_on_real = on_transitions(inverse, theirs, held_out_real)
    return FitReport(
        forward.stack.agents, f, h, agreement, u_on_predictions, accuracy_on_real, u_on_real
    )


def _refuse_mismatch(real: TransitionLog, simulated: TransitionLog) -> None:
    """Models of different state spaces or intervals cannot be composed."""
    for name in ("observation", "decision_interval_s"):
        one, two = getattr(real.provenance, name), getattr(simulated.provenance, name)
        if one != two:
            raise LogError(
                f"the real log has {name} {one!r}, the simulated log {two!r}; record both with the "
                f"same {name}"
            )


@one_thread()
def fit_forward(
    model: ForwardModel,
    log: TransitionLog,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None = None,
) -> ForwardReport:
    """Fits f by least squares on the change of the features, each agent on its own rows."""
    data = stack_log(log, model.stack)
    parts = split(data, config.held_out_every, model.stack)
    change = model.change(data.observation, data.next_observation)
    if not (bool(model.fitted) and config.warm_start):
        generator = torch_generator(seed, "forward", "weights")
        fresh = ForwardModel(model.stack, model.config, generator)
        model.load_state_dict(fresh.state_dict())
        model.fit_scale(data.observation, change, parts.train)
    outputs = model.valid_outputs.sum(-1)

    def loss(columns: Tensor, _epoch: int) -> Tensor:
        predicted = model(data.observation[:, columns], data.asked[:, columns])
        error = predicted - change[:, columns] / model.scale
        return (error**2).sum(-1) / outputs

    generator = torch_generator(seed, "forward", "batches")
    record = _train("forward", model, loss, parts, config, generator, on_epoch)
    return forward_report(model, data, parts.held_out, record)


@one_thread()
def fit_inverse(
    model: InverseModel,
    log: TransitionLog,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None = None,
) -> InverseReport:
    """Fits h with the loss of the method asked for; the head learns from all agents at once."""
    data = stack_log(log, model.stack)
    parts = split(data, config.held_out_every, model.stack)
    inputs = model.inputs(data.observation, data.next_observation)
    fresh = not (bool(model.fitted) and config.warm_start and model.method == config.method)
    if fresh:
        model.renew(config.method, torch_generator(seed, "inverse", "weights"))
        model.standardise.fit(inputs, parts.train)
    generator = torch_generator(seed, "inverse", "batches")
    off_data = OffData.around(inputs, parts.train, model.stack)
    standardised, rows = model.standardise(inputs), parts.train.sum(1)

    def invent(count: int) -> Tensor:
        return model.standardise(off_data.draw(count, generator, state_share=0.5))

    def loss(columns: Tensor, epoch: int) -> Tensor:
        # Annealing lets a fresh model gather evidence before it is punished for misleading some.
        share = annealing(epoch, config.kl_epochs) if fresh and epoch >= 0 else 1.0
        weights = config.kl_weight, config.off_data_weight
        lesson = Lesson(epoch < 0, generator, rows, share, *weights, invent)
        return model.net.loss(standardised[:, columns], data.executed[:, columns], lesson)

    record = _train("inverse", model, loss, parts, config, generator, on_epoch)
    drawn = torch_generator(seed, "inverse", "off data")
    return inverse_report(model, data, parts.train, parts.held_out, record, drawn)


class _Best:
    """The weights with the lowest held-out loss, each of `units` parts of the model for itself."""

    def __init__(self, model: nn.Module, units: int) -> None:
        self._model = model
        self._weights = {name: p.detach().clone() for name, p in model.named_parameters()}
        self.loss = torch.full((units,), torch.inf)

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


def _train(
    name: str,
    model: ForwardModel | InverseModel,
    loss: RowLoss,
    parts: Split,
    config: FitConfig,
    generator: torch.Generator,
    on_epoch: EpochCallback | None,
) -> TrainingRecord:
    # Agents of f and members of h share no weight, so each may keep its own best.
    h = model if isinstance(model, InverseModel) else None
    members = h.net.members if h else 1
    best = _Best(model, members if h else len(parts.train))

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
        train_loss = _epoch(loss, parts.train, batches, epoch, optimiser)
        held_out_loss = held_out()
        improved = best.offer(held_out_loss)
        epoch += 1
        waited = 0 if improved else waited + 1
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


def _shuffled(columns: Tensor, members: int, generator: torch.Generator) -> Tensor:
    """Columns in random order, ``(n,)``; of several members each in its own, ``(members, n)``."""
    orders = [torch.randperm(len(columns), generator=generator) for _ in range(members)]
    return columns[orders[0] if members == 1 else torch.stack(orders)]


def _epoch(
    loss: RowLoss,
    weight: Tensor,
    batches: Sequence[Tensor],
    epoch: int,
    optimiser: torch.optim.Optimizer,
) -> float:
    """One pass over the batches of columns; the mean loss over agents, members and batches."""
    total = 0.0
    for batch in batches:
        own = weight[:, batch]
        # Each agent's mean, summed: an agent learns as fast among many as it would alone.
        mean = (loss(batch, epoch) * own).sum(-1) / own.sum(-1).clamp(min=1.0)
        optimiser.zero_grad(set_to_none=True)
        mean.sum().backward()
        optimiser.step()
        total += float(mean.detach().mean())
    return total / len(batches)


@torch.no_grad()
def _mean_loss(loss: RowLoss, weight: Tensor, members: int, chunk: int = 2048) -> Tensor:
    """Mean loss over the rows with weight, ``(agents,)`` or, of several, ``(agents, members)``."""
    total, rows = torch.zeros(()), torch.zeros(())
    for batch in weight.any(0).nonzero()[:, 0].split(chunk):
        columns = batch if members == 1 else batch.expand(members, -1)
        own = weight[:, columns]
        total, rows = total + (loss(columns, -1) * own).sum(-1), rows + own.sum(-1)
    return total / rows
