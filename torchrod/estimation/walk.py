"""The rod of a problem by the compiled kernel, whatever is measured of it: what the kernel is handed, and what it finds."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .. import kernel
from ..mechanics.grid import Grid
from ..mechanics.integrate import known
from ..mechanics.loads import total
from ..mechanics.section import Section
from ..mechanics.statics import beyond_tip, grid_for, stage_table
from ..mechanics.tendons import LEAK, SLACK
from ..model.load_families import FourierCoordinates, GaussianCoordinates, PaperCoordinates, PointCoordinates, SmoothCoordinates
from ..model.load_families.family import FAINT
from ..model.problem import TIP_ROWS, Problem
from ..util.by_value import Kept, key

_layouts = Kept(256)


def kernel_walks(problem: Problem) -> bool:
    """Whether the kernel can walk the rod under its loads.

    Nodes that move with a point load take along neither a section nor a curvature nor a routing that vary.
    """
    robot, family = problem.on_grid, family_of(problem)
    if family is None or robot.rod.K_se.ndim != 2 or len(robot.tendons) > kernel.MOST_TENDONS:
        return False
    if problem.state.tension.size and any(t.tension_gain != 1 for t in robot.tendons.tendons):
        return False  # the kernel adds an error of the tension, not of the reading
    if family == "point":
        straight = all(len(t.routing) == 1 and not t.discs for t in robot.tendons.tendons)
        return kernel.available() and straight and len(robot.rod.reference_curvature) == 1 and robot.rod.pieces is None
    return kernel.available()


def kernel_serves(problem: Problem) -> bool:
    """Whether the kernel can do all of the fit: it walks the rod, and nothing but isotropic markers are read."""
    markers = problem.markers
    return markers is not None and markers.isotropic and not misread(problem) and kernel_walks(problem)


def misread(problem: Problem) -> bool:
    """Whether how positions are measured is among what is only nearly known."""
    return problem.deviations is not None and problem.deviations.seen


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
class Walk:
    """A problem made ready for the kernel. nu: degrees of freedom of Student's t; inf: a normal distribution."""

    problem: Problem
    nu: float = math.inf

    def take(self, index: Int[Tensor, " b"]) -> "Walk":
        """The samples of an index."""
        part = Walk(self.problem.take(index), self.nu)
        vars(part.problem)["_layout"] = vars(self.problem).get("_layout")  # the same for all samples
        return part

    @cached_property
    def _fixed(self) -> kernel.FitTables:
        return _tables(self.problem, self.nu, None)

    @cached_property
    def moving(self) -> bool:
        """Whether the tables depend on where x has come to: it moves the nodes, or the robot itself."""
        return self._moves_nodes or self.problem.deviations is not None

    @property
    def _moves_nodes(self) -> bool:
        """Whether there are point loads at unknown places."""
        return family_of(self.problem) == "point"

    def tables(self, x: Float[Tensor, "B n"], slopes: bool = True) -> kernel.FitTables:
        """What the kernel is handed, for all samples; slopes: to find how the readings move with x, too."""
        tables = _tables(self.problem, self.nu, x) if self._moves_nodes else self._fixed
        return self._off(tables, x, slopes)

    def _off(self, tables: kernel.FitTables, x: Float[Tensor, "B n"], slopes: bool) -> kernel.FitTables:
        """Of robots that are off by what x says."""
        problem, nearly = self.problem, self.problem.deviations
        if nearly is None or not nearly.counts.total:
            return tables
        theta = x[:, problem.state.parameters.at]
        kappa, dkappa = nearly.amounts(theta, problem.tension), nearly.slopes(theta, problem.tension) if slopes else None
        weight = nearly.weight(kappa) if self._moves_nodes and nearly.counts.weight else None
        return tables.off_by(kappa, dkappa, weight)

    def states(
        self, x: Float[Tensor, "B n"], slopes: bool
    ) -> tuple[Float[Tensor, "B P1 w"], Float[Tensor, "B 6"], Float[Tensor, "B P1 w n"] | None, Float[Tensor, "B 6 n"] | None]:
        """The section's states [p (m), q, wrench (N, N m)] at problem.s and at the tip, in the rod's own frame, with Theta of every
        tendon where they rub; the tip residual c (N, N m), and where slopes are wanted how they move with x.
        """
        tendons = self.problem.on_grid.tendons
        width = kernel.STATE + (0 if tendons.friction is None else len(tendons))
        t = self.tables(x, slopes)  # which must outlive the call: the structure holds bare addresses
        h, H = kernel.measured_now(x, t.structure, t.markers, slopes, width)
        y, c = h[:, :-TIP_ROWS].unflatten(1, (-1, width)), h[:, -TIP_ROWS:]
        return (y, c, None, None) if H is None else (y, c, H[:, :-TIP_ROWS].unflatten(1, (-1, width)), H[:, -TIP_ROWS:])

    def balance(
        self, x: Float[Tensor, "B n"], q_tip: Float[Tensor, "B 4"] | None, increments: int, tolerance: float
    ) -> tuple[Float[Tensor, "B 6"], Float[Tensor, " B"], Float[Tensor, "B P 3"]]:
        """The base wrench (N, N m) in equilibrium under x, how far the base is from its clamp (rad), the centre line (m).

        The base wrench that x has plays no part. Where tendons rub, the kernel does not walk from the tip.
        """
        assert self.problem.on_grid.tendons.friction is None
        t = _tables(self.problem, self.nu, x if self._moves_nodes else None, readings=False)
        t = self._off(t, x, False)
        return kernel.balance_now(x, q_tip, increments, tolerance, t.structure, t.markers)


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
    grid = grid_for(problem.on_grid, family.loads(gamma) if gamma.shape[-1] else (), problem.s, problem.steps)
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
        "leak": LEAK,
        "slack": SLACK * unit(state.tension.unit, 0),
    }


def _layout(problem: Problem, x: Float[Tensor, "B n"] | None = None) -> Layout:
    """The robot, its loads and its markers on the grid, with nodes as x has them where it moves them."""
    robot, c, family, state = problem.on_grid, problem.unknowns.loads, family_of(problem), problem.state
    assert family is not None
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
        "offsets": _offsets(problem),
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
    if (nearly := problem.deviations) is not None:
        along = nearly.along(grid)
        u_star, hanging = (None if x is None else x.movedim(0, d) for x, d in ((along.u_star, -4), (along.hanging, -3)))
        tensors |= {"K_off": along.K, "u_off": u_star, "hangs": hanging, "pulling": along.pulling}
        own |= nearly.counts.of_kernel
        own["parameters"] = state.parameters.size if nearly.counts.total else 0
        if along.K is not None:  # none of what is off the diagonals of K_se and K_bt
            counts["diagonal"] &= int(not along.K[..., [1, 2, 3, 5, 6, 7, 10, 11, 12, 14, 15, 16]].any())
    # Copies: what is kept must not change with the tensors that it was worked out from.
    tensors = {name: None if x is None else x.clone() for name, x in tensors.items()}
    return Layout(tensors, counts | loads | own, _units(problem), active)


def _offsets(problem: Problem) -> Float[Tensor, "P 3"] | None:
    """Those of the markers (m), where they are all that was measured; other sensors have theirs to themselves."""
    return None if problem.markers is None else problem.markers.offsets


def _layout_key(problem: Problem) -> Any:
    """What a layout depends on, by value; but for the number of steps the same for the coarse problem."""
    known = vars(problem).get("_known_key")
    if known is None:
        known = key((problem.robot, problem.s, _offsets(problem)))
        vars(problem)["_known_key"] = vars(problem.coarse)["_known_key"] = known
    return known, problem.unknowns, problem.steps


def _tables(problem: Problem, nu: float, x: Float[Tensor, "B n"] | None, readings: bool = True) -> kernel.FitTables:
    """Everything that the kernel reads. The layout is kept, by value, for the next shapes of the same robot and markers.

    readings: with the markers' positions and weights, where markers are all that was measured.
    """
    robot, markers = problem.robot, problem.markers
    if x is None:
        kept = vars(problem).setdefault("_layout", None)  # of this call; the next one looks it up by value again
        layout = kept or _layouts(_layout_key(problem), lambda: _layout(problem))
        vars(problem)["_layout"] = layout
    else:
        layout = _layout(problem, x)
    readings = readings and markers is not None and markers.isotropic
    positions, w = (markers.positions, problem.weights) if readings and markers is not None else (None, None)
    if layout.shared is not None:
        return layout.shared.with_rows(positions, w, nu)
    tensors, counts = layout.tensors | {"positions": positions, "w": w}, layout.counts
    if layout.active is not None and problem.tension is not None:
        # Where a tension is unknown the kernel adds its error and eases it about zero: it is handed as it was read.
        tension = problem.as_pulled.tendons.true_tension(problem.tension)
        tensors["tau"] = tension[:, None, None, :] * layout.active
        counts = counts | {"newton": robot.tendons.newton_steps(*robot.rod.sampled_stiffness, tension)}
    return kernel.FitTables.of(kernel.with_rows(tensors, problem.batch), counts, layout.numbers | {"robust": nu})
