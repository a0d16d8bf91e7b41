"""Pages of HTML for tests: their tags and texts, and their look in a browser."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import matplotlib.image
import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no chromium to look at the page with")
_FRAME = """<!DOCTYPE html><body style="margin:0"><iframe id="f" width="{width}" height="4000"
style="border:0" srcdoc="{page}"></iframe><p id="out"></p><script>
const errors = []; addEventListener("error", e => errors.push(String(e.message)));
f.onload = () => {{ const d = f.contentDocument, w = d.documentElement;
  let clicks = 0;
  for (const s of d.querySelectorAll("details:not([open]) > summary")) {{ s.click(); clicks += 1; }}
  const wide = [...d.querySelectorAll("body *")].filter(
    e => e.getBoundingClientRect().right > w.clientWidth + 1 && !e.closest("{aside}")
  ).map(e => e.tagName + "." + e.getAttribute("class"));
  const cut = [...d.querySelectorAll("svg text")].filter(t => {{
    const a = t.getBoundingClientRect(), b = t.closest("svg").getBoundingClientRect();
    return a.left < b.left - 1 || a.right > b.right + 1 || a.bottom > b.bottom + 1; }}
  ).map(t => t.textContent);
  const small = [...d.querySelectorAll("svg text")].filter(
    t => t.getBoundingClientRect().height < 8).map(t => t.textContent);
  out.textContent = JSON.stringify({{scroll: w.scrollWidth, width: w.clientWidth, wide, cut, small,
    clicks, open: d.querySelectorAll("details[open]").length, errors}}); }};
</script></body>"""


class Page(HTMLParser):
    """Tags, attributes and texts of a page; every tag must be closed."""

    VOID = ("meta", "br", "img")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, Any]]] = []
        self.open: list[str] = []
        self.texts: list[str] = []
        self.cells: list[list[str]] = []
        self.feed(text)
        assert not self.open, self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, Any]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "tr":
            self.cells.append([])
        elif tag == "td":
            self.cells[-1].append("")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, Any]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] == ["td"]:
            self.cells[-1][-1] += data.replace("\u00a0", " ")
        if "style" not in self.open[-1:]:
            self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())

    def row(self, first: str) -> list[str]:
        """The first row of a table that begins with a cell."""
        return next(row for row in self.cells if row[:1] == [first])


def seen_in_browser(page: str, width: int, directory: Path, *, aside: str) -> dict[str, Any]:
    """Sizes of a page in a browser of a width, with all its folded parts open.

    Args:
        page: HTML of the page.
        width: Width of the window.
        directory: Folder for the files of the browser.
        aside: Selector of the elements whose contents may be wider than the window.
    """
    frame = directory / "frame.html"
    frame.write_text(_FRAME.format(width=width, page=html.escape(page, quote=True), aside=aside))
    dom = _browse(directory, "--virtual-time-budget=3000", "--dump-dom", frame.as_uri())
    (found,) = re.findall(r'<p id="out">(.*?)</p>', dom)
    return json.loads(html.unescape(found))


def assert_drawn(page: Path, *, dark: bool) -> None:
    """Look at a page in a browser that prefers light or dark pages."""
    picture = page.with_suffix(".png")
    options = ["--blink-settings=preferredColorScheme=0"] if dark else []
    size = "--window-size=1280,1600"
    _browse(page.parent, *options, size, f"--screenshot={picture}", page.as_uri())
    pixels = matplotlib.image.imread(picture)
    assert pixels.shape[:2] == (1600, 1280)
    assert pixels.std() > 0.05
    assert (pixels[:, :, :3].mean() < 0.5) == dark


def _browse(directory: Path, *options: str) -> str:
    assert CHROMIUM is not None
    command = [
        CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
        "--hide-scrollbars", "--enable-logging=stderr", f"--user-data-dir={directory / 'profile'}",
        *options,
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert "CONSOLE" not in done.stderr, done.stderr
    return done.stdout
