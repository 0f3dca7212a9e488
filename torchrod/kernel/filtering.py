"""The filter by the compiled kernel: one iteration, or all of them until every sample has converged."""

import ctypes

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from .fitting import FitTables, Sums, run
from .structures import Course, Filter, address, fill
from .structures import Sums as CSums


class Iteration:
    """Iterations of the filter on one chunk, in place: ekf.advance at the normal equations of x.

    state: x, Sigma, before, cap, done of ekf.Iterate. filtering: Sigma0 (B, n, n), mean, precision and Q (n). limits: those of
    ekf.Limits by name. sums: written for the samples that are done.
    """

    def __init__(self, state: dict[str, Tensor], filtering: dict[str, Tensor], limits: dict[str, float | int], sums: Sums):
        self._held = (state, filtering, sums)  # the structures hold bare addresses
        self.filter, self.sums = Filter(), CSums()
        fill(self.filter, state | filtering, limits)
        fill(self.sums, vars(sums), {})

    def __call__(self, tables: FitTables, live: Int[Tensor, " b"]) -> None:
        """One iteration of the samples `live`."""
        b, live = len(live), live.contiguous()
        pointers = [ctypes.byref(x) for x in (tables.structure, self.filter, self.sums)]
        run("torchrod_iterate", b, *pointers, address(live, "live"), ctypes.c_int64(b))


def iterate_all(
    rough: tuple[Iteration, FitTables],
    fine: tuple[Iteration, FitTables],
    live: Int[Tensor, " b"],
    near: Bool[Tensor, " B"],
    most: int,
) -> tuple[Bool[Tensor, " B"], Int[Tensor, " B"]]:
    """Iterations of the samples `live`, at most so many each: the rough ones until a sample is near, then the fine ones.

    Returns which have converged, and how many iterations each has had. near changes in place.
    """
    converged, iterations = torch.zeros_like(near), torch.zeros(len(near), dtype=torch.int64)
    course, live = Course(), live.contiguous()
    fill(course, {"near": near, "converged": converged, "iterations": iterations}, {"most": most})
    parts = {"coarse": rough[1].structure, "fine": fine[1].structure, "rough": rough[0].filter, "filter": fine[0].filter}
    for name, structure in (parts | {"out": fine[0].sums}).items():
        setattr(course, name, ctypes.addressof(structure))
    run("torchrod_filter", len(live), ctypes.byref(course), address(live, "live"), ctypes.c_int64(len(live)))
    return converged, iterations
