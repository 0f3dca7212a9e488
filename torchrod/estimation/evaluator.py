"""How a problem is evaluated: by the compiled kernel where it serves, else by the torch model, which is the definition.

`evaluator` chooses once for each problem; whoever holds an Evaluator does not ask which one it is. The kernel serves markers on any
robot of one section under the load families of model.load_families; other sensors, markers with covariances or uncertain arc
lengths, and load families of a user's own, go through the torch model with a compiled march.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .. import kernel
from ..mechanics.grid import Grid
from ..mechanics.integrate import known
from ..mechanics.loads import total
from ..mechanics.section import Section
from ..mechanics.statics import beyond_tip, grid_for, stage_table
from ..model.load_families import FourierCoordinates, GaussianCoordinates, PaperCoordinates, PointCoordinates, SmoothCoordinates
from ..model.load_families.family import FAINT
from ..model.problem import SLACK, TIP_ROWS, Problem
from ..model.uncertainty import Warp, near_zero
from ..util.by_value import Kept, key
from . import filter as ekf

_layouts = Kept(256)  # of every robot near one whose parameters are only nearly known, on two grids


@runtime_checkable
class Evaluator(Protocol):
    """A problem made ready for the filter, which evaluates it many times.

    problem: with B samples. nu: degrees of freedom of Student's t, by which outliers weigh little; inf: a normal distribution.
    """

    @property
    def problem(self) -> Problem:
        """What is evaluated."""
        ...

    @property
    def nu(self) -> float:
        """Degrees of freedom of Student's t."""
        ...

    def take(self, index: Int[Tensor, " b"]) -> "Evaluator":
        """The samples of an index."""
        ...

    def h(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B z"]:
        """See Problem."""
        ...

    def linearized(self, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"]]:
        """See Problem."""
        ...

    def cost(self, x: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
        """The cost of (3) with the prior's, r^T W r + (x0 - x)^T P (x0 - x)."""
        ...

    def sums(self, x: Float[Tensor, "B n"]) -> kernel.Sums:
        """At x: the normal equations, the residuals and the centre line (m, the rod's own frame)."""
        ...

    def posterior(self, sums: kernel.Sums, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B n n"], Float[Tensor, " B"]]:
        """From the sums at x: the covariance, in equilibrium, and the cost of (3) with the prior: see filter.Normal.posterior."""
        ...

    def iteration(self, run: "Run", limits: ekf.Limits) -> Callable[[Int[Tensor, " b"]], None]:
        """One iteration of the filter on some samples of a run, in place; run.at.done then says which of them are done."""
        ...

    def iterate_all(
        self, fine: "Evaluator", run: "Run", limits: tuple[ekf.Limits, ekf.Limits], live: Int[Tensor, " b"], most: int
    ) -> tuple[Bool[Tensor, " B"], Int[Tensor, " B"]] | None:
        """All iterations in one call, by this evaluator until a sample is near, then by `fine`; None where that cannot be done.

        Returns which samples have converged, and how many iterations each has had. run.near changes in place.
        """
        ...


@dataclass(frozen=True)
class Run:
    """The filter's state on B samples, changed in place: the iterate, what it began from, and the sums of samples that are done.

    near (B,): whether a sample is near enough to the data for the fine model.
    """

    at: ekf.Iterate
    Sigma0: Float[Tensor, "B n n"]
    Q: Float[Tensor, " n"]
    sums: kernel.Sums
    near: Bool[Tensor, " B"]


def evaluator(problem: Problem, nu: float = math.inf) -> Evaluator:
    """The evaluator that serves a problem, which keeps it."""
    kept = vars(problem).setdefault("_evaluators", {})
    if nu not in kept:
        kept[nu] = _made(problem, nu)
    return kept[nu]


def _made(problem: Problem, nu: float) -> Evaluator:
    if kernel_serves(problem):
        return KernelEvaluator(problem, nu)
    if problem.state.parameters.size and kernel_serves(problem.exact):
        return NearlyKnownEvaluator(problem, nu)
    return TorchEvaluator(problem, nu)


def kernel_serves(problem: Problem) -> bool:
    """Whether the kernel can do the fit.

    Nodes that move with a point load take along neither a section nor a curvature nor a routing that vary.
    """
    robot, family, markers = problem.robot, family_of(problem), problem.markers
    if markers is None or not markers.isotropic or problem.state.parameters.size or problem.warp is not None:
        return False
    if family is None or robot.rod.K_se.ndim != 2 or len(robot.tendons) > kernel.MOST_TENDONS:
        return False
    if problem.state.tension.size and any(t.tension_gain != 1 for t in robot.tendons.tendons):
        return False  # the kernel adds an error of the tension, not of the reading
    if family == "point":
        straight = all(len(t.routing) == 1 and not t.discs for t in robot.tendons.tendons)
        return kernel.available() and straight and len(robot.rod.reference_curvature) == 1 and robot.rod.pieces is None
    return kernel.available()


def family_of(problem: Problem) -> str | None:
    """Which of the kernel's load families serves the problem's; None: none does."""
    c = problem.unknowns.loads
    if c.size == 0:
        return "none"
    if isinstance(c, GaussianCoordinates | PaperCoordinates):
        return "gaussian" if isinstance(c, GaussianCoordinates) else "paper"
    if isinstance(c, FourierCoordinates | SmoothCoordinates) or (isinstance(c, PointCoordinates) and c.locations is not None):
        return "linear"
    return "point" if isinstance(c, PointCoordinates) else None


@dataclass(frozen=True)
class TorchEvaluator:
    """By Problem.h and Problem.linearized: the definition."""

    problem: Problem
    nu: float = math.inf

    def take(self, index: Int[Tensor, " b"]) -> "TorchEvaluator":
        """The samples of an index."""
        return replace(self, problem=self.problem.take(index))

    def residual(self, h: Float[Tensor, "B z"]) -> Float[Tensor, "B z"]:
        """r = z - h(x), zero where nothing was read."""
        return torch.where(self.problem.weights > 0, self.problem.reading - h, 0.0)

    def h(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B z"]:
        """See Problem."""
        return self.problem.h(x, differentiable=False)

    def linearized(self, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"]]:
        """See Problem."""
        return self.problem.linearized(x)

    def cost(self, x: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
        """See Evaluator."""
        problem, m = self.problem, len(self.problem.groups)
        square = problem.weights * self.residual(self.h(x)) ** 2
        sensors, _ = ekf.sensors_cost(square[:, :m], problem.groups, self.nu)
        return sensors + square[:, m:].sum(-1) + (problem.precision * (problem.mean - x) ** 2).sum(-1)

    def sums(self, x: Float[Tensor, "B n"]) -> kernel.Sums:
        """See Evaluator."""
        problem = self.problem
        h, H = self.linearized(x)
        r = self.residual(h)
        N = ekf.normal_equations(H, r, problem.weights, problem.groups, self.nu)
        C = H[:, len(problem.groups) :].contiguous()
        return kernel.Sums(N.A, N.g, N.cost, C, r, self.line(x))

    def line(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B P 3"]:
        """The centre line (m, the rod's own frame)."""
        return self.problem.shape(x, differentiable=False).p

    def posterior(self, sums: kernel.Sums, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B n n"], Float[Tensor, " B"]]:
        """See Evaluator."""
        problem = self.problem
        return normal(problem, sums).posterior(x, problem.mean, problem.precision, problem.exact_tip)

    def iteration(self, run: Run, limits: ekf.Limits) -> Callable[[Int[Tensor, " b"]], None]:
        """See Evaluator."""

        def once(live: Int[Tensor, " b"]) -> None:
            part, here = self.take(live), run.at.take(live)
            found = part.sums(here.x)
            prior = part.problem.mean, part.problem.precision
            run.at.put(live, ekf.advance(here, normal(part.problem, found), run.Sigma0[live], prior, run.Q, limits))
            run.sums.put(live, found)

        return once

    def iterate_all(self, fine: Evaluator, run: Run, limits, live: Int[Tensor, " b"], most: int) -> None:
        """None: step by step."""


def normal(problem: Problem, sums: kernel.Sums) -> ekf.Normal:
    """The normal equations as estimation.filter has them."""
    return ekf.Normal(sums.A, sums.g, sums.cost, problem.seen, ekf.TipCondition.of(sums.C, sums.r[:, -TIP_ROWS:]))


@dataclass(frozen=True)
class KernelEvaluator:
    """By the compiled kernel, held to TorchEvaluator by tests/test_fit.py."""

    problem: Problem
    nu: float = math.inf

    def take(self, index: Int[Tensor, " b"]) -> "KernelEvaluator":
        """The samples of an index."""
        part = KernelEvaluator(self.problem.take(index), self.nu)
        vars(part.problem)["_layout"] = vars(self.problem).get("_layout")  # the same for all samples
        return part

    @cached_property
    def _fixed(self) -> kernel.FitTables:
        return _tables(self.problem, self.nu, None, self.problem.weights)

    @cached_property
    def _moving(self) -> bool:
        """Whether the tables depend on where x has come to: point loads at unknown places move the nodes."""
        return family_of(self.problem) == "point"

    def tables(self, x: Float[Tensor, "B n"]) -> kernel.FitTables:
        """What the kernel is handed, for all samples."""
        return _tables(self.problem, self.nu, x, self.problem.weights) if self._moving else self._fixed

    def cost(self, x: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
        """See Evaluator."""
        t = self.tables(x)  # which must outlive the call: the structure holds bare addresses
        return kernel.cost_now(x, self.problem.mean, self.problem.precision, t.structure)

    def sums(self, x: Float[Tensor, "B n"]) -> kernel.Sums:
        """See Evaluator."""
        t = self.tables(x)
        return kernel.normal_equations_now(x, t.structure, t.markers)

    def posterior(self, sums: kernel.Sums, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B n n"], Float[Tensor, " B"]]:
        """See Evaluator."""
        return kernel.posterior_now(sums, x, self.problem.mean, self.problem.precision, self.problem.exact_tip)

    def h(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B z"]:
        """See Problem."""
        t = self.tables(x)
        return kernel.measured_now(x, t.structure, t.markers, slopes=False)[0]

    def linearized(self, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"]]:
        """See Problem."""
        t = self.tables(x)
        h, H = kernel.measured_now(x, t.structure, t.markers, slopes=True)
        assert H is not None
        return h, H

    def balance(
        self, gamma: Float[Tensor, "B g"], q_tip: Float[Tensor, "B 4"] | None, increments: int, tolerance: float
    ) -> tuple[Float[Tensor, "B 6"], Float[Tensor, " B"], Float[Tensor, "B P 3"]]:
        """The base wrench (N, N m) in equilibrium under gamma, how far the base is from its clamp (rad), the centre line (m)."""
        x = self.problem.state.join(gamma, gamma.new_zeros(len(gamma), 6))
        t = _tables(self.problem, self.nu, x if self._moving else None, gamma.new_zeros(len(gamma), 0))
        return kernel.balance_now(x, q_tip, increments, tolerance, t.structure, t.markers)

    def _compiled(self, run: Run, limits: ekf.Limits) -> kernel.Iteration:
        filtering = {"Sigma0": run.Sigma0, "mean": self.problem.mean, "precision": self.problem.precision, "Q": run.Q}
        return kernel.Iteration(vars(run.at), filtering, limits._asdict(), run.sums)

    def iteration(self, run: Run, limits: ekf.Limits) -> Callable[[Int[Tensor, " b"]], None]:
        """See Evaluator."""
        call = self._compiled(run, limits)
        return lambda live: call(self.tables(run.at.x), live)

    def iterate_all(
        self, fine: Evaluator, run: Run, limits: tuple[ekf.Limits, ekf.Limits], live: Int[Tensor, " b"], most: int
    ) -> tuple[Bool[Tensor, " B"], Int[Tensor, " B"]] | None:
        """See Evaluator."""
        if self._moving or not isinstance(fine, KernelEvaluator):
            return None
        calls = [(e._compiled(run, own), e.tables(run.at.x)) for e, own in zip((self, fine), limits, strict=True)]
        return kernel.iterate_all(calls[0], calls[1], live, run.near, most)


@dataclass(frozen=True)
class NearlyKnownEvaluator(TorchEvaluator):
    """A robot with parameters that are only nearly known, by the kernel for each of the robots near it (model.uncertainty)."""

    @cached_property
    def _exact(self) -> KernelEvaluator:
        return KernelEvaluator(self.problem.exact, self.nu)

    @cached_property
    def _off(self) -> list[tuple[KernelEvaluator, Warp | None]]:
        """Of every robot nearby; the exact one's own where only the measurement is off."""
        found = []
        for other in self.problem.off:
            plain = replace(other, warp=None)
            vars(plain)["state"] = other.state
            same = other.robot is self.problem.exact.robot
            found.append((self._exact if same else KernelEvaluator(plain, self.nu), other.warp))
        return found

    def take(self, index: Int[Tensor, " b"]) -> "NearlyKnownEvaluator":
        """The samples of an index."""
        part = NearlyKnownEvaluator(self.problem.take(index), self.nu)
        exact = self._exact.take(index)
        off = [(exact if model is self._exact else model.take(index), warp) for model, warp in self._off]
        vars(part)["_exact"], vars(part)["_off"] = exact, off
        return part

    def h(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B z"]:
        """See Problem."""
        plain, theta = self.problem.without_parameters(x)
        exact = self._exact.h(plain)
        off = (_warped(exact if model is self._exact else model.h(plain), warp) for model, warp in self._off)
        return near_zero(exact, off, theta, self.problem.wide)[0]

    def linearized(self, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"]]:
        """See Problem."""
        plain, theta = self.problem.without_parameters(x)
        exact, off = self._exact.linearized(plain), []
        for model, warp in self._off:
            h, H = exact if model is self._exact else model.linearized(plain)
            off.append((_warped(h, warp), H if warp is None else _warped(H.mT, replace(warp, shift=0 * warp.shift)).mT))
        return self.problem.with_parameters(exact, off, theta)

    def line(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B P 3"]:
        """The centre line (m) of the robot as the file has it."""
        plain, _ = self.problem.without_parameters(x)
        return self._exact.sums(plain).line


def _warped(rows: Float[Tensor, "... z"], warp: Warp | None) -> Float[Tensor, "... z"]:
    """Rows of markers, with the tip residual behind them, as they are measured."""
    if warp is None:
        return rows
    p = warp(rows[..., :-TIP_ROWS].unflatten(-1, (-1, 3)))
    return torch.cat([p.flatten(-2), rows[..., -TIP_ROWS:]], -1)


# The kernel's tables.


@dataclass(frozen=True)
class Layout:
    """What stays from shape to shape, by the names of kernel.bindings. active: (S, 3, T), 1 where a tendon pulls."""

    tensors: dict[str, Tensor | None]
    counts: dict[str, int]
    numbers: dict[str, float]
    active: Float[Tensor, "... S 3 T"] | None

    @cached_property
    def shared(self) -> kernel.FitTables | None:
        """For every sample, where none has a row of its own but for its measurements."""
        rows = ((x, kernel.SHARED_DIMENSIONS[name]) for name, x in self.tensors.items() if name in kernel.SHARED_DIMENSIONS)
        if self.active is not None or any(x is not None and x.ndim > d for x, d in rows):
            return None
        return kernel.FitTables.of(self.tensors, self.counts, self.numbers | {"robust": math.inf})


def _basis(problem: Problem, grid: Grid) -> Float[Tensor, "points g 5"]:
    """What one unit of each entry of gamma adds to [G, G2_x, G2_y] at every stage and beyond the tip, for loads linear in it."""
    family = problem.unknowns.loads
    if isinstance(family, PointCoordinates) and family.friction is not None:
        family = replace(family, friction=math.inf)  # the kernel puts in how F_z depends on the rest of the force
    gamma = family.start().unsqueeze(0)

    def integrals(gamma: Float[Tensor, "B g"]) -> Float[Tensor, "B points5"]:
        loads = family.loads(gamma)
        along, tip = total(loads, grid.stages, grid.inside), beyond_tip(problem.robot, loads, gamma.new_zeros(()))
        assert along.G is not None and along.G2 is not None and tip.G is not None and tip.G2 is not None
        G = torch.cat([along.G.flatten(1, 2), tip.G.unsqueeze(1)], 1)
        G2 = torch.cat([along.G2.flatten(1, 2), tip.G2.unsqueeze(1)], 1)
        return torch.cat([G, G2[..., :2]], -1).flatten(1)

    slope = integrals(gamma + torch.eye(family.size, dtype=gamma.dtype)) - integrals(gamma)  # exact: they are linear
    return slope.unflatten(-1, (-1, 5)).movedim(0, 1).contiguous()


def _grid_at(problem: Problem, x: Float[Tensor, "B n"] | None) -> Grid:
    """The grid, of each sample its own where x moves the nodes."""
    family = problem.unknowns.loads
    gamma = family.start().unsqueeze(0) if x is None else x[:, problem.state.loads.at]
    grid = grid_for(problem.robot, family.loads(gamma) if gamma.shape[-1] else (), problem.s, problem.steps)
    return Grid(grid.nodes[0], grid.outputs[0]) if x is None and grid.nodes.ndim == 2 else grid


def _nodes_of(nodes: Float[Tensor, "B S1"], at: Float[Tensor, "B K"]) -> Int[Tensor, "B K"]:
    """Which node each moving place is: of several at one place, the grid has the fixed one first, then the moving ones in order."""
    later = (at.unsqueeze(-1) == at.unsqueeze(-2)).triu(1).sum(-1)
    return torch.searchsorted(nodes.contiguous(), at.contiguous(), right=True) - 1 - later


def _units(problem: Problem) -> dict[str, float]:
    """Units of the entries of x, and the rod's length."""

    def unit(values: Float[Tensor, " k"], i: int) -> float:
        return float(values[i]) if len(values) else 0.0

    state, loads = problem.state, problem.unknowns.loads
    sigmoid = {name: getattr(loads, name, 0.0) for name in ("eps", "beta1", "beta2")}  # of the paper's coordinates
    return sigmoid | {
        "length": problem.robot.rod.length,
        "force_scale": getattr(loads, "force_scale", 1.0),
        "friction": getattr(loads, "friction", None) or 0.0,
        "faint": FAINT,
        "force_unit": unit(state.base.unit, 0),
        "moment_unit": unit(state.base.unit, 3),
        "length_unit": unit(state.registration.unit, 0),
        "angle_unit": unit(state.registration.unit, 3),
        "tension_unit": unit(state.tension.unit, 0),
        "slack": SLACK * unit(state.tension.unit, 0),
    }


def _layout(problem: Problem, x: Float[Tensor, "B n"] | None = None) -> Layout:
    """The robot, its loads and its markers on the grid, with nodes as x has them where it moves them."""
    robot, c, family, state = problem.robot, problem.unknowns.loads, family_of(problem), problem.state
    markers = problem.markers
    assert family is not None and markers is not None
    grid, s = _grid_at(problem, x), problem.s
    section, table = Section.of(robot.rod.K_se, robot.rod.K_bt), stage_table(robot, (), None, grid)
    active = None
    if len(robot.tendons):
        tendons = robot.tendons.table(grid.stages, grid.inside, s.new_ones(len(robot.tendons)))
        table, active = replace(table, tendons=tendons), tendons.tau
    tensors, counts = known(section, table, grid, grid.outputs_and_tip)
    tensors |= {
        "s": grid.stages.contiguous(),
        "inside": grid.inside.contiguous(),
        "offsets": markers.offsets,
        "weight": robot.weight,
        "active": active,
    }
    locations = getattr(c, "locations", None)
    if family == "linear":
        tensors["basis"] = _basis(problem, grid)
    if family == "gaussian" and locations is not None:
        tensors["locations"] = torch.tensor(locations, dtype=s.dtype)
    loads = {"family": kernel.FAMILIES[family], "count": getattr(c, "count", 0), "gamma": c.size}
    loads["per_load"] = c.size // max(loads["count"], 1)
    if family == "point":
        assert x is not None
        tensors["node"] = _nodes_of(grid.nodes, torch.sigmoid(x[:, 2 : c.size : loads["per_load"]]) * robot.rod.length)
    loads["axial"] = int(getattr(c, "friction", None) is not None)
    own = {
        "size": state.size,
        "tip": state.tip.size,
        "tensions": state.tension.size,
        "registration": int(state.registration.size > 0),
    }
    # Copies: what is kept must not change with the tensors that it was worked out from.
    tensors = {name: None if x is None else x.clone() for name, x in tensors.items()}
    return Layout(tensors, counts | loads | own, _units(problem), active)


def _layout_key(problem: Problem) -> Any:
    """What a layout depends on, by value; but for the number of steps the same for the coarse problem."""
    known = vars(problem).get("_known_key")
    if known is None:
        markers = problem.markers
        assert markers is not None
        known = key((problem.robot, markers.s, markers.offsets))
        vars(problem)["_known_key"] = vars(problem.coarse)["_known_key"] = known
    return known, problem.unknowns, problem.steps


def _tables(problem: Problem, nu: float, x: Float[Tensor, "B n"] | None, w: Float[Tensor, "B z"]) -> kernel.FitTables:
    """Everything that the kernel reads. The layout is kept, by value, for the next shapes of the same robot and markers."""
    robot, markers = problem.robot, problem.markers
    assert markers is not None
    if x is None:
        kept = vars(problem).setdefault("_layout", None)  # of this call; the next one looks it up by value again
        layout = kept or _layouts(_layout_key(problem), lambda: _layout(problem))
        vars(problem)["_layout"] = layout
    else:
        layout = _layout(problem, x)
    if layout.shared is not None:
        return layout.shared.with_rows(markers.positions, w, nu)
    tensors, counts = layout.tensors | {"positions": markers.positions, "w": w}, layout.counts
    if layout.active is not None and problem.tension is not None:
        # Where a tension is unknown the kernel adds its error, and only then is it clamped at zero.
        tension = robot.tendons.true_tension(problem.tension, clamped=not problem.state.tension.size)
        tensors["tau"] = tension[:, None, None, :] * layout.active
        counts = counts | {"newton": robot.tendons.newton_steps(*robot.rod.sampled_stiffness, tension)}
    return kernel.FitTables.of(kernel.with_rows(tensors, len(w)), counts, layout.numbers | {"robust": nu})
