"""The sentence about a transfer, by hand: shown, not shown, worse, one episode."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from ugat_marl.data import Scores
from ugat_marl.experiments import Evaluation, TransferOutcome, outcome_of
from ugat_marl.experiments.scores import Result

BLANK = Scores(0, 0, 100, 0, 0, 0, 0, 110, 105, 0)


def outcome(
    direct_s: list[float], grounded_s: list[float], **more_s: list[float]
) -> TransferOutcome:
    times = {"direct transfer": direct_s, "fitted street": grounded_s, "rule sotl:1:2": [99.0] * 9}
    times |= {name.replace("_", " "): values for name, values in more_s.items()}
    results = [
        Result(policy, domain, seed, replace(BLANK, att_s=att_s))
        for policy, values in times.items()
        for domain in ("sim", "V4")
        for seed, att_s in enumerate(values[: len(direct_s)])
    ]
    found = outcome_of(Evaluation("toy", "0", tuple(results), {"best rule in V4": "sotl:1:2"}))
    assert found is not None
    return found


def test_a_shown_difference_has_its_interval() -> None:
    # Differences -8, -10, -12: mean -10, s = 2, t(0.975, 2) = 4.303, half width 4.97, t = 8.66.
    found = outcome([110.0, 112.0, 114.0], [102.0, 102.0, 102.0])
    assert found.shown
    assert found.test.p == pytest.approx(0.01307, abs=1e-4)
    assert found.sentence() == (
        "In V4 vehicles need 102 s with fitted street, 10 s less than with direct transfer "
        "(95 % interval 5 to 15 s, p = 0.01, 3 episodes with the same vehicles); the best rule "
        "there, sotl:1:2, needs 99 s."
    )


def test_the_control_is_named_beside_direct_transfer() -> None:
    """What more training alone wins is no merit of the grounding."""
    found = outcome([110.0, 112.0, 114.0], [102.0, 102.0, 102.0], more_plain_sim=[101.0] * 3)
    assert found.sentence().endswith(
        "with the same vehicles); after as many more episodes in plain sim, 101 s; the best rule "
        "there, sotl:1:2, needs 99 s."
    )


def test_long_times_are_whole_seconds() -> None:
    text = outcome([500.0, 520.0, 540.0], [302.0, 302.0, 302.0]).sentence()
    assert "218 s less than with direct transfer (95 % interval 168 to 268 s" in text
    text = outcome([2450.0, 2461.0, 2472.0], [1450.4, 1450.4, 1450.4]).sentence()
    assert text.startswith("In V4 vehicles need 1450 s with fitted street, ")


def test_the_same_policy_is_no_difference_of_zero() -> None:
    text = outcome([120.0, 100.0, 100.0], [120.0, 100.0, 100.0]).sentence()
    assert "fitted street, to the last digit as with direct transfer; the best" in text


def test_harm_is_told_as_such() -> None:
    text = outcome([102.0, 102.0, 102.0], [110.0, 112.0, 114.0]).sentence()
    assert "10 s more than with direct transfer (95 % interval 5 to 15 s" in text


def test_chance_is_no_difference() -> None:
    # Differences -20, 0, 14: mean -2, s = 17.1, half width 42.4.
    text = outcome([120.0, 100.0, 100.0], [100.0, 100.0, 114.0]).sentence()
    assert "no difference from direct transfer is shown (-44 to +40 s, 3 episodes" in text


def test_one_episode_has_no_interval() -> None:
    text = outcome([120.0], [100.0]).sentence()
    assert "-20 s against direct transfer in a single episode" in text


def test_an_episode_without_a_travel_time_is_told() -> None:
    text = outcome([120.0, math.nan, 110.0], [100.0, 100.0, 100.0]).sentence()
    assert "some of the 3 episodes have no travel time" in text and "single" not in text


def test_a_run_without_grounding_has_no_outcome() -> None:
    results = tuple(Result("direct transfer", d, 0, BLANK) for d in ("sim", "V4"))
    assert outcome_of(Evaluation("toy", "0", results, {})) is None
