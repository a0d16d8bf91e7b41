"""CoLight as the network of DQN: against its definition, who sees whom, and what it learns."""

from __future__ import annotations

import importlib.util
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from gymnasium import spaces
from pettingzoo import ParallelEnv
from torch import Tensor

from tests.runs import q_values
from ugat_marl.envs import AgentSet, parallel_env
from ugat_marl.envs.wrappers import frame_stack
from ugat_marl.errors import CheckpointError, OptionError
from ugat_marl.grounding import neighbours_of
from ugat_marl.policies import DQN, NetworkPolicy, export_policy
from ugat_marl.policies.learners.dqn import DQNConfig
from ugat_marl.policies.networks.colight import HEAD_SIZE, HEADS, CoLight
from ugat_marl.policies.networks.structure import MOST_NEIGHBOURS, Structure, _neighbours
from ugat_marl.scenarios import Intersection, Network
from ugat_marl.testing import ToyTraffic

HIDDEN = (6, 5)
QUICK = DQNConfig(
    network="colight",
    hidden=(16, 16),
    batch_size=16,
    replay_capacity=2000,
    warmup_decisions=40,
    epsilon_decay_decisions=400,
    learning_rate=3e-3,
)

# a - b - c - d, and e apart; c is a smaller intersection
AGENTS = AgentSet(("a", "b", "c", "d", "e"), (7, 7, 4, 7, 7), (3, 3, 2, 3, 3))
LINE = ((1,), (0, 2), (1, 3), (2,), ())


def colight(agents: AgentSet, neighbours: tuple[tuple[int, ...], ...]) -> CoLight:
    """A network whose every weight is drawn wider than a learner begins with."""
    made = CoLight(agents, neighbours, HIDDEN, torch.Generator())
    generator = torch.Generator().manual_seed(3)
    for parameter in made.parameters():
        parameter.data.normal_(generator=generator, std=0.5)
    return made


def seen(agents: AgentSet, batch: int = 9) -> Tensor:
    """Observations, zeros where padded."""
    generator = torch.Generator().manual_seed(0)
    found = torch.rand(len(agents), batch, agents.widest_observation, generator=generator)
    for row, size in enumerate(agents.observation_sizes):
        found[row, :, size:] = 0.0
    return found


def by_the_book(net: CoLight, near: tuple[int, ...], own: int, rows: Tensor) -> Tensor:
    """Q of one agent at one decision of all, ``(agents, widest_observation)``, head by head."""
    embedded = [
        (row @ net.embedding.weight + bias[0]).relu()
        for row, bias in zip(rows, net.embedding.agent_bias, strict=True)
    ]
    weights = net.heads.weight[0].split(HEADS * HEAD_SIZE, dim=1)
    biases = net.heads.bias[0, 0].split(HEADS * HEAD_SIZE)
    average = torch.zeros(HEAD_SIZE)
    for head in range(HEADS):
        part = slice(head * HEAD_SIZE, (head + 1) * HEAD_SIZE)
        query, key, value = (
            [h @ w[:, part] + b[part] for h in embedded]
            for w, b in zip(weights, biases, strict=True)
        )
        scores = [float(torch.exp(query[own] @ key[j]).item()) for j in (own, *near)]
        for j, score in zip((own, *near), scores, strict=True):
            average += score / sum(scores) * value[j] / HEADS
    joint = (average @ net.joint.weight[0] + net.joint.bias[0, 0]).relu()
    return joint @ net.readout.weight[0] + net.readout.bias[0, 0]


def test_values_are_those_of_the_definition_for_unequal_intersections_at_once():
    net, observations = colight(AGENTS, LINE), seen(AGENTS)
    values = net(observations)
    assert values.shape == (5, 9, 3)
    for agent, near in enumerate(LINE):
        for sample in range(9):
            wanted = by_the_book(net, near, agent, observations[:, sample])
            torch.testing.assert_close(values[agent, sample], wanted, rtol=1e-4, atol=1e-5)


def test_without_neighbours_it_is_the_path_of_its_own_embedding():
    net, observations = colight(AGENTS, ((),) * 5), seen(AGENTS)
    value = slice(2 * HEADS * HEAD_SIZE, None)
    embedded = net.embedding(observations).relu()
    heads = embedded @ net.heads.weight[0, :, value] + net.heads.bias[0, 0, value]
    joint = net.joint.weight[0], net.joint.bias[0, 0]
    hidden = (heads.unflatten(-1, (HEADS, HEAD_SIZE)).mean(-2) @ joint[0] + joint[1]).relu()
    wanted = hidden @ net.readout.weight[0] + net.readout.bias[0, 0]
    torch.testing.assert_close(net(observations), wanted)
    alone = colight(AGENTS, LINE)(observations)[4]  # e, beside others that have neighbours
    torch.testing.assert_close(alone, wanted[4])


def test_the_order_of_neighbours_changes_nothing():
    star = ((1, 2, 3, 4), (0, 2), (1, 0), (0, 4), (0, 3))
    turned = ((3, 1, 4, 2), (2, 0), (0, 1), (4, 0), (3, 0))
    observations = seen(AGENTS)
    values, others = (colight(AGENTS, near)(observations) for near in (star, turned))
    torch.testing.assert_close(values, others)


def test_values_follow_from_the_observations_of_the_intersection_and_its_neighbours_alone():
    net, observations = colight(AGENTS, LINE), seen(AGENTS)
    before = net(observations)
    for changed, size in enumerate(AGENTS.observation_sizes):
        other = observations.clone()
        other[changed, :, :size] += 0.5
        after = net(other)
        for agent, near in enumerate(LINE):
            if changed in (agent, *near):
                assert not torch.isclose(after[agent], before[agent]).all(-1).any()
            else:
                assert torch.equal(after[agent], before[agent])


def test_a_wider_intersection_elsewhere_changes_nothing_but_the_padding():
    narrow = AgentSet(("a", "b"), (4, 4), (2, 2))
    wide = AgentSet(("a", "b", "c"), (4, 4, 6), (2, 2, 2))
    net, beside = colight(narrow, ((1,), (0,))), colight(wide, ((1,), (0,), ()))
    for ours, theirs in zip(net.parameters(), beside.parameters(), strict=True):
        theirs.data[tuple(slice(size) for size in ours.shape)] = ours.data
    both = seen(narrow)
    padded = torch.nn.functional.pad(both, (0, 2, 0, 0, 0, 1), value=0.0)
    padded[2] = torch.rand(9, 6, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(beside(padded)[:2], net(both))


# --- what it is told -------------------------------------------------------------------------


@pytest.mark.parametrize("scenario", ["grid4x4-v1", "mixed-v1", "single-v1"])
def test_neighbours_of_shipped_networks_are_those_of_the_roads(scenario: str):
    env = parallel_env(scenario, neighbours=1)
    agents, structure = AgentSet.of(env), Structure.of(env, "colight")
    assert structure is not None and not structure.junctions
    assert structure.checked(agents) is structure
    near = {
        name: {agents.names[at] for at in own}
        for name, own in zip(agents.names, structure.neighbours, strict=True)
    }
    assert near == {name: {*own} for name, own in neighbours_of(env).items()}
    assert sum(map(len, structure.neighbours)) == {"grid4x4-v1": 48, "mixed-v1": 16}.get(
        scenario, 0
    )


def test_of_many_neighbours_the_nearest_are_attended_to():
    distances_m = [900.0, 300.0, 500.0, 100.0, 700.0, 200.0, 400.0]
    names = tuple(f"n{i}" for i in range(7))
    hub = Intersection("hub", (), (), (), (), (), names, (0.0, 0.0))
    around = tuple(
        Intersection(name, (), (), (), (), (), ("hub",), (0.0, -distance))
        for name, distance in zip(names, distances_m, strict=True)
    )
    agents = AgentSet(tuple("abcdefgh"), (1,) * 8, (2,) * 8)
    light_of = dict(zip(agents.names, (*names, "hub"), strict=True))
    found = _neighbours(agents, light_of, Network({}, (hub, *around), ()))
    assert MOST_NEIGHBOURS == 5
    assert found == ((7,),) * 7 + ((3, 5, 1, 6, 2),)


def test_what_cannot_be_read_is_refused_with_the_way_out():
    with pytest.raises(OptionError, match=r"'colight' reads neighbours .* or the network 'mlp'"):
        DQN.of(ToyTraffic(), QUICK)
    with pytest.raises(OptionError, match=r"network = 'colight' with the structure of 'frap'"):
        DQN(AGENTS, QUICK, structure=Structure("frap"))
    agents = AgentSet(("a",), (3,), (2,))
    with pytest.raises(
        OptionError, match=r"does not know the intersections of a; leave out wrappers"
    ):
        _neighbours(agents, {"b": "J"}, Network({}, (), ()))
    cases: dict[str, dict[str, Any]] = {
        "hidden = .*two sizes": {"hidden": (8,)},
        "shared = True": {"shared": True},
    }
    for told, settings in cases.items():
        with pytest.raises(OptionError, match=rf"DQNConfig\.{told}.*'colight'"):
            DQNConfig(network="colight", **settings)
    stacked = DQN.of(frame_stack(parallel_env("single-v1"), 2), QUICK)  # no place is looked for
    assert stacked.structure == Structure("colight", neighbours=((),))


# --- what it learns, and how it is kept --------------------------------------------------------

PAIRS = Structure("colight", neighbours=((1,), (0,), (3,), (2,)))


class OthersCoin(ParallelEnv[str, Any, Any]):
    """Each of four agents sees a coin of its own and is paid for naming its neighbour's."""

    metadata: ClassVar = {"name": "others_coin"}

    def __init__(self, length: int = 20) -> None:
        self.possible_agents = [f"signal_{i}" for i in range(4)]
        self.agents = []
        self.length = length

    def observation_space(self, agent: str) -> spaces.Box:
        return spaces.Box(0, 1, (2,), np.float32)

    def action_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None):
        self.random = np.random.default_rng(seed)
        self.agents, self.time = list(self.possible_agents), 0
        return self._observe(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, int]):
        agents = list(self.agents)
        theirs = self.coins[[1, 0, 3, 2]]
        paid = {a: float(actions[a] == theirs[i]) for i, a in enumerate(agents)}
        self.time += 1
        over = self.time == self.length
        observations = self._observe()
        if over:
            self.agents = []
        ended = dict.fromkeys(agents, over)
        return observations, paid, dict.fromkeys(agents, False), ended, {a: {} for a in agents}

    def _observe(self) -> dict[str, Any]:
        self.coins = self.random.integers(2, size=4)
        one_hot = np.eye(2, dtype=np.float32)[self.coins]
        return dict(zip(self.possible_agents, one_hot, strict=True))


def played(env: Any, policy: NetworkPolicy, *seeds: int) -> float:
    """Mean reward per decision and agent."""
    rewards: list[float] = []
    for seed in seeds:
        observations, infos = env.reset(seed=seed)
        while env.agents:
            observations, reward, _, _, infos = env.step(policy.act(observations, infos))
            rewards += reward.values()
    return float(np.mean(rewards))


def test_learns_what_only_the_neighbour_sees_and_a_plain_network_cannot():
    agents, config = AgentSet.of(OthersCoin()), replace(QUICK, discount=0.0)
    attending = DQN(agents, config, 1, structure=PAIRS)
    plain = DQN(agents, replace(config, network="mlp", shared=True), 1)
    reached = [
        played(OthersCoin(250), who.learn(OthersCoin(), 20, seed=1), 99)
        for who in (attending, plain)
    ]
    assert reached[0] == 1.0
    assert reached[1] < 0.6


@pytest.mark.slow
def test_learns_toy_traffic_with_unequal_intersections():
    env = ToyTraffic(steps=40)
    structure = Structure("colight", neighbours=((1,), (0, 2), (1,)))
    config = DQNConfig(network="colight", hidden=(32, 32), epsilon_decay_decisions=800)
    policy = DQN(AgentSet.of(env), config, 0, structure=structure).learn(env, 40, seed=0)
    # the rule that knows it gets -2.7, random phases -8.9
    assert played(env, policy, *range(900, 910)) > -3.4


def test_resume_equals_an_unbroken_run_and_policies_survive(tmp_path: Path):
    env = OthersCoin()

    def fresh(seed: int) -> DQN:
        return DQN(AgentSet.of(env), QUICK, seed, structure=PAIRS)

    unbroken = fresh(5).learn(env, 8, seed=1)
    first, second = fresh(5), fresh(77)
    first.learn(env, 5, seed=1)
    first.save(tmp_path / "dqn.pt")
    second.load(tmp_path / "dqn.pt")
    assert np.array_equal(second.learn(env, 3, seed=1).parameters, unbroken.parameters)
    unbroken.save(tmp_path / "policy.pt")
    observations, _ = env.reset(seed=7)
    for copy in (NetworkPolicy.load(tmp_path / "policy.pt"), pickle.loads(pickle.dumps(unbroken))):  # noqa: S301
        assert copy.structure == PAIRS
        for agent, values in q_values(unbroken, observations).items():
            assert np.array_equal(q_values(copy, observations)[agent], values)


def test_a_policy_takes_plain_observations_and_the_learner_scaled_ones():
    learner = DQN(AgentSet.of(OthersCoin()), QUICK, 5, structure=PAIRS)
    policy = learner.learn(OthersCoin(), 3, seed=1)
    assert learner._inputs.min() > 1.2  # a coin's root mean square is about 0.7
    observations, _ = OthersCoin().reset(seed=7)
    seen = torch.from_numpy(learner.agents.stack(observations))[:, None] * learner._inputs
    for values, expected in zip(
        q_values(policy, observations).values(), learner._target(seen)[:, 0], strict=True
    ):
        assert values == pytest.approx(expected.numpy(), abs=1e-4)


def test_checkpoints_of_other_networks_or_neighbours_are_refused(tmp_path: Path):
    agents = AgentSet.of(OthersCoin())
    mine = DQN(agents, QUICK, 0, structure=PAIRS)
    mine.save(tmp_path / "colight.pt")
    plain = DQN(agents, DQNConfig(hidden=QUICK.hidden))
    plain.save(tmp_path / "mlp.pt")
    untouched = mine.policy().parameters
    with pytest.raises(CheckpointError, match=r"its network are mlp, this learner's colight"):
        mine.load(tmp_path / "mlp.pt")
    with pytest.raises(CheckpointError, match=r"its network are colight, this learner's mlp"):
        plain.load(tmp_path / "colight.pt")
    crossed = Structure("colight", neighbours=((2,), (3,), (0,), (1,)))
    with pytest.raises(CheckpointError, match=r"other movements, phases or neighbours"):
        DQN(agents, QUICK, 0, structure=crossed).load(tmp_path / "colight.pt")
    assert np.array_equal(mine.policy().parameters, untouched)


def test_a_policy_file_with_broken_neighbours_is_refused(tmp_path: Path):
    agents, path = AgentSet.of(OthersCoin()), tmp_path / "policy.pt"
    DQN(agents, QUICK, 0, structure=PAIRS).policy().save(path)
    whole = torch.load(path, weights_only=True)
    for broken in (
        {"neighbours": ((1,), (0,), (3,))},  # an agent is missing
        {"neighbours": ((1,), (0,), (4,), (2,))},  # no such agent
        {"neighbours": ((1,), (0,), (-1,), (2,))},
        {"neighbours": ((1, 1), (0,), (3,), (2,))},
        {"neighbours": ((0,), (0,), (3,), (2,))},  # its own neighbour
        {"neighbours": "near"},
        {"network": "frap"},
        {"network": "mlp"},
    ):
        torch.save({**whole, "structure": {**whole["structure"], **broken}}, path)
        with pytest.raises(CheckpointError, match=r"policy\.pt: not a whole policy"):
            NetworkPolicy.load(path)


def test_it_is_exported_to_torchscript_and_refused_elsewhere(tmp_path: Path):
    env = OthersCoin()
    policy = DQN(AgentSet.of(env), QUICK, 0, structure=PAIRS).policy()
    known = importlib.util.find_spec("onnx") is not None
    for suffix in (".npz", ".onnx") if known else (".npz",):
        with pytest.raises(OptionError, match=r"'colight' .* export it to \.ts"):
            export_policy(policy, tmp_path / f"policy{suffix}")
    export_policy(policy, tmp_path / "policy.ts")
    model: Any = torch.jit.load(str(tmp_path / "policy.ts"))
    observations, infos = env.reset(seed=3)
    while env.agents:
        stacked, allowed = policy.agents.stack(observations), policy.agents.masks(infos)
        actions = policy.act(observations, infos)
        given = model(torch.from_numpy(stacked), torch.from_numpy(allowed))
        assert given.tolist() == list(actions.values())
        observations, _, _, _, infos = env.step(actions)
