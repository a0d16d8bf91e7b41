"""sumo-rl in its own virtual environment, because it needs an older PettingZoo than the suite.

The wheel of sumo-rl also holds the RESCO networks. The bench finds them here if they are not
installed beside the suite.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from studies.errors import MeasurementError
from ugat_marl.data import installed_version, installed_versions
from ugat_marl.files import write_whole

SUMO_RL = "1.4.5"
PETTINGZOO = "1.24.3"
"""Newest PettingZoo that works with sumo-rl 1.4.5."""

_OWN_VERSIONS = (
    "gymnasium", "numpy", "pandas", "pillow", "sumolib", "traci", "typing_extensions",
    "cloudpickle", "Farama-Notifications", "python-dateutil", "tzdata",
)  # fmt: skip
"""Packages that get the same version there as here, if they are installed here."""


@dataclass(frozen=True)
class SumoRl:
    """A virtual environment with sumo-rl.

    Attributes:
        python: Python interpreter of the virtual environment.
        networks: Folder of the RESCO networks.
        versions: Versions of the installed packages.
    """

    python: Path
    networks: Path
    versions: dict[str, str]

    def variables(self) -> dict[str, str]:
        """Return the environment variables for sumo-rl, without the path of the suite."""
        import sumo

        return {"SUMO_HOME": str(sumo.SUMO_HOME), "LIBSUMO_AS_TRACI": "1", "PYTHONPATH": ""}


def install_sumo_rl(cache: Path, say: Callable[[str], None]) -> SumoRl:
    """Return the virtual environment below `cache`; install it if it is missing.

    Args:
        cache: Folder of virtual environments.
        say: Function that prints a line before the installation.

    Raises:
        MeasurementError: The installation failed; the message quotes pip.
    """
    libsumo = installed_version("libsumo")
    wanted = [f"sumo-rl=={SUMO_RL}", f"pettingzoo=={PETTINGZOO}", f"libsumo=={libsumo}"]
    python_version = ".".join(map(str, sys.version_info[:2]))
    folder = cache.resolve() / f"sumo-rl-{SUMO_RL}-libsumo-{libsumo}-py{python_version}"
    record = folder / "installed.json"
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not record.exists():
        say(f"installing {', '.join(wanted)} into {folder} (some 500 MB, once)")
        _install(folder, python, wanted)
        write_whole(record, json.dumps(_found(python)))
    found = json.loads(record.read_text())
    return SumoRl(python, Path(found["networks"]), found["versions"])


def _install(folder: Path, python: Path, wanted: list[str]) -> None:
    shutil.rmtree(folder, ignore_errors=True)  # an interrupted run may have left it
    folder.parent.mkdir(parents=True, exist_ok=True)
    _run([sys.executable, "-m", "venv", str(folder)], "no virtual environment could be made")
    same = installed_versions(*_OWN_VERSIONS)
    constraints = folder / "constraints.txt"
    constraints.write_text("".join(f"{name}=={v}\n" for name, v in same.items() if v))
    options = ["--disable-pip-version-check", "--no-input", "--quiet", "-c", str(constraints)]
    _run(
        [str(python), "-P", "-m", "pip", "install", *options, *wanted],
        f"{', '.join(wanted)} could not be installed; pip needs to reach a package index "
        "(--no-sumo-rl leaves the comparison out)",
    )


def _found(python: Path) -> dict[str, Any]:
    """Return the packages of the virtual environment, without importing sumo-rl."""
    program = (
        "import importlib.metadata as m, importlib.util as u, json; "
        "print(json.dumps({'networks': u.find_spec('sumo_rl').submodule_search_locations[0] "
        "+ '/nets/RESCO', 'versions': {d.name: d.version for d in m.distributions()}}))"
    )
    return json.loads(_run([str(python), "-P", "-c", program], "sumo-rl is not installed whole"))


def _run(command: list[str], failure: str) -> str:
    variables = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    finished = subprocess.run(
        command,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        env=variables,
        check=False,
    )
    if finished.returncode:
        said = " ".join((finished.stderr or finished.stdout).split())[-1500:]
        raise MeasurementError(f"{failure}; it said: {said}")
    return finished.stdout
