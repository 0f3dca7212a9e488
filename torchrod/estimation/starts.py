"""Where the filter starts: from no load, or from a guess that must first show that it is nearer to the data than that."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..model.measurement import Markers, Model
from ..util.precision import Float64
from .at_rest import at_rest, without_load
from .evaluator import Prepared


@dataclass(frozen=True)
class Start(Float64):
    """Where B samples start: x (B, n) in the model's coordinates.

    Sigma0: the covariance (B, n, n) to start with; None leaves it to the settings. warm: (B,), which samples start from a guess;
    the others start cold, from no load. cold: x of a cold start, and costs (B, 2) of x and of that by the model, if the rule has
    them at hand.
    """

    x: Float[Tensor, "B n"]
    Sigma0: Float[Tensor, "B n n"] | None
    warm: Bool[Tensor, " B"]
    cold: Float[Tensor, "B n"] | None = None
    costs: Float[Tensor, "B 2"] | None = None

    @classmethod
    def known(cls, x: Float[Tensor, "B n"]) -> "Start":
        """To be begun from whatever a cold start would cost."""
        return cls(x, None, torch.zeros(len(x), dtype=torch.bool))

    def take(self, index: Int[Tensor, " b"]) -> "Start":
        """The samples of an index."""
        Sigma0, cold, costs = (None if part is None else part[index] for part in (self.Sigma0, self.cold, self.costs))
        return Start(self.x[index], Sigma0, self.warm[index], cold, costs)


StartRule = Callable[[Model, Markers, float], Start]


def in_equilibrium(
    model: Model, gamma: Float[Tensor, "B g"], markers: Markers, q_tip: Float[Tensor, "B 4"] | None = None
) -> Float[Tensor, "B n"]:
    """x at the loads gamma, with the base wrench of the robot in equilibrium under them; of zero where there is none to be found.

    q_tip: the orientation of the tip near which to look, where it is known: sooner found.
    """
    return model.join(gamma, at_rest(model, markers, gamma, q_tip).wrench.nan_to_num(0.0))


def costs_in_equilibrium(
    model: Model, markers: Markers, noise: float, x: Float[Tensor, "B k n"], p: Float[Tensor, "B k P 3"]
) -> Float[Tensor, "B k"]:
    """The cost of (3) with the prior's at k states x, whose shapes p (m) in equilibrium are known: there is no tip residual."""
    mean, precision = model.prior()
    square = (markers.positions.unsqueeze(1) - p).square().sum(-1)
    seen = torch.where(markers.present.unsqueeze(1), square, 0.0).sum(-1)
    variance = noise**2 if markers.sigma is None else markers.sigma.unsqueeze(-1) ** 2
    return seen / variance + (precision * (mean - x) ** 2).sum(-1)


def cold_start(model: Model, markers: Markers, noise: float) -> Start:
    """No load where the coordinates say so, and the base wrench of the rod in equilibrium without it."""
    x = cold_from(model, without_load(model, markers).wrench.nan_to_num(0.0))
    return Start(x, None, torch.zeros(len(x), dtype=torch.bool))


def cold_from(model: Model, alpha: Float[Tensor, "B 6"]) -> Float[Tensor, "B n"]:
    """x of a cold start, from the base wrench (N, N m) of the robot without load."""
    return model.join(model.coordinates.start().expand(len(alpha), -1), alpha)


def better_start(
    model: Model, markers: Markers, noise: float, start: Start, Sigma0: Float[Tensor, "n n"]
) -> tuple[Start, Bool[Tensor, " B"]]:
    """Per warm sample, the cheaper of its guess and a cold start, and which guesses were dropped, (B,).

    Sigma0 is what a cold start goes with. Where the rule does not have their costs, each takes one evaluation of h without its
    Jacobian, on coarse steps. A guess that is not finite, or that bends the rod out of all bounds, is dropped with the rest.
    """
    index = start.warm.nonzero().squeeze(-1)
    if not len(index):
        return start, start.warm
    cold = cold_start(model, markers.take(index), noise).x if start.cold is None else start.cold[index]
    if start.costs is None:
        part = markers if len(index) == len(start.warm) else markers.take(index)
        prepared = Prepared(model.coarse, part, model.weights(part, noise))
        costs = torch.stack([prepared.cost(start.x[index]), prepared.cost(cold)], -1)
    else:
        costs = start.costs[index]
    guessed, known = costs.nan_to_num(torch.inf).unbind(-1)
    worse = ~(guessed < known)
    dropped = torch.zeros_like(start.warm).index_copy(0, index, worse)
    x = start.x.clone()
    x[dropped] = cold[worse]
    spread = None if start.Sigma0 is None else torch.where(dropped[:, None, None], Sigma0, start.Sigma0)
    return Start(x, spread, start.warm & ~dropped), dropped
