"""Training cases: random robots, loads and markers, and the answer that the filter itself gives when it starts at the truth.

A block has one robot, one marker layout and one noise level, and is a pure function of (recipe, index).
"""

import math
from dataclasses import asdict, dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchrod import (
    DatasetSpec,
    GaussianCoordinates,
    Markers,
    Origin,
    PolynomialLoads,
    Problem,
    Robot,
    Rod,
    Settings,
    Start,
    Tendon,
    Tendons,
    Unknowns,
    cold_start,
    estimate,
    simulate_shard,
    solve_shape,
)
from torchrod.estimation.evaluator import evaluator, normal
from torchrod.estimation.solve import CHUNK
from torchrod.estimation.starts import in_equilibrium
from torchrod.learned.features import features, prior_log_c
from torchrod.learned.network import PER_LOAD, turn_of_gamma
from torchrod.util.precision import DTYPE

L, DIAMETER, E, G = 0.4, 0.0014, 207e9, 79e9  # of the rod; the features are dimensionless, so one rod stands for all
LEAST_SEEN = 8
TENDON_SHARE = 0.09  # of the rod's own stiffness: below it the strain balance needs few steps
FARTHEST_LOAD = 0.998  # eta is finite there
COLUMNS = ("x", "amp", "log_c", "target", "M", "seen")


@dataclass(frozen=True)
class Recipe:
    """What a network learns from. Lengths in L, forces and weights in force scales (4 EI / L^2).

    load: "contacts" (point forces) or "smooth" (cubic in s). priors: taken in turn by the blocks. force: log-uniform; of a smooth
    load its largest density times L. tendons: how many, at least and at most; weight: the largest. target_iterations: of the filter
    from the truth.
    """

    contacts: int
    load: str
    priors: tuple[str, ...]
    force: tuple[float, float]
    tendons: tuple[int, int] = (0, 0)
    weight: float = 0.0
    noise: tuple[float, float] = (2e-4, 6e-3)
    markers: tuple[int, ...] = (20, 12, 20, 30, 40)
    location: tuple[float, float] = (0.04, 1.0)
    min_gap: float = 0.05
    blocks: int = 40
    block_size: int = 512
    target_iterations: int = 3
    seed: int = 0

    def record(self) -> dict[str, object]:
        """Plain values for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Draw:
    """The problem of a block, with its markers without a gap, and a truth gamma (B, 4 K) to start from."""

    problem: Problem
    gamma: Float[Tensor, "B n"]


def generator_of(recipe: Recipe, index: int) -> torch.Generator:
    """The random stream of a block."""
    return torch.Generator().manual_seed(recipe.seed * 1_000_003 + index)


def uniform(generator: torch.Generator, *shape: int) -> Tensor:
    """Random numbers from 0 to 1."""
    return torch.rand(*shape, generator=generator, dtype=DTYPE)


def noise_of(recipe: Recipe, index: int) -> float:
    """Log-uniform over the blocks, by the golden ratio's low-discrepancy sequence (over L)."""
    low, high = recipe.noise
    return low * (high / low) ** ((index * 0.6180339887) % 1.0)


def layout(recipe: Recipe, index: int, generator: torch.Generator) -> Float[Tensor, " P"]:
    """Arc lengths of the markers over L: even up to the tip, in every other block uneven and not quite up to it."""
    count = recipe.markers[index % len(recipe.markers)]
    s = torch.arange(1, count + 1, dtype=DTYPE) / count
    if (index // len(recipe.markers)) % 2:
        s = (s - 0.9 / count * uniform(generator, count)) * (0.9 + 0.1 * uniform(generator, 1))
    return s


def random_robot(recipe: Recipe, generator: torch.Generator) -> tuple[Robot, float]:
    """A robot and its largest tension (N), so small that sum tau r^2 stays below TENDON_SHARE of the rod's torsional stiffness."""
    plain = Rod.circular(L, DIAMETER, E, G)
    u = uniform(generator, 16).tolist()
    count = recipe.tendons[0] + int(u[0] * (recipe.tendons[1] - recipe.tendons[0] + 1))
    # Radius, angle and end of each tendon. Those beyond the third are drawn afterwards: robots of up to three, which the shipped
    # checkpoints have learned from, stay what they were.
    drawn = [*zip(u[1:4], u[4:7], u[7:10], strict=True), *uniform(generator, max(count - 3, 0), 3).tolist()]
    tendons, top = [], 6 * plain.force_scale
    for size, way, place in drawn[:count]:
        r, angle, end = L * 0.01 * 6**size, 2 * math.pi * way, L * min(0.4 + 0.9 * place, 1.0)
        tendons.append(Tendon.straight(r * math.cos(angle), r * math.sin(angle), end))
        top = min(top, 0.7 * plain.bending_stiffness / (L * r))
    if tendons:
        reach = max(x * x + y * y for t in tendons for _, x, y in t.routing)
        softness = 1 / float(plain.K_se.diagonal().min()) + reach / float(plain.K_bt.diagonal().min())
        top = min(top, TENDON_SHARE / (count * softness))
    direction = torch.randn(3, generator=generator, dtype=DTYPE)
    weight = recipe.weight * u[10] * plain.force_scale / L * direction / direction.norm()
    return Robot(Rod.circular(L, DIAMETER, E, G, 1.0), Tendons(tuple(tendons)), weight, "training"), top


def contacts(recipe: Recipe, index: int, prior: str) -> Draw:
    """Point forces, through the library's data sets."""
    generator = generator_of(recipe, index)
    robot, top = random_robot(recipe, generator)
    s = layout(recipe, index, generator)
    spec = DatasetSpec(
        robots=(robot,),
        samples=recipe.block_size,
        shard_size=recipe.block_size,
        seed=recipe.seed * 1_000_003 + index,
        noise=L * noise_of(recipe, index),
        contacts=recipe.contacts,
        family="point",
        force=(4 * recipe.force[0], 4 * recipe.force[1]),
        force_unit="EI/L^2",
        distribution="log-uniform",
        location=recipe.location,
        min_gap=recipe.min_gap if recipe.contacts > 1 else 0.0,
        width=None,
        markers=tuple(s.tolist()),
        tension=(0.0, top) if len(robot.tendons) else None,
        gravity=None,
    )
    data = {name: torch.from_numpy(value) for name, value in simulate_shard(spec, 0).items()}
    markers = Markers(data["s"], data["positions"], L * noise_of(recipe, index))
    problem = Problem(robot, unknowns_of(recipe, robot, prior), [markers], data["tension"] if len(robot.tendons) else None)
    eta = torch.logit((data["location"] / L).clamp(max=FARTHEST_LOAD)).unsqueeze(-1)
    log_c = torch.full_like(eta, prior_log_c(problem))
    gamma = torch.cat([data["force"] / robot.rod.force_scale, eta, log_c], -1).flatten(1)
    return Draw(problem, gamma)


def smooth(recipe: Recipe, index: int, prior: str) -> Draw:
    """Distributed loads, cubic in s. No Gaussians are the truth: the answer is the one that is found from a cold start."""
    generator = generator_of(recipe, index)
    robot, _ = random_robot(recipe, generator)
    B, s = recipe.block_size, L * layout(recipe, index, generator)
    knots = 2 * uniform(generator, B, 2, 4) - 1
    powers = torch.linspace(0, 1, 4, dtype=DTYPE).unsqueeze(-1) ** torch.arange(4)
    low, high = recipe.force
    size = low * (high / low) ** uniform(generator, B, 1, 1) * robot.rod.force_scale / L
    load = PolynomialLoads(size * torch.linalg.solve(powers, knots.unsqueeze(-1)).squeeze(-1), L)
    shape = solve_shape(robot, (load,), None, s, B)
    noise, unknowns = L * noise_of(recipe, index), unknowns_of(recipe, robot, prior)
    noisy = shape.p + noise * torch.randn(shape.p.shape, generator=generator, dtype=DTYPE)
    return Draw(Problem(robot, unknowns, [Markers(s, noisy, noise)]), unknowns.loads.start().expand(B, -1))


def unknowns_of(recipe: Recipe, robot: Robot, prior: str) -> Unknowns:
    """The unknowns whose starts are learned."""
    return Unknowns(GaussianCoordinates(recipe.contacts, L, robot.rod.force_scale, prior))


def with_gaps(problem: Problem, generator: torch.Generator) -> Problem:
    """Up to half of the markers missing, but LEAST_SEEN there."""
    B, P = problem.batch, problem.group_count
    gone = (uniform(generator, B, 1) * (P - max(LEAST_SEEN, P // 2) + 1)).floor()
    rank = uniform(generator, B, P).argsort(-1).argsort(-1)
    return problem.without(rank < gone)


def information(problem: Problem, x: Float[Tensor, "B n"]) -> Float[Tensor, "B g g"]:
    """M: the information on gamma with alpha eliminated, so that d^T M d is what an error d in gamma costs."""
    A, _, _ = normal(problem, evaluator(problem).sums(x)).whole(x, problem.mean, problem.precision)
    size = problem.state.loads.size
    cross = A[:, :size, size:]
    return A[:, :size, :size] - cross @ torch.linalg.solve(A[:, size:, size:], cross.mT)


def in_order(gamma: Float[Tensor, "B n"], M: Float[Tensor, "B n n"]) -> tuple[Tensor, Tensor]:
    """Loads from the base to the tip: which is which must not be left to chance."""
    order = gamma.unflatten(-1, (-1, PER_LOAD))[..., 2].argsort(-1)
    index = (PER_LOAD * order.unsqueeze(-1) + torch.arange(PER_LOAD)).flatten(1)
    rows = index.unsqueeze(-1).expand_as(M)
    return gamma.gather(1, index), M.gather(1, rows).gather(2, index.unsqueeze(1).expand_as(M))


def answered(problem: Problem, gamma: Float[Tensor, "B g"], iterations: int) -> Float[Tensor, "B n"]:
    """x after so many iterations of the filter from a truth gamma. Nothing challenges that start: the answer is wanted as it is."""
    x = in_equilibrium(problem, gamma)
    at_truth = Start.at(torch.where(x.isnan(), cold_start(problem).x, x), Origin.OTHER_FIT)
    return estimate(problem, Settings(max_iterations=iterations, restarts=()), at_truth).x


def block(recipe: Recipe, index: int) -> dict[str, Tensor]:
    """x, amp, log_c, target and M in the canonical frame, and the markers seen: float32, one row per case."""
    draw = (contacts if recipe.load == "contacts" else smooth)(recipe, index, recipe.priors[index % len(recipe.priors)])
    problem, log_c = with_gaps(draw.problem, generator_of(recipe, 10_000_019 + index)), prior_log_c(draw.problem)
    rows = []
    for i in torch.arange(problem.batch).split(CHUNK):
        part = problem.take(i)
        x = answered(part, draw.gamma[i], recipe.target_iterations)
        target, M = in_order(x[:, part.state.loads.at], information(part, x))
        read = features(part)
        turn = turn_of_gamma(read.turn, recipe.contacts)
        target, M = (turn @ target.unsqueeze(-1)).squeeze(-1), turn @ M @ turn.mT
        good = torch.isfinite(target).all(-1) & torch.isfinite(M).flatten(1).all(-1)
        row = (read.x, read.amp, torch.full_like(read.amp, log_c), target, M, read.seen)
        rows.append([value[good].float() for value in row])
    return {name: torch.cat(values) for name, values in zip(COLUMNS, zip(*rows, strict=True), strict=True)}
