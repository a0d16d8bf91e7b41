"""What a fit of f and h was worth, measured on episodes that it did not see."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ugat_marl.grounding.arrays import Floats
from ugat_marl.grounding.calibration import (
    auroc,
    expected_calibration_error,
    rate_by_quantile,
    risk_by_coverage,
    spearman,
)
from ugat_marl.grounding.forward import ForwardModel
from ugat_marl.grounding.inverse import InverseModel
from ugat_marl.grounding.off_data import OffData
from ugat_marl.grounding.stacked import StackedTransitions
from ugat_marl.grounding.uncertainty import InversePrediction, MethodName

QUANTILES = 5
DISCRIMINATES = 0.55
"""AUROC below which u is called uninformative in the warnings."""


@dataclass(frozen=True)
class TrainingRecord:
    """How a training went.

    Attributes:
        epochs: Epochs run before held-out loss stopped falling.
        train_loss: Mean loss of the last epoch, over agents.
        held_out_loss: Mean held-out loss of the weights that were kept.
        split: "episodes", or "steps" where the log has only one episode.
        train_rows: Rows trained on, over all agents.
        held_out_rows: Rows held out, over all agents.
    """

    epochs: int
    train_loss: float
    held_out_loss: float
    split: str
    train_rows: int
    held_out_rows: int

    def as_dict(self, prefix: str) -> dict[str, float]:
        """Epochs and losses, as flat numbers."""
        return {
            f"{prefix}/epochs": float(self.epochs),
            f"{prefix}/train_loss": self.train_loss,
            f"{prefix}/held_out_loss": self.held_out_loss,
        }


def entries(name: str, values: Floats, agents: Sequence[str]) -> dict[str, float]:
    """An array over agents as flat numbers: its mean, and one entry per agent."""
    known = values[~np.isnan(values)]
    numbers = {name: float(known.mean()) if len(known) else float("nan")}
    own = zip(agents, values, strict=True)
    return numbers | {f"{name}/{agent}": float(value) for agent, value in own}


def said_of(complaint: str, where: NDArray[np.bool_], agents: Sequence[str]) -> str:
    """A sentence about the agents that `where`, ``(agents,)``, marks; empty if it marks none."""
    names = [agent for agent, hit in zip(agents, where, strict=True) if hit]
    shown = ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
    return f"{complaint} at {len(names)} of {len(agents)} ({shown})" if names else ""


@dataclass(frozen=True)
class ForwardReport:
    """Held-out error of f, per agent: root mean squares in the unit of the features.

    Attributes:
        training: How the training went.
        error: Of f.
        no_change: Of predicting that nothing changes.
        mean_outcome: Of predicting the mean of what follows, whatever the state.
    """

    training: TrainingRecord
    error: Floats
    no_change: Floats
    mean_outcome: Floats

    @property
    def ratio(self) -> Floats:
        """Error over the error of no change, per agent: below 1, f has learnt something."""
        return self.error / np.maximum(self.no_change, 1e-12)

    @property
    def learnt(self) -> NDArray[np.bool_]:
        """Agents whose f beats both: without the second, it does so on rows that are mixed up."""
        return (self.ratio < 1.0) & (self.error < self.mean_outcome)

    def doubts(self, model: str, agents: Sequence[str]) -> list[str]:
        """What is wrong with it; sentences, some of them empty."""
        poor = self.ratio >= 1.0
        mixed = ~self.learnt & ~poor
        return [
            said_of(f"{model} is no better than predicting no change", poor, agents),
            said_of(f"{model} is no better than one answer for every state", mixed, agents),
        ]


@dataclass(frozen=True)
class Calibration:
    """Whether u tells right from wrong, and known from unknown, over all agents together.

    Attributes:
        spearman: Rank correlation of u with being wrong.
        auroc: Probability that u is higher for a wrong answer than for a right one.
        error_by_quantile: Error rate in fifths of rising u.
        risk_by_coverage: Error rate of the fifth with the lowest u, of two fifths, ..., of all.
        ece: Expected calibration error of the probability of the answer.
        mean_u: Mean u on held-out data.
        mean_u_off_data: Mean u on states and changes drawn around, not from, the data.
        auroc_off_data: Probability that u is higher off the data than on it.
    """

    spearman: float
    auroc: float
    error_by_quantile: tuple[float, ...]
    risk_by_coverage: tuple[float, ...]
    ece: float
    mean_u: float
    mean_u_off_data: float
    auroc_off_data: float

    @classmethod
    def of(
        cls, answer: InversePrediction, wrong: Tensor, held_out: Tensor, off: InversePrediction
    ) -> Calibration:
        """Of answers, of which some are wrong, on held-out rows (bool), and off the data."""
        on_u, on_wrong = answer.u[held_out].numpy(), wrong[held_out].numpy()
        off_u = off.u.flatten().numpy()
        both = np.concatenate([on_u, off_u])
        likeliest = answer.probability.amax(-1)[held_out].numpy()
        return cls(
            spearman=spearman(on_u, on_wrong),
            auroc=auroc(on_u, on_wrong),
            error_by_quantile=rate_by_quantile(on_u, on_wrong, QUANTILES),
            risk_by_coverage=risk_by_coverage(on_u, on_wrong, QUANTILES),
            ece=expected_calibration_error(likeliest, ~on_wrong),
            mean_u=float(on_u.mean()) if len(on_u) else math.nan,
            mean_u_off_data=float(off_u.mean()),
            auroc_off_data=auroc(both, np.arange(len(both)) >= len(on_u)),
        )

    def as_dict(self) -> dict[str, float]:
        """Flat numbers, one entry per fifth."""
        numbers: dict[str, float] = {}
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, tuple):
                for i, rate in enumerate(value):
                    numbers[f"calibration/{entry.name}/{i}"] = rate
            else:
                numbers[f"calibration/{entry.name}"] = value
        return numbers


@dataclass(frozen=True)
class InverseReport:
    """Held-out quality of h, per agent where an array.

    Attributes:
        training: How the training went.
        accuracy: Share of right answers.
        chance: 1 / number of phases.
        majority: Accuracy of always answering the phase most frequent in training.
        mean_u: Mean uncertainty.
        auroc: u against being wrong, agent by agent.
        calibration: The same and more, pooled.
        uncertainty: Where u came from.
    """

    training: TrainingRecord
    accuracy: Floats
    chance: Floats
    majority: Floats
    mean_u: Floats
    auroc: Floats
    calibration: Calibration
    uncertainty: MethodName


@dataclass(frozen=True)
class FitReport:
    """What f and h are worth, alone and together.

    Attributes:
        agents: Names, the order of all arrays.
        forward: f, on held-out real transitions.
        inverse: h, on held-out simulated transitions.
        agreement: Per agent, share of held-out simulated states in which h, fed by f, answers the
            action that f was given. Without a gap and with a perfect f this is h's accuracy; what
            is missing is the gap and the errors of both models. It says how much grounding would
            change if every grounded action were taken.
        mean_u_on_predictions: Per agent, mean u of these answers: what the gate will see.
        accuracy_on_real: Per agent, share of held-out real transitions whose action h names. What
            it lacks of h's own accuracy is the gap itself, in actions, without f's part in it.
        mean_u_on_real: Per agent, mean u of these answers: how foreign the real world is to h.
        accuracy_on_means: Per agent, accuracy of h on held-out simulated states and what a model of
            the simulation expects of their actions: means, such as f predicts.
    """

    agents: tuple[str, ...]
    forward: ForwardReport
    inverse: InverseReport
    agreement: Floats
    mean_u_on_predictions: Floats
    accuracy_on_real: Floats
    mean_u_on_real: Floats
    accuracy_on_means: Floats

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons not to obey the grounded actions yet; empty if there are none."""
        h, calibration = self.inverse, self.inverse.calibration
        found = [
            *self.forward.doubts("f", self.agents),
            said_of(
                "h is no better than the most frequent phase", h.accuracy <= h.majority, self.agents
            ),
        ]
        if h.uncertainty == "none":
            found.append("without uncertainty u is 0, and the gate takes every grounded action")
            return tuple(sentence for sentence in found if sentence)
        if calibration.auroc < DISCRIMINATES:
            found.append(f"u does not tell wrong answers (AUROC {calibration.auroc:.2f})")
        if calibration.mean_u_off_data <= calibration.mean_u:
            found.append(
                f"u does not rise off the data ({calibration.mean_u_off_data:.2f} against "
                f"{calibration.mean_u:.2f} on it)"
            )
        return tuple(sentence for sentence in found if sentence)

    @property
    def expected_u(self) -> Floats:
        """Mean u to expect at the gate, per agent; of all agents where one has no held-out rows."""
        return with_the_others(self.mean_u_on_predictions)

    def trusted(self, least_accuracy: float = 0.0) -> NDArray[np.bool_]:
        """Agents whose models may be obeyed, for `Gate.trust`; ``(agents,)``.

        f has learnt something, and h beats both the most frequent phase and `least_accuracy`.
        """
        h = self.inverse
        better = self.forward.learnt & (h.accuracy > h.majority)
        return better & (h.accuracy >= least_accuracy)

    def as_dict(self) -> dict[str, float]:
        """Flat numbers; arrays as their mean over agents and as one entry per agent."""
        numbers: dict[str, float] = {}
        for prefix, part in (("forward", self.forward), ("inverse", self.inverse)):
            numbers |= part.training.as_dict(prefix)
            for entry in fields(part):
                value = getattr(part, entry.name)
                if isinstance(value, np.ndarray):
                    numbers |= entries(f"{prefix}/{entry.name}", value, self.agents)
        numbers |= entries("forward/ratio", self.forward.ratio, self.agents)
        for name in (
            "agreement",
            "mean_u_on_predictions",
            "accuracy_on_real",
            "mean_u_on_real",
            "accuracy_on_means",
        ):
            numbers |= entries(name, getattr(self, name), self.agents)
        return numbers | self.inverse.calibration.as_dict()


def with_the_others(u: Floats) -> Floats:
    """Mean u per agent; NaN replaced by the mean of the other agents, of all by 1, the most."""
    known = u[~np.isnan(u)]
    return np.where(np.isnan(u), known.mean() if known.size else 1.0, u)


@torch.no_grad()
def forward_report(
    model: ForwardModel,
    predicted: Tensor,
    happened: Tensor,
    off_mean: Tensor,
    held_out: Tensor,
    training: TrainingRecord,
) -> ForwardReport:
    """Errors of predicted changes on held-out rows; `held_out` weighs ``(agents, n)``.

    `off_mean` is by how much the features that followed differ from their mean in training.
    """
    outputs = model.valid_outputs.sum(-1)[:, 0].double()
    share = (held_out / held_out.sum(1, keepdim=True)).double()

    def root_mean_square(error: Tensor) -> Floats:
        return ((error.double() ** 2).sum(-1) * share).sum(1).div(outputs).sqrt().numpy()

    errors = (predicted - happened, happened, off_mean)
    return ForwardReport(training, *map(root_mean_square, errors))


@torch.no_grad()
def inverse_report(
    model: InverseModel,
    data: StackedTransitions,
    train: Tensor,
    held_out: Tensor,
    training: TrainingRecord,
    generator: torch.Generator,
) -> InverseReport:
    """Accuracy of h and calibration of its u on the held-out rows."""
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
    majority = ((data.executed == usual) * held_out).sum(1) / held_out.sum(1)
    rows = range(len(kept))
    return InverseReport(
        training=training,
        accuracy=np.array([1.0 - wrong[i][kept[i]].mean() for i in rows]),
        chance=1.0 / np.array(model.stack.phases, float),
        majority=majority.double().numpy(),
        mean_u=np.array([u[i][kept[i]].mean() for i in rows], float),
        auroc=np.array([auroc(u[i][kept[i]], wrong[i][kept[i]]) for i in rows]),
        calibration=Calibration.of(answer, missed, held_out.bool(), model.answer(drawn)),
        uncertainty=model.method.name,
    )


@torch.no_grad()
def on_predictions(
    forward: ForwardModel, inverse: InverseModel, data: StackedTransitions, held_out: Tensor
) -> tuple[Floats, Floats]:
    """Per agent, agreement and mean u of h fed by f in held-out simulated states."""
    predicted = forward.predict(forward.view.of(data), data.executed)
    return answers_to(inverse, data, predicted, held_out)


@torch.no_grad()
def on_transitions(
    inverse: InverseModel, data: StackedTransitions, held_out: Tensor
) -> tuple[Floats, Floats]:
    """Per agent, accuracy and mean u of h on transitions as they happened, real ones say."""
    return answers_to(inverse, data, data.next_observation, held_out)


@torch.no_grad()
def answers_to(
    inverse: InverseModel, data: StackedTransitions, next_features: Tensor, held_out: Tensor
) -> tuple[Floats, Floats]:
    """Per agent, accuracy and mean u of h asked what led to `next_features`."""
    answer = inverse.predict(inverse.view.of(data), next_features)
    share = held_out.double() / held_out.double().sum(1, keepdim=True)
    agreement = ((answer.action == data.executed) * share).sum(1)
    return agreement.numpy(), (answer.u * share).sum(1).numpy()
