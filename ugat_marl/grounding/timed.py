"""Timed grounding: the policy's phase, with a green that begins later.

Slow vehicles use less of a green. The paper's grounded action, another phase, cannot express this.
Here the grounded action is the policy's own phase and a delay of its green. f predicts the change
in the real domain ("the street"). h answers with the delay that causes this change in the
simulation. Where h is not trusted, the delay is the one that fits all real transitions best.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ugat_marl.data import AgentLayout, TransitionLog
from ugat_marl.errors import OptionError, require_kinds, require_ranges
from ugat_marl.grounding.delays import (
    EpisodeRewards,
    LostTime,
    MatchedDelays,
    ModelErrors,
    lost_time,
    match_delays,
)
from ugat_marl.grounding.fitting import Changes, Fitter, OffData, Questions, Split, refuse_mismatch
from ugat_marl.grounding.forward import DelayedForward, ForwardConfig
from ugat_marl.grounding.gate import GateConfig
from ugat_marl.grounding.inverse import DelayModel, InverseConfig
from ugat_marl.grounding.joint import running
from ugat_marl.grounding.reports import (
    FitReport,
    Floats,
    ForwardReport,
    InverseReport,
    TrainingRecord,
    UncertaintyQuality,
    better_than_chance,
    complaint,
    flat,
)
from ugat_marl.grounding.stacked import Stack, StackedTransitions, alike, stack_log
from ugat_marl.grounding.transform import GroundedActions, Transform
from ugat_marl.grounding.view import InputsConfig, Moment, Neighbours
from ugat_marl.policies import one_thread
from ugat_marl.seeding import torch_generator

END_S = 0.5
"""Distance in s from the longest delay tried; a best delay within it may in truth be longer."""


@dataclass(frozen=True)
class TimedConfig:
    """Settings of timed grounding.

    Attributes:
        most_s: Longest delay of a green, in whole s. Roll-outs for D_sim use all delays from 0 to
            it. Delays longer than the green within one decision interval look all the same.
        answer: "state" asks h in every state and applies the gate; "constant" takes the delay that
            fits all transitions best, per intersection and phase.
        spread_s: Expected distance, in s, of delays of single phases and states from the delay of
            their intersection and phase. With few data, delays stay close to it.
        target_noise: Noise on the changes from which h learns, in units of the root mean square
            error of the model of the simulation. It stands for the error of f.
        match: True if the delays of an intersection are moved together until the policy gets the
            same reward in both domains. This needs roll-outs of the policy in both.
    """

    most_s: int = 5
    answer: Literal["state", "constant"] = "state"
    spread_s: float = 1.0
    target_noise: float = 0.2
    match: bool = False

    def __post_init__(self) -> None:
        require_kinds(self, "timed")
        require_ranges(
            self,
            "timed",
            at_least={"most_s": 1},
            positive=("spread_s",),
            non_negative=("target_noise",),
        )


class _Constants(nn.Module):
    """Delays in s for greens of agents whose h is not trusted.

    Attributes:
        delay_s: Lost time at the start of a green, ``(agents, phases)``.
        beyond_s: Further delay of all greens of an intersection, to match rewards, ``(agents, 1)``.
    """

    delay_s: Tensor
    beyond_s: Tensor

    def __init__(self, stack: Stack, match: bool) -> None:
        super().__init__()
        self.register_buffer("delay_s", torch.zeros(len(stack.agents), stack.actions))
        # Not stored without matching, so checkpoints with matching are refused then.
        self.register_buffer("beyond_s", torch.zeros(len(stack.agents), 1), persistent=match)


class TimedTransform(Transform):
    """f, h, gate and the best constant delays of a network.

    Args:
        layouts: Agent to the division of its observation, in the environment's order.
        seed: Seed of the initial weights.
        forward: Shape of the forward models, of the street and of the simulation.
        inverse: Shape of the inverse models.
        gate: Settings of alpha.
        timed: Settings of the delays.
        inputs: Inputs of the models beside the intersection's own state and action.
        neighbours: Agent to the agents one road away, for inputs with hops.
    """

    inverse: DelayModel

    def __init__(
        self,
        layouts: Mapping[str, AgentLayout],
        seed: int,
        forward: ForwardConfig | None = None,
        inverse: InverseConfig | None = None,
        gate: GateConfig | None = None,
        timed: TimedConfig | None = None,
        inputs: InputsConfig | None = None,
        neighbours: Neighbours | None = None,
    ) -> None:
        forward, inverse = forward or ForwardConfig(), inverse or InverseConfig()
        if forward.include_phase or inverse.include_phase:
            raise OptionError(
                "timed grounding does not change phases, so that include_phase says nothing; "
                "leave it off"
            )
        super().__init__(layouts, seed, forward, gate, inputs, neighbours)
        self.timed = timed or TimedConfig()
        most_s = self.timed.most_s
        # Its predictions are compared with the street, so it has the same view as f.
        self.simulated = DelayedForward(
            self.stack, forward, most_s, torch_generator(seed, "simulated"), self.forward.view
        )
        self.inverse = DelayModel(
            self.stack, inverse, most_s, torch_generator(seed, "inverse"), view=self.local
        )
        self.constants = _Constants(self.stack, self.timed.match)

    @property
    def models(self) -> dict[str, nn.Module]:
        """All modules with weights, by their names in a checkpoint."""
        return {**super().models, "simulated": self.simulated, "constants": self.constants}

    @one_thread()
    def fit(
        self,
        real: TransitionLog,
        simulated: TransitionLog,
        fitter: Fitter,
        rewards: EpisodeRewards | None = None,
        *,
        on_top: bool = False,
    ) -> TimedReport:
        """Fit f on the street, a model with delays and h on the simulation, and the constants.

        Args:
            real: Transitions of the real domain.
            simulated: Transitions of the simulation under random delays.
            fitter: Settings, seed and device of the training.
            rewards: Rewards of the policy in both worlds. If lost time does not explain their
                difference, all delays of an intersection are moved together until they match.
            on_top: True if f begins as the model of the simulation without delays.

        Raises:
            LogError: The logs are refused by `Transform.fit`.
        """
        refuse_mismatch(real, simulated)
        stack, model = self.stack, self.simulated
        street, data = alike(stack_log(real, stack), stack_log(simulated, stack))
        view = self.forward.view
        rows = fitter.split(data, stack)
        extra = model.extra(data.delay_s)
        training_data = Changes("simulated", view.of(data), data.outcome, data.executed, extra)
        g = fitter.fit_changes(model, training_data, rows)
        if on_top:
            self.forward.begin_as(model)
        own = fitter.further() if on_top else fitter
        training_data, _ = self.training_data(street)
        f = own.fit_changes(self.forward, training_data, fitter.split(street, stack))
        begins = _begins(data, stack)
        known = ModelErrors.of(model, replace(data, weight=rows.train * begins))
        street = replace(street, weight=street.weight * _begins(street, stack))
        lost = lost_time(model, street, known, self.timed.spread_s)
        # A lost time counts only if both models have learnt something.
        learnt = f.learnt & g.learnt
        matched = self._set_constants(lost, learnt, rewards)
        data = replace(data, weight=data.weight * begins)
        h = self._fit_inverse(data, _where(begins, rows), known.spread[:, None], fitter)
        mean_u = self._mean_u(street)
        return TimedReport(stack.agents, f, h, mean_u, g, lost, self.timed.most_s, matched)

    def training_data(self, data: StackedTransitions) -> tuple[Changes, Tensor]:
        """Return the outcomes of what was asked; only greens that begin can be grounded."""
        training_data = Changes("forward", self.forward.view.of(data), data.outcome, data.asked)
        begins = self.stack.current_phase(data.observation) != data.asked
        return training_data, data.weight * begins

    @property
    def acting(self) -> NDArray[np.bool_]:
        """True for agents with a trusted h or with constant delays, ``(agents,)``."""
        constant = self.constants.delay_s + self.constants.beyond_s
        return self.gate.trusted | (constant != 0).any(1).numpy()

    def restrict(self, agents: NDArray[np.bool_]) -> None:
        """Leave the greens of all other agents as they are, without constant delays, too."""
        super().restrict(agents)
        self.constants.delay_s.mul_(torch.from_numpy(agents)[:, None])
        self.constants.beyond_s.mul_(torch.from_numpy(agents)[:, None])

    def _set_constants(
        self, lost: LostTime, learnt: NDArray[np.bool_], rewards: EpisodeRewards | None
    ) -> MatchedDelays | None:
        """Set the constant delays where models have learnt something; return the matched delays."""
        shown = learnt & lost.shown
        self.constants.delay_s.copy_(lost.phase_s * torch.from_numpy(shown)[:, None])
        if rewards is None:
            return None
        matched = match_delays(rewards, np.where(shown, lost.best_s, 0.0))
        matched = replace(matched, beyond_s=matched.beyond_s * learnt)
        self.constants.beyond_s.copy_(torch.from_numpy(matched.beyond_s)[:, None])
        return matched

    def _fit_inverse(
        self, data: StackedTransitions, rows: Split, spread: Tensor, fitter: Fitter
    ) -> TimedInverseReport:
        """Fit h to the changes that a model of the simulation predicts under random delays.

        Single transitions are too noisy: the best guess of their delay is the middle of the range.
        h later reads the predictions of f. These are means, as are those of the model:

            change = (g(s, a, delay) + target_noise * noise) * scale
        """
        model, simulated, seed = self.inverse, self.simulated, fitter.seed
        seen = model.view.of(data)
        generator = torch_generator(seed, "inverse", "delays")
        answers = torch.randint(model.most_s + 1, data.executed.shape, generator=generator)
        with torch.no_grad():
            extra = simulated.extra(answers.float())
            change = simulated(simulated.view.of(data), data.executed, extra)
            noise = torch.randn(change.shape, generator=generator) * spread
            change = (change + self.timed.target_noise * noise) * simulated.scale
        inputs = model.inputs(seen, data.executed, change)
        off_data = OffData.around(inputs, rows.train, model.view, model.action_columns)
        training_data = Questions(inputs, answers, off_data)
        record = fitter.fit_answers(model, training_data, rows)
        return self._inverse_report(
            data, rows, training_data, record, torch_generator(seed, "off data")
        )

    @torch.no_grad()
    def _inverse_report(
        self,
        data: StackedTransitions,
        rows: Split,
        training_data: Questions,
        record: TrainingRecord,
        generator: torch.Generator,
    ) -> TimedInverseReport:
        """Measure h on its held-out questions and on single transitions."""
        model = self.inverse
        seconds = torch.arange(model.most_s + 1, dtype=torch.float32)
        answer = model.answer(training_data.inputs)
        happened = self.simulated.change(data.observation, data.outcome)
        single = model.predict(model.view.of(data), data.executed, happened)
        held = rows.held_out * data.weight  # 0 for agents that had to train without such rows
        count = int(held.sum(1).max().clamp(min=1))
        drawn = training_data.off_data.draw(count, generator, state_share=1.0)
        missed = answer.action != training_data.answers
        asked_s = training_data.answers.float()
        found_s = (answer.probability * seconds).sum(-1)
        gain_s = (seconds.mean() - asked_s).abs() - (found_s - asked_s).abs()
        return TimedInverseReport(
            training=record,
            calibration=UncertaintyQuality.of(answer, missed, held.bool(), model.answer(drawn)),
            uncertainty=model.method.name,
            error_s=mean_error(found_s, asked_s, held),
            error_on_transitions_s=mean_error(
                (single.probability * seconds).sum(-1), data.delay_s, held
            ),
            guess_s=float((seconds - seconds.mean()).abs().mean()),
            beats_guess=better_than_chance(gain_s, held),
        )

    @torch.no_grad()
    def _mean_u(self, street: StackedTransitions) -> Floats:
        """Return the weighted mean u of h's answers to the predictions of f, per agent."""
        seen, local = self.forward.view.of(street), self.local.of(street)
        u = self.delays(seen, local, street.executed)[1]
        mean = (u * street.weight).sum(1) / street.weight.sum(1)
        return mean.double().numpy()

    def ground(
        self,
        observations: Tensor,
        actions: NDArray[np.int64],
        permitted: NDArray[np.bool_] | None,
        earlier: Sequence[Moment],
    ) -> GroundedActions:
        """Return the policy's phases, with a delay where they change.

        Line numbers are those of Algorithm 1 (`ugat`). The gate gets delays in whole seconds. An
        action counts as changed if the delay of h differs from the constant delay.
        """
        asked = torch.from_numpy(actions)[:, None]
        usual = self._later(self.constants.delay_s.gather(1, asked))
        current = self.stack.current_phase(observations)[:, 0].numpy()
        switched = current != actions
        if self.timed.answer == "constant":
            delay = np.where(switched, usual[:, 0].numpy(), 0.0).astype(np.float32)
            return GroundedActions(actions, actions, np.zeros_like(delay), delay > 0, delay)
        # Grounding keeps all phases, so those of the neighbours are known in advance.
        phases = torch.from_numpy(running(actions, current, permitted))[:, None]
        delays_s, u = self.delays(  # lines 11 and 12
            self.forward.view.seen(observations, phases, earlier),
            self.local.seen(observations, phases),
            asked,
        )
        accepted = self.gate.decide(  # lines 13 and 15
            u[:, 0].numpy(),
            usual[:, 0].round().long().numpy(),
            delays_s[:, 0].round().long().numpy(),
            asked=switched,
        )
        delay = np.where(accepted, delays_s[:, 0].numpy(), usual[:, 0].numpy())
        delay = np.where(switched, delay, 0.0).astype(np.float32)
        return GroundedActions(actions, actions, u[:, 0].numpy(), accepted, delay)

    def delays(self, seen: Tensor, local: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the delays of h in s, pulled to the constant delays, and u: ``(agents, batch)``.

        Args:
            seen: ``(agents, batch, forward.view.width)`` observations in the view of f.
            local: ``(agents, batch, local.width)`` the same observations in the view of h.
            actions: ``(agents, batch)`` int64, phases that turn green.
        """
        if self.draws == 1:
            change = self.forward(seen, actions) * self.forward.scale
        else:
            change = self.forward.change_each(seen, actions)
        answer = self.inverse.predict(local, actions, change, self.draws)
        usual = self.constants.delay_s.gather(1, actions)
        # h estimates the lost time alone, so matching is added afterwards.
        likely_s = likely_delay(answer.probability, usual, self.timed.spread_s)
        return self._later(likely_s), answer.u

    def _later(self, delay_s: Tensor) -> Tensor:
        """Return delays ``(agents, batch)`` plus `beyond_s`, limited to 0 to `most_s` s."""
        return (delay_s + self.constants.beyond_s).clamp(0.0, float(self.timed.most_s))


def likely_delay(probability: Tensor, expected_s: Tensor, spread_s: float) -> Tensor:
    """Return the likeliest delay in s, ``(...)``, given a normal prior around an expected delay.

        argmax_d  log p(d) - (d - expected_s)^2 / (2 spread_s^2)

    With equal probabilities the answer is the expected delay.

    Args:
        probability: ``(..., classes)`` probabilities of delays of 0, 1, 2, ... s.
        expected_s: ``(...)`` expected delays, in s.
        spread_s: Standard deviation of the prior, in s.
    """
    seconds = torch.arange(probability.shape[-1], dtype=torch.float32)
    fine = torch.linspace(0.0, float(seconds[-1]), 10 * (len(seconds) - 1) + 1)
    # Log-probabilities are interpolated linearly between whole seconds.
    below = fine.floor().long().clamp(max=len(seconds) - 2)
    share = fine - below
    log = probability.clamp(min=1e-12).log()
    between = log[..., below] * (1.0 - share) + log[..., below + 1] * share
    prior = -0.5 * ((fine - expected_s[..., None]) / spread_s) ** 2
    return fine[(between + prior).argmax(-1)]


def _begins(data: StackedTransitions, stack: Stack) -> Tensor:
    """Return bool ``(agents, n)``, true where a green begins; only these greens can be late."""
    return stack.current_phase(data.observation) != data.executed


def _where(begins: Tensor, rows: Split) -> Split:
    """Return the rows in which a green begins; all rows of an agent that lacks such rows.

    The head of h is shared. An agent without rows would make the loss of all agents NaN.
    """
    train, held_out = rows.train * begins, rows.held_out * begins
    enough = (train.any(1) & held_out.any(1))[:, None]
    return Split(
        torch.where(enough, train, rows.train),
        torch.where(enough, held_out, rows.held_out),
        rows.kind,
    )


# --- reports


@dataclass(frozen=True)
class TimedInverseReport(InverseReport):
    """Held-out quality of h; delays and errors in s, arrays ``(agents,)``.

    `calibration` compares u with answers that name a wrong second.

    Attributes:
        error_s: Mean absolute error on predicted changes of held-out states.
        error_on_transitions_s: Mean absolute error on single held-out transitions. Their noise
            limits every answer.
        guess_s: Mean absolute error of the middle of the range as the constant answer.
        beats_guess: Agents whose h is better than that by more than chance.
    """

    error_s: Floats
    error_on_transitions_s: Floats
    guess_s: float
    beats_guess: NDArray[np.bool_]

    def as_dict(self, agents: Sequence[str]) -> dict[str, float]:
        """Return everything as flat numbers; arrays as their mean and one entry per agent."""
        numbers = self.training.as_dict("inverse")
        for name in ("error_s", "error_on_transitions_s"):
            numbers |= flat(f"inverse/{name}", getattr(self, name), agents)
        return numbers | {"inverse/guess_s": self.guess_s} | self.calibration.as_dict()


@dataclass(frozen=True)
class TimedReport(FitReport):
    """Held-out quality of the models of timed grounding, and the estimated delays.

    Attributes:
        inverse: Quality of h. `mean_u_on_predictions` is over real transitions in which a green
            begins.
        simulated: Quality of the model with delays, on held-out simulated transitions.
        lost: Delays that fit the street best.
        most_s: Longest delay tried, in s.
        matched: Delays with which rewards match; None without rewards.
    """

    inverse: TimedInverseReport
    simulated: ForwardReport
    lost: LostTime
    most_s: int
    matched: MatchedDelays | None = None

    def doubts(self) -> Iterator[str]:
        """Yield sentences about problems; some of them are empty."""
        yield from self.forward.doubts("f", self.agents)
        yield from self.simulated.doubts("the model of the simulation", self.agents)
        yield complaint(
            f"too few greens begin to tell how late they are (0 to {self.most_s} s would all "
            "fit; give more roll-outs or longer episodes)",
            self.lost.high_s - self.lost.low_s > self.most_s - END_S,
            self.agents,
        )
        yield complaint(
            f"the best delay is the longest tried ({self.most_s} s; raise timed most_s)",
            self._delay_s > self.most_s - END_S,
            self.agents,
        )
        if self.inverse.uncertainty == "none":
            yield "without uncertainty u is 0, and the gate takes every answer of h"
        elif (off := self.calibration.auroc_off_data) <= 0.5:
            yield f"u does not rise off the data (AUROC {off:.2f})"

    @property
    def _delay_s(self) -> Floats:
        """Delay of greens in s, ``(agents,)``: lost time plus matching."""
        beyond_s = 0.0 if self.matched is None else self.matched.beyond_s
        return self.lost.best_s * self._found + beyond_s

    @property
    def _found(self) -> NDArray[np.bool_]:
        """Agents with a lost time, if their models have learnt something."""
        return self.forward.learnt & self.simulated.learnt & self.lost.shown

    def trusted(self, least_accuracy: float = 0.0) -> NDArray[np.bool_]:
        """Return the agents with a trusted h, for `Gate.trust`; the others take the constant delay.

        An agent is trusted if f and the model of the simulation have learnt something, a lost time
        was found, h is better than a guess by more than chance, and
        error_s < (1 - least_accuracy) * guess_s.
        """
        h = self.inverse
        good = h.error_s < (1.0 - least_accuracy) * h.guess_s
        return self._found & h.beats_guess & good

    def as_dict(self) -> dict[str, float]:
        """Return flat numbers; arrays as their mean over agents and as one entry per agent."""
        numbers = self.forward.as_dict("forward", self.agents)
        numbers |= self.simulated.as_dict("simulated", self.agents)
        numbers |= self.inverse.as_dict(self.agents)
        for name in ("best_s", "low_s", "high_s"):
            numbers |= flat(f"lost_time/{name}", getattr(self.lost, name), self.agents)
        if self.matched is not None:
            numbers |= flat("lost_time/matched_s", self.matched.delay_s, self.agents)
            numbers |= flat("lost_time/beyond_s", self.matched.beyond_s, self.agents)
            numbers["lost_time/chance"] = self.matched.chance
        return numbers


def mean_error(found_s: Tensor, true_s: Tensor, weight: Tensor) -> Floats:
    """Return the mean absolute error per agent, ``(agents,)``; NaN without rows."""
    total = ((found_s - true_s).abs() * weight).sum(1).double()
    return (total / weight.sum(1).double()).numpy()
