"""Pages from templates: one file of HTML that loads no other file and runs no script.

Names may come from foreign files. The templates therefore escape every text, and the page forbids
scripts.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ugat_marl.errors import OutputError
from ugat_marl.files import require_writable
from ugat_marl.reporting.figures import NamedFigure
from ugat_marl.reporting.style import DARK, LIGHT, css_variables

if TYPE_CHECKING:
    from markupsafe import Markup

_MANY = 7
"""Number of columns above which a table is set narrower."""


@dataclass(frozen=True)
class Grid:
    """A table; a narrow screen shows it as a list of cards.

    Attributes:
        headings: Headings of the columns.
        rows: Rows, each with one text per heading.
        numbers: Headings of the columns that are aligned to the right.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: Sequence[str] = ()

    @property
    def many(self) -> bool:
        """True if the table has many columns."""
        return len(self.headings) > _MANY


@dataclass(frozen=True)
class Figure:
    """A picture and its caption."""

    picture: NamedFigure
    caption: str

    @property
    def svg(self) -> Markup:
        """The picture as HTML; an XML writer has escaped the texts in it."""
        from markupsafe import Markup

        return Markup(self.picture.for_page())


@dataclass
class Page:
    """A page under construction.

    Attributes:
        text: HTML of the page; "" until it is made.
        pictures: All pictures on the page; each has another name.
    """

    text: str = ""
    pictures: list[NamedFigure] = field(default_factory=list)

    def figures(self, *pairs: tuple[NamedFigure | None, str]) -> list[Figure]:
        """Return pictures with their captions; leave out each picture that is None."""
        made: list[Figure] = []
        for picture, caption in pairs:
            if picture is None:
                continue
            names = {other.name for other in self.pictures}
            base, again = picture.name, 1
            while picture.name in names:
                again += 1
                picture.name = f"{base}-{again}"
            self.pictures.append(picture)
            made.append(Figure(picture, caption))
        return made


def render(template: str, **context: Any) -> str:
    """Return a page made from one of the ``templates/``."""
    text = _environment().get_template(template).render(context)
    return text.encode("utf-8", "replace").decode()  # file names may hold half characters


_GENERATOR = b'<meta name="generator" content="ugat_marl">'
_FORBIDS_SCRIPTS = b"content=\"default-src 'none'; style-src 'unsafe-inline'\""
"""What pages begin with; those of earlier versions have the second line alone."""


def require_page_place(path: Path, title: str = "") -> None:
    """Refuse a path that cannot become a page, or whose file holds something else.

    Args:
        path: The file to write.
        title: Begin of the titles of pages that may be replaced; "" for every page.

    Raises:
        OutputError: No page can be written there, or the file there is not one of these pages.
    """
    require_writable(path, ".html")
    if not path.exists():
        return
    with path.open("rb") as file:
        begin = file.read(1000)
    ours = _GENERATOR in begin or _FORBIDS_SCRIPTS in begin
    if not ours or f"<title>{title}".encode() not in begin:
        titled = f" titled '{title} ...'" if title else ""
        raise OutputError(
            f"{path}: is no page of ugat_marl{titled}, and would be lost; move it, or give another "
            "place"
        )


@functools.cache
def _environment() -> Any:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("ugat_marl.reporting"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    colours: dict[str, Any] = {"light": css_variables(LIGHT), "dark": css_variables(DARK)}
    environment.globals.update(colours)
    return environment
