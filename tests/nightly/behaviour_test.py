"""Episodes, recordings, trainings and diagnoses have the numbers that were written down.

A change of a number that is meant goes with new digests, in a commit that gives the reason.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from studies.behaviour_digests import NotInstalled, difference, moved, other_versions, parts, played

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(3600)]

WRITTEN = json.loads(
    (Path(__file__).parents[2] / "studies/behaviour_digests.json").read_text(encoding="utf-8")
)


OTHERS = other_versions(WRITTEN["made_with"])


@pytest.mark.skipif(bool(OTHERS), reason=OTHERS)
@pytest.mark.parametrize("name", parts())
def test_the_numbers_are_those_that_were_written_down(name: str) -> None:
    assert name in WRITTEN["parts"], f"no numbers of {name} are written down"
    before = WRITTEN["parts"][name]
    try:
        now = played(name)
    except NotInstalled as error:
        pytest.skip(str(error))
    assert now["sha256"] == before["sha256"], difference(before, now)
    assert not moved(before, now), difference(before, now)
