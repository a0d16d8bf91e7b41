"""Clearance times read off logs written by hand, and counts put where detections would be."""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from ugat_marl.data import MeasuredData
from ugat_marl.diagnosis import DiagnosisConfig, diagnose
from ugat_marl.diagnosis.features import (
    BIN_FEATURES,
    FEATURES,
    INDEX,
    DetectorLayout,
)
from ugat_marl.diagnosis.intervals import bins_together, counts_tally, without_gaps
from ugat_marl.diagnosis.signal_timing import timing_effects
from ugat_marl.diagnosis.statistics import Pools
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.effects import load_scenario
from ugat_marl.scenarios import Network, Period, Scenario, SignalLog
from ugat_marl.simulation import standard_detectors

THRESHOLDS = Thresholds()


@pytest.fixture(scope="module")
def scenario(data: Path) -> Scenario:
    return load_scenario(data / "crossing").with_control(yellow_s=3.0, all_red_s=2.0)


@pytest.fixture(scope="module")
def network(scenario: Scenario) -> Network:
    return Network.read(scenario)


def cycles(
    count: int, yellow: float, red: float, green: float = 20.0, jitter: float = 0.0
) -> SignalLog:
    """North and east in turn."""
    rows: list[tuple[float, str]] = []
    time = 0.0
    for index in range(count):
        for states in (("Gr", "yr"), ("rG", "ry")):
            for state, duration in (
                (states[0], green), (states[1], yellow + jitter * (index % 2)), ("rr", red),
            ):  # fmt: skip
                if duration > 0:
                    rows.append((time, state))
                    time += duration
    return tuple(rows)


def found(scenario: Scenario, network: Network, log: SignalLog, tls: str = "C") -> list[str]:
    period = Period("day1", 0.0, 3600.0, "fit", {tls: log}, {})
    measured = MeasuredData(standard_detectors(network), (period,))
    return [str(effect) for effect in timing_effects(scenario, network, measured, THRESHOLDS)]


def test_the_same_times_are_no_effect(scenario: Scenario, network: Network) -> None:
    assert found(scenario, network, cycles(30, 3.0, 2.0)) == []


def test_longer_yellow_and_all_red_are_read_off(scenario: Scenario, network: Network) -> None:
    assert found(scenario, network, cycles(30, 4.0, 2.0)) == ["yellow_time=4"]
    assert found(scenario, network, cycles(30, 3.0, 1.0)) == ["all_red_time=1"]
    assert found(scenario, network, cycles(30, 4.5, 0.5)) == ["yellow_time=4.5", "all_red_time=0.5"]


@pytest.mark.parametrize(
    ("left_out", "named"),
    [
        ((), ["yellow_time", "all_red_time"]),
        (("yellow_time",), ["all_red_time"]),
        (("all_red_time", "headway"), ["yellow_time"]),
        (("yellow_time", "all_red_time"), []),
    ],
)
def test_what_the_log_tells_can_be_left_out(
    scenario: Scenario,
    network: Network,
    tmp_path: Path,
    left_out: tuple[str, ...],
    named: list[str],
) -> None:
    period = Period("day1", 0.0, 3600.0, "fit", {"C": cycles(30, 4.5, 0.5)}, {})
    measured = MeasuredData(standard_detectors(network), (period,))
    # Nothing is simulated within such a budget; the log is read all the same.
    config = DiagnosisConfig(budget_s=1e-9, leave_out=left_out, cache=tmp_path / "cache")
    diagnosis = diagnose(scenario, measured, tmp_path / "found", config)
    assert [effect.name for effect in diagnosis.effects] == named
    assert (diagnosis.corrected is not None) == bool(named)


def test_a_diagnosis_that_cannot_be_written_leaves_the_earlier_one(
    scenario: Scenario, network: Network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diagnosed(yellow: float) -> None:
        period = Period("day1", 0.0, 3600.0, "fit", {"C": cycles(30, yellow, 0.5)}, {})
        measured = MeasuredData(standard_detectors(network), (period,))
        config = DiagnosisConfig(budget_s=1e-9, cache=tmp_path / "cache")
        diagnose(scenario, measured, tmp_path / "found", config)

    def written() -> dict[Path, bytes]:
        names = ("diagnosis.json", "corrected/*")
        return {
            path: path.read_bytes() for name in names for path in (tmp_path / "found").glob(name)
        }

    def full(_scenario: Scenario, place: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(place))

    diagnosed(4.5)
    earlier = written()
    assert len(earlier) > 2
    monkeypatch.setattr(Scenario, "write", full)
    with pytest.raises(OSError, match="No space left"):
        diagnosed(4.0)
    assert written() == earlier
    monkeypatch.undo()
    diagnosed(4.0)
    assert written().keys() == earlier.keys() and written() != earlier


def test_green_right_behind_yellow_is_no_all_red(scenario: Scenario, network: Network) -> None:
    assert found(scenario, network, cycles(30, 3.0, 0.0)) == ["all_red_time=0"]


def test_a_red_that_no_clearance_has_is_a_phase_of_others(
    scenario: Scenario, network: Network
) -> None:
    assert found(scenario, network, cycles(30, 4.0, 22.0)) == ["yellow_time=4"]


def test_a_single_green_has_no_all_red(scenario: Scenario, network: Network) -> None:
    """15 s of pedestrians, whose links are not in the network, are no clearance."""
    shown = [(0, "Gr"), (20, "yr"), (24, "rr")]
    log = tuple((39.0 * i + time, state) for i in range(30) for time, state in shown)
    assert found(scenario, network, log) == ["yellow_time=4"]


def test_a_few_clearances_prove_nothing(scenario: Scenario, network: Network) -> None:
    assert found(scenario, network, cycles(5, 4.0, 2.0)) == []


def test_times_that_vary_are_no_setting(scenario: Scenario, network: Network) -> None:
    assert found(scenario, network, cycles(30, 4.0, 2.0, jitter=1.0)) == []


def test_stamps_of_a_hundredth_more_are_no_effect(scenario: Scenario, network: Network) -> None:
    assert found(scenario, network, cycles(30, 3.04, 1.96)) == []


def test_the_networks_own_programme_is_no_control(scenario: Scenario, network: Network) -> None:
    # It knows no yellow, whatever the control would do.
    log = tuple(
        (50.0 * i + add, state) for i in range(40) for add, state in ((0, "Gr"), (40, "rG"))
    )
    assert found(scenario, network, log) == []


@pytest.mark.parametrize(("longer_s", "named"), [(0.0, []), (2.0, ["yellow_time=5"])])
def test_other_yellow_in_the_states_of_the_own_programme_is_read_off(
    longer_s: float, named: list[str]
) -> None:
    grid = load_scenario("grid2x2-v1")
    network = Network.read(grid)
    light = network.intersections[0]
    rows: list[tuple[float, str]] = []
    time = 0.0
    for _ in range(12):
        for seconds, state in light.programme:
            rows.append((time, state))
            time += seconds + (longer_s if "y" in state else 0.0)
    assert found(grid, network, tuple(rows), tls=light.id) == named


def test_traffic_lights_that_nobody_controls_tell_nothing(
    scenario: Scenario, network: Network
) -> None:
    assert found(scenario, network, cycles(30, 5.0, 2.0), tls="elsewhere") == []


def test_links_that_stay_green_do_not_hide_a_yellow(scenario: Scenario, network: Network) -> None:
    rows: list[tuple[float, str]] = []
    for index in range(30):
        start = 40.0 * index
        rows += [(start, "GG"), (start + 20, "Gy"), (start + 24, "Gr")]
    assert "yellow_time=4" in found(scenario, network, tuple(rows))


def test_yellows_that_overlap_are_timed_link_by_link(scenario: Scenario, network: Network) -> None:
    """Two rings: the second one turns yellow 2 s after the first one."""
    shown = [(0, "GG"), (20, "yG"), (22, "yy"), (24, "ry"), (26, "rr")]
    log = tuple((28.0 * i + time, state) for i in range(30) for time, state in shown)
    assert found(scenario, network, log) == ["yellow_time=4"]


# --- counts only ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def layout(network: Network) -> DetectorLayout:
    return DetectorLayout.of(network, standard_detectors(network))


def counts(*rows: tuple[str, float, float, str, float]) -> pl.DataFrame:
    names = ("period_id", "begin_s", "end_s", "detector_id", "count")
    return pl.DataFrame(rows, schema=names, orient="row")


PERIOD = Period("day1", 0.0, 900.0, "fit", {}, {})


def test_counts_stand_where_detections_would(layout: DetectorLayout) -> None:
    table = counts(
        ("day1", 0.0, 300.0, "stop:S_C_0", 10),
        ("day1", 300.0, 600.0, "stop:S_C_0", 20),
        ("day1", 600.0, 900.0, "stop:S_C_0", 30),
        ("day1", 0.0, 900.0, "exit:C_E_0", 90),
        ("day2", 0.0, 900.0, "stop:S_C_0", 999),
        ("day1", 0.0, 900.0, "nowhere", 999),
    )
    found = counts_tally(
        layout, PERIOD, table, without_gaps(table, [PERIOD], THRESHOLDS), THRESHOLDS
    )
    lane = next(i for i, item in enumerate(layout.lanes) if item.id == "S_C_0")
    behind = next(i for i, item in enumerate(layout.exits) if item[1] == "C_E_0")
    assert found.sums[INDEX["count_stop"], lane].tolist() == [60.0, 15.0]
    assert found.bins[BIN_FEATURES.index("count_stop"), lane].tolist() == [10.0, 20.0, 30.0]
    place = len(layout.lanes) + behind
    assert found.sums[INDEX["count_exit"], place].tolist() == [90.0, 15.0]
    assert found.bins[BIN_FEATURES.index("count_exit"), place].tolist() == [30.0, 30.0, 30.0]
    others = [i for i, (name, _, _) in enumerate(FEATURES) if not name.startswith("count_")]
    assert found.sums.sum() == 60 + 15 + 90 + 15
    assert not found.sums[others].any(), "nothing else is known"


def test_a_count_across_bins_is_shared_out(layout: DetectorLayout) -> None:
    table = counts(
        ("day1", 0.0, 200.0, "stop:S_C_0", 20),
        ("day1", 200.0, 600.0, "stop:S_C_0", 40),
        ("day1", 600.0, 900.0, "stop:S_C_0", 5),
    )
    found = counts_tally(
        layout, PERIOD, table, without_gaps(table, [PERIOD], THRESHOLDS), THRESHOLDS
    )
    lane = next(i for i, item in enumerate(layout.lanes) if item.id == "S_C_0")
    assert found.bins[BIN_FEATURES.index("count_stop"), lane] == pytest.approx([30.0, 30.0, 5.0])
    assert bins_together(table, THRESHOLDS) == 2, "nobody knows when in 400 s they came"
    pooled = Pools.of(layout, THRESHOLDS, 2).pool(found)["time"]
    row = BIN_FEATURES.index("count_stop") * len(layout.places) + lane
    assert pooled[row].tolist() == [[60.0, 1.0]], "what is left at the end is not used"


def test_what_was_not_counted_is_no_count_of_zero(layout: DetectorLayout) -> None:
    table = counts(
        ("day1", 0.0, 300.0, "stop:S_C_0", 10),
        ("day1", 600.0, 900.0, "stop:S_C_0", 30),
        ("day1", 0.0, 900.0, "exit:C_E_0", 90),
    )
    whole = without_gaps(table, [PERIOD], THRESHOLDS)
    assert whole == {"exit:C_E_0"}
    assert not without_gaps(table, [PERIOD, replace(PERIOD, id="day2")], THRESHOLDS)
    found = counts_tally(layout, PERIOD, table, whole, THRESHOLDS)
    lane = next(i for i, item in enumerate(layout.lanes) if item.id == "S_C_0")
    line = BIN_FEATURES.index("count_stop"), lane
    assert found.bins[line].tolist() == [10.0, 0.0, 30.0]
    assert found.counted[line].tolist() == [1.0, 0.0, 1.0]
    assert not found.counted[BIN_FEATURES.index("occupied")].any()
    assert not found.sums[:, lane].any(), "the mean of some hours is not that of all"
    twice = found + found
    assert twice.counted[line].tolist() == [2.0, 0.0, 2.0]
    events = replace(found, known=None)
    assert (found + events).counted[line].tolist() == [2.0, 1.0, 2.0]


def test_no_counts_no_weight(layout: DetectorLayout) -> None:
    found = counts_tally(
        layout, PERIOD, counts().cast({"period_id": pl.String}), frozenset(), THRESHOLDS
    )
    assert not found.sums.any()
    assert not found.counted.any()
    assert found.bins.shape[-1] == 3
