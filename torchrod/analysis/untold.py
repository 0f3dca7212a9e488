"""Loads that nobody told of, where the number of contacts is told and the fit is accepted.

A shape that one contact explains may be of a force at the tip that also pulls along the rod, which looks like a contact farther
down, or of two loads of which the fit has made one. Both are tried: a force at the tip instead of the contact nearest to it, and
one contact more. By the BIC, with the weights that hypotheses have in analysis.averaging, what is nearly as probable, or of more
contacts more probable, is named; the fit that is reported is never changed.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..estimation.result import Estimate
from ..estimation.solve import Settings, estimate_each
from ..model.load_families import GaussianCoordinates
from ..model.problem import Problem
from ..model.sensors import TipWrench
from .alternatives import read_at_few_places
from .averaging import ONE_MORE
from .count import CLOSE, NEAR_TIP, StartFor, always_cold, bic

WEIGH = "--contacts auto weighs both"


def untold(problem: Problem, fit: Estimate, settings: Settings | None = None, start: StartFor = always_cold) -> tuple[str, ...]:
    """For every sample a sentence on loads that explain its readings as well as those that were told, or "".

    problem: with Gaussian loads of unknown places, and nothing unknown at the tip; of another there is nothing said. fit: of it.
    start: the rule that other fits start by.
    """
    said = [""] * problem.batch
    loads = problem.unknowns.loads
    asked = isinstance(loads, GaussianCoordinates) and loads.count > 0 and loads.locations is None
    if not asked or problem.unknowns.tip != "none" or any(isinstance(sensor, TipWrench) for sensor in problem.sensors):
        return tuple(said)
    settings = replace(settings or Settings(), restarts=())
    own = bic(problem, fit)
    whole = fit.accepted & ~read_at_few_places(problem)
    rows = whole.nonzero().squeeze(-1)
    for found in (_instead, _beside) if len(rows) else ():
        for b, words in found(problem, fit, own, rows, settings, start):
            said[b] = words
    return tuple(said)


def _another(
    problem: Problem, rows: Int[Tensor, " b"], own: Float[Tensor, " B"], share: float, settings: Settings, start: StartFor
) -> tuple[Estimate, Float[Tensor, " b"]]:
    """The fit of other unknowns to some samples, and by how much its BIC, that of a hypothesis with a share, is behind."""
    part = problem.take(rows)
    other = estimate_each(part, settings, start(part))
    behind = bic(part, other) - 2 * math.log(share) - own[rows]
    return other, torch.where(other.accepted, behind, torch.inf)


def _instead(
    problem: Problem, fit: Estimate, own: Float[Tensor, " B"], rows: Int[Tensor, " b"], settings: Settings, start: StartFor
) -> list[tuple[int, str]]:
    """A force at the tip instead of a contact near it. It counts as if somebody had told that it may be one."""
    loads = problem.unknowns.loads
    assert isinstance(loads, GaussianCoordinates)
    rows = rows[(fit.location[rows] > NEAR_TIP * fit.rod_length[rows].unsqueeze(-1)).any(-1)]
    fewer = problem.of(replace(problem.unknowns, loads=replace(loads, count=loads.count - 1), tip="force"))
    if not (len(rows) and fewer.determined):
        return []
    other, behind = _another(fewer, rows, own, 1.0, settings, start)
    beside = f" beside {loads.count - 1} contact{'s' * (loads.count > 2)}" if loads.count > 1 else ""
    option = f"--contacts {loads.count - 1} --unknown-tip force"
    return [
        (int(rows[i]), f"{_force(other, i)}{beside} explains the readings as well ({option}); {WEIGH}.")
        for i in (behind < -2 * math.log(CLOSE)).nonzero().squeeze(-1).tolist()
    ]


def _beside(
    problem: Problem, fit: Estimate, own: Float[Tensor, " B"], rows: Int[Tensor, " b"], settings: Settings, start: StartFor
) -> list[tuple[int, str]]:
    """One contact more, where that is more probable than that there is none."""
    loads = problem.unknowns.loads
    assert isinstance(loads, GaussianCoordinates)
    more = problem.of(replace(problem.unknowns, loads=replace(loads, count=loads.count + 1)))
    if not more.determined:
        return []
    contacts, behind = _another(more, rows, own, ONE_MORE, settings, start)
    found = []
    for i in (behind < 0).nonzero().squeeze(-1).tolist():
        chi2 = f"chi2 = {float(contacts.chi2[i]):.3g} instead of {float(fit.chi2[rows[i]]):.3g}"
        found.append((int(rows[i]), f"One contact more explains the readings better ({chi2}); {WEIGH}."))
    return found


def _force(fit: Estimate, i: int) -> str:
    """Of a fit with an unknown force at the tip."""
    assert fit.tip is not None
    return f"A force of ({', '.join(f'{v:.3g}' for v in fit.tip[i, :3].tolist())}) N at the tip"
