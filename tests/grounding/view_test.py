"""What f and h see beside their own state, number by number: from a log and in an episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import torch

from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.envs import parallel_env
from ugat_marl.errors import CheckpointError, LogError, OptionError
from ugat_marl.experiments import TransferConfig, transfer
from ugat_marl.grounding import (
    FitConfig,
    Fitter,
    GateConfig,
    GroundedEnv,
    InputsConfig,
    InverseConfig,
    PhaseTransform,
    RunState,
    Stack,
    TimedConfig,
    TimedTransform,
    Ugat,
    UgatConfig,
    neighbours_of,
    stack_log,
)
from ugat_marl.grounding.fitting import OffData
from ugat_marl.grounding.forward import ForwardConfig
from ugat_marl.grounding.view import Moment, View
from ugat_marl.policies import observer_of, roll_out
from ugat_marl.scenarios import within_hops
from ugat_marl.seeding import torch_generator

LAYOUTS = {"a_0": AgentLayout(2, 3, 1), "b_0": AgentLayout(1, 2), "c_0": AgentLayout(3, 2)}
ROW = {"a_0": ("b_0",), "b_0": ("a_0", "c_0"), "c_0": ("b_0",)}
STACK = Stack(LAYOUTS)
SHAPES = {
    "forward": ForwardConfig(hidden=(16,)),
    "inverse": InverseConfig(hidden=(16,), embedding=8),
}


def observed(seed: int, phases: Mapping[str, int]) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    rows = {agent: rng.random(layout.size, np.float32) for agent, layout in LAYOUTS.items()}
    for agent, layout in LAYOUTS.items():
        lit = slice(layout.features, layout.features + layout.phases)
        rows[agent][lit] = np.eye(layout.phases)[phases[agent]]
    return rows


def recorded(clock: list[tuple[int, int]], delayed: bool = False) -> TransitionLog:
    """Phases and numbers at random; every number tells when it was seen."""
    recorder = TransitionRecorder(Provenance("x", "", "sim", (0,), 10.0, "count", LAYOUTS))
    rng = np.random.default_rng(0)
    shown = dict.fromkeys(LAYOUTS, 0)
    for place, (episode, step) in enumerate(clock):
        executed = {a: int(rng.integers(v.phases)) for a, v in LAYOUTS.items()}
        asked = {a: int(rng.integers(v.phases)) for a, v in LAYOUTS.items()}
        held = {a: float(rng.integers(3)) * (executed[a] != shown[a] and delayed) for a in LAYOUTS}
        now, then = observed(place, shown), observed(place + 1, executed)
        reward = dict.fromkeys(LAYOUTS, 0.0)
        recorder.record(episode, step, now, asked, executed, reward, then, held)
        shown = executed
    return recorder.log()


# --- what is seen


def test_by_default_a_model_sees_what_it_saw_before() -> None:
    view, data = View(STACK), stack_log(recorded([(0, 0), (0, 1)]), STACK)
    assert view.of(data) is data.observation
    assert view.seen(data.observation, data.executed) is data.observation
    assert view.sizes == STACK.sizes and not view.joint


def test_by_default_models_begin_and_fit_as_they_did_before_there_were_inputs() -> None:
    """Sums noted when models saw nothing but their own state."""
    layouts = {"a_0": AgentLayout(6, 3), "b_0": AgentLayout(4, 2, 2)}
    shapes = {
        "forward": ForwardConfig(hidden=(32, 32)),
        "inverse": InverseConfig(hidden=(32, 32), embedding=16),
    }
    made = TimedTransform(layouts, 0, **shapes)
    weights = {
        made.forward: ("network.layers.0.weight", 115.72069046189426),
        made.simulated: ("network.layers.0.weight", 131.4217741843313),
        made.inverse: ("net.encoders.layers.0.weight", 145.02151216869242),
    }
    for model, (name, total) in weights.items():
        assert float(model.state_dict()[name].double().abs().sum()) == total


def test_own_numbers_then_earlier_ones_then_neighbours_by_hand() -> None:
    view = View(STACK, 2, {"b_0": ("c_0", "a_0")})
    before, now = observed(1, {"a_0": 2, "b_0": 1, "c_0": 0}), observed(2, dict.fromkeys(ROW, 1))
    ran, running = torch.tensor([[1], [0], [1]]), torch.tensor([[2], [0], [1]])
    asked = torch.tensor([[0], [1], [0]])  # the street ran something else: a late command
    stacked = STACK.observations(now)
    seen = view.seen(stacked, running, [Moment(STACK.observations(before), ran, asked)])
    wanted = [
        *now["b_0"],
        *(*before["b_0"], 1, 0, 0, 1),  # what ran, what was asked for
        *(*now["c_0"], 0, 1),
        *(*now["a_0"][:5], 0, 0, 1),  # features and phase; its context is somebody else's
    ]
    assert seen[1, 0, : len(wanted)].tolist() == pytest.approx(wanted)
    assert view.sizes == [6 + 6 + 6, len(wanted), 5 + 5 + 4] and view.width == len(wanted)
    assert not seen[0, 0, 18:].any() and not seen[2, 0, 14:].any()
    lit = [False, True, True] * 2 + [True] * 4 + [False] * 3 + [True] * 4 + [False] * 2 + [True] * 6
    assert view.lights[1, 0].tolist() == lit


def test_where_nothing_was_before_the_oldest_stands_in_without_a_phase() -> None:
    view = View(STACK, 4)
    log = recorded([(0, 0), (0, 1), (0, 2), (0, 5), (1, 6), (1, 7)])
    data = stack_log(log, STACK)
    seen, own = view.of(data)[2], data.observation[2]
    moments = [seen[:, start : start + 5] for start in (0, 5, 14, 23)]
    # Row 3 comes after a gap, row 4 begins an episode.
    for moment, rows in zip(
        moments,
        [[0, 1, 2, 3, 4, 5], [0, 0, 1, 3, 4, 4], [0, 0, 0, 3, 4, 4], [0, 0, 0, 3, 4, 4]],
        strict=True,
    ):
        assert torch.equal(moment, own[rows, :5])
    for offset, phases in ((0, data.executed[2]), (2, data.asked[2])):
        known = torch.nn.functional.one_hot(phases, 2).float()
        for start, lag, rows in ((10, 1, [1, 2, 5]), (19, 2, [2]), (28, 3, [])):
            lights = seen[:, start + offset : start + offset + 2]
            assert torch.equal(lights[rows], known[[row - lag for row in rows]])
            assert not lights[[row for row in range(6) if row not in rows]].any()


def test_a_row_of_the_log_is_what_an_episode_shows_at_that_step() -> None:
    view = View(STACK, 3, ROW)
    data = stack_log(recorded([(0, k) for k in range(6)]), STACK)
    earlier: list[Moment] = []
    for k in range(6):
        now, ran = data.observation[:, k : k + 1], data.executed[:, k : k + 1]
        assert torch.equal(view.seen(now, ran, earlier), view.of(data)[:, k : k + 1])
        earlier.insert(0, Moment(now, ran, data.asked[:, k : k + 1]))


class Cycling:
    """Each agent at a pace of its own, so that minimum greens get in the way of some."""

    env_options: Mapping[str, Any] = {}

    def reset(self, seed: int) -> None:
        self._decision = seed

    def act(self, observations: Mapping[str, Any], infos: Any) -> dict[str, int]:
        self._decision += 1
        return {a: self._decision // (1 + i % 3) % 2 for i, a in enumerate(observations)}


def test_an_episode_in_sumo_shows_the_models_what_its_log_will_show_them() -> None:
    """Grounded at the same time, everyone's f was last fed the phases that then ran upstream."""
    env = parallel_env("grid2x2-v1", duration_s=300)
    made = PhaseTransform(
        env.layouts,
        0,
        **SHAPES,
        gate=GateConfig(mode="static", static_alpha=0.999),
        inputs=InputsConfig(history=4, hops=1),
        neighbours=neighbours_of(env),
    )
    made.forward.fitted.fill_(True)
    made.inverse.fitted.fill_(True)
    fed: list[list[torch.Tensor]] = []
    predict, grounded = made.forward.predict, GroundedEnv(env, made)
    ground, changed = made.ground, []

    def noticed(seen: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        fed[-1].append(seen)
        return predict(seen, action)

    def begun(observations: Any, actions: Any, *others: Any) -> Any:
        fed.append([])
        outcome = ground(observations, actions, *others)
        changed.append((outcome.executed != actions).any())
        return outcome

    made.forward.predict, made.ground = noticed, begun
    try:
        for seed in (1, 2):  # the second begins without memories of the first
            fed.clear()
            log = roll_out(grounded, Cycling(), seed, record=observer_of(env)).log
            data = stack_log(log, made.stack)
            assert torch.equal(
                torch.cat([passes[-1] for passes in fed], 1), made.forward.view.of(data)
            )
            assert torch.equal(made.local.of(data), View(made.stack, near=made.local.near).of(data))
    finally:
        env.close()
    assert any(changed)
    assert any(not torch.equal(passes[0], passes[-1]) for passes in fed)


# --- who is near


def test_neighbours_are_those_within_some_roads_nearest_first() -> None:
    ring = {"a": ("b", "e"), "b": ("a", "c"), "c": ("b", "d"), "d": ("c", "e"), "e": ("d", "a")}
    assert within_hops(ring, 0)["a"] == ()
    assert within_hops(ring, 1)["a"] == ("b", "e")
    assert within_hops(ring, 2)["a"] == ("b", "e", "c", "d") == within_hops(ring, 9)["a"]
    assert within_hops(ring, 10**12) == within_hops(ring, 2)
    assert within_hops({"a": (), "b": ()}, 3) == {"a": (), "b": ()}


def test_an_environment_knows_its_neighbours_by_the_names_of_its_agents() -> None:
    env = parallel_env("arterial1x5-v1")
    found = neighbours_of(env)
    assert set(found) == set(env.possible_agents)
    assert sorted(map(len, found.values())) == [1, 1, 2, 2, 2]
    for agent, near in found.items():
        assert all(agent in found[other] for other in near)
    ends = [agent for agent, near in found.items() if len(near) == 1]
    assert (
        ends[1] not in within_hops(found, 3)[ends[0]] and ends[1] in within_hops(found, 4)[ends[0]]
    )


@pytest.mark.parametrize(
    ("options", "neighbours", "complaint"),
    [
        ({"history": 0}, None, "inputs history is 0; allowed: >= 1"),
        ({"hops": -1}, None, "inputs hops is -1"),
        ({"hops": 1}, None, "hops is 1, but nobody says who is near whom; .*neighbours_of"),
        ({"hops": 1}, {"a_0": ("b_0",)}, r"differ in \['c_0'\]"),
        ({"hops": 1}, {**ROW, "c_0": ("x_0",)}, r"differ in \['x_0'\]"),
    ],
)
def test_impossible_inputs_are_refused(options: dict, neighbours: Any, complaint: str) -> None:
    def made(grounding: Any) -> None:
        UgatConfig(grounding, inputs=InputsConfig(**options)).transform(LAYOUTS, 0, neighbours)

    for grounding in ("phase", "timed"):
        with pytest.raises(OptionError, match=complaint):
            made(grounding)


def test_agents_recorded_at_different_times_have_no_neighbours_but_a_past() -> None:
    log = recorded([(0, k) for k in range(4)])
    frame = log.frame.filter(~((pl.col("agent") == "b_0") & (pl.col("step") == 2)))
    data = stack_log(TransitionLog(log.provenance, frame), STACK)
    assert View(STACK, 3).of(data).shape == (3, 4, 30)
    with pytest.raises(LogError, match=r"rows of b_0 at other times than of a_0.*hops at 0"):
        View(STACK, 1, ROW).of(data)


# --- models that see more


def test_checkpoints_know_what_their_models_saw(tmp_path: Path) -> None:
    inputs = InputsConfig(history=2, hops=1)

    def made(how: InputsConfig, near: Any = ROW) -> PhaseTransform:
        return PhaseTransform(LAYOUTS, 0, **SHAPES, inputs=how, neighbours=near)

    one = made(inputs)
    one.save(tmp_path / "x.pt")
    made(inputs).load(tmp_path / "x.pt")
    elsewhere = {**ROW, "a_0": ("c_0",), "c_0": ("a_0",), "b_0": ()}
    for other in (made(InputsConfig()), made(InputsConfig(3, 1)), made(inputs, elsewhere)):
        with pytest.raises(CheckpointError, match=r"x.pt: .* see .*'history': 2, 'hops': 1"):
            other.load(tmp_path / "x.pt")
    made(InputsConfig()).save(tmp_path / "plain.pt")
    with pytest.raises(CheckpointError, match="use the same inputs"):
        one.load(tmp_path / "plain.pt")
    incomplete = made(InputsConfig()).state_dict()
    del incomplete["inputs"]
    with pytest.raises(CheckpointError, match="use the same inputs"):
        made(InputsConfig()).load_state_dict(incomplete)


def test_off_the_data_phases_of_neighbours_stay_phases() -> None:
    view = View(STACK, 1, ROW)
    data = stack_log(recorded([(0, k) for k in range(20)]), STACK)
    inputs = torch.nn.functional.pad(view.of(data), (0, 3))  # some change behind it
    drawn = OffData.around(inputs, data.weight, view).draw(50, torch_generator(0), 1.0)
    lit = torch.nn.functional.pad(view.lights, (0, 3)).expand_as(drawn)
    assert set(drawn[lit].tolist()) == {0.0, 1.0}
    own = drawn[1, :, : view.sizes[1]][:, ~view.lights[1, 0, : view.sizes[1]]]
    assert not set(own.flatten().tolist()) & {0.0, 1.0}


def test_observed_rows_are_those_of_the_agent_itself() -> None:
    """The agents have no row in common, and the second one has fewer."""
    view = View(STACK, 1, ROW)
    data = stack_log(recorded([(0, k) for k in range(20)]), STACK)
    number = torch.arange(20.0).expand(3, -1)[..., None]
    inputs = torch.cat([view.of(data), number, number], 2)
    own = [set(range(0, 20, 2)), {1, 3, 5}, {7}]
    weight = torch.tensor([[float(k in rows) for k in range(20)] for rows in own])
    kept = torch.zeros(3, 1, inputs.shape[-1], dtype=torch.bool)
    kept[..., -1] = True
    off_data = OffData.around(inputs, weight, view, kept)
    drawn = off_data.draw(400, torch_generator(0), 1.0)[..., -1]
    assert [set(map(int, rows.tolist())) for rows in drawn] == own


@pytest.mark.parametrize("grounding", ["phase", "timed"])
def test_both_groundings_fit_and_ground_with_all_inputs(grounding: Any) -> None:
    timed = TimedConfig(most_s=2)
    config = UgatConfig(grounding, inputs=InputsConfig(3, 2), **SHAPES, timed=timed)
    made = config.transform(LAYOUTS, 0, ROW)
    clock = [(episode, step) for episode in range(2) for step in range(40)]
    log, brief = recorded(clock, delayed=grounding == "timed"), FitConfig(epochs=2)
    if isinstance(made, TimedTransform):
        report = made.fit(log, log, Fitter(brief, seed=0))
    else:
        report = made.fit(log, log, Fitter(brief, seed=0))
    assert all(np.isfinite(report.forward.error))
    assert made.forward.standardise.mean.shape[-1] == made.forward.view.width > STACK.width
    data = stack_log(log, STACK)
    now, own = data.observation[:, :1], np.array([1, 1, 1])
    past = [Moment(data.observation[:, 5:6], data.executed[:, 5:6], data.asked[:, 5:6])]
    outcomes = [made(now, own), made(now, own, earlier=past)]
    assert outcomes[0].u.tolist() != outcomes[1].u.tolist()
    other = dataclasses.replace(data, executed=data.executed.roll(1, 1))
    assert not torch.equal(made.local.of(data), made.local.of(other))


@pytest.mark.slow
def test_a_run_finds_the_neighbours_by_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class ResetResult(Exception):
        pass

    def begun(_ugat: Ugat, state: RunState) -> None:
        raise ResetResult(state.transform)

    monkeypatch.setattr(Ugat, "train", begun)
    config = TransferConfig(
        "grid2x2-v1", ugat=UgatConfig("phase", inputs=InputsConfig(history=2, hops=1))
    )
    with pytest.raises(ResetResult) as told:
        transfer(config, tmp_path / "run")
    (made,) = told.value.args
    near = made.local.near
    assert made.forward.view.history == 2 and made.forward.view.near == near
    assert len(near) == 4 and all(len(others) == 2 for others in near.values())
    assert all(agent in near[other] for agent, others in near.items() for other in others)
