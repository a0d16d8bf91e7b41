"""IPPO and MAPPO on the suite's environments, in one file, with torch and numpy only.

Proximal policy optimisation (Schulman et al. 2017). In IPPO each critic sees the observation of
its intersection (de Witt et al. 2020); in MAPPO it sees the whole network (Yu et al. 2022). Details
follow Huang et al. (2022), "The 37 implementation details of PPO".

    python baselines/ippo.py --scenario grid2x2-v1 --episodes 100 --out runs/ippo
    python baselines/ippo.py --scenario mixed-v1 --centralised
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import tyro
from torch import Tensor, nn

from ugat_marl.cli import baseline_command
from ugat_marl.data import read_checkpoint, write_checkpoint
from ugat_marl.envs import AgentSet
from ugat_marl.envs import AnyParallelEnv as Env
from ugat_marl.errors import CheckpointError, EpisodeError, OptionError
from ugat_marl.experiments import BaselineArgs, BaselineResult, train_baseline
from ugat_marl.policies import (
    BatchedMLP,
    InputScale,
    NetworkPolicy,
    SharedMLP,
    checkpoint_header,
    flatten_parameters,
    observation_mask,
    one_thread,
    parameters_for_unscaled,
)
from ugat_marl.policies import EpisodeCallback as Callback
from ugat_marl.seeding import derive_seed, torch_generator

_MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # names in Adam's state


@dataclass(frozen=True)
class IPPOConfig:
    """Settings of the learner."""

    centralised: bool = False  # the critic sees env.state() (MAPPO), not an observation (IPPO)
    shared: bool = True  # one actor and critic for all agents, with a one-hot; or one for each
    hidden: tuple[int, ...] = (64, 64)  # sizes of the hidden layers
    learning_rate: float = 1e-3  # step size of Adam
    anneal_episodes: int = 0  # the step size falls to 0 over so many episodes; 0 keeps it
    discount: float = 0.95  # weight of the next decision's value (gamma)
    gae_lambda: float = 0.95  # from one-step (0) to Monte Carlo (1) advantages
    clip: float = 0.2  # share by which the probability of an action may move in an update
    entropy_weight: float = 0.01  # weight of the entropy bonus
    value_weight: float = 0.5  # weight of the critic's squared error
    max_gradient: float = 0.5  # longer gradients are scaled down to this norm
    update_every: int = 120  # decisions in a roll-out; the end of an episode ends one too
    epochs: int = 8  # passes over each roll-out
    minibatch: int = 30  # decisions (of all agents) in a gradient step
    reward_scale: float | None = None  # factor on rewards; none: standardise with running moments

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            whole = name in ("hidden", "update_every", "epochs", "minibatch")
            most = 1 if name in ("discount", "gae_lambda") else math.inf
            for number in value if isinstance(value, tuple) else (value,):
                least = 1 if whole else 0
                if number is not None and (not least <= number <= most or number == math.inf):
                    raise OptionError(f"{name} = {value}: must be from {least} to {most}")
        for name in ("learning_rate", "reward_scale"):
            if getattr(self, name) == 0:
                raise OptionError(f"{name} = 0: must be above 0, or nothing is learnt")
        if self.discount == 1:
            raise OptionError("discount = 1: must be below 1, since traffic has no end")


def network(
    agents: AgentSet, config: IPPOConfig, n_in: int, n_out: int, gain: float, rng: torch.Generator
) -> nn.Module:
    """Return perceptrons from ``(agents, batch, n_in)`` to ``(agents, batch, n_out)``.

    Weights are orthogonal: times `gain` in the last layer, times √2 before. Biases are zero. A
    shared perceptron gets a one-hot of the agent, as `ugat_marl.envs.wrappers.agent_indicator`
    adds it.
    """
    if config.shared:
        made: nn.Module = SharedMLP(len(agents), n_in, config.hidden, n_out, rng)
    else:
        made = BatchedMLP([n_in] * len(agents), config.hidden, n_out, rng)
    weights = [layer for name, layer in made.named_parameters() if name.endswith("weight")]
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.zero_()
        for layer in weights:
            for own in layer.view(-1, *layer.shape[-2:]):
                nn.init.orthogonal_(own, gain if layer is weights[-1] else math.sqrt(2), rng)
    return made


def gae(rewards: Tensor, values: Tensor, discount: float, gae_lambda: float) -> Tensor:
    """Return generalised advantage estimates (Schulman et al. 2016, equation 16).

    δ_t = r_t + γ V_{t+1} - V_t and A_t = δ_t + γ λ A_{t+1}.

    Args:
        rewards: Rewards r without an end of an episode in between, ``(agents, decisions)``.
        values: Values V before each decision and after the last, ``(agents, decisions + 1)``. The
            last one bootstraps the roll-out.
        discount: γ.
        gae_lambda: λ.

    Returns:
        Advantages A, ``(agents, decisions)``.
    """
    errors = rewards + discount * values[:, 1:] - values[:, :-1]
    for i in reversed(range(errors.shape[1] - 1)):
        errors[:, i] += discount * gae_lambda * errors[:, i + 1]
    return errors


class Decision(NamedTuple):
    """A decision of all agents: inputs, choice and outcome, all ``(agents, ...)``.

    Attributes:
        observation: Input of the actors.
        viewed: Input of the critics.
        allowed: Action masks, ``(agents, actions)``.
        action: Chosen actions, ``(agents,)``.
        log_probability: Log-probabilities of the chosen actions, ``(agents,)``.
        reward: Rewards, ``(agents,)``.
    """

    observation: Tensor
    viewed: Tensor
    allowed: Tensor
    action: Tensor
    log_probability: Tensor
    reward: Tensor


class IPPO:
    """Learner by PPO for all agents of `env`, equal or not; a `Learner` of the suite.

    A roll-out that ends by truncation is bootstrapped with the critic's value. If an agent
    terminates, its future rewards count as zero.
    """

    def __init__(self, env: Env, config: IPPOConfig | None = None, seed: int = 0) -> None:
        self.agents, self.config = agents, config = AgentSet.of(env), config or IPPOConfig()
        self.env_options = dict(getattr(env.unwrapped, "env_options", {}))
        self.episodes = 0
        rng = torch_generator(seed, "ippo", "weights")
        n_in, n_out = agents.widest_observation, agents.most_actions
        self._actor = network(agents, config, n_in, n_out, 0.01, rng)  # at first nearly uniform
        if config.centralised:
            state: Any = getattr(env, "state_space", None)
            if state is None:
                raise OptionError("a centralised critic needs env.state_space and env.state()")
            n_in = int(state.shape[0])
        self._critic = network(agents, config, n_in, 1, 1.0, rng)
        self._weights = flatten_parameters(nn.ModuleList([self._actor, self._critic]))
        self._adam = torch.optim.Adam([self._weights], eps=1e-5)
        # Scales of observations and states: without them, small inputs have little effect at first.
        self._seen, self._stated = InputScale(agents.widest_observation), InputScale(n_in)
        # Number, sum and sum of squares of each agent's rewards so far.
        self._rewards = torch.zeros(3, len(agents), 1, dtype=torch.float64)

    def learn(
        self, env: Env, episodes: int, seed: int, on_episode: Callback | None = None
    ) -> NetworkPolicy:
        """Train further `episodes`; random choices depend on `seed` and the episodes so far."""
        if AgentSet.of(env) != self.agents:
            raise OptionError(f"agents are {AgentSet.of(env)}, this learner's {self.agents}")
        with one_thread():
            for _ in range(episodes):
                numbers = self._episode(env, seed)
                if on_episode is not None:
                    on_episode(self.episodes - 1, numbers)
        return self.policy()

    def policy(self) -> NetworkPolicy:
        """Return a snapshot of the current greedy policy.

        Its class is DQN's, with logits in place of Q, so all commands of `ugat-marl` read its
        files.
        """
        parameters = parameters_for_unscaled(self._actor, torch.from_numpy(self._seen.factors))
        hidden, shared = self.config.hidden, self.config.shared
        return NetworkPolicy(self.agents, hidden, parameters, self.env_options, shared)

    def save(self, path: Path) -> None:
        """Write the whole state; after `load`, training continues with the same numbers."""
        write_checkpoint(path, "baselines.ippo", self._content())

    def load(self, path: Path) -> None:
        """Restore the state that `save` wrote; raise `CheckpointError` for another learner's."""
        content, own = read_checkpoint(path, "baselines.ippo"), self._content()
        for name, value in own.items():
            found, value = (
                (x.shape, x.dtype) if isinstance(x, Tensor) else x
                for x in (content.get(name), value)
            )
            if type(found) is not type(value) or (found != value and name != "episodes"):
                raise CheckpointError(f"{path}: {name} is {found!r}, this learner's {value!r}")
        self.episodes = content["episodes"]
        self._weights.data.copy_(content["weights"])
        self._rewards.copy_(content["rewards"])
        self._seen.sums[:], self._stated.sums[:] = content["seen"], content["stated"]
        self._adam.state[self._weights] = {name: content[name] for name in _MOMENTS}

    def _content(self) -> dict[str, Any]:
        weights = self._weights.detach().clone()
        moments = dict(zip(_MOMENTS, (torch.tensor(0.0), 0 * weights, 0 * weights), strict=True))
        return {
            **checkpoint_header(
                self.agents, self.config.hidden, self.env_options, self.config.shared
            ),
            "centralised": self.config.centralised,
            "episodes": self.episodes,
            "weights": weights,
            "rewards": self._rewards.clone(),
            "seen": torch.from_numpy(self._seen.sums.copy()),
            "stated": torch.from_numpy(self._stated.sums.copy()),
            **(self._adam.state[self._weights] or moments),
        }

    def _episode(self, env: Env, seed: int) -> dict[str, float]:
        acting = torch_generator(seed, "ippo", "act", self.episodes)
        shuffling = torch_generator(seed, "ippo", "shuffle", self.episodes)
        observations, infos = env.reset(seed=derive_seed(seed, "ippo", "episode", self.episodes))
        rollout, losses, total = list[Decision](), list[list[float]](), 0.0
        seen, viewed = self._look(env, observations)
        while env.agents:
            allowed = torch.from_numpy(self.agents.masks(infos))
            action, log_probability = self._draw(seen, allowed, acting)
            observations, rewards, ended, _, infos = env.step(self.agents.actions(action.numpy()))
            if len(env.agents) not in (0, len(self.agents)):
                raise EpisodeError(f"only {env.agents} are left; all agents have to stay")
            reward = torch.from_numpy(self.agents.values(rewards))
            if not reward.isfinite().all():
                raise EpisodeError(f"a reward is not finite: {rewards}; correct the reward")
            total += float(reward.mean())
            rollout.append(Decision(seen, viewed, allowed, action, log_probability, reward))
            seen, viewed = self._look(env, observations)
            if len(rollout) == self.config.update_every or not env.agents:
                over = torch.from_numpy(self.agents.values(ended)).bool()
                losses += self._update(rollout, viewed, over, shuffling)
                rollout.clear()
        self.episodes += 1
        policy_loss, value_loss, entropy = np.mean(losses, axis=0).tolist()
        told = {"policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}
        return {"return": total} | told

    def _look(self, env: Env, observations: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
        """Return the inputs of actors and critics, scaled by the running scales."""
        rows = self.agents.stack(observations)
        self._seen.note(rows, observation_mask(self.agents))
        seen = torch.from_numpy(rows * self._seen.factors)
        if not self.config.centralised:
            return seen, seen
        state = env.state()
        self._stated.note(state[None])
        return seen, torch.from_numpy(state * self._stated.factors).expand(len(self.agents), -1)

    def _log_probabilities(self, seen: Tensor, allowed: Tensor) -> Tensor:
        """Return the log-probabilities of all actions; a forbidden one has probability 0."""
        return self._actor(seen).masked_fill(~allowed, -1e8).log_softmax(-1)

    def _draw(self, seen: Tensor, allowed: Tensor, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw an action for each agent and return actions and log-probabilities, ``(agents,)``.

        Gumbel trick: the argmax of log p - log(-log U), U uniform in (0, 1), has probabilities p.
        """
        with torch.no_grad():
            logs = self._log_probabilities(seen[:, None], allowed[:, None]).squeeze(1)
            uniform = torch.rand(logs.shape, generator=rng).clamp_min(1e-9)
            action = (logs - (-uniform.log()).log()).argmax(-1)
            return action, logs.gather(1, action[:, None]).squeeze(1)

    def _update(
        self, rollout: list[Decision], after: Tensor, over: Tensor, rng: torch.Generator
    ) -> list[list[float]]:
        batch = Decision(*(torch.stack(column, dim=1) for column in zip(*rollout, strict=True)))
        config, (centre, scale) = self.config, self._reward_scale(batch.reward)
        with torch.no_grad():
            values = self._critic(torch.cat((batch.viewed, after[:, None]), dim=1)).squeeze(-1)
            # Reward 0 is (0 - centre) * scale after scaling; for ever: divided by 1 - discount.
            nothing = -centre * scale / (1 - config.discount)
            values[:, -1] = torch.where(over, nothing.squeeze(-1), values[:, -1])
            rewards = (batch.reward - centre) * scale
            returns = gae(rewards, values, config.discount, config.gae_lambda) + values[:, :-1]
        left = 1 - self.episodes / config.anneal_episodes if config.anneal_episodes else 1.0
        self._adam.param_groups[0]["lr"] = config.learning_rate * max(left, 0.0)
        losses = list[list[float]]()
        for _ in range(config.epochs):
            for some in torch.randperm(len(rollout), generator=rng).split(config.minibatch):
                part = Decision(*(column[:, some] for column in batch))
                losses.append(self._descend(part, values[:, some], returns[:, some]))
        return losses

    def _reward_scale(self, rewards: Tensor) -> tuple[Tensor, Tensor]:
        """Return centre and scale of each agent's rewards so far, these included, ``(agents, 1)``.

        The scaled reward is (r - mean) / deviation. A given `reward_scale` is used with centre 0.
        """
        if self.config.reward_scale is not None:
            return torch.zeros(len(rewards), 1), torch.tensor(self.config.reward_scale)
        self._rewards += torch.stack([rewards.double() ** k for k in range(3)]).sum(2, keepdim=True)
        _, mean, square = self._rewards / self._rewards[0]
        deviation = (square - mean**2).clamp_min(0).sqrt()
        return mean.float(), torch.where(deviation > 1e-6, 1 / deviation, 1.0).float()

    def _descend(self, part: Decision, values: Tensor, returns: Tensor) -> list[float]:
        logs = self._log_probabilities(part.observation, part.allowed)
        chosen = logs.gather(-1, part.action[..., None]).squeeze(-1)
        ratio = (chosen - part.log_probability).exp()
        advantages = returns - values
        gain = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-8)
        # PPO, equation 7: loss = -E[min(ratio * gain, clip(ratio, 1 - ε, 1 + ε) * gain)].
        clipped = ratio.clamp(1 - self.config.clip, 1 + self.config.clip)
        policy_loss = -torch.minimum(ratio * gain, clipped * gain).mean()
        value_loss = 0.5 * (self._critic(part.viewed).squeeze(-1) - returns).square().mean()
        entropy = -(logs.exp() * logs).sum(-1).mean()
        loss = policy_loss + self.config.value_weight * value_loss
        (loss - self.config.entropy_weight * entropy).backward()
        nn.utils.clip_grad_norm_([self._weights], self.config.max_gradient)
        self._adam.step()
        self._adam.zero_grad(set_to_none=False)  # the networks' gradients are views of this one
        return [number.item() for number in (policy_loss, value_loss, entropy)]


@dataclass(frozen=True)
class Args(BaselineArgs):
    """Train IPPO, or with --centralised MAPPO, on one scenario."""

    ppo: Annotated[IPPOConfig, tyro.conf.arg(name="")] = IPPOConfig()


def train(args: Args, on_episode: Callback | None = None) -> BaselineResult:
    """Train and evaluate; write the results if `args.out` is given."""
    return train_baseline(args, lambda env: IPPO(env, args.ppo, args.seed), on_episode)


if __name__ == "__main__":
    baseline_command(Args, train)
