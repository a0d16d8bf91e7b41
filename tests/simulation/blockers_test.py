"""Vehicles that block lanes for effects: detectors see them, rewards and scores do not."""

from __future__ import annotations

from pathlib import Path

import libsumo
import numpy as np
import pytest

from tests.crossroads import crossroads_with
from ugat_marl import parallel_env
from ugat_marl.effects import scenario_in_domain

LANE = "northA_A1_1"


@pytest.mark.parametrize("effect", [f"lane_closure={LANE},55,145", f"parking={LANE},120,15"])
def test_lanes_are_measured_without_them(effect: str) -> None:
    """Vehicle by vehicle, on lanes beside others, where SUMO's mean speed leaves them out."""
    env = parallel_env("single-v1", effect, duration_s=200, reward="queue", simulator="inprocess")
    env.reset(seed=1)
    (agent,), lanes = env.agents, env.network.lane_table()
    blocked, decision = 0, 0
    while env.agents:
        decision += 1
        _, rewards, *_ = env.step({agent: decision // 2 % 4})
        if not env.agents:
            break
        measured, seen, api = env.snapshot, env.seen, libsumo.vehicle
        for place, lane in enumerate(lanes.ids):
            names = libsumo.lane.getLastStepVehicleIDs(lane)
            speeds = [api.getSpeed(n) for n in names if not n.startswith(("closure", "parking"))]
            assert measured.vehicles[place] == len(speeds)
            assert measured.halting[place] == sum(speed < 0.1 for speed in speeds)
            expected_mps = np.mean(speeds) if speeds else lanes.speed_mps[place]
            assert measured.mean_speed_mps[place] == pytest.approx(expected_mps)
            assert seen.vehicles[place] == len(names)
            assert seen.mean_speed_mps[place] == libsumo.lane.getLastStepMeanSpeed(lane)
            blocked += len(names) - len(speeds)
        incoming = lanes.indices(env.network.intersections[0].incoming_lanes)
        assert rewards[agent] == -measured.halting[incoming].sum()
    assert blocked > 2
    env.close()


@pytest.mark.filterwarnings("ignore:.*no vehicle has entered")
@pytest.mark.parametrize("simulator", ["inprocess", "process"])
@pytest.mark.parametrize("domain", ["sim", "reach=300"])
def test_a_street_without_traffic_stays_empty(domain: str, simulator: str, tmp_path: Path) -> None:
    """Two vehicles for one place: one stands there, the other waits to enter."""
    empty = crossroads_with('<vehicle id="0" depart="190"><route edges="NM MS"/></vehicle>',
                            tmp_path, 50, 200)  # fmt: skip
    effects = "lane_closure=Ww_0,5,100+lane_closure=Ww_0,15,80"
    for reward in ("total-queue", "waiting"):
        world = scenario_in_domain(empty, f"{effects}+{domain}" if domain != "sim" else effects)
        env = parallel_env(world, reward=reward, simulator=simulator)
        env.reset(seed=1)
        (agent,) = env.agents
        seen: list[float] = []
        for _ in range(19):
            _, rewards, *_ = env.step({agent: 0})
            assert rewards[agent] == 0
            measured = env.snapshot
            assert not any(map(np.any, (measured.vehicles, measured.halting, measured.waiting_s)))
            assert measured.mean_speed_mps == pytest.approx(13.0)
            assert (measured.departed, measured.backlog) == (0, 0)
            seen.append(env.seen.vehicles.sum())
        assert max(seen) == (2 if domain == "reach=300" else 0)
        env.step({agent: 0})
        assert (env.snapshot.departed, env.scores().queue) == (1, 0)
        env.close()
