"""The whole way from readings to an answer: noise, number of loads, common frame, judgement, diagnosis, load profile."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Int
from torch import Tensor

from ..estimation.intervals import Intervals, sampled_intervals
from ..estimation.load_places import LoadPlaces, load_places
from ..estimation.load_profile import Profile, joined_profile
from ..estimation.result import Estimate
from ..estimation.shared import STEPS, BaseFrame, with_shared_frame
from ..estimation.solve import Settings, estimate_each
from ..estimation.starts import StartRule, cold_start
from ..learned.warm_start import find_warm_start
from ..model.load_families import GaussianCoordinates, SmoothCoordinates
from ..model.problem import Problem
from ..model.sensors import TipWrench
from ..model.unknowns import Scope, Unknowns
from .alternatives import other_solutions
from .averaging import average
from .count import (
    MAX_CONTACTS,
    MOST_BESIDE_TIP,
    Bar,
    Evidence,
    Hypothesis,
    Parts,
    StartFor,
    no_bar,
    parts_of,
    same_kind,
    selection,
)
from .diagnosis import Diagnosis, diagnose
from .noise import Noise, estimate_noise_among, with_noise
from .patterns import Pattern, joined_diagnosis, joined_estimate, joined_evidence, joined_intervals, joined_noise, part_of, patterns
from .untold import NARROW, spread, untold

SMOOTH_DEVIATIONS, SMOOTH_CORRELATIONS = (0.5, 2.0, 8.0), (0.1, 0.4)  # force scales / L, lengths


def learned_or_cold(problem: Problem) -> StartRule:
    """The shipped checkpoint that fits a problem, else a cold start."""
    return find_warm_start(problem) or cold_start


def contact_hypotheses(
    problem: Problem,
    contacts: int | str = "auto",
    load_prior: str = "contact",
    locations: Sequence[float] | None = None,
    friction: float | None = None,
) -> list[Hypothesis]:
    """What competes to explain the readings of a problem: numbers of Gaussian loads, priors of their width, something at the tip.

    contacts: so many, or "auto": 0 to MAX_CONTACTS. load_prior: "point", "contact", "distributed", "none", "smooth": one load of
    any form along the rod, of several sizes and length scales (model.load_families.smooth), or "auto": contact against distributed
    and smooth. locations: known ones (m), one for each contact. friction: of contacts that may drag along the rod
    (GaussianCoordinates); infinite: by any force; None: by none. With contacts "auto" an unknown tip of the problem's unknowns
    competes with nothing at the tip, unless a sensor reads it; where none is unknown, a force there is tried on samples that take
    two contacts or one near the tip, or that nothing explains. The rest of its unknowns is part of every hypothesis. Errors:
    ValueError for another prior.
    """
    known, rod = problem.unknowns, problem.robot.rod
    if load_prior == "smooth" and not (contacts in (1, "auto", "1") and locations is None and friction is None):
        raise ValueError('load_prior "smooth" is one load along the whole rod; leave contacts, places and friction out')
    counts = range(MAX_CONTACTS + 1) if contacts == "auto" else [int(contacts)]
    priors = {"auto": ["contact", "distributed"], "smooth": []}.get(load_prior, [load_prior])
    competes = contacts == "auto" and known.tip != "none" and not any(isinstance(s, TipWrench) for s in problem.sensors)
    tips = ["none", known.tip] if competes else [known.tip]
    at = None if locations is None else tuple(locations)
    found = []
    for k in counts:
        for tip in tips:
            for prior in priors if k else ["contact"]:
                name = f"{k} {prior}" if len(priors) > 1 and k else str(k)
                name += f" + tip {tip}" if len(tips) > 1 and tip != "none" else ""
                loads = GaussianCoordinates(k, rod.length, rod.force_scale, prior, at, friction=friction)
                found.append(Hypothesis(name, k, replace(known, loads=loads, tip=tip)))
            if k == 1 and load_prior in ("auto", "smooth") and locations is None and friction is None:
                for scales in itertools.product(SMOOTH_DEVIATIONS, SMOOTH_CORRELATIONS):
                    smooth = SmoothCoordinates(rod.length, rod.force_scale, *scales)
                    name = f"1 {smooth.prior_name}" + f" + tip {tip}" * (len(tips) > 1 and tip != "none")
                    found.append(Hypothesis(name, 1, replace(known, loads=smooth, tip=tip)))
    if contacts == "auto" and known.tip == "none" and priors:  # not of one load of any form, which is all that is asked for then
        for k in range(MOST_BESIDE_TIP + 1):
            loads = GaussianCoordinates(k, rod.length, rod.force_scale, priors[0], at, friction=friction)
            found.append(Hypothesis(f"{k} + tip force", k, replace(known, loads=loads, tip="force"), spare=True))
    return found


@dataclass(frozen=True)
class Analysis:
    """What `analyze` has found of B samples.

    problem: as it was fitted in the end, with the noise and in the base frame that were found. estimate: loads and how sure. parts:
    the unknowns that were chosen, each with the samples that chose it. evidence: what spoke for each hypothesis; None where there
    was one. noise: where it was estimated, else None. frame: the base frame's error that all samples share, else None. diagnosis:
    what is wrong with samples that no fit explains. intervals: from draws of the posterior, where that was asked for.
    """

    problem: Problem
    estimate: Estimate
    parts: Sequence[tuple[Unknowns, Int[Tensor, " b"]]]
    evidence: Evidence | None
    noise: Noise | None
    frame: BaseFrame | None
    diagnosis: Diagnosis
    intervals: Intervals | None = None

    @cached_property
    def profile(self) -> Profile | None:
        """f(s) of every sample with its band, from the draws where there are any; None for point loads, which have no density."""
        own = joined_profile(self.problem, self.parts, self.estimate.x, self.estimate.covariance)
        if own is None or self.intervals is None or self.intervals.band is None:
            return own
        drawn = self.intervals.band
        return replace(own, band=torch.where(drawn.isnan(), own.band, drawn))

    @cached_property
    def places(self) -> LoadPlaces:
        """Where the loads act in space, and their forces in the robot's base frame."""
        return load_places(self.problem, self.parts, self.estimate)

    def message(self, sample: int) -> str:
        """What became of a sample, what is wrong with it, what else explains it, and what to do."""
        return f"{self.estimate.message(sample)} {self.diagnosis.message(sample)}".rstrip()


def analyze(
    problem: Problem,
    candidates: Sequence[Hypothesis] | None = None,
    unknown_noise: bool = False,
    settings: Settings | None = None,
    start: StartFor = learned_or_cold,
    bar: Bar = no_bar,
    sampled: bool = False,
    named: bool = False,
) -> Analysis:
    """Everything that `torchrod estimate` does, from readings to judged loads.

    problem: robot, unknowns and readings. candidates: hypotheses that compete (`contact_hypotheses`); None: the problem's unknowns
    alone. unknown_noise: estimate the markers' noise of each sample from the residual; what the markers state plays no part then. A
    registration of scope SHARED is found from all samples. start: the rule that the fits of a hypothesis start by. bar: shows
    progress, called with a total and a name. sampled: intervals and bands from draws of the posterior (estimation.draws), and the
    choice among hypotheses by their probabilities (analysis.averaging); not where all samples share a base frame, whose error the
    draws of one sample cannot have. named: what nobody told of is named if it explains the readings as well (analysis.untold), by a
    few fits more: other loads where the number of contacts is told, and one spread along the rod where none competes.
    Errors: ValueError as torchrod.estimate.
    """
    registration = problem.unknowns.registration
    split = patterns(problem) if registration is None or registration.scope is not Scope.SHARED else []
    if split:
        with bar(problem.batch, "samples") as shown:
            found = []
            for pattern in split:
                found.append(
                    analyze(part_of(problem, pattern), candidates, unknown_noise, settings, start, sampled=sampled, named=named)
                )
                shown.update(len(pattern.samples))
        return _joined(problem, found, split)
    settings, noise = settings or Settings(), None
    competing = list(candidates) if candidates is not None else [Hypothesis("", _count(problem), problem.unknowns)]
    if unknown_noise:
        kin = [c.unknowns for c in competing if same_kind(c.unknowns, competing[-1].unknowns)]
        noise, sigma = estimate_noise_among(problem, kin, settings)
        problem = with_noise(problem, sigma)
    evidence: Evidence | None = None
    drawn: Intervals | None = None
    shared = registration is not None and registration.scope is Scope.SHARED

    def fitted(problem: Problem) -> tuple[Estimate, Parts]:
        nonlocal evidence, drawn
        own = [replace(c, unknowns=replace(c.unknowns, registration=problem.unknowns.registration)) for c in competing]
        if len(own) > 1:
            drawing = sampled and not shared
            chosen = selection(problem, own, settings, start, bar, thorough=drawing)
            found, evidence = chosen.fit, chosen.evidence
            if drawing:
                averaged = average(problem, own, chosen, settings.robust, bar)
                found, evidence, drawn = averaged.fit, averaged.evidence, averaged.intervals
            return found, parts_of(own, evidence)
        only = problem.of(own[0].unknowns)
        with bar(problem.batch, f"{own[0].contacts} contact{'s' * (own[0].contacts != 1)}") as shown:
            found = estimate_each(only, settings, start(only), shown.update)
        return found, [(only.unknowns, torch.arange(problem.batch))]

    frame = None
    if shared:
        with bar(STEPS * problem.batch, "base frame") as shown:
            common = with_shared_frame(problem, fitted, settings, shown.update)
        found, parts, frame, problem = common.estimate, common.parts, common.frame, common.problem
    else:
        found, parts = fitted(problem)
    if len(parts) == 1:
        problem = problem.of(parts[0][0])
    found = found if noise is None else noise.judged(found)
    diagnosis = replace(diagnose(problem, found, settings, parts), others=other_solutions(problem, found, parts, settings))
    rivals = []
    if evidence is not None and evidence.probability is not None:
        rivals.append([evidence.rival(b) for b in range(problem.batch)])
    elif named and evidence is None:
        rivals.append(untold(problem, found, settings, start))
    if named and all(getattr(c.unknowns.loads, "prior_name", "") in NARROW for c in competing):
        rivals.append(spread(problem, found, parts, settings, start, told=evidence is None))
    diagnosis = replace(diagnosis, rivals=tuple(" ".join(filter(None, words)) for words in zip(*rivals, strict=True)))
    if sampled and not shared and drawn is None:
        drawn = sampled_intervals(problem, found, parts, nu=settings.robust)
    return Analysis(problem, found, parts, evidence, noise, frame, diagnosis, drawn)


def _joined(problem: Problem, found: Sequence[Analysis], split: Sequence[Pattern]) -> Analysis:
    """The analysis of a batch that was split; every part has the same hypotheses."""
    B = problem.batch
    parts = []
    for h, (unknowns, _) in enumerate(found[0].parts):
        parts.append((unknowns, torch.cat([p.samples[a.parts[h][1]] for a, p in zip(found, split, strict=True)])))
    noise = joined_noise([a.noise for a in found], split, B)
    problem = problem.of(parts[0][0]) if len(parts) == 1 else problem
    estimate = joined_estimate([a.estimate for a in found], split, problem)
    evidence = joined_evidence([a.evidence for a in found], split, B)
    diagnosis = joined_diagnosis([a.diagnosis for a in found], split, problem)
    drawn = joined_intervals([a.intervals for a in found], split, B)
    return Analysis(problem, estimate, parts, evidence, noise, None, diagnosis, drawn)


def _count(problem: Problem) -> int:
    return int(getattr(problem.unknowns.loads, "count", 1))
