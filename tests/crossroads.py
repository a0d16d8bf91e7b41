"""A crossroads of single lanes with one light, made by netconvert, for tests of its lanes."""

from __future__ import annotations

import subprocess
from pathlib import Path

from ugat_marl.effects import load_scenario
from ugat_marl.scenarios import Scenario, sumo_program

NODES = {"M": (0, 0), "N": (0, 200), "S": (0, -200), "W": (-200, 0), "E": (200, 0)}
ROADS = ("Ww", "wM", "ME", "NM", "MS", "SM", "MN")


def build_crossroads(folder: Path, before_m: int) -> None:
    """Write ``n.net.xml`` into a folder: a light at "M", and a node "w" on the western road.

    Args:
        folder: The folder.
        before_m: Distance of "w" from "M", m.
    """
    places = {**NODES, "w": (-before_m, 0)}
    nodes = "".join(
        f'<node id="{name}" x="{x}" y="{y}" type="{"traffic_light" if name == "M" else "priority"}"'
        "/>"
        for name, (x, y) in places.items()
    )
    edges = "".join(f'<edge id="{r}" from="{r[0]}" to="{r[1]}" speed="13"/>' for r in ROADS)
    (folder / "n.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "n.edg.xml").write_text(f"<edges>{edges}</edges>")
    subprocess.run(
        [str(sumo_program("netconvert")), "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml",
         "--no-turnarounds"],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip


def crossroads_with(vehicles: str, folder: Path, before_m: int, duration_s: int) -> Scenario:
    """Return the crossroads as a scenario in a folder, with vehicles as XML."""
    build_crossroads(folder, before_m)
    (folder / "r.rou.xml").write_text(f"<routes>{vehicles}</routes>")
    (folder / "scenario.toml").write_text(
        f'network = "n.net.xml"\nroutes = ["r.rou.xml"]\nduration_s = {duration_s}\n'
    )
    return load_scenario(folder)
