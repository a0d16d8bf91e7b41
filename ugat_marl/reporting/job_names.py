"""Names of the jobs of ``ugat-marl paper`` in its tables, by their settings alone."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

_PLAIN = {
    "direct": "direct transfer",
    "randomised": "domain randomisation",
    "delays": "random delay",
    "rule": "best rule, tuned there",
}
_GROUNDED = {"phase": "UGAT", "timed": "UGAT, timed"}
_LATE = re.compile(r"(?:.*\+)?late_green=\*,(\d+)")


def job_name(job: Mapping[str, Any]) -> str:
    """The name of the row of a job.

    Args:
        job: The content of ``job.json``.
    """
    kind, world = str(job.get("kind", "")), job.get("world")
    if kind in _PLAIN:
        return _PLAIN[kind]
    if kind == "grounded":
        return _GROUNDED.get(grounding_of(job), "UGAT")
    if kind == "further":
        if world is None:
            return "fine-tuned on the same data"
        if world == job.get("sim"):
            return "more plain sim"
        late = _LATE.fullmatch(str(world))
        return f"constant delay {late[1]} s" if late else f"further in {world}"
    if kind == "scratch":
        return "trained in real" if world is None else f"trained in {world}"
    return kind or "unknown"


def grounding_of(settings: Mapping[str, Any]) -> str:
    """The kind of grounding of a run or job."""
    ugat = settings.get("ugat")
    return str(ugat.get("grounding", "phase")) if isinstance(ugat, Mapping) else ""
