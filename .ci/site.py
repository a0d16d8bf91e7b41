"""Build the documentation site from the pages of the repository, strictly.

Run by `make docs`: ``python .ci/site.py``. The pages are staged in ``.cache/site/pages``, in the
tree they have in the repository, so that a link that works on a code host works in the site too.
A page of reference is written for each room, with all that its ``__init__.pyi`` exports. Broken
links and names that cannot be resolved fail the build. A notebook becomes a page with its outputs.
"""

from __future__ import annotations

import ast
import base64
import json
import os
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGES = ROOT / ".cache" / "site" / "pages"
VENV = ROOT / ".venv-docs"
CONSTRAINTS = ROOT / "constraints-docs.txt"
PACKAGE = ROOT / "ugat_marl"
SOURCES = (
    "*.md",
    "LICENSE",
    "CITATION.cff",
    "constraints*.txt",
    "docs/**/*",
    "results/**/*",
    "scenarios/**/*",
    "baselines/*",
    ".ci/run",
)


def stage() -> None:
    """Copy the pages and what they link to, and write the pages of reference."""
    shutil.rmtree(PAGES, ignore_errors=True)
    for pattern in SOURCES:
        for path in sorted(ROOT.glob(pattern)):
            if path.is_file() and "__pycache__" not in path.parts:
                target = PAGES / path.relative_to(ROOT)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, target)
    for book in sorted(PAGES.glob("docs/notebooks/*.ipynb")):
        book.with_suffix(".md").write_text(notebook(book))
    for page in PAGES.rglob("*.md"):
        text = page.read_text()
        if "](" in text and ".ipynb)" in text:
            page.write_text(re.sub(r"(\]\([^()\s]*)\.ipynb\)", r"\1.md)", text))
    folder = PAGES / "docs" / "reference" / "python"
    folder.mkdir(parents=True)
    told: set[str] = set()
    for stub in sorted(PACKAGE.glob("*/__init__.pyi")):
        name = stub.parent.name
        (folder / f"{name}.md").write_text(reference(f"ugat_marl.{name}", stub, told))
    (folder / "ugat_marl.md").write_text(reference("ugat_marl", PACKAGE / "__init__.pyi", told))


def notebook(book: Path) -> str:
    """Return the page of a notebook, and write its pictures beside it.

    Texts, code and outputs are all that ours hold, and the page loads nothing from elsewhere.
    """
    name = f"docs/notebooks/{book.name}"
    parts: list[str] = []
    for number, cell in enumerate(json.loads(book.read_text())["cells"]):
        source = "".join(cell["source"]).strip()
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for place, output in enumerate(cell["outputs"]):
            data = output.get("data", {})
            if "image/png" in data:
                picture = book.with_name(f"{book.stem}-{number}-{place}.png")
                picture.write_bytes(base64.b64decode("".join(data["image/png"])))
                parts.append(f"![Output of the code above]({picture.name})")
            else:
                text = "".join(output.get("text", data.get("text/plain", ""))).strip("\n")
                text = re.sub(r"\x1b\[[\d;]*m", "", text)  # colours of a terminal
                parts.append(f"```text\n{text}\n```")
    title, _, rest = "\n\n".join(parts).partition("\n\n")
    hint = f"*This page is the notebook `{name}` of the repository, with what it showed.*"
    return f"{title}\n\n{hint}\n\n{rest}\n"


def reference(module: str, stub: Path, told: set[str]) -> str:
    """Return the page of a module: its docstring, then every name that its stub exports.

    Args:
        module: The module.
        stub: Its stub.
        told: Names on the pages before, to which those of this page are added. Links to such a name
            lead there.
    """
    docstring = ast.get_docstring(ast.parse(stub.with_suffix(".py").read_text())) or ""
    title = f"# `{module}`\n\n{re.sub(r'``', '`', docstring)}\n"
    homes = [(home(f"{module}.{source}", name), name) for source, name in exports(stub)]
    names = [f"{place}.{name}" for place, name in homes if not unpacked(place, name)]
    again = "    options:\n      skip_local_inventory: true\n"
    blocks = [f"\n::: {name}\n{again if name in told else ''}" for name in names]
    told.update(names)
    values = [f"`{name}`" for place, name in homes if unpacked(place, name)]
    more = f"\nValues: {', '.join(values)}.\n" if values else ""
    return title + "".join(blocks) + more


def exports(stub: Path) -> list[tuple[str, str]]:
    """Return the modules and names that a stub exports, classes before functions before values."""
    found = [
        (node.module or "", alias.name)
        for node in ast.parse(stub.read_text()).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if node.module  # a submodule as a whole has names of its own
    ]
    return sorted(set(found), key=lambda pair: (not pair[1][:1].isupper(), pair[1].lower()))


def unpacked(module: str, name: str) -> bool:
    """Return whether a name comes from the unpacking of a tuple, which griffe does not follow."""
    file = ROOT.joinpath(*module.split(".")).with_suffix(".py")
    return any(
        isinstance(target, ast.Tuple) and name in {ast.unparse(item) for item in target.elts}
        for node in ast.parse(file.read_text()).body
        if isinstance(node, ast.Assign)
        for target in node.targets
    )


def home(module: str, name: str) -> str:
    """Return the module that defines a name, followed over imports and stubs."""
    folder = ROOT.joinpath(*module.split("."))
    stub = folder / "__init__.pyi"  # a folder beside a module of its name holds data alone
    file = stub if stub.is_file() else folder.with_suffix(".py")
    for node in ast.parse(file.read_text()).body:
        if (
            isinstance(node, ast.ImportFrom)
            and node.module
            and name in {alias.asname or alias.name for alias in node.names}
        ):
            return home(f"{module}.{node.module}" if node.level else node.module, name)
    return module


def environment() -> Path:
    """Return the interpreter of an environment with MkDocs, made where there is none."""
    python = VENV / "bin" / "python"
    if not python.exists():
        venv.create(VENV, with_pip=True, clear=True)
    install = [str(python), "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    wanted = ["mkdocs-material", "mkdocstrings-python", "ruff"]
    subprocess.run([*install, "-c", str(CONSTRAINTS), *wanted], check=True)
    return python


def main() -> int:
    """Stage, build, and return MkDocs' exit code; its output is shown if it fails."""
    python = environment()
    stage()
    # not -q: MkDocs then hears no warnings, and --strict counts those that it hears
    build = [str(python), "-m", "mkdocs", "build", "--strict"]
    variables = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    joined = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    done = subprocess.run(build, cwd=ROOT, env=variables, text=True, check=False, **joined)
    if done.returncode == 0:
        print("the site is in .cache/site/html/index.html")
    else:
        print(done.stdout, file=sys.stderr)
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
