"""Fits f on real transitions and h on simulated ones."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ugat_marl.batched import one_thread
from ugat_marl.errors import LogError
from ugat_marl.grounding.evidential import annealing
from ugat_marl.grounding.fit_config import FitConfig
from ugat_marl.grounding.fit_loop import EpochCallback, Split, split, train_model
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
from ugat_marl.grounding.inverse import AnswerModel, InverseModel
from ugat_marl.grounding.off_data import OffData
from ugat_marl.grounding.stacked import stack_log
from ugat_marl.grounding.uncertainty import Lesson
from ugat_marl.seeding import torch_generator
from ugat_marl.transitions import TransitionLog


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
    name: str = "forward",
) -> ForwardReport:
    """Fits f by least squares on the change of the features, each agent on its own rows.

    A model of delays learns what the *executed* action does when its green is held back so long.
    """
    data = stack_log(log, model.stack)
    parts = split(data, config.held_out_every, model.stack)
    change = model.change(data.observation, data.next_observation)
    if not (bool(model.fitted) and config.warm_start):
        generator = torch_generator(seed, name, "weights")
        fresh = ForwardModel(model.stack, model.config, generator, model.delays)
        model.load_state_dict(fresh.state_dict())
        model.fit_scale(data.observation, change, parts.train)
    outputs = model.valid_outputs.sum(-1)
    acted = data.executed if model.delays else data.asked

    def loss(columns: Tensor, _epoch: int) -> Tensor:
        delay_s = data.delay_s[:, columns]
        predicted = model(data.observation[:, columns], acted[:, columns], delay_s)
        error = predicted - change[:, columns] / model.scale
        return (error**2).sum(-1) / outputs

    generator = torch_generator(seed, name, "batches")
    record = train_model(name, model, loss, parts, config, generator, on_epoch)
    return forward_report(model, data, acted, parts.held_out, record)


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
    off_data = OffData.around(inputs, parts.train, model.stack)
    record = fit_answers(
        model, Questions(inputs, data.executed, off_data), parts, config, seed, on_epoch
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
) -> TrainingRecord:
    """Fits a model that answers with a class, with the loss of the method asked for."""
    fresh = not (bool(model.fitted) and config.warm_start and model.method == config.method)
    if fresh:
        model.renew(config.method, torch_generator(seed, "inverse", "weights"))
        model.standardise.fit(asked.inputs, parts.train)
    generator = torch_generator(seed, "inverse", "batches")
    standardised, rows = model.standardise(asked.inputs), parts.train.sum(1)

    def invent(count: int) -> Tensor:
        return model.standardise(asked.off_data.draw(count, generator, state_share=0.5))

    def loss(columns: Tensor, epoch: int) -> Tensor:
        # Annealing lets a fresh model gather evidence before it is punished for misleading some.
        share = annealing(epoch, config.kl_epochs) if fresh and epoch >= 0 else 1.0
        weights = config.kl_weight, config.off_data_weight
        lesson = Lesson(epoch < 0, generator, rows, share, *weights, invent)
        return model.net.loss(standardised[:, columns], asked.answers[:, columns], lesson)

    return train_model("inverse", model, loss, parts, config, generator, on_epoch)
