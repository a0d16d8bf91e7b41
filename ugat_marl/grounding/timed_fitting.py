"""Fits timed grounding: f on the street, a model with delays and h on the simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ugat_marl.data import TransitionLog
from ugat_marl.grounding.arrays import Floats
from ugat_marl.grounding.fit_config import FitConfig
from ugat_marl.grounding.fit_loop import EpochCallback, Split, split
from ugat_marl.grounding.fit_report import Calibration, TrainingRecord, with_the_others
from ugat_marl.grounding.fitting import (
    Changes,
    Questions,
    fit_answers,
    fit_changes,
    refuse_mismatch,
)
from ugat_marl.grounding.lost_time import Means, lost_time
from ugat_marl.grounding.matching import Paid, match
from ugat_marl.grounding.off_data import OffData
from ugat_marl.grounding.stacked import Stack, StackedTransitions, stack_log
from ugat_marl.grounding.timed import TimedTransform
from ugat_marl.grounding.timed_report import DelayReport, TimedReport, mean_error
from ugat_marl.policies import CPU, one_thread
from ugat_marl.seeding import torch_generator


@one_thread()
def fit_timed(
    transform: TimedTransform,
    real: TransitionLog,
    simulated: TransitionLog,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None = None,
    device: torch.device = CPU,
    paid: Paid | None = None,
) -> TimedReport:
    """Fits all models of a timed grounding, and measures them.

    Args:
        transform: Changed in place.
        real: Transitions of the world to be matched.
        simulated: Transitions of the simulation under random delays.
        config: How to train.
        seed: Decides fresh weights, the order of batches, and what is drawn.
        on_epoch: Called after every epoch.
        device: Where the models are trained; they come from the CPU and end there.
        paid: What the policy in training got in both worlds; with it all delays of an intersection
            are moved together until it gets the same, where the lost time does not explain it.

    Raises:
        LogError: As `fitting.fit`.
    """
    refuse_mismatch(real, simulated)
    how = config, seed, on_epoch, device
    stack, model = transform.stack, transform.simulated
    street, data = _alike(stack_log(real, stack), stack_log(simulated, stack))
    parts = split(street, config.held_out_every, stack)
    lesson = Changes("forward", transform.forward.view.of(street), street.outcome, street.asked)
    f = fit_changes(transform.forward, lesson, parts, *how)
    parts = split(data, config.held_out_every, stack)
    extra = model.extra(data.delay_s)
    lesson = Changes("simulated", model.view.of(data), data.outcome, data.executed, extra)
    g = fit_changes(model, lesson, parts, *how)
    begins = _begins(data, stack)
    known = Means.of(model, replace(data, weight=parts.train * begins))
    street = replace(street, weight=street.weight * _begins(street, stack))
    lost = lost_time(model, street, known, transform.timed.spread_s)
    # Models that know nothing of a street or of the simulation know of no lost time either.
    learnt = f.learnt & g.learnt
    found = learnt & lost.shown
    transform.constants.delay_s.copy_(lost.phase_s * torch.from_numpy(found)[:, None])
    matched = None
    if paid is not None:
        matched = match(paid, np.where(found, lost.best_s, 0.0))
        matched = replace(matched, beyond_s=matched.beyond_s * learnt)
        transform.constants.beyond_s.copy_(torch.from_numpy(matched.beyond_s)[:, None])
    data = replace(data, weight=data.weight * begins)
    spread = known.spread[:, None]
    h = _fit_delays(transform, data, _where(begins, parts), spread, *how)
    most_s, u = transform.timed.most_s, _expected_u(transform, street)
    return TimedReport(stack.agents, f, g, lost, h, most_s, u, matched)


@torch.no_grad()
def _expected_u(transform: TimedTransform, street: StackedTransitions) -> Floats:
    """Mean u of h's answers to what f predicts, per agent, by the weights of the rows."""
    seen, local = transform.forward.view.of(street), transform.local.of(street)
    u = transform.delays(seen, local, street.executed)[1]
    mean = (u * street.weight).sum(1) / street.weight.sum(1)
    return with_the_others(mean.double().numpy())


def _alike(
    one: StackedTransitions, two: StackedTransitions
) -> tuple[StackedTransitions, StackedTransitions]:
    """Both with the features that were served, or neither."""
    if one.served_features is None or two.served_features is None:
        return replace(one, served_features=None), replace(two, served_features=None)
    return one, two


def _begins(data: StackedTransitions, stack: Stack) -> Tensor:
    """Where a green begins, ``(agents, n)``: elsewhere it cannot be late."""
    return stack.current_phase(data.observation) != data.executed


def _where(begins: Tensor, parts: Split) -> Split:
    """The rows in which a green begins; all of an agent's, if it lacks such rows on one side.

    The head of h is shared: without rows of one agent the loss of all would be no number.
    """
    train, held_out = parts.train * begins, parts.held_out * begins
    enough = (train.any(1) & held_out.any(1))[:, None]
    return Split(
        torch.where(enough, train, parts.train),
        torch.where(enough, held_out, parts.held_out),
        parts.kind,
    )


def _fit_delays(
    transform: TimedTransform,
    data: StackedTransitions,
    parts: Split,
    spread: Tensor,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None,
    device: torch.device,
) -> DelayReport:
    """Fits h to what the model of the simulation makes of every state under some delay.

    Not to single transitions: from one of those the delay can hardly be told, and whoever guesses
    it well under noise guesses the middle of the range. f, whose output h is to read, predicts
    means, and so does the model.
    """
    model, simulated = transform.inverse, transform.simulated
    seen = model.view.of(data)
    generator = torch_generator(seed, "inverse", "delays")
    answers = torch.randint(model.most_s + 1, data.executed.shape, generator=generator)
    with torch.no_grad():
        extra = simulated.extra(answers.float())
        change = simulated(simulated.view.of(data), data.executed, extra)
        noise = torch.randn(change.shape, generator=generator) * spread
        change = (change + transform.timed.target_noise * noise) * simulated.scale
    inputs = model.inputs(seen, data.executed, change)
    off_data = OffData.around(inputs, parts.train, model.view, model.action_columns)
    asked = Questions(inputs, answers, off_data)
    record = fit_answers(model, asked, parts, config, seed, on_epoch, device)
    return _report(transform, data, parts, asked, record, torch_generator(seed, "off data"))


@torch.no_grad()
def _report(
    transform: TimedTransform,
    data: StackedTransitions,
    parts: Split,
    asked: Questions,
    record: TrainingRecord,
    generator: torch.Generator,
) -> DelayReport:
    model = transform.inverse
    seconds = torch.arange(model.most_s + 1, dtype=torch.float32)
    answer = model.answer(asked.inputs)
    happened = transform.simulated.change(data.observation, data.outcome)
    single = model.predict(model.view.of(data), data.executed, happened)
    held = parts.held_out * data.weight  # nothing is known of an agent that had to take all rows
    drawn = asked.off_data.draw(int(held.sum(1).max().clamp(min=1)), generator, state_share=1.0)
    missed = answer.action != asked.answers
    return DelayReport(
        training=record,
        error_s=mean_error((answer.probability * seconds).sum(-1), asked.answers.float(), held),
        error_on_transitions_s=mean_error(
            (single.probability * seconds).sum(-1), data.delay_s, held
        ),
        guess_s=float((seconds - seconds.mean()).abs().mean()),
        calibration=Calibration.of(answer, missed, held.bool(), model.answer(drawn)),
        uncertainty=model.method.name,
    )
