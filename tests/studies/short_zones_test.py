"""The study of short zones: its table has every street, with the zone that is there."""

from __future__ import annotations

import pytest

from studies.short_zones import main


def test_a_zone_is_told_where_there_is_one(capsys: pytest.CaptureFixture[str]) -> None:
    main(["single-v1", "--domains", "V4", "detection_zone=50"])
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert rows == [
        ["single-v1", "V4", "none"],
        ["single-v1", "detection_zone=50", "45", "to", "56.25"],
    ]
