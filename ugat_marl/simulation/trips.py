"""Trips of every vehicle due, as SUMO reports them at the end."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ugat_marl.errors import SimulatorError
from ugat_marl.scenarios import is_blocker
from ugat_marl.simulation.snapshots import Trips

STATISTICS = "statistics.xml"
"""SUMO's file with the numbers of collisions and hard brakings, beside the tripinfo file."""


def measuring_options(directory: Path) -> list[str]:
    """Return options of SUMO that record emissions and safety. They do not change the traffic."""
    return [
        "--device.emissions.probability", "1",
        "--statistic-output", str(directory / STATISTICS),
        "--emergencydecel.warning-threshold", "0",
    ]  # fmt: skip


def read_trips(path: Path, end_s: float, persons: Mapping[str, float] | None = None) -> Trips:
    """Read SUMO's tripinfo file, unfinished and undeparted vehicles included.

    Vehicles that block a lane for an effect are no travellers and are left out, and so are those
    that a calibrator of the scenario removes. Vehicles that SUMO takes off the road otherwise, such
    as after a collision, have not arrived: their times count to the end.

    Args:
        path: The file.
        end_s: Time at which the simulation ended, s on the scenario's clock.
        persons: Vehicle type to the persons in each vehicle, "" for all other types. If given, SUMO
            must have run with `measuring_options`, and emissions and dangers are read too.

    Raises:
        SimulatorError: The file is missing or incomplete.
    """
    try:
        return _trips_in(path, end_s, persons or {})
    except (OSError, ET.ParseError) as error:
        raise SimulatorError(
            f"SUMO's report on its vehicles cannot be read ({error}); is there room left in "
            f"{path.parent.parent}?"
        ) from None


def _trips_in(path: Path, end_s: float, persons: Mapping[str, float]) -> Trips:
    rows: list[tuple[float, float, bool, bool]] = []
    emitted_g: list[float] = []
    carried: list[float] = []
    co2_mg = 0.0
    for _, element in ET.iterparse(path):
        if element.tag == "emissions":  # ends before the trip it belongs to
            co2_mg = float(element.get("CO2_abs", "0"))
        blocks = is_blocker(element.get("id", ""), element.get("vType", ""))
        removed_by = element.get("vaporized", "")
        if element.tag == "tripinfo" and not blocks and removed_by != "calibrator":
            entered = float(element.get("depart", "-1")) >= 0
            arrival_s = float(element.get("arrival", "-1"))
            ended = arrival_s >= 0
            removed = ended and bool(removed_by)
            waited = float(element.get("departDelay", "0"))
            inside = float(element.get("duration", "0"))
            lost = float(element.get("timeLoss", "0"))
            missing = waited + (end_s - arrival_s if removed else 0.0)
            rows.append((missing + inside, missing + lost, ended and not removed, entered))
            if persons:
                emitted_g.append(co2_mg / 1000.0)
                carried.append(persons.get(element.get("vType", ""), persons[""]))
        if element.tag == "tripinfo":
            co2_mg = 0.0  # SUMO tells no emissions of a vehicle that never entered
        element.clear()
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return Trips(
        table[:, 0],
        table[:, 1],
        table[:, 2] > 0,
        table[:, 3] > 0,
        np.array(emitted_g, dtype=np.float64),
        np.array(carried, dtype=np.float64),
        np.array(_dangers(path.parent / STATISTICS) if persons else ()),
    )


def _dangers(path: Path) -> tuple[float, float]:
    """Return the numbers of collisions and of hard brakings."""
    safety = ET.parse(path).getroot().find("safety")
    counts = {} if safety is None else safety.attrib
    return float(counts.get("collisions", "0")), float(counts.get("emergencyBraking", "0"))
