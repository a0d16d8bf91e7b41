"""Write the overview in results/README.md anew from the tables in results/.

python results/overview.py
"""

from __future__ import annotations

import csv
import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from ugat_marl.experiments import CONTROL, DIRECT, ORACLE, RULE, STREET, TIMED, matched_name
from ugat_marl.files import write_whole
from ugat_marl.reporting import number_text, percent_text, share_text

FOLDER = Path(__file__).parent
BEGIN, END = "<!-- overview -->\n", "<!-- end of overview -->\n"
GROUNDED = (TIMED, matched_name("timed"), STREET)
CONSTANT = "constant delay"
BESIDE = ("there", "*matched*")
"""Folders with tables of further settings in the same domains and with equal direct transfer."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of one setting in one domain.

    Attributes:
        att_s: Travel time in the domain in s, mean over training seeds.
        gap_s: `att_s` minus the travel time in the simulation, in s.
    """

    att_s: float
    gap_s: float


Column = Mapping[str, Outcome]
"""Outcomes in one domain, by setting."""


def columns(table: Path) -> dict[str, Column]:
    """Return the outcomes of a `table.csv`, by domain."""
    found: dict[str, dict[str, Outcome]] = defaultdict(dict)
    with table.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            own = Outcome(float(row["att_s"]), float(row["att_s_gap"]))
            found[row["domain"]][row["setting"]] = own
    return dict(found)


def known(table: Path) -> dict[str, Column]:
    """Return the outcomes of a `table.csv` and of the tables `BESIDE` it, by domain.

    Another table is added only where its direct transfer is equal to the digit: then the
    evaluations agree.
    """
    found, scenario = columns(table), table.parent.parent
    for other in (path for name in BESIDE for path in sorted(scenario.glob(f"{name}/table.csv"))):
        for domain, column in columns(other).items():
            if domain in found and found[domain][DIRECT] == column[DIRECT]:
                found[domain] = {**column, **found[domain]}
    return found


def regret_s(setting: str, column: Column) -> float:
    """Return the travel time minus that of the best setting, in s."""
    return column[setting].att_s - min(own.att_s for own in column.values())


def won_back(setting: str, column: Column) -> float:
    """Return the share of direct transfer's regret that a setting removes.

    1 - regret(setting) / regret(direct); nan if direct transfer is the best setting.
    """
    start = regret_s(DIRECT, column)
    return 1.0 - regret_s(setting, column) / start if start > 0 else math.nan


def reduction(setting: str, column: Column) -> float:
    """Return the change of direct transfer's gap, as a share.

    gap(setting) / gap(direct) - 1, negative for a smaller gap; nan if direct transfer has no gap.
    """
    start = column[DIRECT].gap_s
    return column[setting].gap_s / start - 1.0 if start > 0 else math.nan


def heading(page: Path) -> str:
    """Return the heading of a page of Markdown, which names its scenario and its table."""
    return page.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")


def learner(page: Path) -> str:
    """Return the learner of a table, from the command on its page."""
    text = page.read_text(encoding="utf-8")
    named = re.search(r"--learner\s+(\S+)", text)
    return named[1] if named else "dqn" if "--preset paper" in text else "universal"


def overview(folder: Path = FOLDER) -> str:
    """Return the overview as Markdown: every domain of every table of transfer, and means."""
    lines = [
        "| table, learner | | direct transfer (regret) | timed | timed, rewards matched "
        "| fitted street | more plain `sim` | constant delay | trained in real | best rule there |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for table in sorted(folder.glob("*/main*/table.csv")):
        found = known(table)
        page = table.with_suffix(".md")
        first = f"[{heading(page)}]({page.relative_to(folder)}), {learner(page)}"
        # Effects that all domains of a table share are in its sim, too, and are left out.
        shared = {domain.partition("+")[2] for domain in found}
        for domain, column in found.items():
            short = domain.partition("+")[0] if len(shared) == 1 else domain
            lines.append(_line(first, short, column))
            first = ""
        if len(found) > 1:
            lines.append(_mean(list(found.values())))
    return "\n".join(lines) + "\n"


def _line(name: str, domain: str, column: Column) -> str:
    others = [
        _att(column, [own for own in column if own.startswith(start)])
        for start in (CONTROL, CONSTANT, ORACLE, RULE)
    ]
    direct = f"{_att(column, [DIRECT])} ({number_text(regret_s(DIRECT, column))})"
    cells = [name, domain, direct, *(_grounded(g, column) for g in GROUNDED)]
    return f"| {' | '.join(cells + others)} |"


def _att(column: Column, settings: Sequence[str]) -> str:
    return number_text(min(column[own].att_s for own in settings)) if settings else ""


def _grounded(setting: str, column: Column) -> str:
    if setting not in column:
        return ""
    gap, back = percent_text(reduction(setting, column)), share_text(won_back(setting, column))
    return f"**{number_text(column[setting].att_s)}** {gap}, {back}"


def _mean(found: Sequence[Column]) -> str:
    cells = ["", "*mean*", ""]
    for setting in GROUNDED:
        having = [column for column in found if setting in column]
        if len(having) < len(found):
            cells.append("")
            continue
        gap = percent_text(fmean(reduction(setting, column) for column in having))
        back = share_text(fmean(won_back(setting, column) for column in having))
        cells.append(f"*{gap}, {back}*")
    return f"| {' | '.join(cells)} | | | | |"


def with_overview(page: str, folder: Path = FOLDER) -> str:
    """Return the page with a new overview between its marks."""
    if BEGIN not in page or END not in page:
        raise ValueError(f"the overview belongs between {BEGIN.strip()} and {END.strip()}")
    before, _, rest = page.partition(BEGIN)
    return f"{before}{BEGIN}\n{overview(folder)}\n{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    page = FOLDER / "README.md"
    write_whole(page, with_overview(page.read_text(encoding="utf-8")))
