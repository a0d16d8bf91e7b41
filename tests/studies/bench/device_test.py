"""``bench device``: its arithmetic by hand, and its program with the CPU against itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import studies.bench.device as device_module
from studies.bench.device import DeviceBench, compared, pays_from
from studies.bench.device_program import LAYOUT, measure, random_log
from studies.errors import MeasurementError
from ugat_marl.errors import OptionError


@pytest.mark.parametrize(
    ("ratios", "first"),
    [
        ([0.1, 0.5, 2.0, 8.0], 16),
        ([2.0, 2.0, 2.0, 2.0], 1),
        ([0.1, 0.5, 0.9, 1.0], None),
        ([3.0, 0.5, 2.0, 2.0], 16),  # once faster by chance is not from there on
        ([3.0, 3.0, 3.0, 0.9], None),
    ],
)
def test_the_size_from_which_on_it_pays(ratios: list[float], first: int | None) -> None:
    assert pays_from([1, 4, 16, 64], ratios) == first


def test_times_become_ratios_of_the_same_round_and_a_sentence() -> None:
    def times(ratio: float) -> dict[str, list[float]]:
        device = [2.0, 4.0, 8.0]
        return {"cpu": [ratio * x for x in device], "device": device}

    def of_size(update: float, fit: float) -> dict[str, Any]:
        own = {"update of DQN": times(update), "fit of f and h": times(fit)}
        return {"name": "Some GPU", "times": own}

    found = {1: of_size(0.25, 0.5), 16: of_size(0.5, 3.0)}
    report = compared(found, {"sizes": [1, 16, 64], "device": "cuda", "rounds": 3})
    assert report.settings["sizes"] == [1, 16]
    shown = {(row["what"], row["intersections"]): row for row in report.rows}
    assert shown["update of DQN [ms]", 16]["cpu / cuda"].median == 0.5
    assert shown["fit of f and h [s]", 16]["cpu / cuda"].values == (3.0, 3.0, 3.0)
    assert shown["fit of f and h [s]", 16]["cuda"].median == 4.0
    assert report.notes == [
        "cuda: Some GPU. Medians of 3 rounds, wall time.",
        "update of DQN: cuda does not pay up to 16 intersections.",
        "fit of f and h: cuda pays from 16 intersections.",
    ]


def test_the_log_has_the_form_of_a_recorded_one() -> None:
    log = random_log(3, 5, seed=1)
    assert log.agents == ("agent_0", "agent_1", "agent_2")
    rows = log.transitions("agent_2")
    assert rows.observation.shape == (20, LAYOUT.size)
    assert set(rows.action) <= set(range(LAYOUT.phases))


def test_every_size_is_measured_on_both_in_every_round() -> None:
    asked = {"device": "cpu", "rounds": 2, "updates": 2, "batch_size": 4}
    for size in (1, 2):
        found = measure({**asked, "size": size, "epochs": 1, "steps": 6, "seed": 1})
        assert set(found["times"]) == {"update of DQN", "fit of f and h"}
        for own in found["times"].values():
            assert set(own) == {"cpu", "device"}
            assert all(len(times) == 2 and min(times) > 0 for times in own.values())


def test_the_command_measures_and_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_module, "device_of", lambda _name: None)
    asked: list[dict[str, Any]] = []

    def measured(_program: Any, request: dict[str, Any], **_: Any) -> dict[str, Any]:
        asked.append(request)
        return measure({**request, "device": "cpu"})

    monkeypatch.setattr(device_module, "in_fresh_process", measured)
    out = tmp_path / "device.json"
    tiny = {"rounds": 1, "updates": 1, "batch_size": 4, "epochs": 1, "steps": 4}
    report = DeviceBench("cuda", sizes=(2, 1, 2), out=out, **tiny).run()
    assert [one["size"] for one in asked] == [1, 2] and asked[0]["device"] == "cuda"
    assert [row["intersections"] for row in report.rows] == [1, 2, 1, 2]
    assert len(json.loads(out.read_text())["rows"]) == 4


def test_sizes_that_were_measured_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_module, "device_of", lambda _name: None)

    def measured(_program: Any, request: dict[str, Any], **_: Any) -> dict[str, Any]:
        if request["size"] == 2:
            raise MeasurementError("took too long")
        return measure({**request, "device": "cpu"})

    monkeypatch.setattr(device_module, "in_fresh_process", measured)
    out = tmp_path / "device.json"
    tiny = {"rounds": 1, "updates": 1, "batch_size": 4, "epochs": 1, "steps": 4}
    with pytest.raises(MeasurementError):
        DeviceBench("cuda", sizes=(1, 2), out=out, **tiny).run()
    assert [row["intersections"] for row in json.loads(out.read_text())["rows"]] == [1, 1]


def test_what_cannot_be_compared_is_refused() -> None:
    with pytest.raises(OptionError, match="'cpu' is what it is compared with"):
        DeviceBench("cpu")
    with pytest.raises(OptionError, match="sizes is empty"):
        DeviceBench(sizes=())
    with pytest.raises(OptionError, match="sizes = 0: must be at least 1"):
        DeviceBench(sizes=(0, 4))
