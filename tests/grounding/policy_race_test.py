"""Race of policies: who leaves it, who wins it, and how many worlds it takes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from ugat_marl.grounding.policy_race import ROUND, race_policies

Times = NDArray[np.float64]


class Streets:
    """Travel times of policies in worlds, and the rounds in which they were asked for."""

    def __init__(self, **times_s: Times) -> None:
        self.names = list(times_s)
        self.rounds: list[tuple[tuple[str, ...], range]] = []
        self._times_s = times_s

    def play(self, names: Sequence[str], worlds: range) -> Times:
        """Return the times of a round."""
        self.rounds.append((tuple(names), worlds))
        return np.array([self._times_s[name][worlds.start : worlds.stop] for name in names])


def noise(seed: int, worlds: int = 80) -> Times:
    """Return deviations of mean 0 and standard deviation 10 s."""
    drawn = np.random.default_rng(seed).normal(0.0, 10.0, worlds)
    return drawn - drawn.mean()


def test_the_clearly_best_policy_needs_one_round() -> None:
    streets = Streets(slow=200.0 + noise(1), fast=100.0 + noise(2), middle=150.0 + noise(3))
    race = race_policies(streets.names, 40, streets.play)
    assert race.best == "fast" and race.worlds == ROUND == 8
    assert streets.rounds == [(("slow", "fast", "middle"), range(8))]


def test_what_worlds_have_in_common_is_no_noise() -> None:
    """Travel times of a jam differ by far more than policies do, which play in the same worlds."""
    common = 10 * noise(1)
    streets = Streets(slow=203.0 + common + noise(2) / 10, fast=200.0 + common + noise(3) / 10)
    race = race_policies(streets.names, 40, streets.play)
    assert (race.best, race.worlds) == ("fast", 8)


def test_close_policies_play_on_without_those_that_left() -> None:
    streets = Streets(slow=200.0 + noise(1), one=104.0 + noise(2), other=100.0 + noise(3))
    race = race_policies(streets.names, 80, streets.play)
    assert race.best == "other"
    assert streets.rounds[0] == (("slow", "one", "other"), range(8))
    assert streets.rounds[1] == (("one", "other"), range(8, 16))
    assert race.worlds > 16


def test_more_worlds_mend_the_choice_of_the_first() -> None:
    """Of policies 6 % apart the better one is kept nearly always, after one round often not."""

    def right(most: int) -> float:
        better, worse = 100.0, 106.0
        kept = [
            race_policies(s.names, most, s.play).best == "better"
            for k in range(200)
            for s in [Streets(worse=worse + noise(2 * k), better=better + noise(2 * k + 1))]
        ]
        return float(np.mean(kept))

    assert right(8) < 0.92
    assert right(40) > 0.97


def test_equal_policies_end_the_race_and_the_first_is_kept() -> None:
    same = 100.0 + noise(1)
    streets = Streets(kept=same, new=same.copy())
    race = race_policies(streets.names, 40, streets.play)
    assert (race.best, race.worlds) == ("kept", 8)
    assert race.times_s["kept"] == race.times_s["new"] == pytest.approx(same[:8].mean())


def test_times_never_contradict_the_choice() -> None:
    """A policy may leave behind one that falls back later, and so never have met the best one."""
    middles = np.random.default_rng(0)
    for k in range(300):
        names = [f"policy{i}" for i in range(7)]
        times_s = {
            name: 100.0 + middles.uniform(0, 6) + middles.uniform(0, 2) * noise(10 * k + i)
            for i, name in enumerate(names)
        }
        streets = Streets(**times_s)
        race = race_policies(names, 40, streets.play)
        assert min(race.times_s.values()) == race.times_s[race.best]


@pytest.mark.filterwarnings("error")
def test_worlds_without_traffic_end_the_race_after_a_round() -> None:
    nobody = np.full(40, np.nan)
    streets = Streets(one=nobody, other=nobody)
    race = race_policies(streets.names, 40, streets.play)
    assert race.best == "one" and race.worlds == 0 and len(streets.rounds) == 1
    first, last = 100.0 + noise(1), 100.0 + noise(2)
    first[0] = last[7] = np.nan
    assert race_policies(["a", "b"], 40, Streets(a=first, b=last).play).best == "a"


def test_the_time_of_a_policy_that_left_is_set_against_the_best_one() -> None:
    """The first worlds were slow ones; what counts is by how much it was slower there."""
    worlds = np.concatenate((np.full(8, 50.0), np.zeros(72)))
    left = 130.0 + worlds
    streets = Streets(left=left, one=100.0 + worlds + noise(1), other=101.0 + worlds + noise(2))
    race = race_policies(streets.names, 40, streets.play)
    assert all("left" not in names for names, _ in streets.rounds[1:]) and race.worlds == 40
    one, other = streets.play(["one", "other"], range(40))
    ahead = min((one, other), key=lambda times_s: times_s[:8].mean())
    assert race.times_s["left"] == pytest.approx(ahead.mean() + (left[:8] - ahead[:8]).mean())
    assert min(race.times_s.values()) == race.times_s[race.best]


@pytest.mark.parametrize("most", [1, 2, 3, 8, 13])
def test_no_more_worlds_are_played_than_allowed(most: int) -> None:
    streets = Streets(one=100.0 + noise(1), other=100.1 + noise(2))
    race = race_policies(streets.names, most, streets.play)
    assert race.worlds == most == sum(len(worlds) for _, worlds in streets.rounds)


def test_worlds_without_traffic_do_not_count() -> None:
    slow, fast = 203.0 + noise(1) / 10, 200.0 + noise(2) / 10
    slow[3] = fast[3] = np.nan
    race = race_policies(["slow", "fast"], 40, Streets(slow=slow, fast=fast).play)
    assert (race.best, race.worlds) == ("fast", 7)
    assert race.times_s["slow"] == pytest.approx(np.nanmean(slow[:8]))
    assert race.times_s["fast"] == pytest.approx(np.nanmean(fast[:8]))


def test_a_policy_that_alone_lacks_a_travel_time_leaves() -> None:
    lost, fine = 100.0 + noise(1), 200.0 + noise(2)
    lost[3] = np.nan
    streets = Streets(lost=lost, fine=fine)
    race = race_policies(streets.names, 40, streets.play)
    assert (race.best, len(streets.rounds)) == ("fine", 1)
    assert np.isnan(race.times_s["lost"])


def test_a_single_policy_plays_one_round() -> None:
    streets = Streets(alone=100.0 + noise(1))
    race = race_policies(streets.names, 40, streets.play)
    assert (race.best, race.worlds) == ("alone", 8)


def test_a_policy_that_is_no_worse_seldom_leaves() -> None:
    left = 0
    for k in range(300):
        streets = Streets(one=100.0 + noise(2 * k), other=100.0 + noise(2 * k + 1))
        race_policies(streets.names, 16, streets.play)
        left += len(streets.rounds) == 1
    assert left / 300 < 0.05
