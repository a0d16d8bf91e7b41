"""Logs of signal controllers: every state and vehicle at its second, by hand and by round trip.

The crossing of tests/data has two links: 0 from the south, 1 from the west.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from rich.console import Console

from ugat_marl.cli.import_atspm import ImportAtspm
from ugat_marl.data import MeasuredData, import_atspm, read_measured, split_periods
from ugat_marl.errors import MeasuredDataError, UgatMarlError
from ugat_marl.scenarios import Detector, Network, Passages, Period, Scenario, read_scenario

ZERO = dt.datetime(2024, 3, 5, 7, 0, 0)
MAPPING = """
zero = [2024-03-05T07:00:00]

[[devices]]
id = 7
tls = "C"
phases = { 2 = [0], 4 = [1] }

[[devices.detectors]]
channel = 5
lane = "S_C_0"
position_m = 487
kind = "stop"

[[devices.detectors]]
channel = 6
id = "advance west"
lane = "W_C_0"
position_m = 440
length_m = 2
kind = "advance"
"""
LOG = [
    (-10.0, 1, 2),
    (20.0, 8, 2),
    (23.5, 9, 2),
    (23.5, 10, 2),
    (25.0, 11, 2),
    (25.0, 1, 4),
    (31.2, 82, 5),
    (33.0, 82, 6),
    (33.4, 81, 6),
    (35.9, 81, 5),
    (45.0, 8, 4),
    (48.0, 9, 4),
    (48.0, 12, 4),
    (50.0, 1, 2),
    (51.0, 82, 5),
    (51.7, 81, 5),
    (52.0, 82, 99),
    (52.1, 43, 4),
]
SIGNALS = (
    (-10.0, "Gr"),
    (20.0, "yr"),
    (23.5, "rr"),
    (25.0, "rG"),
    (45.0, "ry"),
    (48.0, "rr"),
    (50.0, "Gr"),
)


def log(
    events: list[tuple[float, int, int]], device: object = 7, zero: dt.datetime = ZERO
) -> pl.DataFrame:
    return pl.DataFrame(
        {
            "TimeStamp": [zero + dt.timedelta(seconds=time) for time, _, _ in events],
            "DeviceId": [device for _ in events],
            "EventId": [code for _, code, _ in events],
            "Parameter": [number for _, _, number in events],
        }
    )


Import = Callable[..., MeasuredData]
Rows = list[tuple[float, int, int]]


@pytest.fixture
def imported(tmp_path: Path, scenario: Scenario, network: Network) -> Import:
    """Writes a log and a mapping, and imports them."""

    def run(
        frame: pl.DataFrame | None = None,
        mapping: str = MAPPING,
        csv: bool = False,
        where: tuple[Scenario, Network] | None = None,
    ) -> MeasuredData:
        frame = log(LOG) if frame is None else frame
        file = tmp_path / f"events.{'csv' if csv else 'parquet'}"
        frame.write_csv(file) if csv else frame.write_parquet(file)
        (tmp_path / "mapping.toml").write_text(mapping)
        return import_atspm(file, tmp_path / "mapping.toml", *(where or (scenario, network)))

    return run


def texts(measured: MeasuredData) -> str:
    return "\n".join(finding.text for finding in measured.findings)


@pytest.mark.parametrize("csv", [False, True])
def test_a_log_counted_by_hand(imported: Import, csv: bool) -> None:
    read = imported(csv=csv)
    assert read.detectors == (
        Detector("7:5", "S_C_0", 487.0, 0.0, "stop", clock="signals"),
        Detector("advance west", "W_C_0", 440.0, 2.0, "advance", clock="signals"),
    )
    period = read.periods[0]
    assert (period.id, period.begin_s, period.end_s) == ("2024-03-05T0700", 0.0, 200.0)
    assert period.signals == {"C": SIGNALS}
    stop = period.passages["7:5"]
    np.testing.assert_array_equal(stop.on_s, [31.2, 51.0])
    np.testing.assert_array_equal(stop.off_s, [35.9, 51.7])
    assert np.isnan(stop.speed_mps).all()
    np.testing.assert_array_equal(period.passages["advance west"].off_s, [33.4])


def test_links_on_which_vehicles_may_go_on_red(imported: Import) -> None:
    read = imported(mapping=MAPPING.replace('tls = "C"', 'tls = "C"\non_red = [1]'))
    shown = tuple((since, state[0] + state[1].replace("r", "s")) for since, state in SIGNALS)
    assert read.periods[0].signals == {"C": shown}
    with pytest.raises(MeasuredDataError, match="link 2 does not exist"):
        imported(mapping=MAPPING.replace('tls = "C"', 'tls = "C"\non_red = [2]'))


def test_what_was_shown_before_the_log_begins_follows_from_its_first_events(
    imported: Import,
) -> None:
    read = imported(log(LOG[1:]))
    assert read.periods[0].signals == {"C": ((0.0, "Gr"), *SIGNALS[1:])}


def test_names_of_columns_and_times_in_other_spellings(imported: Import) -> None:
    expected = imported().hash
    plain = log(LOG)
    lower = plain.rename(
        {
            "TimeStamp": "timestamp",
            "DeviceId": "device_id",
            "EventId": "event_id",
            "Parameter": "parameter",
        }
    )
    assert imported(lower, csv=True).hash == expected
    utah = plain.rename(
        {
            "TimeStamp": "Timestamp",
            "DeviceId": "SignalID",
            "EventId": "EventCode",
            "Parameter": "EventParam",
        }
    ).with_columns(
        pl.col("SignalID").cast(pl.String),
        pl.col("Timestamp").dt.strftime("%m/%d/%Y %I:%M:%S%.3f %p"),
    )
    assert imported(utah, csv=True).hash == expected
    utc = plain.with_columns(
        pl.col("TimeStamp").dt.replace_time_zone("America/Denver").dt.convert_time_zone("UTC")
    )
    zoned = 'time_zone = "America/Denver"\n' + MAPPING
    assert imported(utc, zoned).hash == expected
    text = utc.with_columns(pl.col("TimeStamp").dt.strftime("%Y-%m-%dT%H:%M:%S%.3fZ"))
    assert imported(text, zoned, csv=True).hash == expected
    with pytest.raises(MeasuredDataError, match="has offsets from UTC, .* write the street's"):
        imported(utc)


BERLIN = 'time_zone = "Europe/Berlin"\n' + MAPPING


@pytest.mark.parametrize(
    ("zero", "utc"),
    [
        ("2025-10-26T02:59:00+02:00", dt.datetime(2025, 10, 26, 0, 59)),  # then 2:00 comes again
        ("2025-03-30T01:59:00", dt.datetime(2025, 3, 30, 0, 59)),  # then it is 3:00
    ],
)
def test_a_log_with_offsets_runs_on_over_a_change_of_the_clock(
    imported: Import, zero: str, utc: dt.datetime
) -> None:
    late = [(time + 30.0, code, number) for time, code, number in LOG]  # to 81 s: over the change
    frame = log(late, zero=utc).with_columns(pl.col("TimeStamp").dt.replace_time_zone("UTC"))
    (period,) = imported(frame, BERLIN.replace("2024-03-05T07:00:00", zero)).periods
    np.testing.assert_array_equal(period.passages["7:5"].on_s, [61.2, 81.0])
    later = [(since + 30.0, state) for since, state in SIGNALS]
    assert period.signals == {"C": ((0.0, "rr"), *later)}


def test_a_zero_that_clocks_showed_twice_or_never_is_refused_if_the_log_has_offsets(
    imported: Import,
) -> None:
    for zero, told in (("2025-10-26T02:30:00", "twice"), ("2025-03-30T02:30:00", "did not show")):
        mapping = BERLIN.replace("2024-03-05T07:00:00", zero)
        frame = log(LOG, zero=dt.datetime.fromisoformat(zero))
        (period,) = imported(frame, mapping).periods
        assert period.signals == {"C": SIGNALS}
        utc = frame.with_columns(pl.col("TimeStamp").dt.replace_time_zone("UTC"))
        with pytest.raises(MeasuredDataError, match=f"toml, entry 1: zero is .* {told}.* write ze"):
            imported(utc, mapping)


def test_one_zero_of_several_may_have_an_offset(imported: Import) -> None:
    days = [ZERO, ZERO + dt.timedelta(days=1)]
    zeros = "2024-03-05T07:00:00+01:00, 2024-03-06T07:00:00"
    frame = pl.concat([log(LOG, zero=day) for day in days])
    for period in imported(frame, BERLIN.replace("2024-03-05T07:00:00", zeros)).periods:
        assert period.signals == {"C": SIGNALS}


def test_periods_on_both_sides_of_a_change_of_the_clock_overlap_by_true_time(
    imported: Import,
) -> None:
    zeros = "2025-03-30T01:59:00, 2025-03-30T03:00:00"  # a minute apart
    start = dt.datetime(2025, 3, 30, 0, 59)
    frame = pl.concat([log(LOG, zero=start), log(LOG, zero=start + dt.timedelta(seconds=60))])
    utc = frame.with_columns(pl.col("TimeStamp").dt.replace_time_zone("UTC"))
    with pytest.raises(MeasuredDataError, match="overlap by 140 s"):
        imported(utc, BERLIN.replace("2024-03-05T07:00:00", zeros))


def test_detectors_that_are_stamped_late(imported: Import) -> None:
    read = imported(mapping=MAPPING.replace("channel = 5", "channel = 5\nlatency_s = 0.4"))
    np.testing.assert_array_equal(read.periods[0].passages["7:5"].on_s, [30.8, 50.6])


def test_a_late_stamp_belongs_to_the_period_in_which_it_happened(imported: Import) -> None:
    late = MAPPING.replace("channel = 5", "channel = 5\nlatency_s = 2.0")
    around = [
        (-1.0, 82, 5), (0.5, 81, 5),  # before the start
        (1.5, 82, 5), (2.5, 81, 5),  # on before the start, off in the period
        (199.0, 82, 5), (201.5, 81, 5),  # off in the period, though stamped after it
        (201.9, 82, 5), (203.0, 81, 5),  # off after the end
        (201.0, 8, 2), (201.0, 82, 6),  # without a delay, so of the time after the end
    ]  # fmt: skip
    read = imported(log(sorted(LOG + around)), late)
    (period,) = read.periods
    stop = period.passages["7:5"]
    np.testing.assert_array_equal(stop.on_s, [np.nan, 29.2, 49.0, 197.0, 199.9])
    np.testing.assert_array_equal(stop.off_s, [0.5, 33.9, 49.7, 199.5, np.nan])
    np.testing.assert_array_equal(period.passages["advance west"].on_s, [33.0])
    assert period.signals == {"C": SIGNALS}
    assert "outside of their periods" not in texts(read)


def test_several_days_are_several_periods(imported: Import) -> None:
    other = [(time + 0.1 * (code in (81, 82)), code, number) for time, code, number in LOG]
    days = [ZERO + dt.timedelta(days=i) for i in range(3)]
    frame = pl.concat([log(LOG, zero=days[0]), log(other, zero=days[1]), log(LOG, zero=days[2])])
    dates = ", ".join(day.isoformat() for day in days[:2])
    read = imported(frame, MAPPING.replace("2024-03-05T07:00:00", dates))
    assert [(period.id, period.split) for period in read.periods] == [
        ("2024-03-05T0700", "fit"),
        ("2024-03-06T0700", "heldout"),
    ]
    assert all(period.signals == {"C": SIGNALS} for period in read.periods)
    rows = """
[[periods]]
id = "wed"
zero = 2024-03-06T07:00:00
end_s = 100
split = "fit"
[[periods]]
id = "thu"
zero = 2024-03-07T07:00:00
begin_s = 30
split = "heldout"
"""
    read = imported(frame, MAPPING.replace("zero = [2024-03-05T07:00:00]", rows))
    assert [(p.id, p.begin_s, p.end_s, p.split) for p in read.periods] == [
        ("wed", 0.0, 100.0, "fit"),
        ("thu", 30.0, 200.0, "heldout"),
    ]
    assert read.periods[1].signals["C"][0] == (25.0, "rG")
    overlapping = MAPPING.replace("07:00:00]", "07:00:00, 2024-03-05T07:01:00]")
    with pytest.raises(MeasuredDataError, match="overlap by 140 s"):
        imported(frame, overlapping)


ARROWS = """
zero = [2024-03-05T07:00:00]

[[devices]]
id = "12"
tls = "A1"

[devices.phases]
2 = [0, 1, 2, 3]
5 = { green = [4], flashing = [4] }
6 = [10, 11, 12, 13]
1 = [14]
4 = { green = [6, 7, 8], permissive = [9] }
8 = [16, 17, 18, 19]

[devices.overlaps]
1 = [15]

[devices.constant]
5 = "g"

[[devices.detectors]]
channel = 1
lane = "northA_A1_0"
position_m = 100
kind = "stop"
"""


def test_overlaps_arrows_and_links_that_yield(imported: Import) -> None:
    scenario = read_scenario("single-v1")
    events = [
        (-60.0, 11, 4),
        (-60.0, 11, 8),
        (-5.0, 1, 2),
        (-5.0, 1, 6),
        (-4.0, 32, 5),
        (1.0, 82, 1),
        (2.0, 81, 1),
        (10.0, 33, 5),
        (12.0, 1, 5),
        (14.0, 8, 6),
        (16.0, 8, 5),
        (17.0, 9, 6),
        (19.0, 10, 5),
        (20.0, 61, 1),
        (22.0, 62, 1),
        (25.0, 63, 1),
        (28.0, 64, 1),
        (29.0, 65, 1),
        (30.0, 1, 4),
    ]
    read = imported(log(events, "12"), ARROWS, where=(scenario, Network.read(scenario)))
    states = dict(read.periods[0].signals["A1"])
    through, rest = "GGGG", "g" + "rrrr"
    assert states == {
        -4.0: through + "g" + rest + "GGGG" + "r" + "r" + "rrrr",
        10.0: through + "r" + rest + "GGGG" + "r" + "r" + "rrrr",
        12.0: through + "G" + rest + "GGGG" + "r" + "r" + "rrrr",
        14.0: through + "G" + rest + "yyyy" + "r" + "r" + "rrrr",
        16.0: through + "y" + rest + "yyyy" + "r" + "r" + "rrrr",
        17.0: through + "y" + rest + "rrrr" + "r" + "r" + "rrrr",
        19.0: through + "r" + rest + "rrrr" + "r" + "r" + "rrrr",
        20.0: through + "r" + rest + "rrrr" + "r" + "G" + "rrrr",
        25.0: through + "r" + rest + "rrrr" + "r" + "y" + "rrrr",
        28.0: through + "r" + rest + "rrrr" + "r" + "r" + "rrrr",
        30.0: through + "r" + "g" + "GGGg" + "rrrr" + "r" + "r" + "rrrr",
    }
    assert "phase 1 of device '12' is never logged: red" in texts(read)


def as_log(measured: MeasuredData, channels: dict[str, int]) -> pl.DataFrame:
    """The log a controller would have kept of a recording on the crossing."""
    codes = {("r", "G"): (1,), ("G", "y"): (8,), ("y", "r"): (9, 10)}
    events: list[tuple[float, int, int]] = []
    frames: list[pl.DataFrame] = []
    for index, period in enumerate(measured.periods):
        events = []
        before = "rr"
        for time, state in period.signals["C"]:
            for link, phase in ((0, 2), (1, 4)):
                pair = (before[link], state[link])
                events += [(time, code, phase) for code in codes.get(pair, ())]
            before = state
        for name, passages in period.passages.items():
            events += [(float(t), 82, channels[name]) for t in passages.on_s]
            events += [(float(t), 81, channels[name]) for t in passages.off_s]
        frames.append(log(sorted(events), zero=ZERO + dt.timedelta(days=index)))
    return pl.concat(frames)


def test_a_recording_that_became_a_log_is_the_same_recording(
    imported: Import, tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    cycle = ((0, "Gr"), (20, "yr"), (23, "rr"), (25, "rG"), (45, "ry"), (48, "rr"))
    signals = tuple((50.0 * i + t, state) for i in range(4) for t, state in cycle)
    rng = np.random.default_rng(0)

    def vehicles() -> Passages:
        on = np.round(np.arange(1, 195, 6) + rng.uniform(0, 3, 33), 1)
        nothing = np.full(33, np.nan)
        return Passages(on, np.round(on + rng.uniform(0.3, 2, 33), 1), nothing, nothing)

    channels = {"7:5": 5, "advance west": 6}
    detectors = (
        Detector("7:5", "S_C_0", 487.0, 0.0, "stop", clock="signals"),
        Detector("advance west", "W_C_0", 440.0, 2.0, "advance", clock="signals"),
    )
    days = tuple(
        Period(
            f"2024-03-0{5 + i}T0700", 0, 200, s, {"C": signals}, {d: vehicles() for d in channels}
        )
        for i, s in enumerate(split_periods(3))
    )
    street = MeasuredData(detectors, days)
    zeros = ", ".join(f"2024-03-0{5 + i}T07:00:00" for i in range(3))
    mapping = MAPPING.replace("2024-03-05T07:00:00", zeros)
    read = imported(as_log(street, channels), mapping)
    assert read.hash == street.hash

    directory = tmp_path / "street"
    command = ImportAtspm(
        str(Path(__file__).parents[1] / "fixtures" / "crossing"),
        tmp_path / "events.parquet",
        tmp_path / "mapping.toml",
        directory,
    )
    console = Console(
        markup=False, record=True, width=400, quiet=False, file=(tmp_path / "said").open("w")
    )
    assert command.run(console) == 0
    said = console.export_text()
    assert "3 periods, 2 detectors, 198 passages over detectors" in said
    assert "no speeds" in said and "rules out: speed_spread" in said
    assert read_measured(directory, scenario, network).hash == street.hash


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('tls = "C"', 'tls = "D"', "'D' is not a traffic light of the network; it has C"),
        (
            "4 = [1] }",
            '4 = [1] }\nconstant = { 1 = "g" }',
            r"link 1 is under \[devices.constant\] and in a phase or an overlap",
        ),
        ("4 = [1]", "4 = []", r"nothing says what the links 1 of 'C' show.*devices.constant"),
        ("4 = [1]", "4 = [1, 2]", "link 2 does not exist; 'C' has the links 0 to 1"),
        ("channel = 6", "channel = 5", "channel 5 is mapped twice"),
        ('lane = "W_C_0"', 'lane = "W_C_1"', "'W_C_1', which the network does not have; did you"),
        ("position_m = 487", "position_m = 4870", "goes from 0 to 490 m"),
        ('kind = "stop"', 'kind = "presence"', r"detectors.0.kind: input should be 'advance'"),
        ("position_m = 487", "", r"key 'devices.0.detectors.0.position_m' is missing"),
        ("position_m = 487", "position_m = true", r"detectors.0.position_m: input should be a val"),
        ("position_m = 487", 'position_m = "487"', r"detectors.0.position_m: input should be a v"),
        ("channel = 5", "channel = true", r"detectors.0.channel: input should be a valid integer"),
        ("4 = [1]", "4 = [true]", r"phases.4.green.0: input should be a valid integer"),
        ("4 = [1]", "0_4 = [1]", r"'0_4' is not a number; write plain digits"),
        ("zero =", "zeros =", r"unknown key 'zeros'; did you mean 'zero'\?"),
        (
            'tls = "C"',
            'tls = "C"\nonred = [1]',
            r"toml: unknown key 'devices.0.onred'; did you mean 'on_red'\?; docs/",
        ),
        ("[2024-03-05T07:00:00]", "'7:00'", r"zero: write a list, as in zero = \['7:00'\];"),
        (
            "[2024-03-05T07:00:00]",
            "2024-03-05T07:00:00",
            r"zero: write a list, as in zero = \[2024-03-05T07:00:00\];",
        ),
        ("4 = [1]", "4 = {green = 1}", r"green: write a list, as in green = \[1\];"),
        ("[2024-03-05T07:00:00]", "[1709622000]", "zero.0 = 1709622000: write a local time such"),
        ("[2024-03-05T07:00:00]", '["1709622000"]', "zero.0 = '1709622000': write a local time"),
        ("[2024-03-05T07:00:00]", '["7:00"]', "zero.0 = '7:00': write a local time such as 2024"),
        ("zero = [2024-03-05T07:00:00]", "", "give zero .* or .*periods"),
        ("07:00:00]", "07:00:00Z]", "zero has offsets from UTC, .* write the street's own time_"),
        ("[2024-03-05T07:00:00]", "[2023-03-05T07:00:00]", "no event in period.*the log goes from"),
        ("[[devices]]", "[[devices", "not valid TOML"),
        ("zero =", 'time_zone = "Denver"\nzero =', "unknown time_zone 'Denver'"),
        ("zero =", "end_s = 4000\nzero =", "demand from 0 s to 200 s"),
        ("id = 7", "id = 8", "no event of a device in mapping.toml; the log is of '7'"),
        ("2 = [0], 4 = [1]", "3 = [0], 1 = [1]", "no phase event .* of a mapped phase"),
    ],
)
def test_a_wrong_mapping_is_refused(imported: Import, old: str, new: str, message: str) -> None:
    assert old in MAPPING
    with pytest.raises(MeasuredDataError, match=f"(?s){message}"):
        imported(mapping=MAPPING.replace(old, new, 1))


def test_a_wrong_log_is_refused(imported: Import, tmp_path: Path) -> None:
    with pytest.raises(MeasuredDataError, match="no column for event"):
        imported(log(LOG).drop("EventId"))
    with pytest.raises(MeasuredDataError, match="no events"):
        imported(log([]).cast({"TimeStamp": pl.Datetime("us")}))
    with pytest.raises(MeasuredDataError, match="no detector event"):
        imported(log([row for row in LOG if row[1] not in (81, 82)]))
    bad = log(LOG).with_columns(pl.col("TimeStamp").dt.strftime("%d.%m.%Y"))
    with pytest.raises(MeasuredDataError, match="line 2: TimeStamp is '05.03.2024'"):
        imported(bad, csv=True)
    with pytest.raises(MeasuredDataError, match="TimeStamp has the type Float64"):
        imported(log(LOG).with_columns(pl.lit(1.5).alias("TimeStamp")))
    with pytest.raises(MeasuredDataError, match=r"line 2: event is 'green'"):
        imported(log(LOG).with_columns(pl.lit("green").alias("EventId")), csv=True)
    for cell in ("1_0", "١٢", "true"):
        with pytest.raises(MeasuredDataError, match=f"line 2: event is '{cell}'; write a number"):
            imported(log(LOG).with_columns(pl.lit(cell).alias("EventId")), csv=True)
    with pytest.raises(MeasuredDataError, match=r"line 2: event '81\.5' is not a whole number"):
        imported(log(LOG).with_columns(pl.lit(81.5).alias("EventId")), csv=True)
    with pytest.raises(MeasuredDataError, match="'event' has the type Boolean"):
        imported(log(LOG).with_columns(pl.lit(True).alias("EventId")))
    whole = (tmp_path / "events.parquet").read_bytes()
    (tmp_path / "events.parquet").write_bytes(whole[:100])
    scenario = read_scenario(Path(__file__).parents[1] / "fixtures" / "crossing")
    with pytest.raises(MeasuredDataError, match="cut short"):
        import_atspm(
            tmp_path / "events.parquet", tmp_path / "mapping.toml", scenario, Network.read(scenario)
        )


def test_a_summer_night_that_is_there_twice_is_an_error(imported: Import) -> None:
    steps = [(float(t), code, 5) for t in range(1, 190, 4) for code in (82, 81)]
    steps = [(t + 0.5 * (code == 81), code, n) for t, code, n in steps]
    again = [(t - 90 if t > 120 else t, code, n) for t, code, n in LOG[:6] + steps]
    with pytest.raises(MeasuredDataError, match=r"steps back by [\d.]+ s, so some times occur"):
        imported(log(again))


SEEN = [row for row in LOG if row[1] in (81, 82)]


def cycles(begin_s: float, count: int) -> Rows:
    """The changes of the signals of `LOG` in some cycles of 50 s."""
    return [
        (begin_s + 50.0 * cycle + time, code, number)
        for cycle in range(count)
        for time, code, number in LOG[1:]
        if time < 50.0 and code not in (81, 82)
    ]


def test_a_clock_set_back_out_of_the_period_is_an_error(imported: Import) -> None:
    """The log begins with the period, so no time occurs twice, but half of the period is lost."""
    back = [*cycles(0.0, 2), *cycles(100.0 - 3600.0, 2)]
    with pytest.raises(MeasuredDataError, match=r"'7' steps back by 3\d+ s, so .* before the per"):
        imported(log([*SEEN, *back]))


def test_pieces_in_another_order_are_put_in_order(imported: Import) -> None:
    """The newest hour first, or two pieces of the hour before swapped: no time occurs twice."""
    newest, oldest, before = cycles(0.0, 4), cycles(-3000.0, 4), cycles(-150.0, 3)
    few = cycles(-60.0, 1)[:3], cycles(-300.0, 1)[:3], newest[:3]
    for found, ordered in (
        ((newest, oldest, before), (oldest, before, newest)),
        (few, (few[1], few[0], few[2])),
    ):
        one, other = ([row for piece in pieces for row in piece] for pieces in (found, ordered))
        assert imported(log([*SEEN, *one])).hash == imported(log([*SEEN, *other])).hash


def test_a_clock_set_back_before_the_period_is_no_error(imported: Import) -> None:
    """The hour before a period only tells what is shown at its start."""
    behind = [*cycles(-250.0, 9), *SEEN]
    read = imported(log([*cycles(-300.0, 3), *behind]))  # back by 98 s
    assert read.hash == imported(log(behind)).hash


def test_what_a_controller_says_of_itself_is_passed_on(imported: Import) -> None:
    faults = [(60.0, 181, 3), (61.0, 84, 5), (62.0, 87, 50)]
    read = imported(log([*LOG, *faults]))
    assert "the clock of '7' was set once (event 181)" in texts(read)
    assert "device '7' reports faults (events 84 to 88) of its channels 5" in texts(read)
    earlier = [(time - 3000.0, code, number) for time, code, number in faults]
    said = texts(imported(log([*earlier, *LOG])))
    assert "event 181" not in said and "faults" not in said


def test_a_clock_that_was_set_once_was_set_once(imported: Import) -> None:
    """The hour before a period is read too, for the state of its signals."""
    rows = """
[[periods]]
id = "first"
zero = 2024-03-05T07:00:00
end_s = 100
[[periods]]
id = "second"
zero = 2024-03-05T07:00:00
begin_s = 100
end_s = 200
"""
    mapping = MAPPING.replace("zero = [2024-03-05T07:00:00]", rows)
    more = [(time + 100.0, code, number) for time, code, number in LOG if 0 <= time < 90]
    said = texts(imported(log([*LOG, (60.0, 181, 3), *more]), mapping))
    assert "the clock of '7' was set once (event 181)" in said


@pytest.mark.parametrize("kept", ["signal", "detector"])
def test_a_period_without_events_is_to_be_left_out(imported: Import, kept: str) -> None:
    seen = [row for row in LOG if (row[1] in (81, 82)) == (kept == "detector")]
    days = [ZERO, ZERO + dt.timedelta(days=1)]
    frame = pl.concat([log(LOG, zero=days[0]), log(seen, zero=days[1])])
    dates = ", ".join(day.isoformat() for day in days)
    with pytest.raises(MeasuredDataError, match="event in period '2024-03-06T0700'; leave this"):
        imported(frame, MAPPING.replace("2024-03-05T07:00:00", dates))


def test_damaged_logs_never_end_in_a_traceback(
    imported: Import, tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    imported()
    imported(csv=True)
    rng = np.random.default_rng(0)
    for name in ("events.parquet", "events.csv", "mapping.toml"):
        whole = (tmp_path / name).read_bytes()
        for _ in range(60):
            broken = bytearray(whole[: rng.integers(1, len(whole)) if rng.random() < 0.3 else None])
            for place in rng.integers(0, len(broken), rng.integers(0, 6)):
                broken[place] = rng.integers(0, 256)
            (tmp_path / name).write_bytes(bytes(broken))
            log_file = tmp_path / (name if name.startswith("events") else "events.csv")
            try:
                import_atspm(log_file, tmp_path / "mapping.toml", scenario, network)
            except UgatMarlError as error:
                assert str(tmp_path) in str(error)  # noqa: PT017
        (tmp_path / name).write_bytes(whole)
