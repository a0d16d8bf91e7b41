"""Contents of the wheel and the source archive, of the installed package and of the image."""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest

import ugat_marl
from tests.docs.readme_test import names as packages_in

PACKAGE = Path(ugat_marl.__file__).parent
CHECKOUT = Path(__file__).resolve().parent.parent
BASELINES = sorted(CHECKOUT.glob("baselines/*.py"))
SCENARIOS = sorted(path.parent for path in CHECKOUT.glob("scenarios/*/scenario.toml"))
SCENARIO_FILES = ("scenario.toml", "README.md", "*.xml")
"""Names of a scenario's files that a wheel carries, as patterns."""

installed = pytest.mark.skipif(
    not PACKAGE.is_relative_to(sysconfig.get_paths()["purelib"]),
    reason="the package is imported from a source tree; `make test` installs the wheel",
)


def files_of(folder: Path) -> list[Path]:
    return [p for p in folder.rglob("*") if p.is_file() and "__pycache__" not in p.parts]


def carried() -> dict[str, Path]:
    """Every file that the wheel has to carry: its name there, and its place in the checkout."""
    package = {str(p.relative_to(CHECKOUT)): p for p in files_of(CHECKOUT / "ugat_marl")}
    scenarios = {
        f"ugat_marl/_scenarios/{folder.name}/{path.name}": path
        for folder in SCENARIOS
        for pattern in SCENARIO_FILES
        for path in folder.glob(pattern)
    }
    baselines = {f"ugat_marl/_baselines/{path.name}": path for path in BASELINES}
    return {**package, **scenarios, **baselines}


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel and the source archive of this checkout."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(folder)]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_the_wheel_holds_what_the_package_reads_and_nothing_else(archives: Path) -> None:
    with zipfile.ZipFile(next(archives.glob("*.whl"))) as wheel:
        names = {name for name in wheel.namelist() if ".dist-info/" not in name}
        assert names == {*carried()}
        for name, path in carried().items():
            assert wheel.read(name) == path.read_bytes(), name
    kinds = {Path(name).suffix for name in names} | {Path(name).name for name in names}
    assert {".pyi", "py.typed", ".j2", ".css", ".toml", ".xml"} <= kinds
    assert sum(Path(name).name == "scenario.toml" for name in names) == len(SCENARIOS) >= 5


def test_the_source_archive_holds_the_package_its_tests_and_what_they_read(archives: Path) -> None:
    with tarfile.open(next(archives.glob("*.tar.gz"))) as source:
        names = {name.partition("/")[2] for name in source.getnames()}
    assert {str(path.relative_to(CHECKOUT)) for path in carried().values()} <= names
    assert {"pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "constraints.txt"} <= names
    assert "tests/packaging_test.py" in names
    assert {".ci/environment.py", ".ci/words.py", ".ci/package.py", ".ci/site.py"} <= names
    assert not [name for name in names if name.startswith((".venv", ".git/", "runs/", ".cache"))]


def test_what_is_tried_after_an_installation_is_what_its_extras_bring() -> None:
    """Else a fresh environment counts as damaged and is installed twice."""
    file = CHECKOUT / ".ci" / "environment.py"
    spec = importlib.util.spec_from_file_location("environment", file)
    assert spec is not None and spec.loader is not None
    environment: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(environment)
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    probes = {"": environment.PROBE, **environment.PROBES}
    assert {"dev", "osm"} <= set(probes) <= {"", *extras}
    packages = importlib.metadata.packages_distributions()
    for extra, probe in probes.items():
        brought = extras[extra] if extra else [project["name"], *project["dependencies"]]
        for imported in ast.walk(ast.parse(probe)):
            if isinstance(imported, ast.alias) and imported.name in packages:
                found = packages_in(packages[imported.name])
                assert found & packages_in(brought), (extra, imported.name)


def test_the_image_is_made_of_what_is_there() -> None:
    text = (CHECKOUT / "Containerfile").read_text(encoding="utf-8")
    copied = re.findall(r"^COPY (?!--from)(\S+) ", text, flags=re.MULTILINE)
    assert copied and all((CHECKOUT / name).exists() for name in copied)
    versions = set(re.findall(r"^FROM \S+/python:3\.(\d+)-slim", text, flags=re.MULTILINE))
    assert len(versions) == 1 and int(versions.pop()) >= 11
    left_out = (CHECKOUT / ".dockerignore").read_text(encoding="utf-8").split()
    assert not {"ugat_marl", "scenarios", "baselines", "pyproject.toml", "README.md"} & {*left_out}
    (entry,) = re.findall(r'^ENTRYPOINT \["([\w-]+)"\]', text, flags=re.MULTILINE)
    assert f"\n{entry} = " in (CHECKOUT / "pyproject.toml").read_text(encoding="utf-8")


def test_the_changes_speak_of_this_version() -> None:
    text = (CHECKOUT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(rf"^## {re.escape(ugat_marl.__version__)}\b", text, flags=re.MULTILINE)
    cited = (CHECKOUT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {ugat_marl.__version__}\n" in cited


@installed
def test_the_version_is_the_wheels() -> None:
    assert importlib.metadata.version("ugat-marl") == ugat_marl.__version__


@installed
def test_the_installed_package_is_that_of_the_checkout() -> None:
    for name, path in carried().items():
        assert (PACKAGE.parent / name).read_bytes() == path.read_bytes(), name


@installed
def test_other_processes_import_the_wheel_too() -> None:
    command = [sys.executable, "-c", "import ugat_marl; print(ugat_marl.__file__)"]
    printed = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=True)
    assert Path(printed.stdout.strip()).parent == PACKAGE


def test_importing_is_cheap() -> None:
    code = (
        "import sys, ugat_marl; "
        "sys.exit(bool({'torch', 'libsumo', 'matplotlib', 'gymnasium'} & {*sys.modules}))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("verb", ["scenario_check", "diagnose", "evaluate", "plan", "record"])
def test_who_trains_nothing_waits_for_no_torch(verb: str) -> None:
    code = f"import sys, ugat_marl.cli.{verb}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_all_that_the_rooms_offer_is_there_without_the_extras() -> None:
    extras = ["stable_baselines3", "sb3_contrib", "torchrl", "skrl", "benchmarl", "ray", "onnx"]
    extras += ["osmium", "imageio_ffmpeg", "atspm", "sumo_rl"]
    rooms = sorted(x.parent.name for x in PACKAGE.glob("*/__init__.py"))
    lines = [
        f"import sys; sys.modules |= dict.fromkeys({extras})",
        *(f"from ugat_marl.{room} import *" for room in rooms if not room.startswith("_")),
    ]
    command = [sys.executable, "-c", "\n".join(lines)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
