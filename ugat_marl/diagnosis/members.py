"""Sets of effects with their values: put together, taken apart, and named."""

from __future__ import annotations

from ugat_marl.diagnosis.fit import Members


def each_left_out(members: Members) -> list[Members]:
    """The set without each of its effects."""
    return [_without(members, index) for index in range(len(members))]


def merged(members: Members, new: Members) -> Members:
    """A model with further effects, or with other values; those at nothing are left out."""
    found = {hypothesis.key: (hypothesis, values) for hypothesis, values in members}
    for hypothesis, values in new:
        found[hypothesis.key] = (hypothesis, values)
    return tuple(
        (hypothesis, values)
        for hypothesis, values in found.values()
        if hypothesis.nominal is None or values != hypothesis.clipped(hypothesis.nominal)
    )


def _without(members: Members, place: int) -> Members:
    return (*members[:place], *members[place + 1 :])


def names_of(members: Members) -> str:
    """Names of the effects, for progress and notes."""
    return "+".join(hypothesis.name for hypothesis, _ in members)
