"""Posterior over worlds on statistics with a known origin: coverage, pooling, correlation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ugat_marl.errors import CheckpointError, UnknownNameError
from ugat_marl.grounding.posterior import (
    FittedService,
    Posterior,
    SimulatedLog,
    WorldPrior,
    WorldValues,
    at_least_0,
)
from ugat_marl.grounding.street import LEARNT
from ugat_marl.grounding.summaries import NAMES, Summary

LANES = tuple(f"lane_{k}" for k in range(8))
WORLDS = WorldPrior.of(LANES)


def summary(values: WorldValues, seed: int, silent: int | None = None) -> Summary:
    """Return statistics that the values decide, with noise; one lane may say nothing."""
    generator = np.random.default_rng(seed)
    scaled = (values.effects - 1.0) / 2.0
    known = np.zeros((len(LANES), len(NAMES)))
    known[:, :7] = np.tanh(scaled) + 0.3 * scaled[::-1]
    known[:, 7] = 2.0 - 0.3 * values.service_s[:, 0]
    known[:, 8] = 3.0 * np.exp(-0.4 * values.service_s[:, 1])
    known += 0.05 * generator.standard_normal(known.shape)
    if silent is not None:
        known[silent] = np.nan
    rows = np.full_like(known, 50.0)
    return Summary(known, rows)


LEARNT_FROM = [WORLDS.draw(k, LEARNT) for k in range(300)]
SIMULATED = [SimulatedLog(values, summary(values, k)) for k, values in enumerate(LEARNT_FROM)]


def interval(sample: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.quantile(sample, (0.05, 0.95), axis=0)
    return low - 1e-9, high + 1e-9


@pytest.mark.slow
def test_ninety_percent_intervals_hold_the_truth_as_often_as_they_say() -> None:
    inside_effects: list[np.ndarray] = []
    inside_service: list[np.ndarray] = []
    for k in range(1000, 1060):
        truth = WORLDS.draw(k)
        posterior = Posterior.fit(WORLDS, SIMULATED, summary(truth, k))
        effects, service_s = posterior.sample(300)
        low, high = interval(effects)
        inside_effects.append((truth.effects >= low) & (truth.effects <= high))
        low, high = interval(service_s)
        inside_service.append((truth.service_s >= low) & (truth.service_s <= high))
    assert 0.8 <= np.mean(inside_effects) <= 0.97
    assert 0.8 <= np.mean(inside_service) <= 0.99  # most lanes are exactly 0, which is inside


def test_service_of_one_lane_is_found_at_this_lane() -> None:
    service_s = np.zeros((len(LANES), 2))
    service_s[3] = (4.0, 0.0)
    truth = WorldValues(np.array([x.nominal for x in WORLDS.library]), service_s)
    found = Posterior.fit(WORLDS, SIMULATED, summary(truth, 5)).sample(300)[1].mean(0)
    assert found[3, 0] == pytest.approx(4.0, abs=1.0)
    assert np.delete(found[:, 0], 3).max() < 1.0


def test_lanes_deviate_from_the_network_s_mean_by_0_on_average() -> None:
    found = Posterior.fit(WORLDS, SIMULATED, summary(WORLDS.draw(5), 5, silent=2))
    assert np.abs(found.offsets_s).max() > 0.01
    assert found.offsets_s.mean(0) == pytest.approx(0.0, abs=1e-9)
    assert found.offset_errors_s.mean(1) == pytest.approx(0.0, abs=1e-9)


def test_a_lane_without_data_follows_the_network_and_is_less_certain() -> None:
    truth = WorldValues(
        np.array([x.nominal for x in WORLDS.library]), np.full((len(LANES), 2), 2.0)
    )
    sample_s = Posterior.fit(WORLDS, SIMULATED, summary(truth, 5, silent=2)).sample(400)[1]
    middle = sample_s.mean(0)
    assert middle[2, 0] == pytest.approx(np.delete(middle[:, 0], 2).mean(), abs=0.8)
    assert middle[2, 0] > 1.0  # not zero
    spread = sample_s.std(0)[:, 0]
    assert spread[2] > 1.5 * np.delete(spread, 2).mean()


def test_a_lane_without_data_in_all_worlds_is_given_no_green_of_its_own() -> None:
    """Greens of one lane serve a vehicle less, in worlds and on the street; none is unused."""

    def shaped(values: WorldValues, seed: int, silent: int | None = None) -> Summary:
        told = summary(values, seed, silent)
        told.values[2, 7] -= 1.0
        return told

    truth = WorldValues(np.array([x.nominal for x in WORLDS.library]), np.zeros((len(LANES), 2)))
    simulated = [SimulatedLog(values, shaped(values, k, 2)) for k, values in enumerate(LEARNT_FROM)]
    found = Posterior.fit(WORLDS, simulated, shaped(truth, 5)).sample(200)[1].mean(0)
    assert found[:, 0].max() < 0.3


def test_draws_keep_to_their_ranges_and_name_only_what_changes() -> None:
    posterior = Posterior.fit(WORLDS, SIMULATED, summary(WORLDS.draw(9), 9))
    for seed in range(50):
        values = posterior.draw(seed)
        for item, value in zip(WORLDS.library, values.effects, strict=True):
            assert item.low <= value <= item.high
        assert values.service_s.min() >= 0.0
    nominal = WorldValues(np.array([x.nominal for x in WORLDS.library]), np.zeros((len(LANES), 2)))
    assert WORLDS.effects(nominal) == ()
    assert FittedService(LANES, nominal.service_s).service() == {}
    names = [effect.name for effect in WORLDS.effects(posterior.draw(0))]
    assert "demand_level" not in names[1:]  # demand changes before vehicles do


def test_a_street_with_one_effect_is_given_no_others() -> None:
    nominal = np.array([x.nominal for x in WORLDS.library])
    place = [item.name for item in WORLDS.library].index("headway")
    effects = nominal.copy()
    effects[place] = 1.9
    truth = WorldValues(effects, np.zeros((len(LANES), 2)))
    posterior = Posterior.fit(WORLDS, SIMULATED, summary(truth, 5))
    assert posterior.presence.chance_of(place) > 0.9
    drawn, service_s = posterior.sample(300)
    assert (np.abs(np.delete(drawn - nominal, place, axis=1)) < 1e-9).mean() > 0.6
    assert (service_s == 0.0).all((1, 2)).mean() > 0.5
    assert np.quantile(drawn[:, place], (0.05, 0.95)) == pytest.approx(1.9, abs=0.4)


def test_worlds_to_learn_from_have_most_effects() -> None:
    nominal = np.array([x.nominal for x in WORLDS.library])
    drawn = np.stack([WORLDS.draw(seed, LEARNT).effects for seed in range(1000)])
    assert (drawn != nominal).mean(0) == pytest.approx(LEARNT, abs=0.05)
    posterior = Posterior.fit(
        WORLDS, SIMULATED, summary(WorldValues(nominal, np.zeros((len(LANES), 2))), 5)
    )
    found, learnt, whole = (
        np.stack([posterior.draw(seed, chance).effects for seed in range(100)]) == nominal
        for chance in (None, LEARNT, 1.0)
    )
    # A draw beyond the end of its range is at the end, and that may be the nominal value.
    inside = [x.low < x.nominal < x.high for x in WORLDS.library]
    assert found[:, inside].mean() > 0.5 and not whole[:, inside].any()
    assert learnt[:, inside].mean() == pytest.approx(1 - LEARNT, abs=0.05)


def test_worlds_near_a_street_do_not_draw_it_towards_them() -> None:
    """Half of the worlds have some red in all greens; the street has none, and says it."""
    nominal = np.array([x.nominal for x in WORLDS.library])
    generator = np.random.default_rng(0)

    def near(seed: int) -> SimulatedLog:
        red = np.full((len(LANES), 2), generator.normal((1.0, 1.2), 0.2))
        values = WorldValues(generator.normal(nominal, 0.02), red)
        return SimulatedLog(values, summary(values, seed))

    simulated = SIMULATED[:40] + [near(5000 + k) for k in range(40)]
    street = WorldValues(nominal, np.zeros((len(LANES), 2)))
    chances = [
        Posterior.fit(WORLDS, simulated, summary(street, 9000 + k)).presence.chance_of(column)
        for k in range(10)
        for column in (-2, -1)
    ]
    assert np.mean(chances) < 0.4


def test_a_log_that_says_nothing_leaves_the_prior_of_unused_green() -> None:
    silence = Summary.of(np.full((len(LANES), len(NAMES)), np.nan), np.zeros((len(LANES), 1)))
    means: list[np.ndarray] = []
    for seed in range(4):
        worlds = [WORLDS.draw(1000 * seed + k, LEARNT) for k in range(160)]
        posterior = Posterior.fit(WORLDS, [SimulatedLog(w, silence) for w in worlds], silence)
        means.append(posterior.sample(200)[1].mean((0, 1)))
    prior = np.mean([WORLDS.draw(k).service_s.mean(0) for k in range(400)], axis=0)
    assert np.mean(means, axis=0) == pytest.approx(prior, rel=0.35)


def test_low_accelerations_are_drawn_as_often_as_high_ones_of_the_same_ratio() -> None:
    place = [item.name for item in WORLDS.library].index("acceleration")
    item = WORLDS.library[place]
    drawn = np.array([WORLDS.draw(seed).effects[place] for seed in range(2000)])
    drawn = drawn[drawn != item.nominal]
    assert drawn.min() >= item.low and drawn.max() <= item.high
    below = [np.mean(drawn < item.low * (item.high / item.low) ** share) for share in (0.25, 0.5)]
    assert below == pytest.approx([0.25, 0.5], abs=0.04)


def test_what_is_estimated_as_a_logarithm_comes_back() -> None:
    effects = np.stack([WORLDS.draw(seed).effects for seed in range(20)])
    np.testing.assert_allclose(WORLDS.natural(WORLDS.scaled(effects)), effects, rtol=1e-12)
    place = [item.name for item in WORLDS.library].index("deceleration")
    np.testing.assert_allclose(WORLDS.scaled(effects)[:, place], np.log(effects[:, place]))
    nothing = WorldPrior.of(LANES, without=[item.name for item in WORLDS.library])
    assert nothing.draw(3).effects.shape == nothing.scaled(np.zeros((4, 0)))[0].shape == (0,)


def test_an_effect_can_be_left_out() -> None:
    worlds = WorldPrior.of(LANES, without=["headway"])
    assert "headway" not in [item.name for item in worlds.library]
    with pytest.raises(UnknownNameError, match="headwya"):
        WorldPrior.of(LANES, without=["headwya"])


def test_a_posterior_survives_its_checkpoint_and_refuses_another_network() -> None:
    posterior = Posterior.fit(WORLDS, SIMULATED, summary(WORLDS.draw(9), 9))
    again = Posterior.from_state(WORLDS, posterior.state_dict())
    assert again.state_dict() == posterior.state_dict()
    assert np.array_equal(again.draw(4).effects, posterior.draw(4).effects)
    with pytest.raises(CheckpointError, match="another network"):
        Posterior.from_state(WorldPrior.of(LANES[:3]), posterior.state_dict())


def test_values_at_least_0_by_hand() -> None:
    given = np.array([[3.0, -1.0, 1.0], [-1.0, -2.0, 2.0], [1.0, 0.0, 0.0]])
    # Means 1, -1, 1: of the first column 2.5 and 0.5 are left, of the second nothing.
    expected = np.array([[2.5, 0.0, 1.0], [0.0, 0.0, 2.0], [0.5, 0.0, 0.0]])
    np.testing.assert_allclose(at_least_0(given), expected)
    many = np.random.default_rng(0).normal(0.3, 1.0, (50, 20))
    np.testing.assert_allclose(at_least_0(many).mean(0), np.maximum(many.mean(0), 0.0), atol=1e-12)


def test_a_street_without_unused_green_is_given_none_on_average() -> None:
    """Noise of single lanes cancels: set to 0 one by one, it would add a third of its size."""
    truth = WorldValues(np.array([x.nominal for x in WORLDS.library]), np.zeros((len(LANES), 2)))
    sample_s = Posterior.fit(WORLDS, SIMULATED, summary(truth, 5)).sample(400)[1]
    assert np.quantile(sample_s[:, :, 0].mean(1), 0.05) == 0.0


def test_a_log_that_no_world_resembles_is_told() -> None:
    """Nine of its statistics are far above those of all worlds: no effect within its range."""
    street = summary(WORLDS.draw(9), 9)
    street.values[:, :9] += 3.0
    posterior = Posterior.fit(WORLDS, SIMULATED, street)
    assert posterior.beyond == pytest.approx(9 / len(NAMES))
    assert posterior.is_unlike and "headway" in posterior.beyond_range
    told, *_ = posterior.describe()
    assert told.startswith("the log is unlike every simulated world: 41% of its statistics")
    assert ", ".join(posterior.beyond_range) in told
    numbers = posterior.as_dict({"a": range(len(LANES))})
    assert numbers["street/beyond_worlds"] == pytest.approx(9 / len(NAMES))
    inside = dataclasses.replace(posterior, answer=WORLDS.scaled(WORLDS.ends)[1])
    assert not inside.beyond_range and not inside.is_unlike
    assert dataclasses.replace(inside, beyond=np.array(0.6)).is_unlike


def test_streets_of_the_prior_are_like_some_world() -> None:
    posteriors = [
        Posterior.fit(WORLDS, SIMULATED[:160], summary(WORLDS.draw(k), k))
        for k in range(1000, 1050)
    ]
    assert sum(posterior.is_unlike for posterior in posteriors) <= 1
    assert posteriors[0].describe()[0].startswith("effects: ")
    assert "street/beyond_worlds" not in posteriors[0].as_dict({"a": range(len(LANES))})


def test_a_part_that_was_not_fitted_is_not_told() -> None:
    truth = WORLDS.draw(1000)
    whole = Posterior.fit(WORLDS, SIMULATED, summary(truth, 1000))
    effects, greens = whole.describe()
    assert effects.startswith("effects: ") and greens.startswith("greens: ")
    one = dataclasses.replace(whole, worlds=dataclasses.replace(WORLDS, service=False))
    assert [line.partition(":")[0] for line in one.describe()] == ["effects"]
    places = {"a": list(range(len(LANES)))}
    told = {name.partition("/")[0] for name in one.as_dict(places)}
    assert told == {"effects"}
    assert {name.partition("/")[0] for name in whole.as_dict(places)} > told
