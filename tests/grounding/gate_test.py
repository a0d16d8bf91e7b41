"""The gate's arithmetic on hand-made uncertainties."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import torch

from ugat_marl.errors import CheckpointError, OptionError
from ugat_marl.grounding import GateConfig
from ugat_marl.grounding.gate import Gate

AGENTS = ("signal_0", "signal_1")
KEEP, OTHER = np.array([0, 0]), np.array([1, 1])


def run(gate: Gate, *steps: tuple[float, float]) -> list[list[bool]]:
    return [gate.decide(np.array(u), KEEP, OTHER).tolist() for u in steps]


def test_alpha_starts_at_infinity_and_becomes_the_mean_of_the_logged_u() -> None:
    gate = Gate(AGENTS, GateConfig())
    assert run(gate, (0.25, 1.0), (0.5, 0.5)) == [[True, True], [True, True]]
    gate.update()
    assert gate.alpha.tolist() == [0.375, 0.75]
    # u >= alpha keeps the policy's action; exactly alpha is kept, too
    assert run(gate, (0.25, 0.75), (0.375, 0.7)) == [[True, False], [False, True]]


def test_what_is_not_counted_changes_neither_alpha_nor_the_report() -> None:
    gate, watched = Gate(AGENTS, GateConfig()), Gate(AGENTS, GateConfig())
    for one in (gate, watched):
        run(one, (0.25, 1.0))
    with watched.uncounted():
        assert run(watched, (0.9, 0.9)) == [[True, True]]
        watched.end_epoch()
        run(watched, (0.8, 0.1))
    for one in (gate, watched):
        run(one, (0.5, 0.5))
    assert gate.update().as_dict() == watched.update().as_dict()
    assert gate.alpha.tolist() == watched.alpha.tolist() == [0.375, 0.75]


def test_pooled_alpha_is_one_mean_over_all_intersections() -> None:
    gate = Gate(AGENTS, GateConfig(scope="pooled"))
    run(gate, (0.2, 1.0), (0.4, 0.4))
    gate.update()
    assert gate.alpha.tolist() == pytest.approx([0.5, 0.5])


def test_a_fitted_start_expects_the_mean_u_of_the_first_fit_until_there_are_logged_ones() -> None:
    gate = Gate(AGENTS, GateConfig(start="fitted"))
    gate.begin(np.array([0.4, 0.0]))  # without any uncertainty there is nothing to gate by
    assert gate.alpha.tolist() == [0.4, np.inf]
    assert run(gate, (0.5, 0.9), (0.3, 0.9)) == [[False, True], [True, True]]
    gate.update()
    assert gate.alpha.tolist() == pytest.approx([0.4, 0.9])
    gate.begin(np.array([0.1, 0.1]))  # the second fit
    assert gate.alpha.tolist() == pytest.approx([0.4, 0.9])


@pytest.mark.parametrize("config", [GateConfig(), GateConfig("static", 0.3, start="fitted")])
def test_only_a_dynamic_gate_starts_fitted_and_only_if_asked_to(config: GateConfig) -> None:
    gate = Gate(AGENTS, config)
    before = gate.alpha.tolist()
    gate.begin(np.array([0.1, 0.2]))
    assert gate.alpha.tolist() == before


def test_a_fitted_start_is_pooled_like_all_else() -> None:
    gate = Gate(AGENTS, GateConfig(scope="pooled", start="fitted"))
    gate.begin(np.array([0.1, 0.3]))
    assert gate.alpha.tolist() == pytest.approx([0.2, 0.2])


def test_refused_actions_are_logged_like_taken_ones() -> None:
    gate = Gate(AGENTS, GateConfig())
    run(gate, (0.4, 0.4))
    gate.update()
    run(gate, (0.8, 0.2))  # refused, taken
    assert "does not discriminate" in gate.update().warning
    assert gate.alpha.tolist() == pytest.approx([0.6, 0.3])  # both means contain this step's u


def test_the_window_holds_the_last_epochs_weighted_by_their_length() -> None:
    gate = Gate(AGENTS, GateConfig(window_epochs=2))
    run(gate, (0.9, 0.9))
    gate.end_epoch()  # falls out of the window
    run(gate, (0.2, 0.2), (0.2, 0.4))
    gate.end_epoch()
    gate.end_epoch()  # an epoch without a decision is none
    run(gate, (0.5, 0.6))
    gate.update()  # closes the third epoch
    assert gate.alpha.tolist() == pytest.approx([0.3, 0.4])


def test_alpha_forgets_what_is_older_than_twenty_episodes() -> None:
    gate = Gate(AGENTS, GateConfig())
    for u in (1.0,) * 5 + (0.25,) * 20:
        run(gate, (u, u))
        gate.end_epoch()
    gate.update()
    assert gate.alpha.tolist() == [0.25, 0.25]


def test_static_and_infinite_do_not_move() -> None:
    static = Gate(AGENTS, GateConfig(mode="static", static_alpha=0.5))
    assert run(static, (0.4, 0.5)) == [[True, False]]
    static.update()
    assert static.alpha.tolist() == [0.5, 0.5]
    infinite = Gate(AGENTS, GateConfig(mode="infinite"))
    for _ in range(3):
        assert run(infinite, (1.0, 1.0)) == [[True, True]]
        infinite.update()
    assert np.isinf(infinite.alpha).all()


def test_a_fixed_alpha_stays_with_the_state_of_another_gate() -> None:
    """Models fitted behind a dynamic gate are judged behind the one that was asked for."""
    fitted = Gate(AGENTS, GateConfig())
    for config, alpha in ((GateConfig("static", 0.3), 0.3), (GateConfig("infinite"), np.inf)):
        gate = Gate(AGENTS, config)
        gate.load_state_dict(fitted.state_dict())
        assert gate.alpha.tolist() == [alpha, alpha]


def test_no_decision_no_change_of_alpha() -> None:
    gate = Gate(AGENTS, GateConfig())
    gate.update()
    assert np.isinf(gate.alpha).all()


def test_report_counts_by_hand() -> None:
    gate = Gate(AGENTS, GateConfig(mode="static", static_alpha=0.5))
    own = np.array([0, 0])
    gate.decide(np.array([0.1, 0.9]), own, np.array([1, 1]))  # taken and changed; refused
    gate.decide(np.array([0.3, 0.2]), own, np.array([0, 1]))  # taken, the same; taken, changed
    gate.decide(np.array([0.2, 0.2]), own, np.array([1, 1]), np.array([True, False]))  # masked
    report = gate.report()
    assert report.decisions.tolist() == [3, 3]
    assert report.acceptance.tolist() == pytest.approx([3 / 3, 1 / 3])
    assert report.change_rate.tolist() == pytest.approx([2 / 3, 1 / 3])
    assert report.mean_u.tolist() == pytest.approx([0.2, 1.3 / 3])
    numbers = report.as_dict()
    assert numbers["acceptance"] == pytest.approx(2 / 3)
    assert numbers["acceptance/signal_1"] == pytest.approx(1 / 3)
    assert numbers["alpha"] == 0.5 and numbers["decisions"] == 6
    json.dumps(numbers)
    gate.update()
    assert gate.report().decisions.tolist() == [0, 0]


def test_without_any_uncertainty_the_gate_stays_open_and_says_so() -> None:
    gate = Gate(AGENTS, GateConfig())
    run(gate, (0.0, 0.5))
    gate.update()
    assert gate.alpha.tolist() == [np.inf, 0.5]  # a mean of 0 would let nothing through
    assert run(gate, (0.0, 0.4), (0.0, 0.6)) == [[True, True], [True, False]]
    assert re.search(r"every grounded action was taken .*signal_0", gate.update().warning)
    assert np.isinf(gate.alpha[0])


def test_all_or_nothing_is_warned_of_after_the_first_iteration_only() -> None:
    gate = Gate(AGENTS, GateConfig(mode="static", static_alpha=0.5))
    run(gate, (0.1, 0.9))
    assert not gate.update().warning
    run(gate, (0.1, 0.9))
    assert re.search(r"no grounded.*signal_1.*every grounded.*signal_0", gate.update().warning)
    run(gate, (0.1, 0.1), (0.9, 0.9))
    assert not gate.update().warning


def test_taking_everything_is_what_infinite_is_for() -> None:
    gate = Gate(AGENTS, GateConfig(mode="infinite"))
    gate.update()
    run(gate, (0.1, 0.9))
    assert not gate.update().warning


def test_an_agent_that_is_not_trusted_keeps_its_policy_and_is_not_warned_of() -> None:
    gate = Gate(AGENTS, GateConfig())
    gate.trust(np.array([True, False]))
    assert run(gate, (0.25, 0.5), (0.75, 0.5)) == [[True, False], [True, False]]
    gate.update()
    assert gate.alpha.tolist() == [0.5, 0.5]  # its u is logged all the same
    run(gate, (0.25, 0.1), (0.75, 0.1))
    report = gate.update()
    assert report.as_dict()["trusted/signal_1"] == 0.0 and not report.warning
    restored = Gate(AGENTS, GateConfig())
    restored.load_state_dict(gate.state_dict())
    assert restored.trusted.tolist() == [True, False]


def test_a_restored_gate_goes_on_to_the_same_numbers() -> None:
    one = Gate(AGENTS, GateConfig(window_epochs=3))
    run(one, (0.2, 0.4))
    one.update()
    run(one, (0.1, 0.4), (0.3, 0.8))
    one.end_epoch()
    run(one, (0.6, 0.7))
    two = Gate(AGENTS, GateConfig(window_epochs=3))
    two.load_state_dict(one.state_dict())
    for gate in (one, two):
        run(gate, (0.9, 0.05))
        gate.update()
    assert one.alpha.tolist() == two.alpha.tolist()
    assert one.iteration == two.iteration == 2
    for name, value in one.state_dict().items():
        other = two.state_dict()[name]
        assert torch.equal(value, other) if isinstance(value, torch.Tensor) else value == other


@pytest.mark.parametrize(
    "change",
    [
        {"agents": ["signal_0"]},
        {"agents": None},
        {"alpha": torch.tensor([0.1])},
        {"alpha": torch.tensor([0.1, float("nan")])},
        {"counts": torch.full((4, 2), -1.0)},
        {"running": "x"},
        {"epochs": None},
        {"iteration": "two"},
    ],
)
def test_impossible_states_are_refused_and_change_nothing(change: dict) -> None:
    gate = Gate(AGENTS, GateConfig())
    before = gate.state_dict()
    with pytest.raises(CheckpointError, match="gate in the checkpoint"):
        gate.load_state_dict(before | change)
    assert gate.iteration == 0 and np.isinf(gate.alpha).all()


@pytest.mark.parametrize(
    "options",
    [{"mode": "never"}, {"scope": "all"}, {"static_alpha": 0.0}, {"window_epochs": 0}],
)
def test_impossible_options_are_refused(options: dict) -> None:
    with pytest.raises(OptionError, match="allowed"):
        GateConfig(**options)


def test_where_there_is_nothing_to_ground_nothing_is_logged() -> None:
    gate = Gate(AGENTS, GateConfig())
    asked = np.array([True, False])
    found = gate.decide(np.array([0.2, 0.8]), KEEP, OTHER, asked=asked)
    assert found.tolist() == [True, False]
    gate.decide(np.array([0.4, 0.6]), KEEP, OTHER)
    report = gate.update()
    assert report.decisions.tolist() == [2, 1]
    assert report.acceptance.tolist() == [1.0, 1.0]
    assert gate.alpha.tolist() == pytest.approx([0.3, 0.6])
