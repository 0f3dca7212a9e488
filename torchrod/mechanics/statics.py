"""Statics of the whole rod: march the arc-length step along it, and solve for the shape under known loads.

March base to tip: the base wrench alpha = [n(0), m(0)] is given and the tip need not be in equilibrium: the estimator's model.
March tip to base: the wrench is known at the tip (there is nothing beyond it), so only the tip's orientation is unknown, and
not even that when no load keeps its direction in the base frame; this is the forward solve.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..util.precision import as_float64
from ..util.status import Status
from .grid import DEFAULT_STEPS, Grid, make_grid, on_rod
from .integrate import march, march_linearized, states_at
from .jacobian import pointwise_jacobian
from .lie import Quaternion, Vector, cross, identity_quaternion, inverse3, logarithm, matvec, normalized, rotate, turned
from .loads import Load, LoadIntegrals, total
from .robot import Robot
from .section import STATE_PARTS, Section, StageTable, State, section_wrench
from .tendons import strains_settled

ORIENTATION_TOLERANCE = 1e-11  # rad: the forward solve's residual, far below what RK4 leaves
ROUGH_TOLERANCE = 1e-5  # rad: enough where a filter starts
INCREMENT_TOLERANCE = 1e-3  # rad: enough on the way to the full load
MAX_NEWTON = 40
LOAD_PER_INCREMENT = 2.0  # in EI / L^2: world-frame loads beyond this are put on in increments, to stay on the principal branch


def stage_table(robot: Robot, loads: tuple[Load, ...], tension: Float[Tensor, "... T"] | None, grid: Grid) -> StageTable:
    """All that is known along the rod, at the stages of every step of the grid. tension: (..., T) readings, N."""
    s, inside = grid.stages, grid.inside
    integrals = total(loads, s, inside) + robot.weight_beyond(s)
    tendons = None
    if len(robot.tendons) and tension is not None:
        tau = robot.tendons.true_tension(tension)
        newton = robot.tendons.newton_steps(robot.rod.K_se, robot.rod.K_bt, tau)
        tendons = robot.tendons.table(s, inside, tau[..., None, None, :], newton)
    return StageTable(integrals, robot.rod.curvature_at(s), tendons)


def grid_for(robot: Robot, loads: tuple[Load, ...], outputs: Float[Tensor, " P"], steps: int) -> Grid:
    """The grid that serves this robot, these loads and these output arc lengths (m)."""
    jumps = [b for b in (load.breakpoints() for load in loads) if b is not None]
    leading = torch.broadcast_shapes(*(b.shape[:-1] for b in jumps)) if jumps else ()
    breakpoints = torch.cat([b.expand(*leading, -1) for b in jumps], -1) if jumps else None
    return make_grid(robot.rod.length, outputs, robot.tendons.ends, breakpoints, steps)


def beyond_tip(robot: Robot, loads: tuple[Load, ...], like: Tensor) -> LoadIntegrals:
    """The load integrals just beyond the tip, where every load, one at the tip itself included, has been passed."""
    tip = like.new_full((1, 3), robot.rod.length)
    integrals = total(loads, tip, torch.full_like(tip, torch.inf))

    def first(x: Vector | None) -> Vector | None:
        return None if x is None else x[..., 0, 0, :]

    return LoadIntegrals(first(integrals.G), first(integrals.G2), first(integrals.Gm))


def base_state(robot: Robot, alpha: Float[Tensor, "... 6"], table: StageTable) -> State:
    """y(0) from the base wrench alpha = [n(0) (N), m(0) (N m)]: by (1) of mechanics.section with G(0) = 0 and R(0) = I."""
    N, M = alpha[..., :3], alpha[..., 3:]
    if table.loads.Wn is not None:
        N = N - table.loads.Wn[..., 0, 0, :]
    if table.loads.Wm is not None:
        M = M - table.loads.Wm[..., 0, 0, :]
    N, M = torch.broadcast_tensors(N, M)
    q = identity_quaternion(N.shape[:-1], N)
    return torch.cat([torch.zeros_like(N), q, N, M], -1)


@dataclass(frozen=True)
class Shape:
    """The rod at the outputs: p (..., P, 3) m, q (..., P, 4), and the tip residual c (..., 6) [N, N m], section frame.

    tip_q: (..., 4), the orientation of the last section.
    """

    p: Float[Tensor, "... P 3"]
    q: Float[Tensor, "... P 4"]
    tip_residual: Float[Tensor, "... 6"]
    tip_q: Float[Tensor, "... 4"]


def shape_of(section: Section, states: Float[Tensor, "... P1 13"], beyond: LoadIntegrals) -> Shape:
    """The shape at the first P states; the tip residual (17) from the last, the wrench carried just beyond the tip:

    c = [N~ - G, M~ + e3 x G2 - Gm] at s = L+, zero in equilibrium
    """
    p, q, N, M = states.split(STATE_PARTS, -1)
    c = section_wrench(q[..., -1, :], N[..., -1, :], M[..., -1, :], section.e3, beyond)
    return Shape(p[..., :-1, :], q[..., :-1, :], torch.cat(c, -1), q[..., -1, :])


def shape_from_base(
    robot: Robot,
    loads: tuple[Load, ...],
    alpha: Float[Tensor, "... 6"],
    tension: Float[Tensor, "... T"] | None,
    outputs: Float[Tensor, " P"],
    steps: int,
    differentiable: bool = True,
) -> Shape:
    """March base to tip under alpha = [n(0) (N), m(0) (N m)]; outputs in m. The tip need not be in equilibrium.

    differentiable=False takes the compiled march where it serves, for alpha (B, 6) outside of any transform.
    """
    alpha, outputs = as_float64(alpha), as_float64(outputs)
    grid = grid_for(robot, loads, outputs, steps)
    table = stage_table(robot, loads, tension, grid)
    section = Section.of(robot.rod.K_se, robot.rod.K_bt)
    y, at = base_state(robot, alpha, table), grid.outputs_and_tip
    if differentiable:
        states = states_at(march(section, y, table, grid), at)
    else:
        states, _ = march_linearized(section, y, y.new_zeros(*y.shape, 0), table, None, grid, at)
    return shape_of(section, states, beyond_tip(robot, loads, alpha))


@dataclass(frozen=True)
class Equilibrium:
    """The forward solve's answer, one entry per sample.

    s: (P,) m. p: (B, P, 3) m and q: (B, P, 4), base frame. base_wrench: (B, 6) = [n(0) N, m(0) N m], the whole section's.
    status: (B,) Status codes; residual: (B,) rad, the angle by which the base misses its clamp; iterations: (B,).
    A sample that failed holds NaN and has disturbed nobody.
    """

    s: Float[Tensor, " P"]
    p: Float[Tensor, "B P 3"]
    q: Float[Tensor, "B P 4"]
    base_wrench: Float[Tensor, "B 6"]
    status: Int[Tensor, " B"]
    residual: Float[Tensor, " B"]
    iterations: Int[Tensor, " B"]


@dataclass(frozen=True)
class _TipProblem:
    """March tip to base from a guessed tip orientation, with the loads of the base frame scaled by a fraction per sample."""

    section: Section
    table: StageTable
    grid: Grid
    wrench: Float[Tensor, "B 6"]

    def march(
        self, q_tip: Float[Tensor, "B 4"], dq_tip: Float[Tensor, "B 4 n"], fraction: Float[Tensor, " B"], keep: Int[Tensor, "*B P"]
    ) -> tuple[Float[Tensor, "B P 13"], Float[Tensor, "B P 13 n"]]:
        """States at the nodes `keep`, and their derivatives when the tip's orientation moves along dq_tip."""
        y = torch.cat([torch.zeros_like(q_tip[:, :3]), q_tip, self.wrench], -1)
        dy = torch.nn.functional.pad(dq_tip, (0, 0, 3, 6))
        return march_linearized(
            self.section, y, dy, self.table.with_base_frame_loads_scaled(fraction), None, self.grid, keep, reverse=True
        )

    def base(
        self, q_tip: Float[Tensor, "B 4"], dq_tip: Float[Tensor, "B 4 n"], fraction: Float[Tensor, " B"]
    ) -> tuple[Vector, Tensor]:
        """r(q_tip), the rotation vector by which the base misses the identity (rad), and its derivatives (B, 3, n)."""
        first = torch.zeros(*self.grid.nodes.shape[:-1], 1, dtype=torch.int64)
        states, tangents = self.march(q_tip, dq_tip, fraction, first)
        if dq_tip.shape[-1] == 0:
            return logarithm(states[:, 0, 3:7]), tangents[:, 0, :3]
        r, dr = pointwise_jacobian(logarithm, states[:, 0, 3:7])
        return r, dr @ tangents[:, 0, 3:7]

    def newton_step(self, q_tip: Float[Tensor, "B 4"], fraction: Float[Tensor, " B"]) -> tuple[Vector, Vector]:
        """r, and the tip's turn -J^-1 r in the base frame."""
        _, dq = pointwise_jacobian(lambda w: turned(w, q_tip), torch.zeros_like(q_tip[:, :3]))
        r, J = self.base(q_tip, dq, fraction)
        return r, -matvec(inverse3(J), r)


def _newton(
    problem: _TipProblem, q: Quaternion, fraction: Float[Tensor, " B"], mine: Bool[Tensor, " B"], tolerance: float
) -> tuple[Quaternion, Float[Tensor, " B"], Int[Tensor, " B"]]:
    """Damped Newton on the tip's orientation: the best orientation, its residual (rad) and the iterations taken."""
    best = torch.full_like(fraction, torch.inf)
    enough = torch.where(fraction < 1, max(INCREMENT_TOLERANCE, tolerance), tolerance)
    anchor, turn, damping = q, torch.zeros_like(q[..., :3]), torch.ones_like(best)
    iterations = torch.zeros(best.shape, dtype=torch.int64)
    for _ in range(MAX_NEWTON):
        r, step = problem.newton_step(q, fraction)
        size = r.norm(dim=-1)
        better = size < best
        anchor, turn = torch.where(better.unsqueeze(-1), q, anchor), torch.where(better.unsqueeze(-1), step, turn)
        best, damping = torch.where(better, size, best), torch.where(better, 1.0, 0.5 * damping)
        active = mine & (best > enough) & torch.isfinite(best) & (damping > 1e-3)
        iterations = iterations + active
        if not active.any():
            break
        scale = (damping / turn.norm(dim=-1).clamp(min=1.0)).unsqueeze(-1)
        q = torch.where(active.unsqueeze(-1), normalized(turned(scale * turn, anchor)), anchor)
    return anchor, best, iterations


def _increments(robot: Robot, table: StageTable, B: int) -> Int[Tensor, " B"]:
    """How many increments put on the base frame's loads, per sample: so many that each is below LOAD_PER_INCREMENT (EI / L^2)."""
    L, EI = robot.rod.length, robot.rod.bending_stiffness
    load = torch.zeros(B, dtype=robot.rod.K_bt.dtype)
    for wrench, lever in ((table.loads.Wn, L * L), (table.loads.Wm, L)):
        if wrench is not None:
            load = load + wrench.norm(dim=-1).flatten(-2).amax(-1) * lever / EI
    return (load.nan_to_num(0.0, 0.0) / LOAD_PER_INCREMENT).ceil().clamp(1, 100).to(torch.int64)


def solve_shape(
    robot: Robot,
    loads: tuple[Load, ...],
    tension: Float[Tensor, "B T"] | None,
    outputs: Float[Tensor, " P"],
    batch: int,
    steps: int = DEFAULT_STEPS,
    tolerance: float = ORIENTATION_TOLERANCE,
    q_tip: Float[Tensor, "B 4"] | None = None,
) -> Equilibrium:
    """The forward solve: the shape of `batch` samples under known loads and tensions, and the wrench at their base.

    Marches tip to base and turns the tip until the base sits in its clamp, R(0) = I: at once without base-frame loads, by damped
    Newton on three numbers with them, until the base misses it by less than the tolerance (rad). Loads (B, ...) in their own frames
    and units (mechanics.loads), tension N, outputs m. q_tip: where to look for the tip's orientation, with all of the load at once.
    Errors: ValueError for outputs off the rod. A sample that cannot be solved has status NOT_CONVERGED; one that holds NaN, or a
    point load off the rod, INVALID.
    Source: docs/model.md.
    """
    outputs, q_tip = as_float64(outputs), as_float64(q_tip)
    grid = grid_for(robot, loads, outputs, steps)
    table = stage_table(robot, loads, tension, grid)
    section = Section.of(robot.rod.K_se, robot.rod.K_bt)
    beyond = beyond_tip(robot, loads, outputs)
    zero = outputs.new_zeros(batch, 3)
    # At L+ the section carries nothing: N = M = 0 in (1), hence N~ = G and M~ = Gm - e3 x G2 there.
    N = zero if beyond.G is None else zero + beyond.G
    M = zero if beyond.G2 is None else zero - cross(section.e3, beyond.G2)
    wrench = torch.cat([N, M if beyond.Gm is None else M + beyond.Gm], -1)
    for place in (load.breakpoints() for load in loads):
        if place is not None:  # torch has no exception for a sample: NaN makes it INVALID
            wrench = torch.where(on_rod(place, robot.rod.length).all(-1, keepdim=True), wrench, torch.nan)
    problem = _TipProblem(section, table, grid, wrench)

    q, one = identity_quaternion((batch,), zero), torch.ones_like(zero[:, 0])
    dead = table.loads.Wn is not None or table.loads.Wm is not None
    if q_tip is None or not dead:
        r, _ = problem.base(q, zero.new_zeros(batch, 4, 0), 0 * one)
        q = turned(-r, q)  # exact where no load keeps its direction in the base frame
    residual, iterations = 0 * one, torch.zeros(batch, dtype=torch.int64)
    if dead:
        increments = _increments(robot, table, batch) if q_tip is None else torch.ones(batch, dtype=torch.int64)
        q = q if q_tip is None else q_tip
        for k in range(1, int(increments.max()) + 1):
            # A sample that carries its whole load is left alone, so that what its neighbours still need does not touch it.
            mine = k <= increments
            fraction = torch.where(k >= increments, one, k / increments.to(one.dtype))
            turned_further, missed, more = _newton(problem, q, fraction, mine, tolerance)
            q = torch.where(mine.unsqueeze(-1), turned_further, q)
            residual, iterations = torch.where(mine, missed, residual), iterations + more
    return _equilibrium(problem, q, residual, iterations, outputs, tolerance)


def _equilibrium(
    problem: _TipProblem,
    q_tip: Quaternion,
    residual: Float[Tensor, " B"],
    iterations: Int[Tensor, " B"],
    outputs: Float[Tensor, " P"],
    tolerance: float,
) -> Equilibrium:
    at = problem.grid.outputs_and_base
    states, _ = problem.march(q_tip, q_tip.new_zeros(len(q_tip), 4, 0), torch.ones_like(residual), at)
    p, q, N, M = states.split(STATE_PARTS, -1)
    base = problem.table.step(0).stage(0).loads
    base = LoadIntegrals(Wn=base.Wn, Wm=base.Wm)
    n0, m0 = section_wrench(q[:, -1], N[:, -1], M[:, -1], problem.section.e3, base)
    wrench = torch.cat([rotate(q[:, -1], n0), rotate(q[:, -1], m0)], -1)
    finite = torch.isfinite(states).flatten(1).all(-1)
    at_base = problem.table.step(0).stage(0)
    balanced = strains_settled(
        problem.section.K_se, problem.section.K_bt, problem.section.e3, at_base.u_star, n0, m0, at_base.tendons
    )
    solved = finite & balanced & (residual <= 10 * tolerance)
    status = torch.full_like(iterations, int(Status.NOT_CONVERGED))
    status = torch.where(solved, int(Status.CONVERGED), torch.where(finite, status, int(Status.INVALID)))
    keep = solved[:, None, None]
    return Equilibrium(
        outputs,
        torch.where(keep, p[:, :-1] - p[:, -1:], torch.nan),
        torch.where(keep, q[:, :-1], torch.nan),
        torch.where(solved.unsqueeze(-1), wrench, torch.nan),
        status,
        residual,
        iterations,
    )
