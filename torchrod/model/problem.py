"""The problem: a robot, what is unknown of it, and what sensors read; and the model h(x) of their readings.

    x = [loads, tip, tension, parameters, registration, base]   ->   h(x) = [rows of every sensor, c]

c is the tip residual (17): what the section carries just beyond the tip, less R^T of the unknown wrench there. It is zero in
equilibrium.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mechanics.grid import DEFAULT_STEPS, Grid, Places, on_rod
from ..mechanics.integrate import march, march_linearized, states_at, with_theta
from ..mechanics.jacobian import forward_jacobian, moved_along
from ..mechanics.lie import Matrix, Vector, conjugate, exponential, move, product, unrotate
from ..mechanics.loads import Load, LoadIntegrals, total
from ..mechanics.robot import Robot
from ..mechanics.section import Section, StageTable, derivative
from ..mechanics.statics import Shape, base_state, beyond_tip, grid_for, shape_from_base, shape_of, stage_table, steps_of_rod
from ..mechanics.tendons import SLACK
from ..util.by_value import Kept, key
from ..util.precision import DTYPE, Float64
from .deviations import Deviations
from .sensors import Markers, RodState, Sensor, TipWrench
from .unknowns import State, Unknowns

COARSE_STEPS = 20  # along the rod, as long as a fit is far from the data: within 1e-6 m of the exact shape
TIP_ROWS = 6
FINEST = 5e-7  # of the length: the least noise of a marker. What steps and round-off leave must not decide a verdict
TIP_FORCE_STD = 1e-3  # in force scales: 1 mN on the paper's rod
TIP_MOMENT_STD = 5e-4  # in moment scales: 0.1 mN m on the paper's rod
_states = Kept(256)
_OF_READINGS = (
    "state",
    "mean",
    "precision",
    "batch",
    "s",
    "reading",
    "weights",
    "tip_weights",
    "seen",
    "groups",
    "group_count",
    "usable",
    "deviations",
)


@dataclass(frozen=True)
class Problem(Float64):
    """Which robot, what is unknown, what was measured: all that an estimate needs (torchrod.estimate).

    A problem is a value: what it has worked out from its tensors (state, weights, reading, ..) it keeps. torchrod.estimate works on
    a copy and follows tensors that were changed in place; for anything else make a new problem after such a change.

    robot: known but for the unknowns. unknowns: what is to be estimated of each sample. sensors: what was read of B samples, with
    its noise; their rows stand one after the other in h. tension: (B, T) N for a tendon robot, the readings of its load cells.
    steps: the least number of arc-length steps; 0: as many as the reference shape asks for. prior: mean and precision of x instead
    of the unknowns' own, (n) or (B, n), in the units of `state`. tip_std: standard deviations (N, N m) of a component of the tip
    residual, W^-1/2 of the paper's W on c, which then stay to the end; None: c is zero at the answer, and TIP_FORCE_STD and
    TIP_MOMENT_STD in the rod's scales ease the way there. Errors: ValueError of `check`.
    """

    robot: Robot
    unknowns: Unknowns
    sensors: Sequence[Sensor]
    tension: Float[Tensor, "B T"] | None = None
    steps: int = 0
    prior: tuple[Tensor, Tensor] | None = None
    tip_std: tuple[float, float] | None = None

    def __post_init__(self):
        super().__post_init__()
        if hasattr(self.sensors, "predict"):
            raise ValueError("Problem.sensors takes a list, [sensor]")
        object.__setattr__(self, "sensors", tuple(self.sensors))
        if self.steps == 0:
            known = bool(self.sensors) and bool(on_rod(self.s, self.robot.rod.length).all())  # else `check` says what is wrong
            object.__setattr__(self, "steps", steps_of_rod(self.robot, self.s) if known and len(self.s) else DEFAULT_STEPS)

    # What is unknown.

    @cached_property
    def state(self) -> State:
        """The blocks of x, bound to this robot's scales."""
        rod = self.robot.rod
        scales = key(self.unknowns), rod.length, rod.bending_stiffness, rod.force_scale, len(self.robot.tendons)
        scales = (*scales, self.robot.weightless, bool(rod.mass_per_length > 0))  # what parameters there are
        return _states(scales, lambda: self.unknowns.state(self.robot))

    @property
    def size(self) -> int:
        """The length of x."""
        return self.state.size

    @cached_property
    def mean(self) -> Float[Tensor, "*B n"]:
        """The prior mean of x."""
        return self.state.mean if self.prior is None else self.prior[0]

    @cached_property
    def precision(self) -> Float[Tensor, "*B n"]:
        """The prior precision of every entry of x."""
        return self.state.precision if self.prior is None else self.prior[1]

    # What was measured.

    @cached_property
    def batch(self) -> int:
        """B."""
        return len(self.sensors[0].reading)

    @cached_property
    def s(self) -> Float[Tensor, " P"]:
        """The arc lengths (m) of all sensors, one after the other."""
        places = [sensor.s for sensor in self.sensors]
        return places[0] if len(places) == 1 else torch.cat(places)

    @cached_property
    def reading(self) -> Float[Tensor, "B z"]:
        """What the sensors read, NaN where they did not, and zero for the tip residual."""
        readings = [sensor.reading for sensor in self.sensors]
        return torch.cat([*readings, readings[0].new_zeros(self.batch, TIP_ROWS)], -1)

    @cached_property
    def weights(self) -> Float[Tensor, "B z"]:
        """The diagonal of W: 1 / variance of what was read, 0 for what was not, then the tip residual's.

        A noise of markers below FINEST of the length counts as that.
        """
        finest = (FINEST * self.robot.rod.length) ** -2
        own = [sensor.weights.clamp(max=finest) if isinstance(sensor, Markers) else sensor.weights for sensor in self.sensors]
        return torch.cat([*own, self.tip_weights.expand(self.batch, TIP_ROWS)], -1)

    @cached_property
    def tip_weights(self) -> Float[Tensor, " 6"]:
        """1 / variance of the tip residual c (1/N^2, 1/(N m)^2) on the way to the answer: (17) holds to a milli-force-scale."""
        rod = self.robot.rod
        force, moment = self.tip_std or (TIP_FORCE_STD * rod.force_scale, TIP_MOMENT_STD * rod.moment_scale)
        return torch.tensor([force] * 3 + [moment] * 3, dtype=DTYPE) ** -2

    @property
    def exact_tip(self) -> bool:
        """Whether (17) holds exactly at the answer."""
        return self.tip_std is None

    @cached_property
    def seen(self) -> Int[Tensor, " B"]:
        """How many numbers the sensors read of each sample."""
        return (self.weights[:, :-TIP_ROWS] > 0).sum(-1)

    @cached_property
    def groups(self) -> Int[Tensor, " rows"]:
        """Which rows are outliers together, over all sensors."""
        parts, first = [], 0
        for sensor in self.sensors:
            parts.append(sensor.groups + first)
            first = int(parts[-1][-1]) + 1
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    @cached_property
    def group_count(self) -> int:
        """G."""
        return int(self.groups[-1]) + 1

    @property
    def present(self) -> Bool[Tensor, "B G"]:
        """Which groups of rows were read, whole or in part."""
        read = self.weights[:, :-TIP_ROWS] > 0
        return torch.zeros(len(read), self.group_count, dtype=torch.int64).index_add(1, self.groups, read.long()) > 0

    def distances(self, rows: Float[Tensor, "B rows"]) -> Float[Tensor, "B K 3"]:
        """Those of the sensors' rows that are positions (m)."""
        parts, first = [], 0
        for sensor in self.sensors:
            last = first + sensor.rows
            parts.append(sensor.distances(rows[:, first:last]))
            first = last
        return parts[0] if len(parts) == 1 else torch.cat(parts, 1)

    @cached_property
    def usable(self) -> Bool[Tensor, " B"]:
        """Samples of which as many numbers were read as only sensors determine, one at least, and whose tensions are finite."""
        enough = self.seen >= max(self.state.free_size, 1)
        return enough if self.tension is None else enough & torch.isfinite(self.tension).all(-1)

    @property
    def determined(self) -> bool:
        """Whether a sample of which everything was read would be usable."""
        return self.weights.shape[-1] - TIP_ROWS >= self.state.free_size

    @property
    def sees_frame(self) -> bool:
        """Whether any sensor measures in a frame of its own, in which the base frame may be off."""
        eye, none = torch.eye(3, dtype=DTYPE), torch.zeros(3, dtype=DTYPE)
        return any(sensor.moved(eye, none) is not sensor for sensor in self.sensors)

    @property
    def _kinds(self) -> str:
        return " and ".join(dict.fromkeys(type(sensor).__name__ for sensor in self.sensors))

    @property
    def markers(self) -> Markers | None:
        """The markers, where they are all that was measured."""
        return only if len(self.sensors) == 1 and isinstance(only := self.sensors[0], Markers) else None

    # Other problems like this one.

    @cached_property
    def coarse(self) -> "Problem":
        """The same with no more than COARSE_STEPS steps along the rod."""
        return self if self.steps <= COARSE_STEPS else self.with_steps(COARSE_STEPS)

    def with_steps(self, steps: int) -> "Problem":
        """The same with another number of steps along the rod."""
        other = replace(self, steps=steps)
        # What has been worked out so far does not depend on the steps.
        vars(other).update({name: value for name, value in vars(self).items() if name in _OF_READINGS})
        return other

    def take(self, index: Int[Tensor, " b"]) -> "Problem":
        """The samples of an index."""
        if len(index) == self.batch and bool((index == torch.arange(self.batch)).all()):
            return self
        tension = None if self.tension is None else self.tension[index]
        prior = self.prior
        if prior is not None:
            prior = prior[0][index] if prior[0].ndim > 1 else prior[0], prior[1][index] if prior[1].ndim > 1 else prior[1]
        part = replace(self, sensors=[sensor.take(index) for sensor in self.sensors], tension=tension, prior=prior)
        vars(part)["state"] = self.state
        if "deviations" in vars(self):
            vars(part)["deviations"] = self.deviations
        return part

    def without(self, groups: Bool[Tensor, "B G"]) -> "Problem":
        """The same with the rows of these groups (Problem.groups) not read."""
        parts, first = [], 0
        for sensor in self.sensors:
            last = first + int(sensor.groups.max()) + 1
            parts.append(sensor.without(groups[:, first:last]))
            first = last
        return replace(self, sensors=parts)

    def moved(self, R: Matrix, t: Vector) -> "Problem":
        """The same readings in the frame p' = R p + t (a rotation matrix, m)."""
        return replace(self, sensors=[sensor.moved(R, t) for sensor in self.sensors])

    def of(self, unknowns: Unknowns) -> "Problem":
        """The same measurements with other unknowns."""
        return replace(self, unknowns=unknowns, prior=None)

    def check(self) -> None:
        """Raise ValueError, naming the remedy, for measurements that do not fit the robot or the unknowns."""
        L, tendons, s, free = self.robot.rod.length, len(self.robot.tendons), self.s, self.state.free_size
        if not self.sensors:
            raise ValueError("there is nothing measured; give at least one sensor")
        for sensor in self.sensors:
            sensor.check()
        if len({len(sensor.reading) for sensor in self.sensors}) > 1:
            counts = ", ".join(f"{type(sensor).__name__} {len(sensor.reading)}" for sensor in self.sensors)
            raise ValueError(f"the sensors hold different numbers of samples ({counts}); give every sensor the same samples")
        if not bool(on_rod(s, L).all()):
            raise ValueError(f"marker arc lengths run from {s.min()} to {s.max()} m, outside the rod of 0 to {L} m")
        if self.unknowns.registration is not None and not self.sees_frame:
            raise ValueError(
                f"{self._kinds} cannot tell where the base frame is; add markers, or take the frame as exact (no registration)"
            )
        if not self.state.tip.size and any(isinstance(sensor, TipWrench) for sensor in self.sensors):
            raise ValueError('TipWrench reads what acts on the tip, which is not unknown; give Unknowns(tip="force") or "wrench"')
        if not self.determined:
            P, read = len(s), self.weights.shape[-1] - TIP_ROWS
            few = f"{P} marker{'s' * (P != 1)}" if self.markers is not None else f"{read} numbers read by {self._kinds}"
            raise ValueError(f"{few} cannot determine {free} unknowns; add markers or drop loads or --registration")
        if tendons and self.tension is None:
            raise ValueError(f"the robot has {tendons} tendons but the shapes carry no tensions; add tension_1..tension_{tendons}")
        if self.tension is not None and tuple(self.tension.shape) != (self.batch, tendons):
            found = self.tension.shape[-1]
            if self.tension.ndim == 2 and found != tendons:
                raise ValueError(f"the shapes carry {found} tensions but the robot has {tendons} tendons")
            raise ValueError(f"tension has shape {tuple(self.tension.shape)}; here it must have ({self.batch}, {tendons})")
        if self.steps < 1:
            raise ValueError(f"steps is {self.steps}; it must be at least 1")

    # The model.

    def tensions(self, x: Float[Tensor, "... n"]) -> Float[Tensor, "... T"] | None:
        """The readings (N) of the load cells, without the errors that x says they have."""
        tension = self.state.tension
        return self.tension if self.tension is None or not tension.size else self.tension + tension.of(x)

    def pulling(self, x: Float[Tensor, "... n"]) -> Float[Tensor, "... T"] | None:
        """The readings (N) that x takes the tendons to pull by: `tensions`, eased to none where a tendon goes slack."""
        tension, found = self.state.tension, self.tensions(x)
        return found if found is None or not tension.size else self.robot.tendons.eased(found, SLACK * tension.unit)

    @cached_property
    def as_pulled(self) -> Robot:
        """The robot that `pulling` is of: where a tension is unknown it may fall below zero by a little."""
        robot = self.robot
        return robot if not self.state.tension.size else replace(robot, tendons=replace(robot.tendons, clamped=False))

    @cached_property
    def deviations(self) -> Deviations | None:
        """How the robot's tables move with the parameters' errors; None where it is known."""
        nearly = self.unknowns.uncertainty
        return Deviations(nearly, self.robot) if nearly is not None and self.state.parameters.size else None

    @property
    def on_grid(self) -> Robot:
        """The robot on whose grid the walk is, with all that may vary along it."""
        return self.robot if self.deviations is None else self.deviations.prepared

    def own_weight(self, x: Float[Tensor, "... n"]) -> Float[Tensor, "... 3"]:
        """Of the whole robot (N, base frame)."""
        if self.deviations is None:
            return self.robot.rod.mass * self.robot.gravity
        return self.deviations.own_weight(x[..., self.state.parameters.at])

    def shape(self, x: Float[Tensor, "... n"], differentiable: bool = True) -> Shape:
        """The rod at the sensors' arc lengths, in its own base frame."""
        state, nearly = self.state, self.deviations
        loads, alpha = self.unknowns.loads.loads(x[..., state.loads.at]), state.base.of(x)
        if nearly is None:
            return shape_from_base(self.as_pulled, loads, alpha, self.pulling(x), self.s, self.steps, differentiable)
        robot = nearly.prepared
        grid = grid_for(robot, loads, self.s, self.steps)
        table = self._table(x, loads, grid)
        assert table.section is not None
        y = with_theta(base_state(robot, alpha, table), table)
        states = states_at(march(table.section, y, table, grid), grid.outputs_and_tip)
        return shape_of(table.section, states, beyond_tip(robot, loads, alpha))

    def _table(self, x: Float[Tensor, "... n"], loads: tuple[Load, ...], places: Grid | Places) -> StageTable:
        """All that is known along the rod that x says."""
        nearly = self.deviations
        if nearly is None:
            return stage_table(self.as_pulled, loads, self.pulling(x), places)
        kappa = nearly.amounts(x[..., self.state.parameters.at], self.tension)
        table = nearly.moved(self.tension, kappa, places)
        return replace(table, loads=table.loads + total(loads, places.stages, places.inside))

    def h(self, x: Float[Tensor, "... n"], differentiable: bool = True) -> Float[Tensor, "... z"]:
        """[rows of every sensor, c (N, N m)]: what the sensors would read, in their units, then the tip residual."""
        return self._read(self.shape(x, differentiable), x)

    def read(self, states: Float[Tensor, "B P1 w"], x: Float[Tensor, "B n"]) -> Float[Tensor, "B rows"]:
        """What the sensors read of a section's states [p (m), q, wrench (N, N m)] at their arc lengths and at the tip, in its own
        frame; with Theta (rad) of every tendon where they rub.
        """
        return self._rows(states[..., :-1, :], states[..., -1, 3:7], x)

    def _read(self, shape: Shape, x: Float[Tensor, "... n"]) -> Float[Tensor, "... z"]:
        """What the sensors read of a shape, and c."""
        c = shape.tip_residual
        if self.state.tip.size:
            tip = self.state.tip_wrench(x)
            c = c - unrotate(shape.tip_q.unsqueeze(-2), tip.unflatten(-1, (2, 3))).flatten(-2)
        own = torch.cat([shape.p, shape.q, shape.wrench, shape.turned], -1)
        return torch.cat([self._rows(own, shape.tip_q, x), c], -1)

    def _rows(
        self, own: Float[Tensor, "... P w"], tip_q: Float[Tensor, "... 4"], x: Float[Tensor, "... n"]
    ) -> Float[Tensor, "... rows"]:
        state, p, q = self.state, own[..., :3], own[..., 3:7]
        if state.registration.size:
            zeta = state.registration.of(x)
            p, q = move(zeta, p), product(exponential(zeta[..., 3:]).unsqueeze(-2), q)
        if self.deviations is not None and self.deviations.seen:
            p = self.deviations.warp(x[..., state.parameters.at])(p)
        rows, first, alpha, tip = [], 0, state.base.of(x), state.tip_wrench(x)
        for sensor in self.sensors:
            at = slice(first, first + len(sensor.s))
            strains = partial(self._strains, own[..., at, :], x, at)
            rows.append(sensor.predict(RodState(p[..., at, :], q[..., at, :], alpha, tip, tip_q, strains)))
            first = at.stop
        return torch.cat(rows, -1)

    def _strains(self, y: Float[Tensor, "... P w"], x: Float[Tensor, "... n"], at: slice) -> tuple[Vector, Vector]:
        """v (-) and u (1/m) at the arc lengths `at` of all sensors', from the rates of mechanics.section at the states y."""
        loads, robot = self.unknowns.loads.loads(x[..., self.state.loads.at]), self.robot
        table = self._table(x, loads, Places(self.s[at])).stage(0)
        q = y[..., 3:7]
        rate = derivative(Section.of(robot.rod.K_se, robot.rod.K_bt), y, table)
        return unrotate(q, rate[..., :3]), 2 * product(conjugate(q), rate[..., 3:7])[..., :3]

    def linearized(self, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"]]:
        """h(x) and H = dh/dx.

        The rod's share of the tangents goes through `march_linearized`, which has a compiled path; what comes before it (load
        integrals of gamma) and after it (sensors, registration, tip residual) by torch.func. The same as forward_jacobian(h), which
        is what is used where the nodes move with x (point loads at unknown places), or where tensions or the robot are not known.
        """
        state, family = self.state, self.unknowns.loads
        gamma, alpha = x[..., state.loads.at], state.base.of(x)
        grid = grid_for(self.robot, family.loads(gamma), self.s, self.steps)
        if grid.nodes.ndim > 1 or state.tension.size or state.parameters.size:
            return forward_jacobian(self.h, x)
        g, B, S = state.loads.size, len(x), grid.h.shape[-1]
        like = x.new_zeros(())

        def integrals(gamma: Float[Tensor, "B g"]) -> Float[Tensor, "B m"]:
            """[G, G2] at every stage, then just beyond the tip."""
            loads = family.loads(gamma)
            along, beyond = total(loads, grid.stages, grid.inside), beyond_tip(self.robot, loads, like)
            assert along.G is not None and along.G2 is not None and beyond.G is not None and beyond.G2 is not None
            return torch.cat([torch.cat([along.G, along.G2], -1).reshape(B, 18 * S), beyond.G, beyond.G2], -1)

        axes = torch.eye(g, dtype=x.dtype).unsqueeze(1).expand(g, B, g)
        value, slope = moved_along(integrals, (gamma,), (axes,))
        G, dG = value[:, :-6].reshape(B, S, 3, 6), slope[:, :-6].reshape(B, S, 3, 6, g)
        known = stage_table(self.robot, (), self.tension, grid)
        table = replace(known, loads=known.loads + LoadIntegrals(G[..., :3], G[..., 3:]))
        y0 = with_theta(base_state(self.robot, alpha, table), table)
        dy0 = x.new_zeros(*y0.shape, g + 6)
        dy0[:, range(7, 13), range(g, g + 6)] = state.base.unit
        section = Section.of(self.robot.rod.K_se, self.robot.rod.K_bt)
        states, tangents = march_linearized(section, y0, dy0, table, dG, grid, grid.outputs_and_tip)
        return self._after(section, states, tangents, value[:, -6:], slope[:, -6:], x)

    def _after(
        self,
        section: Section,
        states: Float[Tensor, "B P1 w"],
        tangents: Float[Tensor, "B P1 w m"],
        beyond: Float[Tensor, "B 6"],
        dbeyond: Float[Tensor, "B 6 g"],
        x: Float[Tensor, "B n"],
    ) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"]]:
        """h and H from the marched states and the loads beyond the tip, and how they move with loads and base wrench."""
        g, n = self.state.loads.size, self.size
        where = torch.tensor([*range(g), *range(*self.state.base.at.indices(n))])
        d_states = tangents.new_zeros(n, *states.shape).index_copy(0, where, tangents.movedim(-1, 0))
        d_beyond = beyond.new_zeros(n, *beyond.shape).index_copy(0, where[:g], dbeyond.movedim(-1, 0))

        def read(states: Tensor, beyond: Tensor, x: Tensor) -> Tensor:
            return self._read(shape_of(section, states, LoadIntegrals(beyond[..., :3], beyond[..., 3:])), x)

        axes = torch.eye(n, dtype=x.dtype).unsqueeze(1).expand(n, *x.shape)
        return moved_along(read, (states, beyond, x), (d_states, d_beyond, axes))
