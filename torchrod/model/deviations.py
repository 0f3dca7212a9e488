"""How the tables of a robot move with the errors of its parameters: every sample walks the rod of its own robot.

A table of what is known along the rod (mechanics.section.StageTable) of a robot that is off by errors e (model.uncertainty) is

    (1)  T(s; e) = T(s) + sum_m kappa_m(e) T_m(s)

with T_m that all samples share, and amounts kappa_m of each its own. Stiffness, reference curvature, friction and routing are
linear in their errors, the weight in the components of gravity. Tensions go slack as `tendons.eased` has it. Where an oval error
meets a section that varies and is not round, (1) is exact to first order only.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ..mechanics.grid import Grid, Places
from ..mechanics.lie import hat
from ..mechanics.robot import Robot
from ..mechanics.section import MATRICES, Section, StageTable
from ..mechanics.statics import stage_table
from ..mechanics.tendons import SLACK, eased, eased_slope
from ..util.precision import DTYPE
from .uncertainty import GRAVITY, OVAL, SHIFT, STRAIN, TURN, Uncertainty, Warp, positive, turned_gravity, within

SMALL = 1e-3  # of what a softer side bears: over so much of it a table's slope is taken


class Counts(NamedTuple):
    """How many amounts there are of each kind, in their order."""

    stiffness: int
    curvature: int
    weight: int
    pull: int
    rubbing: int
    place: int

    @property
    def total(self) -> int:
        """Of all kinds."""
        return sum(self)

    @property
    def of_kernel(self) -> dict[str, int]:
        """As struct Deviations of the kernel has them: of weight and place, how many times three and two."""
        return {
            "stiffness": self.stiffness,
            "curvature": self.curvature,
            "hanging": self.weight // 3,
            "pulls": self.pull,
            "frictions": self.rubbing,
            "places": self.place // 2,
        }


class Along(NamedTuple):
    """T_m of (1) at the stages of S steps, where there are any.

    K (m, S, 3, 18) or (m, 1, 1, 18): K_se (N) then K_bt (N m^2), row by row; u_star (m, S, 3, 3) 1/m; hanging (m, S, 3): kg of the
    rod, then of what hangs on it at points, beyond each; three amounts in turn go with it, the components of gravity. pulling (S,
    3, T): 1 where a tendon pulls.
    """

    K: Float[Tensor, "m S 3 18"] | None
    u_star: Float[Tensor, "m S 3 3"] | None
    hanging: Float[Tensor, "m *B S 3"] | None
    pulling: Float[Tensor, "*B S 3 T"] | None


@dataclass(frozen=True)
class Deviations:
    """Of a robot by a stated uncertainty. robot: as its file has it."""

    uncertainty: Uncertainty
    robot: Robot

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""
        return tuple(p.name for p in self.uncertainty.parameters(self.robot))

    @cached_property
    def root(self) -> Float[Tensor, "k k"]:
        """e = root theta."""
        return self.uncertainty.root(self.robot)

    @cached_property
    def prepared(self) -> Robot:
        """The robot on whose grid (1) is: with rows where reference curvature is unknown, Theta followed where friction is."""
        robot = self.uncertainty.prepared(self.robot)
        return replace(robot, tendons=replace(robot.tendons, followed=True)) if self._any("friction") else robot

    def _any(self, *kinds: str) -> bool:
        return any(name.startswith(kinds) for name in self.names)

    @cached_property
    def _bent(self) -> tuple[str, ...]:
        return tuple(name for name in self.names if name.startswith(("set_", "curvature_")))

    @cached_property
    def _heavy(self) -> bool:
        return self._any("mass", "gravity")

    @cached_property
    def counts(self) -> Counts:
        """How many amounts there are."""
        tendons, points = len(self.robot.tendons), bool(len(self.robot.rod.masses))
        stiffness = 3 if self._any("oval") else int(self._any("stiffness"))
        return Counts(
            stiffness,
            len(self._bent),
            3 * (1 + points) * self._heavy,
            tendons * self._any("tension"),
            tendons * self._any("friction"),
            2 * tendons * self._any("tendon_"),
        )

    @cached_property
    def seen(self) -> bool:
        """Whether any error is of how positions are measured (`warp`)."""
        return self._any("frame_", "metric_")

    def _of_tendons(self, e: Mapping[str, Tensor], kind: str, like: Tensor) -> Float[Tensor, "... T"]:
        """Their errors of a kind, zero where it is known."""
        return torch.stack([e.get(f"{kind}_{j + 1}", torch.zeros_like(like)) for j in range(len(self.robot.tendons))], -1)

    def _errors(self, theta: Float[Tensor, "... k"]) -> tuple[Mapping[str, Tensor], Float[Tensor, "..."]]:
        """By their names, and a zero of their shape for others."""
        errors = theta @ self.root.mT
        return dict(zip(self.names, errors.unbind(-1), strict=True)), errors.sum(-1) * 0

    def amounts(self, theta: Float[Tensor, "... k"], reading: Float[Tensor, "... T"] | None) -> Float[Tensor, "... m"]:
        """kappa of (1) at theta, in standard deviations. reading: the tendons' tensions as they were read (N)."""
        (e, zero), found, counts, robot = self._errors(theta), [], self.counts, self.robot
        if counts.stiffness:
            share, _ = positive(1 + e.get("stiffness", zero))
            found.append(share - 1)
            if counts.stiffness > 1:
                sides, _ = within(torch.stack([e.get(name, zero) for name in OVAL], -1), robot.rod.softer_side)
                found += (share.unsqueeze(-1) * sides).unbind(-1)
        found += [e[name] for name in self._bent]
        if counts.weight:
            of_rod, of_points = (own - robot.gravity for own in self._pulled(e, zero))
            found += of_rod.unbind(-1)
            found += of_points.unbind(-1) if counts.weight > 3 else []
        if counts.pull:
            assert reading is not None
            tau, width = self._pull(e, reading, zero)
            found += (eased(tau, width) - robot.tendons.true_tension(reading)).unbind(-1)
        found += self._of_tendons(e, "friction", zero).unbind(-1) if counts.rubbing else []
        if counts.place:
            places = torch.stack([self._of_tendons(e, f"tendon_{axis}", zero) for axis in "xy"], -1)
            found += places.flatten(-2).unbind(-1)
        return torch.stack(torch.broadcast_tensors(*found), -1) if found else theta[..., :0]

    def slopes(self, theta: Float[Tensor, "B k"], reading: Float[Tensor, "B T"] | None) -> Float[Tensor, "B m k"]:
        """How `amounts` moves with theta: written down, since a fit asks for it in every iteration."""
        (e, zero), counts, robot, first = self._errors(theta), self.counts, self.robot, 0
        at = {name: k for k, name in enumerate(self.names)}
        J = theta.new_zeros(len(theta), counts.total, len(at))

        def put(m: int, name: str, slope: Tensor | float) -> None:
            if name in at:
                J[:, m, at[name]] = slope

        if counts.stiffness:
            share, slope = positive(1 + e.get("stiffness", zero))
            put(0, "stiffness", slope)
            if counts.stiffness > 1:
                sides, bent = within(torch.stack([e.get(name, zero) for name in OVAL], -1), robot.rod.softer_side)
                for i in range(2):
                    put(1 + i, "stiffness", slope * sides[:, i])
                    for j, name in enumerate(OVAL):
                        put(1 + i, name, share * bent[:, i, j])
            first = counts.stiffness
        for name in self._bent:
            put(first, name, 1.0)
            first += 1
        if counts.weight:
            off, turned = turned_gravity(robot.gravity, torch.stack([e.get(name, zero) for name in GRAVITY], -1))
            for i in range(counts.weight):
                of_rod = i < 3
                put(first + i, "mass", off[:, i] if of_rod else 0.0)
                for j, name in enumerate(GRAVITY):
                    put(first + i, name, (1 + e.get("mass", zero)) * turned[:, i % 3, j] if of_rod else turned[:, i % 3, j])
            first += counts.weight
        for j in range(counts.pull):
            assert reading is not None
            slope = eased_slope(*self._pull(e, reading, zero))[:, j]
            put(first + j, f"tension_{j + 1}", slope * robot.tendons.cells[0][j] * reading[:, j])
            put(first + j, f"tension_offset_{j + 1}", slope)
        first += counts.pull
        for j in range(counts.rubbing):
            put(first + j, f"friction_{j + 1}", 1.0)
        first += counts.rubbing
        for m in range(counts.place):
            put(first + m, f"tendon_{'xy'[m % 2]}_{m // 2 + 1}", 1.0)
        return J @ self.root

    def _pull(
        self, e: Mapping[str, Tensor], reading: Float[Tensor, "... T"], zero: Tensor
    ) -> tuple[Float[Tensor, "... T"], Float[Tensor, "... T"]]:
        """By how much every tendon would pull (N) if it could push as well, and the width (N) within which it eases to none."""
        gain, offset = self.robot.tendons.cells
        read = gain * reading
        tau = read * (1 + self._of_tendons(e, "tension", zero)) + offset + self._of_tendons(e, "tension_offset", zero)
        std = [(self._std[f"tension_{j + 1}"] * read[..., j], self._std[f"tension_offset_{j + 1}"]) for j in range(len(gain))]
        return tau, SLACK * torch.stack([(a * a + b * b).sqrt() for a, b in std], -1)

    @cached_property
    def _std(self) -> Mapping[str, Tensor]:
        """Of every parameter by its name; zero of others."""
        return defaultdict(lambda: self.root.new_zeros(()), zip(self.names, self.root.norm(dim=-1), strict=True))

    def own_weight(self, theta: Float[Tensor, "... k"]) -> Float[Tensor, "... 3"]:
        """Of the whole robot (N, base frame)."""
        rod = self.robot.rod
        if not self._heavy:
            return rod.mass * self.robot.gravity
        at_points = float(rod.masses[:, 1].sum())
        of_rod, of_points = self._pulled(*self._errors(theta))
        return (rod.mass - at_points) * of_rod + at_points * of_points

    def _pulled(self, e: Mapping[str, Tensor], zero: Tensor) -> tuple[Float[Tensor, "... 3"], Float[Tensor, "... 3"]]:
        """What gravity (m/s^2) makes of each kg that the file gives the rod, and what hangs on it at points."""
        g, _ = turned_gravity(self.robot.gravity, torch.stack([e.get(name, zero) for name in GRAVITY], -1))
        return (1 + e.get("mass", zero)).unsqueeze(-1) * g, g

    def weight(self, kappa: Float[Tensor, "B m"]) -> Float[Tensor, "B 3"]:
        """Gravity force per length (N/m) of the rod, without what hangs at points, at amounts kappa."""
        first = self.counts.stiffness + self.counts.curvature
        return self.robot.weight + self.robot.rod.mass_per_length * kappa[:, first : first + 3]

    def warp(self, theta: Float[Tensor, "... k"]) -> Warp:
        """How positions are measured, of every sample."""
        e, zero = self._errors(theta)
        return Warp(*(torch.stack([e.get(name, zero) for name in names], -1) for names in (SHIFT, TURN, STRAIN)))

    @cached_property
    def warp_root(self) -> Float[Tensor, "12 k"]:
        """How the entries of `warp`, shift, turn and strain, move with theta."""
        rows = dict(zip(self.names, self.root, strict=True))
        return torch.stack([rows.get(name, torch.zeros_like(self.root[0])) for name in (*SHIFT, *TURN, *STRAIN)])

    def _changed(self, name: str, error: float) -> Robot:
        """The prepared robot with one error."""
        (change,) = (p.change for p in self.uncertainty.parameters(self.robot) if p.name == name)
        assert change is not None
        return change(self.prepared, error)

    @cached_property
    def _bent_robots(self) -> tuple[Robot, ...]:
        """With one unit of each error of the reference curvature."""
        return tuple(self._changed(name, 1.0) for name in self._bent)

    @cached_property
    def _sides(self) -> Mapping[str, tuple[float, tuple[Robot, Robot]]]:
        """Errors of an oval section, and robots that are off by so much, to one side and to the other."""
        step = SMALL * self.robot.rod.softer_side
        return {n: (step, (self._changed(n, step), self._changed(n, -step))) for n in OVAL if n in self.names}

    def along(self, places: Grid | Places) -> Along:
        """T_m of (1) at the stages of a grid, or at places."""
        robot, counts, s, inside = self.prepared, self.counts, places.stages, places.inside

        def stiffness(of: Robot) -> Float[Tensor, "S 3 18"]:
            rod = of.rod
            K = (rod.K_se, rod.K_bt) if rod.pieces is None else rod.pieces.stiffness(rod.K_se, rod.K_bt, s, inside)
            rows = torch.cat([part.flatten(-2) for part in K], -1)
            return rows if rod.pieces is not None else rows.expand(1, 1, 18)

        def side(name: str) -> Float[Tensor, "S 3 18"]:
            if name not in self._sides:
                return torch.zeros_like(stiffness(robot))
            step, (one, other) = self._sides[name]
            return (stiffness(one) - stiffness(other)) / (2 * step)

        K = [stiffness(robot)] if counts.stiffness else []
        K += [side(name) for name in OVAL] if counts.stiffness > 1 else []
        bent = [other.rod.curvature_at(s, inside) - robot.rod.curvature_at(s, inside) for other in self._bent_robots]
        hanging, pulling = [], None
        if counts.weight:
            hanging.append(robot.rod.mass_per_length * robot.rod.length_beyond(s, inside))
            if counts.weight > 3:  # by a gravity of 1 m/s^2
                of_points = replace(robot, gravity=torch.tensor([0.0, 0.0, 1.0], dtype=DTYPE)).point_weights.integrals(s, inside)
                assert of_points.Wn is not None
                hanging.append(of_points.Wn[..., 2].expand_as(hanging[0]))
        if counts.pull:
            pulling = (inside.detach().unsqueeze(-1) < torch.tensor(robot.tendons.ends, dtype=DTYPE)).to(DTYPE)
        of_K, of_u, of_W = (torch.stack(x) if x else None for x in (K, bent, hanging))
        return Along(of_K, of_u, of_W, pulling)

    def moved(self, tension: Float[Tensor, "... T"] | None, kappa: Float[Tensor, "... m"], places: Grid | Places) -> StageTable:
        """(1) at the stages of a grid, or at places, without loads; its section is there. tension: as it was read (N)."""
        robot, along = self.prepared, self.along(places)
        table = stage_table(robot, (), tension, places)
        of_K, of_u, of_W, of_pull, of_mu, of_place = kappa.split(self.counts, -1)
        W, u_star, t = table.loads.Wn, table.u_star, table.tendons
        of = table.section or Section.of(robot.rod.K_se.expand(1, 1, 3, 3), robot.rod.K_bt.expand(1, 1, 3, 3))
        if along.K is not None:
            more = _sum(of_K, along.K).unflatten(-1, (2, 3, 3))
            of = Section.of(of.K_se + more[..., 0, :, :], of.K_bt + more[..., 1, :, :])
        if along.u_star is not None:
            u_star = u_star + _sum(of_u, along.u_star)
        if along.hanging is not None:
            assert W is not None
            axes = torch.eye(3, dtype=DTYPE) * along.hanging[..., None, None]
            W = W + _sum(of_W, axes.movedim(-2, 1).flatten(0, 1))
        if t is not None:
            friction = t.friction
            if along.pulling is not None:
                t = replace(t, tau=t.tau + of_pull[..., None, None, :] * along.pulling)
            if self.counts.rubbing:
                assert friction is not None
                t = replace(t, friction=(friction + of_mu)[..., None, None, :].expand(*of_mu.shape[:-1], *t.tau.shape[-3:]))
            if self.counts.place:
                shift = torch.nn.functional.pad(of_place.unflatten(-1, (-1, 2)), (0, 1))
                t = replace(t, L=t.L + torch.nn.functional.pad(-hat(shift), (3, 0))[..., None, None, :, :, :])
        rows = {n: getattr(of, n).expand(*getattr(of, n).shape[:-4], *u_star.shape[-3:-1], 3, 3) for n in MATRICES}
        return StageTable(replace(table.loads, Wn=W), u_star, t, replace(of, **rows))


def _sum(amounts: Float[Tensor, "... m"], tables: Float[Tensor, "m *B S 3 i"]) -> Float[Tensor, "... S 3 i"]:
    return torch.einsum("...m,...mabi->...abi", amounts, tables.movedim(0, -4))
