"""SUMO's converters: confined to their folder, and quoted when they fail."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ugat_marl.errors import ScenarioError
from ugat_marl.scenarios.confinement import confinement_missing
from ugat_marl.scenarios.sumo_tools import convert, run_program, sumo_program

confined = pytest.mark.skipif(bool(confinement_missing()), reason=confinement_missing())
NETWORK = Path(__file__).parents[1] / "fixtures" / "crossing" / "network.net.xml"
HARMLESS = '<vehicle id="a" depart="0"><route edges="W_C C_E"/></vehicle>'


@pytest.fixture
def work(tmp_path: Path) -> Path:
    """The folder of a converter, with a network."""
    folder = tmp_path / "work"
    folder.mkdir()
    shutil.copy(NETWORK, folder / "network.net.xml")
    return folder


def routing(work: Path, routes: str, out: Path) -> list[str]:
    """Options of duarouter for the content of a route file."""
    (work / "trips.xml").write_text(f"<routes>{routes}</routes>")
    return ["-n", str(work / "network.net.xml"), "-r", str(work / "trips.xml"), "-o", str(out)]


def test_a_converter_works_in_its_folder(work: Path) -> None:
    convert("duarouter", routing(work, HARMLESS, work / "out.xml"), work)
    assert "<vehicle" in (work / "out.xml").read_text()


@confined
def test_a_converter_writes_nowhere_else(work: Path, tmp_path: Path) -> None:
    kept = tmp_path / "kept.xml"
    kept.write_text("what the user wrote")
    arguments = routing(work, HARMLESS, kept)
    with pytest.raises(ScenarioError, match="duarouter: .*kept"):
        convert("duarouter", arguments, work)
    assert kept.read_text() == "what the user wrote"
    # Unconfined, the same command overwrites the file: the test can fail.
    run_program("duarouter", [str(sumo_program("duarouter")), *arguments])
    assert "<vehicle" in kept.read_text()


@confined
def test_a_converter_reads_only_what_it_was_told(work: Path, tmp_path: Path) -> None:
    other = tmp_path / "secret.xml"
    other.write_text(f"<routes>{HARMLESS}</routes>")
    out = work / "out.xml"
    arguments = routing(work, f'<include href="{other}"/>', out)
    with pytest.raises(ScenarioError, match="duarouter: "):
        convert("duarouter", arguments, work)
    convert("duarouter", arguments, work, reads=[other])
    assert "<vehicle" in out.read_text()


@confined
def test_a_tool_in_python_writes_nowhere_else(work: Path, tmp_path: Path) -> None:
    (work / "candidates.xml").write_text('<routes><route id="a" edges="W_C C_E"/></routes>')
    (work / "counts.xml").write_text(
        '<data><interval begin="0" end="60"><edge id="W_C" entered="3"/></interval></data>'
    )
    arguments = ["-r", str(work / "candidates.xml"), "--edgedata-files", str(work / "counts.xml")]
    convert("routeSampler.py", [*arguments, "-o", str(work / "out.xml")], work)
    assert "<vehicle" in (work / "out.xml").read_text()
    with pytest.raises(ScenarioError, match="routeSampler.py: .*Permission"):
        convert("routeSampler.py", [*arguments, "-o", str(tmp_path / "out.xml")], work)
    assert not (tmp_path / "out.xml").exists()
