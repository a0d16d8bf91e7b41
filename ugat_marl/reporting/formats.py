"""Numbers as texts, and texts of Markdown.

`number`, `signed`, `share` and `chance` are for prose and pages, and `tick_text` for axes.
`number_text`, `signed_text`, `ends_text`, `mean_text`, `share_text` and `percent_text` are for
columns of tables, which align by their decimals.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ugat_marl.experiments import Interval


def number(value: Any, digits: int = 3) -> str:
    """Return a number with `digits` significant digits, or a whole number with grouped thousands.

    A missing, infinite or undefined number is a dash.
    """
    if value is None or isinstance(value, bool) or not isinstance(value, int | float):
        return "–" if value is None else str(value)
    if not math.isfinite(value):
        return "–"
    if abs(value) >= 10**digits - 0.5:
        return f"{value:,.0f}".replace(",", "\u00a0").replace("-", "−")
    return f"{value + 0.0:.{digits}g}".replace("-", "−")


def signed(value: Any) -> str:
    """Return a number with its sign."""
    text = number(value)
    return text if text[:1] in ("−", "–") or text == "0" else f"+{text}"


def share(value: Any) -> str:
    """Return a share in per cent; a share below 1 is never rounded to 100 %."""
    if value is None or math.isnan(value):
        return "–"
    percent = 100 * float(value)
    if percent < -0.5:
        return f"−{share(-value)}"
    for digits in (0, 1, 2):
        text = fixed(percent, digits)
        if text.partition(".")[0] != "100" or value >= 1:
            return f"{text} %"
    return "99.99 %"


def chance(value: Any) -> str:
    """Return a probability, such as 0.05 or < 0.001."""
    if value is None:
        return "–"
    return "< 0.001" if value < 0.001 else f"{value:.2g}"


def fixed(value: float, decimals: int, *, plus: bool = False) -> str:
    """Return a number with fixed decimals, perhaps with a plus; what rounds to 0 has no sign."""
    text = f"{value:{'+' if plus else ''}.{decimals}f}"
    return text.lstrip("+-") if float(text) == 0 else text


def number_text(value: float) -> str:
    """Return a number with 0 to 2 decimals, fewer the larger it is; "-" for nan."""
    if math.isnan(value):
        return "-"
    if abs(value) >= 99.95:
        return fixed(value, 0)
    return fixed(value, 1 if abs(value) >= 0.9995 else 2)


def signed_text(value: float) -> str:
    """Return `number_text` of a number with its sign; what rounds to 0 has none."""
    text = number_text(value)
    return text if text.startswith("-") or float(text) == 0 else f"+{text}"


def ends_text(low: float, high: float) -> str:
    """Return an interval; a dash between its ends would make a negative one unclear."""
    return f"{number_text(low)}{' to ' if low < 0 else '–'}{number_text(high)}"


def mean_text(interval: Interval) -> str:
    """Return a mean with its interval, if it has one."""
    mean = number_text(interval.mean)
    return f"{mean} ({ends_text(interval.low, interval.high)})" if interval.is_wide else mean


def share_text(value: float) -> str:
    """Return a share of the regret with two decimals, or more where it would become 1.00.

    The best row alone has 1.00. A dash for nan.
    """
    if math.isnan(value):
        return "–"
    texts = (fixed(value, decimals) for decimals in (2, 3, 4))
    return next((text for text in texts if value >= 1 or float(text) < 1), "0.9999").replace(
        "-", "−"
    )


def percent_text(value: float) -> str:
    """Return a signed share in per cent; what rounds to zero has no sign. A dash for nan."""
    return "–" if math.isnan(value) else f"{fixed(100 * value, 0, plus=True)} %".replace("-", "−")


def tick_text(value: float, _: Any = None) -> str:
    """Return the text of a number on a scale; the second argument is matplotlib's and unused."""
    if abs(value) >= 9_999.5:
        return f"{value:,.0f}".replace(",", "\u2009").replace("-", "−")
    return f"{round(value, 6) + 0.0:.4g}".replace("-", "−")


def flat_settings(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Return settings by their paths, such as ``ugat.gate.mode``."""
    rows: list[tuple[str, str]] = []
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            rows += flat_settings(value, f"{prefix}{key}.")
        else:
            shown = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            rows.append((f"{prefix}{key}", shown))
    return rows


PAGE_WIDTH = 140
"""Longest line of prose in Markdown, in characters."""
COMMAND_WIDTH = 100
"""Longest line of a command in Markdown, in characters."""


def command_block(command: str) -> list[str]:
    """Return a command as a block of Markdown, with long lines continued."""
    lines = [""]
    for word in re.findall(r"""(?:[^\s'"]|'[^']*'|"[^"]*"|['"])+""", command):
        if lines[-1] and len(lines[-1]) + 1 + len(word) > COMMAND_WIDTH:
            lines[-1] += " \\"
            lines.append(f"  {word}")
        else:
            lines[-1] += f" {word}" if lines[-1] else word
    return ["```sh", *lines, "```"]


def commands_in(page: str) -> list[str]:
    """Return the commands in the blocks of a page in Markdown, each in one line."""
    blocks = re.findall(r"^```sh\n(.*?)^```", page, flags=re.DOTALL | re.MULTILINE)
    lines = (re.sub(r" \\\n\s*", " ", block).splitlines() for block in blocks)
    return [line for block in lines for line in block]


def made_with(rows: Mapping[str, Any]) -> list[str]:
    """Return a table of Markdown on how figures were made: command, versions, machine."""
    return [
        "| Made with | |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in rows.items()),
    ]
