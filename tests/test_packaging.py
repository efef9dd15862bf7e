"""What is installed is what lies in the folders, every module imports, and imports follow the arrows of the design.

The tests that read pyproject.toml beside the folders are skipped where the suite runs outside a checkout; the others
read the package that is installed, an editable checkout or a wheel.
"""

import ast
import importlib
import pkgutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
in_checkout = pytest.mark.skipif(
    not all((CHECKOUT / name).exists() for name in ("pyproject.toml", "unitouch_gen", "pipelines", "training")),
    reason="reads pyproject.toml beside the package's folders, and there is no checkout here",
)

# Installed under another name than their folder's.
MAPPED = {"pipelines": "unitouch_gen.pipelines", "training": "unitouch_gen.training"}

# "Arrows go one way": what the modules of each room may import besides their own room and the ground.
GROUND = {"errors", "files"}
ARROWS = {
    **{room: set() for room in GROUND},
    "world": set(),
    "weights": set(),
    "hub": set(),
    "checkpoints": set(),
    "encoders": {"checkpoints", "hub"},
    "diffusion": {"checkpoints"},
    "numerics": {"diffusion", "world"},
    "pipelines": {"diffusion", "encoders", "hub", "weights"},
    "training": {"diffusion", "encoders", "world"},
    "evaluation": {"diffusion", "encoders", "world"},
}
TOP_FLOOR = {"__init__", "__main__", "bench", "cli"}  # may import any room, and no room imports them

MAX_LINES = 400


@cache
def modules() -> dict[str, Path]:
    """The dotted name and file of every module that is installed.

    The two mapped packages are walked by name: in an editable install they do not lie below `unitouch_gen`.
    """
    found = {}
    for package in ("unitouch_gen", *MAPPED.values()):
        imported = importlib.import_module(package)
        found[package] = Path(imported.__file__)
        for info in pkgutil.walk_packages(imported.__path__, f"{package}."):
            if not info.ispkg:
                found[info.name] = Path(info.module_finder.path) / f"{info.name.rpartition('.')[2]}.py"
            else:
                found[info.name] = Path(info.module_finder.path) / info.name.rpartition(".")[2] / "__init__.py"
    return found


def imports(name: str) -> Iterator[tuple[str, int, bool]]:
    """(target, line, at import time) of each module of ours that the module `name` imports, lazily or not."""
    tree = ast.parse(modules()[name].read_text(encoding="utf-8"))
    package = name if modules()[name].name == "__init__.py" else name.rpartition(".")[0]
    lazy = {id(inner) for outer in ast.walk(tree) if is_deferred(outer) for inner in ast.walk(outer)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.rsplit(".", node.level - 1)[0] + "." if node.level else ""
            source = f"{above}{node.module or ''}".rstrip(".")
            # `from package import module` imports the module; `from module import name`, the module it comes from.
            members = [f"{source}.{alias.name}" for alias in node.names]
            targets = [member if member in modules() else source for member in members]
        else:
            continue
        for target in sorted(set(targets)):
            if target.split(".")[0] in {"unitouch_gen", *MAPPED}:
                yield target, node.lineno, id(node) not in lazy


def is_deferred(node: ast.AST) -> bool:
    """Whether what stands in `node` does not run on import: a function, or a block for type checkers."""
    if isinstance(node, ast.If):
        return ast.unparse(node.test).endswith("TYPE_CHECKING")
    return isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)


def room_of(module: str) -> str:
    """`unitouch_gen.encoders.vit` -> `encoders`, `unitouch_gen.cli` -> `cli`, `unitouch_gen` -> `__init__`."""
    return module.split(".")[1] if "." in module else "__init__"


@cache
def settings() -> dict:
    return tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]


def package_folders() -> dict[str, Path]:
    """The package that each folder with an `__init__.py` is installed as."""
    folders = {}
    for top in ("unitouch_gen", *MAPPED):
        for file in (CHECKOUT / top).rglob("__init__.py"):
            inner = file.parent.relative_to(CHECKOUT / top).parts
            folders[".".join((MAPPED.get(top, top), *inner))] = file.parent
    return folders


@in_checkout
def test_packages_listed_are_the_folders():
    listed = settings()["packages"]
    assert sorted(listed) == sorted(set(listed)), "a package is listed twice"
    assert sorted(listed) == sorted(package_folders()), "update `packages` under [tool.setuptools] in pyproject.toml"


@in_checkout
def test_mapped_folders():
    assert settings()["package-dir"] == {"unitouch_gen": "unitouch_gen"} | {name: top for top, name in MAPPED.items()}


@in_checkout
def test_every_folder_with_code_is_a_package():
    tops = [CHECKOUT / top for top in ("unitouch_gen", *MAPPED)]
    with_code = {file.parent for top in tops for file in top.rglob("*.py")}
    assert with_code == set(package_folders().values()), "a folder with Python files has no __init__.py"


@in_checkout
def test_data_files_are_listed():
    folders = package_folders()
    patterns = settings()["package-data"]
    shipped = {file for name in patterns for pattern in patterns[name] for file in folders[name].glob(pattern)}
    present = {
        file
        for top in ("unitouch_gen", *MAPPED)
        for file in (CHECKOUT / top).rglob("*")
        if file.is_file() and file.suffix not in (".py", ".pyc") and not file.name.startswith(".")
    }
    missing = sorted(str(file.relative_to(CHECKOUT)) for file in present - shipped)
    assert not missing, f"add {missing} to [tool.setuptools.package-data] in pyproject.toml, or a wheel lacks them"


def test_one_top_level_package():
    ours = {top for top, distributions in packages_distributions().items() if "unitouch_gen" in distributions}
    # An editable install adds a finder of its own.
    assert {top for top in ours if not top.startswith("__editable__")} == {"unitouch_gen"}


def test_recipes_are_installed():
    recipes = modules()["unitouch_gen.training"].parent / "recipes"
    assert list(recipes.glob("*.yaml")), f"no recipe in {recipes}"


@pytest.mark.parametrize("name", sorted(modules()))
def test_module_imports(name):
    if name.rpartition(".")[2] == "__main__":
        pytest.skip("importing it runs the command")
    importlib.import_module(name)


@pytest.mark.parametrize("name", sorted(modules()))
def test_imports_follow_the_arrows(name):
    room = room_of(name)
    if room in TOP_FLOOR:
        return
    assert room in ARROWS, f"say in {Path(__file__).name} which rooms `{room}` may import"
    allowed = {room} if room in GROUND else {room, *ARROWS[room], *GROUND}
    wrong = [f"line {line}: {target}" for target, line, _ in imports(name) if room_of(target) not in allowed]
    assert not wrong, f"{name} may import from {', '.join(sorted(allowed))}, not {wrong}"


@pytest.mark.parametrize("name", sorted(modules()))
def test_mapped_packages_are_imported_by_their_installed_name(name):
    wrong = [f"line {line}: {target}" for target, line, _ in imports(name) if target.split(".")[0] in MAPPED]
    assert not wrong, f"{name} imports a folder that is only there in a checkout: {wrong}"


def test_no_circles():
    graph = {name: {target for target, _, now in imports(name) if now and target != name} for name in modules()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"modules import each other: {' <- '.join(error.args[1])}")


@pytest.mark.parametrize("name", sorted(modules()))
def test_file_is_short_enough(name):
    lines = len(modules()[name].read_text(encoding="utf-8").splitlines())
    assert lines <= MAX_LINES, f"{modules()[name].name} has {lines} lines: a file that passes {MAX_LINES} is two things"


def test_training_runs_as_a_module(tmp_path):
    command = [sys.executable, "-m", "unitouch_gen.training.touch", "--help"]
    # From an empty folder, as `python -m` would also find what lies in the current one.
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False)
    assert result.returncode == 0, result.stderr
    assert "usage" in result.stdout.lower()
