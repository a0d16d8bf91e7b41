"""Fits f on real transitions and h on simulated ones.

Episodes are split into those trained on and those held out; a training ends when the held-out loss
has stopped falling, and the best weights are kept. Whether an episode is held out depends on its
number alone, so a log that grows by concatenation never moves an episode from one side to the other
and a warm start never meets a held-out episode it was trained on.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ugat_marl.batched import one_thread
from ugat_marl.errors import LogError, OptionError
from ugat_marl.grounding.evidential import annealing, divergence_from_uniform, evidential_loss
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
from ugat_marl.seeding import torch_generator
from ugat_marl.transitions import TransitionLog

EpochCallback = Callable[[str, int, float], None]
"""Called as ``callback("forward" or "inverse", epoch, held_out_loss)`` after every epoch."""

RowLoss = Callable[[Tensor, int], Tensor]
"""Loss of some columns of the data, ``(agents, columns)``, in an epoch (-1: the final form)."""


@dataclass(frozen=True)
class FitConfig:
    """How the models are trained.

    Attributes:
        epochs: Most passes over the training rows.
        batch_size: Rows per agent and update.
        learning_rate: Of Adam.
        patience: Epochs without a lower held-out loss after which training ends.
        held_out_every: Every n-th episode is held out; of a single episode, the last n-th part.
        kl_epochs: Epochs over which the divergence term of the evidential loss is annealed in.
        kl_weight: Its final weight; 1 is Sensoy et al. With eight phases that often look alike, 1
            keeps h from learning: on grid2x2-v1 its held-out accuracy is 0.60 (u 0.90, AUROC of u
            0.72) against 0.70 (0.48, 0.73) at 0.1.
        off_data_weight: Weight of the certainty h shows on invented inputs (`off_data`); 0 is the
            evidential loss alone, under which u need not rise off the data.
        warm_start: Go on from the current weights instead of drawing new ones.
    """

    epochs: int = 100
    batch_size: int = 64
    learning_rate: float = 1e-3
    patience: int = 10
    held_out_every: int = 4
    kl_epochs: int = 10
    kl_weight: float = 0.1
    off_data_weight: float = 0.1
    warm_start: bool = False

    def __post_init__(self) -> None:
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
    fresh = _prepare(model, config, torch_generator(seed, "forward", "weights"))
    if fresh:
        model.fit_scale(data.observation, change, parts.train)
    outputs = model.valid_outputs.sum(-1)

    def loss(columns: Tensor, _epoch: int) -> Tensor:
        predicted = model(data.observation[:, columns], data.asked[:, columns])
        error = predicted - change[:, columns] / model.scale
        return (error**2).sum(-1) / outputs

    generator = torch_generator(seed, "forward", "batches")
    record = _train("forward", model, loss, parts, config, generator, on_epoch, shared=False)
    return forward_report(model, data, parts.held_out, record)


@one_thread()
def fit_inverse(
    model: InverseModel,
    log: TransitionLog,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None = None,
) -> InverseReport:
    """Fits h with the evidential loss; the shared head learns from all agents at once."""
    data = stack_log(log, model.stack)
    parts = split(data, config.held_out_every, model.stack)
    inputs = model.inputs(data.observation, data.next_observation)
    fresh = _prepare(model, config, torch_generator(seed, "inverse", "weights"))
    if fresh:
        model.standardise.fit(inputs, parts.train)

    def loss(columns: Tensor, epoch: int) -> Tensor:
        # Annealing lets a fresh model gather evidence before it is punished for misleading some.
        share = annealing(epoch, config.kl_epochs) if fresh and epoch >= 0 else 1.0
        alpha = model(inputs[:, columns])
        weight = config.kl_weight * share
        error = evidential_loss(alpha, data.executed[:, columns], model.valid_actions, weight)
        if not config.off_data_weight:
            return error
        invented = off_data.draw(len(columns) // 2 + 1, generator, state_share=0.5)
        certain = divergence_from_uniform(model(invented), model.valid_actions)
        return error + config.off_data_weight * share * certain.mean(1, keepdim=True)

    generator = torch_generator(seed, "inverse", "batches")
    off_data = OffData.around(inputs, parts.train, model.stack)
    record = _train("inverse", model, loss, parts, config, generator, on_epoch, shared=True)
    drawn = torch_generator(seed, "inverse", "off data")
    return inverse_report(model, data, parts.train, parts.held_out, record, drawn)


def _prepare(
    model: ForwardModel | InverseModel, config: FitConfig, generator: torch.Generator
) -> bool:
    """Draws new weights unless this is a warm start; true if the weights are new."""
    if bool(model.fitted) and config.warm_start:
        return False
    if isinstance(model, ForwardModel):
        fresh = ForwardModel(model.stack, model.config, generator).state_dict()
    else:
        fresh = InverseModel(model.stack, model.config, generator).state_dict()
    model.load_state_dict(fresh)
    return True


class _Best:
    """The weights with the lowest held-out loss; agent by agent unless parts are shared."""

    def __init__(self, model: nn.Module, agents: int, shared: bool) -> None:
        self._model = model
        self._shared = shared
        self._weights = {name: p.detach().clone() for name, p in model.named_parameters()}
        self.loss = torch.full((agents,), torch.inf)

    def offer(self, loss: Tensor) -> bool:
        """Keeps the model's current weights where `loss`, ``(agents,)``, is lower than before."""
        if self._shared:
            better = (loss.mean() < self.loss.mean()).expand_as(loss)
        else:
            better = loss < self.loss
        if not better.any():
            return False
        self.loss = torch.where(better, loss, self.loss)
        for name, parameter in self._model.named_parameters():
            if self._shared:
                self._weights[name].copy_(parameter.detach())
            else:
                self._weights[name][better] = parameter.detach()[better]
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
    shared: bool,
) -> TrainingRecord:
    best = _Best(model, len(parts.train), shared)
    if bool(model.fitted):  # a warm start that only makes things worse must change nothing
        best.offer(_mean_loss(loss, parts.held_out))
    optimiser = torch.optim.Adam(model.parameters(), lr=config.learning_rate, fused=True)
    columns = parts.train.any(0).nonzero()[:, 0]
    waited = epoch = 0
    train_loss = float("nan")
    while epoch < config.epochs and waited < config.patience:
        train_loss = _epoch(loss, parts.train, columns, epoch, optimiser, config, generator)
        held_out_loss = _mean_loss(loss, parts.held_out)
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


def _epoch(
    loss: RowLoss,
    weight: Tensor,
    columns: Tensor,
    epoch: int,
    optimiser: torch.optim.Optimizer,
    config: FitConfig,
    generator: torch.Generator,
) -> float:
    """One pass over the training columns in random order; the mean loss over agents and batches."""
    order = columns[torch.randperm(len(columns), generator=generator)]
    total, batches = 0.0, order.split(config.batch_size)
    for batch in batches:
        own = weight[:, batch]
        # Each agent's mean, summed: an agent learns as fast among many as it would alone.
        mean = (loss(batch, epoch) * own).sum(1) / own.sum(1).clamp(min=1.0)
        optimiser.zero_grad(set_to_none=True)
        mean.sum().backward()
        optimiser.step()
        total += float(mean.detach().mean())
    return total / len(batches)


@torch.no_grad()
def _mean_loss(loss: RowLoss, weight: Tensor, chunk: int = 2048) -> Tensor:
    """Mean loss per agent over the rows with weight, in its final form."""
    total = torch.zeros(len(weight))
    for columns in weight.any(0).nonzero()[:, 0].split(chunk):
        total += (loss(columns, -1) * weight[:, columns]).sum(1)
    return total / weight.sum(1)
