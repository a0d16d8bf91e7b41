"""Fits f on real transitions and h on simulated ones."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ugat_marl.data import TransitionLog
from ugat_marl.errors import LogError
from ugat_marl.grounding.evidential import annealing
from ugat_marl.grounding.fit_config import FitConfig
from ugat_marl.grounding.fit_loop import EpochCallback, Split, split, taken, train_model
from ugat_marl.grounding.fit_report import (
    FitReport,
    ForwardReport,
    InverseReport,
    TrainingRecord,
    answers_to,
    forward_report,
    inverse_report,
    on_predictions,
    on_transitions,
)
from ugat_marl.grounding.forward import ForwardModel
from ugat_marl.grounding.inverse import AnswerModel, InverseModel
from ugat_marl.grounding.off_data import OffData
from ugat_marl.grounding.stacked import StackedTransitions, refuse_other_agents, stack_log
from ugat_marl.grounding.uncertainty import Lesson
from ugat_marl.policies import CPU, one_thread, placed
from ugat_marl.seeding import torch_generator


@one_thread()
def fit(
    forward: ForwardModel,
    inverse: InverseModel,
    real: TransitionLog,
    simulated: TransitionLog,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None = None,
    device: torch.device = CPU,
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
        device: Where the models are trained; they come from the CPU and end there.

    Raises:
        LogError: A log is of other agents, or too short to be split, or the logs differ in
            scenario, observation or decision interval.
    """
    refuse_mismatch(real, simulated)
    refuse_other_agents(real, inverse.stack)
    ours, theirs = stack_log(simulated, inverse.stack), stack_log(real, forward.stack)
    f = _fit_forward(forward, theirs, config, seed, on_epoch, device)
    means = _expected(forward, ours, config, seed, on_epoch, device)
    pairs = means if config.pairs == "smoothed" else None
    h = _fit_inverse(inverse, ours, config, seed, on_epoch, pairs, device)
    held_out = split(ours, config.held_out_every, inverse.stack).held_out
    held_out_real = split(theirs, config.held_out_every, inverse.stack).held_out
    agreement, u_on_predictions = on_predictions(forward, inverse, ours, held_out)
    accuracy_on_real, u_on_real = on_transitions(inverse, theirs, held_out_real)
    accuracy_on_means, _ = answers_to(inverse, ours, means, held_out)
    return FitReport(
        agents=forward.stack.agents,
        forward=f,
        inverse=h,
        agreement=agreement,
        mean_u_on_predictions=u_on_predictions,
        accuracy_on_real=accuracy_on_real,
        mean_u_on_real=u_on_real,
        accuracy_on_means=accuracy_on_means,
    )


def _expected(
    forward: ForwardModel,
    data: StackedTransitions,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None,
    device: torch.device,
) -> Tensor:
    """What the simulation makes of its states and actions on average, ``(agents, n, outputs)``."""
    generator, seen = torch_generator(seed, "simulated"), forward.view.of(data)
    model = ForwardModel(forward.stack, forward.config, generator, view=forward.view)
    lesson = Changes("simulated", seen, data.next_observation, data.executed)
    parts = split(data, config.held_out_every, forward.stack)
    fit_changes(model, lesson, parts, config, seed, on_epoch, device)
    with torch.no_grad():
        return model.predict(seen, data.executed)


def refuse_mismatch(real: TransitionLog, simulated: TransitionLog) -> None:
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
    device: torch.device = CPU,
) -> ForwardReport:
    """Fits f by least squares on the change of the features, each agent on its own rows."""
    return _fit_forward(model, stack_log(log, model.stack), config, seed, on_epoch, device)


def _fit_forward(
    model: ForwardModel,
    data: StackedTransitions,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None,
    device: torch.device,
) -> ForwardReport:
    parts = split(data, config.held_out_every, model.stack)
    lesson = Changes("forward", model.view.of(data), data.next_observation, data.asked)
    return fit_changes(model, lesson, parts, config, seed, on_epoch, device)


@dataclass(frozen=True)
class Changes:
    """What a model of changes learns from.

    Attributes:
        name: Of the model, in seeds and for the callback.
        observation: ``(agents, n, view.width)``, as the model's view makes it.
        outcome: ``(agents, n, features or more)``, the features afterwards.
        acted: ``(agents, n)`` int64, phases.
        extra: ``(agents, n, extra)`` further inputs, if there are any.
    """

    name: str
    observation: Tensor
    outcome: Tensor
    acted: Tensor
    extra: Tensor | None = None


def fit_changes(
    model: ForwardModel,
    asked: Changes,
    parts: Split,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None,
    device: torch.device = CPU,
) -> ForwardReport:
    """Fits a model of changes by least squares."""
    change = model.change(asked.observation, asked.outcome)
    if not (bool(model.fitted) and config.warm_start):
        model.renew(torch_generator(seed, asked.name, "weights"))
        model.fit_scale(asked.observation, change, parts.train)
    outputs = model.valid_outputs.sum(-1).to(device)
    inputs = model.inputs(asked.observation, asked.acted, asked.extra).to(device)
    truth = (change / model.scale).to(device)

    def loss(columns: Tensor, _epoch: int) -> Tensor:
        error = model.read(taken(inputs, columns)) - taken(truth, columns)
        return (error**2).sum(-1) / outputs

    generator = torch_generator(seed, asked.name, "batches")
    with placed(device, model):
        there = parts.to(device)
        record = train_model(asked.name, model, loss, there, config, generator, on_epoch)
        with torch.no_grad():
            found = (model.read_all(inputs) * model.scale).to(CPU)
    followed = asked.observation[..., : change.shape[-1]] * model.valid_outputs + change
    share = (parts.train / parts.train.sum(1, keepdim=True))[..., None]
    off_mean = followed - (followed * share).sum(1, keepdim=True)
    return forward_report(model, found, change, off_mean, parts.held_out, record)


@one_thread()
def fit_inverse(
    model: InverseModel,
    log: TransitionLog,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None = None,
    outcome: Tensor | None = None,
    device: torch.device = CPU,
) -> InverseReport:
    """Fits h with the loss of the method asked for; the head learns from all agents at once.

    With an `outcome`, ``(agents, n, features or more)``, h learns to read that in the place of the
    next observation.
    """
    data = stack_log(log, model.stack)
    return _fit_inverse(model, data, config, seed, on_epoch, outcome, device)


def _fit_inverse(
    model: InverseModel,
    data: StackedTransitions,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None,
    outcome: Tensor | None,
    device: torch.device,
) -> InverseReport:
    parts = split(data, config.held_out_every, model.stack)
    then = data.next_observation if outcome is None else outcome
    inputs = model.inputs(model.view.of(data), then)
    off_data = OffData.around(inputs, parts.train, model.view)
    record = fit_answers(
        model, Questions(inputs, data.executed, off_data), parts, config, seed, on_epoch, device
    )
    drawn = torch_generator(seed, "inverse", "off data")
    return inverse_report(model, data, parts.train, parts.held_out, record, drawn)


@dataclass(frozen=True)
class Questions:
    """What h is asked in training.

    Attributes:
        inputs: ``(agents, n, width)`` unscaled inputs.
        answers: ``(agents, n)`` int64, the true classes.
        off_data: Where h has to be unsure.
    """

    inputs: Tensor
    answers: Tensor
    off_data: OffData


def fit_answers(
    model: AnswerModel,
    asked: Questions,
    parts: Split,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None,
    device: torch.device = CPU,
) -> TrainingRecord:
    """Fits a model that answers with a class, with the loss of the method asked for."""
    fresh = not (bool(model.fitted) and config.warm_start and model.method == config.method)
    if fresh:
        model.renew(config.method, torch_generator(seed, "inverse", "weights"))
        model.standardise.fit(asked.inputs, parts.train)
    generator = torch_generator(seed, "inverse", "batches")
    standardised, answers = model.standardise(asked.inputs).to(device), asked.answers.to(device)
    parts, off_data = parts.to(device), asked.off_data.to(device)
    rows = parts.train.sum(1)

    def invent(count: int) -> Tensor:
        return model.standardise(off_data.draw(count, generator, state_share=0.5))

    def loss(columns: Tensor, epoch: int) -> Tensor:
        # Annealing lets a fresh model gather evidence before it is punished for misleading some.
        share = annealing(epoch, config.kl_epochs) if fresh and epoch >= 0 else 1.0
        weights = config.kl_weight, config.off_data_weight
        lesson = Lesson(epoch < 0, generator, rows, share, *weights, invent)
        return model.net.loss(taken(standardised, columns), taken(answers, columns), lesson)

    with placed(device, model):
        annealed = config.kl_epochs if fresh and config.uncertainty != "none" else 0
        return train_model("inverse", model, loss, parts, config, generator, on_epoch, annealed)
