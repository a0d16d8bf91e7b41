"""Options that several commands have, with what their default means in place of None."""

from __future__ import annotations

from typing import Annotated

from tyro.conf import arg

Workers = Annotated[int | None, arg(metavar="INT", help_behavior_hint="(default: one per core)")]
"""Simulations at a time."""

LengthS = Annotated[
    float | None, arg(metavar="FLOAT", help_behavior_hint="(default: the scenario's own)")
]
"""Length of a day or an episode, s."""
