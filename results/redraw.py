"""Draw the pictures of all tables in results/ anew, from their numbers.

python results/redraw.py
"""

from __future__ import annotations

import re
from pathlib import Path

from ugat_marl.reporting import draw_table, read_rows

FOLDER = Path(__file__).parent


def simulation_of(page: Path) -> str:
    """Return the simulation of a table, from the command on its page."""
    command = page.read_text(encoding="utf-8").replace("\\\n", " ")
    named = re.search(r"--sim\s+(\S+)", command)
    return named[1] if named else "sim"


def main() -> None:
    """Draw every table."""
    for table in sorted(FOLDER.glob("*/*/table.csv")):
        draw_table(read_rows(table), simulation_of(table.with_name("table.md")), table.parent)
        print(table.parent.relative_to(FOLDER))


if __name__ == "__main__":
    main()
