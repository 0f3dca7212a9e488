"""Statics of the whole rod: march the arc-length step along it, and solve for the shape under known loads.

March base to tip: the base wrench alpha = [n(0), m(0)] is given and the tip need not be in equilibrium: the estimator's model.
March tip to base: the wrench is known at the tip (there is nothing beyond it), so only the tip's orientation is unknown, and
not even that when no load keeps its direction in the base frame; this is the forward solve.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import debug_unwrap

from ..util.by_value import Kept, key
from ..util.errors import InputError
from ..util.precision import as_float64
from ..util.status import Status
from .grid import DEFAULT_STEPS, Grid, Places, make_grid, on_rod
from .integrate import march, march_linearized, states_at, with_theta
from .lie import Quaternion, Vector, cross, identity_quaternion, inverse3, logarithm, matvec, rotate, turned
from .loads import Load, LoadIntegrals, taken, total
from .robot import Robot
from .section import MATRICES, STATE, STATE_PARTS, Section, StageTable, State, section_wrench
from .stability import conjugate_points, follow
from .tendons import strains_settled
from .tip_problem import ORIENTATION_TOLERANCE, SETTLED, TipProblem, newton, newton_with_turning, turning, with_turning

ROUGH_TOLERANCE = 1e-5  # rad: enough where a filter starts
LOAD_PER_INCREMENT = 2.0  # in EI / L^2: world-frame loads beyond this are put on in increments, to stay on the principal branch
MOST_INCREMENTS = 100
MOST_LOAD = 5e3  # in EI / L^2: beyond it the rod is a rope, which no march from the tip can follow in double precision
STEP_TOLERANCE = 5e-6  # of L: what the steps may leave of error in a place
MOST_STEPS = 5120
FINE_WAVE, FINE_TURN = 0.1, 0.2  # rad per step: loads below are followed to STEP_TOLERANCE by the steps that the rod itself needs
SAMPLE_STEPS = 40_000  # solved at once on finer grids: what bounds the memory
LEAST_PIECES, MOST_PIECES = 6, 400
UNSOLVED_FINER = 4  # times as many steps are tried once for what was not solved
PER_SAMPLE = ("p", "q", "base_wrench", "status", "residual", "iterations", "stable", "resolved")  # of Equilibrium
KEPT_STEPS = 256  # robots and marker layouts


def stage_table(robot: Robot, loads: tuple[Load, ...], tension: Float[Tensor, "... T"] | None, grid: Grid | Places) -> StageTable:
    """All that is known along the rod, at the stages of every step of the grid. tension: (..., T) readings, N."""
    s, inside = grid.stages, grid.inside
    integrals, rod = total(loads, s, inside) + robot.weight_beyond(s, inside), robot.rod
    tendons = None
    if len(robot.tendons) and tension is not None:
        tau = robot.tendons.true_tension(tension)
        newton = robot.tendons.newton_steps(*rod.sampled_stiffness, tau)
        tendons = robot.tendons.table(s, inside, tau[..., None, None, :], newton)
    section = None if rod.pieces is None else Section.of(*rod.pieces.stiffness(rod.K_se, rod.K_bt, s, inside))
    return StageTable(integrals, rod.curvature_at(s, inside), tendons, section)


def grid_for(robot: Robot, loads: tuple[Load, ...], outputs: Float[Tensor, " P"], steps: int) -> Grid:
    """The grid that serves this robot, these loads and these output arc lengths (m)."""
    jumps = [b for b in (load.breakpoints() for load in loads) if b is not None]
    leading = np.broadcast_shapes(*(b.shape[:-1] for b in jumps))  # torch's own imports sympy: half a second
    breakpoints = torch.cat([b.expand(*leading, -1) for b in jumps], -1) if jumps else None
    return make_grid(
        robot.rod.length,
        outputs,
        robot.tendons.knots + robot.rod.knots,
        breakpoints,
        steps,
        None if robot.rod.straight else robot.rod.curvature_at,
    )


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

    q: the section's orientation in the base frame, unit quaternions (x, y, z, w). p: base frame. tip_q: (..., 4), the orientation
    of the last section. wrench: (..., P, 6), [N~ (N), M~ (N m)] of mechanics.section (1). turned: (..., P, T) rad, Theta of every
    tendon where they rub, else of none.
    """

    p: Float[Tensor, "... P 3"]
    q: Float[Tensor, "... P 4"]
    tip_residual: Float[Tensor, "... 6"]
    tip_q: Float[Tensor, "... 4"]
    wrench: Float[Tensor, "... P 6"]
    turned: Float[Tensor, "... P T"]


def shape_of(section: Section, states: Float[Tensor, "... P1 w"], beyond: LoadIntegrals) -> Shape:
    """The shape at the first P states; the tip residual (17) from the last, the wrench carried just beyond the tip:

    c = [N~ - G, M~ + e3 x G2 - Gm] at s = L+, zero in equilibrium
    """
    p, q, N, M = states[..., :STATE].split(STATE_PARTS, -1)
    c = section_wrench(q[..., -1, :], N[..., -1, :], M[..., -1, :], section.e3, beyond)
    wrench, turned = states[..., :-1, 7:STATE], states[..., :-1, STATE:]
    return Shape(p[..., :-1, :], q[..., :-1, :], torch.cat(c, -1), q[..., -1, :], wrench, turned)


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
    y, at = with_theta(base_state(robot, alpha, table), table), grid.outputs_and_tip
    if differentiable:
        states = states_at(march(section, y, table, grid), at)
    else:
        states, _ = march_linearized(section, y, y.new_zeros(*y.shape, 0), table, None, grid, at)
    return shape_of(section, states, beyond_tip(robot, loads, alpha))


@dataclass(frozen=True)
class Equilibrium:
    """The forward solve's answer, one entry per sample.

    s: (P,) m. p: (B, P, 3) m and q: (B, P, 4), unit quaternions (x, y, z, w), both in the base frame. base_wrench: (B, 6) = [n(0)
    N, m(0) N m], the whole section's. status: (B,) Status codes; residual: (B,) rad, the angle by which the base misses its clamp;
    iterations: (B,). stable: (B,), whether a rod would stay there (mechanics.stability). resolved: (B,), whether the steps follow
    the load. A sample that is not all of these holds NaN, is NOT_CONVERGED and has disturbed nobody.
    """

    s: Float[Tensor, " P"]
    p: Float[Tensor, "B P 3"]
    q: Float[Tensor, "B P 4"]
    base_wrench: Float[Tensor, "B 6"]
    status: Int[Tensor, " B"]
    residual: Float[Tensor, " B"]
    iterations: Int[Tensor, " B"]
    stable: Bool[Tensor, " B"]
    resolved: Bool[Tensor, " B"]

    def take(self, index: Tensor) -> "Equilibrium":
        """The samples of an index or a mask."""
        return replace(self, **{name: getattr(self, name)[index] for name in PER_SAMPLE})

    @property
    def only_unstable(self) -> Bool[Tensor, " B"]:
        """Where an equilibrium was found, but none that a rod would stay in."""
        return (self.status != int(Status.CONVERGED)) & (self.residual <= 10 * ROUGH_TOLERANCE) & ~self.stable


@dataclass(frozen=True)
class _Sizes:
    """How much a section carries, per sample: of loads that keep their direction (dead), and of the others.

    The largest force (N) and moment (N m), and what (4) of mechanics.stability makes of them all along (N m^2).
    """

    dead_force: Float[Tensor, " B"]
    dead_moment: Float[Tensor, " B"]
    force: Float[Tensor, " B"]
    moment: Float[Tensor, " B"]
    dead_softening: Float[Tensor, " B"]
    softening: Float[Tensor, " B"]

    @classmethod
    def of(cls, problem: TipProblem, length: float) -> "_Sizes":
        """From the integrals of the loads at the start of every step; m(s) is at most the forces beyond s with their levers."""
        loads, zero = problem.table.loads, torch.zeros(len(problem.wrench), 1, dtype=problem.wrench.dtype)
        N, M = problem.wrench.detach().split(3, -1)
        nodes = problem.grid.nodes.detach()
        h, end = nodes.diff(dim=-1), nodes[..., 1:]

        def sizes(x: Vector | None) -> Float[Tensor, "B S"]:
            found = zero if x is None else zero + x.detach()[..., 0, :].norm(dim=-1)
            return found.expand(-1, h.shape[-1])

        def softening(n: Float[Tensor, "B S"], m: Float[Tensor, "B S"]) -> Float[Tensor, " B"]:
            return (n * end * h).sum(-1) + (m.square() * end * h).sum(-1).sqrt()

        def levered(n: Float[Tensor, "B S"]) -> Float[Tensor, "B S"]:
            return (n * h).flip(-1).cumsum(-1).flip(-1)

        n, m = sizes(loads.Wn), sizes(loads.Wm)
        G = sizes(N[:, None, None, :] if loads.G is None else N[:, None, None, :] - loads.G)  # what lies beyond a section
        Gm = torch.maximum(sizes(loads.Gm), M.norm(dim=-1, keepdim=True) if loads.G is None else 0 * zero)
        largest_n, largest_G = n.amax(-1), G.amax(-1)
        return cls(
            largest_n,
            largest_n * length + m.amax(-1),
            largest_G,
            torch.maximum(largest_G * length + Gm.amax(-1), M.norm(dim=-1)),
            softening(n, levered(n) + m),
            softening(G, levered(G) + Gm),
        )

    def in_units(self, robot: Robot) -> Float[Tensor, " B"]:
        """Loads of the base frame, in EI / L^2."""
        L, EI = robot.rod.length, robot.rod.bending_stiffness
        n, m = self.dead_force, self.dead_moment - L * self.dead_force
        return ((n * L * L + m * L) / EI).nan_to_num(0.0, torch.inf)

    def unique_below(self, robot: Robot) -> Float[Tensor, " B"]:
        """The fraction of the base frame's loads up to which (4) of mechanics.stability holds."""
        return ((robot.rod.softest - self.softening) / self.dead_softening.clamp(min=1e-300)).clamp(min=0.0)

    def pieces(self, robot: Robot) -> int:
        """Into how many the rod is cut to count its conjugate points: a piece is short beside the waves that the loads make."""
        L, K = robot.rod.length, robot.rod.softest
        waves = ((self.dead_force + self.force) / K).sqrt() + (self.dead_moment + self.moment) / K
        waves = (L * waves).nan_to_num(0.0, 0.0)
        return LEAST_PIECES + min(MOST_PIECES, math.ceil(float(waves.max()) if len(waves) else 0.0))

    def fine(self, robot: Robot, tension: Float[Tensor, "... T"] | None, steps: int) -> Bool[Tensor, " B"]:
        """Whether so many steps surely follow the loads.

        Under a force n the shape waves, or grows, with sqrt(n / K); under a moment m it turns with m / K.
        """
        h, K = robot.rod.length / steps, robot.rod.softest
        force, moment = self.dead_force + self.force, self.dead_moment + self.moment
        if tension is not None and len(robot.tendons):
            reach = max(max(x * x + y * y for _, x, y in t.routing) for t in robot.tendons.tendons) ** 0.5
            moment = moment + reach * robot.tendons.true_tension(tension.detach()).sum(-1)
        return (h * (force / K).sqrt() <= FINE_WAVE) & (h * moment / K <= FINE_TURN)


def _increments(load: Float[Tensor, " B"]) -> Int[Tensor, " B"]:
    """How many increments put on loads of this size (EI / L^2): so many that each is below LOAD_PER_INCREMENT."""
    return (load.clamp(max=MOST_LOAD) / LOAD_PER_INCREMENT).ceil().clamp(1, MOST_INCREMENTS).to(torch.int64)


def _tensors(robot: Robot, loads: tuple[Load, ...], *more: Tensor | None) -> list[Tensor]:
    pieces = () if robot.rod.pieces is None else vars(robot.rod.pieces).values()
    values = [robot.gravity, *vars(robot.rod).values(), *pieces, *(x for load in loads for x in vars(load).values()), *more]
    return [x for x in values if isinstance(x, Tensor)]


def _asked_for_gradients(tensors: list[Tensor]) -> bool:
    """Whether autograd is to see the solve. Errors: InputError for torch.func and forward mode, which it has no rule for."""
    if any(debug_unwrap(x) is not x or forward_ad.unpack_dual(x).tangent is not None for x in tensors):
        raise InputError(
            "solve_shape has no torch.func transform and no forward mode; call backward or torch.autograd.grad instead"
        )
    return torch.is_grad_enabled() and any(x.requires_grad for x in tensors)


def solve_shape(
    robot: Robot,
    loads: tuple[Load, ...],
    tension: Float[Tensor, "B T"] | None,
    outputs: Float[Tensor, " P"],
    batch: int,
    steps: int | None = None,
    tolerance: float = ORIENTATION_TOLERANCE,
    q_tip: Float[Tensor, "B 4"] | None = None,
) -> Equilibrium:
    """The forward solve: the shape of `batch` samples under known loads and tensions, and the wrench at their base.

    Marches tip to base and turns the tip until the base sits in its clamp, R(0) = I: at once without base-frame loads, by damped
    Newton on three numbers with them, until the base misses it by less than the tolerance (rad). The base frame's loads are put on
    in increments, on the branch of stable equilibria that begins without load, and where that ends on another
    (mechanics.stability). Loads (B, ...) in their own frames and units (mechanics.loads), tension N, outputs m. q_tip: where to
    look for the tip's orientation, with all of the load at once.
    steps: None takes as many as leave less than STEP_TOLERANCE of L in every place; a number takes these, whatever they leave.
    Where an input requires grad, first derivatives of the answer are exact (implicit function theorem, torch path).
    Errors: ValueError for outputs off the rod, InputError under transforms of torch.func. A sample that cannot be solved has status
    NOT_CONVERGED; one that holds NaN, or a point load off the rod, INVALID.
    Source: docs/model.md.
    """
    outputs, q_tip = as_float64(outputs), as_float64(q_tip)
    gradients = _asked_for_gradients(_tensors(robot, loads, tension, outputs))
    first = steps or steps_of_rod(robot, outputs)
    answer = _solve(robot, loads, tension, outputs, batch, first, tolerance, q_tip, gradients)
    if steps is not None:
        return answer.equilibrium
    return _refined(robot, loads, tension, answer, first, tolerance, gradients)[0]


def steps_for(
    robot: Robot,
    outputs: Float[Tensor, " P"],
    tension: Float[Tensor, "B T"] | None = None,
    loads: tuple[Load, ...] = (),
    batch: int = 1,
) -> int:
    """The least number of steps that leaves less than STEP_TOLERANCE of L in every place, at outputs (m), for all of `batch`
    samples.

    Without loads and tensions it is worked out once for a robot and its outputs, and kept by their values.
    """
    outputs = as_float64(outputs)
    first = steps_of_rod(robot, outputs)
    with torch.no_grad():
        answer = _solve(robot, loads, tension, outputs, batch, first, ORIENTATION_TOLERANCE, None, False)
        return _refined(robot, loads, tension, answer, first, ORIENTATION_TOLERANCE, False)[1]


def needs_finer(
    robot: Robot,
    loads: tuple[Load, ...],
    tension: Float[Tensor, "B T"] | None,
    outputs: Float[Tensor, " P"],
    batch: int,
    steps: int,
) -> Bool[Tensor, " B"]:
    """Samples whose loads so many steps might not follow to STEP_TOLERANCE; steps_for tells."""
    with torch.no_grad():
        problem = _problem(robot, loads, tension, outputs, batch, steps)
        return ~_Sizes.of(problem, robot.rod.length).fine(robot, tension, steps)


_steps_kept = Kept(KEPT_STEPS)


def steps_of_rod(robot: Robot, outputs: Float[Tensor, " P"]) -> int:
    """What the reference shape alone asks for."""
    rod = robot.rod
    if rod.straight:
        return DEFAULT_STEPS

    def work_out() -> int:
        with torch.no_grad():
            bare = Robot(replace(rod, reference_curvature=rod.reference_curvature.detach(), masses=rod.masses.detach()))
            answer = _solve(bare, (), None, outputs.detach(), 1, DEFAULT_STEPS, ORIENTATION_TOLERANCE, None, False)
            return _halved(bare, (), None, answer, torch.tensor([0]), DEFAULT_STEPS, ORIENTATION_TOLERANCE, False)[1]

    return _steps_kept(key((rod.length, rod.reference_curvature, rod.knots, outputs)), work_out)


@dataclass(frozen=True)
class _Solved:
    """An answer on one grid. q_tip: (B, 4). sure: (B,), whether the grid is fine enough without trying a finer one."""

    equilibrium: Equilibrium
    q_tip: Float[Tensor, "B 4"]
    sure: Bool[Tensor, " B"]


def _refined(
    robot: Robot,
    loads: tuple[Load, ...],
    tension: Float[Tensor, "B T"] | None,
    answer: _Solved,
    steps: int,
    tolerance: float,
    gradients: bool,
) -> tuple[Equilibrium, int]:
    """The answer with more steps for the samples that need them, and the most that were taken."""
    unsure = (~answer.sure & (answer.equilibrium.status != int(Status.INVALID))).nonzero().squeeze(-1)
    if not len(unsure):
        return answer.equilibrium, steps
    return _halved(robot, loads, tension, answer, unsure, steps, tolerance, gradients)


def _halved(
    robot: Robot,
    loads: tuple[Load, ...],
    tension: Float[Tensor, "B T"] | None,
    answer: _Solved,
    unsure: Int[Tensor, " b"],
    steps: int,
    tolerance: float,
    gradients: bool,
) -> tuple[Equilibrium, int]:
    """Halve the steps of some samples until their places move by less than STEP_TOLERANCE of L.

    RK4 leaves a sixteenth of its error on half the step, so that the change is the error of the coarser answer, to 7 %.
    """

    def waiting(index: Int[Tensor, " b"], n: int, q: Float[Tensor, "b 4"]) -> list[tuple[Tensor, int, Tensor]]:
        """What was solved begins from there, what was not from the start."""
        solved = found.status[index] == int(Status.CONVERGED)
        return [(index[at], n, q[at]) for at in (solved, ~solved) if bool(at.any())]

    found, most = answer.equilibrium, steps
    pending = waiting(unsure, steps, answer.q_tip[unsure])
    allowed = STEP_TOLERANCE * robot.rod.length
    while pending:
        index, n, q = pending.pop()
        started = bool((found.status[index] == int(Status.CONVERGED)).all())
        m = 2 * n if started else UNSOLVED_FINER * n
        room = max(1, SAMPLE_STEPS // m)
        if len(index) > room:
            pending += [(i, n, x) for i, x in zip(index.split(room), q.split(room), strict=True)]
            continue
        finer = _solve_some(robot, loads, tension, found, index, m, tolerance, q if started else None, gradients)
        error = (finer.equilibrium.p - found.p[index]).detach().norm(dim=-1).amax(-1).nan_to_num(torch.inf, torch.inf)
        fails = finer.equilibrium.status != int(Status.CONVERGED)
        kept = (error <= allowed) | (fails & (not started))
        better = ~kept & ((error / 16 <= allowed / 4) & (error <= 1e-2 * robot.rod.length))
        found = replaced(found, finer.equilibrium.take(~kept), index[~kept])
        most = max(most, n if bool(kept.all()) else m)
        more = (~kept & ~better).nonzero().squeeze(-1)
        if len(more) and 2 * m <= MOST_STEPS:
            pending += waiting(index[more], m, finer.q_tip[more])
        elif len(more):
            found = _unresolved(found, index[more])
    return found, most


def _solve_some(
    robot: Robot,
    loads: tuple[Load, ...],
    tension: Float[Tensor, "B T"] | None,
    found: Equilibrium,
    index: Int[Tensor, " b"],
    steps: int,
    tolerance: float,
    q_tip: Float[Tensor, "b 4"] | None,
    gradients: bool,
) -> _Solved:
    """The samples of an index on a grid of their own; all of them where a load cannot be divided."""
    B, some = len(found.status), taken(loads, index)
    if some is None and len(index) < B:
        whole = _solve(robot, loads, tension, found.s, B, steps, tolerance, None, gradients)
        return _Solved(whole.equilibrium.take(index), whole.q_tip[index], whole.sure[index])
    part = replace(robot, gravity=robot.gravity[index]) if robot.gravity.ndim > 1 and len(robot.gravity) == B else robot
    own = tension[index] if tension is not None and len(tension) == B else tension
    return _solve(part, loads if some is None else some, own, found.s, len(index), steps, tolerance, q_tip, gradients)


def replaced(e: Equilibrium, new: Equilibrium, index: Int[Tensor, " b"]) -> Equilibrium:
    """e with other answers for the samples of an index."""
    return replace(e, **{n: getattr(e, n).index_copy(0, index, getattr(new, n)) for n in PER_SAMPLE})


def _unresolved(e: Equilibrium, index: Int[Tensor, " b"]) -> Equilibrium:
    """No number of steps is enough for these."""

    def lost(x: Tensor) -> Tensor:
        return x.index_fill(0, index, torch.nan)

    status = e.status.clone()
    status[index] = torch.where(status[index] == int(Status.INVALID), status[index], int(Status.NOT_CONVERGED))
    return replace(
        e, p=lost(e.p), q=lost(e.q), base_wrench=lost(e.base_wrench), status=status, resolved=e.resolved.index_fill(0, index, False)
    )


def _problem(
    robot: Robot, loads: tuple[Load, ...], tension: Float[Tensor, "B T"] | None, outputs: Float[Tensor, " P"], B: int, steps: int
) -> TipProblem:
    grid = grid_for(robot, loads, outputs, steps)
    table = stage_table(robot, loads, tension, grid)
    section = Section.of(robot.rod.K_se, robot.rod.K_bt)
    beyond = beyond_tip(robot, loads, outputs)
    zero = outputs.new_zeros(B, 3)
    # At L+ the section carries nothing: N = M = 0 in (1), hence N~ = G and M~ = Gm - e3 x G2 there.
    N = zero if beyond.G is None else zero + beyond.G
    M = zero if beyond.G2 is None else zero - cross(section.e3, beyond.G2)
    wrench = torch.cat([N, M if beyond.Gm is None else M + beyond.Gm], -1)
    for place in (load.breakpoints() for load in loads):
        if place is not None:  # torch has no exception for a sample: NaN makes it INVALID
            wrench = torch.where(on_rod(place, robot.rod.length).all(-1, keepdim=True), wrench, torch.nan)
    rubbing = None if table.tendons is None or table.tendons.friction is None else zero.new_zeros(B, len(robot.tendons))
    return TipProblem(section, table, grid, wrench, rubbing)


def _detached(problem: TipProblem) -> TipProblem:
    parts = (getattr(problem.section, n).detach() for n in (*MATRICES, "e3"))
    grid = Grid(problem.grid.nodes.detach(), problem.grid.outputs)
    return TipProblem(Section(*parts), problem.table.detached(), grid, problem.wrench.detach(), problem.turned)


def _solve(
    robot: Robot,
    loads: tuple[Load, ...],
    tension: Float[Tensor, "B T"] | None,
    outputs: Float[Tensor, " P"],
    B: int,
    steps: int,
    tolerance: float,
    q_tip: Float[Tensor, "B 4"] | None,
    gradients: bool,
) -> _Solved:
    """solve_shape on one grid."""
    whole = _problem(robot, loads, tension, outputs, B, steps)
    with torch.no_grad():
        problem = _detached(whole) if gradients else whole
        sizes = _Sizes.of(problem, robot.rod.length)
        q, one = identity_quaternion((B,), problem.wrench[:, :3]), torch.ones_like(problem.wrench[:, 0])
        dead = problem.table.loads.Wn is not None or problem.table.loads.Wm is not None
        if q_tip is None or not dead:
            r, _ = problem.base(q, q.new_zeros(B, 4, 0), 0 * one)
            q = turned(-r, q)  # exact where no load keeps its direction in the base frame
        if problem.turned is not None:  # what they turn by if they had not, up to the tip: nearer than nothing
            states, _ = problem.march(
                q, q.new_zeros(B, 4, 0), one, torch.zeros(*problem.grid.nodes.shape[:-1], 1, dtype=torch.int64)
            )
            problem = replace(problem, turned=-states[:, 0, STATE:].nan_to_num(0.0))
        residual, iterations, stable = 0 * one, torch.zeros(B, dtype=torch.int64), torch.ones(B, dtype=torch.bool)
        valid = torch.isfinite(q).all(-1) if q_tip is None else torch.isfinite(q_tip).all(-1)
        if dead:
            load, unique = sizes.in_units(robot), sizes.unique_below(robot)
            if q_tip is None:
                live = torch.isfinite(q).all(-1) & (load <= MOST_LOAD)
                pieces = sizes.pieces(robot)
                q, residual, iterations, stable = follow(problem, q, _increments(load), unique, live, pieces, tolerance)
                residual = torch.where(live, residual, torch.inf)
            else:
                q, residual, iterations = newton(problem, q_tip, one, tolerance * one)
                stable = _stable(problem, q, unique, sizes.pieces(robot))
        if problem.turned is not None:
            start = residual
            problem, q, residual, more = newton_with_turning(problem, q, one, tolerance)
            residual, iterations = torch.where(torch.isfinite(start), residual, start), iterations + more
            if dead:
                stable = stable & _stable(problem, q, sizes.unique_below(robot), sizes.pieces(robot))
            whole = replace(whole, turned=problem.turned)
    equilibrium = _equilibrium(
        whole, problem, q, residual, iterations, stable, valid if dead else None, outputs, tolerance, gradients
    )
    sure = sizes.fine(robot, tension, steps)
    return _Solved(equilibrium, q, sure)


def _stable(problem: TipProblem, q: Float[Tensor, "B 4"], unique: Float[Tensor, " B"], pieces: int) -> Bool[Tensor, " B"]:
    """Whether nothing is conjugate to the tip, for the samples whose loads could make it so."""
    stable, doubtful = torch.ones(len(q), dtype=torch.bool), (unique < 1).nonzero().squeeze(-1)
    if len(doubtful):
        Theta, _ = problem.take(doubtful).turns(q[doubtful], torch.ones_like(unique[doubtful]), pieces)
        stable[doubtful] = conjugate_points(Theta) == 0
    return stable


def stable_at(
    robot: Robot,
    loads: tuple[Load, ...],
    tension: Float[Tensor, "B T"] | None,
    q_tip: Float[Tensor, "B 4"],
    steps: int = DEFAULT_STEPS,
) -> Bool[Tensor, " B"]:
    """Whether equilibria found by other means, whose tips have the orientation q_tip in the base frame, are stable.

    Loads and tension as in solve_shape, whatever acts on the tip included. True where nothing can be unstable: without loads that
    keep their direction in the base frame.
    """
    outputs = q_tip.new_tensor([robot.rod.length])
    with torch.no_grad():
        problem = _problem(robot, loads, tension, outputs, len(q_tip), steps)
        if problem.table.loads.Wn is None and problem.table.loads.Wm is None:
            return torch.ones(len(q_tip), dtype=torch.bool)
        sizes = _Sizes.of(problem, robot.rod.length)
        return _stable(problem, q_tip, sizes.unique_below(robot), sizes.pieces(robot))


def _marched(whole: TipProblem, problem: TipProblem, q_tip: Quaternion) -> Float[Tensor, "B P1 state"]:
    """The states at the outputs and the base, with their first derivatives.

    The tip's orientation solves r(q, theta) = 0, so that dq = -J^-1 dr: one more Newton step from the solution, J held, has just
    that.
    """
    one, at = torch.ones_like(q_tip[:, 0]), whole.grid.outputs_and_base
    _, J = problem.base(q_tip, turning(q_tip), one) if problem.turned is None else with_turning(problem, q_tip, one)
    J_inverse = inverse3(J) if problem.turned is None else torch.linalg.inv(J)

    def states(at_tip: TipProblem, q: Quaternion) -> Float[Tensor, "B P1 c"]:
        return states_at(march(whole.section, at_tip.tip_state(q), whole.table, whole.grid, reverse=True), at)

    base = states(whole, q_tip)[:, -1]
    move = -matvec(J_inverse, torch.cat([logarithm(base[:, 3:7]), base[:, STATE:]], -1))
    moved = whole if whole.turned is None else replace(whole, turned=whole.turned + move[:, 3:])
    return states(moved, turned(move[:, :3], q_tip))


def _equilibrium(
    whole: TipProblem,
    problem: TipProblem,
    q_tip: Quaternion,
    residual: Float[Tensor, " B"],
    iterations: Int[Tensor, " B"],
    stable: Bool[Tensor, " B"],
    valid: Bool[Tensor, " B"] | None,
    outputs: Float[Tensor, " P"],
    tolerance: float,
    gradients: bool,
) -> Equilibrium:
    if gradients:
        states = _marched(whole, problem, q_tip)
    else:
        at = problem.grid.outputs_and_base
        states, _ = problem.march(q_tip, q_tip.new_zeros(len(q_tip), 4, 0), torch.ones_like(residual), at)
        whole = problem
    p, q, N, M = states[..., :STATE].split(STATE_PARTS, -1)
    base = whole.table.step(0).stage(0).loads
    base = LoadIntegrals(Wn=base.Wn, Wm=base.Wm)
    n0, m0 = section_wrench(q[:, -1], N[:, -1], M[:, -1], whole.section.e3, base)
    wrench = torch.cat([rotate(q[:, -1], n0), rotate(q[:, -1], m0)], -1)
    finite = torch.isfinite(states).flatten(1).all(-1)
    at_base = problem.table.step(0).stage(0)
    section = at_base.section or problem.section
    balanced = strains_settled(section.K_se, section.K_bt, section.e3, at_base.u_star, n0.detach(), m0.detach(), at_base.tendons)
    solved = finite & balanced & (residual <= max(10 * tolerance, SETTLED)) & stable
    valid = finite if valid is None else valid  # a march that overflows under dead loads is no fault of the numbers given
    status = torch.full_like(iterations, int(Status.NOT_CONVERGED))
    status = torch.where(solved, int(Status.CONVERGED), torch.where(valid, status, int(Status.INVALID)))
    keep = solved[:, None, None]
    return Equilibrium(
        outputs,
        torch.where(keep, p[:, :-1] - p[:, -1:], torch.nan),
        torch.where(keep, q[:, :-1], torch.nan),
        torch.where(solved.unsqueeze(-1), wrench, torch.nan),
        status,
        residual,
        iterations,
        stable & solved,
        torch.ones_like(solved),
    )
