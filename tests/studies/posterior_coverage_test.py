"""The study of coverage: its table by hand, and its other streets."""

from __future__ import annotations

import numpy as np

from studies.posterior_coverage import Asked, draw_other, streets_of, table
from ugat_marl.grounding import Worlds

WORLDS = Worlds.of(tuple(f"lane_{k}" for k in range(6)))


def test_table_by_hand() -> None:
    asked = [
        Asked("prior", "headway", 1.5, 1.0, 1.4, 2.0, 1.0, 2.0),  # covered, error 0.1 for 0.5
        Asked("prior", "headway", 2.1, 1.0, 1.4, 2.0, 1.1, 2.0),  # missed, error 0.7 for 1.0
        Asked("other", "headway", 2.0, 1.0, 1.5, 2.0, 2.0, 2.0),  # the end of an interval is in
    ]
    lines = table(asked).splitlines()
    assert "| prior | headway | 2 | 0.50 | 0.09–0.91 | 0.50 | 0.63 |" in lines
    assert "| other | headway | 1 | 1.00 | 0.21–1.00 | 0.50 | – |" in lines
    assert (
        lines.index("| prior | headway | 2 | 0.50 | 0.09–0.91 | 0.50 | 0.63 |") < 4
    )  # worst first


def test_half_of_the_streets_are_not_of_the_prior() -> None:
    streets = streets_of(WORLDS, 400, 7)
    assert [kind for kind, _ in streets[:4]] == ["prior", "other", "prior", "other"]
    late_s = np.stack([values.service_s[:, 0] for kind, values in streets if kind == "other"])
    assert abs((late_s > 0).mean() - 1 / 3) < 0.05
    assert late_s[late_s > 0].min() >= 1.0
    again = draw_other(WORLDS, 3)
    assert np.array_equal(again.effects, draw_other(WORLDS, 3).effects)
