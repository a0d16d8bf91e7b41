"""Builds network and demand of the shipped scenarios from their `source.toml`: `make scenarios`.

    python scenarios/build.py [name ...] [--into FOLDER]     networks and demand
    python scenarios/build.py [name ...] --headroom          measures the tables in the READMEs

The same sources give the same bytes, whatever the day and the machine; a test rebuilds them.
"""

from __future__ import annotations

import argparse
import sys
import tomllib
from pathlib import Path
from typing import Any

from demand import draw_demand

from ugat_marl.cli import guarded
from ugat_marl.errors import ScenarioError
from ugat_marl.files import write_whole
from ugat_marl.scenarios import build_network, netconvert_documents, read_road_plan

HERE = Path(__file__).resolve().parent
BEGIN, END = "<!-- headroom: begin -->\n", "<!-- headroom: end -->\n"


def build(name: str, into: Path) -> list[Path]:
    """Write network.net.xml and demand.rou.xml of scenario `name` below `into`."""
    source = _read(HERE / name / "source.toml")
    settings = _read(HERE / name / "scenario.toml")
    vehicles = _read(HERE / "vehicles.toml")
    plan = read_road_plan(source)
    files = {
        settings["network"]: build_network(
            netconvert_documents(plan, source["speed_mps"]), source["netconvert"]
        ),
        settings["routes"][0]: draw_demand(
            plan, source["demand"], vehicles, settings["duration_s"]
        ),
    }
    for file, content in files.items():
        write_whole(into / name / file, content)
    return [into / name / file for file in files]


def measure(name: str, seeds: list[int], workers: int | None) -> Path:
    """Write the headroom of scenario `name` between the markers of its README."""
    # Building needs no simulation; only this does.
    from ugat_marl.experiments import measure_headroom
    from ugat_marl.reporting import headroom_markdown
    from ugat_marl.scenarios import read_scenario

    readme = HERE / name / "README.md"
    text = readme.read_text(encoding="utf-8")
    if BEGIN not in text or END not in text:
        raise ScenarioError(f"{readme}: has no lines {BEGIN.strip()!r} and {END.strip()!r}")
    before, _, rest = text.partition(BEGIN)
    table = headroom_markdown(
        measure_headroom(read_scenario(HERE / name), seeds=seeds, workers=workers)
    )
    caption = f"Means over the seeds {', '.join(map(str, seeds))}:\n\n"
    write_whole(readme, f"{before}{BEGIN}{caption}{table}{END}{rest.partition(END)[2]}")
    return readme


def _read(path: Path) -> dict[str, Any]:
    return tomllib.loads(path.read_text(encoding="utf-8"))


def main() -> None:
    """Command line."""
    known = sorted(folder.parent.name for folder in HERE.glob("*/source.toml"))
    parser = argparse.ArgumentParser(description="Build the shipped scenarios.")
    parser.add_argument("names", nargs="*", metavar="name", help=f"of {', '.join(known)}; all")
    parser.add_argument("--into", type=Path, default=HERE, help="folder to write to")
    parser.add_argument("--headroom", action="store_true", help="measure headroom instead")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], help="of episodes")
    parser.add_argument("--workers", type=int, help="simulations at a time (number of cores)")
    options = parser.parse_args()
    for name in options.names or known:
        if name not in known:
            parser.error(f"no scenario {name!r} with a source.toml; there are {', '.join(known)}")
        if options.headroom:
            print(measure(name, options.seeds, options.workers))
            continue
        for path in build(name, options.into):
            print(path)


if __name__ == "__main__":
    sys.exit(guarded("build.py", main))
