"""Mean state of lanes in a simulation: vehicles, halting vehicles and speed."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ugat_marl.errors import SimulatorError
from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import Document

_ATTRIBUTES = ("sampledSeconds", "waitingTime", "speed")


def lane_states_document(begin_s: float, end_s: float, file: Path) -> Document:
    """Return an additional file that makes SUMO write the mean state of all lanes to `file`.

    Args:
        begin_s: Begin, on the scenario's clock.
        end_s: End, on the scenario's clock.
        file: Absolute path of SUMO's output.
    """
    root = ET.Element("additional")
    ET.SubElement(
        root,
        "laneData",
        {
            "id": "lanes",
            "file": str(file),
            "begin": repr(begin_s),
            "end": repr(end_s),
            "excludeEmpty": "true",
            "writeAttributes": " ".join(_ATTRIBUTES),
        },
    )
    return Document("lanes.add.xml", None, xml_bytes(root))


def read_lane_states(file: Path, lanes: Sequence[str]) -> NDArray[np.float64]:
    """Read the state of lanes.

    Args:
        file: SUMO's output for `lane_states_document`.
        lanes: SUMO ids of the lanes.

    Returns:
        Vehicle seconds, seconds of halting vehicles, and driven metres of each lane, ``(lanes,
        3)``; zeros for a lane without vehicles.

    Raises:
        SimulatorError: SUMO did not write the file.
    """
    try:
        root = ET.parse(file).getroot()
    except (OSError, ET.ParseError) as error:
        raise SimulatorError(f"SUMO's states of lanes cannot be read ({error})") from None
    index = {lane: number for number, lane in enumerate(lanes)}
    states = np.zeros((len(lanes), 3))
    for element in root.iter("lane"):
        number = index.get(element.get("id", ""))
        if number is not None:
            seconds, halting, speed = (float(element.get(name, "0")) for name in _ATTRIBUTES)
            states[number] += (seconds, halting, seconds * speed)
    return states
