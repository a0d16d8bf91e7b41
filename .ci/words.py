"""Check the words of the project: openings of docstrings, lines and numbers of pages.

Run by `make words`: ``python .ci/words.py``. Prints a line for each fault, and exits with 1 if
there is one. The rules are those of CONTRIBUTING.md, "Words".
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CODE = ("ugat_marl", "studies", "baselines", "scenarios", "results", ".ci")
PAGES = ("README.md", "CONTRIBUTING.md", "docs/**/*.md", "results/**/*.md")
RIDDLES = re.compile(r"(What|Who|Whoever|Whose|Whether|How|Of|As|If|Where|Which|When|That)\b(?!-)")
"""Words a docstring may not open with: it opens with a verb or a plain noun."""
LONGEST_LINE = 300
"""Characters in a line of prose; what is longer cannot be read beside its change."""
MOST_NUMBERS = 5
"""Numbers in a paragraph of prose; more belong into a table."""
NUMBER = re.compile(r"(?<![\w.`/=:-])[-+−]?\d+(?:[.,]\d+)*(?![\w`/=]|\.\d|-v\d)")
"""A figure of its own: not part of a name such as V4, single-v1 or 4x4, and not in code."""


def docstring_faults(source: str, name: str) -> Iterator[str]:
    """Yield a line for each docstring of a module that opens with a riddle."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text and (opening := RIDDLES.match(text)):
                line = getattr(node, "lineno", 1)
                yield f"{name}:{line}: the docstring opens with {opening.group()!r}"


def page_faults(text: str, name: str) -> Iterator[str]:
    """Yield a line for each line of prose that is too long and each paragraph of many numbers."""
    for line, paragraph in paragraphs(text):
        for offset, row in enumerate(paragraph):
            if len(row) > LONGEST_LINE:
                yield f"{name}:{line + offset}: {len(row)} characters in a line of prose"
        numbers = len(NUMBER.findall(plain(" ".join(paragraph))))
        if numbers > MOST_NUMBERS:
            yield f"{name}:{line}: {numbers} numbers in a paragraph; put them into a table"


def paragraphs(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the paragraphs of prose with the number of their first line.

    Tables, code, headings, pictures alone in a line and HTML are no prose. Each item of a list is a
    paragraph.
    """
    rows: list[str] = []
    first = 0
    fenced = False
    for number, row in enumerate([*text.split("\n"), ""], start=1):
        bare = row.strip()
        fence = bare.startswith(("```", "~~~"))
        prose = bool(bare) and not (fenced or fence) and not re.match(r"[|#<]|!\[|---", bare)
        item = bool(re.match(r"([-*]|\d+\.) ", bare))
        if rows and (not prose or item):
            yield first, rows
            rows = []
        if prose:
            first = first if rows else number
            rows.append(re.sub(r"^\s*\d+\. ", "", row) if item else row)
        fenced ^= fence


def plain(text: str) -> str:
    """Return prose without code spans and without the addresses of links."""
    return re.sub(r"\]\([^)]*\)", "]", re.sub(r"`[^`]*`", "", text))


def faults(root: Path, code: Iterable[str] = CODE, pages: Iterable[str] = PAGES) -> list[str]:
    """Return all faults below a directory."""
    found: list[str] = []
    for folder in code:
        for path in sorted((root / folder).rglob("*.py")):
            name = str(path.relative_to(root))
            found += docstring_faults(path.read_text(encoding="utf-8"), name)
    for pattern in pages:
        for path in sorted(root.glob(pattern)):
            found += page_faults(path.read_text(encoding="utf-8"), str(path.relative_to(root)))
    return found


def main() -> int:
    """Print the faults and return the exit code."""
    found = faults(ROOT)
    print("\n".join(found) if found else "words: no faults")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
