"""One robot, shape after shape: an estimator that is built once and called for every frame."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..estimation.result import Estimate
from ..estimation.solve import Settings, estimate
from ..estimation.starts import Start, StartRule, cold_start
from ..learned.warm_start import find_warm_start
from ..model.measurement import Markers, Model
from ..util.precision import as_float64


class Estimator:
    """Estimates one shape at a time, each from where the last one ended: three iterations or so, 2 to 3 ms (docs/performance.md).

        estimator = Estimator(model, s, noise=1e-3)
        for positions in camera:
            fit = estimator(positions)

    s: (P,) m, arc lengths of the markers. noise: m. offsets: (P, 3) m, as in Markers. The first frame, and one after a fit that was
    not accepted, starts from a checkpoint where one fits, else cold; the last fit is left aside where a cold start is nearer.
    Errors: ValueError for what does not fit the robot, as torchrod.estimate.
    """

    def __init__(
        self,
        model: Model,
        s: Float[Tensor, " P"],
        noise: float,
        offsets: Float[Tensor, "P 3"] | None = None,
        settings: Settings | None = None,
    ):
        self.model, self.noise = model, noise
        self.s, self.offsets = as_float64(s), as_float64(offsets)  # once, not frame by frame
        self.settings = settings or Settings()
        self._first: StartRule = find_warm_start(model) or cold_start
        self._last: Float[Tensor, "1 n"] | None = None
        self._cold: Float[Tensor, "1 n"] | None = None

    def __call__(self, positions: Float[Tensor, "P 3"], tension: Float[Tensor, " T"] | None = None) -> Estimate:
        """The fit to one shape: positions (m, base frame, NaN where a marker is missing) and tensions (N). A batch of one."""
        markers = Markers(self.s, positions[None], self.offsets, None if tension is None else tension[None])
        fit = estimate(self.model, markers, self.noise, self.settings, self._start)
        self._last = fit.x if bool(fit.accepted[0]) else None
        return fit

    def reset(self) -> None:
        """Forget the last shape."""
        self._last = None

    def _start(self, model: Model, markers: Markers, noise: float) -> Start:
        """The last fit. What it must be nearer than is the cold start of the first frame, which costs a forward solve."""
        if self._last is not None and self._cold is not None:
            return Start(self._last, None, torch.ones(1, dtype=torch.bool), self._cold)
        self._cold = cold_start(model, markers, noise).x
        return self._first(model, markers, noise)
