"""What the pages have in common: one file of HTML that needs nothing else and runs nothing."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from html import escape

from ugat_marl.reporting.diagnosis_style import STYLE

POLICY = "default-src 'none'; style-src 'unsafe-inline'"
"""Content security policy: nothing is loaded, nothing is run, whatever a name smuggles in."""

_MANY = 7
"""Columns beyond which a table is set narrower."""


def document(title: str, body: str, style: str = "") -> str:
    """A whole page.

    Args:
        title: Plain text.
        body: HTML of what stands in the body.
        style: Rules that this page has beside those of all pages.
    """
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}{style}</style>\n</head>\n<body>\n"
        f"{body}\n</body>\n</html>\n"
    )


def grid(
    headings: Sequence[str], rows: Sequence[Sequence[str]], numbers: Collection[str] = ()
) -> str:
    """A table that becomes a list of cards where it does not fit.

    Args:
        headings: Plain text.
        rows: Plain text, as many cells as there are headings.
        numbers: Headings of columns that are set flush right.
    """
    classes = [' class="n"' if name in numbers else "" for name in headings]
    named = list(zip(headings, classes, strict=True))
    head = "".join(f"<th{c}>{escape(name)}</th>" for name, c in named)
    body = "".join(
        "<tr>"
        + "".join(
            f'<td{c} data-label="{escape(name, quote=True)}">{escape(cell)}</td>'
            for (name, c), cell in zip(named, row, strict=True)
        )
        + "</tr>"
        for row in rows
    )
    many = " many" * (len(headings) > _MANY)
    return f'<table class="stack{many}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def folded(summary: str, body: str, *, opened: bool = False) -> str:
    """Something that is shown on request; `summary` is plain text."""
    return f"<details{' open' * opened}><summary>{escape(summary)}</summary>{body}</details>"
