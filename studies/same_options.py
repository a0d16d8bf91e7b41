"""Options of results that a repeated command goes on with: other options are refused."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ugat_marl.errors import OutputError
from ugat_marl.files import read_json, write_whole


def require_same(file: Path, options: Mapping[str, Any], *, begun: bool) -> None:
    """Refuse to go on with results of other options; write the options where no results are.

    Args:
        file: File of the options, in the folder of the results.
        options: Options on which results depend.
        begun: True if the folder holds results; only they are bound to their options.

    Raises:
        OutputError: The file has other options, or results are there and no file.
    """
    if not begun:
        write_whole(file, json.dumps(dict(options), indent=1) + "\n")
        return
    if not file.exists():
        raise OutputError(
            f"{file.parent}: holds results, and no {file.name} tells their options; give another "
            "folder"
        )
    before = read_json(file, OutputError)
    for name, value in options.items():
        if before.get(name) != value:
            raise OutputError(
                f"{file.parent}: its results were made with {name} = {before.get(name)}, not "
                f"{value}; give the same options, or another folder"
            )
