"""Why does a fit not explain its markers? Labels exchanged, a base frame off, a load too few, the unit, outliers. It only tells.

A rod of arc length s_j - s_i between two markers holds them no farther apart than that, whatever bends it (r: their offsets from
the centre line):

    (1)  V = sum_(i<j) max(0, |z_i - z_j| - |s_i - s_j| - |r_i| - |r_j|)^2

is zero but for noise, and large where labels are exchanged. Two labels after two are exchanged where that lowers (1), or the
squared residual of the fit, the most; the robot is fitted to the markers so labelled, and only a fit that explains them far better
speaks for the exchange. (1) finds them where the fit itself was led astray, the residual where (1) is slack: with offsets, or
markers closer together than a few standard deviations. The fit that is reported is never changed.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..estimation.result import Estimate
from ..estimation.solve import Settings, estimate_each
from ..mechanics.rod import Rod
from ..model.load_families import GaussianCoordinates
from ..model.marker_geometry import misplaced
from ..model.problem import Problem
from ..model.sensors import CentreLine, Markers
from ..model.unknowns import Registration, Unknowns
from ..util.status import Status
from .alternatives import Solution
from .count import free_parameters
from .suspects import suspected

Cycle = tuple[int, ...]
MOST_EXCHANGES = 3
LOWERED = 0.5  # an exchange must halve what it is tried for, and chi^2, to be told
TRANSLATION, ROTATION = 0.1, 0.35  # of the length, and rad: a base frame that is farther off than that is another mistake
SURE = 10.0  # BIC: by so much a base frame must do better before it speaks against a fit that is accepted
OPPOSITE = 0.9  # two forces are a couple where the cosine of their directions is below minus this,
LEFT = 0.75  # together they are no more than this part of the larger: a real push beside the couple adds to one of them,
APART = 0.25  # they are no farther apart than this part of the length,
VAGUE = 0.8  # and each is no better known than to this part of itself,
HUGE = 5.0  # or larger than so many force scales, where the prior begins to hold it
ITERATIONS = 60
ROBUST = 10.0  # degrees of freedom of Student's t: under 3 % more error on clean markers (docs/model.md)
FEW, CLEAR = 0.2, 8.0  # outliers are told where they are at most this share of the markers, and so many sigma off at least
MOST_SUSPECTED = 16  # samples for which it is asked what is off of the robot
MOST_TOLD = 2  # other solutions in a message; the result file has them all
ONE_PLACE = (
    "All was read at s = {:.4g} mm, where one contact looks like another; for a force at the tip, try --contacts 0 "
    "--unknown-tip force."
)
CHUNK = 64  # samples at a time: the table of exchanges holds (markers)^3 numbers of each while it is made


@dataclass(frozen=True)
class Diagnosis:
    """What explains the markers of B samples far better than their fit; for most nothing.

    s: (P,) m, of the markers. exchanged: per sample the groups of markers (counted from 0) whose labels look exchanged, mostly
    pairs. registration: (B, 6) [m, rad], an error of the base frame that explains the markers; NaN where none does. one_more: (B,),
    where one more load does. geometry: per sample what is wrong with its markers' unit, frame or order, or nothing. outliers: per
    sample the markers without which a robust fit explains the others. couple (B,): where (m) loads, or those of one load more, are
    a large opposite couple, which no contact is; NaN where there is none. tip_instead (B,): where a force at the tip explains the
    shape with fewer contacts than without it. others: per sample what else explains its readings; () where nothing was looked for.
    rivals: per sample sentences on other loads that are nearly as probable as those of the fit, or more; () where none were tried.
    robot: per sample a sentence on what of the robot, or of the arc lengths, would explain the readings if it were off, or nothing.
    """

    s: Float[Tensor, " P"]
    exchanged: tuple[tuple[Cycle, ...], ...]
    registration: Float[Tensor, "B 6"]
    one_more: Bool[Tensor, " B"]
    geometry: tuple[str, ...]
    outliers: tuple[Cycle, ...]
    couple: Float[Tensor, " B"]
    tip_instead: Bool[Tensor, " B"]
    others: tuple[tuple[Solution, ...], ...] = ()
    rivals: tuple[str, ...] = ()
    robot: tuple[str, ...] = ()

    def suspects(self, sample: int) -> list[dict[str, object]]:
        """For files: groups of markers, counted from 1 along the rod, their arc lengths (m), and what they are suspected of."""
        s = self.s.tolist()
        groups = [(cycle, "exchanged") for cycle in self.exchanged[sample]] + [((i,), "outlier") for i in self.outliers[sample]]
        return [{"markers": [i + 1 for i in group], "s_m": [s[i] for i in group], "suspicion": what} for group, what in groups]

    def _named(self, markers: Cycle) -> str:
        names, places = _listed([str(i + 1) for i in markers]), _listed([f"{1e3 * float(self.s[i]):.4g}" for i in markers])
        return f"Marker{'s' * (len(markers) > 1)} {names} (s = {places} mm)"

    @cached_property
    def told(self) -> list[bool]:
        """Of which samples there is something to say."""
        doubt = torch.isfinite(self.registration).all(-1) | self.one_more | torch.isfinite(self.couple) | self.tip_instead
        others, rivals, robot = (kind or [()] * len(doubt) for kind in (self.others, self.rivals, self.robot))
        by_kind = (doubt.tolist(), self.exchanged, self.geometry, self.outliers, others, rivals, robot)
        return [any(parts) for parts in zip(*by_kind, strict=True)]

    def message(self, sample: int) -> str:
        """Sentences with the remedy, or nothing."""
        if not self.told[sample]:
            return ""
        said = []
        for cycle in self.exchanged[sample]:
            said.append(f"{self._named(cycle)} look exchanged; exchange their labels.")
        if off := self.outliers[sample]:
            said.append(f"{self._named(off)} look{' like outliers' if off[1:] else 's like an outlier'}; try --robust.")
        zeta = self.registration[sample]
        if bool(torch.isfinite(zeta).all()):
            shift, turn = 1e3 * float(zeta[:3].norm()), float(zeta[3:].norm().rad2deg())
            said.append(
                f"The residual near the base looks like a registration error of about {shift:.2g} mm and {turn:.2g} degrees; "
                "try --registration."
            )
        if self.robot and self.robot[sample]:
            said.append(self.robot[sample])
        if bool(torch.isfinite(self.couple[sample])):
            said.append(
                f"The shape asks for something that is not a contact near s = {1e3 * float(self.couple[sample]):.3g} mm: two large "
                "opposite forces side by side, neither of which is known; check the section, the stiffness and the reference shape "
                "there, or, where two opposite pushes are meant, add markers about them."
            )
        if bool(self.tip_instead[sample]):
            said.append("A force at the tip explains the shape with fewer contacts than lateral pushes alone would take.")
        if bool(self.one_more[sample]):
            said.append("One more contact explains the readings; try more --contacts, or auto.")
        if self.geometry[sample]:
            said.append(self.geometry[sample])
        if self.others and (others := self.others[sample]):
            told = "; by ".join(f"{other.said} (chi2 = {other.chi2:.3g})" for other in others[:MOST_TOLD])
            more = f"; and by {len(others) - MOST_TOLD} more" if len(others) > MOST_TOLD else ""
            said.append(f"The readings are explained as well by {told}{more}; {others[0].remedy}.")
        if self.rivals and self.rivals[sample]:
            said.append(self.rivals[sample])
        return " ".join(said)


def _listed(words: list[str]) -> str:
    return f"{', '.join(words[:-1])} and {words[-1]}" if words[1:] else words[0]


def _stretch(markers: Markers, z: Float[Tensor, "b P 3"]) -> Float[Tensor, "b P P"]:
    """(1) after the labels of every two markers are exchanged (m^2); on the diagonal as it is. O(P^3): only rows i and j change."""
    reach = (markers.s.unsqueeze(-1) - markers.s).abs()
    if markers.offsets is not None:
        size = markers.offsets.norm(dim=-1)
        reach = reach + size.unsqueeze(-1) + size
    apart = (z.unsqueeze(2) - z.unsqueeze(1)).norm(dim=-1)
    excess = (apart - reach).clamp(min=0).square().nan_to_num(0.0)
    rows = excess.sum(-1)
    # at[a, b]: marker a under the label b, against all others; k = b itself goes elsewhere
    at = torch.stack([(apart - row).clamp(min=0).square().nan_to_num(0.0).sum(-1) for row in reach], -1)
    at = at - (apart - reach.diagonal()).clamp(min=0).square().nan_to_num(0.0)
    after = rows.sum(-1)[:, None, None] / 2 - rows.unsqueeze(-1) - rows.unsqueeze(-2) + 2 * excess + at + at.mT
    return _with_diagonal(after, rows.sum(-1) / 2)


def _misfit(fitted: Float[Tensor, "b P 3"], z: Float[Tensor, "b P 3"]) -> Float[Tensor, "b P P"]:
    """The squared distance (m^2) of measured from fitted markers after the labels of every two are exchanged."""
    seen = (z.unsqueeze(2) - fitted.unsqueeze(1)).square().sum(-1)
    own = seen.diagonal(dim1=-2, dim2=-1)
    after = own.nansum(-1)[:, None, None] - own.unsqueeze(-1) - own.unsqueeze(-2) + seen + seen.mT
    return _with_diagonal(after, own.nansum(-1))


def _with_diagonal(after: Float[Tensor, "b P P"], now: Float[Tensor, " b"]) -> Float[Tensor, "b P P"]:
    eye = torch.eye(after.shape[-1], dtype=torch.bool)
    return torch.where(eye, now[:, None, None], after)


def _exchanges(z: Float[Tensor, "b P 3"], cost: Callable[[Float[Tensor, "b P 3"]], Float[Tensor, "b P P"]]) -> Int[Tensor, "b P"]:
    """Which measured marker to take for each label: exchanged two by two while that halves the cost."""
    b, P = z.shape[:2]
    order = torch.arange(P).expand(b, P).clone()
    seen = torch.isfinite(z).all(-1)
    for _ in range(MOST_EXCHANGES):
        after = cost(z.gather(1, order.unsqueeze(-1).expand(-1, -1, 3)))
        here = seen.gather(1, order)
        after = torch.where(here.unsqueeze(-1) & here.unsqueeze(-2), after, torch.inf)
        now = after.diagonal(dim1=-2, dim2=-1).amin(-1)
        least, best = after.flatten(1).min(-1)
        i, j = best // P, best % P
        rows = (least < LOWERED * now).nonzero().squeeze(-1)
        order[rows, i[rows]], order[rows, j[rows]] = order[rows, j[rows]], order[rows, i[rows]]
    return order


def _cycles(order: list[int]) -> tuple[Cycle, ...]:
    """The groups that a permutation moves among themselves."""
    left, found = {i for i, k in enumerate(order) if i != k}, []
    while left:
        cycle = [min(left)]
        while order[cycle[-1]] != cycle[0]:
            cycle.append(order[cycle[-1]])
        left -= set(cycle)
        found.append(tuple(sorted(cycle)))
    return tuple(found)


def _exchanged(problem: Problem, fit: Estimate, index: Int[Tensor, " b"], settings: Settings) -> list[tuple[Cycle, ...]]:
    """Per sample of `index`, which is all of the problem, the groups of labels whose exchange makes the fit explain far better."""
    found: list[tuple[Cycle, ...]] = [()] * len(index)
    markers = problem.markers
    if markers is None or not len(index):
        return found
    z = markers.positions
    fitted = z - fit.residual[index]
    best: Float[Tensor, " b"] = fit.chi2[index].clone()
    for cost in (lambda z: _misfit(fitted, z), lambda z: _stretch(markers, z)):
        order = _exchanges(z, cost)
        some = (order != torch.arange(z.shape[1])).any(-1).nonzero().squeeze(-1)
        some = some[[_cycles(order[b].tolist()) != found[b] for b in some.tolist()]]
        if not len(some):
            continue
        part = problem.take(some)
        own = part.markers
        assert own is not None
        swapped = replace(own, positions=own.positions.gather(1, order[some].unsqueeze(-1).expand(-1, -1, 3)))
        other = estimate_each(replace(part, sensors=[swapped]), settings)
        better = (other.status == int(Status.CONVERGED)) & (other.chi2 < LOWERED * best[some])
        for b, row in zip(some[better].tolist(), order[some[better]].tolist(), strict=True):
            found[b] = _cycles(row)
        best[some[better]] = other.chi2[better]
    return found


def _score(problem: Problem, accepted: Bool[Tensor, " b"], chi2: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
    """chi^2 + k ln(n), where a registration's numbers count as well as those of analysis.count; inf where not accepted."""
    k = free_parameters(problem) + problem.state.registration.size
    return torch.where(accepted, chi2 + k * torch.log(problem.seen.clamp(min=3).to(chi2.dtype)), torch.inf)


def _with_loads(unknowns: Unknowns, count: int) -> Unknowns | None:
    """The unknowns with so many loads, where they are Gaussians at unknown places."""
    loads = unknowns.loads
    if not isinstance(loads, GaussianCoordinates) or loads.locations is not None or count < 1:
        return None
    return replace(unknowns, loads=replace(loads, count=count))


def couples(fit: Estimate, rod: Rod) -> Float[Tensor, " B"]:
    """Where (m) two loads of a fit are opposite, close together and each hardly known, as unmodelled bending looks; else NaN."""
    found = fit.chi2.new_full((len(fit.status),), torch.nan)
    K = fit.location.shape[1]
    for i in range(K):
        for j in range(i + 1, K):
            pair, size = fit.force[:, [i, j]], fit.magnitude[:, [i, j]]
            opposite = (pair[:, 0] * pair[:, 1]).sum(-1) < -OPPOSITE * size.prod(-1)
            opposite = opposite & (pair.sum(1).norm(dim=-1) < LEFT * size.amax(-1))
            near = (fit.location[:, i] - fit.location[:, j]).abs() < APART * rod.length
            vague = ((fit.magnitude_std[:, [i, j]] > VAGUE * size) | (size > HUGE * rod.force_scale)).all(-1)
            middle = 0.5 * (fit.location[:, i] + fit.location[:, j])
            found = torch.where(opposite & near & vague, middle, found)
    return found


def _explained(
    problem: Problem, x: Float[Tensor, "b n"], own: Float[Tensor, " b"], wanted: Bool[Tensor, " b"], settings: Settings
) -> tuple[Float[Tensor, "b 6"], Bool[Tensor, " b"], Float[Tensor, " b"], list[str]]:
    """An error of the base frame, or that one more load, or what is off of the robot, explains the readings: of these and the fit
    x (its score: own) the best. Third, where (m) one more load only makes a couple: that explains nothing.

    A fit that is accepted, for which own is finite, may still have loads that a base frame with fewer would do without.
    """
    unknowns, everyone, refused = problem.unknowns, torch.arange(len(own)), torch.isinf(own).nonzero().squeeze(-1)
    zeta = torch.full((len(own), 6), torch.nan, dtype=torch.float64)
    by_frame, by_load = torch.full_like(own, torch.inf), torch.full_like(own, torch.inf)
    couple = torch.full_like(own, torch.nan)
    count = getattr(unknowns.loads, "count", 0)
    tried = [(unknowns, refused)] + [(_with_loads(unknowns, k), everyone) for k in {1, count - 1} - {count}]
    for some, index in tried if unknowns.registration is None and problem.sees_frame else ():
        if some is None or not len(index):
            continue
        part = problem.of(replace(some, registration=Registration())).take(index)
        if not part.determined:
            continue
        fit = estimate_each(part, settings)
        assert fit.registration is not None
        shift, turn = fit.registration.split(3, -1)
        small = (shift.norm(dim=-1) < TRANSLATION * problem.robot.rod.length) & (turn.norm(dim=-1) < ROTATION)
        score = torch.where(small, _score(part, fit.accepted, fit.chi2), torch.inf)
        zeta[index] = torch.where((score < by_frame[index]).unsqueeze(-1), fit.registration, zeta[index])
        by_frame[index] = torch.minimum(by_frame[index], score)
    more = _with_loads(unknowns, count + 1)
    if more is not None and len(refused) and (part := problem.of(more).take(refused)).determined:
        fit = estimate_each(part, settings)
        couple[refused] = torch.where(fit.accepted, couples(fit, problem.robot.rod), torch.nan)
        by_load[refused] = _score(part, fit.accepted & couple[refused].isnan(), fit.chi2)
    by_robot, robot = _by_robot(problem, x, own, wanted, settings)
    best = torch.stack([by_frame, by_load, by_robot, own]).amin(0)
    robot = [said if off == least else "" for said, off, least in zip(robot, by_robot.tolist(), best.tolist(), strict=True)]
    best = torch.minimum(torch.minimum(by_frame, by_load), torch.where(torch.isinf(own), by_robot, own - SURE))
    framed = torch.isfinite(best) & (by_frame == best)
    one_more = torch.isfinite(best) & ~framed & (by_load == best)
    return torch.where(framed.unsqueeze(-1), zeta, torch.nan), one_more, couple, robot


def _by_robot(
    problem: Problem, x: Float[Tensor, "b n"], own: Float[Tensor, " b"], wanted: Bool[Tensor, " b"], settings: Settings
) -> tuple[Float[Tensor, " b"], list[str]]:
    """The score of what is off of the robot, and what is said of it: with a fit's loads, and with fewer if it is accepted."""
    score, said = torch.full_like(own, torch.inf), [""] * len(own)
    count, accepted = getattr(problem.unknowns.loads, "count", 0), torch.isfinite(own)
    tried = [(count, problem.unknowns, wanted)]
    tried += [(k, _with_loads(problem.unknowns, k), wanted & accepted) for k in sorted({1, count - 1}) if k < count]
    for loads, unknowns, which in tried:
        index = which.nonzero().squeeze(-1)
        if unknowns is None or not len(index) or not (part := problem.of(unknowns).take(index)).determined:
            continue
        at = x[index] if unknowns is problem.unknowns else estimate_each(part, settings).x
        off = suspected(part, at, settings)
        sure = torch.where(accepted[index] & (loads == count), SURE, 0.0)  # with no load less it must do better by more
        for b, found, words in zip(index.tolist(), (off.score + sure).tolist(), off.said, strict=True):
            if found < score[b]:
                what, _, remedy = words.partition("; ")
                score[b], said[b] = found, f"What explains the readings best is {what}; {remedy}."
                if loads < count:
                    fewer = f"{loads} contact{'s' * (loads > 1)} instead of {count}"
                    said[b] = f"The readings are explained as well by {what}, with {fewer}: {remedy}."
    return score, said


def _outliers(problem: Problem, settings: Settings) -> list[Cycle]:
    """Per sample the few markers far off without which a robust fit explains the others."""
    markers = problem.markers
    if math.isfinite(settings.robust) or markers is None or not problem.batch:
        return [()] * problem.batch
    fit = estimate_each(problem, replace(settings, robust=ROBUST))
    few = fit.outlier.sum(-1) <= FEW * markers.present.sum(-1)
    told = fit.outlier & (fit.residual.norm(dim=-1) > CLEAR * markers.deviation) & (fit.accepted & few).unsqueeze(-1)
    return [tuple(row.nonzero().flatten().tolist()) for row in told]


def diagnose(
    problem: Problem,
    fit: Estimate,
    settings: Settings | None = None,
    parts: Sequence[tuple[Unknowns, Int[Tensor, " b"]]] | None = None,
) -> Diagnosis:
    """Look for the mistake behind every fit that does not explain its readings.

    parts: of the batch, each with the unknowns it was fitted by; None: all by the problem's own. Where there are several, the
    number of loads was chosen from the data, and an error of the base frame may have passed for loads: accepted fits of two loads
    and more are looked at as well. Costs a few more fits of these samples, and nothing for the others. Samples that no fit can
    explain have nothing said of them; nothing is raised. Source: what each mistake is told by, and how often that is right, is in
    docs/trust.md.
    """
    parts = [(problem.unknowns, torch.arange(problem.batch))] if parts is None else parts
    hasty, B = replace(settings or Settings(), restarts=(), max_iterations=ITERATIONS), len(fit.status)
    exchanged: list[tuple[Cycle, ...]] = [()] * B
    registration, one_more = torch.full((B, 6), torch.nan, dtype=torch.float64), torch.zeros(B, dtype=torch.bool)
    geometry = [""] * B
    outliers: list[Cycle] = [()] * B
    robot = [""] * B
    markers, L = problem.markers, problem.robot.rod.length
    couple = torch.where(fit.status == int(Status.CONVERGED), couples(fit, problem.robot.rod), torch.nan)
    tip_instead = torch.zeros(B, dtype=torch.bool)

    def misplaced_at(b: int) -> str:
        if markers is not None:
            return misplaced(markers, b, L)
        if problem.unknowns.tip == "none" and len(problem.s.unique()) == 1:
            return ONE_PLACE.format(1e3 * float(problem.s[0]))
        return next((said for c in problem.sensors if isinstance(c, CentreLine) and (said := c.misplaced(b))), "")

    for b in (~fit.accepted & ~torch.isfinite(fit.chi2)).nonzero().flatten().tolist():
        geometry[b] = misplaced_at(b)
    determined = [own for own in (problem.of(unknowns) for unknowns, _ in parts) if own.determined]
    richest = max(reversed(determined), key=lambda own: own.state.loads.size)
    wanted = torch.zeros(B, dtype=torch.bool)  # a robot that is off is so in all samples
    for some in (~fit.accepted & torch.isfinite(fit.chi2), fit.accepted):
        at = some.nonzero().squeeze(-1)
        wanted[at[torch.linspace(0, len(at) - 1, min(MOST_SUSPECTED, len(at))).round().long()]] = True
    for unknowns, index in parts:
        own = problem.of(unknowns)
        tip_instead[index] = len(parts) > 1 and unknowns.tip != "none" and problem.unknowns.tip == "none"
        chosen = len(parts) > 1 and own.state.external.stop > 0
        doubtful = torch.isfinite(fit.chi2[index]) & (~fit.accepted[index] | chosen) & own.take(index).usable
        for rows in index[doubtful].split(CHUNK):
            refused = rows[~fit.accepted[rows]]
            found = _exchanged(own.take(refused), fit, refused, hasty)
            for b, cycles in zip(refused.tolist(), found, strict=True):
                exchanged[b] = cycles
            for b in [b for b in refused.tolist() if not exchanged[b]]:
                geometry[b] = misplaced_at(b)
            rest = rows[[not (exchanged[b] or geometry[b]) for b in rows.tolist()]]
            part = own.take(rest)
            score = _score(part, fit.accepted[rest], fit.chi2[rest])
            registration[rest], one_more[rest], pair, off = _explained(part, fit.x[rest, : own.size], score, wanted[rest], hasty)
            for b, said in zip(rest.tolist(), off, strict=True):
                robot[b] = said
            couple[rest] = torch.where(couple[rest].isnan(), pair, couple[rest])
            rest = rest[~fit.accepted[rest] & ~one_more[rest] & registration[rest].isnan().any(-1)]
            rest = rest[[not robot[b] for b in rest.tolist()]]
            for b, some in zip(rest.tolist(), _outliers(richest.take(rest), settings or Settings()), strict=True):
                outliers[b] = some
    if problem.unknowns.tip == "none" and problem.state.loads.size and len(problem.s.unique()) == 1:
        geometry = [said or ONE_PLACE.format(1e3 * float(problem.s[0])) for said in geometry]  # of a fit that is accepted, too
    found = registration, one_more, tuple(geometry), tuple(outliers), couple, tip_instead
    return Diagnosis(problem.s, tuple(exchanged), *found, robot=tuple(robot))
