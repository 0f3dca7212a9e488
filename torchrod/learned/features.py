"""Markers as a dimensionless picture that is the same for every rod, layout and direction: what a learned start reads.

(1) Displacement. y_i = (p_i - p0(s_i)) / L, with p0 the robot under its tensions and its weight but without the unknown load.

(2) Onto a grid. A weak load f bends a clamped beam (L = EI = 1) to y(s) = int g(s, t) f(t) dt, with curvature by k likewise:

        g(s, t) = t^2 (3 s - t) / 6 for t < s,  s^2 (3 t - s) / 6 otherwise;     k(s, t) = max(t - s, 0)

    With a white-noise prior on f of intensity q^2 the best linear guess of y and k on a grid from the markers seen is (kriging)

        [y, k](grid) = [Kgg, Kkg] (Kss + sigma^2 I)^-1 y_seen,     Kgs = q^2 int g(grid, t) g(s, t) dt, and so on.

    It takes any layout; a marker that is missing is left out.

(3) Size. amp = rms over the grid of the lateral curvature. Deflection and curvature are divided by it: to first order what is left
    depends only on where the load is, and the force is in proportion to amp.

(4) Direction. The frame is turned about z so that the net bend lies on +x, and mirrored in y so that the rest lies on +y. What is
    learned for one direction then holds for all.

(5) What else there is: log amp, amp (large bends are not linear), log sigma, log(sigma / amp), the prior's log c, log(20 / markers
    seen). For a robot with tendons or weight, at 4 stations: the tendons' pull over the rod's force scale and their moment
    sum tau r over EI / L (their number does not matter), its shape p0 / L; and its weight over the force scale.

Source: kriging, e.g. Rasmussen & Williams 2006, eq. (2.23); what to feed and to divide by: measured (docs/training.md).
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..estimation.at_rest import without_load
from ..mechanics.robot import Robot
from ..model.load_families import GaussianCoordinates
from ..model.problem import Problem
from ..model.sensors import Markers
from ..util.by_value import Kept, key
from ..util.precision import DTYPE

GRID = 20  # points of the grid
STATIONS = 4  # where the known loads are described
NODES = 100  # of the quadrature over the unknown load
LOAD_STD = 4.0  # q
MOST_NUMBERS = 2**22  # in the matrices of the patterns that are solved together: 32 MB each
AMP_LEAST = 1e-6  # a straighter rod has no direction and no size
PASSIVE_SIZE = 5 * GRID + 6
ACTIVE_SIZE = PASSIVE_SIZE + STATIONS * 6 + 3
_kriged = Kept()
MIRROR_MARGIN = 1e-6  # a bend this planar (in amp) is not mirrored: round-off must not decide


@dataclass(frozen=True)
class Features:
    """x (B, n): the input. amp (B,): the rms curvature, 1 / L. turn (B, 2, 2): canonical frame = turn @ section frame (orthogonal).

    seen (B,): markers that were seen. alpha (B, 6): the base wrench without the unknown load (N, N m), zero where there is none.
    q_tip (B, 4): the orientation of the tip as the markers have it, to find the base wrench under a guessed load sooner.
    p0 (B, P, 3): the markers (m) as they would be without the unknown load.
    """

    x: Float[Tensor, "B n"]
    amp: Float[Tensor, " B"]
    turn: Float[Tensor, "B 2 2"]
    seen: Float[Tensor, " B"]
    alpha: Float[Tensor, "B 6"]
    q_tip: Float[Tensor, "B 4"]
    p0: Float[Tensor, "B P 3"]

    def take(self, index: Int[Tensor, " b"]) -> "Features":
        """The samples of an index."""
        return Features(*(getattr(self, f.name)[index] for f in fields(self)))


def is_active(robot: Robot) -> bool:
    """Whether known loads (tendons, weight) shape the robot before the unknown one does."""
    return len(robot.tendons) > 0 or not robot.weightless


def _beam(s: Float[Tensor, "... S"], t: Float[Tensor, " T"]) -> tuple[Float[Tensor, "... S T"], Float[Tensor, "... S T"]]:
    """g(s, t) and k(s, t) of (2)."""
    s = s.unsqueeze(-1)
    far = torch.where(s < t, s**2 * (3 * t - s), t**2 * (3 * s - t)) / 6
    return far, (t - s).clamp(min=0)


def kriging(s: Float[Tensor, "U P"], sigma: float) -> Float[Tensor, "U 2G P"]:
    """(2): what takes displacements to deflection and curvature on the grid, for U layouts of markers; all over L. Curvature is
    that of a step's beginning, so that the base, where it is largest, is among them.
    """
    t = (torch.arange(NODES, dtype=DTYPE) + 0.5) / NODES
    grid = torch.linspace(1 / GRID, 1, GRID, dtype=DTYPE)
    at_markers, at_grid, bend = _beam(s, t)[0], _beam(grid, t)[0], _beam(grid - 1 / GRID, t)[1]
    q2 = LOAD_STD**2 / NODES
    own = q2 * at_markers @ at_markers.mT
    own.diagonal(dim1=-2, dim2=-1).add_(sigma**2)
    cross = q2 * at_markers @ torch.cat([at_grid, bend]).T
    return torch.cholesky_solve(cross, torch.linalg.cholesky(own)).mT


def _kriging_of_all(s: Float[Tensor, " P"], length: float, sigma: float) -> Float[Tensor, "1 2G P"]:
    """Where every marker was seen, kept for the next shapes with the same arc lengths."""
    return _kriged((key(s), length, sigma), lambda: kriging(s[None] / length, sigma))


def _places(s: Float[Tensor, " P"], length: float) -> Float[Tensor, " Q"]:
    """The markers, the stations and the grid (m)."""
    stations, grid = (torch.linspace(length / n, length, n, dtype=DTYPE) for n in (STATIONS, GRID))
    return torch.cat([s, stations, grid])


def smoothed(
    s: Float[Tensor, " P"], y: Float[Tensor, "B P 3"], seen: Bool[Tensor, "B P"], length: float, noise: float
) -> tuple[Float[Tensor, "B G 3"], Float[Tensor, "B G 3"]]:
    """(2) from displacements over L; s, length and noise in m. Each pattern of markers seen is solved once."""
    if bool(seen.all()):
        rows = y.mT.flatten(0, 1) @ _kriging_of_all(s, length, noise / length)[0].mT  # one product for all samples
        out = rows.unflatten(0, (-1, 3)).mT
    else:
        out = _smoothed_by_pattern(s / length, y, seen, noise / length)
    return out[:, :GRID], out[:, GRID:]


def _smoothed_by_pattern(
    s: Float[Tensor, " P"], y: Float[Tensor, "B P 3"], seen: Bool[Tensor, "B P"], sigma: float
) -> Float[Tensor, "B 2G 3"]:
    """The same with gaps: of each pattern only the markers that were seen, so that samples with arc lengths of their own, each of
    which sees few of all the markers, take no more memory than these few.
    """
    out = y.new_zeros(len(y), 2 * GRID, 3)
    patterns, which = torch.unique(seen, dim=0, return_inverse=True)
    order, count = which.argsort(stable=True), patterns.sum(-1)
    samples = order.split(torch.bincount(which, minlength=len(patterns)).tolist())
    for n in count.unique().tolist():
        alike = (count == n).nonzero().squeeze(-1)
        for some in alike.split(max(1, MOST_NUMBERS // max(n * (n + NODES), 1))) if n else ():
            at = patterns[some].nonzero()[:, 1].unflatten(0, (len(some), n))
            for solve, places, u in zip(kriging(s[at], sigma), at, some.tolist(), strict=True):
                out[samples[u]] = solve @ y[samples[u]][:, places]
    return out


def _canonical(bend: Float[Tensor, "B G 2"], amp: Float[Tensor, " B"]) -> Float[Tensor, "B 2 2"]:
    """(4), from the lateral curvature. The second row decides by the curvature beside the net bend, weighted towards the base."""
    net = bend.sum(1)
    e = net / net.norm(dim=-1, keepdim=True).clamp(min=1e-300)
    e = torch.where((e != 0).any(-1, keepdim=True), e, torch.tensor([1.0, 0.0], dtype=DTYPE))
    across = torch.stack([-e[:, 1], e[:, 0]], -1)
    side = (bend @ across.unsqueeze(-1)).squeeze(-1) @ torch.linspace(1, 0, GRID, dtype=DTYPE) ** 2
    sign = torch.where(side < -MIRROR_MARGIN * amp, -1.0, 1.0).to(DTYPE)
    return torch.stack([e, sign.unsqueeze(-1) * across], 1)


def _facing(way: Float[Tensor, "B 3"]) -> Float[Tensor, "B 4"]:
    """The smallest rotation that turns e3 to a direction: the quaternion (e3 x t, 1 + e3 . t), normalized."""
    t = torch.nn.functional.normalize(way, dim=-1)
    q = torch.stack([-t[:, 1], t[:, 0], torch.zeros_like(t[:, 0]), (1 + t[:, 2]).clamp(min=1e-3)], -1)
    return torch.nn.functional.normalize(q, dim=-1)


def noise_of(markers: Markers) -> float:
    """The noise (m) that stands for a batch in which each sample has its own: the middle one."""
    return float(markers.noise.median()) if isinstance(markers.noise, Tensor) else markers.noise


def features(problem: Problem) -> Features:
    """(1)-(5) of B samples, of which nothing but markers was measured. A sample without markers reads as an unbent rod."""
    robot, markers = problem.robot, problem.markers
    assert markers is not None
    L, seen, P, noise = robot.rod.length, markers.present, len(markers.s), noise_of(markers)
    stations = torch.linspace(L / STATIONS, L, STATIONS, dtype=DTYPE)
    places = _places(markers.s, L)
    rest = without_load(problem, places)
    straight = torch.nn.functional.pad(places.unsqueeze(-1), (2, 0))
    known = torch.isfinite(rest.p)
    p0 = rest.p if bool(known.all()) else torch.where(known, rest.p, straight)  # as a rule one shape, expanded to all samples
    sigma = torch.tensor(noise / L, dtype=DTYPE)
    y, k = smoothed(markers.s, (markers.positions - p0[:, :P]).div_(L), seen, L, noise)
    amp = k[..., :2].square().sum(-1).mean(-1).sqrt().clamp(min=AMP_LEAST)
    turn = _canonical(k[..., :2], amp)

    def turned(v: Float[Tensor, "B S 3"]) -> Float[Tensor, "B S3"]:
        return torch.cat([v[..., :2] @ turn.mT, v[..., 2:]], -1).flatten(1)

    size, count, log_c = amp.unsqueeze(-1), seen.sum(-1).to(DTYPE), torch.full_like(amp, prior_log_c(problem))
    parts = [5 * turned(y) / size, (k[..., :2] @ turn.mT).flatten(1) / size, size.log(), size]
    parts += [torch.stack([sigma.log().expand_as(amp), (sigma / amp).log(), log_c, (20 / count.clamp(min=1)).log()], -1)]
    if is_active(robot):
        pull, moment, weight = _known(robot, problem.tension, len(amp), stations)
        moment = turned(moment).unflatten(-1, (STATIONS, 3))[..., :2].flatten(1)
        parts += [pull, moment, turned(weight), turned(p0[:, P : P + STATIONS] / L)]
    q_tip = _facing((p0[:, -1] + L * y[:, -1]) - (p0[:, -2] + L * y[:, -2]))
    return Features(torch.cat(parts, -1), amp, turn, count, rest.wrench.nan_to_num(0.0), q_tip, p0[:, :P])


def prior_log_c(problem: Problem) -> float:
    """The prior mean of log(c L^2)."""
    loads = problem.unknowns.loads
    assert isinstance(loads, GaussianCoordinates)
    return loads.log_c


def _known(
    robot: Robot, tension: Float[Tensor, "B T"] | None, B: int, stations: Float[Tensor, " S"]
) -> tuple[Float[Tensor, "B S"], Float[Tensor, "B S 3"], Float[Tensor, "B 1 3"]]:
    """The tendons' pull and moment and the weight of (5)."""
    rod = robot.rod
    pull, moment = torch.zeros(B, STATIONS, dtype=DTYPE), torch.zeros(B, STATIONS, 3, dtype=DTYPE)
    if tension is not None and len(robot.tendons):
        tension = tension.nan_to_num(0.0).clamp(min=0)
        on = torch.stack([stations <= t.ends_at * (1 + 1e-9) for t in robot.tendons.tendons]).to(DTYPE)
        r = torch.stack([t.offset_at(stations)[0] for t in robot.tendons.tendons])
        pull = tension @ on / rod.force_scale
        moment = torch.einsum("bt,tg,tgc->bgc", tension, on, r) * (rod.length / rod.bending_stiffness)
    return pull, moment, (robot.weight * rod.length / rod.force_scale).expand(B, 3).unsqueeze(1)
