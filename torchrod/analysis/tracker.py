"""One robot, shape after shape: an estimator that is built once and called for every frame."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..estimation.result import Estimate
from ..estimation.solve import Settings, estimate_each
from ..estimation.starts import Origin, Start, StartRule, cold_start
from ..learned.warm_start import find_warm_start
from ..mechanics.robot import Robot
from ..model.problem import Problem
from ..model.sensors import Markers
from ..model.unknowns import Unknowns
from ..util.precision import as_float64


class Tracker:
    """Estimates one shape at a time, each from where the last one ended: three iterations or so, 2 to 3 ms (docs/performance.md).

        tracker = Tracker(robot, unknowns, s, noise=1e-3)
        for positions in camera:
            fit = tracker(positions)

    s: (P,) m, arc lengths of the markers. noise: m. offsets: (P, 3) m, as in Markers. The first frame, and one after a fit that was
    not accepted, starts from a checkpoint where one fits, else cold; the last fit is left aside where a cold start is nearer.
    Errors: ValueError for what does not fit the robot, as torchrod.estimate.
    """

    def __init__(
        self,
        robot: Robot,
        unknowns: Unknowns,
        s: Float[Tensor, " P"],
        noise: float,
        offsets: Float[Tensor, "P 3"] | None = None,
        settings: Settings | None = None,
    ):
        s = as_float64(s)
        nowhere = Markers(s, s.new_full((1, len(s), 3), torch.nan), noise, offsets)
        self._frame = Problem(robot, unknowns, [nowhere])  # with whose readings a frame's are exchanged
        self.settings = settings or Settings()
        self._first: StartRule = find_warm_start(self._frame) or cold_start
        self._last: Float[Tensor, "1 n"] | None = None
        self._cold: Float[Tensor, "1 n"] | None = None
        self._cold_tension: Float[Tensor, "1 T"] | None = None

    def __call__(self, positions: Float[Tensor, "P 3"], tension: Float[Tensor, " T"] | None = None) -> Estimate:
        """The fit to one shape: positions (m, base frame, NaN where a marker is missing) and tensions (N). A batch of one."""
        markers = self._frame.markers
        assert markers is not None
        seen = replace(markers, positions=positions[None])
        problem = replace(self._frame, sensors=[seen], tension=None if tension is None else tension[None])
        fit = estimate_each(problem, self.settings, self._start)
        self._last = fit.x if bool(fit.accepted[0]) else None
        return fit

    def reset(self) -> None:
        """Forget the last shape."""
        self._last = None

    def _start(self, problem: Problem) -> Start:
        """The last fit. What it must be nearer than is the cold start at these tensions, which costs a forward solve."""
        same = self._cold_tension is problem.tension or (
            self._cold_tension is not None and problem.tension is not None and torch.equal(self._cold_tension, problem.tension)
        )
        if self._cold is None or (self._last is not None and not same):
            self._cold, self._cold_tension = cold_start(problem).x, problem.tension
        if self._last is None:
            return self._first(problem)
        origin = torch.full((1,), int(Origin.PREVIOUS))
        return Start(self._last, origin, torch.ones(1, dtype=torch.bool), None, self._cold)
