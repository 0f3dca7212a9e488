"""The estimate: what torchrod is for."""

import torch

from ..model.problem import Problem
from ..model.unknowns import Scope
from .result import Estimate
from .shared import with_shared_frame
from .solve import Progress, Settings, estimate_each, silent
from .starts import Start, StartRule, cold_start


def estimate(
    problem: Problem, settings: Settings | None = None, start: StartRule | Start = cold_start, progress: Progress = silent
) -> Estimate:
    """Fit the unknowns of every sample to what its sensors read: the weighted least squares (1) of the residual (3), iterated
    by (4).

    problem: robot, unknowns and readings of B samples. A registration of scope SHARED is one for all samples (estimation.shared).
    start: where to start, or a rule that says so from a problem of some of the samples; a challenged start that is no nearer to the
    data than a cold one is dropped, and one that leads to no accepted fit is followed by a cold start. progress: called as samples
    finish, with their number. Unless unknowns are shared, a sample's answer does not depend on its batch. Errors: ValueError for
    measurements or a start that do not fit the robot; a sample that cannot be estimated has a status for it. Source: the paper,
    section II; docs/model.md.
    """
    registration = problem.unknowns.registration
    if registration is None or registration.scope is Scope.SAMPLE:
        return estimate_each(problem, settings, start, progress)
    everyone = torch.arange(problem.batch)

    def fitted(problem: Problem):
        rule = start if problem.unknowns.registration is not None or not isinstance(start, Start) else cold_start
        return estimate_each(problem, settings, rule, progress), [(problem.unknowns, everyone)]

    return with_shared_frame(problem, fitted, settings, progress).estimate
