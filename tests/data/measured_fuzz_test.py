"""Files cut in half and bytes turned over: measured data, or an error that says what is wrong."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from ugat_marl.data import (
    CSV_HASHES,
    MeasuredData,
    read_measured,
    split_periods,
    write_measured,
)
from ugat_marl.errors import UgatMarlError
from ugat_marl.scenarios import Detector, Network, Passages, Period, Scenario, read_scenario

NAMES = ("periods", "detectors", "signals", "detections")
JUNK = (b"\0", b"1e400", b"nan", b"-", b",", b'"', b"\n", b"\xff\xfe", b"9" * 40, b"\r", b"1e99")


def recording() -> MeasuredData:
    detectors = (
        Detector("a", "S_C_0", 440.0, 2.0, "advance"),
        Detector("s", "W_C_0", 487.0, 0.0, "stop"),
    )
    on = np.arange(5.0, 195.0, 9.0)
    days = tuple(
        Period(
            f"p{i}",
            0.0,
            200.0,
            split,
            {"C": tuple((20.0 * k, ("Gr", "rG")[k % 2]) for k in range(10))},
            {d.id: Passages(on + i, on + i + 1, on % 7, on * 0 + 5) for d in detectors},
        )
        for i, split in enumerate(split_periods(2))
    )
    return MeasuredData(detectors, days)


def read_or_error(
    directory: Path, scenario: Scenario, network: Network
) -> MeasuredData | UgatMarlError:
    """Anything else that is raised fails the test."""
    try:
        return read_measured(directory, scenario, network)
    except UgatMarlError as error:
        return error


@st.composite
def damage(draw: st.DrawFn, content: bytes) -> bytes:
    at = draw(st.integers(0, len(content) - 1))
    kind = draw(st.sampled_from(["cut", "flip", "insert", "delete"]))
    event(kind)
    if kind == "cut":
        return content[:at]
    if kind == "insert":
        return content[:at] + draw(st.sampled_from(JUNK)) + content[at:]
    if kind == "delete":
        return content[:at] + content[at + draw(st.integers(1, 40)) :]
    changed = bytearray(content)
    for place, value in draw(
        st.lists(
            st.tuples(st.integers(0, len(content) - 1), st.integers(0, 255)),
            min_size=1,
            max_size=8,
        )
    ):
        changed[place] = value
    return bytes(changed)


@pytest.mark.parametrize("form", ["parquet", "csv", "csv by hand"])
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_never_end_in_a_traceback(
    form: str, tmp_path: Path, data: st.DataObject
) -> None:
    scenario = read_scenario(Path(__file__).parents[1] / "fixtures" / "crossing")
    network = Network.read(scenario)
    whole = tmp_path / "whole"
    if not whole.exists():
        write_measured(recording(), whole, csv=form != "parquet")
        if form == "csv by hand":
            (whole / CSV_HASHES).unlink()
    broken = tmp_path / "broken"
    shutil.rmtree(broken, ignore_errors=True)
    shutil.copytree(whole, broken)
    stem = data.draw(st.sampled_from(NAMES))
    file = next(path for path in broken.iterdir() if path.stem == stem)
    file.write_bytes(data.draw(damage(file.read_bytes())))
    outcome = read_or_error(broken, scenario, network)
    event(type(outcome).__name__)
    if isinstance(outcome, MeasuredData):
        assert outcome.hash
    else:
        assert any(f"{name}." in str(outcome) for name in NAMES)
