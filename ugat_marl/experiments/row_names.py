"""Names of the rows of tables: each is a way to come to a policy."""

from __future__ import annotations

DIRECT, PHASE, TIMED = "direct transfer", "phase (the paper's UGAT)", "timed"
CONTROL = "more plain sim"
CORRECTED = "corrected sim"
RANDOMISED = "domain randomisation"
RANDOM_DELAY = "random delay"
PENALTY = "penalty on changes"
FINE_TUNED = "fine-tuned on the same data"
ORACLE = "trained in real"
SEEING_ORACLE = "trained in real, sees its commands"
RULE = "best rule, tuned there"

STREET = "fitted street"
UNTRAINED = "pretrained, not trained here"

GROUNDED_NAME = {"phase": PHASE, "timed": TIMED, "street": STREET}
"""Name of the row of each kind of grounding."""


def short_name(name: str) -> str:
    """Return the name of a row, without the brackets if it is that of phase grounding."""
    return "phase" if name == PHASE else name


def variant_name(grounding: str, what: str) -> str:
    """Return the name of a row that differs from that of its grounding, as "timed: no gate"."""
    return f"{short_name(GROUNDED_NAME[grounding])}: {what}"


def is_grounded(name: str) -> bool:
    """Return True for the name of a row of a grounding, such as "timed: rewards matched"."""
    return short_name(name).partition(":")[0] in map(short_name, GROUNDED_NAME.values())
