"""A model and a chunk of markers made ready for the filter, which evaluates them many times: by the compiled kernel where it
serves, else by the torch model, which is the definition.

Every robot of one section, and every family of loads in model.load_families, goes through the kernel; loads of a user's own
coordinates go through the torch model with a compiled march.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .. import kernel
from ..mechanics.grid import Grid
from ..mechanics.integrate import known
from ..mechanics.jacobian import forward_jacobian
from ..mechanics.loads import total
from ..mechanics.section import Section
from ..mechanics.statics import beyond_tip, grid_for, stage_table
from ..model.load_families import FourierCoordinates, GaussianCoordinates, PaperCoordinates, PointCoordinates
from ..model.measurement import TIP_EXACT, TURN_SCALE, Markers, Model
from ..util.kept import versions
from . import filter as ekf

MOST_TENDONS = 16  # of the kernel


def family_of(model: Model) -> str | None:
    """Which of the kernel's load families serves the model's coordinates; None: none does."""
    c = model.coordinates
    if c.size == 0:
        return "none"
    if isinstance(c, GaussianCoordinates | PaperCoordinates):
        return "gaussian" if isinstance(c, GaussianCoordinates) else "paper"
    if isinstance(c, FourierCoordinates) or (isinstance(c, PointCoordinates) and c.locations is not None):
        return "linear"
    return "point" if isinstance(c, PointCoordinates) else None


def served(model: Model, like: Tensor) -> bool:
    """Whether the kernel can do the fit. Nodes that move with a point load take along neither curvature nor routing that vary."""
    robot, family = model.robot, family_of(model)
    plain = robot.rod.K_se.ndim == 2 and like.dtype == torch.float64 and like.device.type == "cpu"
    if not plain or family is None or len(robot.tendons) > MOST_TENDONS:
        return False
    if family == "point":
        straight = all(len(t.routing) == 1 for t in robot.tendons.tendons)
        return kernel.available() and straight and len(robot.rod.reference_curvature) == 1
    return kernel.available()


def _basis(model: Model, grid: Grid) -> Float[Tensor, "points g 5"]:
    """What one unit of each entry of gamma adds to [G, G2_x, G2_y] at every stage and beyond the tip, for loads linear in it."""
    gamma = model.coordinates.start().unsqueeze(0)

    def integrals(gamma: Float[Tensor, "B g"]) -> Float[Tensor, "B points5"]:
        loads = model.coordinates.loads(gamma)
        along, tip = total(loads, grid.stages, grid.inside), beyond_tip(model.robot, loads, gamma.new_zeros(()))
        assert along.G is not None and along.G2 is not None and tip.G is not None and tip.G2 is not None
        G = torch.cat([along.G.flatten(1, 2), tip.G.unsqueeze(1)], 1)
        G2 = torch.cat([along.G2.flatten(1, 2), tip.G2.unsqueeze(1)], 1)
        return torch.cat([G, G2[..., :2]], -1).flatten(1)

    _, slope = forward_jacobian(integrals, gamma)
    return slope[0].unflatten(0, (-1, 5)).mT.contiguous()


def _grid_at(model: Model, s: Float[Tensor, " P"], x: Float[Tensor, "B n"] | None) -> Grid:
    """The grid, of each sample its own where x moves the nodes."""
    gamma = model.coordinates.start().unsqueeze(0) if x is None else x[:, : model.coordinates.size]
    grid = grid_for(model.robot, model.coordinates.loads(gamma) if gamma.shape[-1] else (), s, model.steps)
    return Grid(grid.nodes[0], grid.outputs[0]) if x is None and grid.nodes.ndim == 2 else grid


def _nodes_of(nodes: Float[Tensor, "B S1"], at: Float[Tensor, "B K"]) -> Int[Tensor, "B K"]:
    """Which node each moving place is: of several at one place, the grid has the fixed one first, then the moving ones in order."""
    later = (at.unsqueeze(-1) == at.unsqueeze(-2)).triu(1).sum(-1)
    return torch.searchsorted(nodes.contiguous(), at.contiguous(), right=True) - 1 - later


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
        if self.active is not None or any(x is not None and x.ndim > d for x, d in self._rows()):
            return None
        return kernel.FitTables.of(self.tensors, self.counts, self.numbers | {"robust": math.inf})

    def _rows(self) -> list[tuple[Tensor | None, int]]:
        return [(x, kernel.SHARED_DIMENSIONS[name]) for name, x in self.tensors.items() if name in kernel.SHARED_DIMENSIONS]


def _numbers(model: Model) -> dict[str, float]:
    """Units of the entries of x."""
    rod, scaled = model.robot.rod, model.scaled
    return {
        "length": rod.length,
        "force_scale": getattr(model.coordinates, "force_scale", 1.0),
        "force_unit": rod.force_scale if scaled else 1.0,
        "moment_unit": rod.moment_scale if scaled else 1.0,
        "length_unit": TURN_SCALE * rod.length if scaled else 1.0,
        "angle_unit": TURN_SCALE if scaled else 1.0,
        "tension_unit": model.tension_std or 0.0,
    }


def _layout(
    model: Model, s: Float[Tensor, " P"], offsets: Float[Tensor, "P 3"] | None, x: Float[Tensor, "B n"] | None = None
) -> Layout:
    """The robot, its loads and its markers on the grid, with nodes as x has them where it moves them."""
    robot, c, family = model.robot, model.coordinates, family_of(model)
    assert family is not None
    grid = _grid_at(model, s, x)
    section, table = Section.of(robot.rod.K_se, robot.rod.K_bt), stage_table(robot, (), None, grid)
    active = None
    if len(robot.tendons):
        tendons = robot.tendons.table(grid.stages, grid.inside, s.new_ones(len(robot.tendons)))
        table, active = replace(table, tendons=tendons), tendons.tau
    tensors, counts = known(section, table, grid, grid.outputs_and_tip)
    tensors |= {
        "s": grid.stages.contiguous(),
        "inside": grid.inside.contiguous(),
        "offsets": offsets,
        "weight": robot.weight,
        "active": active,
    }
    locations = getattr(c, "locations", None)
    if family == "linear":
        tensors["basis"] = _basis(model, grid)
    if family == "gaussian" and locations is not None:
        tensors["locations"] = torch.tensor(locations, dtype=s.dtype)
    if family == "point":
        assert x is not None
        tensors["node"] = _nodes_of(grid.nodes, torch.sigmoid(x[:, 2 : c.size : 3]) * robot.rod.length)
    loads = {"family": kernel.FAMILIES[family], "count": getattr(c, "count", 0), "gamma": c.size}
    loads["per_load"] = c.size // max(loads["count"], 1)
    state = {
        "size": model.size,
        "tip": model.load_size - c.size,
        "tensions": model.tension_size,
        "registration": int(model.registration),
    }
    return Layout(tensors, counts | loads | state, _numbers(model), active)


@lru_cache(maxsize=32)
def _kept_layout(model: Model, s: Tensor, offsets: Tensor | None, now: tuple[int, ...]) -> Layout:
    return _layout(model, s, offsets)


def _tables(model: Model, markers: Markers, w: Float[Tensor, "B z"], nu: float, x: Float[Tensor, "B n"] | None) -> kernel.FitTables:
    """Everything of kernel.FitTables. The layout is kept for the next shapes, unless a tensor in it has been changed since."""
    robot = model.robot
    if x is None:
        now = robot.versions + versions(markers.s, markers.offsets)
        layout = _kept_layout(model, markers.s, markers.offsets, now)
    else:
        layout = _layout(model, markers.s, markers.offsets, x)
    if layout.shared is not None:
        return layout.shared.with_rows(markers.positions, w, nu)
    tensors, counts = layout.tensors | {"positions": markers.positions, "w": w}, layout.counts
    if layout.active is not None and markers.tension is not None:
        # Where a tension is unknown the kernel adds its error, and only then is it clamped at zero.
        tension = robot.tendons.true_tension(markers.tension, clamped=model.tension_std is None)
        tensors["tau"] = tension[:, None, None, :] * layout.active
        counts = counts | {"newton": robot.tendons.newton_steps(robot.rod.K_se, robot.rod.K_bt, tension)}
    return kernel.FitTables.of(kernel.with_rows(tensors, len(w)), counts, layout.numbers | {"robust": nu})


@dataclass(frozen=True)
class Prepared:
    """model and markers, with weights w (B, z) and the degrees of freedom nu of Student's t (inf: a normal distribution)."""

    model: Model
    markers: Markers
    w: Float[Tensor, "B z"]
    nu: float = math.inf

    def take(self, index: Int[Tensor, " b"]) -> "Prepared":
        """The samples of an index."""
        return Prepared(self.model, self.markers.take(index), self.w[index], self.nu)

    @cached_property
    def compiled(self) -> bool:
        """Whether the kernel serves."""
        return served(self.model, self.w)

    @cached_property
    def _fixed(self) -> kernel.FitTables:
        return _tables(self.model, self.markers, self.w, self.nu, None)

    @cached_property
    def _prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        return self.model.prior()

    def tables(self, x: Float[Tensor, "B n"]) -> kernel.FitTables:
        """What the kernel is handed, for all samples."""
        moving = family_of(self.model) == "point"
        return _tables(self.model, self.markers, self.w, self.nu, x) if moving else self._fixed

    def h(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B z"]:
        """Model.h, without derivatives."""
        return self.model.h(x, self.markers, differentiable=False)

    def residual(self, h: Float[Tensor, "B z"]) -> Float[Tensor, "B z"]:
        """r = z - h(x), zero where a marker is missing."""
        z = torch.cat([self.markers.positions.flatten(1), h.new_zeros(len(h), 6)], -1)
        return torch.where(self.w > 0, z - h, 0.0)

    def cost(self, x: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
        """The cost of (3) with the prior's, r^T W r + (x0 - x)^T P (x0 - x)."""
        if self.compiled:
            t = self.tables(x)  # which must outlive the call: the structure holds bare addresses
            return kernel.cost_now(x, *self._prior, t.structure)
        r = self.residual(self.h(x))
        s, _ = ekf.student((self.w * r * r)[:, :-6].unflatten(-1, (-1, 3)).sum(-1), self.nu)
        mean, precision = self._prior
        return s.sum(-1) + (self.w * r * r)[:, -6:].sum(-1) + (precision * (mean - x) ** 2).sum(-1)

    def sums(self, x: Float[Tensor, "B n"]) -> kernel.Sums:
        """At x: the normal equations, the residuals and the centre line (m, the rod's own frame)."""
        if self.compiled:
            t = self.tables(x)
            return kernel.Sums(*kernel.normal_equations_now(x, t.structure, t.markers))
        h, H = self.model.linearized(x, self.markers)
        r = self.residual(h)
        N = ekf.normal_equations(H, r, self.w, self.nu)
        return kernel.Sums(N.A, N.g, N.cost, r, self.model.shape(x, self.markers, differentiable=False).p)

    def normal(self, sums: kernel.Sums) -> ekf.Normal:
        """As estimation.filter has them."""
        return ekf.Normal(sums.A, sums.g, sums.cost, (self.w[:, :-6] > 0).sum(-1))

    def posterior(self, sums: kernel.Sums, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B n n"], Float[Tensor, " B"]]:
        """From the sums at x: the covariance, with a tip residual TIP_EXACT times as stiff, and the cost of (3) with the prior."""
        if self.compiled:
            return kernel.posterior_now(sums, x, *self._prior, TIP_EXACT**2)
        normal = self.normal(sums)
        A, _, _ = normal.exact(TIP_EXACT).whole(x, *self._prior)
        return ekf.posterior(A), normal.whole(x, *self._prior)[2]

    @property
    def at_once(self) -> bool:
        """Whether the kernel can do all iterations in one call: not where its tables depend on where x has come to."""
        return self.compiled and family_of(self.model) != "point"

    def compiled_iteration(
        self, at: ekf.Iterate, Sigma0: Float[Tensor, "B n n"], Q: Float[Tensor, " n"], limits: ekf.Limits, sums: kernel.Sums
    ) -> kernel.Iteration:
        """`iteration` as the kernel has it."""
        mean, precision = self._prior
        filtering = {"Sigma0": Sigma0, "mean": mean, "precision": precision, "Q": Q}
        return kernel.Iteration(vars(at), filtering, limits._asdict(), sums)

    def iteration(
        self, at: ekf.Iterate, Sigma0: Float[Tensor, "B n n"], Q: Float[Tensor, " n"], limits: ekf.Limits, sums: kernel.Sums
    ) -> Callable[[Int[Tensor, " b"]], None]:
        """One iteration of the filter on some samples, in place: at.done then says which of them are done, whose sums are kept."""
        call = self.compiled_iteration(at, Sigma0, Q, limits, sums) if self.compiled else None

        def once(live: Int[Tensor, " b"]) -> None:
            if call is not None:
                call(self.tables(at.x), live)
            else:
                part, here = self.take(live), at.take(live)
                found = part.sums(here.x)
                at.put(live, ekf.advance(here, part.normal(found), Sigma0[live], self._prior, Q, limits))
                sums.put(live, found)

        return once
