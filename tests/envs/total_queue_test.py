"""The reward total-queue: queues that do not end on the lanes at the lights."""

from __future__ import annotations

from pathlib import Path

import pytest

import ugat_marl
from tests.crossroads import crossroads_with
from ugat_marl.envs import Rewarder, TrafficEnv
from ugat_marl.scenarios import Scenario


@pytest.fixture(scope="module")
def short_entry(tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    """A crossroads whose western road is cut 18 m before the light; 60 cars come from there."""
    cars = "".join(
        f'<vehicle id="w{i}" depart="{5 * i}"><route edges="Ww wM ME"/></vehicle>'
        f'<vehicle id="n{i}" depart="{5 * i}"><route edges="NM MS"/></vehicle>'
        for i in range(60)
    )
    return crossroads_with(cars, tmp_path_factory.mktemp("short"), 18, 600)


def phase_with(env: TrafficEnv, lane: str) -> int:
    """Return a phase that is green for a lane, of those that hold the others up."""
    (item,) = env.network.intersections
    letter = next(link.index for link in item.links if link.from_lane == lane)
    return next(i for i, state in enumerate(item.phases) if state[letter] in "Gg")


def rewards_of_green(env: TrafficEnv, lane: str, decisions: int) -> list[float]:
    """Begin an episode, show green for a lane and nothing else, and return the rewards."""
    env.reset(seed=1)
    (agent,) = env.agents
    green = phase_with(env, lane)
    return [env.step({agent: green})[1][agent] for _ in range(decisions)]


@pytest.mark.parametrize("domain", ["sim", "reach=100", "reach=300"])
def test_every_car_that_is_held_up_counts_once(short_entry: Scenario, domain: str) -> None:
    """North has green for ever: all sixty cars of the west wait, wherever they stand."""
    env = ugat_marl.parallel_env(short_entry, domain)
    rewards = rewards_of_green(env, "NM_0", 60)
    assert env.snapshot.backlog > 20
    assert rewards[-1] == pytest.approx(-60)
    near = Rewarder(env.network, "queue").rewards(env.snapshot, env.snapshot)
    assert near[0] > -5 if domain == "sim" else near[0] >= -60
    env.close()


@pytest.mark.parametrize("domain", ["sim", "reach=100"])
def test_who_is_due_later_on_the_route_counts_once(domain: str, tmp_path: Path) -> None:
    """All forty depart on the road at the light, where few find room."""
    cars = "".join(
        f'<vehicle id="{i}" depart="{i}" departEdge="1"><route edges="Ww wM ME"/></vehicle>'
        for i in range(40)
    )
    env = ugat_marl.parallel_env(crossroads_with(cars, tmp_path, 50, 60), domain)
    rewards = rewards_of_green(env, "NM_0", 6)
    assert env.snapshot.backlog > 30
    assert rewards[-1] == pytest.approx(-40)
    env.close()


def test_a_policy_is_not_paid_for_blocking_the_short_entry(short_entry: Scenario) -> None:
    """Under `queue` green for the north pays most; west's cars are out of sight."""
    paid: dict[str, dict[str, float]] = {"queue": {}, "total-queue": {}}
    att_s: dict[str, float] = {}
    for reward, returns in paid.items():
        for policy in ("blocks west", "in turns"):
            env = ugat_marl.parallel_env(short_entry, reward=reward)
            env.reset(seed=1)
            (agent,) = env.agents
            ways = [phase_with(env, "NM_0"), phase_with(env, "wM_0")]
            returns[policy] = 0.0
            for decision in range(60):
                turn = decision // 6 % 2 if policy == "in turns" else 0
                returns[policy] += env.step({agent: ways[turn]})[1][agent]
            att_s[policy] = env.scores().att_s
            env.close()
    assert att_s["blocks west"] > 2 * att_s["in turns"]
    assert paid["queue"]["blocks west"] > paid["queue"]["in turns"]
    assert paid["total-queue"]["blocks west"] < 2 * paid["total-queue"]["in turns"]


def test_it_is_the_queue_where_queues_end_at_the_lights() -> None:
    returns: list[list[float]] = []
    for reward in ("queue", "total-queue"):
        env = ugat_marl.parallel_env("single-v1", reward=reward, duration_s=600)
        env.reset(seed=3)
        returns.append(
            [
                env.step(dict.fromkeys(env.agents, decision // 2 % 4))[1]["signal_0"]
                for decision in range(60)
            ]
        )
        measured = env.snapshot.queued_upstream.size
        assert measured == (len(env.snapshot.halting) if reward == "total-queue" else 0)
        env.close()
    assert returns[0] == returns[1]


def test_a_process_answers_the_same(short_entry: Scenario) -> None:
    played: list[list[float]] = []
    for simulator in ("process", "inprocess"):
        env = ugat_marl.parallel_env(short_entry, simulator=simulator)
        env.reset(seed=1)
        (agent,) = env.agents
        played.append([env.step({agent: 0})[1][agent] for _ in range(40)])
        env.close()
    assert played[0] == played[1]
    assert min(played[0]) < -20


def test_the_queue_model_counts_who_cannot_enter(short_entry: Scenario) -> None:
    env = ugat_marl.parallel_env(short_entry, "queue_model=100")
    env.reset(seed=1)
    (agent,) = env.agents
    green = phase_with(env, "NM_0")
    rewards = [env.step({agent: green})[1][agent] for _ in range(60)]
    assert env.snapshot.queued_upstream.sum() >= env.snapshot.backlog > 10
    assert rewards[-1] <= -env.snapshot.backlog
    env.close()
