"""The measurement: markers on the rod, and the model h(x) of what they show.

    x = [gamma, tip, theta, zeta, alpha]   ->   h(x) = [p_1 .. p_P, c]

gamma are the loads (torchrod.coordinates), tip an optional unknown wrench at the tip, theta optional errors of the tensions'
readings, zeta an optional registration twist, alpha the base wrench, c the tip residual: what the section carries just beyond
the tip (17), less R^T of the unknown wrench there.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.func import jvp, vmap

from .coordinates import LoadCoordinates
from .grid import DEFAULT_STEPS
from .jacobian import forward_jacobian
from .kept import kept
from .lie import move, rotate, unrotate
from .loads import LoadIntegrals, total
from .march import march_linearized
from .precision import Float64
from .robot import Robot
from .statics import Shape, base_state, beyond_tip, grid_for, shape_from_base, shape_of, stage_table
from .step import Section

COARSE_STEPS = 20  # along the rod, as long as a fit is far from the data: within 1e-6 m of the exact shape
TIP_FORCE_STD = 1e-3  # in force scales: 1 mN on the paper's rod
TIP_MOMENT_STD = 5e-4  # in moment scales: 0.1 mN m on the paper's rod
TIP_EXACT = 10.0  # the covariance of the result takes the tip residual as this much stiffer
TIP_UNKNOWNS = {"none": 0, "force": 3, "wrench": 6}
TIP_STD = 10.0  # of the weak prior on the unknown tip force and moment about zero, in force and moment scales
FRAME_SHIFT, FRAME_TURN = 0.05, 0.175  # of the length, and rad (10 degrees): where nothing better is known of a base frame
TURN_SCALE = 0.1  # rad, one unit of a registration angle; a unit of translation is this part of the rod's length


def _all_finite(positions: Float[Tensor, "B P 3"]) -> Bool[Tensor, "B P"]:
    x, y, z = torch.isfinite(positions).unbind(-1)  # .all(-1) takes three times as long
    return x & y & z


@dataclass(frozen=True)
class Markers(Float64):
    """Measured markers of B samples.

    s: (P,) m, arc lengths. positions: (B, P, 3) m, base frame, NaN where a marker is missing. offsets: (P, 3) m, from the centre
    line in the section frame, so that the marker sits at p(s) + R(s) r. tension: (B, T) N for a tendon robot. sigma: (B,) m, each
    sample's own noise, which then goes before the one that an estimate is given (torchrod.estimate_noise).
    """

    s: Float[Tensor, " P"]
    positions: Float[Tensor, "B P 3"]
    offsets: Float[Tensor, "P 3"] | None = None
    tension: Float[Tensor, "B T"] | None = None
    sigma: Float[Tensor, " B"] | None = None

    @property
    def misshapen(self) -> str | None:
        """What does not belong together, in one sentence; None where all does."""
        P, B = self.s.numel(), len(self.positions)
        shapes = {"s": (P,), "positions": (B, P, 3), "offsets": (P, 3), "tension": (B, None), "sigma": (B,)}
        for name, wanted in shapes.items():
            value = getattr(self, name)
            found = () if value is None else tuple(value.shape)
            fits = len(found) == len(wanted) and all(w in (None, n) for w, n in zip(wanted, found, strict=True))
            if value is not None and not fits:
                shown = str(wanted).replace("None", "tendons")
                return f"markers.{name} has shape {found}; with {P} arc lengths and {B} samples it must have {shown}"
        return None

    @property
    def present(self) -> Bool[Tensor, "B P"]:
        """Which markers were seen."""
        return kept(self, "_present", self.positions, _all_finite)

    def take(self, index: Int[Tensor, " b"]) -> "Markers":
        """The samples of an index."""
        tension, sigma = (None if x is None else x[index] for x in (self.tension, self.sigma))
        return Markers(self.s, self.positions[index], self.offsets, tension, sigma)


@dataclass(frozen=True)
class Model:
    """h(x) for one robot, one parameterization and one marker layout.

    scaled: alpha in the rod's force and moment scales and zeta in tenths of L and of a radian; otherwise in SI (the paper's).
    tip: "none", or the unknown dead "force" or "wrench" at the tip, in the base frame. It is known to the markers through the base
    wrench alone, so it costs no tangent of the march.
    tension_std: standard deviation (N) of the sensors of the tensions, which are then part of the state; None takes them as exact.
    frame_std: standard deviations (m, rad) of a component of the base frame's error, where they are better known than FRAME_SHIFT
    and FRAME_TURN say.
    tip_std: standard deviations (N, N m) of a component of the tip residual, W^-1/2 of the paper's W on c; None: TIP_FORCE_STD and
    TIP_MOMENT_STD in the rod's scales.
    """

    robot: Robot
    coordinates: LoadCoordinates
    registration: bool = False
    scaled: bool = True
    steps: int = DEFAULT_STEPS
    tip: str = "none"
    tension_std: float | None = None
    frame_std: tuple[float, float] | None = None
    tip_std: tuple[float, float] | None = None

    @cached_property
    def coarse(self) -> "Model":
        """The same with no more than COARSE_STEPS steps along the rod."""
        return self if self.steps <= COARSE_STEPS else replace(self, steps=COARSE_STEPS)

    @property
    def tension_size(self) -> int:
        """How many entries of x are errors of tensions, in units of tension_std."""
        return 0 if self.tension_std is None else len(self.robot.tendons)

    @property
    def free_size(self) -> int:
        """How many entries of x only the markers determine: neither alpha, which (17) holds, nor theta, which has a prior."""
        return self.size - 6 - self.tension_size

    @property
    def load_size(self) -> int:
        """How many entries of x are external loads: gamma and the unknown wrench at the tip."""
        return self.coordinates.size + TIP_UNKNOWNS[self.tip]

    @property
    def size(self) -> int:
        """The length of x."""
        return self.load_size + self.tension_size + 6 * self.registration + 6

    def _scale_of(self, x: Tensor, first: float, second: float) -> Float[Tensor, " 6"]:
        return x.new_tensor([first] * 3 + [second] * 3) if self.scaled else x.new_ones(6)

    def alpha_scale(self, x: Tensor) -> Float[Tensor, " 6"]:
        """One unit of alpha's entries in x: the rod's force and moment scales (N, N m), or 1."""
        return self._scale_of(x, self.robot.rod.force_scale, self.robot.rod.moment_scale)

    def zeta_scale(self, x: Tensor) -> Float[Tensor, " 6"]:
        """One unit of zeta's entries in x (m, rad): tenths of L and of a radian, or 1."""
        return self._scale_of(x, TURN_SCALE * self.robot.rod.length, TURN_SCALE)

    def split(
        self, x: Float[Tensor, "... n"]
    ) -> tuple[Float[Tensor, "... g"], Float[Tensor, "... 6"] | None, Float[Tensor, "... 6"]]:
        """gamma, zeta [m, rad] (None without registration) and alpha [N, N m]."""
        cuts = [self.coordinates.size, self.load_size + self.tension_size, self.size - 6]
        gamma, _, zeta, alpha = x.tensor_split(cuts, -1)
        zeta = zeta * self.zeta_scale(x) if self.registration else None
        return gamma, zeta, alpha * self.alpha_scale(x)

    def tip_wrench(self, x: Float[Tensor, "... n"]) -> Float[Tensor, "... 6"]:
        """The unknown force (N) and moment (N m) at the tip, base frame; zero where they are not unknown."""
        tip = x[..., self.coordinates.size : self.load_size]
        return torch.nn.functional.pad(tip, (0, 6 - tip.shape[-1])) * self.alpha_scale(x)

    def tension(self, x: Float[Tensor, "... n"], reading: Float[Tensor, "... T"] | None) -> Float[Tensor, "... T"] | None:
        """The tensions (N) that x takes to be pulling: the readings, with their errors where those are unknown."""
        if self.tension_std is None or reading is None:
            return reading
        return reading + self.tension_std * x[..., self.load_size : self.load_size + self.tension_size]

    def join(self, gamma: Float[Tensor, "B g"], alpha: Float[Tensor, "B 6"]) -> Float[Tensor, "B n"]:
        """x from loads and a base wrench (N, N m), with nothing unknown at the tip and neither tension nor registration error."""
        between = alpha.new_zeros(alpha.shape[0], TIP_UNKNOWNS[self.tip] + self.tension_size + 6 * self.registration)
        return torch.cat([gamma, between, alpha / self.alpha_scale(alpha)], -1)

    def shape(self, x: Float[Tensor, "... n"], markers: Markers, differentiable: bool = True) -> Shape:
        """The rod at the markers' arc lengths, in its own base frame."""
        gamma, _, alpha = self.split(x)
        loads = self.coordinates.loads(gamma)
        tension = self.tension(x, markers.tension)
        return shape_from_base(self.robot, loads, alpha, tension, markers.s, self.steps, differentiable)

    def h(self, x: Float[Tensor, "... n"], markers: Markers, differentiable: bool = True) -> Float[Tensor, "... z"]:
        """[p_1 .. p_P (m), c (N, N m)], (..., 3 P + 6): marker positions in the measured frame, then the tip residual."""
        return self._seen(self.shape(x, markers, differentiable), x, markers)

    def _seen(self, shape: Shape, x: Float[Tensor, "... n"], markers: Markers) -> Float[Tensor, "... z"]:
        """What the markers show of a shape."""
        p = shape.p if markers.offsets is None else shape.p + rotate(shape.q, markers.offsets)
        _, zeta, _ = self.split(x)
        if zeta is not None:
            p = move(zeta, p)
        c = shape.tip_residual
        if self.tip != "none":
            wrench = self.tip_wrench(x).unflatten(-1, (2, 3))
            c = c - unrotate(shape.tip_q.unsqueeze(-2), wrench).flatten(-2)
        return torch.cat([p.flatten(-2), c], -1)

    def linearized(self, x: Float[Tensor, "B n"], markers: Markers) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"]]:
        """h(x) and H = dh/dx.

        The rod's share of the tangents goes through `march_linearized`, which has a compiled path; what comes before it (load
        integrals of gamma) and after it (offsets, registration, tip residual) by torch.func. The same as forward_jacobian(h),
        which is what is used where the nodes move with x (point loads at unknown places) or tensions are unknown.
        """
        gamma, _, alpha = self.split(x)
        loads = self.coordinates.loads(gamma)
        grid = grid_for(self.robot, loads, markers.s, self.steps)
        if grid.nodes.ndim > 1 or self.tension_size:
            return forward_jacobian(lambda x: self.h(x, markers), x)
        g, B, S = self.coordinates.size, len(x), grid.h.shape[-1]
        like = x.new_zeros(())

        def integrals(gamma: Float[Tensor, "B g"]) -> Float[Tensor, "B m"]:
            """[G, G2] at every stage, then just beyond the tip."""
            loads = self.coordinates.loads(gamma)
            along, beyond = total(loads, grid.stages, grid.inside), beyond_tip(self.robot, loads, like)
            assert along.G is not None and along.G2 is not None and beyond.G is not None and beyond.G2 is not None
            return torch.cat([torch.cat([along.G, along.G2], -1).reshape(B, 18 * S), beyond.G, beyond.G2], -1)

        value, slope = forward_jacobian(integrals, gamma)
        G, dG = value[:, :-6].reshape(B, S, 3, 6), slope[:, :-6].reshape(B, S, 3, 6, g)
        known = stage_table(self.robot, (), markers.tension, grid)
        table = replace(known, loads=known.loads + LoadIntegrals(G[..., :3], G[..., 3:]))
        dy0 = x.new_zeros(B, 13, g + 6)
        dy0[:, range(7, 13), range(g, g + 6)] = self.alpha_scale(x)
        y0 = base_state(self.robot, alpha, table)
        section = Section.of(self.robot.rod.K_se, self.robot.rod.K_bt)
        states, tangents = march_linearized(section, y0, dy0, table, dG, grid, grid.outputs_and_tip)
        return self._after(section, states, tangents, value[:, -6:], slope[:, -6:], x, markers)

    def _after(
        self,
        section: Section,
        states: Float[Tensor, "B P1 13"],
        tangents: Float[Tensor, "B P1 13 m"],
        beyond: Float[Tensor, "B 6"],
        dbeyond: Float[Tensor, "B 6 g"],
        x: Float[Tensor, "B n"],
        markers: Markers,
    ) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"]]:
        """h and H from the marched states and the loads beyond the tip, and how they move with gamma and alpha."""
        g, n = self.coordinates.size, self.size
        where = torch.tensor([*range(g), *range(n - 6, n)])
        d_states = tangents.new_zeros(n, *states.shape).index_copy(0, where, tangents.movedim(-1, 0))
        d_beyond = beyond.new_zeros(n, *beyond.shape).index_copy(0, where[:g], dbeyond.movedim(-1, 0))

        def seen(states: Tensor, beyond: Tensor, x: Tensor) -> Tensor:
            return self._seen(shape_of(section, states, LoadIntegrals(beyond[..., :3], beyond[..., 3:])), x, markers)

        def column(ds: Tensor, db: Tensor, e: Tensor) -> tuple[Tensor, Tensor]:
            value, tangent, *_ = jvp(seen, (states, beyond, x), (ds, db, e.expand_as(x).contiguous()))
            return value, tangent

        axes = vmap(column, out_dims=(None, 0))  # pyright: ignore[reportArgumentType]
        h, columns = axes(d_states, d_beyond, torch.eye(n, dtype=x.dtype))
        return h, columns.movedim(0, -1)

    def tip_weights(self, like: Tensor) -> Float[Tensor, " 6"]:
        """1 / variance of the tip residual c (1/N^2, 1/(N m)^2): stiff, so that (17) holds to a milli-force-scale."""
        rod = self.robot.rod
        force, moment = self.tip_std or (TIP_FORCE_STD * rod.force_scale, TIP_MOMENT_STD * rod.moment_scale)
        return like.new_tensor([force] * 3 + [moment] * 3) ** -2

    def weights(self, markers: Markers, noise: float) -> Float[Tensor, "B z"]:
        """The diagonal of W: 1 / noise^2 for a marker that was seen, 0 for a missing one, then the tip residual's."""
        tip = self.tip_weights(markers.s)
        seen = markers.present.to(tip.dtype).repeat_interleave(3, -1)
        variance = noise**2 if markers.sigma is None else markers.sigma.unsqueeze(-1) ** 2
        return torch.cat([seen / variance, tip.expand(len(seen), 6)], -1)

    def exact_weights(self, w: Float[Tensor, "B z"]) -> Float[Tensor, "B z"]:
        """W with the tip residual ten times stiffer: for the covariance of the result, not for the way there.

        In truth (17) holds exactly. The slack that eases the iteration would widen the regions that are reported: by 1.6 across the
        force, in Study 1 with 1 mm noise.
        """
        return torch.cat([w[:, :-6], TIP_EXACT**2 * w[:, -6:]], -1)

    def prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Mean and precision of every entry of x."""
        return self._prior

    @cached_property
    def _prior(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """The loads' own; weak on tip, 1 on theta, none on alpha, which (17) holds.

        zeta is zero within frame_std, else FRAME_SHIFT and FRAME_TURN: what a base frame is off by after it was once set up. A
        wider prior lets an unlikely frame pass for a push near the base, a narrower one is worth having (docs/trust.md).
        """
        mean, precision = self.coordinates.prior()
        tip = mean.new_full((TIP_UNKNOWNS[self.tip],), TIP_STD**-2)
        shift, turn = self.frame_std or (FRAME_SHIFT * self.robot.rod.length, FRAME_TURN)
        off = mean.new_tensor([shift] * 3 + [turn] * 3)
        zeta = (self.zeta_scale(mean) / off) ** 2 if self.registration else mean[:0]
        held = torch.cat([tip, mean.new_ones(self.tension_size), zeta, mean.new_zeros(6)])
        return torch.cat([mean, torch.zeros_like(held)]), torch.cat([precision, held])
