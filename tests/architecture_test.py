"""The rooms in docs/explanation/architecture.md and rules of the house, held to the code.

Every checker is a function of a source tree, so that each is also run on a small tree that breaks
its rule and must be caught.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "ugat_marl"
TOP = ""
"""The room of the ground stones, the modules at the top of the package."""
MAX_STONES = 5
MAX_FUNCTION_LINES = 60
REGISTRATION = "register_single()"
"""The one act of an import: ``gymnasium.make("module:name")`` imports a module that registers."""
GYMNASIUM_LOADED = "'gymnasium' in sys.modules"
UNPICKLERS = {"pickle", "cloudpickle", "dill", "shelve", "marshal", "joblib"}
# `traci` is for a SUMO that runs elsewhere, in place of the street.
ENGINES = {"libsumo": "simulation", "traci": "field"}
CHECKS: dict[str, Callable[[Tree], list[str]]] = {}


class Tree:
    """The parsed modules of a package, and its rooms from the ground up.

    Module names are relative to the package; the facade ``__init__`` is ``""``. A stub
    ``room/__init__.pyi`` has the name ``room.__init__`` and says what the room exports.
    """

    def __init__(self, sources: Mapping[str, str], rooms: Sequence[str]) -> None:
        self.rooms = [TOP, *rooms]
        stubs = {name: text for name, text in sources.items() if name.endswith(".__init__")}
        self.parsed = {name: ast.parse(t) for name, t in sources.items() if name not in stubs}
        self.exports = {
            name.removesuffix(".__init__"): {
                alias.asname or alias.name
                for node in ast.walk(ast.parse(text))
                if isinstance(node, ast.ImportFrom)
                for alias in node.names
            }
            for name, text in stubs.items()
        }

    def room(self, module: str) -> str:
        """The room a module stands in."""
        first = module.split(".")[0]
        return first if any(name.startswith(f"{first}.") for name in self.parsed) else TOP

    def imports(self, module: str) -> Iterator[tuple[str, str]]:
        """Every import of a module, wherever in the file: from what, and which name (or "")."""
        for node in ast.walk(self.parsed[module]):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    yield alias.name, ""
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                for alias in node.names:
                    yield node.module, alias.name

    def internal(self, module: str) -> Iterator[tuple[str, str]]:
        """The imports from the package: the module imported from, relative to it, and the name."""
        for source, name in self.imports(module):
            parts = source.split(".")
            if parts[0] == PACKAGE:
                inner = ".".join(parts[1:])
                whole = f"{inner}.{name}".strip(".")
                yield (whole, "") if whole in self.parsed else (inner, name)


def package_tree(package: Path, rooms: Sequence[str]) -> Tree:
    """Reads all modules below a directory; an ``__init__`` has its package's name."""
    sources: dict[str, str] = {}
    for path in sorted(package.rglob("*.py*")):
        if path.suffix not in (".py", ".pyi"):
            continue
        parts = list(path.relative_to(package).with_suffix("").parts)
        if parts[-1] == "__init__" and path.suffix == ".py":
            parts.pop()
        sources[".".join(parts)] = path.read_text(encoding="utf-8")
    sources.pop("__init__", None)  # the stub of the facade
    return Tree(sources, rooms)


def documented_rooms(text: str) -> list[str]:
    """The rooms in the rows ``| `room/` | ... |`` of a Markdown table, from the ground up."""
    rooms = re.findall(r"^\| `(\w+)/` \|", text, flags=re.MULTILINE)
    assert len(set(rooms)) == len(rooms), "a room has two rows"
    return rooms


def check(function: Callable[[Tree], list[str]]) -> Callable[[Tree], list[str]]:
    """Marks a function as a check of this file."""
    CHECKS[function.__name__] = function
    return function


@check
def every_room_has_a_row(tree: Tree) -> list[str]:
    """Rooms and rows of the table belong to each other."""
    there = {tree.room(module) for module in tree.parsed} - {TOP}
    rows = set(tree.rooms) - {TOP}
    return [f"{room}: no row in the table" for room in sorted(there - rows)] + [
        f"{room}: in the table, but there is no such room" for room in sorted(rows - there)
    ]


@check
def imports_are_absolute(tree: Tree) -> list[str]:
    """No module imports by dots: the checks below read absolute names."""
    return [
        f"{module}:{node.lineno} imports by dots"
        for module, parsed in tree.parsed.items()
        for node in ast.walk(parsed)
        if isinstance(node, ast.ImportFrom) and node.level
    ]


@check
def few_stones_lie_at_the_top(tree: Tree) -> list[str]:
    """At most five modules stand at the top, beside the facade and the command line."""
    stones = sorted(m for m in tree.parsed if m not in ("", "__main__") and not tree.room(m))
    return [f"modules at the top: {', '.join(stones)}"] if len(stones) > MAX_STONES else []


@check
def imports_go_down(tree: Tree) -> list[str]:
    """A room imports only from rooms above it in the table; nothing imports the facade."""
    found: list[str] = []
    for module in tree.parsed:
        if module in ("", "__main__"):
            continue
        own = tree.room(module)
        for source, name in tree.internal(module):
            other = tree.room(source)
            if not source and name != "__version__":
                found.append(f"{module} imports {name or 'all'} from the facade")
            elif {own, other} <= set(tree.rooms) and (
                tree.rooms.index(other) > tree.rooms.index(own)
            ):
                found.append(f"{module} imports {source}: {other} stands after {own or 'it'}")
    return found


@check
def rooms_are_entered_by_the_door(tree: Tree) -> list[str]:
    """From another room come only the names that its stub exports."""
    found: list[str] = []
    for module in tree.parsed:
        for source, name in tree.internal(module):
            room = tree.room(source)
            if room == TOP or room == tree.room(module):
                continue
            if source != room and source != f"{room}.{name}":
                inner = source.removeprefix(f"{room}.")
                if name or inner not in tree.exports.get(room, ()):
                    found.append(f"{module} imports {source}, not from {room}")
            elif source == room and name not in tree.exports.get(room, ()):
                found.append(f"{module} imports {name}, which {room} does not export")
    return found


@check
def private_names_stay_in_their_room(tree: Tree) -> list[str]:
    """No room imports or exports a name that begins with an underscore."""
    taken = [
        f"{module} imports {name} from {source}"
        for module in tree.parsed
        for source, name in tree.internal(module)
        if name.startswith("_") and name != "__version__"
        if tree.room(source) != tree.room(module)
    ]
    return taken + [
        f"{room} exports {name}"
        for room, names in tree.exports.items()
        for name in sorted(names)
        if name.startswith("_")
    ]


@check
def imports_have_no_cycle(tree: Tree) -> list[str]:
    """No module reaches itself over imports within its room."""
    found: list[str] = []
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        if module in path:
            found.append(" -> ".join([*path[path.index(module) :], module]))
        elif module not in done:
            for target in sorted({source for source, _ in tree.internal(module)} - {module}):
                if target in tree.parsed:
                    visit(target, (*path, module))
            done.add(module)

    for module in sorted(tree.parsed):
        visit(module, ())
    return found


@check
def engines_have_one_room(tree: Tree) -> list[str]:
    """Only one room talks to SUMO, and only one to a SUMO that runs elsewhere."""
    return [
        f"{module} imports {engine}"
        for engine, room in ENGINES.items()
        for module in tree.parsed
        if tree.room(module) != room
        if any(source.split(".")[0] == engine for source, _ in tree.imports(module))
    ]


@check
def nothing_is_unpickled(tree: Tree) -> list[str]:
    """No pickle in any dress but its exception; tensors are loaded as weights only."""
    found = [
        f"{module} imports {source}"
        for module in tree.parsed
        for source, name in tree.imports(module)
        if source.split(".")[0] in UNPICKLERS and name != "UnpicklingError"
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
    """Module level holds definitions only, and the names that Gymnasium learns by an import."""
    return [
        f"{module}:{statement.lineno} does something when imported"
        for module, parsed in tree.parsed.items()
        for statement in parsed.body
        if not is_definition(statement)
    ]


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
        case ast.Expr():
            return ast.unparse(statement) == REGISTRATION
        case ast.Assign(targets=targets):
            return all(isinstance(target, ast.Name | ast.Tuple) for target in targets)
        case ast.If(test=test, body=body):
            if ast.unparse(test) == "__name__ == '__main__'":
                return True
            names = ast.unparse(test)
            only_names = names.endswith("TYPE_CHECKING") or names == GYMNASIUM_LOADED
            return only_names and all(map(is_definition, body))
        case _:
            return False


@pytest.fixture(scope="module")
def suite() -> Tree:
    """The package of this checkout, whichever copy the other tests import."""
    text = (ROOT / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8")
    return package_tree(ROOT / PACKAGE, documented_rooms(text))


@pytest.mark.parametrize("name", CHECKS)
def test_the_package_keeps_the_rule(name: str, suite: Tree) -> None:
    assert not CHECKS[name](suite)


def test_the_tests_have_the_same_rooms(suite: Tree) -> None:
    folders = {path.parent for path in (ROOT / "tests").rglob("*_test.py")}
    names = {folder.relative_to(ROOT / "tests").parts[0] for folder in folders - {ROOT / "tests"}}
    assert names <= {*suite.rooms, "docs", "nightly", "studies"}


ROOMS = ["lower", "upper", "simulation"]
SOUND = {
    "": '"""Facade."""\nfrom ugat_marl.upper import f\n',
    "__main__": "from ugat_marl.upper import f\n",
    "stone": "import torch\nx: int = 1\n\n\ndef load(p):\n    torch.load(p, weights_only=True)\n",
    "lower": '"""Room."""\n__getattr__ = 1\n',
    "lower.__init__": "from .one import a as a\nfrom . import two as two\n",
    "lower.one": "from ugat_marl.stone import x\n\n\ndef a():\n    return x\n\n\n_b = 1\n",
    "lower.two": "from ugat_marl.lower.one import _b, a\n",
    "upper": '"""Room."""\n',
    "upper.__init__": "from .deep.f import f as f\n",
    "upper.deep": "",
    "upper.deep.f": "from ugat_marl.lower import a, two\nfrom pickle import UnpicklingError\n"
    "if TYPE_CHECKING:\n    import numpy\n\n\ndef f():\n    from ugat_marl import __version__\n",
    "simulation": '"""Room."""\n',
    "simulation.engine": "import libsumo\n",
}
BROKEN: list[tuple[str, dict[str, str]]] = [
    ("every_room_has_a_row", {"stray": "", "stray.one": ""}),
    ("few_stones_lie_at_the_top", {f"stone{i}": "" for i in range(MAX_STONES)}),
    ("imports_are_absolute", {"lower.one": "from ..upper import f"}),
    ("imports_go_down", {"lower.one": "from ugat_marl.upper import f"}),
    ("imports_go_down", {"lower.one": "def f():\n    import ugat_marl.upper"}),
    ("imports_go_down", {"stone": "from ugat_marl.lower import a"}),
    ("imports_go_down", {"upper.deep.f": "import ugat_marl"}),
    ("imports_go_down", {"upper.deep.f": "from ugat_marl import parallel_env"}),
    ("rooms_are_entered_by_the_door", {"upper.deep.f": "from ugat_marl.lower.one import a"}),
    ("rooms_are_entered_by_the_door", {"upper.deep.f": "import ugat_marl.lower.one"}),
    ("rooms_are_entered_by_the_door", {"upper.deep.f": "from ugat_marl.lower import c"}),
    ("rooms_are_entered_by_the_door", {"upper.deep.f": "from ugat_marl.lower import one"}),
    ("rooms_are_entered_by_the_door", {"__main__": "from ugat_marl.upper.deep.f import f"}),
    ("private_names_stay_in_their_room", {"upper.deep.f": "from ugat_marl.lower.one import _b"}),
    ("private_names_stay_in_their_room", {"upper.deep.f": "from ugat_marl.stone import _x"}),
    ("private_names_stay_in_their_room", {"lower.__init__": "from .one import _b as _b"}),
    ("imports_have_no_cycle", {"lower.one": "from ugat_marl.lower import two"}),
    ("engines_have_one_room", {"upper.deep.f": "def f():\n    from libsumo import lane"}),
    ("engines_have_one_room", {"simulation.engine": "import traci.constants"}),
    ("nothing_is_unpickled", {"stone": "from pickle import loads"}),
    ("nothing_is_unpickled", {"stone": "import pickle"}),
    ("nothing_is_unpickled", {"stone": "def f(p):\n    return torch.load(p)"}),
    ("nothing_is_unpickled", {"stone": "def f(p):\n    return torch.load(p, weights_only=False)"}),
    ("nothing_is_unpickled", {"stone": "def f(p):\n    return np.load(p, allow_pickle=True)"}),
    ("importing_does_nothing", {"stone": "print(1)"}),
    ("importing_does_nothing", {"stone": "os.environ['A'] = '1'"}),
    ("importing_does_nothing", {"stone": "for x in y:\n    pass"}),
    ("importing_does_nothing", {"stone": "if TYPE_CHECKING:\n    f()"}),
    ("importing_does_nothing", {"stone": "if 'gymnasium' in sys.modules:\n    f()"}),
    ("functions_are_short", {"stone": "def f():\n    '''D.'''\n" + "    x = 1\n" * 61}),
]


@pytest.mark.parametrize("name", CHECKS)
def test_a_sound_tree_passes(name: str) -> None:
    assert not CHECKS[name](Tree(SOUND, ROOMS))


@pytest.mark.parametrize(("name", "change"), BROKEN)
def test_a_broken_tree_is_caught(name: str, change: dict[str, str]) -> None:
    assert CHECKS[name](Tree({**SOUND, **change}, ROOMS))


def test_a_row_without_a_room_is_caught() -> None:
    assert every_room_has_a_row(Tree(SOUND, [*ROOMS, "gone"]))


def test_every_check_has_a_broken_tree() -> None:
    assert {name for name, _ in BROKEN} == set(CHECKS)


def test_the_rooms_are_read_from_markdown() -> None:
    text = "| Room | holds |\n|---|---|\n| (top) | x |\n| `a/` | one |\n| `b/` | two |\n"
    assert documented_rooms(text) == ["a", "b"]
