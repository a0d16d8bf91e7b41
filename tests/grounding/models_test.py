"""Padded models of unequal intersections compute what each intersection's own model would."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.errors import LogError, OptionError
from ugat_marl.grounding import UNCERTAINTY_METHODS, InverseConfig, InverseModel, Stack, stack_log
from ugat_marl.grounding.forward import DelayedForward, ForwardConfig, ForwardModel
from ugat_marl.grounding.networks import FARTHEST, Standardiser
from ugat_marl.grounding.uncertainty import Method, MethodName
from ugat_marl.seeding import torch_generator

# One has the widest observation, another the most phases, a third the most features.
LAYOUTS = {
    "wide_0": AgentLayout(4, 2, 9),
    "many_0": AgentLayout(3, 6),
    "long_0": AgentLayout(8, 3, 1),
}
BATCH = 5


def drawn(layout: AgentLayout, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    here = torch.rand(BATCH, layout.size, generator=generator)
    there = torch.rand(BATCH, layout.size, generator=generator)
    return here, there, torch.randint(layout.phases, (BATCH,), generator=generator)


def stacked() -> tuple[Stack, torch.Tensor, torch.Tensor, torch.Tensor]:
    stack = Stack(LAYOUTS)
    rows = [drawn(layout, i) for i, layout in enumerate(LAYOUTS.values())]
    here, there = (
        torch.stack([nn.functional.pad(row[k], (0, stack.width - row[k].shape[1])) for row in rows])
        for k in (0, 1)
    )
    return stack, here, there, torch.stack([row[2] for row in rows])


def part_of(model: nn.Module, alone: nn.Module, agent: int, members: int = 1) -> None:
    """Copies one agent's share of the padded parameters into a model of that agent alone."""
    whole = model.state_dict()
    state = {}
    for name, own in alone.state_dict().items():
        source = whole[name]
        if name.startswith("net.head."):  # shared; the agent's phases of every member
            rows = own.shape[0] // members
            source = source.view(members, -1, *own.shape[1:])[:, :rows].reshape(own.shape)
        elif own.dim() >= 3 and len(source) >= len(LAYOUTS):  # the rest is shared
            each = source.view(-1, len(LAYOUTS), *source.shape[1:])[:, agent]
            source = each[..., : own.shape[-2], : own.shape[-1]]
        state[name] = source
    alone.load_state_dict(state)


@pytest.mark.parametrize("include_phase", [False, True])
def test_forward_models_together_equal_each_alone(include_phase: bool) -> None:
    stack, here, there, action = stacked()
    config = ForwardConfig(hidden=(16, 16), include_phase=include_phase)
    model = ForwardModel(stack, config, torch_generator(0))
    model.fit_scale(here, model.change(here, there), torch.ones(3, BATCH))
    together = model.predict(here, action)
    for i, (agent, layout) in enumerate(LAYOUTS.items()):
        alone = ForwardModel(Stack({agent: layout}), config, torch_generator(1))
        part_of(model, alone, i)
        own, _, act = drawn(layout, i)
        expected = alone.predict(own[None], act[None])[0]
        head = layout.features + layout.phases * include_phase
        assert expected.shape == (BATCH, head)
        assert torch.allclose(together[i, :, :head], expected, atol=1e-6)
        assert not together[i, :, head:].any()


@pytest.mark.parametrize("include_phase", [False, True])
@pytest.mark.parametrize("method", UNCERTAINTY_METHODS)
def test_inverse_models_together_equal_each_alone(include_phase: bool, method: MethodName) -> None:
    stack, here, there, _ = stacked()
    config = InverseConfig(hidden=(16, 16), embedding=8, include_phase=include_phase)
    how = Method(method, members=2, passes=4)
    model = InverseModel(stack, config, torch_generator(0), how)
    model.standardise.fit(model.inputs(here, there), torch.ones(3, BATCH))
    together = model.predict(here, there)
    for i, (agent, layout) in enumerate(LAYOUTS.items()):
        alone = InverseModel(Stack({agent: layout}), config, torch_generator(1), how)
        part_of(model, alone, i, model.net.members)
        own, following, _ = drawn(layout, i)
        expected = alone.predict(own[None], following[None])
        assert torch.allclose(together.u[i], expected.u[0], atol=1e-6)
        assert torch.equal(together.action[i], expected.action[0])
        own_classes = together.probability[i, :, : layout.phases]
        assert torch.allclose(own_classes, expected.probability[0], atol=1e-6)
        assert not together.probability[i, :, layout.phases :].any()
        assert torch.allclose(own_classes.sum(-1), torch.ones(BATCH))


def test_the_networks_of_f_predict_as_each_alone_and_together_as_their_mean() -> None:
    stack, here, _, action = stacked()
    config = ForwardConfig(hidden=(16,))
    model = ForwardModel(stack, replace(config, members=3), torch_generator(0))
    each = model.predict_each(here, action).unflatten(1, (3, BATCH))
    for member in range(3):
        alone = ForwardModel(stack, config, torch_generator(1))
        state = model.state_dict()
        for name, own in alone.state_dict().items():
            if name.startswith("network"):
                state[name] = state[name].view(3, *own.shape)[member]
        alone.load_state_dict(state)
        assert torch.allclose(each[:, member], alone.predict(here, action), atol=1e-6)
    assert torch.allclose(each.mean(1), model.predict(here, action), atol=1e-6)
    assert (each.std(1).amax((1, 2)) > 0.01).all()


def test_f_begins_as_a_model_of_the_simulation_without_delays() -> None:
    stack, here, there, action = stacked()
    config = ForwardConfig(hidden=(16,), members=2)
    delayed = DelayedForward(stack, config, 3, torch_generator(0))
    delayed.fit_scale(here, delayed.change(here, there), torch.ones(3, BATCH))
    f = ForwardModel(stack, config, torch_generator(1))
    f.begin_as(delayed)
    expected = delayed(here, action, delayed.extra(torch.zeros(3, BATCH))) * delayed.scale
    assert torch.allclose(f(here, action) * f.scale, expected, atol=1e-6)


@pytest.mark.parametrize("method", UNCERTAINTY_METHODS)
def test_an_intersection_with_its_own_head_learns_from_itself_alone(method: MethodName) -> None:
    stack, here, there, action = stacked()
    config = InverseConfig(hidden=(8,), embedding=5, head="own")
    h = InverseModel(stack, config, torch_generator(0), Method(method, members=2, passes=3))
    assert h.parts == 3 * h.net.members
    answer = h.predict(here, there)
    for i, layout in enumerate(LAYOUTS.values()):
        own = answer.probability[i, :, : layout.phases].sum(-1)
        assert torch.allclose(own, torch.ones(BATCH))
    wanted = h.predict(here, there).probability.gather(-1, action[..., None])
    wanted[1].log().sum().backward()
    weight = h.net.head.weight.grad
    assert weight is not None
    learnt = weight.view(h.net.members, 3, -1).abs().sum(-1)
    assert (learnt[:, 1] > 0).all() and not learnt[:, [0, 2]].any()


def test_an_agents_numbers_never_reach_another_agent() -> None:
    stack, here, there, action = stacked()
    f = ForwardModel(stack, ForwardConfig(), torch_generator(0))
    h = InverseModel(stack, InverseConfig(), torch_generator(0))
    other = here.clone()
    other[1] = torch.where(other[1] != 0, other[1] + 1.0, 0.0)
    for i in (0, 2):
        assert torch.equal(f.predict(here, action)[i], f.predict(other, action)[i])
        assert torch.equal(h.predict(here, there).u[i], h.predict(other, there).u[i])


def test_without_phase_the_inverse_model_does_not_see_the_next_phase() -> None:
    stack, here, there, _ = stacked()
    blind = InverseModel(stack, InverseConfig(), torch_generator(0))
    seeing = InverseModel(stack, InverseConfig(include_phase=True), torch_generator(0))
    other = there.clone()
    for i, layout in enumerate(LAYOUTS.values()):
        other[i, :, layout.features :] = 0.0  # phase and context of s'
    assert torch.equal(blind.predict(here, there).u, blind.predict(here, other).u)
    assert not torch.equal(seeing.predict(here, there).u, seeing.predict(here, other).u)


def test_an_untrained_forward_model_differs_by_action() -> None:
    stack, here, _, _ = stacked()
    f = ForwardModel(stack, ForwardConfig(), torch_generator(0))
    zero, one = (torch.full((3, BATCH), k) for k in (0, 1))
    assert not torch.allclose(f.predict(here, zero), f.predict(here, one))


def test_same_seed_same_weights_whatever_was_drawn_before() -> None:
    stack = Stack(LAYOUTS)
    torch.rand(7)
    one = InverseModel(stack, InverseConfig(), torch_generator(3)).state_dict()
    torch.rand(9)
    two = InverseModel(stack, InverseConfig(), torch_generator(3)).state_dict()
    assert one.keys() == two.keys()
    assert all(torch.equal(one[name], two[name]) for name in one)


def test_standardiser_ignores_rows_without_weight_and_leaves_constants_alone() -> None:
    scale = Standardiser(1, 3)
    rows = torch.tensor([[[0.0, 5.0, 0.0], [2.0, 5.0, 0.0], [99.0, 99.0, 0.0]]])
    scale.fit(rows, torch.tensor([[1.0, 1.0, 0.0]]))
    out = scale(rows)[0]
    assert out[:2].tolist() == [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    assert out[2].tolist() == [FARTHEST, FARTHEST, 0.0]


def log_of(steps: dict[str, int]) -> TransitionLog:
    provenance = Provenance("toy", "", "here", (), 10.0, "count", LAYOUTS, source="measured")
    recorder = TransitionRecorder(provenance)
    for step in range(max(steps.values())):
        here = {a: np.full(v.size, step, np.float32) for a, v in LAYOUTS.items()}
        zeros, ones = dict.fromkeys(LAYOUTS, 0), dict.fromkeys(LAYOUTS, 1)
        recorder.record(7, step, here, zeros, ones, zeros, {a: v + 1 for a, v in here.items()})
    log = recorder.log()
    kept = [row for row in log.frame.iter_rows(named=True) if row["step"] < steps[row["agent"]]]
    return TransitionLog(
        provenance, log.frame.clear().extend(type(log.frame)(kept, log.frame.schema))
    )


def test_agents_measured_for_different_times_are_padded_with_weight_zero() -> None:
    stack = Stack(LAYOUTS)
    data = stack_log(log_of({"wide_0": 4, "many_0": 2, "long_0": 3}), stack)
    assert data.weight.sum(1).tolist() == [4, 2, 3]
    assert data.episode[1].tolist() == [0, 0, -1, -1]
    assert data.observation[0, 2, : LAYOUTS["wide_0"].size].unique().tolist() == [2.0]
    assert not data.observation[1, :, LAYOUTS["many_0"].size :].any()
    assert data.asked[0].tolist() == [0] * 4 and data.executed[0].tolist() == [1] * 4


def test_a_log_of_other_agents_or_without_an_agent_is_refused() -> None:
    with pytest.raises(LogError, match="does not fit the models"):
        stack_log(log_of(dict.fromkeys(LAYOUTS, 2)), Stack({"wide_0": AgentLayout(4, 2, 9)}))
    with pytest.raises(LogError, match="no row of many_0"):
        stack_log(log_of({"wide_0": 4, "many_0": 0, "long_0": 3}), Stack(LAYOUTS))


def test_stack_of_one_step() -> None:
    stack = Stack(LAYOUTS)
    here = {a: np.arange(v.size, dtype=np.float32) for a, v in LAYOUTS.items()}
    rows = stack.observations(here)
    assert rows.shape == (3, 1, 15) and rows[1, 0].tolist() == [*range(9)] + [0.0] * 6
    masks = stack.masks({"wide_0": np.array([0, 1], np.int8), "many_0": None})
    assert masks.tolist() == [[False, True] + [False] * 4, [True] * 6, [True] * 3 + [False] * 3]


@pytest.mark.parametrize(
    "make",
    [
        lambda: ForwardConfig(hidden=()),
        lambda: InverseConfig(hidden=(0,)),
        lambda: InverseConfig(embedding=0),
    ],
)
def test_impossible_shapes_are_refused(make) -> None:
    with pytest.raises(OptionError, match="allowed"):
        make()
