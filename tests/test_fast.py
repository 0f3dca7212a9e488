"""The compiled march against the torch step, which is the definition: values and Jacobians of the discrete steps, to round-off.

Whoever changes torchrod/mechanics/section.py or torchrod/mechanics/tendons.py without kernel.cpp fails here.
"""

import pytest
import torch

from tests import fresh
from tests.problems import posed
from tests.robots import T, busy_robot, steel_rod
from torchrod import (
    FourierCoordinates,
    GaussianCoordinates,
    PointForces,
    PointWrenches,
    Registration,
    Robot,
    Rod,
    SmoothCoordinates,
    forward_jacobian,
    kernel,
    shape_from_base,
    solve_shape,
)
from torchrod.kernel import build

needs_compiler = pytest.mark.skipif(
    not kernel.available(), reason="no kernel here (no C++ compiler, or TORCHROD_FAST=0): there is only the torch path"
)
TENSION = T([[3.0, 2.0], [1.0, 4.0], [0.0, 7.0]], dtype=torch.float64)


def stiffened() -> Robot:
    """Full stiffness matrices, a pre-curved rod, gravity."""
    K_bt = T([[0.04, 0.004, 0.001], [0.004, 0.05, 0.002], [0.001, 0.002, 0.03]])
    curved = T([[0.0, 0.5, -1.0, 2.0], [0.4, -1.0, 0.0, 1.0]])
    rod = Rod.from_stiffness(0.4, torch.diag(T([2e4, 3e4, 5e4])) + 100.0, K_bt, 0.1, curved)
    return Robot(rod, gravity=T([3.0, -5.0, 6.0]))


def close(a: torch.Tensor, b: torch.Tensor) -> bool:
    return bool((a - b).abs().max() <= 1e-10 * b.abs().max())


@needs_compiler
@pytest.mark.parametrize("registration", [None, Registration()], ids=["", "registration"])
@pytest.mark.parametrize("loads", ["one gaussian", "three gaussians", "fourier", "smooth"])
@pytest.mark.parametrize("kind", ["passive", "tendons and gravity", "full stiffness"])
def test_values_and_jacobians(kind, loads, registration):
    """Problem.linearized, which marches in the kernel, against forward_jacobian of the torch model."""
    robot = {"passive": steel_rod, "tendons and gravity": busy_robot, "full stiffness": stiffened}[kind]()
    scale = robot.rod.force_scale
    family = {
        "one gaussian": GaussianCoordinates(1, 0.4, scale),
        "three gaussians": GaussianCoordinates(3, 0.4, scale),
        "fourier": FourierCoordinates(3, 0.4, scale),
        "smooth": SmoothCoordinates(0.4, scale, 2.0, 0.2, terms=5),
    }[loads]
    s, tension, offsets = T([0.1, 0.25, 0.4]), TENSION if len(robot.tendons) else None, 0.01 * torch.eye(3)
    problem = posed(s, torch.zeros(3, 3, 3), 1e-3, robot, family, tension, offsets, steps=2, registration=registration)
    start = problem.state.join(family.start().expand(3, -1), torch.zeros(3, 6))
    x = start + 0.3 * torch.randn(3, problem.size, generator=torch.Generator().manual_seed(1))
    h, H = problem.linearized(x)
    reference_h, reference_H = forward_jacobian(problem.h, x)
    assert close(h, reference_h)
    assert close(H, reference_H)


@needs_compiler
def test_the_forward_solve(monkeypatch):
    """Tip to base with every kind of known load, per-sample nodes included, with and without the kernel."""
    robot, s = busy_robot(), T([0.1, 0.25, 0.4])
    local = PointWrenches(T([[[0.06, 0.03, 0.09]]]), T([[[0.003, 0.006, 0.002]]]), T([0.17]), frame="local")
    dead = PointWrenches(T([[[0.03, 0.06, -0.03]]]), T([[[0.003, -0.006, 0.003]]]), T([0.33]))
    points = PointForces(T([[[0.1, 0.03, 0.0]], [[0.06, 0.12, 0.0]], [[0.0, 0.03, 0.0]]]), T([[0.11], [0.29], [0.4]]))

    def solve():
        return solve_shape(robot, (local, dead, points), TENSION, s, 3, 2)

    compiled = solve()
    monkeypatch.setattr(kernel, "available", lambda: False)
    plain = solve()
    assert (compiled.status == 0).all() and (plain.status == 0).all()
    assert (compiled.p - plain.p).abs().max() < 1e-10
    assert (compiled.base_wrench - plain.base_wrench).abs().max() < 1e-9


@needs_compiler
@pytest.mark.parametrize(
    "robot", [steel_rod(), busy_robot(), stiffened()], ids=["passive", "tendons and gravity", "full stiffness"]
)
def test_a_shape_without_tangents(robot):
    """What the result and the figure draw, with loads whose places differ from sample to sample."""
    points = PointForces(T([[[0.3, 0.1, 0.0]], [[0.2, 0.4, 0.0]], [[0.0, 0.1, 0.0]]]), T([[0.11], [0.29], [0.4]]))
    alpha = 0.3 * torch.randn(3, 6, generator=torch.Generator().manual_seed(2))
    tension = TENSION if len(robot.tendons) else None
    shapes = [shape_from_base(robot, (points,), alpha, tension, T([0.1, 0.4]), 10, differentiable=d) for d in (True, False)]
    for name in ("p", "q", "tip_residual"):
        assert close(getattr(shapes[1], name), getattr(shapes[0], name)), name


@needs_compiler
def test_threads_do_not_change_the_answer():
    problem = posed(T([0.1, 0.4]), torch.zeros(70, 2, 3), loads=GaussianCoordinates(1, 0.4, 1.0))
    x = torch.randn(70, problem.size, generator=torch.Generator().manual_seed(0)) * 0.3
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = problem.linearized(x)
        torch.set_num_threads(3)
        three = problem.linearized(x)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(one[0], three[0])
    assert torch.equal(one[1], three[1])


def test_without_a_compiler_it_says_so_once_and_works(tmp_path):
    code = """
import warnings, torch
warnings.simplefilter("always")
from torchrod import Robot, Rod, solve_shape
robot = Robot(Rod.circular(0.4, 0.0014, 207e9, 79e9))
with warnings.catch_warnings(record=True) as seen:
    for _ in range(2):
        shape = solve_shape(robot, (), None, torch.tensor([0.4], dtype=torch.float64), 1, 4)
assert shape.status[0] == 0
assert sum("no compiled kernel" in str(w.message) for w in seen) == 1, [str(w.message) for w in seen]
"""
    done = fresh.run(code, tmp_path, PATH="/nowhere", CXX="/nowhere/c++", TORCHROD_CACHE=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.glob("*.so"))


@needs_compiler
def test_a_first_estimate_waits_for_the_build(tmp_path):
    """With one line about it; whether the compiler is slow or quick, the kernel serves from the first shape on."""
    compiler = tmp_path / "slow-c++"
    compiler.write_text(f'#!/bin/sh\nsleep 1\nfor last; do :; done\ncp "{build.target()}" "$last"\n')
    compiler.chmod(0o755)
    code = """
import torch
from torchrod import Robot, Rod, kernel, solve_shape
robot = Robot(Rod.circular(0.4, 0.0014, 207e9, 79e9, 0.05), gravity=torch.tensor([9.81, 0.0, 0.0], dtype=torch.float64))
asked = []
march = kernel.march_linearized
kernel.march_linearized = lambda *given: asked.append(1) or march(*given)
for _ in range(2):
    shape = solve_shape(robot, (), None, torch.tensor([0.4], dtype=torch.float64), 1, 4)
assert shape.status[0] == 0
assert len(asked) >= 2
"""
    done = fresh.run(code, tmp_path, PATH="/usr/bin:/bin", CXX=str(compiler), TORCHROD_CACHE=str(tmp_path / "cache"))
    assert done.returncode == 0, done.stderr
    assert done.stderr == build.LINE + "\n"


def test_the_torch_path_marches_with_its_tangents(monkeypatch):
    """Without the kernel, against torch.func through the whole of h."""
    monkeypatch.setattr(kernel, "available", lambda: False)
    robot = busy_robot()
    s, offsets = T([0.1, 0.4]), 0.01 * torch.eye(2, 3)
    problem = posed(s, torch.zeros(3, 2, 3), 1e-3, robot, tension=TENSION, offsets=offsets, steps=2)
    x = 0.3 * torch.randn(3, problem.size, generator=torch.Generator().manual_seed(1))
    h, H = problem.linearized(x)
    reference_h, reference_H = forward_jacobian(problem.h, x)
    assert close(h, reference_h)
    assert close(H, reference_H)
