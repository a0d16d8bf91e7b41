"""Phase grounding, the paper's: the grounded action is another phase."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ugat_marl.data import AgentLayout, TransitionLog
from ugat_marl.errors import OptionError
from ugat_marl.grounding.delays import EpisodeRewards
from ugat_marl.grounding.fitting import Changes, Fitter, OffData, Questions, Split, refuse_mismatch
from ugat_marl.grounding.forward import ForwardConfig, ForwardModel
from ugat_marl.grounding.gate import GateConfig
from ugat_marl.grounding.inverse import InverseConfig, InverseModel
from ugat_marl.grounding.joint import alone, together, turns
from ugat_marl.grounding.reports import (
    FitReport,
    Floats,
    InverseReport,
    TrainingRecord,
    UncertaintyQuality,
    auroc,
    better_than_chance,
    complaint,
    flat,
)
from ugat_marl.grounding.stacked import StackedTransitions, stack_log
from ugat_marl.grounding.transform import GroundedActions, Transform
from ugat_marl.grounding.view import InputsConfig, Moment, Neighbours
from ugat_marl.policies import one_thread
from ugat_marl.seeding import torch_generator

DISCRIMINATES = 0.55
"""AUROC of u below which a warning calls u uninformative."""


class PhaseTransform(Transform):
    """Phase grounding, the paper's: the grounded action is another phase.

    Args:
        layouts: Agent to the division of its observation, in the environment's order.
        seed: Seed of the initial weights.
        forward: Shape of the forward models.
        inverse: Shape of the inverse models.
        gate: Settings of alpha.
        inputs: Inputs of the models beside the intersection's own state and action.
        neighbours: Agent to the agents one road away, for inputs with hops.
    """

    inverse: InverseModel

    def __init__(
        self,
        layouts: Mapping[str, AgentLayout],
        seed: int,
        forward: ForwardConfig | None = None,
        inverse: InverseConfig | None = None,
        gate: GateConfig | None = None,
        inputs: InputsConfig | None = None,
        neighbours: Neighbours | None = None,
    ) -> None:
        forward, inverse = forward or ForwardConfig(), inverse or InverseConfig()
        if forward.include_phase != inverse.include_phase:
            raise OptionError(
                f"include_phase is {forward.include_phase} in the forward and "
                f"{inverse.include_phase} in the inverse model; h must be given what f predicts"
            )
        super().__init__(layouts, seed, forward, gate, inputs, neighbours)
        self.inverse = InverseModel(
            self.stack, inverse, torch_generator(seed, "inverse"), view=self.local
        )
        self._in_turn = turns(self.stack.agents, self.local.near)

    @one_thread()
    def fit(
        self,
        real: TransitionLog,
        simulated: TransitionLog,
        fitter: Fitter,
        rewards: EpisodeRewards | None = None,
        *,
        on_top: bool = False,
    ) -> PhaseReport:
        """Fit f on the real log, and h on the simulated log; rewards are not used."""
        refuse_mismatch(real, simulated)
        f, h = self.forward, self.inverse
        d_real, d_sim = stack_log(real, self.stack), stack_log(simulated, self.stack)
        real_rows, rows = (fitter.split(data, self.stack) for data in (d_real, d_sim))
        if on_top:
            f.begin_as(_fit_simulated(f, d_sim, d_sim.asked, rows, fitter, "world"))
        own = fitter.further() if on_top else fitter
        forward = own.fit_changes(f, self.training_data(d_real)[0], real_rows)
        means = _expected(f, d_sim, rows, fitter)
        pairs = means if fitter.config.pairs == "smoothed" else d_sim.next_observation
        inverse = _fit_inverse(h, d_sim, pairs, rows, fitter)
        with torch.no_grad():
            predicted = _predicted(f, f.view.of(d_sim), d_sim.executed, self.draws)
        agreement, u_on_predictions = inverse_accuracy(
            h, d_sim, predicted, rows.held_out, self.draws
        )
        following = d_real.next_observation
        accuracy_on_real, u_on_real = inverse_accuracy(h, d_real, following, real_rows.held_out)
        accuracy_on_means, _ = inverse_accuracy(h, d_sim, means, rows.held_out)
        return PhaseReport(
            agents=self.stack.agents,
            forward=forward,
            inverse=inverse,
            mean_u_on_predictions=u_on_predictions,
            agreement=agreement,
            accuracy_on_real=accuracy_on_real,
            mean_u_on_real=u_on_real,
            accuracy_on_means=accuracy_on_means,
        )

    def training_data(self, data: StackedTransitions) -> tuple[Changes, Tensor]:
        """Return the outcomes of what was asked; every decision can be grounded."""
        seen = self.forward.view.of(data)
        return Changes("forward", seen, data.next_observation, data.asked), data.weight

    def ground(
        self,
        observations: Tensor,
        actions: NDArray[np.int64],
        permitted: NDArray[np.bool_] | None,
        earlier: Sequence[Moment],
    ) -> GroundedActions:
        """Ask f, then h, then the gate; models that see neighbours are asked several times.

        `joint` repeats the questions until the answers of all agents agree. Line numbers are those
        of Algorithm 1 (`ugat`).
        """
        asked = torch.from_numpy(actions)[:, None]

        def answer(phases: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
            running = torch.from_numpy(phases)[:, None]
            seen = self.forward.view.seen(observations, running, earlier)
            predicted = _predicted(self.forward, seen, asked, self.draws)  # line 11
            local = self.local.seen(observations, running)
            inverse = self.inverse.predict(local, predicted, self.draws)  # line 12
            return inverse.action[:, 0].numpy(), inverse.u[:, 0].numpy()

        if self.local.joint:
            current = self.stack.current_phase(observations)[:, 0].numpy()
            settled = together(answer, self.gate, self._in_turn, actions, current, permitted)
        else:
            settled = alone(answer, actions, permitted)
        grounded, u = settled.grounded, settled.u
        accepted = self.gate.decide(u, actions, grounded, settled.allowed)  # lines 13 and 15
        executed = np.where(accepted, grounded, actions)
        return GroundedActions(executed, grounded, u, accepted, np.zeros_like(u))


# --- fits of single models


@one_thread()
def fit_inverse(model: InverseModel, log: TransitionLog, fitter: Fitter) -> PhaseInverseReport:
    """Fit h alone on a log of the simulation, with the loss of the fitter's method.

    Args:
        model: Inverse model, changed in place; its head learns from all agents at once.
        log: Transitions with the outcomes of the *executed* actions.
        fitter: Settings, seed and device of the training.

    Raises:
        LogError: The log has other agents, or is too short to be split.
    """
    data = stack_log(log, model.stack)
    rows = fitter.split(data, model.stack)
    return _fit_inverse(model, data, data.next_observation, rows, fitter)


def _expected(
    forward: ForwardModel, data: StackedTransitions, rows: Split, fitter: Fitter
) -> Tensor:
    """Return the expected next features of simulated states and actions, ``(agents, n, outputs)``.

    They are predictions of a model of the simulation that knows what was executed, as h does.
    """
    model = _fit_simulated(forward, data, data.executed, rows, fitter, "simulated")
    with torch.no_grad():
        return model.predict(forward.view.of(data), data.executed)


def _fit_simulated(
    forward: ForwardModel,
    data: StackedTransitions,
    phases: Tensor,
    rows: Split,
    fitter: Fitter,
    name: str,
) -> ForwardModel:
    """Fit a model of the simulation with the shape and the inputs of f; return it.

    Args:
        forward: f.
        data: Transitions of the simulation.
        phases: Phases that the model knows, ``(agents, n)``: those asked for, or those executed.
        rows: Rows to train on and to hold out.
        fitter: Fits.
        name: Name of the random stream and of the progress bar.
    """
    generator = torch_generator(fitter.seed, name)
    model = ForwardModel(forward.stack, forward.config, generator, view=forward.view)
    training_data = Changes(name, forward.view.of(data), data.next_observation, phases)
    fitter.fit_changes(model, training_data, rows)
    return model


def _fit_inverse(
    model: InverseModel, data: StackedTransitions, outcome: Tensor, rows: Split, fitter: Fitter
) -> PhaseInverseReport:
    """Fit h to name the executed action from `outcome`, ``(agents, n, features or more)``."""
    inputs = model.inputs(model.view.of(data), outcome)
    off_data = OffData.around(inputs, rows.train, model.view)
    record = fitter.fit_answers(model, Questions(inputs, data.executed, off_data), rows)
    generator = torch_generator(fitter.seed, "inverse", "off data")
    return _inverse_report(model, data, rows.train, rows.held_out, record, generator)


# --- reports


@dataclass(frozen=True)
class PhaseInverseReport(InverseReport):
    """Held-out quality of h; arrays ``(agents,)``.

    Attributes:
        accuracy: Share of right answers.
        chance: 1 / number of phases.
        majority: Accuracy of the most frequent phase in training as the constant answer.
        beats_majority: Agents whose h is better than that by more than chance.
        mean_u: Mean uncertainty, in [0, 1].
        auroc: AUROC of u for wrong answers; `calibration` has it pooled over agents.
    """

    accuracy: Floats
    chance: Floats
    majority: Floats
    beats_majority: NDArray[np.bool_]
    mean_u: Floats
    auroc: Floats

    def as_dict(self, agents: Sequence[str]) -> dict[str, float]:
        """Return everything as flat numbers; arrays as their mean and one entry per agent."""
        numbers = self.training.as_dict("inverse")
        for name in ("accuracy", "chance", "majority", "mean_u", "auroc"):
            numbers |= flat(f"inverse/{name}", getattr(self, name), agents)
        return numbers | self.calibration.as_dict()


@dataclass(frozen=True)
class PhaseReport(FitReport):
    """Worth of f and h of phase grounding, alone and together.

    Attributes:
        inverse: Quality of h on held-out simulated transitions.
        agreement: Per agent, share of held-out simulated states in which h, given the prediction of
            f, answers with the action that f was given. Without a gap and with a perfect f it is
            the accuracy of h. 1 - agreement is the share of actions that grounding would change
            without a gate. `mean_u_on_predictions` is the mean u of these answers.
        accuracy_on_real: Per agent, share of held-out real transitions whose action h names. Its
            distance from the accuracy of h measures the gap without the errors of f.
        mean_u_on_real: Per agent, mean u of these answers.
        accuracy_on_means: Per agent, accuracy of h on held-out simulated states whose next features
            are predicted by a model of the simulation. Like those of f, they are means.
    """

    inverse: PhaseInverseReport
    agreement: Floats
    accuracy_on_real: Floats
    mean_u_on_real: Floats
    accuracy_on_means: Floats

    def doubts(self) -> Iterator[str]:
        """Yield sentences about problems; some of them are empty."""
        h, u = self.inverse, self.calibration
        yield from self.forward.doubts("f", self.agents)
        yield complaint(
            "h is not shown to be better than the most frequent phase",
            ~h.beats_majority,
            self.agents,
        )
        if h.uncertainty == "none":
            yield "without uncertainty u is 0, and the gate takes every grounded action"
            return
        if u.auroc < DISCRIMINATES:
            yield f"u does not tell wrong answers (AUROC {u.auroc:.2f})"
        if u.mean_u_off_data <= u.mean_u:
            yield (
                f"u does not rise off the data ({u.mean_u_off_data:.2f} against "
                f"{u.mean_u:.2f} on it)"
            )

    def trusted(self, least_accuracy: float = 0.0) -> NDArray[np.bool_]:
        """Return true for trusted agents, ``(agents,)`` bool, for `Gate.trust`.

        An agent is trusted if f has learnt something there, the accuracy of h is above that of the
        most frequent phase by more than chance, and it is at least `least_accuracy`.
        """
        h = self.inverse
        return self.forward.learnt & h.beats_majority & (h.accuracy >= least_accuracy)

    def as_dict(self) -> dict[str, float]:
        """Return flat numbers; arrays as their mean over agents and as one entry per agent."""
        numbers = self.forward.as_dict("forward", self.agents) | self.inverse.as_dict(self.agents)
        for name in (
            "agreement",
            "mean_u_on_predictions",
            "accuracy_on_real",
            "mean_u_on_real",
            "accuracy_on_means",
        ):
            numbers |= flat(name, getattr(self, name), self.agents)
        return numbers


@torch.no_grad()
def _inverse_report(
    model: InverseModel,
    data: StackedTransitions,
    train: Tensor,
    held_out: Tensor,
    training: TrainingRecord,
    generator: torch.Generator,
) -> PhaseInverseReport:
    """Measure accuracy of h and calibration of its u on the held-out rows."""
    inputs = model.inputs(model.view.of(data), data.next_observation)
    answer = model.answer(inputs)
    missed = answer.action != data.executed
    kept, wrong, u = held_out.bool().numpy(), missed.numpy(), answer.u.numpy()
    drawn = OffData.around(inputs, train, model.view).draw(
        int(held_out.sum(1).max()), generator, state_share=1.0
    )
    counts = torch.zeros(train.shape[0], model.stack.actions)
    counts.scatter_add_(1, data.executed, train)
    usual = counts.argmax(1)[:, None]
    right_of_usual = data.executed == usual
    majority = (right_of_usual * held_out).sum(1) / held_out.sum(1)
    rows = range(len(kept))
    return PhaseInverseReport(
        training=training,
        accuracy=np.array([1.0 - wrong[i][kept[i]].mean() for i in rows]),
        chance=1.0 / np.array(model.stack.phases, float),
        majority=majority.double().numpy(),
        beats_majority=better_than_chance((~missed).double() - right_of_usual.double(), held_out),
        mean_u=np.array([u[i][kept[i]].mean() for i in rows], float),
        auroc=np.array([auroc(u[i][kept[i]], wrong[i][kept[i]]) for i in rows]),
        calibration=UncertaintyQuality.of(answer, missed, held_out.bool(), model.answer(drawn)),
        uncertainty=model.method.name,
    )


def _predicted(model: ForwardModel, seen: Tensor, actions: Tensor, draws: int) -> Tensor:
    """Return the mean prediction of f, or with more than one draw those of all its networks."""
    return model.predict(seen, actions) if draws == 1 else model.predict_each(seen, actions)


@torch.no_grad()
def inverse_accuracy(
    inverse: InverseModel,
    data: StackedTransitions,
    next_features: Tensor,
    held_out: Tensor,
    draws: int = 1,
) -> tuple[Floats, Floats]:
    """Return accuracy and mean u, per agent, of h given `next_features`.

    Args:
        inverse: Fitted h.
        data: States, and the executed actions that h should name.
        next_features: ``(agents, draws * n, features or more)``, recorded or predicted.
        held_out: ``(agents, n)`` weights of the rows.
        draws: Number of draws of each row's next features.
    """
    answer = inverse.predict(inverse.view.of(data), next_features, draws)
    share = held_out.double() / held_out.double().sum(1, keepdim=True)
    agreement = ((answer.action == data.executed) * share).sum(1)
    return agreement.numpy(), (answer.u * share).sum(1).numpy()
