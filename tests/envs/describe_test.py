"""What tells a newcomer about an environment: its description, its keywords, its errors."""

from __future__ import annotations

import inspect
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import polars as pl
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

import ugat_marl
from ugat_marl.envs import EnvOptions, IntersectionView, SingleEnv
from ugat_marl.envs.options import EnvKeywords
from ugat_marl.envs.registration import SINGLE
from ugat_marl.errors import CheckpointError, OptionError, UnknownNameError
from ugat_marl.policies import DQN, DQNConfig
from ugat_marl.scenarios.phases import programme_phases


def two(view: IntersectionView) -> NDArray[np.float64]:
    """All vehicles on the incoming lanes, and the longest queue in tens."""
    return np.array([view.vehicles.sum(), 10 * view.halting.max()])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"observation": "movements", "commands": 2},
        {"neighbours": 1, "observation": "pressure"},
        {"observation": two, "neighbours": 1, "commands": 1},
    ],
)
def test_every_number_of_an_observation_is_described(options: dict[str, Any]) -> None:
    env = ugat_marl.parallel_env("mixed-v1", **options)
    table = env.describe().observation
    for agent in env.possible_agents:
        rows = table.filter(pl.col("agent") == agent)
        assert rows["entry"].to_list() == list(range(env.observation_space(agent).shape[0]))


def test_lanes_stand_where_their_numbers_are() -> None:
    env = ugat_marl.parallel_env("mixed-v1", observation="movements")
    described = env.describe()
    seen, _ = env.reset(seed=1)
    for _ in range(20):
        seen, *_ = env.step(dict.fromkeys(env.agents, 0))
    lanes = env.network.lane_table()
    counts = {"halting vehicles": env.snapshot.halting, "vehicles, incoming": env.snapshot.vehicles}
    compared = 0
    for row in described.observation.to_dicts():
        if row["shows"] in counts:
            (place,) = lanes.indices([row["name"]])
            expected = counts[row["shows"]][place] / lanes.storage_veh[place]
            assert seen[row["agent"]][row["entry"]] == pytest.approx(min(expected, 1.0), abs=1e-6)
            compared += expected > 0
    assert compared > 20
    env.close()


def test_phases_are_described_by_their_movements() -> None:
    env = ugat_marl.parallel_env("single-v1")
    phases = env.describe().phases
    (light,) = env.network.intersections
    for phase, state in enumerate(light.phases):
        rows = phases.filter(pl.col("phase") == phase)
        green = {link.from_lane for link in light.links if state[link.index] in "Gg"}
        assert set(" ".join(rows["lanes"]).split()) == green
        protected = rows.filter(pl.col("right_of_way") == "protected")
        assert (protected.height > 0) == ("G" in state)
    assert set(phases["turn"]) <= {"left", "through", "right", "turn-around"}
    text = str(env.describe())
    assert "…" not in text and light.phases and light.incoming_lanes[-1] in text
    assert f"ugat-marl scenario draw {env.unwrapped.scenario.id} --out pictures" in text


def test_phases_say_which_green_of_the_file_they_are(crossing: Callable[..., Path]) -> None:
    """Phases in another order than the file's."""
    folder = crossing()
    told = str(ugat_marl.parallel_env(folder).describe())  # a folder has no name that commands know
    assert "scenario draw FOLDER_OR_SUMOCFG --out pictures" in told
    network = ugat_marl.parallel_env(folder).network
    (light,) = network.intersections
    greens = programme_phases(light.programme)
    assert len(greens) == 2
    file = folder / "scenario.toml"
    phases = ", ".join(f'"{state}"' for state in reversed(greens))
    file.write_text(file.read_text() + f"\n[intersections.{light.id}]\nphases = [{phases}]\n")
    described = ugat_marl.parallel_env(folder).describe().phases
    assert dict(described.select("phase", "green_of_file").unique().iter_rows()) == {0: 1, 1: 0}


def test_phases_that_the_file_has_not_are_none_of_its_greens() -> None:
    described = ugat_marl.parallel_env("single-v1").describe().phases
    numbers = dict(described.select("phase", "green_of_file").unique().iter_rows())
    # greens of the file, with its yellows left out: 0 and 1 from north and south, 2 and 3 from east
    # and west; right turns go on in most phases, which the file lets them in none
    assert numbers == {0: 0, 1: 2, **dict.fromkeys(range(2, 8))}


def test_a_function_is_an_observation() -> None:
    env = ugat_marl.parallel_env("grid2x2-v1", observation=two)
    seen, _ = env.reset(seed=1)
    lanes = env.network.lane_table()
    for _ in range(8):
        for agent, vector in seen.items():
            assert env.observation_space(agent).contains(vector)
            item = env.network.intersection(env.intersection_of[agent])
            incoming = lanes.indices(item.incoming_lanes)
            assert vector[0] == env.snapshot.vehicles[incoming].sum()
            assert vector[1] == 10 * env.snapshot.halting[incoming].max()
            assert vector[2 + env.phases[env.possible_agents.index(agent)]] == 1
        seen, *_ = env.step(dict.fromkeys(env.agents, 1))
    env.close()


def test_workers_of_a_vector_import_the_function() -> None:
    vector = ugat_marl.vector_env("single-v1", 2, observation=two, duration_s=100.0)
    first = vector.reset(seed=3).observations[0, 0]
    vector.close()
    env = ugat_marl.parallel_env("single-v1", observation=two, duration_s=100.0)
    observations, _ = env.reset(seed=3)
    (second,) = observations.values()
    assert np.array_equal(first, second)
    env.close()


@pytest.mark.parametrize(
    ("function", "says"),
    [
        (lambda view: view.vehicles.reshape(1, -1), "shape (1,"),
        (lambda view: [float("nan")], "not finite"),
        (lambda view: None, "returned 'None'"),
        (lambda view: "text", "returned .text. .str.; it must return one row"),
    ],
)
def test_a_function_that_returns_no_row_is_refused(function: Any, says: str) -> None:
    with pytest.raises(OptionError, match=says.replace("(", r"\(")):
        ugat_marl.parallel_env("single-v1", observation=function)


def test_a_policy_of_a_function_is_not_written(tmp_path: Any) -> None:
    env = ugat_marl.parallel_env("single-v1", observation=two)
    policy = DQN.of(env, DQNConfig(), 0).policy()
    with pytest.raises(CheckpointError):
        policy.save(tmp_path / "policy.pt")


def test_keywords_are_shown_with_their_defaults_and_documented() -> None:
    options = {option.name: option for option in fields(EnvOptions)}
    assert set(EnvKeywords.__annotations__) == set(options)
    for function in (ugat_marl.parallel_env, ugat_marl.env, ugat_marl.vector_env):
        parameters = inspect.signature(function).parameters
        assert not [p for p in parameters.values() if p.kind is p.VAR_KEYWORD]
        for name, option in options.items():
            assert parameters[name].default == option.default
            assert f"    {name}: " in (function.__doc__ or "")
    wrong: dict[str, Any] = {"obsrevation": "count"}
    with pytest.raises(UnknownNameError, match="'observation'"):
        ugat_marl.parallel_env("single-v1", **wrong)
    wrong = {"domian": "V4"}
    with pytest.raises(UnknownNameError, match="Did you mean 'domain'"):
        ugat_marl.parallel_env("single-v1", **wrong)


def test_one_light_is_an_environment_of_gymnasium() -> None:
    for name in SINGLE:
        env = gymnasium.make(f"ugat_marl/{name}", domain="V4", duration_s=100.0)
        check_env(env.unwrapped, skip_render_check=True)
        env.reset(seed=4)
        same = ugat_marl.parallel_env(name, "V4", duration_s=100.0)
        same.reset(seed=4)
        (agent,) = same.possible_agents
        over = False
        while not over:
            seen, reward, ended, over, info = env.step(1)
            others, rewards, *_ = same.step({agent: 1})
            assert np.array_equal(seen, others[agent]) and reward == rewards[agent]
            assert not ended and info["action_mask"].shape == (env.action_space.n,)  # pyright: ignore[reportAttributeAccessIssue]
        light: Any = env.unwrapped
        assert str(light.describe()) == str(same.describe())
        assert light.scores() == same.scores()
        env.close()
        same.close()
    with pytest.raises(OptionError, match=r"has 4 intersections.*parallel_env"):
        SingleEnv("grid2x2-v1")


@pytest.mark.parametrize(
    "program",
    [
        'import gymnasium; light = gymnasium.make("ugat_marl:ugat_marl/single-v1")',
        'import gymnasium, ugat_marl; light = gymnasium.make("ugat_marl/single-v1")',
        'import gymnasium, ugat_marl; light = gymnasium.make("ugat_marl:ugat_marl/single-v1")',
        "import ugat_marl, gymnasium; "
        'light = gymnasium.make("ugat_marl.envs.single:ugat_marl/single-v1")',
        "import ugat_marl, gymnasium; ugat_marl.parallel_env; "
        'light = gymnasium.make("ugat_marl/single-v1")',
    ],
)
def test_gymnasium_finds_one_light_in_a_fresh_interpreter(program: str) -> None:
    code = f"{program}; print(light.unwrapped.parallel.scenario.id)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["single-v1"], done.stderr


def test_render_without_a_mode_warns() -> None:
    with pytest.warns(UserWarning, match='render_mode="rgb_array"'):
        assert ugat_marl.parallel_env("single-v1").render() is None


def test_phases_are_known_before_the_first_reset() -> None:
    env = ugat_marl.parallel_env("mixed-v1")
    before = env.phases
    env.reset(seed=1)
    assert before == env.phases and len(before) == len(env.possible_agents)
    env.close()
