"""The comparison of detectors with lanes: what is known is close, what is guessed is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from studies.detector_logs import errors, fits, record_street
from ugat_marl.effects import load_scenario


def test_a_queue_that_detectors_see_is_close(data: Path) -> None:
    scenario = load_scenario(data / "crossing")
    logs = record_street(scenario, "sim", "fixed-time:20", 1)
    known, guessed = errors(scenario, *logs)
    assert (known.lanes, guessed.lanes) == (2, 0)
    assert known.vehicles > 1.0
    assert known.error < 0.2
    # Detectors of other days are far off.
    _, other = record_street(scenario, "sim", "fixed-time:10", 1)
    assert errors(scenario, logs[0], other)[0].error > 0.4
    assert 0.0 < known.said < 1.0
    assert np.isnan(guessed.error)


def test_a_street_is_fitted_to_either_log(data: Path) -> None:
    scenario = load_scenario(data / "crossing")
    found = fits(scenario, *record_street(scenario, "sim", "fixed-time:20", 1), 20)
    assert len(found["lanes"]) == len(found["detectors"]) == len(found["effect"]) > 3
    assert found["effect"][0] == "acceleration"
