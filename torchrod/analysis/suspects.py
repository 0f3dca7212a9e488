"""What a robot that is not as its file says would explain: readings that no load explains are fitted again with one parameter of
the robot, or the arc lengths, unknown, each by itself.

Which of them explains a sample best is told by the marginal likelihood, by Laplace's method: of parameters theta with priors

    (1)  -2 log p = cost + log det (posterior precision / prior precision of theta),

beside chi^2 + k ln(n) for what has no prior, as analysis.count has it. Arc lengths are no parameters but noise along the rod (a =
s_std / noise), for which -2 log p has ln(1 + a^2) of every marker. A parameter that a load can stand for, as a stiffness that is
off for a larger force, is not seen by its residual, and is not told here.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..estimation.result import Estimate
from ..estimation.solve import Settings, solver_of
from ..estimation.starts import Origin, Start
from ..mechanics.lie import exponential, rotate
from ..model.problem import Problem
from ..model.uncertainty import Uncertainty
from .count import free_parameters

ITERATIONS = 25  # of a fit that begins at that of the robot as it is
ALIKE = 4.0  # of -2 log p: what is behind by less is told as well
OVAL = 0.1  # of EI
NOT_FLAT = 2 * OVAL  # of EI: of a rod that is softer to one side than that, OVAL would leave nothing there
SLIP = 0.05  # of the length: arc lengths that are farther off than that are another mistake


@dataclass(frozen=True)
class Suspect:
    """A parameter of the robot that may be off: a kind of Uncertainty, its standard deviation, and what is said of its errors."""

    kind: str
    std: float
    said: Callable[[list[float]], str]

    @property
    def stated(self) -> Uncertainty:
        """It alone."""
        return Uncertainty(**{self.kind: self.std})  # pyright: ignore[reportArgumentType]

    @property
    def remedy(self) -> str:
        """By its key in ROBOT.toml."""
        return f'state "{self.kind} = {self.std:.2g}" under [uncertainty], or calibrate the robot'


def _share(what: str) -> Callable[[list[float]], str]:
    return lambda errors: f"{what} off by {', '.join(f'{100 * e:+.2g} %' for e in errors)}"


def _size(what: str, unit: str, scale: float = 1.0) -> Callable[[list[float]], str]:
    return lambda errors: f"{what} by {scale * math.hypot(*errors):.2g} {unit}"


def suspects(problem: Problem) -> list[Suspect]:
    """What may be off of a robot, by as much as such robots are; nothing where its uncertainty is stated already."""
    robot, unknowns = problem.robot, problem.unknowns
    if unknowns.uncertainty is not None or unknowns.tension_std is not None:
        return []
    L = robot.rod.length
    found = [
        Suspect("stiffness", 0.1, _share("a stiffness that is")),
        Suspect("set", 0.1 / L, _size("a rod that is bent, unloaded, other than its file says,", "1/m")),
    ]
    if robot.rod.softer_side > NOT_FLAT:
        found.append(Suspect("oval", OVAL, _size("a section that is stiffer to one side", "%", 100)))
    if problem.tension is not None:
        found += [
            Suspect("tension", 0.1, _share("tensions that are")),
            Suspect("friction", 0.2, _size("tendons that rub, mu times their motion", "in all")),
        ]
    if not robot.weightless:
        found += [
            Suspect("mass", 0.2, _share("a mass that is")),
            Suspect("gravity", math.radians(10), _size("gravity that is turned", "degrees", math.degrees(1))),
        ]
    return found


@dataclass(frozen=True)
class Suspected:
    """Of b samples the suspect that explains them best: -2 log p up to what all explanations share, inf where none does; words."""

    score: Float[Tensor, " b"]
    said: list[str]


def suspected(problem: Problem, x: Float[Tensor, "b n"], settings: Settings) -> Suspected:
    """Try all of them on every sample, from its fit x. Those that explain it nearly as well as the best are told, too."""
    solve = solver_of(replace(settings, restarts=(), basins=0, sized=False, max_iterations=ITERATIONS))
    B, scores, words = problem.batch, [torch.full((problem.batch,), torch.inf, dtype=torch.float64)], [[""] * problem.batch]
    remedies = [""]
    for suspect in suspects(problem) if B else []:
        own = problem.of(replace(problem.unknowns, uncertainty=suspect.stated))
        if not (own.state.parameters.size and own.determined):
            continue
        at = own.state.parameters.at.start
        start = torch.cat([x[:, :at], x.new_zeros(B, own.state.parameters.size), x[:, at:]], -1)
        fit = solve(own, Start.at(start, Origin.OTHER_FIT))
        assert fit.parameters is not None
        scores.append(_score(own, fit, _narrowed(own, fit)))
        words.append([suspect.said(errors) for errors in fit.parameters.tolist()])
        remedies.append(suspect.remedy)
    if B and (off := _along(problem, x)):
        own, price = _loose(problem, off)
        scores.append(_score(own, solve(own, Start.at(x, Origin.OTHER_FIT)), price))
        words.append([f"arc lengths that are off by about {1e3 * off:.2g} mm"] * B)
        remedies.append(f"measure them again, or try --s-std {off:.1g}")
    every = torch.stack(scores)
    best, which = every.min(0)
    said = [""] * B
    for b in torch.isfinite(best).nonzero().squeeze(-1).tolist():
        near = [k for k in every[:, b].argsort().tolist() if every[k, b] < best[b] + ALIKE]
        said[b] = f"{', or as well '.join(words[k][b] for k in near)}; {remedies[int(which[b])]}"
    return Suspected(best, said)


def _score(own: Problem, fit: Estimate, price: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
    """-2 log p, inf where the fit is not accepted. price: what is to be paid for what is not a load."""
    free = (free_parameters(own) + own.state.registration.size) * torch.log(own.seen.clamp(min=3).to(fit.chi2.dtype))
    return torch.where(fit.accepted, fit.chi2 + free + price, torch.inf)


def _narrowed(own: Problem, fit: Estimate) -> Float[Tensor, " b"]:
    """The last term of (1)."""
    block = own.state.parameters
    root = block.precision.sqrt()
    C = fit.covariance[:, block.at, block.at]
    return -torch.linalg.slogdet(root.unsqueeze(-1) * C * root)[1].nan_to_num(-math.inf)


def _along(problem: Problem, x: Float[Tensor, "b n"]) -> float:
    """How far off along the rod (m) markers are from their fits x: the middle one of b; 0 where that makes no sense."""
    markers = problem.markers
    if markers is None or not markers.isotropic or isinstance(markers.noise, Tensor):
        return 0.0
    before = problem.sensors[: next(k for k, sensor in enumerate(problem.sensors) if sensor is markers)]
    places, rows = sum(len(sensor.s) for sensor in before), sum(sensor.rows for sensor in before)
    fitted = problem.h(x, differentiable=False)[:, rows : rows + markers.rows].unflatten(-1, (-1, 3))
    q = problem.shape(x, differentiable=False).q[:, places : places + len(markers.s)]
    tangent = rotate(q, x.new_tensor([0.0, 0.0, 1.0]))
    if problem.state.registration.size:
        tangent = rotate(exponential(problem.state.registration.of(x)[:, 3:]).unsqueeze(1), tangent)
    along = ((markers.positions - fitted) * tangent).sum(-1).square().nanmean(-1).sqrt()
    off = float(along.nanmedian())
    return off if 0 < off < SLIP * problem.robot.rod.length else 0.0


def _loose(problem: Problem, off: float) -> tuple[Problem, Float[Tensor, " b"]]:
    """The problem with arc lengths that are off by so much (m), and what that costs before the data (module)."""
    markers = problem.markers
    assert markers is not None
    own = replace(markers, s_std=torch.full_like(markers.s, off))
    price = markers.present.sum(-1) * math.log1p((off / float(markers.noise)) ** 2)
    return replace(problem, sensors=[own if s is markers else s for s in problem.sensors]), price
