"""FRAP as the network of DQN: against its definition, its invariances, and what it learns."""

from __future__ import annotations

import importlib.util
import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.runs import q_values
from ugat_marl.data import AgentLayout
from ugat_marl.envs import AgentSet, pad_spaces, parallel_env
from ugat_marl.envs.wrappers import frame_stack
from ugat_marl.errors import CheckpointError, OptionError
from ugat_marl.policies import DQN, NetworkPolicy, export_policy, learner_factory
from ugat_marl.policies.learners.dqn import DQNConfig
from ugat_marl.policies.networks.frap import FRAP
from ugat_marl.policies.networks.structure import Junction, Structure, _junction
from ugat_marl.scenarios import Intersection, Link
from ugat_marl.testing import ToyTraffic

HIDDEN = (6, 5)
QUICK = DQNConfig(
    network="frap",
    hidden=(12, 16),
    batch_size=16,
    replay_capacity=2000,
    warmup_decisions=40,
    epsilon_decay_decisions=400,
    learning_rate=3e-3,
)

CROSS = Junction(  # four lanes, a movement each; a fifth movement is the right turn of lane 0
    movements=(((0,),), ((1,),), ((2,),), ((3,),), ((0,),)),
    greens=((1, 0, 1, 0, 1), (0, 1, 0, 1, 0), (1, 0, 0, 0, 0.5), (0, 0, 0, 1, 0)),
    first_phase=4,
)
TEE = Junction(
    movements=(((0, 1),), ((1,),), ((2,),)),
    greens=((1, 1, 0), (0, 0, 1)),
    first_phase=3,
)
BOTH = AgentSet(("cross", "tee"), (8, 5), (4, 2))


def frap(agents: AgentSet, *junctions: Junction) -> FRAP:
    """A network whose every weight is drawn wider than a learner begins with."""
    made = FRAP(agents, junctions, HIDDEN, torch.Generator())
    generator = torch.Generator().manual_seed(3)
    for parameter in made.parameters():
        parameter.data.normal_(generator=generator)
    return made


def seen(agents: AgentSet, batch: int = 7, seed: int = 0) -> Tensor:
    """Traffic, and a current phase, of each agent."""
    generator = torch.Generator().manual_seed(seed)
    found = torch.zeros(len(agents), batch, agents.widest_observation)
    sizes = zip(agents.observation_sizes, agents.action_counts, strict=True)
    for row, (size, phases) in enumerate(sizes):
        found[row, :, : size - phases] = torch.rand(batch, size - phases, generator=generator)
        shown = torch.randint(phases, (batch,), generator=generator)
        found[row, torch.arange(batch), size - phases + shown] = 1.0
    return found


def by_the_book(net: FRAP, junction: Junction, observation: Tensor) -> Tensor:
    """Q of one observation with a loop over movements and one over pairs of phases."""
    layers: Any = net.demand.layers
    (w1, b1), (w2, b2) = ((layer.weight[0], layer.bias[0, 0]) for layer in layers[::2])
    shown = int(observation[junction.first_phase :].argmax())
    demands = [
        (
            (torch.tensor([observation[list(own)].sum(), junction.greens[shown][m]]) @ w1 + b1)
            .relu() @ w2 + b2
        ).relu()
        for m, (own,) in enumerate(junction.movements)
    ]  # fmt: skip
    phases = [
        sum((share * d for share, d in zip(row, demands, strict=True)), torch.zeros(HIDDEN[0]))
        for row in junction.greens
    ]
    values: list[Tensor] = []
    for p, one in enumerate(junction.greens):
        scores: list[Tensor] = []
        for q, other in enumerate(junction.greens):
            if p != q:
                pair = torch.cat((phases[p], phases[q])) @ net.pair.weight[0] + net.pair.bias[0, 0]
                share = any(a > 0 and b > 0 for a, b in zip(one, other, strict=True))
                scores.append(pair.relu() @ net.relation[int(share)])
        values.append(torch.stack(scores).mean() + net.level[0])
    return torch.stack(values)


def test_values_are_those_of_the_definition_for_unequal_intersections_at_once():
    net, observations = frap(BOTH, CROSS, TEE), seen(BOTH)
    values = net(observations)
    assert values.shape == (2, 7, 4)
    for row, (junction, phases) in enumerate(((CROSS, 4), (TEE, 2))):
        for sample in range(7):
            wanted = by_the_book(net, junction, observations[row, sample])
            torch.testing.assert_close(values[row, sample, :phases], wanted)


def test_an_intersection_alone_has_the_values_it_has_beside_others():
    beside, observations = frap(BOTH, CROSS, TEE), seen(BOTH)
    for row, (junction, size, phases) in enumerate(((CROSS, 8, 4), (TEE, 5, 2))):
        alone = frap(AgentSet(("it",), (size,), (phases,)), junction)
        mine = alone(observations[row : row + 1, :, :size])
        torch.testing.assert_close(mine[0], beside(observations)[row, :, :phases])


def test_values_follow_when_phases_lanes_and_movements_are_numbered_otherwise():
    agents = AgentSet(("it",), (8,), (4,))
    phases, lanes, movements = [2, 0, 3, 1], [3, 1, 0, 2], [4, 2, 0, 1, 3]
    other = Junction(
        movements=tuple(
            tuple(tuple(lanes.index(at) for at in own) for own in CROSS.movements[m])
            for m in movements
        ),
        greens=tuple(tuple(CROSS.greens[p][m] for m in movements) for p in phases),
        first_phase=4,
    )
    observations = seen(agents)
    renamed = torch.cat((observations[..., :4][..., lanes], observations[..., 4:][..., phases]), 2)
    values, others = frap(agents, CROSS)(observations), frap(agents, other)(renamed)
    torch.testing.assert_close(others, values[..., phases])
    assert not torch.allclose(others, values)  # it is a numbering that changes something


def test_intersections_with_the_same_traffic_have_the_same_values():
    agents = AgentSet(("a", "b"), (8, 8), (4, 4))
    one = seen(AgentSet(("a",), (8,), (4,)))
    values = frap(agents, CROSS, CROSS)(one.repeat(2, 1, 1))
    assert torch.equal(values[0], values[1])


def test_gradients_of_a_pair_flow_through_the_movements_of_its_phases_alone():
    net = frap(AgentSet(("it",), (8,), (4,)), CROSS)
    observations = seen(AgentSet(("it",), (8,), (4,)), batch=64).requires_grad_()
    pairs = net.pairs(observations)  # (agents, phases, batch, phases, size)
    lanes_of = {0: {0, 2}, 1: {1, 3}, 2: {0}, 3: {3}}
    for p, own in lanes_of.items():
        for q, theirs in lanes_of.items():
            (gradient,) = torch.autograd.grad(
                pairs[0, p, :, q].sum(), observations, retain_graph=True
            )
            reached = set(torch.nonzero(gradient[0, :, :4].abs().sum(0)).flatten().tolist())
            assert reached == own | theirs, (p, q)


def test_a_phase_an_intersection_lacks_takes_no_part():
    net, observations = frap(BOTH, CROSS, TEE), seen(BOTH).requires_grad_()
    net(observations)[1, :, 2:].sum().backward()  # the tee's phases 2 and 3 do not exist
    assert observations.grad is not None
    assert not observations.grad.any()


# --- what it is told -------------------------------------------------------------------------


def intersection(
    links: tuple[Link, ...], incoming: tuple[str, ...], phases: tuple[str, ...]
) -> Intersection:
    outgoing = tuple(dict.fromkeys(link.to_lane for link in links))
    return Intersection("J", incoming, outgoing, links, phases, (), (), (0.0, 0.0))


def test_movements_and_greens_of_a_hand_made_intersection():
    links = (
        Link(0, "west_0", "south_0", "r"),  # green in both: competes with nothing
        Link(1, "west_0", "east_0", "s"),
        Link(2, "west_1", "east_1", "s"),  # goes on in the second phase: half of the movement
        Link(3, "west_1", "north_0", "l"),
        Link(4, "south_0", "north_0", "s"),
    )
    item = intersection(links, ("west_0", "west_1", "south_0"), ("GGGgr", "GrGrG"))
    made = _junction(item, AgentLayout(3, 2), halves=False)
    assert made.movements == (((0, 1),), ((1,),), ((2,),))  # through, left, from the south
    assert made.greens == ((1.0, 1.0, 0.0), (0.5, 0.0, 1.0))
    assert made.first_phase == 3
    # halting and vehicles per incoming, vehicles per outgoing lane: south, east twice, north
    told = _junction(item, AgentLayout(10, 2), halves=True).movements
    assert told == (((0, 1), (3, 4), (7, 8)), ((1,), (4,), (9,)), ((2,), (5,), (9,)))


def test_structure_of_shipped_networks_fits_every_observation():
    for observation in ("count", "pressure", "movements"):
        env = parallel_env("mixed-v1", observation=observation, neighbours=1)
        agents, structure = AgentSet.of(env), Structure.of(env, "frap")
        assert structure is not None
        structure.checked(agents)
        for name, junction in zip(agents.names, structure.junctions, strict=True):
            layout = env.layouts[name]
            assert junction.first_phase == layout.features
            told = {at for kinds in junction.movements for own in kinds for at in own}
            assert told <= set(range(layout.features))
            assert all(any(row) for row in junction.greens)
    assert Structure.of(ToyTraffic(), "mlp") is None


def test_what_cannot_be_read_is_refused_with_the_way_out():
    with pytest.raises(OptionError, match=r"parallel_env, or the network 'mlp'"):
        DQN.of(ToyTraffic(), QUICK)
    env = parallel_env("single-v1")
    for wrapped in (frame_stack(env, 2), pad_spaces(parallel_env("mixed-v1"))):
        with pytest.raises(OptionError, match=r"network 'frap'"):
            DQN.of(wrapped, QUICK)
    for size in (2, 40):
        own = parallel_env("single-v1", observation=lambda _, n=size: np.zeros(n, np.float32))
        with pytest.raises(OptionError, match=r"'frap' cannot tell what .* function are"):
            DQN.of(own, QUICK)
    with pytest.raises(OptionError, match=r"network = 'frap' with the structure of 'mlp'"):
        DQN(BOTH, QUICK)
    assert isinstance(learner_factory("dqn", dqn=QUICK)(env, 1), DQN)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"network": "lstm"}, "network is 'lstm'; allowed: mlp, frap, colight"),
        ({"network": "frap", "hidden": (8,)}, "hidden = .*two sizes"),
        ({"network": "frap", "shared": True}, "shared = True: must be left away"),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, Any], told: str):
    with pytest.raises(OptionError, match=rf"DQNConfig[. ]{told}"):
        DQNConfig(**settings)


# --- what it learns, and how it is kept --------------------------------------------------------


def toy_structure() -> Structure:
    """Phase k of `ToyTraffic` serves lanes k and k + 1."""

    def junction(lanes: int) -> Junction:
        greens = tuple(
            tuple(float(m in (p, p + 1)) for m in range(lanes)) for p in range(lanes - 1)
        )
        return Junction(tuple(((m,),) for m in range(lanes)), greens, lanes)

    return Structure("frap", (junction(4), junction(3), junction(4)))


def played(env: ToyTraffic, act: Any) -> float:
    rewards: list[float] = []
    for seed in range(900, 910):
        observations, infos = env.reset(seed=seed)
        while env.agents:
            observations, reward, _, _, infos = env.step(act(observations, infos))
            rewards += reward.values()
    return float(np.mean(rewards))


def test_learns_toy_traffic_as_well_as_the_rule_that_knows_it():
    env = ToyTraffic(steps=40)

    def rule(observations: Any, infos: Any) -> dict[str, int]:
        chosen: dict[str, int] = {}
        for agent, layout in env.layouts.items():
            queue = observations[agent][: layout.features]
            served = np.minimum(queue, 3 / 20) + 1e-3 * queue
            chosen[agent] = int((served[:-1] + served[1:])[: layout.phases].argmax())
        return chosen

    learner = DQN(AgentSet.of(env), QUICK, 0, structure=toy_structure())
    policy = learner.learn(env, 20, seed=0)
    assert played(env, policy.act) > 1.2 * played(env, rule)  # random phases: 3.3 times


def test_resume_equals_an_unbroken_run_and_policies_survive(tmp_path: Path):
    env = ToyTraffic()

    def fresh(seed: int) -> DQN:
        return DQN(AgentSet.of(env), QUICK, seed, structure=toy_structure())

    unbroken = fresh(5).learn(env, 8, seed=1)
    first, second = fresh(5), fresh(77)
    first.learn(env, 5, seed=1)
    first.save(tmp_path / "dqn.pt")
    second.load(tmp_path / "dqn.pt")
    assert np.array_equal(second.learn(env, 3, seed=1).parameters, unbroken.parameters)
    unbroken.save(tmp_path / "policy.pt")
    observations, _ = env.reset(seed=7)
    for copy in (NetworkPolicy.load(tmp_path / "policy.pt"), pickle.loads(pickle.dumps(unbroken))):  # noqa: S301
        assert copy.structure == toy_structure()
        for agent, values in q_values(unbroken, observations).items():
            assert np.array_equal(q_values(copy, observations)[agent], values)


def test_checkpoints_of_other_networks_or_intersections_are_refused(tmp_path: Path):
    agents = AgentSet.of(ToyTraffic())
    mine = DQN(agents, QUICK, 0, structure=toy_structure())
    mine.save(tmp_path / "frap.pt")
    DQN(agents, DQNConfig(hidden=QUICK.hidden)).save(tmp_path / "mlp.pt")
    untouched = mine.policy().parameters
    with pytest.raises(CheckpointError, match=r"its network are|its network is"):
        mine.load(tmp_path / "mlp.pt")
    with pytest.raises(CheckpointError, match=r"network"):
        DQN(agents, DQNConfig(hidden=QUICK.hidden)).load(tmp_path / "frap.pt")
    turned = toy_structure()
    first = replace(turned.junctions[0], greens=turned.junctions[0].greens[::-1])
    other = replace(turned, junctions=(first, *turned.junctions[1:]))
    with pytest.raises(CheckpointError, match=r"other movements, phases or neighbours"):
        DQN(agents, QUICK, 0, structure=other).load(tmp_path / "frap.pt")
    assert np.array_equal(mine.policy().parameters, untouched)


def test_a_policy_file_with_a_broken_structure_is_refused(tmp_path: Path):
    agents, path = AgentSet.of(ToyTraffic()), tmp_path / "policy.pt"
    DQN(agents, QUICK, 0, structure=toy_structure()).policy().save(path)
    whole = torch.load(path, weights_only=True)
    for junction in (
        {"movements": (((9,),),) * 4},  # no such place
        {"greens": whole["structure"]["junctions"][0]["greens"][:2]},  # a phase is missing
        {"greens": ((float("nan"),) * 4,) * 3},
        {"movements": ()},
        {"first_phase": "here"},
        {"vehicles": (1.0,)},  # not one for each feature
        {"commands": (3,)},  # the others show none
        {"interval_s": -10.0},
    ):
        first, *rest = whole["structure"]["junctions"]
        structure = {"network": "frap", "junctions": ({**first, **junction}, *rest)}
        torch.save({**whole, "structure": structure}, path)
        with pytest.raises(CheckpointError, match=r"policy\.pt: (not a whole policy|.* holds NaN)"):
            NetworkPolicy.load(path)


def test_exports_of_equal_weights_at_other_junctions_are_two_policies(tmp_path: Path):
    agents, structure = AgentSet.of(ToyTraffic()), toy_structure()
    first, *rest = structure.junctions
    other = replace(structure, junctions=(replace(first, greens=first.greens[::-1]), *rest))
    sums: set[str] = set()
    for number, one in enumerate((structure, structure, other)):
        policy = DQN(agents, QUICK, 0, structure=one).policy()
        about = export_policy(policy, tmp_path / f"policy{number}.ts")
        sums.add(json.loads(about.read_text())["parameters"])
    assert len(sums) == 2


def test_it_is_exported_to_torchscript_and_refused_elsewhere(tmp_path: Path):
    env = ToyTraffic()
    policy = DQN(AgentSet.of(env), QUICK, 0, structure=toy_structure()).policy()
    known = importlib.util.find_spec("onnx") is not None
    for suffix in (".npz", ".onnx") if known else (".npz",):
        with pytest.raises(OptionError, match=r"'frap' .* export it to \.ts"):
            export_policy(policy, tmp_path / f"policy{suffix}")
    assert not list(tmp_path.iterdir())
    export_policy(policy, tmp_path / "policy.ts")
    model: Any = torch.jit.load(str(tmp_path / "policy.ts"))
    for seed in range(20):
        observations, infos = env.reset(seed=seed)
        while env.agents:
            stacked, allowed = policy.agents.stack(observations), policy.agents.masks(infos)
            actions = policy.act(observations, infos)
            given = model(torch.from_numpy(stacked), torch.from_numpy(allowed))
            assert given.tolist() == list(actions.values())
            observations, _, _, _, infos = env.step(actions)
