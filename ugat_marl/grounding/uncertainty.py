"""Methods for the uncertainty of h: each has a loss for training, and answers with a u.

The network of a method has one encoder per intersection and one head shared by all, or a head per
intersection. The methods differ in how they read its outputs. u is always in [0, 1]. With u = 1 all
phases of the intersection have the same probability.

- ``edl``: u = K / S of a Dirichlet distribution (Sensoy, Kaplan, Kandemir, "Evidential Deep
  Learning to Quantify Classification Uncertainty", NeurIPS 2018). Near 0 there is much evidence,
  which may be for several actions.
- ``dropout`` (Gal, Hron, Kendall, "Concrete Dropout", NeurIPS 2017) and ``ensemble``
  (Lakshminarayanan, Pritzel, Blundell, "Simple and Scalable Predictive Uncertainty Estimation using
  Deep Ensembles", NeurIPS 2017): the predictive entropy of the mean over networks, in units of its
  maximum log K (`normalised_entropy`). With u = 0 one action is certain. The mutual information of
  network and action would not do: it is low where several actions lead to the same next state and
  all networks agree on equal probabilities. The evidence of ``edl`` is low in such states, too.
- ``none``: u = 0.

Rows may have different numbers of classes. A mask marks the classes of a row, and K is their
number. Shapes are ``(..., K)`` for logits, concentrations and masks (broadcastable), ``(...)`` for
losses and u.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from ugat_marl.errors import OptionError
from ugat_marl.grounding.networks import member_rows
from ugat_marl.policies import BatchedLinear, BatchedMLP

MOST_NETWORKS = 100
"""Largest number of members or passes; larger ones are taken for a mistake."""

MethodName = Literal["edl", "dropout", "ensemble", "none"]
UNCERTAINTY_METHODS: tuple[MethodName, ...] = ("edl", "dropout", "ensemble", "none")


@dataclass(frozen=True)
class Method:
    """Method of uncertainty of h, and the number of its networks.

    Attributes:
        name: "edl", "dropout", "ensemble" or "none".
        members: Number of networks of an ensemble.
        passes: Number of thinned networks that dropout averages over.
    """

    name: MethodName = "edl"
    members: int = 5
    passes: int = 20

    def __post_init__(self) -> None:
        if self.name not in UNCERTAINTY_METHODS:
            raise OptionError(
                f"uncertainty is {self.name!r}; allowed: {', '.join(UNCERTAINTY_METHODS)}"
            )
        for name in ("members", "passes"):
            value = getattr(self, name)
            if not isinstance(value, int) or not 1 <= value <= MOST_NETWORKS:
                raise OptionError(f"{name} is {value}; allowed: whole numbers 1 to {MOST_NETWORKS}")


@dataclass(frozen=True)
class InversePrediction:
    """Answers of h; tensors with the leading axes ``(agents, batch)``.

    Attributes:
        action: int64, the likeliest action.
        probability: ``(agents, batch, actions)`` expected probabilities, 0 where masked.
        u: Uncertainty in [0, 1].
    """

    action: Tensor
    probability: Tensor
    u: Tensor

    @classmethod
    def joined(cls, parts: Sequence[InversePrediction]) -> InversePrediction:
        """Return the answers to consecutive parts of a batch as one, joined along the rows."""
        return cls(
            torch.cat([part.action for part in parts], 1),
            torch.cat([part.probability for part in parts], 1),
            torch.cat([part.u for part in parts], 1),
        )


@dataclass(frozen=True)
class LossArguments:
    """Arguments of a loss beside the rows; every method takes what it needs.

    Attributes:
        held_out: True for held-out rows, whose loss only ranks weights.
        generator: Source of all draws; on the CPU for rows on any device.
        rows: ``(agents,)`` number of training rows of each agent.
        share: Current share of the final weights, 0 to 1; it rises while h is annealed.
        kl_weight: Final weight of the divergence of misleading evidence.
        off_data_weight: Final weight of certainty on invented inputs.
        invent: Function from a number of rows per agent to standardised inputs off the data.
    """

    held_out: bool
    generator: torch.Generator
    rows: Tensor
    share: float
    kl_weight: float
    off_data_weight: float
    invent: Callable[[int], Tensor]


@dataclass(frozen=True)
class NetShape:
    """Sizes of a network.

    Attributes:
        fan_in: Number of inputs of each agent.
        hidden: Sizes of the hidden layers of an encoder.
        embedding: Size of the output of an encoder, which the head reads.
        valid_actions: ``(agents, 1, actions)`` bool, the phases each agent has.
        own_heads: True for a head per agent, False for one that all share.
    """

    fan_in: Sequence[int]
    hidden: Sequence[int]
    embedding: int
    valid_actions: Tensor
    own_heads: bool = False


class AnswerNet(nn.Module, abc.ABC):
    """Base of the methods: the network of h, its loss, and its answers.

    Args:
        shape: Sizes of the network.
        generator: Source of the initial weights.
        members: Number of networks side by side. They share no weight. Every parameter holds them
            in order, so ``parameter.view(members, -1)`` has one row for each.
    """

    valid_actions: Tensor

    def __init__(self, shape: NetShape, generator: torch.Generator, members: int = 1) -> None:
        super().__init__()
        self.members = members
        fan_in = [*shape.fan_in] * members
        self.encoders = BatchedMLP(fan_in, shape.hidden, shape.embedding, generator)
        self.own_heads = shape.own_heads
        classes = shape.valid_actions.shape[-1]
        self.head: nn.Linear | BatchedLinear
        if shape.own_heads:
            self.head = BatchedLinear([shape.embedding] * len(fan_in), classes, generator)
        else:
            self.head = _linear(shape.embedding, members * classes, generator)
        self.register_buffer("valid_actions", shape.valid_actions, persistent=False)

    @abc.abstractmethod
    def outputs(self, inputs: Tensor, arguments: LossArguments) -> Tensor:
        """Return the tensor that `row_loss` and `certainty` read, ``(agents, ..., rows, K)``."""

    @abc.abstractmethod
    def row_loss(self, outputs: Tensor, target: Tensor, arguments: LossArguments) -> Tensor:
        """Return the loss of every row, in the shape of `target`."""

    @abc.abstractmethod
    def certainty(self, outputs: Tensor) -> Tensor:
        """Return the certainty about rows off the data, in nats; 0 for equal probabilities.

        The shape is ``(agents, count)`` or ``(agents, members, count)``.
        """

    def loss(self, inputs: Tensor, target: Tensor, arguments: LossArguments) -> Tensor:
        """Return the loss of every row, in the shape of `target`, with the certainty off the data.

            loss = row loss + off_data_weight * share * mean certainty on invented inputs

        Args:
            inputs: ``(agents, batch, width)`` standardised, or ``(agents, members, batch, width)``
                if every member has its own rows.
            target: ``(agents, batch)`` or ``(agents, members, batch)`` int64, the true actions.
            arguments: Further arguments of the loss.
        """
        if not arguments.off_data_weight:
            return self.row_loss(self.outputs(inputs, arguments), target, arguments)
        rows = target.shape[-1]
        invented = arguments.invent(rows // 2 + 1)
        if inputs.dim() > invented.dim():
            invented = invented[:, None].expand(-1, self.members, -1, -1)
        # One pass for both, because two would read all weights and sum their gradients twice.
        outputs = self.outputs(torch.cat([inputs, invented], -2), arguments)
        error = self.row_loss(outputs[..., :rows, :], target, arguments)
        certain = self.certainty(outputs[..., rows:, :])
        return error + arguments.off_data_weight * arguments.share * certain.mean(-1, keepdim=True)

    @abc.abstractmethod
    def answer(self, inputs: Tensor) -> InversePrediction:
        """Answer ``(agents, batch, width)`` standardised inputs, row by row."""

    def mixed(self, answers: InversePrediction) -> InversePrediction:
        """Return one answer to inputs that are themselves uncertain.

        Its probabilities are the mean over the draws, and u is their normalised entropy. It rises
        if the draws lead to different answers, even if each of them is certain.

        Args:
            answers: Answers to the draws of each input, ``(draws, agents, batch)``.
        """
        return prediction(answers.probability.mean(0), self.valid_actions)


def _linear(n_in: int, n_out: int, generator: torch.Generator) -> nn.Linear:
    """Return an affine map with initial weights from `generator`."""
    layer = nn.Linear(n_in, n_out)
    bound = n_in**-0.5
    with torch.no_grad():  # nn.Linear drew from the global generator
        for part in layer.parameters():
            part.copy_((torch.rand(part.shape, generator=generator) * 2 - 1) * bound)
    return layer


def log_probability(logits: Tensor, mask: Tensor) -> Tensor:
    """Return the log of the softmax over the classes of a row; minus infinity for others."""
    return logits.masked_fill(~mask, -math.inf).log_softmax(-1)


def negative_log_likelihood(logits: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Return the cross-entropy of every row in nats, ``(...)`` for logits ``(..., actions)``."""
    return -log_probability(logits, mask).gather(-1, target[..., None])[..., 0]


def divergence_from_even(logits: Tensor, mask: Tensor) -> Tensor:
    """Return the KL divergence between equal probabilities and the softmax p of a row, in nats.

        KL = -(1 / K) sum_k log p_k - log K

    Its gradient is that of the cross-entropy with equal probabilities. Hendrycks, Mazeika and
    Dietterich, "Deep Anomaly Detection with Outlier Exposure", ICLR 2019, train with it on
    outliers.
    """
    log_p, count = log_probability(logits, mask).masked_fill(~mask, 0.0), mask.sum(-1)
    return -log_p.sum(-1) / count - count.log()


def normalised_entropy(probability: Tensor, mask: Tensor) -> Tensor:
    """Return the entropy over its maximum log K, in [0, 1]; K is a row's number of classes.

        u = -sum_k p_k log p_k / log K

    For the mean over networks this is the predictive entropy (Gal, "Uncertainty in Deep Learning",
    2016, section 3.3; Lakshminarayanan et al., NeurIPS 2017, section 3.5). It contains the noise of
    the data and the disagreement of the networks. A single class has entropy 0.
    """
    most = mask.sum(-1).clamp(min=2).log()
    return (torch.special.entr(probability).sum(-1) / most).clamp(0.0, 1.0)


def prediction(probability: Tensor, mask: Tensor) -> InversePrediction:
    """Return the likeliest action, its probabilities, and their normalised entropy as u."""
    u = normalised_entropy(probability, mask)
    return InversePrediction(probability.argmax(-1), probability, u)


# --- edl: evidence for every action


def concentration(logits: Tensor, mask: Tensor) -> Tensor:
    """Return concentrations ``softplus(logits) + 1``; 0 where a row has no such class."""
    return (functional.softplus(logits) + 1.0) * mask


def expected_probability(alpha: Tensor) -> Tensor:
    """Return the mean of the Dirichlet; 0 for classes a row does not have."""
    return alpha / alpha.sum(-1, keepdim=True)


def uncertainty(alpha: Tensor, mask: Tensor) -> Tensor:
    """Return u = K / S, in (0, 1]: 1 without any evidence. K is the row's number of classes."""
    return mask.sum(-1) / alpha.sum(-1)


def expected_squared_error(alpha: Tensor, target: Tensor) -> Tensor:
    """Return E[sum_j (y_j - p_j)^2] for p from the Dirichlet (Sensoy et al., equation 5).

    Args:
        alpha: ``(..., K)`` concentrations, 0 where masked.
        target: ``(...)`` int64, the true class.
    """
    total = alpha.sum(-1, keepdim=True)
    mean = alpha / total
    truth = functional.one_hot(target, alpha.shape[-1])
    return ((truth - mean) ** 2 + mean * (1.0 - mean) / (total + 1.0)).sum(-1)


def divergence_from_uniform(alpha: Tensor, mask: Tensor) -> Tensor:
    """Return KL of Dirichlet(alpha) from the uniform Dirichlet over a row's classes, in nats."""
    return _Divergence.apply(alpha, mask)  # pyright: ignore[reportReturnType]


class _Divergence(torch.autograd.Function):
    """Divergence from uniform with its derivative in closed form; S is the sum of all alpha_k.

    KL = log Gamma(S) - log Gamma(K) - sum_k log Gamma(alpha_k)
         + sum_k (alpha_k - 1) (digamma(alpha_k) - digamma(S))

    dKL/d alpha_k = (alpha_k - 1) trigamma(alpha_k) - (S - K) trigamma(S)
    """

    @staticmethod
    def forward(ctx: Any, alpha: Tensor, mask: Tensor) -> Tensor:
        masked_alpha = torch.where(
            mask, alpha, 1.0
        )  # a concentration of 1 contributes nothing below
        total = (masked_alpha * mask).sum(-1)
        count = mask.sum(-1).to(alpha.dtype)
        ctx.save_for_backward(masked_alpha, mask, total, count)
        pull = (
            (masked_alpha - 1.0) * (torch.digamma(masked_alpha) - torch.digamma(total)[..., None])
        ).sum(-1)
        return torch.lgamma(total) - torch.lgamma(count) - torch.lgamma(masked_alpha).sum(-1) + pull

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        masked_alpha, mask, total, count = ctx.saved_tensors
        shared = (total - count) * torch.polygamma(1, total)
        slope = (masked_alpha - 1.0) * torch.polygamma(1, masked_alpha) - shared[..., None]
        return gradients[0][..., None] * slope * mask, None


def mixed_concentration(probability: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and S of the Dirichlet with mean and variance of a mixture of Dirichlets.

        m = mean over draws of m_d
        v = sum_k [mean of m_dk (1 - m_dk) / (S_d + 1) + variance of m_dk]
        S = sum_k m_k (1 - m_k) / v - 1

    Draws that are all equal keep their S. Draws that are certain and contradict each other have
    S = 0: nothing is known.

    Args:
        probability: ``(draws, ..., K)`` means m_d.
        total: ``(draws, ...)`` sums S_d of concentrations.

    Returns:
        m, ``(..., K)``, and S, ``(...)``; NaN where one class is certain.
    """
    mean = probability.mean(0)
    own = (probability * (1.0 - probability)).sum(-1) / (total + 1.0)
    between = ((probability - mean) ** 2).sum(-1)
    variance = (own + between).mean(0)
    return mean, (mean * (1.0 - mean)).sum(-1) / variance - 1.0


def misleading(alpha: Tensor, target: Tensor) -> Tensor:
    """Return `alpha` without the evidence for the true class (Sensoy et al., section 4)."""
    truth = functional.one_hot(target, alpha.shape[-1])
    return truth + (1 - truth) * alpha


def evidential_loss(alpha: Tensor, target: Tensor, mask: Tensor, kl_weight: float) -> Tensor:
    """Return expected squared error plus weighted divergence of misleading evidence, per row."""
    error = expected_squared_error(alpha, target)
    if kl_weight == 0.0:
        return error
    return error + kl_weight * divergence_from_uniform(misleading(alpha, target), mask)


def annealing(epoch: int, epochs: int = 10) -> float:
    """Return the weight of the divergence in epoch 0, 1, ...: min(1, epoch / epochs)."""
    return 1.0 if epochs <= 0 else min(1.0, epoch / epochs)


class EvidentialNet(AnswerNet):
    """One network whose outputs are evidence; u = K / S.

    The outputs give the concentrations of a Dirichlet distribution over class probabilities. Its
    mean is the prediction; S is the sum of its concentrations.
    """

    def forward(self, inputs: Tensor) -> Tensor:
        """Return concentrations ``(agents, batch, actions)`` for standardised inputs."""
        embedding = torch.relu(self.encoders(inputs))
        return concentration(self.head(embedding), self.valid_actions)

    def outputs(self, inputs: Tensor, arguments: LossArguments) -> Tensor:
        """Return the concentrations."""
        return self(inputs)

    def row_loss(self, outputs: Tensor, target: Tensor, arguments: LossArguments) -> Tensor:
        """Return the evidential loss with the current weight of the divergence."""
        weight = arguments.kl_weight * arguments.share
        return evidential_loss(outputs, target, self.valid_actions, weight)

    def certainty(self, outputs: Tensor) -> Tensor:
        """Return the divergence from a Dirichlet without evidence."""
        return divergence_from_uniform(outputs, self.valid_actions)

    def answer(self, inputs: Tensor) -> InversePrediction:
        """Return the mean of the Dirichlet, and u."""
        alpha = self(inputs)
        return InversePrediction(
            action=alpha.argmax(-1),
            probability=expected_probability(alpha),
            u=uncertainty(alpha, self.valid_actions),
        )

    def mixed(self, answers: InversePrediction) -> InversePrediction:
        """Return the Dirichlet with mean and variance of the draws' mixture; u = K / S."""
        classes = self.valid_actions.sum(-1)
        mean, total = mixed_concentration(answers.probability, classes / answers.u)
        u = (classes / total.clamp(min=1e-6)).clamp(max=1.0)
        alone = answers.u.mean(0)  # with one class the variance is 0
        return InversePrediction(mean.argmax(-1), mean, torch.where(total.isnan(), alone, u))


# --- dropout: thinned networks

COIN_TEMPERATURE = 0.1
"""Temperature of the relaxed coin, as in the paper."""

START_RATE = 0.1
"""Dropout rate of a fresh network, as in the authors' code."""

RATE_SPEED = 10.0
"""Factor by which rates learn faster than weights, because a fit has only a few hundred updates."""

LENGTH_SCALE = 1e-2
"""Length scale l of the prior, by hand (the authors' notebooks have 1e-4); it allows weights of
about 1 / l."""

SMALLEST_RATE = 1e-6
"""Smallest distance of rates and draws from 0 and 1, where logarithms are infinite."""

ROWS_IN_DROPOUT = 256
"""Rows answered at once; this limits the memory of all passes."""


def thinned(inputs: Tensor, logit: Tensor, draw: Tensor) -> Tensor:
    """Return inputs with units left out at rate p, divided by 1 - p to keep the mean.

        inputs * (1 - sigmoid((logit p + logit draw) / COIN_TEMPERATURE)) / (1 - p)

    Args:
        inputs: Any shape; units on the last axis.
        logit: log p - log (1 - p), broadcastable.
        draw: Uniform numbers in [0, 1), broadcastable; a draw above 1 - p leaves a unit out.
    """
    dropped = torch.sigmoid((logit + torch.logit(draw, SMALLEST_RATE)) / COIN_TEMPERATURE)
    return inputs * (1.0 - dropped) / torch.sigmoid(-logit)


def divergence(weight: Tensor, logit: Tensor, units: Tensor | int) -> Tensor:
    """Return the divergence of a layer's posterior from the prior, in nats, up to a constant.

    The loss of Concrete Dropout is the negative log-likelihood per row plus this divergence over
    the number of rows. The prior is Gaussian with length scale l. For an affine map W of n inputs
    with rate p, and the entropy H of a coin, the divergence is

        l^2 (1 - p) |W|^2 / 2 - n H(p)

    With many data the rates fall; with few data H raises them.

    Args:
        weight: ``(..., inputs, outputs)``, 0 for missing inputs. `thinned` divides the layer's
            inputs by 1 - p, so the W of the formula is weight / (1 - p).
        logit: ``(...)`` log odds of the rate p.
        units: Number of inputs, ``(...)`` or the same for all.
    """
    p = torch.sigmoid(logit).clamp(SMALLEST_RATE, 1.0 - SMALLEST_RATE)
    entropy = torch.special.entr(p) + torch.special.entr(1.0 - p)
    size = weight.square().sum((-2, -1))
    return LENGTH_SCALE**2 / 2 * size / (1.0 - p) - units * entropy


class DropoutNet(AnswerNet):
    """One network, thinned before every affine map at a learned rate of that map.

    A network with random units left out is a draw from an approximate posterior over networks (Gal
    et al. 2017). The coin that leaves units out is relaxed to give its rate a gradient.

    Each intersection's encoder has its own rates. Answers average over `passes` thinned networks.
    These are drawn once, when the network is made, and are kept in checkpoints. So the same input
    always gets the same answer.

    Args:
        shape: Sizes of the network.
        generator: Source of the initial weights and of the thinned networks.
        passes: Number of thinned networks, T in the papers.
    """

    fan_in: Tensor
    own_inputs: Tensor

    def __init__(self, shape: NetShape, generator: torch.Generator, passes: int) -> None:
        super().__init__(shape, generator)
        agents, widest = len(shape.fan_in), max(shape.fan_in)
        widths = [widest, *shape.hidden, shape.embedding]
        owners = [agents] * (len(widths) - 1) + [agents if shape.own_heads else 1]
        start = math.log(START_RATE) - math.log(1.0 - START_RATE)
        self.slow_logits = nn.ParameterList(
            torch.full((n, 1, 1), start / RATE_SPEED) for n in owners
        )
        for k, (n, width) in enumerate(zip(owners, widths, strict=True)):
            draws = torch.rand(n, passes, 1, width, generator=generator)
            self.register_buffer(f"draws_{k}", draws)
        fan_in = torch.tensor([*shape.fan_in])
        self.register_buffer("fan_in", fan_in.float(), persistent=False)
        own_inputs = torch.arange(widest)[None, :, None] < fan_in[:, None, None]
        self.register_buffer("own_inputs", own_inputs, persistent=False)

    def row_loss(self, outputs: Tensor, target: Tensor, arguments: LossArguments) -> Tensor:
        """Return the cross-entropy of one thinned network per row, plus divergence / rows.

        The loss of held-out rows is the cross-entropy of the whole network alone.
        """
        likelihood = negative_log_likelihood(outputs, target, self.valid_actions)
        return likelihood if arguments.held_out else likelihood + self._divergence(arguments.rows)

    def certainty(self, outputs: Tensor) -> Tensor:
        """Return the divergence from equal probabilities, with one thinned network per row."""
        return divergence_from_even(outputs, self.valid_actions)

    def answer(self, inputs: Tensor) -> InversePrediction:
        """Return the mean of the thinned networks' probabilities; u is its entropy."""
        means = [self._mean(rows) for rows in inputs.split(ROWS_IN_DROPOUT, dim=1)]
        return prediction(torch.cat(means, 1), self.valid_actions)

    def _logits(self) -> list[Tensor]:
        """Return the log odds of every rate, ``(agents, 1, 1)``; ``(1, 1, 1)`` if shared."""
        return [RATE_SPEED * logit for logit in self.slow_logits]

    def outputs(self, inputs: Tensor, arguments: LossArguments) -> Tensor:
        """Return logits ``(agents, batch, actions)``, each row from a newly thinned network."""
        if arguments.held_out:
            return self.head(torch.relu(self.encoders(inputs)))
        x = inputs
        for k, (layer, logit) in enumerate(zip(self._maps(), self._logits(), strict=True)):
            draw = torch.rand(x.shape, generator=arguments.generator).to(x.device)
            x = layer(thinned(x if k == 0 else torch.relu(x), logit, draw))
        return x

    def _maps(self) -> list[BatchedLinear | nn.Linear]:
        """Return the affine maps in order, the head last; a ReLU follows each but the head."""
        return [*(m for m in self.encoders.layers if isinstance(m, BatchedLinear)), self.head]

    def _mean(self, inputs: Tensor) -> Tensor:
        agents, rows, _ = inputs.shape
        x = inputs[:, None]  # a second axis for the passes
        for k, (layer, logit) in enumerate(zip(self._maps(), self._logits(), strict=True)):
            draws = self.get_buffer(f"draws_{k}")
            x = thinned(x if k == 0 else torch.relu(x), logit[..., None], draws)
            passes = x.shape[1]
            x = layer(x.reshape(agents, passes * rows, -1)).view(agents, passes, rows, -1)
        return log_probability(x, self.valid_actions[:, None]).exp().mean(1)

    def _divergence(self, rows: Tensor) -> Tensor:
        """Return the divergence per row, ``(agents, 1)``; all rows share that of a shared head."""
        maps = [layer.weight for layer in self._maps()]
        logits = [logit.flatten() for logit in self._logits()]
        own = len(maps) if self.own_heads else len(maps) - 1
        total = divergence(maps[0] * self.own_inputs, logits[0], self.fan_in)
        for weight, logit in zip(maps[1:own], logits[1:own], strict=True):
            total = total + divergence(weight, logit, weight.shape[-2])
        if self.own_heads:
            return (total / rows)[:, None]
        head = maps[-1]
        shared = divergence(head[None], logits[-1], head.shape[-1])
        return (total / rows + shared / rows.sum())[:, None]


# --- ensemble, and none: networks side by side


class EnsembleNet(AnswerNet):
    """Networks side by side in one batched product; u is the entropy of their mean.

    The networks differ in their initial weights and in the order of their data. They agree where
    there are data and need not agree elsewhere (Lakshminarayanan et al. 2017). Every member is
    trained on all rows, because bootstrap samples were harmful in the paper (section 2.4). Its
    adversarial training is left out, because the inputs here have no common scale.
    """

    def logits(self, inputs: Tensor) -> Tensor:
        """Return logits ``(agents, members, batch, actions)`` for inputs of `loss` or `answer`."""
        members, agents, rows = self.members, len(inputs), inputs.shape[-2]
        encoded = torch.relu(self.encoders(member_rows(inputs, members)))
        if self.own_heads:
            return self.head(encoded).view(members, agents, rows, -1).transpose(0, 1)
        embedding = encoded.view(members, agents * rows, -1)
        weight = self.head.weight.view(members, -1, embedding.shape[-1])
        bias = self.head.bias.view(members, 1, -1)
        out = torch.baddbmm(bias, embedding, weight.transpose(1, 2))
        return out.view(members, agents, rows, -1).transpose(0, 1)

    def outputs(self, inputs: Tensor, arguments: LossArguments) -> Tensor:
        """Return the logits."""
        return self.logits(inputs)

    def row_loss(self, outputs: Tensor, target: Tensor, arguments: LossArguments) -> Tensor:
        """Return the cross-entropy, member by member."""
        member_target = target.reshape(outputs.shape[:3])
        return negative_log_likelihood(outputs, member_target, self.valid_actions[:, None]).view(
            target.shape
        )

    def certainty(self, outputs: Tensor) -> Tensor:
        """Return the divergence from equal probabilities, member by member."""
        certain = divergence_from_even(outputs, self.valid_actions[:, None])
        return certain if self.members > 1 else certain[:, 0]

    def answer(self, inputs: Tensor) -> InversePrediction:
        """Return the mean of the members' probabilities (section 2.4); u is its entropy."""
        each = log_probability(self.logits(inputs), self.valid_actions[:, None]).exp()
        return prediction(each.mean(1), self.valid_actions)


class PlainNet(EnsembleNet):
    """One network without uncertainty: u = 0, so the gate takes every grounded action.

    This is grounded action transformation without a gate (GAT; Hanna and Stone, AAAI 2017).
    """

    def loss(self, inputs: Tensor, target: Tensor, arguments: LossArguments) -> Tensor:
        """Return the cross-entropy alone; without u no training off the data is needed."""
        return self.row_loss(self.outputs(inputs, arguments), target, arguments)

    def answer(self, inputs: Tensor) -> InversePrediction:
        """Return the likeliest action with u = 0."""
        return _certain(super().answer(inputs))

    def mixed(self, answers: InversePrediction) -> InversePrediction:
        """Return the likeliest action of the mean with u = 0."""
        return _certain(super().mixed(answers))


def _certain(answer: InversePrediction) -> InversePrediction:
    """Return the answer with u = 0."""
    return InversePrediction(answer.action, answer.probability, torch.zeros_like(answer.u))
