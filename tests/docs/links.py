"""Local links of a page: to a file that is there, and to a heading of it, as a code host has it."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path


def broken_links(text: str, page: Path) -> list[str]:
    """Local links of the text of a page whose file or heading is not there."""
    return [link for link in local_links(text) if not _leads_somewhere(link, text, page)]


def local_links(text: str) -> list[str]:
    """Targets of all links of a text that stay in the repository."""
    targets = re.findall(r"\]\(([^()\s]+)\)", _without_code(text))
    return [target for target in targets if not target.startswith(("http:", "https:", "mailto:"))]


def anchors(text: str) -> set[str]:
    """Anchors of the headings of a page; a heading that comes again has a number."""
    found: set[str] = set()
    seen: Counter[str] = Counter()
    for heading in re.findall(r"^#{1,6} +(.+?)(?: +#+)?$", _without_code(text), flags=re.MULTILINE):
        shown = re.sub(r"!?\[([^]]*)\]\([^)]*\)", r"\1", heading).lower()
        slug = re.sub(r"[^\w\- ]", "", shown).replace(" ", "-")
        found.add(f"{slug}-{seen[slug]}" if seen[slug] else slug)
        seen[slug] += 1
    return found


def _leads_somewhere(link: str, text: str, page: Path) -> bool:
    name, _, anchor = link.partition("#")
    target = page.parent / name if name else page
    if name and not target.exists():
        return False
    if not anchor or target.suffix != ".md":
        return True
    return anchor in anchors(text if target == page else target.read_text(encoding="utf-8"))


def _without_code(text: str) -> str:
    """A text without its fenced blocks, in which # begins a remark."""
    return re.sub(r"^( *)(```|~~~).*?^\1\2 *$", "", text, flags=re.MULTILINE | re.DOTALL)
