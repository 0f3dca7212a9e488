"""The house rules that a machine can check."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import torchrod

ROOT = Path(__file__).resolve().parents[1]
MODULES = sorted((ROOT / "torchrod").rglob("*.py"))
SCRIPTS = sorted((ROOT / "scripts").rglob("*.py")) + sorted((ROOT / "training").rglob("*.py"))
PICTURE = (ROOT / "docs" / "architecture.md").read_text().split("```")[1].strip("\n").splitlines()
COMMANDS = sorted(path.stem for path in MODULES if path.stem.endswith("_command"))


def layer(line: str) -> set[str]:
    """The modules of a line of docs/architecture.md: what stands left of the explanation."""
    names = re.split(r" +", line[:42].strip())
    return {name for given in names for name in (COMMANDS if given == "*_command" else [given])}


# From the command line down to the Lie-group helpers: a module imports only from layers below its own.
LAYERS = [layer(line) for line in PICTURE]

PACKAGES = ("io", "fast", "coordinates")


def imports_of(path: Path) -> set[str]:
    """The torchrod modules that a file imports when it runs (not only for type checking)."""
    tree = ast.parse(path.read_text())
    guarded = {
        id(n)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        for n in ast.walk(node)
    }
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level and id(node) not in guarded:
            if path.parent.name in PACKAGES and node.level == 1:
                continue
            found |= {node.module.split(".")[0]} if node.module else {alias.name for alias in node.names}
    return found


def layer_of(module: str) -> int:
    (layer,) = [i for i, names in enumerate(LAYERS) if module in names]
    return layer


@pytest.mark.parametrize("path", [m for m in MODULES if m.name != "__init__.py" or m.parent.name in PACKAGES], ids=lambda p: p.stem)
def test_imports_go_one_way(path):
    module = path.parent.name if path.parent.name in PACKAGES else path.stem
    for other in imports_of(path):
        assert layer_of(other) > layer_of(module), f"{module} imports {other}, which is not below it"


@pytest.mark.parametrize("path", MODULES + SCRIPTS, ids=lambda p: p.stem)
def test_modules_and_functions_are_short(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 300, path
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            doc = (ast.get_docstring(node, clean=False) or "").count("\n") + 1
            assert (node.end_lineno or 0) - node.lineno + 1 - doc <= 52, f"{path.name}: {node.name}"


def test_the_library_is_free_of_lightning_and_of_leftovers():
    for path in MODULES:
        text = path.read_text()
        for word in ("lightning", "TO" + "DO", "FIX" + "ME", "allow_pickle=True", "weights_only=False"):
            assert word not in text, f"{path.name} contains {word}"


def test_the_public_surface_is_what_it_says():
    homes = [name for names in torchrod._HOMES.values() for name in names]
    assert sorted(homes) == sorted(torchrod.__all__)
    for name in torchrod.__all__:
        assert getattr(torchrod, name).__doc__, name
    with pytest.raises(AttributeError):
        _ = torchrod.nothing


def test_shapes_and_types_hold():
    """A whole estimate with every annotation checked by beartype (in its own process: the checks slow everything down)."""
    code = """
from jaxtyping import install_import_hook
install_import_hook("torchrod", "beartype.beartype")
import torch
torch.set_default_dtype(torch.float64)
from tests.robots import T, busy_robot
from torchrod import GaussianCoordinates, Markers, Model, PointForces, Settings, estimate, solve_shape
robot, s, tension = busy_robot(), torch.linspace(0.1, 0.4, 4), T([[3.0, 2.0], [1.0, 2.0]])
load = PointForces(T([[[0.2, 0.1, 0.0]], [[0.3, 0.0, 0.0]]]), T([[0.2], [0.3]]))
shape = solve_shape(robot, (load,), tension, s, 2, 4)
model = Model(robot, GaussianCoordinates(1, 0.4, 1.0), registration=True, steps=4)
markers = Markers(s, shape.p, 0.01 * torch.ones(4, 3), tension)
fit = estimate(model, markers, 1e-3, Settings(max_iterations=2))
print(fit.magnitude_std, fit.rms_residual, fit.fit(0).loads(0.4))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-3000:]


def test_nothing_is_said_twice():
    """No function with the same name and body, and no tuple of the same name and values, in two modules."""
    seen = {}
    for path in MODULES:
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef):
                what = node.name, ast.dump(node.args), *map(ast.dump, node.body[ast.get_docstring(node) is not None :])
            elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple):
                what = (ast.dump(node),)
            else:
                continue
            assert seen.setdefault(what, path) == path, f"{ast.unparse(node)[:60]}: in {seen[what].name} and {path.name}"
