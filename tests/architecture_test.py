"""The table of levels in docs/architecture.md, and a few rules of the house, held against the code.

Every checker is a function of a source tree, so that each is also run on a small tree that breaks
its rule and must be caught.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "ugat_marl"
MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 60
UNPICKLERS = {"pickle", "cloudpickle", "dill", "shelve", "marshal", "joblib"}
# The simulator, and the yardstick it is measured against: libsumo without the suite, as a program
# of its own that nothing imports.
LIBSUMO_USERS = {"simulator", "bench.bare"}
# A SUMO that runs elsewhere, in place of the street.
TRACI_USERS = {"field.street"}
CHECKS: dict[str, Callable[[Tree], list[str]]] = {}


class Tree:
    """The parsed modules of a package and the levels its documentation gives them.

    Module names are relative to the package; the facade ``__init__`` is ``""``.
    """

    def __init__(self, sources: Mapping[str, str], levels: Mapping[str, int]) -> None:
        self.sources = dict(sources)
        self.levels = dict(levels)
        self.parsed = {name: ast.parse(source) for name, source in sources.items()}

    def level(self, module: str) -> int | None:
        """The level of a module: of its own row, or else of its package's."""
        while module and module not in self.levels:
            module = module.rpartition(".")[0]
        return self.levels.get(module)

    def imports(self, module: str) -> set[str]:
        """All absolute dotted names that a module imports, wherever in the file."""
        found: set[str] = set()
        for node in ast.walk(self.parsed[module]):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found |= {f"{node.module}.{alias.name}" for alias in node.names}
        return found

    def internal(self, module: str) -> set[str]:
        """The modules of the package that a module imports, the module itself excepted."""
        found: set[str] = set()
        for name in self.imports(module):
            parts = name.split(".")
            if parts[0] == PACKAGE:
                inner = parts[1:]
                while inner and ".".join(inner) not in self.parsed:
                    inner.pop()
                found.add(".".join(inner))
        return found - {module}


def package_tree(package: Path, levels: Mapping[str, int]) -> Tree:
    """Reads all modules below a directory; an ``__init__`` has its package's name."""
    sources: dict[str, str] = {}
    for path in sorted(package.rglob("*.py")):
        parts = list(path.relative_to(package).with_suffix("").parts)
        if parts[-1] == "__init__":
            parts.pop()
        sources[".".join(parts)] = path.read_text(encoding="utf-8")
    return Tree(sources, levels)


def documented_levels(text: str) -> dict[str, int]:
    """The rows ``| `module` | level | ... |`` of a Markdown table, modules without the package."""
    rows = re.findall(r"^\| `([\w.]+)` \| (\d+) \|", text, flags=re.MULTILINE)
    assert len(dict(rows)) == len(rows), "a module has two rows"
    return {module: int(level) for module, level in rows}


def check(function: Callable[[Tree], list[str]]) -> Callable[[Tree], list[str]]:
    """Marks a function as a check of this file."""
    CHECKS[function.__name__] = function
    return function


@check
def every_module_has_a_row(tree: Tree) -> list[str]:
    """Modules and rows of the table belong to each other."""
    missing = [
        f"{module}: no row in the table"
        for module in tree.parsed
        if module and tree.level(module) is None and not is_folder(module, tree)
    ]
    idle = [
        f"{row}: in the table, but there is no such module"
        for row in tree.levels
        if not any(module == row or module.startswith(f"{row}.") for module in tree.parsed)
    ]
    return missing + idle


@check
def imports_go_down(tree: Tree) -> list[str]:
    """Imports go to lower levels or stay in a package; the facade is for the command line."""
    found: list[str] = []
    for module in tree.parsed:
        for target in tree.internal(module):
            if not module or (module, target) == ("__main__", ""):
                continue
            own, other = tree.level(module), tree.level(target)
            siblings = module.split(".")[0] == target.split(".")[0]
            if not target:
                found.append(f"{module} imports the facade")
            elif siblings and own == other:
                continue
            elif own is not None and other is not None and other >= own:
                found.append(f"{module} (level {own}) imports {target} (level {other})")
    return found


@check
def imports_have_no_cycle(tree: Tree) -> list[str]:
    """No module reaches itself over imports."""
    found: list[str] = []
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        if module in path:
            found.append(" -> ".join([*path[path.index(module) :], module]))
        elif module not in done:
            for target in sorted(tree.internal(module)):
                visit(target, (*path, module))
            done.add(module)

    for module in sorted(tree.parsed):
        visit(module, ())
    return found


@check
def one_module_imports_libsumo(tree: Tree) -> list[str]:
    """Only the simulator talks to SUMO."""
    found: list[str] = []
    for name, allowed in (("libsumo", LIBSUMO_USERS), ("traci", TRACI_USERS)):
        users = {module for module in tree.parsed if name in roots(tree.imports(module))}
        found += [f"{module} imports {name}" for module in sorted(users - allowed)]
    imported = {target for module in tree.parsed for target in tree.internal(module)}
    return found + (["bench.bare is imported"] if "bench.bare" in imported else [])


@check
def nothing_is_unpickled(tree: Tree) -> list[str]:
    """No pickle in any dress but its exception; tensors are loaded as weights only."""
    found = [
        f"{module} imports {name}"
        for module in tree.parsed
        for name in sorted(tree.imports(module) - {"pickle.UnpicklingError"})
        if name.split(".")[0] in UNPICKLERS
    ]
    for module, call in calls(tree):
        name, options = ast.unparse(call.func), {k.arg: ast.unparse(k.value) for k in call.keywords}
        if name == "torch.load" and options.get("weights_only") != "True":
            found.append(f"{module}:{call.lineno} torch.load without weights_only=True")
        if options.get("allow_pickle") == "True":
            found.append(f"{module}:{call.lineno} allow_pickle=True")
    return found


@check
def importing_does_nothing(tree: Tree) -> list[str]:
    """Module level holds definitions only."""
    return [
        f"{module}:{statement.lineno} does something when imported"
        for module, parsed in tree.parsed.items()
        for statement in parsed.body
        if not is_definition(statement)
    ]


@check
def files_are_short(tree: Tree) -> list[str]:
    """At most 400 lines in a file."""
    counts = {module: len(source.splitlines()) for module, source in tree.sources.items()}
    return [f"{m or '__init__'} has {n} lines" for m, n in counts.items() if n > MAX_FILE_LINES]


@check
def functions_are_short(tree: Tree) -> list[str]:
    """At most 60 lines in a function, its docstring not counted."""
    found: list[str] = []
    for module, parsed in tree.parsed.items():
        for node in ast.walk(parsed):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                first = node.body[1] if ast.get_docstring(node) and node.body[1:] else node.body[0]
                lines = (node.end_lineno or 0) - first.lineno + 1
                if lines > MAX_FUNCTION_LINES:
                    found.append(f"{module}.{node.name} has {lines} lines")
    return found


def is_folder(module: str, tree: Tree) -> bool:
    """Whether a package only holds modules that have rows of their own."""
    return not tree.internal(module) and any(row.startswith(f"{module}.") for row in tree.levels)


def roots(names: set[str]) -> set[str]:
    """The top-level packages of dotted names."""
    return {name.split(".")[0] for name in names}


def calls(tree: Tree) -> Iterator[tuple[str, ast.Call]]:
    """All calls with the module they stand in."""
    for module, parsed in tree.parsed.items():
        for node in ast.walk(parsed):
            if isinstance(node, ast.Call):
                yield module, node


def is_definition(statement: ast.stmt) -> bool:
    """Whether a statement at module level only defines names."""
    match statement:
        case ast.Import() | ast.ImportFrom() | ast.FunctionDef() | ast.ClassDef():
            return True
        case ast.AsyncFunctionDef() | ast.AnnAssign(target=ast.Name()):
            return True
        case ast.Expr(value=ast.Constant()):  # docstrings, of attributes too
            return True
        case ast.Assign(targets=targets):
            return all(isinstance(target, ast.Name | ast.Tuple) for target in targets)
        case ast.If(test=test, body=body):
            if ast.unparse(test) == "__name__ == '__main__'":
                return True
            return ast.unparse(test).endswith("TYPE_CHECKING") and all(map(is_definition, body))
        case _:
            return False


@pytest.fixture(scope="module")
def suite() -> Tree:
    """The package of this checkout, whichever copy the other tests import."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    return package_tree(ROOT / PACKAGE, documented_levels(text))


@pytest.mark.parametrize("name", CHECKS)
def test_the_package_keeps_the_rule(name: str, suite: Tree) -> None:
    assert not CHECKS[name](suite)


LEVELS = {
    "low": 0,
    "high": 1,
    "simulator": 1,
    "pack": 1,
    "folder.deep": 0,
    "folder.top": 2,
    "bench": 3,
}
SOUND = {
    "": '"""Facade."""\nfrom ugat_marl.high import f\n',
    "low": "import torch\nx: int = 1\n\n\ndef load(p):\n    torch.load(p, weights_only=True)\n",
    "high": "from __future__ import annotations\nfrom ugat_marl.low import x\n"
    "from ugat_marl import low\nfrom pickle import UnpicklingError\n"
    "if TYPE_CHECKING:\n    import numpy\n\n\ndef f():\n    return x\n",
    "simulator": "import libsumo\n",
    "bench.bare": "import libsumo\n",
    "pack": "",
    "pack.one": "from ugat_marl.low import x\n",
    "pack.two": "from ugat_marl.pack.one import x\n",
    "folder": '"""Only a place."""\n',
    "folder.deep": "",
    "folder.top": "from ugat_marl.folder.deep import x\nfrom ugat_marl import high\n",
}
BROKEN: list[tuple[str, dict[str, str]]] = [
    ("every_module_has_a_row", {"stray": ""}),
    ("every_module_has_a_row", {"folder.new": ""}),
    ("every_module_has_a_row", {"folder": "from ugat_marl.high import f"}),
    ("imports_go_down", {"low": "from ugat_marl.high import f"}),
    ("imports_go_down", {"low": "def f():\n    import ugat_marl.high"}),
    ("imports_go_down", {"simulator": "from ugat_marl import high"}),
    ("imports_go_down", {"high": "import ugat_marl"}),
    ("imports_go_down", {"folder.deep": "from ugat_marl.folder.top import x"}),
    ("imports_go_down", {"pack.two": "from ugat_marl.high import f"}),
    ("imports_have_no_cycle", {"pack.one": "from ugat_marl.pack import two"}),
    ("one_module_imports_libsumo", {"high": "def f():\n    from libsumo import lane"}),
    ("one_module_imports_libsumo", {"high": "import traci.constants"}),
    ("one_module_imports_libsumo", {"simulator": "import traci"}),
    ("one_module_imports_libsumo", {"folder.top": "from ugat_marl.bench import bare"}),
    ("nothing_is_unpickled", {"low": "from pickle import loads"}),
    ("nothing_is_unpickled", {"low": "import pickle"}),
    ("nothing_is_unpickled", {"low": "def f(p):\n    return torch.load(p)"}),
    ("nothing_is_unpickled", {"low": "def f(p):\n    return torch.load(p, weights_only=False)"}),
    ("nothing_is_unpickled", {"low": "def f(p):\n    return np.load(p, allow_pickle=True)"}),
    ("importing_does_nothing", {"low": "print(1)"}),
    ("importing_does_nothing", {"low": "os.environ['A'] = '1'"}),
    ("importing_does_nothing", {"low": "for x in y:\n    pass"}),
    ("importing_does_nothing", {"low": "if TYPE_CHECKING:\n    f()"}),
    ("files_are_short", {"low": "x = 1\n" * 401}),
    ("functions_are_short", {"low": "def f():\n    '''D.'''\n" + "    x = 1\n" * 61}),
]


@pytest.mark.parametrize("name", CHECKS)
def test_a_sound_tree_passes(name: str) -> None:
    assert not CHECKS[name](Tree(SOUND, LEVELS))


@pytest.mark.parametrize(("name", "change"), BROKEN)
def test_a_broken_tree_is_caught(name: str, change: dict[str, str]) -> None:
    assert CHECKS[name](Tree({**SOUND, **change}, LEVELS))


def test_a_row_without_a_module_is_caught() -> None:
    assert every_module_has_a_row(Tree(SOUND, {**LEVELS, "gone": 2}))


def test_every_check_has_a_broken_tree() -> None:
    assert {name for name, _ in BROKEN} == set(CHECKS)


def test_the_table_is_read_from_markdown() -> None:
    text = "| Module | Level | x |\n|---|---|---|\n| `a` | 0 | one |\n| `b.c` | 12 | two |\n"
    assert documented_levels(text) == {"a": 0, "b.c": 12}
