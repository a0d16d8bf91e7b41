"""The network "universal": its definition, its invariances, and its start."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import tyro
from torch import Tensor

from tests.runs import q_values
from ugat_marl.envs import AGE_SCALE_S, AgentSet, parallel_env
from ugat_marl.errors import CheckpointError, OptionError
from ugat_marl.experiments import TransferConfig
from ugat_marl.policies import (
    DQN,
    UNIVERSAL_NAME,
    DQNConfig,
    InitialWeights,
    NetworkPolicy,
    export_policy,
    has_first_lessons,
    observed_options,
    roll_out,
    suite_config,
)
from ugat_marl.policies.networks.structure import Junction, Structure
from ugat_marl.policies.networks.universal import LANES, SECONDS, VEHICLES, UniversalNetwork
from ugat_marl.testing import ToyTraffic

HIDDEN = (6, 5)
QUICK = DQNConfig(
    network="universal",
    hidden=(12, 16),
    batch_size=16,
    replay_capacity=2000,
    warmup_decisions=40,
    epsilon_decay_decisions=400,
    learning_rate=3e-3,
    reward_scale=1.0,
)
CROSS = Junction(  # four lanes, a movement each, two remembered commands, then the age
    movements=(((0,),), ((1,),), ((2,),), ((3,),), ((0, 1),)),
    greens=((1, 0, 1, 0, 1), (0, 1, 0, 1, 0), (1, 0, 0, 0, 0.5), (0, 0, 0, 1, 0)),
    first_phase=4,
    vehicles=(40, 20, 10, 40),
    commands=(8, 12),
    age=16,
    interval_s=10,
    clearance_s=5,
)
TEE = Junction(
    movements=(((0, 1),), ((1,),), ((2,),)),
    greens=((1, 1, 0), (0, 0, 1)),
    first_phase=3,
    vehicles=(20, 20, 20),
    commands=(5, 7),
    age=9,
    interval_s=10,
    clearance_s=5,
)
BOTH = AgentSet(("cross", "tee"), (17, 10), (4, 2))


def universal(agents: AgentSet, *junctions: Junction) -> UniversalNetwork:
    """A network whose every weight is drawn wider than a learner begins with."""
    made = UniversalNetwork(agents, junctions, HIDDEN, torch.Generator())
    generator = torch.Generator().manual_seed(3)
    for parameter in made.parameters():
        parameter.data.normal_(generator=generator)
    return made


def seen(junctions: tuple[Junction, ...], agents: AgentSet, batch: int = 7) -> Tensor:
    """Traffic, a current phase, two commands and an age of each agent."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.zeros(len(agents), batch, agents.widest_observation)
    for row, junction in enumerate(junctions):
        lanes, phases = junction.first_phase, len(junction.greens)
        rows[row, :, :lanes] = torch.rand(batch, lanes, generator=generator)
        for first in (junction.first_phase, *junction.commands):
            shown = torch.randint(phases, (batch,), generator=generator)
            rows[row, torch.arange(batch), first + shown] = 1.0
        assert junction.age is not None
        rows[row, :, junction.age] = torch.rand(batch, generator=generator)
    return rows


def perceptron(layers: Any, numbers: Tensor) -> Tensor:
    """A perceptron of one hidden layer, matrix by matrix."""
    (w1, b1), (w2, b2) = ((layer.weight[0], layer.bias[0, 0]) for layer in layers[::2])
    return (numbers @ w1 + b1).relu() @ w2 + b2


def by_the_book(net: UniversalNetwork, junction: Junction, observation: Tensor) -> Tensor:
    """Q of one observation, with loops over movements and phases."""
    phases = len(junction.greens)

    def shown(first: int) -> int:
        return int(observation[first : first + phases].argmax())

    assert junction.age is not None
    embeddings: list[Tensor] = []
    for m, (lanes,) in enumerate(junction.movements):
        vehicles = sum(float(observation[at]) * junction.vehicles[at] for at in lanes)
        green = junction.greens[shown(junction.first_phase)][m]
        asked = [junction.greens[shown(first)][m] for first in junction.commands]
        numbers = [vehicles / VEHICLES, *asked, green, float(observation[junction.age]) * green]
        facts = [len(lanes) / LANES, junction.interval_s / SECONDS, junction.clearance_s / SECONDS]
        embeddings.append(perceptron(net.movement.layers, torch.tensor(numbers + facts)).relu())
    total = torch.stack(embeddings).sum(0)
    values: list[Tensor] = []
    for row in junction.greens:
        demand = sum((g * e for g, e in zip(row, embeddings, strict=True)), torch.zeros(HIDDEN[0]))
        joint = demand @ net.own.weight[0] + net.own.bias[0, 0]
        joint = (joint + total @ net.whole.weight[0] + net.whole.bias[0, 0]).relu()
        values.append(perceptron(net.readout.layers, joint) + perceptron(net.value.layers, total))
    return torch.stack(values)[:, 0]


def test_values_are_those_of_the_definition_for_unequal_intersections_at_once():
    net, observations = universal(BOTH, CROSS, TEE), seen((CROSS, TEE), BOTH)
    values = net(observations)
    assert values.shape == (2, 7, 4)
    for row, junction in enumerate((CROSS, TEE)):
        for sample in range(7):
            wanted = by_the_book(net, junction, observations[row, sample])
            torch.testing.assert_close(values[row, sample, : len(junction.greens)], wanted)


def test_values_follow_when_phases_and_movements_are_numbered_otherwise():
    agents = AgentSet(("it",), (17,), (4,))
    phases, movements = [2, 0, 3, 1], [4, 2, 0, 1, 3]
    other = replace(
        CROSS,
        movements=tuple(CROSS.movements[m] for m in movements),
        greens=tuple(tuple(CROSS.greens[p][m] for m in movements) for p in phases),
    )
    observations = seen((CROSS,), agents)
    renamed = observations.clone()
    for first in (4, 8, 12):
        renamed[..., first : first + 4] = observations[..., first : first + 4][..., phases]
    values, others = universal(agents, CROSS)(observations), universal(agents, other)(renamed)
    torch.testing.assert_close(others, values[..., phases])
    assert not torch.allclose(others, values)  # it is a numbering that changes something


def test_a_vehicle_counts_alike_on_short_and_long_lanes():
    agents = AgentSet(("it",), (17,), (4,))
    observations = seen((CROSS,), agents)
    longer = replace(CROSS, vehicles=tuple(2 * x for x in CROSS.vehicles))
    halved = observations.clone()
    halved[..., :4] /= 2
    torch.testing.assert_close(
        universal(agents, longer)(halved), universal(agents, CROSS)(observations)
    )


def test_structure_of_shipped_networks_holds_commands_age_and_times():
    env = parallel_env("mixed-v1", **observed_options(UNIVERSAL_NAME))
    agents, structure = AgentSet.of(env), Structure.of(env, "universal")
    assert structure is not None
    structure.checked(agents)
    observations, _ = env.reset(seed=0)
    asked = dict.fromkeys(env.agents, 1)
    observations, *_ = env.step(asked)
    env.close()
    interval_s = env.decision_interval_s
    for name, junction in zip(agents.names, structure.junctions, strict=True):
        assert len(junction.commands) == 4
        assert junction.age is not None
        vector, phases = observations[name], len(junction.greens)
        latest, *before = junction.commands
        assert vector[latest : latest + phases].tolist() == np.eye(phases)[1].tolist()
        assert not any(vector[at : at + phases].any() for at in before)  # nothing asked before
        assert vector[junction.age] == pytest.approx(interval_s / AGE_SCALE_S)
        assert junction.interval_s == interval_s
        assert junction.clearance_s == env.scenario.timing.clearance_s
        item = next(i for i in env.network.intersections if i.id == env.intersection_of[name])
        lanes = env.network.lane_table()
        capacity = lanes.storage_veh[lanes.indices(item.incoming_lanes)]
        assert np.array_equal(junction.vehicles[: len(capacity)], capacity)


def test_an_observation_without_vehicles_is_refused():
    with pytest.raises(OptionError, match=r"reads numbers of vehicles; use the observation"):
        DQN.of(parallel_env("single-v1", observation="pressure"), QUICK)


# --- learning and starts -------------------------------------------------------------------------


def toy_structure() -> Structure:
    """Phase k of `ToyTraffic` serves lanes k and k + 1."""

    def junction(lanes: int) -> Junction:
        greens = tuple(
            tuple(float(m in (p, p + 1)) for m in range(lanes)) for p in range(lanes - 1)
        )
        movements = tuple(((m,),) for m in range(lanes))
        return Junction(movements, greens, lanes, vehicles=(20.0,) * lanes)

    return Structure("universal", (junction(4), junction(3), junction(4)))


def toy_learner(seed: int = 0, config: DQNConfig = QUICK) -> DQN:
    return DQN(AgentSet.of(ToyTraffic()), config, seed, structure=toy_structure())


def played(env: ToyTraffic, policy: NetworkPolicy) -> float:
    return float(np.mean([roll_out(env, policy, seed).mean_reward for seed in range(900, 910)]))


def test_learns_toy_traffic_and_its_weights_serve_as_a_start(tmp_path: Path):
    env = ToyTraffic(steps=40)
    learner = toy_learner(1)
    assert played(env, learner.policy()) < -10
    learner.learn(env, 20, seed=0)
    policy: Any = learner.policy()
    running, newest = learner._target_weights.detach(), learner._weights.detach()
    assert np.array_equal(policy.parameters, running), "it acts with the running mean"
    assert not torch.equal(running, newest)
    trained = played(env, policy)
    assert trained > -3  # the rule that knows the game has -2.71, random phases -8.85
    weights = torch.from_numpy(policy.parameters)
    InitialWeights(weights, {"observation": "toy"}, "a test").save(tmp_path / "start.pt")
    begun = toy_learner(5, replace(QUICK, start=str(tmp_path / "start.pt")))
    assert played(env, begun.policy()) == trained
    with pytest.raises(OptionError, match=r"observation = 'toy', not 'count'"):
        DQN(AgentSet.of(env), begun.config, 0, {"observation": "count"}, toy_structure())
    wider = replace(QUICK, hidden=(13, 16), start=str(tmp_path / "start.pt"))
    with pytest.raises(OptionError, match=r"learned with observation=toy: use the same"):
        toy_learner(0, wider)
    (tmp_path / "start.pt").write_bytes(b"torn")
    with pytest.raises(CheckpointError):
        toy_learner(0, replace(QUICK, start=str(tmp_path / "start.pt")))


def test_a_policy_of_an_earlier_training_serves_as_a_start(tmp_path: Path):
    learner = toy_learner(1)
    learner.learn(ToyTraffic(steps=40), 2, seed=0)
    learner.policy().save(tmp_path / "policy.pt")
    begun = toy_learner(5, replace(QUICK, start=str(tmp_path / "policy.pt")))
    assert np.array_equal(begun.policy().parameters, learner.policy().parameters)
    assert not has_first_lessons(begun) and has_first_lessons(learner)
    told: list[float] = []
    begun.learn(ToyTraffic(steps=40), 1, 0, lambda _, numbers: told.append(numbers["epsilon"]))
    assert told == [QUICK.epsilon_end]
    with pytest.warns(UserWarning, match="has not seen commands under way"):
        late = DQN(
            AgentSet.of(ToyTraffic()), begun.config, 0, {"commands": 2}, structure=toy_structure()
        )
    assert has_first_lessons(late)
    other = DQN.of(ToyTraffic(), replace(QUICK, network="mlp"), 0)
    other.policy().save(tmp_path / "other.pt")
    with pytest.raises(OptionError, match=r"other\.pt: a training begins with .* \"universal\""):
        InitialWeights.load(tmp_path / "other.pt")
    (tmp_path / "log.pt").write_bytes(b"torn")
    with pytest.raises(CheckpointError):
        InitialWeights.load(tmp_path / "log.pt")


def test_learners_that_share_weights_update_the_same_ones():
    env = ToyTraffic(steps=40)
    first, second = toy_learner(1), toy_learner(2)
    assert not np.array_equal(first.policy().parameters, second.policy().parameters)
    second.share_weights(first)
    first.learn(env, 3, seed=0)
    second.learn(env, 3, seed=1)
    assert first.updates > 0
    assert second.updates > 0
    assert np.array_equal(first.policy().parameters, second.policy().parameters)
    observations, _ = env.reset(seed=0)
    one, two = (q_values(learner.policy(), observations) for learner in (first, second))
    assert all(np.array_equal(one[agent], two[agent]) for agent in one)
    dqn = DQN.of(env)
    with pytest.raises(OptionError, match=r"only learners with network = \"universal\""):
        dqn.share_weights(first)


OBSERVED = {**observed_options(UNIVERSAL_NAME), "duration_s": 200.0}
DECISIONS = 20


def test_the_learner_of_that_name_serves_any_shipped_network(tmp_path: Path):
    for name in ("single-v1", "mixed-v1"):
        env = parallel_env(name, **OBSERVED)
        learner = DQN.of(env, suite_config(UNIVERSAL_NAME))
        policy = learner.policy()
        export_policy(policy, tmp_path / "policy.ts", env)
        policy.save(tmp_path / "policy.pt")
        loaded = NetworkPolicy.load(tmp_path / "policy.pt")
        observations, infos = env.reset(seed=0)
        assert loaded.act(observations, infos) == policy.act(observations, infos)
        env.close()
    assert suite_config(UNIVERSAL_NAME, DQNConfig(discount=0.9)).discount == 0.9
    assert suite_config(UNIVERSAL_NAME, DQNConfig(discount=0.9)).network == "universal"
    assert suite_config(UNIVERSAL_NAME, DQNConfig(network="mlp")).network == "mlp"


def test_rewards_are_not_centred_so_that_equal_states_are_worth_the_same_everywhere():
    env = ToyTraffic(steps=40)
    learner = toy_learner()
    learner.learn(env, 2, seed=0)
    assert not learner._centre.any()
    assert (learner._scale == QUICK.reward_scale).all()
    learner = toy_learner(config=replace(QUICK, reward_scale=None))
    assert (learner._scale == 0.05).all()


@pytest.mark.parametrize(("interval_s", "steps"), [(5.0, 6), (10.0, 3), (30.0, 1)])
def test_discount_and_steps_are_those_of_ten_seconds(interval_s: float, steps: int):
    agents = AgentSet(("it",), (17,), (4,))
    structure = Structure("universal", (replace(CROSS, interval_s=interval_s),))
    learner = DQN(agents, replace(QUICK, discount=0.5, steps=3), structure=structure)
    assert learner._discount == pytest.approx(0.5 ** (interval_s / 10))
    assert learner._steps == steps


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        (("--dqn.teacher", "None"), "teacher", None),
        (("--dqn.teacher", "none"), "teacher", None),
        (("--dqn.hidden", "48", "48"), "hidden", (48, 48)),
        (("--dqn.steps", "1"), "steps", 1),
        (("--dqn.warmup-decisions", "200"), "warmup_decisions", 200),
        (("--dqn.epsilon-decay-decisions", "3600"), "epsilon_decay_decisions", 3600),
    ],
)
def test_settings_that_are_given_stay_though_they_are_those_of_dqn(
    words: tuple[str, ...], name: str, value: Any
) -> None:
    usual = suite_config(UNIVERSAL_NAME, tyro.cli(TransferConfig, args=["single-v1"]).dqn)
    assert usual == suite_config(UNIVERSAL_NAME)
    assert getattr(usual, name) != value == getattr(suite_config("dqn"), name)
    parsed = tyro.cli(TransferConfig, args=["single-v1", *words]).dqn
    for given in (parsed, DQNConfig(**{name: value})):
        assert suite_config(UNIVERSAL_NAME, given) == replace(usual, **{name: value})
        assert suite_config("dqn", given) == suite_config("dqn")
