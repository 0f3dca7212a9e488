"""The house rules that a machine can check."""

import ast
import subprocess
import sys
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest

import torchrod

ROOT = Path(__file__).resolve().parents[1]
LIBRARY = ROOT / "torchrod"
MODULES = sorted(LIBRARY.rglob("*.py"))
PICTURE = (ROOT / "docs" / "architecture.md").read_text().split("```")[1].strip("\n").splitlines()
ORDER = [line.split()[0] for line in PICTURE]  # from the command line down: a package imports only what stands below it


@lru_cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@lru_cache
def imports_of(path: Path) -> set[str]:
    """The modules of torchrod that a file imports, as dotted names below torchrod; those it names for type checking included."""
    here = path.relative_to(LIBRARY).parent.parts
    found = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = here[: len(here) - node.level + 1]
            module = [*base, *(node.module.split(".") if node.module else [])]
            for alias in node.names:
                inner = LIBRARY.joinpath(*module, alias.name)
                found.add(".".join([*module, alias.name] if inner.with_suffix(".py").is_file() or inner.is_dir() else module))
    return found


def test_the_picture_names_every_package():
    packages = {path.parent.name for path in LIBRARY.glob("*/__init__.py")}
    assert set(ORDER) == packages
    for name in packages:
        assert ast.get_docstring(parsed(LIBRARY / name / "__init__.py")), f"{name} does not say what it is for"


@pytest.mark.parametrize("package", ORDER)
def test_imports_go_one_way(package):
    for path in (LIBRARY / package).rglob("*.py"):
        for other in imports_of(path):
            home = other.split(".")[0]
            assert home == package or ORDER.index(home) > ORDER.index(package), f"{path.relative_to(ROOT)} imports {other}"


def test_no_module_imports_itself_by_a_detour():
    """Within a package, too, the imports have no circle."""
    names = {".".join(path.relative_to(LIBRARY).with_suffix("").parts).removesuffix(".__init__"): path for path in MODULES}
    below = {name: imports_of(path) & names.keys() for name, path in names.items()}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join([*trail, name])
        if name not in done:
            for other in below[name] - {name.rpartition(".")[0]}:
                visit(other, (*trail, name))
            done.add(name)

    for name in names:
        visit(name, ())


def test_the_library_is_free_of_lightning_and_of_leftovers():
    for path in MODULES:
        text = path.read_text()
        for word in ("lightning", "TO" + "DO", "FIX" + "ME", "allow_pickle=True", "weights_only=False"):
            assert word not in text, f"{path.name} contains {word}"


def test_the_public_surface_is_documented():
    surface: Any = torchrod
    assert len(surface.__all__) > 60
    for name in surface.__all__:
        assert getattr(surface, name).__doc__, name
    with pytest.raises(AttributeError):
        _ = surface.nothing


def test_shapes_and_types_hold():
    """A whole estimate with every annotation checked by beartype (in its own process: the checks slow everything down)."""
    code = """
from jaxtyping import install_import_hook
packages = ["util", "kernel", "mechanics", "model", "estimation"]  # those that it goes through
install_import_hook([f"torchrod.{package}" for package in packages], "beartype.beartype")
import torch
torch.set_default_dtype(torch.float64)
from tests.robots import T, busy_robot
from torchrod import GaussianCoordinates, Markers, PointForces, Problem, Registration, Settings, Unknowns, estimate, solve_shape
robot, s, tension = busy_robot(), torch.linspace(0.1, 0.4, 4), T([[3.0, 2.0], [1.0, 2.0]])
load = PointForces(T([[[0.2, 0.1, 0.0]], [[0.3, 0.0, 0.0]]]), T([[0.2], [0.3]]))
shape = solve_shape(robot, (load,), tension, s, 2, 4)
markers = Markers(s, shape.p, 1e-3, 0.01 * torch.ones(4, 3))
unknowns = Unknowns(GaussianCoordinates(1, 0.4, 1.0), registration=Registration())
fit = estimate(Problem(robot, unknowns, [markers], tension, steps=4), Settings(max_iterations=2))
print(fit.magnitude_std, fit.rms_residual, fit.fitted_rod(0).loads(0.4))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-3000:]


def test_nothing_is_said_twice():
    """No function with the same name and body, and no tuple of the same name and values, in two modules."""
    seen = {}
    for path in MODULES:
        for node in parsed(path).body:
            if isinstance(node, ast.FunctionDef):
                what = node.name, ast.dump(node.args), *map(ast.dump, node.body[ast.get_docstring(node) is not None :])
            elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple):
                what = (ast.dump(node),)
            else:
                continue
            assert seen.setdefault(what, path) == path, f"{ast.unparse(node)[:60]}: in {seen[what].name} and {path.name}"
