"""The study of detection limits: the values that it tries, and its summary by hand."""

from __future__ import annotations

from studies.detection_limits import Trial, domains_at, summary
from ugat_marl.diagnosis import DetectionLimit


def test_values_on_both_ends_of_a_limit_are_tried_unless_nothing_is_there() -> None:
    limits = [
        DetectionLimit("headway", "seconds", "s", 1.0, 1.2, 1.3),
        DetectionLimit("late_green", "seconds", "s", 0.0, 0.0, 0.2),
        DetectionLimit("gap_acceptance", "seconds", "s", 1.0, 2.5, None),
    ]
    assert domains_at(limits) == [
        ("usual", "sim"),
        ("shown", "headway=1.3"),
        ("hidden", "headway=1.2"),
        ("shown", "late_green=*,0.2"),
        ("hidden", "gap_acceptance=2.5"),
    ]


def test_summary_by_hand() -> None:
    found = [
        Trial("usual", "sim", 2, 40),
        Trial("shown", "headway=1.3", 3, 4),
        Trial("shown", "late_green=*,0.2", 4, 4),
        Trial("hidden", "headway=1.2", 1, 4),
    ]
    assert summary(found) == [
        "| shown | 2 | 7 of 8 | 0.53–0.98 |",
        "| hidden | 1 | 1 of 4 | 0.05–0.70 |",
        "| usual | 1 | 2 of 40 | 0.01–0.17 |",
    ]
