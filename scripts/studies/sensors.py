"""Every sensor on the paper's steel rod under one push: what it reads, its noise, and the Cramer-Rao bound of what it tells.

The truth is the forward solve's; orientations and positions are its own, strains their differences along the rod, and everything
else is worked out from those here, not by the library's sensors.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import roma
import torch
from torch import Tensor

from studies.reproduction.cases import L, steel_rod
from torchrod import (
    BaseWrench,
    Camera,
    CentreLine,
    CoreStrains,
    Curvature,
    Directions,
    GaussianCoordinates,
    GaussianLoads,
    Markers,
    PointForces,
    PointWrenches,
    Poses,
    Problem,
    Robot,
    Sensor,
    Tendon,
    Tendons,
    TipWrench,
    Uncertainty,
    Unknowns,
    estimate,
    sampled_intervals,
    solve_shape,
)

D = torch.float64
ROBOT = steel_rod()
DS = 1e-4  # m: over which strains are differences
FEW, MANY = (torch.linspace(first, L, count, dtype=D) for first, count in ((0.08, 5), (0.02, 20)))
GRATINGS = torch.linspace(0.01, L - 0.01, 20, dtype=D)
CORES, RADIUS = torch.arange(4, dtype=D) * (math.pi / 2) + 0.3, 3e-4
POINTS = torch.linspace(0.01, L - 0.004, 60, dtype=D)  # m: where the points of a centre line are in truth
ALONG = torch.linspace(0, L, 81, dtype=D)
NORMAL = torch.tensor([0.6, 0.0, 0.8], dtype=D)  # a coil's axis in the section
LENS = torch.tensor([-0.2, 0.05, 1e-3, -5e-4, 0.0], dtype=D)
MATRIX = torch.tensor([[1400.0, 0.0, 640.0], [0.0, 1400.0, 512.0], [0.0, 0.0, 1.0]], dtype=D)
WIDTH = L / 100  # m: of a point-like load
STEPS = 80


@dataclass(frozen=True)
class Sections:
    """The true rod at P places: p (B, P, 3) m, R (B, P, 3, 3), v, u (B, P, 3), base wrench and tip wrench (B, 6), R at the tip."""

    p: Tensor
    R: Tensor
    v: Tensor
    u: Tensor
    base: Tensor
    tip: Tensor
    R_tip: Tensor


@dataclass(frozen=True)
class Form:
    """One way to measure: at s, raw numbers (B, k) of true sections, their noise, and the library's sensor that is told them.

    information: (B, n, n) from dz (n, B, k), how the raw numbers move with the unknowns; by default of independent noise `std`.
    tip: whether it reads the force at the tip, which is then unknown.
    """

    s: Tensor
    raw: Callable[[Sections], Tensor]
    std: Tensor
    sensor: Callable[[Tensor], Sensor]
    noisy: Callable[[Tensor, Tensor], Tensor] | None = None
    information: Callable[[Tensor, Sections], Tensor] | None = None
    tip: bool = False

    def told(self, at: Sections, draw: Tensor | None = None) -> Sensor:
        """The sensor that reads these sections, with standard normal draws (B, k) of noise, or without."""
        z = self.raw(at)
        if draw is not None:
            z = z + self.std * draw if self.noisy is None else self.noisy(z, draw)
        return self.sensor(z)

    def tells(self, dz: Tensor, at: Sections) -> Tensor:
        """The Fisher information of the unknowns."""
        if self.information is not None:
            return self.information(dz, at)
        scaled = dz / self.std
        return torch.einsum("ibk,jbk->bij", scaled, scaled)


def _flat(x: Tensor) -> Tensor:
    return x.flatten(1)


def _in_threes(z: Tensor) -> Tensor:
    return z.unflatten(-1, (-1, 3))


def _turned(z: Tensor, draw: Tensor, std: float) -> Tensor:
    """Rotation matrices (B, 9 P) turned at random."""
    R = z.unflatten(-1, (-1, 3, 3))
    return (R @ roma.rotvec_to_rotmat(std * draw[:, : R.shape[1] * 3].unflatten(-1, (-1, 3)))).flatten(1)


def _by_covariance(dz: Tensor, C: Tensor) -> Tensor:
    """Information from positions (B, 3 P) with covariances (B, P, 3, 3) or (P, 3, 3)."""
    d = dz.unflatten(-1, (-1, 3))
    return torch.einsum("ibpk,bpkl,jbpl->bij", d, torch.linalg.inv(C).expand(d.shape[1], -1, 3, 3), d)


def markers(s: Tensor = MANY, noise: float = 1e-3) -> Form:
    """Positions."""
    return Form(s, lambda at: _flat(at.p), torch.full((3 * len(s),), noise), lambda z: Markers(s, _in_threes(z), noise))


def own_noise() -> Form:
    """Positions of which each marker has its own noise."""
    std = torch.linspace(5e-4, 3e-3, len(MANY))
    return Form(MANY, lambda at: _flat(at.p), std.repeat_interleave(3), lambda z: Markers(MANY, _in_threes(z), std.unsqueeze(0)))


def stereo() -> Form:
    """Positions of which the depth, along (1, 1, 1), is five times less certain."""
    way = torch.ones(3) / math.sqrt(3)
    C = (1e-6 * torch.eye(3) + 24e-6 * way.outer(way)).expand(len(MANY), 3, 3)
    root = torch.linalg.cholesky(C)

    def noisy(z: Tensor, draw: Tensor) -> Tensor:
        return z + (root @ _in_threes(draw).unsqueeze(-1)).squeeze(-1).flatten(1)

    def information(dz: Tensor, at: Sections) -> Tensor:
        return _by_covariance(dz, C)

    std = torch.ones(3 * len(MANY))
    return Form(MANY, lambda at: _flat(at.p), std, lambda z: Markers(MANY, _in_threes(z), C), noisy, information)


def uncertain_s(noise: float = 3e-4, s_std: float = 2e-3) -> Form:
    """Positions of markers that are not quite where they are said to be. The raw numbers: p, then R v."""
    inner = torch.linspace(0.03, L - 0.01, 20)
    P = len(inner)

    def raw(at: Sections) -> Tensor:
        along = (at.R @ at.v.unsqueeze(-1)).squeeze(-1)
        bend = (at.R @ torch.linalg.cross(at.u, at.v).unsqueeze(-1)).squeeze(-1)
        return torch.cat([_flat(at.p), _flat(along), _flat(bend)], -1)

    def noisy(z: Tensor, draw: Tensor) -> Tensor:
        p, along, bend = (part.unflatten(-1, (-1, 3)) for part in z.split(3 * P, -1))
        slip = s_std * draw[:, :P].unsqueeze(-1)
        seen = p + slip * along + slip**2 / 2 * bend + noise * draw[:, P : 4 * P].unflatten(-1, (-1, 3))
        return torch.cat([seen.flatten(1), z[:, 3 * P :]], -1)

    def information(dz: Tensor, at: Sections) -> Tensor:
        along = (at.R @ at.v.unsqueeze(-1)).squeeze(-1)
        C = noise**2 * torch.eye(3) + s_std**2 * along.unsqueeze(-1) * along.unsqueeze(-2)
        return _by_covariance(dz[..., : 3 * P], C)

    def sensor(z: Tensor) -> Markers:
        return Markers(inner, _in_threes(z[:, : 3 * P]), noise, s_std=torch.full((P,), s_std))

    return Form(inner, raw, torch.ones(9 * P), sensor, noisy, information)


def poses(s: Tensor = FEW, noise: float = 5e-4, angle: float = math.radians(0.5)) -> Form:
    """Positions and orientations. The raw numbers: p, then R."""
    P = len(s)

    def noisy(z: Tensor, draw: Tensor) -> Tensor:
        p, R = z.split([3 * P, 9 * P], -1)
        return torch.cat([p + noise * draw[:, : 3 * P], _turned(R, draw[:, 3 * P :], angle)], -1)

    def sensor(z: Tensor) -> Poses:
        p, R = z.split([3 * P, 9 * P], -1)
        return Poses(s, _in_threes(p), roma.rotmat_to_unitquat(R.unflatten(-1, (-1, 3, 3))), noise, angle)

    std = torch.cat([torch.full((3 * P,), noise), torch.full((9 * P,), angle * math.sqrt(2))])  # |dR|^2 = 2 |dphi|^2
    return Form(s, lambda at: torch.cat([_flat(at.p), _flat(at.R)], -1), std, sensor, noisy)


def directions(placed: bool = False, noise: float = 5e-4, angle: float = math.radians(0.5)) -> Form:
    """The axes of five coils, or ten without positions. The raw numbers: the axes, then, where they are read, p."""
    s = FEW if placed else torch.linspace(0.04, L, 10)
    P = len(s)

    def raw(at: Sections) -> Tensor:
        return torch.cat([_flat(at.R @ NORMAL), _flat(at.p)], -1)

    def noisy(z: Tensor, draw: Tensor) -> Tensor:
        axes, p = z.split(3 * P, -1)
        turned = roma.rotvec_to_rotmat(angle * _in_threes(draw[:, : 3 * P])) @ _in_threes(axes).unsqueeze(-1)
        return torch.cat([turned.flatten(1), p + noise * draw[:, 3 * P :]], -1)

    def sensor(z: Tensor) -> Directions:
        axes, p = (_in_threes(part) for part in z.split(3 * P, -1))
        return Directions(s, axes, angle, NORMAL.expand(P, 3), p if placed else None, noise if placed else None)

    std = torch.cat([torch.full((3 * P,), angle), torch.full((3 * P,), noise if placed else math.inf)])
    return Form(s, raw, std, sensor, noisy)


def curvature(noise: float = 0.05) -> Form:
    """u_x and u_y at 20 gratings."""
    std = torch.full((2 * len(GRATINGS),), noise)
    return Form(GRATINGS, lambda at: _flat(at.u[..., :2]), std, lambda z: Curvature(GRATINGS, z.unflatten(-1, (-1, 2)), noise))


def core_strains(noise: float = 1.5e-5) -> Form:
    """Four cores at 20 gratings, each grating with a temperature of its own."""
    C, P = len(CORES), len(GRATINGS)
    x, y = RADIUS * CORES.cos(), RADIUS * CORES.sin()

    def raw(at: Sections) -> Tensor:
        return _flat(at.v[..., 2:] - 1 + at.u[..., :1] * y - at.u[..., 1:2] * x)

    def noisy(z: Tensor, draw: Tensor) -> Tensor:
        warm = 1e-3 * torch.sin(torch.arange(P) + 7 * draw[:, :1]).repeat_interleave(C, -1)
        return z + warm + noise * draw

    def information(dz: Tensor, at: Sections) -> Tensor:
        d = dz.unflatten(-1, (P, C))
        d = (d - d.mean(-1, keepdim=True)) / noise
        return torch.einsum("ibpk,jbpk->bij", d, d)

    def sensor(z: Tensor) -> CoreStrains:
        return CoreStrains(GRATINGS, z.unflatten(-1, (P, C)), CORES, RADIUS, noise)

    return Form(GRATINGS, raw, torch.ones(C * P), sensor, noisy, information)


def base_wrench(force: float = 0.02, moment: float = 2e-3) -> Form:
    """Under the robot."""
    std = torch.tensor([force] * 3 + [moment] * 3)
    return Form(torch.zeros(0), lambda at: at.base, std, lambda z: BaseWrench(z, force, moment))


def tip_wrench(force: float = 0.02, moment: float = 2e-3) -> Form:
    """In the axes of the last section."""
    std = torch.tensor([force] * 3 + [moment] * 3)

    def raw(at: Sections) -> Tensor:
        return torch.einsum("bji,bkj->bki", at.R_tip, at.tip.unflatten(-1, (2, 3))).flatten(1)

    return Form(torch.zeros(0), raw, std, lambda z: TipWrench(z, force, moment), tip=True)


def centre_line(noise: float = 1e-3, ordered: bool = False) -> Form:
    """60 points without arc lengths."""

    def information(dz: Tensor, at: Sections) -> Tensor:
        t = torch.nn.functional.normalize((at.R @ at.v.unsqueeze(-1)).squeeze(-1), dim=-1)
        d = dz.unflatten(-1, (-1, 3))
        d = (d - (d * t).sum(-1, keepdim=True) * t) / noise
        return torch.einsum("ibpk,jbpk->bij", d, d)

    std = torch.full((3 * len(POINTS),), noise)
    return Form(POINTS, lambda at: _flat(at.p), std, lambda z: CentreLine(ALONG, _in_threes(z), noise, ordered), None, information)


def camera(where: Sequence[float] = (0.8, 0.1, 0.2), noise: float = 0.3) -> Form:
    """One camera at a place in the base frame (m), that looks at the middle of the rod."""
    eye = torch.tensor(where)
    forward = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, L / 2]) - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    R = torch.stack([right, torch.linalg.cross(forward, right), forward])
    t = -R @ eye

    def raw(at: Sections) -> Tensor:
        X, Y, Z = (at.p @ R.mT + t).unbind(-1)
        x, y = X / Z, Y / Z
        r2 = x**2 + y**2
        radial = 1 + LENS[0] * r2 + LENS[1] * r2**2 + LENS[4] * r2**3
        u = x * radial + 2 * LENS[2] * x * y + LENS[3] * (r2 + 2 * x**2)
        v = y * radial + LENS[2] * (r2 + 2 * y**2) + 2 * LENS[3] * x * y
        return torch.stack([MATRIX[0, 0] * u + MATRIX[0, 2], MATRIX[1, 1] * v + MATRIX[1, 2]], -1).flatten(1)

    std = torch.full((2 * len(MANY),), noise)
    return Form(MANY, raw, std, lambda z: Camera(MANY, z.unflatten(-1, (-1, 2)), noise, MATRIX, R, t, LENS))


OTHER_EYE = (0.1, 0.8, 0.2)
RUBBING = Robot(ROBOT.rod, Tendons(tuple(Tendon(((0.0, x, 0.0),), L, friction=0.2) for x in (0.007, -0.007))))
FEW_DRAWN = 100  # pushes, on a robot that is only nearly known


@dataclass(frozen=True)
class Push:
    """Forces (B, 2) N at places (B,) m, in the section frame, and a dead force (B, 3) N at the tip, base frame, on robots with
    tensions (T,) N that are so many times (B,) as stiff as `robot`.
    """

    force: Tensor
    place: Tensor
    tip: Tensor
    stiffer: Tensor
    robot: Robot = ROBOT
    tension: Tensor | None = None

    def at(self, s: Tensor) -> Sections:
        """The true sections at s under point forces."""
        force = torch.cat([self.force, torch.zeros_like(self.place).unsqueeze(-1)], -1)
        return self.under(PointForces(self._less(force).unsqueeze(1), self.place.unsqueeze(1)), s)

    def spread(self, c: Tensor, s: Tensor) -> Sections:
        """The same with Gaussians of sharpness c (B,) 1/m^2."""
        a = self._less(self.force) * (c / math.pi).sqrt().unsqueeze(-1)
        return self.under(GaussianLoads(a.unsqueeze(1), self.place.unsqueeze(1), c.unsqueeze(-1)), s)

    def _less(self, force: Tensor) -> Tensor:
        """On a robot k times as stiff a force does what the kth part of it does on `robot`."""
        return force / self.stiffer.unsqueeze(-1)

    def under(self, load: PointForces | GaussianLoads, s: Tensor) -> Sections:
        """The sections under a load that is already less, and what else there is."""
        B, P = len(self.place), len(s)
        tip = self._less(self.tip).unsqueeze(1)
        tension = None if self.tension is None else self._less(self.tension.expand(B, -1))
        below, above = (s - DS).clamp(min=0), (s + DS).clamp(max=L)
        at = torch.cat([s, below, above, torch.tensor([L])])
        loads = (load, PointWrenches(tip, torch.zeros_like(tip), torch.tensor([L])))
        shape = solve_shape(self.robot, loads, tension, at, B, STEPS)
        p, R = shape.p, roma.unitquat_to_rotmat(shape.q)
        h = (above - below).unsqueeze(-1)
        u = roma.rotmat_to_rotvec(R[:, P : 2 * P].mT @ R[:, 2 * P : 3 * P]) / h
        v = (R[:, :P].mT @ ((p[:, 2 * P : 3 * P] - p[:, P : 2 * P]) / h).unsqueeze(-1)).squeeze(-1)
        wrench = torch.cat([self.tip, torch.zeros_like(self.tip)], -1)
        return Sections(p[:, :P], R[:, :P], v, u, self.stiffer.unsqueeze(-1) * shape.base_wrench, wrench, R[:, -1])


@dataclass(frozen=True)
class Judged:
    """One number of a push: rms error (SI) of the fits, the same over the bound; the mean of their standard deviation over the
    bound's; the shares of 95 % intervals that hold it, of the covariance's and of those from draws.
    """

    error: float
    over_bound: float
    spread: float
    covered: float
    drawn: float


@dataclass(frozen=True)
class Coverage:
    """accepted: a share. Of accepted fits: force, and place."""

    accepted: float
    force: Judged
    place: Judged


@dataclass(frozen=True)
class Case:
    """What measures at once, on a robot with tensions (N) whose stiffness is known to a standard deviation (relative).

    drawn: of how many pushes there are draws, at most; 0 where each takes a second.
    """

    forms: tuple[Form, ...]
    robot: Robot = ROBOT
    tension: tuple[float, ...] = ()
    stiffness: float = 0.0
    drawn: int = 500

    @property
    def tip(self) -> bool:
        """Whether the force at the tip is unknown."""
        return any(form.tip for form in self.forms)

    def pushes(self, count: int, seed: int) -> Push:
        """0.5 to 1 N at 10 to 39 cm, as in Study 1, and up to 0.1 N in each direction at the tip."""
        generator = torch.Generator().manual_seed(seed)
        size, angle, place = torch.rand(3, count, generator=generator)
        size, angle = 0.5 + 0.5 * size, 2 * math.pi * angle
        force = torch.stack([size * angle.cos(), size * angle.sin()], -1)
        tip = (0.2 * torch.rand(count, 3, generator=generator) - 0.1) * self.tip
        stiffer = 1 + self.stiffness * torch.randn(count, generator=generator)
        return Push(force, 0.1 + 0.29 * place, tip, stiffer, self.robot, torch.tensor(self.tension) if self.tension else None)

    @property
    def unknowns(self) -> Unknowns:
        """One point-like contact, the force at the tip where a cell reads it, and the stiffness where it is not quite known."""
        loads = GaussianCoordinates(1, L, ROBOT.rod.force_scale, "point")
        nearly = Uncertainty(stiffness=self.stiffness) if self.stiffness else None
        return Unknowns(loads, "force" if self.tip else "none", uncertainty=nearly)

    def problem(self, push: Push, seed: int | None = None) -> Problem:
        """What these sensors read of a push, with noise (seed) or without."""
        sensors = []
        for i, form in enumerate(self.forms):
            at = push.at(form.s)
            chance = None if seed is None else torch.Generator().manual_seed(seed + 1000 * (i + 1))  # not that of the pushes
            sensors.append(form.told(at, None if chance is None else torch.randn(form.raw(at).shape, generator=chance)))
        tension = None if push.tension is None else push.tension.expand(len(push.place), -1)
        return Problem(self.robot, self.unknowns, sensors, tension)

    def bound(self, push: Push) -> Tensor:
        """The Cramer-Rao bound (B, n, n) of [F_x, F_y (N), place (m), log c, tip force (N), stiffness], the last where they are
        unknown, by differences of the forward solve.

        The load is a Gaussian as wide as the estimator takes a point-like one to be, +-1 in log c; the priors of tip and stiffness
        count as well.
        """
        B = len(push.place)
        at = torch.cat(
            [
                push.force,
                push.place.unsqueeze(-1),
                torch.full((B, 1), math.log(0.5 / WIDTH**2)),
                push.tip,
                push.stiffer.unsqueeze(-1),
            ],
            -1,
        )
        free = [0, 1, 2, 3, *[4, 5, 6] * self.tip, *[7] * bool(self.stiffness)]
        step = torch.tensor([1e-3, 1e-3, 1e-4, 1e-2, 1e-3, 1e-3, 1e-3, 1e-3])
        known = torch.tensor([0.0, 0.0, 0.0, 1.0, *[(10 * ROBOT.rod.force_scale) ** -2] * 3, 0.0])
        if self.stiffness:
            known[7] = self.stiffness**-2

        def under(theta: Tensor, s: Tensor) -> Sections:
            own = replace(push, force=theta[:, :2], place=theta[:, 2], tip=theta[:, 4:7], stiffer=theta[:, 7])
            return own.spread(theta[:, 3].exp(), s)

        information = torch.diag(known[free]).expand(B, -1, -1)
        for form in self.forms:
            dz = []
            for k in free:
                d = step[k] * torch.eye(8)[k]
                dz.append((form.raw(under(at + d, form.s)) - form.raw(under(at - d, form.s))) / (2 * step[k]))
            information = information + form.tells(torch.stack(dz), under(at, form.s))
        return torch.linalg.inv(information)

    def coverage(self, count: int, seed: int, drawn: bool = True) -> Coverage:
        """Fits of so many pushes with noise, of which only those accepted have a say. drawn: whether there are draws."""
        push = self.pushes(count, seed)
        problem = self.problem(push, seed)
        fit = estimate(problem)
        rows = torch.arange(min(count, self.drawn))
        draws = sampled_intervals(problem.take(rows), fit.of(rows, problem.size)) if drawn and len(rows) else None
        C, size, ok = self.bound(push), push.force.norm(dim=-1), fit.accepted
        along = push.force / size.unsqueeze(-1)
        variance = {"magnitude": (along.unsqueeze(1) @ C[:, :2, :2] @ along.unsqueeze(-1)).flatten(), "location": C[:, 2, 2]}

        def judged(name: str, truth: Tensor) -> Judged:
            found, std, normal = (getattr(fit, f"{name}{what}")[:, 0] for what in ("", "_std", "_interval"))
            bound = variance[name].sqrt()

            def held(interval: Tensor) -> float:
                most = len(interval)
                inside = (truth[:most] >= interval[:, 0]) & (truth[:most] <= interval[:, 1])
                return float(inside[ok[:most]].double().mean())

            by_draws = math.nan
            if draws is not None:
                own = getattr(draws, name)[:, 0]
                by_draws = held(torch.where(own.isnan(), normal[: len(own)], own))
            off = (found - truth)[ok]
            over = float((off / bound[ok]).square().mean().sqrt())
            return Judged(float(off.square().mean().sqrt()), over, float((std / bound)[ok].mean()), held(normal), by_draws)

        return Coverage(float(ok.double().mean()), judged("magnitude", size), judged("location", push.place))


CASES: dict[str, Callable[[], Case]] = {
    "20 markers, 1 mm": lambda: Case((markers(),)),
    "20 markers, 0.5 to 3 mm": lambda: Case((own_noise(),)),
    "20 markers, 1 mm, 5 mm in depth": lambda: Case((stereo(),)),
    "20 markers, 0.3 mm, s off by 2 mm": lambda: Case((uncertain_s(),)),
    "5 poses, 0.5 mm, 0.5 degrees": lambda: Case((poses(),)),
    "10 directions, 0.5 degrees": lambda: Case((directions(),)),
    "5 directions, 0.5 degrees, with positions, 0.5 mm": lambda: Case((directions(True),)),
    "20 gratings, 0.05 1/m": lambda: Case((curvature(),)),
    "20 gratings of 4 cores, 15 microstrain": lambda: Case((core_strains(),)),
    "base wrench, 20 mN, 2 mN m": lambda: Case((base_wrench(),)),
    "centre line, 60 points, 1 mm": lambda: Case((centre_line(),)),
    "centre line, ordered": lambda: Case((centre_line(ordered=True),)),
    "one camera, 0.3 px": lambda: Case((camera(),)),
    "two cameras, 0.3 px": lambda: Case((camera(), camera(OTHER_EYE))),
    "20 gratings and a tip pose": lambda: Case((curvature(), poses(MANY[-1:]))),
    "5 markers, base wrench, tip wrench": lambda: Case((markers(FEW), base_wrench(), tip_wrench())),
    "one camera and the gratings": lambda: Case((camera(), curvature())),
    "centre line and 5 directions": lambda: Case((centre_line(), directions(True))),
    "20 markers and base wrench, stiffness known to 10 %": lambda: Case((markers(), base_wrench()), stiffness=0.1, drawn=FEW_DRAWN),
    "20 gratings of 4 cores, two tendons that rub": lambda: Case((core_strains(),), RUBBING, (3.0, 1.0), drawn=0),
}
