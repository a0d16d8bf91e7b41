"""What the installed wheel carries."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

import ugat_marl

PACKAGE = Path(ugat_marl.__file__).parent
CHECKOUT = Path(__file__).resolve().parent.parent
BASELINES = sorted(CHECKOUT.glob("baselines/*.py"))
SCENARIOS = sorted(path.parent for path in CHECKOUT.glob("scenarios/*/scenario.toml"))

pytestmark = pytest.mark.skipif(
    not PACKAGE.is_relative_to(sysconfig.get_paths()["purelib"]),
    reason="the package is imported from a source tree; `make test` installs the wheel",
)


def test_the_version_is_the_wheels() -> None:
    assert importlib.metadata.version("ugat-marl") == ugat_marl.__version__


def test_the_wheel_is_typed() -> None:
    assert (PACKAGE / "py.typed").exists()


@pytest.mark.parametrize("source", SCENARIOS, ids=lambda path: path.name)
def test_the_wheel_carries_what_a_scenario_needs(source: Path) -> None:
    installed = PACKAGE / "_scenarios" / source.name
    names = ["scenario.toml", *(path.name for path in source.glob("*.xml*"))]
    for name in names:
        assert (installed / name).read_bytes() == (source / name).read_bytes()


def test_the_wheel_carries_no_build_sources() -> None:
    carried = {path.name for path in (PACKAGE / "_scenarios").rglob("*")}
    assert not {"source.toml", "vehicles.toml", "build.py"} & carried


@pytest.mark.parametrize("source", BASELINES, ids=lambda path: path.name)
def test_the_wheel_carries_the_baselines(source: Path) -> None:
    assert (PACKAGE / "_baselines" / source.name).read_bytes() == source.read_bytes()


def test_other_processes_import_the_wheel_too() -> None:
    command = [sys.executable, "-c", "import ugat_marl; print(ugat_marl.__file__)"]
    printed = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=True)
    assert Path(printed.stdout.strip()).parent == PACKAGE


def test_importing_is_cheap() -> None:
    code = (
        "import sys, ugat_marl; sys.exit(bool({'torch', 'libsumo', 'matplotlib'} & {*sys.modules}))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
