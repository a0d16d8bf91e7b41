"""The network "universal" without torch: the same values and actions, and wrong arrays refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.policies.export_test import exported, inputs, page_loader
from tests.runs import q_values
from ugat_marl.envs import AgentSet, parallel_env
from ugat_marl.errors import CheckpointError
from ugat_marl.policies import (
    DQN,
    UNIVERSAL_NAME,
    NetworkPolicy,
    NumpyPolicy,
    observed_options,
    suite_config,
)
from ugat_marl.policies.export import _sum_of, portable_network
from ugat_marl.policies.networks.q_network import q_network
from ugat_marl.policies.networks.structure import Junction, Structure
from ugat_marl.policies.portable import PortableUniversal

HIDDEN = (6, 5)
SIZES = {
    "one": ([(5, 4)], 1, 2),
    "unequal": ([(8, 4), (3, 2), (6, 8)], 1, 4),
    "movements": ([(4, 3), (8, 2)], 3, 1),
    "no memory": ([(4, 2), (2, 3), (4, 2), (7, 5)], 1, 0),
}
"""Lanes and phases of each agent, kinds of numbers of a movement, and remembered commands."""

Sizes = tuple[list[tuple[int, int]], int, int]


def junction(lanes: int, phases: int, kinds: int, commands: int, seed: int) -> Junction:
    """An intersection with a movement for each lane, and one more that shares two lanes."""
    rng = np.random.default_rng(seed)
    features = lanes * kinds
    places = [*((lane,) for lane in range(lanes)), (0, lanes - 1)]
    memory = features + phases
    return Junction(
        movements=tuple(
            tuple(tuple(at + kind * lanes for at in places_) for kind in range(kinds))
            for places_ in places
        ),
        greens=tuple(map(tuple, rng.random((phases, len(places))).round(2).tolist())),
        first_phase=features,
        vehicles=tuple(rng.uniform(5, 40, features).tolist()),
        commands=tuple(memory + lag * phases for lag in range(commands)),
        age=memory + commands * phases if commands else None,
        interval_s=10.0,
        clearance_s=float(rng.integers(2, 6)),
    )


def universal_policy(sizes: Sizes, ceiling: bool = False) -> NetworkPolicy:
    """A policy of random weights, drawn wider than a learner begins with."""
    rows, kinds, commands = sizes
    agents = AgentSet(
        tuple(f"agent_{place}" for place in range(len(rows))),
        tuple(n * kinds + p * (1 + commands) + (commands > 0) for n, p in rows),
        tuple(phases for _, phases in rows),
    )
    junctions = tuple(junction(n, p, kinds, commands, at) for at, (n, p) in enumerate(rows))
    structure = Structure("universal", junctions).checked(agents)
    network = q_network(agents, HIDDEN, False, torch.Generator(), structure)
    rng = np.random.default_rng(7)
    count = sum(parameter.numel() for parameter in network.parameters())
    weights = rng.normal(size=count).astype(np.float32)
    limit = rng.uniform(0, 1, (len(agents), agents.widest_observation)).astype(np.float32)
    held = limit if ceiling else None
    return NetworkPolicy(agents, HIDDEN, weights, {}, False, structure, held)


# --- the same values and actions -----------------------------------------------------------------


@pytest.mark.parametrize("ceiling", [False, True])
@pytest.mark.parametrize("sizes", SIZES.values(), ids=[*SIZES])
def test_numpy_has_the_values_of_torch(sizes: Sizes, ceiling: bool) -> None:
    policy = universal_policy(sizes, ceiling)
    numpy_policy = NumpyPolicy(policy.agents, portable_network(policy), {})
    rng = np.random.default_rng(1)
    for _ in range(20):
        observations, _ = inputs(rng, policy.agents)
        values = numpy_policy.values(policy.agents.stack(observations))
        for row, own in zip(values, q_values(policy, observations).values(), strict=True):
            np.testing.assert_allclose(row[: own.size], own, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("suffix", [".npz", ".onnx", ".ts"])
@pytest.mark.parametrize("ceiling", [False, True])
@pytest.mark.parametrize("sizes", SIZES.values(), ids=[*SIZES])
def test_random_inputs_give_the_same_actions(
    sizes: Sizes, ceiling: bool, suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = universal_policy(sizes, ceiling)
    path = exported(policy, suffix, tmp_path)
    assert json.loads(path.with_suffix(".json").read_text())["network"] == "universal"
    act = page_loader(suffix, tmp_path, monkeypatch)
    rng = np.random.default_rng(0)
    taken: set[tuple[int, ...]] = set()
    for _ in range(100):
        observations, infos = inputs(rng, policy.agents)
        actions = policy.act(observations, infos)
        assert act(observations, infos) == actions
        taken.add(tuple(actions.values()))
    assert len(taken) > 2  # the observations mattered


@pytest.mark.parametrize("suffix", [".npz", ".onnx"])
def test_an_episode_with_the_weights_of_the_package_is_the_same(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = parallel_env("mixed-v1", **observed_options(UNIVERSAL_NAME), duration_s=300.0)
    policy = DQN.of(env, suite_config(UNIVERSAL_NAME)).policy()
    exported(policy, suffix, tmp_path, env)
    act = page_loader(suffix, tmp_path, monkeypatch)
    observations, infos = env.reset(seed=1)
    while env.agents:
        actions = policy.act(observations, infos)
        assert act(observations, infos) == actions
        observations, _, _, _, infos = env.step(actions)
    env.close()


# --- damage --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ceiling", *PortableUniversal.SHAPES])
def test_arrays_that_do_not_fit_are_refused(name: str) -> None:
    policy = universal_policy(SIZES["unequal"], ceiling=True)
    arrays = dict(portable_network(policy).arrays)
    array = arrays[name]
    wrong: list[Any] = [array * np.nan, array + np.inf, array.astype(np.float64), array[None]]
    for axis in range(array.ndim):
        first = array.take([0], axis)
        wrong += [np.concatenate((array, first), axis), array.take([], axis)]
    for other in wrong:
        with pytest.raises(
            ValueError, match=name.replace(".", r"\.") + "|numbers of a movement|not"
        ):
            NumpyPolicy(policy.agents, PortableUniversal({**arrays, name: other}), {})
    rest = {key: array for key, array in arrays.items() if key != name}
    if name != "ceiling":
        with pytest.raises(ValueError, match=f"lacking or too many: {name}"):
            NumpyPolicy(policy.agents, PortableUniversal(rest), {})


def test_other_agents_and_unknown_arrays_are_refused() -> None:
    policy = universal_policy(SIZES["unequal"])
    network, others = portable_network(policy), universal_policy(SIZES["movements"]).agents
    with pytest.raises(
        ValueError, match=r"inputs of shape \(3, 47, 54\), not \(agents 2, width 29"
    ):
        NumpyPolicy(others, network, {})
    odd = PortableUniversal({**network.arrays, "odd": network.arrays["facts"]})
    with pytest.raises(ValueError, match="too many: odd"):
        NumpyPolicy(policy.agents, odd, {})


def test_files_that_name_another_network_are_refused(tmp_path: Path) -> None:
    path = exported(universal_policy(SIZES["one"]), ".npz", tmp_path)
    assert NumpyPolicy.load(path).agents.names == ("agent_0",)
    side_car = path.with_suffix(".json")
    about = json.loads(side_car.read_text().replace('"universal"', '"mlp"'))
    about["sha256"][".json"] = _sum_of(about)
    side_car.write_text(json.dumps(about))
    with pytest.raises(CheckpointError, match=r"lacking or too many.*export it again"):
        NumpyPolicy.load(path)
