"""What a page says of a fitted street, from numbers by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ugat_marl.data import Metrics
from ugat_marl.reporting.page import Page
from ugat_marl.reporting.run_records import RunRecord
from ugat_marl.reporting.street_found import commands_found, detectors_found, found_on_street


def record(folder: Path, numbers: dict[str, float]) -> RunRecord:
    rows = [("iteration", 1, name, value) for name, value in numbers.items()]
    nothing: dict[str, Any] = {}
    return RunRecord(
        "run", folder, False, nothing, nothing, nothing, None, Metrics(rows), None, None, (), 0.0
    )


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ({"channel/lag_0": 1.0, "channel/lost": 0.0}, "Commands: obeyed at once."),
        (
            {"channel/lag_0": 0.2, "channel/lag_1": 0.5, "channel/lost": 0.3},
            "Commands: 50 % take effect 1 decision late, 30 % are lost.",
        ),
        (
            {"channel/lag_2": 1.0, "channel/forbids": 1.0},
            "Commands: 100 % take effect 2 decisions late, some changes of phase are refused.",
        ),
    ],
)
def test_commands(numbers: dict[str, float], said: str, tmp_path: Path) -> None:
    assert commands_found(record(tmp_path / "run", numbers)) == said


def test_detectors(tmp_path: Path) -> None:
    none = dict.fromkeys(("dead", "zone_m", "absolute", "relative", "lag", "lost", "step"), 0.0)
    found = {f"eyes/{name}": value for name, value in none.items()}
    assert detectors_found(record(tmp_path / "a", found)) == "Detectors: no fault found."
    found |= {"eyes/zone_m": 21.4, "eyes/relative": 0.1}
    assert detectors_found(record(tmp_path / "b", found)) == (
        "Detectors: vehicles count only within 21 m of the stop line, counts err by 10 %."
    )
    assert detectors_found(record(tmp_path / "c", {})) == ""


def test_effects_and_unused_green(tmp_path: Path) -> None:
    numbers = {
        "street/commands": 0.0,
        "effects/acceleration": 0.5,
        "effects/acceleration/low": 0.4,
        "effects/acceleration/high": 0.9,
        "effects/acceleration/nominal": 2.6,
        "unused/begin_s/signal_0": 1.25,
        "unused/begin_s_low/signal_0": 0.5,
        "unused/begin_s_high/signal_0": 2.0,
        "unused/each_s/signal_0": 0.0,
        "unused/each_s_low/signal_0": 0.0,
        "unused/each_s_high/signal_0": 0.31,
        "judged/before": 110.0,
        "judged/after": 99.0,
    }
    section = found_on_street(Page(), record(tmp_path / "run", numbers), "no map: by hand")
    assert section is not None
    (effect,) = section["effects"].rows
    assert effect == ["acceleration", "m/s^2", "2.6", "0.5", "0.4 to 0.9", "no"]
    (row,) = section["unused"].rows
    assert row == ["signal_0", "–", "1.2 (0.5 to 2)", "0 (0 to 0.31)"]
    assert section["kept"].endswith("before 110 s, after 99 s; the one after was kept.")
    assert section["note"] == "no map: by hand"
    assert found_on_street(Page(), record(tmp_path / "other", {"gate/alpha": 0.5}), "") is None
