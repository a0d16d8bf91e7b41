"""Options of the environment, as files of policies and learners hold them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from ugat_marl.errors import CheckpointError


def plain_options(env_options: Mapping[str, Any]) -> str:
    """Return the options of an environment as JSON.

    Raises:
        CheckpointError: An option is not plain data (for example a callable).
    """
    try:
        return json.dumps(dict(env_options), sort_keys=True)
    except TypeError as error:
        raise CheckpointError(
            f"env_options {dict(env_options)!r} cannot be saved ({error}); keep to plain data"
        ) from None


def other_observation(saved: Mapping[str, Any], own: Mapping[str, Any]) -> str:
    """Say in what the observations of two environments differ; "" if in nothing that is known.

    Observations of equal sizes may have other meanings, such as queues and counts.

    Args:
        saved: Options of the one environment, as in a checkpoint.
        own: Options of the other one.
    """
    if "observation" not in saved or "observation" not in own:
        return ""
    for name, usual in (("observation", None), ("neighbours", 0)):
        there, here = saved.get(name, usual), own.get(name, usual)
        if there != here:
            return f"{name} = {there!r}, not {here!r}"
    return ""
