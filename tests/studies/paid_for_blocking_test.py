"""A reward that is blind beyond the lanes at the lights pays for blocking; the default does not."""

from __future__ import annotations

import pytest

from studies.paid_for_blocking import Paid, play, rank_correlation, wrong_pairs
from ugat_marl.scenarios import resco_maps


def test_wrong_pairs_are_found() -> None:
    good = Paid("good", 100.0, 0.0, {"queue": -20.0, "total-queue": -20.0})
    blocks = Paid("blocks", 200.0, 50.0, {"queue": -10.0, "total-queue": -60.0})
    close = Paid("close", 101.0, 0.0, {"queue": -9.0, "total-queue": -19.0})
    rows = [good, blocks, close]
    assert wrong_pairs(rows, "queue") == [("blocks", "good", 1.0)]
    assert wrong_pairs(rows, "total-queue") == []
    assert wrong_pairs([good, close], "queue", margin=0.0) == [
        ("close", "good", pytest.approx(0.01))
    ]
    assert rank_correlation([good, blocks], "total-queue") == pytest.approx(1.0)
    assert rank_correlation([good, blocks], "queue") == pytest.approx(-1.0)


def test_beyond_capacity_only_the_total_queue_follows_travel_times() -> None:
    names = ("fixed-time:10", "fixed-time:90", "largest-queue:40", "starving:1")
    rows = [play("single-v1", "demand_level=*,2", name, [1], 1200.0) for name in names]
    assert max(row.backlog for row in rows) > 20
    assert wrong_pairs(rows, "total-queue") == []
    assert rank_correlation(rows, "total-queue") == pytest.approx(1.0)
    assert wrong_pairs(rows, "queue")


@pytest.mark.slow
@pytest.mark.skipif(not resco_maps(), reason="sumo-rl is not installed")
def test_ingolstadt7_as_it_comes() -> None:
    """The lanes at its lights begin 1 to 140 m before the stop line."""
    names = ("fixed-time:10", "largest-queue:40")
    rows = [play("resco:ingolstadt7", "sim", name, [1]) for name in names]
    assert [pair[:2] for pair in wrong_pairs(rows, "queue")] == [names]
    assert wrong_pairs(rows, "total-queue") == []
