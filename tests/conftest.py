"""What all tests share: a deterministic Hypothesis, and a word on which package is tested."""

from __future__ import annotations

import os
import shutil
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest

import ugat_marl
from ugat_marl.simulation import Host
from ugat_marl.simulation.process import SERVICE

# `studies` is imported from the checkout; behind all else, so that the installed suite is tested.
CHECKOUT = str(Path(__file__).resolve().parents[1])
sys.path.append(CHECKOUT)

hypothesis.settings.register_profile(
    "suite",
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("suite")


def installed() -> bool:
    """Whether `ugat_marl` comes from site-packages, and not from a source tree."""
    return Path(ugat_marl.__file__).is_relative_to(sysconfig.get_paths()["purelib"])


def pytest_configure(config: pytest.Config) -> None:
    """Refuses to test the source tree where `make test` promised the installed wheel."""
    if os.environ.get("UGAT_MARL_TEST_INSTALLED") and not installed():
        raise pytest.UsageError(
            f"the tests would import {ugat_marl.__file__} and not the installed wheel"
        )


def pytest_report_header() -> str:
    """Says in the first lines which package is tested."""
    return f"ugat_marl {ugat_marl.__version__} from {Path(ugat_marl.__file__).parent}"


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Names a failure as it happens; only the process that shows the results speaks."""
    if report.failed and "PYTEST_XDIST_WORKER" not in os.environ:
        where = f"{report.nodeid} ({report.when})" if report.when != "call" else report.nodeid
        print(f"\nFAILED {where}: {_last_line(report.longreprtext)}", flush=True)


def _last_line(text: str) -> str:
    """The line that says what went wrong: the first of pytest's ``E``, or the last there is."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return next((line[1:].strip() for line in lines if line.startswith("E ")), "".join(lines[-1:]))


DATA = Path(__file__).parent / "fixtures"

ROUTES = """<routes>
    <vType id="car" vClass="passenger" length="5" minGap="2.5" accel="2.5" decel="4.5" sigma="0"
           speedFactor="1" speedDev="0"/>
    {types}
    <route id="north" edges="S_C C_N"/>
    <route id="east" edges="W_C C_E"/>
    {vehicles}
</routes>
"""


def make_crossing(
    directory: Path,
    vehicles: str | None = None,
    types: str = "",
    edit: Callable[[str], str] | None = None,
    toml: Callable[[str], str] | None = None,
) -> Path:
    """Copies the hand-made crossing of tests/data and changes it.

    Args:
        directory: Where the scenario goes.
        vehicles: XML of the vehicles; the routes "north" and "east" and the type "car" exist. None
            keeps a car every 20 s on each road.
        types: XML of further vehicle types.
        edit: Changes the text of the network.
        toml: Changes the text of scenario.toml.
    """
    shutil.copytree(DATA / "crossing", directory)
    if vehicles is not None:
        (directory / "demand.rou.xml").write_text(ROUTES.format(types=types, vehicles=vehicles))
    for name, change in (("network.net.xml", edit), ("scenario.toml", toml)):
        if change is not None:
            file = directory / name
            before = file.read_text()
            after = change(before)
            assert after != before, f"the edit of {name} changed nothing"
            file.write_text(after)
    return directory


@pytest.fixture(scope="session")
def _host() -> Iterator[Host]:
    host = Host(SERVICE)
    yield host
    host.close()


@pytest.fixture(autouse=True)
def _warm(_host: Host) -> None:
    """Keeps the process that forks simulators from one test to the next: SUMO is loaded once."""
    if hasattr(os, "fork"):
        _host.warm()


@pytest.fixture
def crossing(tmp_path: Path) -> Callable[..., Path]:
    """`make_crossing` in a new directory at each call."""
    made: list[Path] = []

    def make(**changes: object) -> Path:
        made.append(tmp_path / f"crossing{len(made)}-v1")
        return make_crossing(made[-1], **changes)  # pyright: ignore[reportArgumentType]

    return make


@pytest.fixture(scope="session")
def data() -> Path:
    """Files made for the tests."""
    return DATA


@pytest.fixture(scope="session")
def hangzhou() -> Path:
    """The Hangzhou networks, which have no licence and so are never part of the project."""
    directory = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not directory.is_dir():
        pytest.skip(f"no Hangzhou networks in {directory}")
    return directory


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for temporary files that is empty before and must be empty after."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setenv("TMPDIR", str(folder))
    return folder


@pytest.fixture
def python(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The command of an interpreter that imports what this one does, from any directory."""
    package = str(Path(ugat_marl.__file__).parents[1])
    others = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(dict.fromkeys([package, *others, CHECKOUT])))
    return [sys.executable]
