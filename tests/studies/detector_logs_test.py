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
    assert known.error < 0.5 and known.served < 0.1 < known.left
    assert np.isnan(guessed.error)


def test_a_street_is_fitted_to_either_log(data: Path) -> None:
    scenario = load_scenario(data / "crossing")
    found = fits(scenario, *record_street(scenario, "sim", "fixed-time:20", 1), 20)
    assert len(found["lanes"]) == len(found["detectors"]) == len(found["effect"]) > 3
    assert found["effect"][0] == "acceleration"
