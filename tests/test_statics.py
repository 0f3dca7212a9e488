"""The forward model against closed forms and against solvers that nobody here wrote."""

import csv
import math

import pytest
import torch

from tests.conftest import reference
from tests.robots import T, busy_robot, loads_of, robot_of, steel_rod
from torchrod import PointForces, PointWrenches, PolynomialLoads, Robot, Rod, Status, Tendon, Tendons, shape_from_base, solve_shape

# alpha = P L^2 / EI -> deflection w / L, abscissa x / L of an inextensible cantilever under a dead transverse tip load
ELASTICA = {
    0.5: (0.16214358, 0.98408104),
    1: (0.30172077, 0.94356676),
    2: (0.49345748, 0.83935828),
    5: (0.71379152, 0.61237164),
    10: (0.81060902, 0.44500440),
}


def inextensible(length: float = 1.0, EI: float = 1.0, GJ: float = 0.8, **more) -> Rod:
    return Rod.from_stiffness(length, torch.eye(3) * 1e12, torch.diag(T([EI, EI, GJ])), **more)


def tip_moment(moment, length: float) -> PointWrenches:
    """A moment that turns with the tip: the section carries it unchanged along the rod when u is parallel to it."""
    return PointWrenches(torch.zeros(1, 1, 3), moment.reshape(1, 1, 3), T([length]), frame="local")


@pytest.mark.parametrize("alpha", ELASTICA)
def test_elastica(alpha):
    load = PointWrenches(T([[[float(alpha), 0.0, 0.0]]]), torch.zeros(1, 1, 3), T([1.0]))
    shape = solve_shape(Robot(inextensible()), (load,), None, T([1.0]), 1, 50)
    w, x = ELASTICA[alpha]
    assert shape.status[0] == Status.CONVERGED
    assert abs(float(shape.p[0, 0, 0]) / w - 1) < 1e-6
    assert abs(float(shape.p[0, 0, 2]) / x - 1) < 1e-6


def test_a_moment_closes_a_circle():
    L = 0.7
    rod = inextensible(L, 0.04)
    moment = T([0.0, 2 * math.pi * 0.04 / L, 0.0])
    shape = solve_shape(Robot(rod), (tip_moment(moment, L),), None, T([L / 2, L]), 1, 400)
    assert shape.p[0, 1].norm() < 1e-9
    assert torch.allclose(shape.p[0, 0], T([L / math.pi, 0.0, 0.0]), atol=1e-9)


def test_a_local_moment_makes_a_helix():
    """With EI = GJ a moment gives a constant u = (0, a, b): a helix of curvature a and torsion b about the axis u / |u|."""
    rod, L = inextensible(0.5, 0.04, 0.04), 0.5
    u = T([0.0, 6.0, 9.0])
    load = tip_moment(rod.K_bt @ u, L)
    s = torch.linspace(0.05, L, 10)
    shape = solve_shape(Robot(rod), (load,), None, s, 1, 400)
    w = u.norm()
    k = u / w
    e3 = T([0.0, 0.0, 1.0])
    across, along = e3 - k * (k @ e3), k * (k @ e3)
    sine, versine = (torch.sin(w * s) / w)[:, None], ((1 - torch.cos(w * s)) / w)[:, None]
    exact = along * s[:, None] + across * sine + torch.linalg.cross(k, e3) * versine
    assert (shape.p[0] - exact).abs().max() < 1e-9


def test_reference_curvature_alone_makes_the_same_helix():
    """A pre-curved rod without loads has the shape that u* says; a table of rows and one row agree."""
    u = [0.0, 6.0, 9.0]
    s = torch.linspace(0.05, 0.5, 10)
    shapes = [
        solve_shape(Robot(inextensible(0.5, 0.04, reference_curvature=T(rows))), (), None, s, 1, 100).p
        for rows in ([[0.0, *u]], [[0.0, *u], [0.2, *u], [0.5, *u]])
    ]
    bent = tip_moment(0.04 * T(u), 0.5)
    loaded = solve_shape(Robot(inextensible(0.5, 0.04, 0.04)), (bent,), None, s, 1, 100).p
    assert (shapes[0] - shapes[1]).abs().max() < 1e-14
    assert (shapes[0] - loaded).abs().max() < 1e-12


@pytest.mark.parametrize("case", reference("shape"), ids=lambda c: c["name"])
def test_shape_reference(case):
    """An independent solver: 8th-order adaptive integration and shooting, residual below 1e-11."""
    robot, tension = robot_of(case), T([case["tensions"]]) if case["tensions"] else None
    shape = solve_shape(robot, loads_of(case), tension, T(case["s"]), 1)
    assert shape.status[0] == Status.CONVERGED
    assert (shape.p[0] - T(case["positions"])).norm(dim=-1).max() < 1e-6
    assert (shape.base_wrench[0] - T(case["base_wrench"])).abs().max() < 2e-5
    again = shape_from_base(robot, loads_of(case), shape.base_wrench, tension, T(case["s"]), 40)
    assert (again.p - shape.p).abs().max() < 1e-6, "base to tip and tip to base disagree"
    assert again.tip_residual.abs().max() < 1e-5


def test_tendon_reference():
    """A public C++ Rucker-Webster model, six tendons on two segments with tip forces; good to its own tolerance of 0.11 mm."""
    data = reference("tendon")
    r = data["robot"]
    E, d, offset = r["youngs_modulus_Pa"], 2 * r["backbone_radius_m"], r["tendon_offset_m"]
    ends = [r["tendons_1_to_3_end_at_m"]] * 3 + [r["tendons_4_to_6_end_at_m"]] * 3
    angles = [math.radians(a) for a in r["tendon_angles_deg"]] * 2
    tendons = tuple(Tendon.straight(offset * math.cos(a), offset * math.sin(a), end) for a, end in zip(angles, ends, strict=True))
    L = sum(r["segments_m"])
    robot = Robot(Rod.circular(L, d, E, E / (2 * (1 + r["poisson_ratio"]))), Tendons(tendons))
    cases = data["cases"]
    force = T([[c["tip_force_world_N"]] for c in cases])
    tension = T([c["tensions_N"] for c in cases])
    shape = solve_shape(robot, (PointWrenches(force, 0 * force, T([L])),), tension, T(r["disk_arc_lengths_m"]), len(cases))
    assert (shape.status == Status.CONVERGED).all()
    assert (shape.p - T([c["disk_positions_m"] for c in cases])).norm(dim=-1).max() < 1.2e-4


SOROSIM = {"SpringSteel": (200e9, 0.33, 1.6e-3, 7870.0, 0.6), "TPU": (70e6, 0.4, 1e-2, 1200.0, 0.4)}


def sorosim_robot(name: str, gravity) -> Robot:
    """Their rod lies along +x; ours leaves the base along +z, so (x, y, z) becomes (y, z, x)."""
    E, nu, d, rho, L = SOROSIM[name]
    return Robot(Rod.circular(L, d, E, E / (2 * (1 + nu)), rho * math.pi * d**2 / 4), Tendons(), gravity[..., [1, 2, 0]])


def dead_wrenches(mid, tip, L: float) -> PointWrenches:
    """(B, 6) moment and force at the middle and at the tip."""
    both = torch.stack([mid, tip], 1)
    return PointWrenches(both[..., 3:][..., [1, 2, 0]], both[..., :3][..., [1, 2, 0]], T([L / 2, L]))


@pytest.mark.parametrize("name", SOROSIM)
def test_sorosim_statics(shared, name):
    """250 static shapes of another group's simulator under gravity and dead wrenches; its file is rounded to 0.1 mm."""
    rows = list(csv.reader((shared / "sorosim" / f"{name}_statics.csv").open()))
    L = SOROSIM[name][-1]
    values = T([[float(v) for v in row[1:]] for row in rows[2:]]).reshape(-1, 6, 17)
    fractions = T([float(v) for v in rows[1][4:]])
    s = torch.cat([fractions[:7], 1 + fractions[7:]]) * L / 2
    gravity, mid, tip = values[:, 3:, 0], values[:, :, 1], values[:, :, 2]
    measured = values[:, 3:, 3:].mT[..., [1, 2, 0]]
    shape = solve_shape(sorosim_robot(name, gravity), (dead_wrenches(mid, tip, L),), None, s, len(values))
    error = (shape.p - measured).norm(dim=-1)
    assert (shape.status == Status.CONVERGED).all()
    assert error.max() < 7e-4
    assert error.median() < 2e-4
    assert error[:, -1].median() < 2e-4


@pytest.mark.parametrize("name", SOROSIM)
def test_sorosim_release_states(shared, name):
    """The held states before release: poses of the middle and the tip."""
    lines = [line for line in (shared / "sorosim" / f"{name}_release_t0.txt").read_text().splitlines() if not line.startswith("#")]
    numbers = T([[float(v) for v in line.split()] for line in lines]).reshape(-1, 3, len(lines[0].split()))
    L = SOROSIM[name][-1]
    gravity = numbers[:, 0, -3:]
    mid, tip = numbers[:, 1, 1:7], numbers[:, 1, 7:13]
    poses = numbers[:, 2, 1:]
    shape = solve_shape(sorosim_robot(name, gravity), (dead_wrenches(mid, tip, L),), None, T([L / 2, L]), len(numbers))
    expected = torch.stack([poses[:, 3:6], poses[:, 9:12]], 1)[..., [1, 2, 0]]
    assert (shape.status == Status.CONVERGED).all()
    error = (shape.p - expected).norm(dim=-1)
    assert error.max() < 7e-4
    assert error.median() < 2e-4


@pytest.mark.parametrize("tendons", [False, True], ids=["passive", "across a tendon's end"])
def test_rk4_converges_with_fourth_order(tendons):
    """What a halved step changes falls to a sixteenth with the next halving."""
    robot = busy_robot() if tendons else steel_rod()
    tension = T([[3.0, 2.0]]) if tendons else None
    alpha = T([[0.6, 0.5, 0.2, 0.1, 0.2, 0.05]])
    steps = (40, 80, 160)  # multiples of 40 divide the rod, and the part up to the tendon's end, evenly
    at = T([0.2, 0.4])
    coarse, fine, finer = (shape_from_base(robot, (), alpha, tension, at, n, differentiable=False).p for n in steps)
    first, second = (float(change.norm(dim=-1).max()) for change in (coarse - fine, fine - finer))
    assert 3.8 < math.log2(first / second) < 4.2


def test_a_distributed_load_equals_many_points():
    """A uniform load by its closed-form integrals, and as 400 point forces."""
    robot, s = steel_rod(), T([0.2, 0.4])
    smooth = solve_shape(robot, (PolynomialLoads(T([[[1.5], [0.5]]]), 0.4),), None, s, 1).p
    at = (torch.arange(400) + 0.5) * 1e-3
    force = T([1.5e-3, 0.5e-3, 0.0]).expand(1, 400, 3)
    lumped = solve_shape(robot, (PointForces(force, at.unsqueeze(0)),), None, s, 1).p
    assert (smooth - lumped).abs().max() < 2e-6


def test_a_failed_sample_leaves_its_neighbours_alone():
    robot = busy_robot()
    tension = T([[3.0, 2.0], [math.nan, 2.0], [1.0, 1e9], [3.0, 2.0]])
    s = T([0.2, 0.4])
    together = solve_shape(robot, (), tension, s, 4)
    alone = solve_shape(robot, (), tension[:1], s, 1)
    assert together.status.tolist()[0] == together.status.tolist()[3] == Status.CONVERGED
    assert together.status[1] == Status.INVALID
    assert together.p[1].isnan().all()
    assert (together.p[[0, 3]] - alone.p).abs().max() < 1e-12


def test_the_number_of_load_increments_does_not_matter():
    """41 and 47 increments once ended just short of the whole load; a neighbour's increments leave a sample alone."""
    robot, s, L = steel_rod(), T([0.2, 0.4]), T([0.4])

    def solve(*forces):
        return solve_shape(
            robot, (PointWrenches(T(forces).unsqueeze(1), torch.zeros(len(forces), 1, 3), L),), None, s, len(forces), 40
        )

    for force in (20.0, 19.7, 20.3):
        assert solve([force, 0.0, 0.0]).status[0] == Status.CONVERGED
    together, alone = solve([2.0, 0.0, 0.0], [20.0, 0.0, 0.0]), solve([2.0, 0.0, 0.0])
    assert torch.equal(together.p[0], alone.p[0])


def test_one_load_serves_the_whole_batch():
    """Leading dimensions broadcast: a point load of batch 1 among three samples with different tensions."""
    robot, s = busy_robot(), T([0.2, 0.4])
    load = PointForces(T([[[0.2, 0.1, 0.0]]]), T([[0.13]]))
    tension = T([[3.0, 2.0], [1.0, 2.0], [0.0, 1.0]])
    together = solve_shape(robot, (load,), tension, s, 3)
    alone = [solve_shape(robot, (load,), tension[i : i + 1], s, 1).p[0] for i in range(3)]
    assert (together.p - torch.stack(alone)).abs().max() < 1e-12


def test_tendons_on_a_soft_rod():
    """Tensions as stiff as the rod take more Newton steps; a tension that crushes the rod is not converged."""
    rod = Rod.circular(0.1, 0.01, 1e5, 1e5 / 3)
    robot = Robot(rod, Tendons((Tendon.straight(0.004, 0.0, 0.1),)))
    push = PointWrenches(T([[[0.0, 0.02, 0.0]]]), torch.zeros(1, 1, 3), T([0.1]))
    soft = solve_shape(robot, (push,), T([[1.0]]), T([0.1]), 1, 80)
    fine = solve_shape(robot, (push,), T([[1.0]]), T([0.1]), 1, 160)
    assert soft.status[0] == Status.CONVERGED
    assert (soft.p - fine.p).abs().max() < 1e-6
    assert solve_shape(robot, (), T([[9.0]]), T([0.1]), 1, 80).status[0] == Status.NOT_CONVERGED
