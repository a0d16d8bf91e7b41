"""The README says what is there: its example runs, its tables are complete, its links work."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import ugat_marl
from tests.docs.links import broken_links

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "scenarios/README.md")),
    *(path for folder in ("docs", "results") for path in sorted((ROOT / folder).rglob("*.md"))),
]


def names(requirements: list[str]) -> set[str]:
    """The packages that requirements name, in lower case with hyphens."""
    return {re.split(r"[<>=\[; ]", text)[0].lower().replace("_", "-") for text in requirements}


def test_the_example_runs() -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    command = [sys.executable, "-c", example]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "att_s" in done.stdout


def test_badges_say_what_the_package_says() -> None:
    badges = dict(re.findall(r"!\[(\w+): ([^]]+)\]\(docs/images/badge-", README))
    least = PROJECT["requires-python"].removeprefix(">=")
    assert badges == {
        "version": ugat_marl.__version__,
        "python": f"{least} or newer",
        "licence": PROJECT["license"],
    }
    for name, text in badges.items():
        picture = (ROOT / "docs" / "images" / f"badge-{name}.svg").read_text(encoding="utf-8")
        assert re.findall(r"<text[^>]*>([^<]+)<", picture) == [name, text]


def test_every_dependency_is_explained() -> None:
    table = (ROOT / "docs" / "reference" / "dependencies.md").read_text(encoding="utf-8")
    explained = set(re.findall(r"^\| ([\w-]+) \|", table, flags=re.MULTILINE)) - {
        "package",
        "extra",
    }
    assert explained == names(PROJECT["dependencies"])


def test_every_scenario_is_listed() -> None:
    table = (ROOT / "scenarios" / "README.md").read_text(encoding="utf-8")
    shipped = {path.parent.name for path in ROOT.glob("scenarios/*/scenario.toml")}
    assert set(re.findall(r"\[([\w]+-v\d+)\]", table)) == shipped


def test_the_readme_fits_a_screen_or_three() -> None:
    assert len(README.splitlines()) <= 110


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    assert broken_links(page.read_text(encoding="utf-8"), page) == []


@pytest.mark.parametrize(
    ("link", "broken"),
    [
        ("other.md#two-words", False),
        ("other.md#two-words-1", False),
        ("other.md#with---an-option-1", False),
        ("#here", False),
        ("https://example.org/gone.md#a", False),
        ("gone.md", True),
        ("gone.md#a", True),
        ("other.md#gone", True),
        ("other.md#a-remark", True),
        ("#two-words", True),
    ],
)
def test_a_link_that_leads_nowhere_is_found(link: str, broken: bool, tmp_path: Path) -> None:
    other = "# Two words\n\n```sh\n# a remark\n```\n\n## Two words\n\n### With `--an` option: 1\n"
    (tmp_path / "other.md").write_text(other)
    page = tmp_path / "page.md"
    page.write_text(f"# Here\n\n[x]({link})\n")
    assert broken_links(page.read_text(), page) == [link] * broken


@pytest.mark.parametrize("file", ["constraints.txt", "constraints-oldest.txt"])
def test_constraints_pin_every_dependency_without_local_builds(file: str) -> None:
    lines = [line for line in (ROOT / file).read_text().splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in lines)
    assert names(PROJECT["dependencies"]) <= names(lines)
    assert "torch==2.13.0" in lines
