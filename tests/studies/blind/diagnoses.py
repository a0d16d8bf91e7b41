"""Diagnoses made by hand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ugat_marl.diagnosis import Diagnosis


def says(verdict: str, *effects: Mapping[str, Any], **more: Any) -> Diagnosis | None:
    """Return a diagnosis that says this, and nothing else; None for a failed one."""
    if verdict == "failed":
        return None
    nothing = dict.fromkeys(Diagnosis.__dataclass_fields__)
    many = (
        "left_out", "ruled_out", "findings", "where", "left", "alternatives", "statistics",
        "lanes", "untried", "approaches", "patterns", "unnamed", "limits",
    )  # fmt: skip
    grounds = {"distance": 1.0, "runner_up_is_worse_by": None}
    return Diagnosis.from_json(
        nothing | {name: [] for name in many} | {
            "schema": "ugat-marl/diagnosis/7", "scenario": "single-v1", "seed": 0, "alpha": 0.05,
            "budget_h": None, "budget_s": 1.0,
            "periods": {"fit": [], "heldout": []}, "hashes": {}, "versions": {},
            "verified_on_fitted_periods": True, "sentence": "", "complete": True,
            "verdict": verdict, "effects": [{"evidence": grounds, **each} for each in effects],
        } | more
    )  # fmt: skip
