"""Episodes, recordings, trainings and diagnoses have the numbers that were written down.

A change of a number that is meant goes with new digests, in a commit that gives the reason.
"""

from __future__ import annotations

import importlib.metadata
import json
import sys
from pathlib import Path

import pytest

from studies.behaviour_digests import NotInstalled, difference, moved, parts, played

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(3600)]

WRITTEN = json.loads(
    (Path(__file__).parents[2] / "studies/behaviour_digests.json").read_text(encoding="utf-8")
)


def of_other_versions() -> str:
    """Return what is installed in another version than the numbers belong to."""
    others = [
        f"{name} {installed}, not {version}"
        for name, version in WRITTEN["made_with"].items()
        if (installed := version_of(name)) != version
    ]
    return "; ".join(others)


def version_of(name: str) -> str:
    """Return the installed version of a package, or of Python."""
    if name == "python":
        return ".".join(map(str, sys.version_info[:3]))
    return importlib.metadata.version(name)


@pytest.mark.skipif(bool(of_other_versions()), reason=of_other_versions())
@pytest.mark.parametrize("name", parts())
def test_the_numbers_are_those_that_were_written_down(name: str) -> None:
    if name not in WRITTEN["parts"]:
        pytest.skip(f"no numbers of {name} are written down")
    before = WRITTEN["parts"][name]
    try:
        now = played(name)
    except NotInstalled as error:
        pytest.skip(str(error))
    assert now["sha256"] == before["sha256"], difference(before, now)
    assert not moved(before, now), difference(before, now)
