"""When vehicles cross: counted by hand, the same in every simulator, and kept in logs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import polars as pl
import pytest

from tests.crossroads import crossroads_with
from ugat_marl import parallel_env
from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.data.row_hashes import write_hashed
from ugat_marl.effects import load_scenario
from ugat_marl.errors import LogError
from ugat_marl.grounding import Stack, stack_log
from ugat_marl.policies import observer_of, roll_out
from ugat_marl.scenarios import Network
from ugat_marl.simulation import LibsumoSimulator, Snapshot, launch_of

Crossing = Callable[..., Path]
LANES = ("S_C_0", "W_C_0", "C_N_0", "C_E_0")
WEST = 1
TWO_WAIT = "".join(
    f'<vehicle id="{n}" type="car" route="east" depart="0" departPos="{at}" departSpeed="0"/>'
    for n, at in enumerate((490, 482.5))
)
ONE_WAITS = TWO_WAIT[: TWO_WAIT.index("/>") + 2]


@pytest.fixture
def simulator() -> Iterator[LibsumoSimulator]:
    made = LibsumoSimulator()
    yield made
    made.close()


@pytest.fixture
def start(simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path) -> Callable[..., Any]:
    """Starts the crossing with some vehicles; crossings are looked for unless told otherwise."""

    def begin(vehicles: str, crossings: bool = True, step_s: float = 1.0) -> Snapshot:
        scenario = load_scenario(crossing(vehicles=vehicles))
        settings = scenario.settings.model_copy(update={"step_length_s": step_s})
        launch = launch_of(
            replace(scenario, settings=settings),
            1,
            tmp_path / "own",
            LANES,
            crossings=crossings,
        )
        return simulator.start(launch)

    return begin


class Plan:
    """The phases that it was given, one after the other."""

    env_options: Mapping[str, Any] = {}

    def __init__(self, *phases: int) -> None:
        self._phases = phases

    def reset(self, seed: int) -> None:
        self._left = list(self._phases)

    def act(self, observations: Mapping[str, Any], infos: Mapping[str, Any]) -> dict[str, int]:
        phase = self._left.pop(0) if self._left else 0
        return dict.fromkeys(observations, phase)


# --- counting


@pytest.mark.parametrize(("red_s", "share"), [(1, 0.9), (4, 0.6), (9, 0.1), (10, 0.0)])
def test_a_vehicle_counts_in_all_the_seconds_after_it_has_left(
    red_s: int, share: float, simulator: LibsumoSimulator, start: Any
) -> None:
    """It stands at the stop line and moves in the first second of green: second `red_s` + 1."""
    assert not len(start(ONE_WAITS).mean_left)
    assert simulator.advance(10, {"C": [(10.0, "Gr")]}).mean_left.tolist() == [0, 0, 0, 0]
    segments = [(float(red_s), "Gr"), (10.0 - red_s, "rG")]
    snapshot = simulator.advance(10, {"C": [s for s in segments if s[0]]})
    np.testing.assert_allclose(snapshot.mean_left, [0, share, 0, 0])
    # The next interval begins at nothing: what left before is not counted again.
    later = simulator.advance(10, {"C": [(10.0, "rG")]}).mean_left
    np.testing.assert_allclose(later, [0, float(red_s == 10), 0, 0])


@pytest.mark.parametrize(
    ("red_s", "share"),
    [(1.0, 1.5 / 2.5), (2.0, 0.5 / 2.5)],  # of 2.5 s, gone in the second 2 or 3
)
def test_a_part_of_a_second_counts_as_a_part(
    red_s: float, share: float, simulator: LibsumoSimulator, start: Any
) -> None:
    start(ONE_WAITS, step_s=0.5)
    simulator.advance(10, {"C": [(10.0, "Gr")]})
    snapshot = simulator.advance(2.5, {"C": [(red_s, "Gr"), (2.5 - red_s, "rG")]})
    assert snapshot.mean_left[WEST] == pytest.approx(share)
    # nothing of the part is left for the next interval
    later = simulator.advance(0.5, {"C": [(0.5, "rG")]}).mean_left
    assert later.tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("step_s", [0.1, 0.4, 2.0, 5.0])
def test_seconds_within_a_step_of_the_simulation_are_as_the_last_step_left_them(
    step_s: float, simulator: LibsumoSimulator, start: Any
) -> None:
    start(ONE_WAITS, crossings=False, step_s=step_s)
    simulator.advance(10, {"C": [(10.0, "Gr")]})
    steps = round(10 / step_s)
    there = [1.0]
    there += [
        simulator.advance(step_s, {"C": [(step_s, "rG")]}).vehicles[WEST] for _ in range(steps)
    ]
    gone = [1 - there[int(second / step_s + 1e-6)] for second in range(1, 11)]
    start(ONE_WAITS, step_s=step_s)
    simulator.advance(10, {"C": [(10.0, "Gr")]})
    found = simulator.advance(10, {"C": [(10.0, "rG")]}).mean_left[WEST]
    assert found == pytest.approx(np.mean(gone)) and 0 < found < 1


def test_several_vehicles_add_up_as_counts_by_the_second_do(
    simulator: LibsumoSimulator, start: Any
) -> None:
    start(TWO_WAIT, crossings=False)
    present = [simulator.advance(10, {"C": [(10.0, "Gr")]}).vehicles[WEST]]
    for second in range(10):
        state = "Gr" if second < 2 else "rG"
        present.append(simulator.advance(1, {"C": [(1.0, state)]}).vehicles[WEST])
    assert present[0] == 2 and present[-1] == 0 and 1 in present
    start(TWO_WAIT)
    simulator.advance(10, {"C": [(10.0, "Gr")]})
    found = simulator.advance(10, {"C": [(2.0, "Gr"), (8.0, "rG")]})
    assert found.vehicles[WEST] == 0
    # Nobody arrives, so whoever is not there any more has left.
    assert found.mean_left[WEST] == pytest.approx(np.mean([2 - n for n in present[1:]]))


def test_who_arrives_at_the_end_of_a_journey_has_left_too(
    simulator: LibsumoSimulator, start: Any
) -> None:
    start(
        '<vehicle id="last" type="car" depart="0" departPos="455" departSpeed="10">'
        '<route edges="C_E"/></vehicle>'
    )
    there = [simulator.advance(1, {}).vehicles[3] for _ in range(10)]
    assert there[0] == 1 and there[-1] == 0
    simulator.close()
    start(
        '<vehicle id="last" type="car" depart="0" departPos="455" departSpeed="10">'
        '<route edges="C_E"/></vehicle>'
    )
    left = simulator.advance(10, {}).mean_left
    np.testing.assert_allclose(left, [0, 0, 0, there.count(0) / 10])


@pytest.mark.parametrize(
    ("attributes", "end", "stop", "first_s", "last_s"),
    [
        ("", "ME", '<stop lane="wM_0" endPos="50" duration="60" parking="true"/>', 70, 100),
        ("", "ME", '<stop lane="wM_0" endPos="50" duration="60"/>', 70, 100),
        ("", "ME", '<stop lane="ME_0" endPos="50" duration="60" parking="true"/>', 10, 20),
        ('arrivalPos="20"', "", "", 0, 0),
        ('arrivalPos="max"', "", "", 0, 0),
    ],
    ids=["parks", "stops", "parks beyond", "ends on the lane", "ends at the line"],
)
def test_only_who_comes_past_the_end_of_a_road_at_a_light_has_left(
    attributes: str, end: str, stop: str, first_s: int, last_s: int,
    simulator: LibsumoSimulator, tmp_path: Path,
) -> None:  # fmt: skip
    car = f'<vehicle id="0" depart="0" {attributes}><route edges="Ww wM {end}"/>{stop}</vehicle>'
    scenario = crossroads_with(car, tmp_path, 100, 120)
    network = Network.read(scenario)
    (light,) = network.intersections
    green = "".join("G" if link.from_edge == "wM" else "r" for link in light.links)
    lanes = network.lane_table().ids
    simulator.start(launch_of(scenario, 1, tmp_path / "own", lanes, crossings=True))
    place = lanes.index("wM_0")
    left = [simulator.advance(1, {"M": [(1.0, green)]}).mean_left[place] for _ in range(110)]
    assert sum(left) == sum(left[first_s:last_s]) == (last_s > 0)


@pytest.mark.parametrize("measured", ["_0", "_1", ""])
def test_on_many_lanes_it_is_who_is_on_another_road_a_second_later(
    measured: str, simulator: LibsumoSimulator, tmp_path: Path
) -> None:
    """Changing lanes is not leaving. Roads are asked of the vehicles, second by second."""
    scenario = load_scenario("single-v1").with_duration(200)
    known = Network.read(scenario).lane_table().ids
    lanes = tuple(lane for lane in known if lane.endswith(measured))
    index = {lane: place for place, lane in enumerate(lanes)}
    launch = launch_of(scenario, 3, tmp_path / "own", lanes, crossings=True)

    def on_roads() -> dict[str, tuple[str, str]]:
        api = libsumo.vehicle
        return {name: (api.getRoadID(name), api.getLaneID(name)) for name in api.getIDList()}

    simulator.start(launch)
    expected, single, changed = np.zeros((20, len(lanes))), np.zeros((20, len(lanes))), 0
    before = on_roads()
    for interval in range(20):
        left, summed = np.zeros(len(lanes)), np.zeros(len(lanes))
        for _ in range(10):
            summed += simulator.advance(1, {}).mean_left
            now = on_roads()
            for name, (road, lane) in before.items():
                then = now.get(name, ("", ""))
                changed += then[0] == road and then[1] != lane
                if then[0] != road and lane in index:
                    left[index[lane]] += 1
            expected[interval] += left / 10
            single[interval] += summed / 10
            before = now
    assert changed and expected.sum() > 20
    np.testing.assert_allclose(single, expected)
    simulator.start(launch)
    for interval in range(20):
        found = simulator.advance(10, {}).mean_left
        np.testing.assert_allclose(found, expected[interval], err_msg=str(interval))


@pytest.mark.parametrize(
    ("attributes", "stop", "count"),
    [
        ("", "", 15),
        ("", '<stop lane="ME_0" endPos="60" duration="5" parking="true"/>', 15),
        ('departEdge="2" departPos="0"', "", 0),
        ('departEdge="2"', '<stop lane="ME_0" endPos="60" duration="5" parking="true"/>', 0),
    ],
    ids=["crosses", "parks beyond", "departs beyond", "departs and parks beyond"],
)
def test_who_crosses_a_short_lane_within_a_second_counts_once(
    attributes: str, stop: str, count: int, simulator: LibsumoSimulator, tmp_path: Path
) -> None:
    """A car drives 12 m in a second, and the lane at the light has 7 m."""
    cars = "".join(
        f'<vehicle id="{n}" depart="{4 * n}" departSpeed="max" {attributes}>'
        f'<route edges="Ww wM ME"/>{stop}</vehicle>'
        for n in range(15)
    )
    scenario = crossroads_with(cars, tmp_path, 11, 120)
    network = Network.read(scenario)
    (light,) = network.intersections
    green = "".join("G" if link.from_edge == "wM" else "r" for link in light.links)
    table = network.lane_table()
    assert network.lanes["wM_0"].length_m < 7.5
    simulator.start(launch_of(scenario, 1, tmp_path / "own", table.ids, crossings=True))
    states = ["r" * len(green)] * 20 + [green] * 80  # some wait, and most drive through
    left = np.sum(
        [simulator.advance(1, {"M": [(1.0, state)]}).mean_left for state in states], axis=0
    )
    assert left[table.ids.index("wM_0")] == count


def test_looking_changes_nothing_else_and_is_not_done_unasked(
    simulator: LibsumoSimulator, start: Any
) -> None:
    seen: list[list[tuple[Any, ...]]] = []
    for crossings in (False, True):
        rows = [start(TWO_WAIT, crossings)]
        rows += [simulator.advance(10, {"C": [(3.0, "Gr"), (7.0, "rG")]}) for _ in range(3)]
        assert [len(row.mean_left) for row in rows] == [0] + [4 * crossings] * 3
        seen.append([(r.vehicles.tolist(), r.halting.tolist(), r.departed) for r in rows])
    assert seen[0] == seen[1]


def test_processes_count_like_this_process() -> None:
    def rows(simulator: str, crossings: bool) -> list[list[float]]:
        env = parallel_env("single-v1", duration_s=150, simulator=simulator, crossings=crossings)
        env.reset(seed=2)
        found: list[list[float]] = [env.snapshot.mean_left.tolist()]
        while env.agents:
            env.step(dict.fromkeys(env.agents, len(found) // 2 % 4))
            found.append(env.snapshot.mean_left.tolist())
        env.close()
        return found

    own = rows("inprocess", True)
    assert own == rows("process", True)
    assert not own[0] and sum(map(sum, own)) > 10
    assert rows("process", False) == [[]] * 16


def test_a_snapshot_without_those_who_left() -> None:
    snapshot = Snapshot(
        10.0,
        np.array([3.0, 1.0, 0.0]),
        np.array([2.0, 0.5, 0.0]),
        np.full(3, 9.0),
        np.empty(0),
        4,
        0,
    )
    less = snapshot.less(np.array([0.5, 1.0, 0.25]))
    assert less.vehicles.tolist() == [2.5, 0.0, -0.25]  # came and left: below nothing
    assert less.halting.tolist() == [1.5, 0.0, 0.0]
    assert snapshot.vehicles.tolist() == [3.0, 1.0, 0.0]
    assert (less.time_s, less.departed) == (10.0, 4)


# --- recording


@pytest.mark.parametrize(("delay_s", "left"), [(0, 1.0), (3, 0.7), (9, 0.1)])
def test_a_log_holds_the_features_without_those_who_left(
    delay_s: int, left: float, crossing: Crossing
) -> None:
    env = parallel_env(crossing(vehicles=ONE_WAITS), duration_s=40, crossings=True)
    step = env.step

    def delayed(actions: Mapping[str, int]) -> Any:
        env.delay_greens(dict.fromkeys(env.agents, float(delay_s)))
        return step(actions)

    env.step = delayed
    log = roll_out(env, Plan(0, 1, 1, 0), 1, record=observer_of(env)).log
    env.close()
    assert log is not None
    rows = log.transitions("signal_0")
    # The car waits in the first interval, leaves in the second, and drives on.
    expected = np.array([[0, 0], [0, 1 - left], [0, 0], [0, 0]]) / 40
    np.testing.assert_allclose(rows.served_features, expected, atol=1e-6)
    np.testing.assert_allclose(rows.observation[:, 1] * 40, [0, 1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(rows.next_observation[:, 1] * 40, [1, 0, 0, 0], atol=1e-6)


def test_who_comes_and_leaves_within_an_interval_counts_below_nothing(crossing: Crossing) -> None:
    passing = (
        '<vehicle id="p" type="car" route="east" depart="2" departPos="470" departSpeed="10"/>'
    )
    env = parallel_env(crossing(vehicles=passing), duration_s=40, crossings=True)
    log = roll_out(env, Plan(1, 1, 1, 1), 1, record=observer_of(env)).log
    env.close()
    assert log is not None
    rows = log.transitions("signal_0")
    served = rows.served_features[:, 1] * 40
    assert not rows.observation[:, 1].any() and not rows.next_observation[:, 1].any()
    assert -0.8 < served[0] < -0.3
    assert served[1:].tolist() == [0, 0, 0]


@pytest.mark.parametrize("observation", ["count", "queue", "density", "pressure", "movements"])
def test_every_observation_of_counts_is_recorded_in_its_own_terms(observation: str) -> None:
    env = parallel_env("single-v1", duration_s=120, crossings=True, observation=observation)
    observer = observer_of(env)
    snapshots: list[Snapshot] = []
    log = roll_out(
        env, Plan(*range(4), *range(4)), 5, record=observer,
        on_step=lambda _: snapshots.append(env.snapshot),
    ).log  # fmt: skip
    env.close()
    assert log is not None
    rows = log.transitions("signal_0")
    layout = log.provenance.layouts["signal_0"]
    assert rows.served_features.shape == (12, layout.features)
    for step in range(1, 12):
        less = snapshots[step - 1].less(snapshots[step].mean_left)
        (expected,) = observer.observe(less, [0])
        assert np.array_equal(rows.served_features[step], expected[: layout.features])
    before = rows.observation[:, : layout.features]
    assert (rows.served_features != before).any()
    if observation != "pressure":
        assert (rows.served_features <= before + 1e-6).all()


@pytest.mark.parametrize(
    "options", [{"crossings": False}, {"crossings": True, "observation": "waiting"}]
)
def test_what_was_not_measured_is_an_empty_list(options: dict[str, Any]) -> None:
    """Nor does it say anything of waiting times who has left."""
    env = parallel_env("single-v1", duration_s=50, **options)
    log = roll_out(env, Plan(), 5, record=observer_of(env)).log
    env.close()
    assert log is not None
    assert log.frame["served_features"].to_list() == [[]] * 5
    assert log.transitions("signal_0").served_features.shape == (5, 0)
    stacked = stack_log(log, Stack(log.provenance.layouts))
    assert stacked.served_features is None and stacked.outcome is stacked.next_observation


# --- the columns of a log


LAYOUTS = {"a_0": AgentLayout(3, 2, 1), "b_0": AgentLayout(2, 4)}


def recorded(steps: int = 3, crossings: bool = True) -> TransitionLog:
    provenance = Provenance("toy-v1", "", "sim", (1,), 10.0, "count", LAYOUTS)
    recorder = TransitionRecorder(provenance)
    rng = np.random.default_rng(0)
    for step in range(steps):
        seen = {a: rng.random(v.size, np.float32) for a, v in LAYOUTS.items()}
        left = {a: seen[a][: v.features] - np.float32(0.5) for a, v in LAYOUTS.items()}
        did, got = dict.fromkeys(LAYOUTS, 1), dict.fromkeys(LAYOUTS, 0.0)
        late = {"a_0": step / 2, "b_0": 0.0}
        recorder.record(0, step, seen, did, did, got, seen, late, left if crossings else None)
    return recorder.log()


def test_both_columns_are_written_and_read_back(tmp_path: Path) -> None:
    log = recorded()
    log.write(tmp_path / "log.parquet")
    again = TransitionLog.read(tmp_path / "log.parquet")
    assert again.frame.equals(log.frame)
    rows = again.transitions("a_0")
    assert rows.delay_s.tolist() == [0.0, 0.5, 1.0] and rows.delay_s.dtype == np.float32
    assert np.array_equal(rows.served_features, rows.observation[:, :3] - np.float32(0.5))
    stacked = stack_log(again, Stack(LAYOUTS))
    assert stacked.served_features is not None and stacked.outcome is stacked.served_features
    assert np.array_equal(stacked.served_features[0], rows.served_features)
    assert not stacked.served_features[1, :, 2].any()  # padding of an agent with fewer features
    assert stacked.delay_s.tolist() == [[0.0, 0.5, 1.0], [0.0] * 3]


def test_logs_written_without_the_columns_are_still_read(tmp_path: Path) -> None:
    log = recorded()
    old = log.frame.drop("delay_s", "served_features")
    metadata = {"ugat_marl.data.transitions": log.provenance.to_json()}
    write_hashed(old, tmp_path / "old.parquet", metadata)
    again = TransitionLog.read(tmp_path / "old.parquet")
    for agent, layout in LAYOUTS.items():
        rows, whole = again.transitions(agent), log.transitions(agent)
        assert np.array_equal(rows.observation, whole.observation)
        assert rows.delay_s.tolist() == [0.0] * 3
        assert rows.served_features.shape == (3, 0)
        assert again.provenance.layouts[agent] == layout
    again.write(tmp_path / "again.parquet")
    assert TransitionLog.read(tmp_path / "again.parquet").frame.equals(again.frame)
    both = TransitionLog.concatenate([log, again])
    assert both.transitions("a_0").served_features.shape == (6, 0)  # not measured everywhere
    assert stack_log(both, Stack(LAYOUTS)).served_features is None


def test_an_empty_log_has_the_columns() -> None:
    rows = recorded(steps=0).transitions("a_0")
    assert len(rows) == 0 and rows.delay_s.shape == (0,)
    assert rows.served_features.shape == (0, 3)


def changed(column: str, values: list[Any]) -> pl.DataFrame:
    return recorded(steps=1).frame.with_columns(pl.Series(column, values, strict=False))


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("frame", "complaint"),
    [
        (changed("served_features", [[0.0] * 4, [0.0] * 2]), "a_0: served_features has the wrong"),
        (changed("served_features", [[0.0] * 2, [0.0] * 2]), "a_0: served_features has the wrong"),
        (changed("served_features", [[0.0] * 3, [0.0] * 6]), "b_0: served_features has the wrong"),
        (
            changed("served_features", [[0.0] * 3, [NAN, 0.0]]),
            "b_0: served_features holds a number",
        ),
        (changed("served_features", [[0.0, INF, 0.0], []]), "a_0: served_features holds a number"),
        (changed("served_features", [[0.0, None, 0.0], []]), "a_0: served_features holds a number"),
        (changed("served_features", [None, [0.0] * 2]), "'served_features' has missing values"),
        (changed("served_features", ["x", "y"]), "'served_features' has type String"),
        (changed("delay_s", [-0.5, 0.0]), "a_0: delay_s is not a time to wait"),
        (changed("delay_s", [0.0, NAN]), "b_0: delay_s is not a time to wait"),
        (changed("delay_s", [None, 0.0]), "'delay_s' has missing values"),
        (changed("delay_s", ["0", "0"]), "'delay_s' has type String"),
    ],
)
def test_impossible_columns_are_refused(frame: pl.DataFrame, complaint: str) -> None:
    with pytest.raises(LogError, match=complaint):
        TransitionLog(recorded().provenance, frame)


def test_served_features_of_an_agent_are_not_left_out_in_a_record() -> None:
    recorder = TransitionRecorder(recorded().provenance)
    seen = {a: np.zeros(v.size, np.float32) for a, v in LAYOUTS.items()}
    one = dict.fromkeys(LAYOUTS, 0)
    some = {"a_0": np.zeros(3, np.float32)}
    with pytest.raises(LogError, match="agent 'b_0' is missing"):
        recorder.record(0, 0, seen, one, one, one, seen, None, some)
    with pytest.raises(LogError, match="agent 'b_0' is missing"):
        recorder.record(0, 0, seen, one, one, one, seen, {"a_0": 0.0})
    assert len(recorder) == 0
    long = {a: np.zeros(v.size, np.float32) for a, v in LAYOUTS.items()}
    recorder.record(0, 0, seen, one, one, one, seen, None, long)
    with pytest.raises(LogError, match="served_features has the wrong length"):
        recorder.log()
