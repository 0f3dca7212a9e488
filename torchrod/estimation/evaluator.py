"""How a problem is evaluated: by the compiled kernel where it serves, else by the torch model, which is the definition.

`evaluator` chooses once for each problem; whoever holds an Evaluator does not ask which one it is. The kernel walks any robot under
the load families of model.load_families. Isotropic markers are its own as well; what other sensors read of the states it finds is
worked out by torch. Load families of a user's own go through the torch model with a compiled march.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .. import kernel
from ..mechanics.jacobian import moved_along
from ..model.problem import TIP_ROWS, Problem
from . import filter as ekf
from .walk import Walk, kernel_serves, kernel_walks


@runtime_checkable
class Evaluator(Protocol):
    """A problem made ready for the filter, which evaluates it many times.

    problem: with B samples. nu: degrees of freedom of Student's t, by which outliers weigh little; inf: a normal distribution.
    """

    @property
    def problem(self) -> Problem:
        """What is evaluated."""
        ...

    @property
    def nu(self) -> float:
        """Degrees of freedom of Student's t."""
        ...

    def take(self, index: Int[Tensor, " b"]) -> "Evaluator":
        """The samples of an index."""
        ...

    def h(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B z"]:
        """See Problem."""
        ...

    def linearized(self, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"]]:
        """See Problem."""
        ...

    def cost(self, x: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
        """The cost of (3) with the prior's, r^T W r + (x0 - x)^T P (x0 - x)."""
        ...

    def sums(self, x: Float[Tensor, "B n"]) -> kernel.Sums:
        """At x: the normal equations, the residuals and the centre line (m, the rod's own frame)."""
        ...

    def posterior(self, sums: kernel.Sums, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B n n"], Float[Tensor, " B"]]:
        """From the sums at x: the covariance, in equilibrium, and the cost of (3) with the prior: see filter.Normal.posterior."""
        ...

    def iteration(self, run: "Run", limits: ekf.Limits) -> Callable[[Int[Tensor, " b"]], None]:
        """One iteration of the filter on some samples of a run, in place; run.at.done then says which of them are done."""
        ...

    def iterate_all(
        self, fine: "Evaluator", run: "Run", limits: tuple[ekf.Limits, ekf.Limits], live: Int[Tensor, " b"], most: int
    ) -> tuple[Bool[Tensor, " B"], Int[Tensor, " B"]] | None:
        """All iterations in one call, by this evaluator until a sample is near, then by `fine`; None where that cannot be done.

        Returns which samples have converged, and how many iterations each has had. run.near changes in place.
        """
        ...


@dataclass(frozen=True)
class Run:
    """The filter's state on B samples, changed in place: the iterate, what it began from, and the sums of samples that are done.

    near (B,): whether a sample is near enough to the data for the fine model.
    """

    at: ekf.Iterate
    Sigma0: Float[Tensor, "B n n"]
    Q: Float[Tensor, " n"]
    sums: kernel.Sums
    near: Bool[Tensor, " B"]


def evaluator(problem: Problem, nu: float = math.inf) -> Evaluator:
    """The evaluator that serves a problem, which keeps it."""
    kept = vars(problem).setdefault("_evaluators", {})
    if nu not in kept:
        kept[nu] = _made(problem, nu)
    return kept[nu]


def _made(problem: Problem, nu: float) -> Evaluator:
    if not kernel_walks(problem):
        return TorchEvaluator(problem, nu)
    if kernel_serves(problem):
        return KernelEvaluator(problem, nu)
    markers = problem.markers
    return (SensorEvaluator if markers is None or not markers.isotropic else MisreadEvaluator)(problem, nu)


@dataclass(frozen=True)
class TorchEvaluator:
    """By Problem.h and Problem.linearized: the definition."""

    problem: Problem
    nu: float = math.inf

    def take(self, index: Int[Tensor, " b"]) -> "TorchEvaluator":
        """The samples of an index."""
        return replace(self, problem=self.problem.take(index))

    def residual(self, h: Float[Tensor, "B z"]) -> Float[Tensor, "B z"]:
        """r = z - h(x), zero where nothing was read."""
        return torch.where(self.problem.weights > 0, self.problem.reading - h, 0.0)

    def h(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B z"]:
        """See Problem."""
        return self.problem.h(x, differentiable=False)

    def linearized(self, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"]]:
        """See Problem."""
        return self.problem.linearized(x)

    def cost(self, x: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
        """See Evaluator."""
        problem, m = self.problem, len(self.problem.groups)
        square = problem.weights * self.residual(self.h(x)) ** 2
        sensors, _ = ekf.sensors_cost(square[:, :m], problem.groups, self.nu)
        return sensors + square[:, m:].sum(-1) + (problem.precision * (problem.mean - x) ** 2).sum(-1)

    def sums(self, x: Float[Tensor, "B n"]) -> kernel.Sums:
        """See Evaluator."""
        problem = self.problem
        h, H = self.linearized(x)
        r = self.residual(h)
        N = ekf.normal_equations(H, r, problem.weights, problem.groups, self.nu)
        C = H[:, len(problem.groups) :].contiguous()
        return kernel.Sums(N.A, N.g, N.cost, C, r, self.line(x))

    def line(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B P 3"]:
        """The centre line (m, the rod's own frame)."""
        return self.problem.shape(x, differentiable=False).p

    def posterior(self, sums: kernel.Sums, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B n n"], Float[Tensor, " B"]]:
        """See Evaluator."""
        problem = self.problem
        return normal(problem, sums).posterior(x, problem.mean, problem.precision, problem.exact_tip)

    def iteration(self, run: Run, limits: ekf.Limits) -> Callable[[Int[Tensor, " b"]], None]:
        """See Evaluator."""

        def once(live: Int[Tensor, " b"]) -> None:
            part, here = self.take(live), run.at.take(live)
            found = part.sums(here.x)
            prior = part.problem.mean, part.problem.precision
            run.at.put(live, ekf.advance(here, normal(part.problem, found), run.Sigma0[live], prior, run.Q, limits))
            run.sums.put(live, found)

        return once

    def iterate_all(self, fine: Evaluator, run: Run, limits, live: Int[Tensor, " b"], most: int) -> None:
        """None: step by step."""


def normal(problem: Problem, sums: kernel.Sums) -> ekf.Normal:
    """The normal equations as estimation.filter has them."""
    return ekf.Normal(sums.A, sums.g, sums.cost, problem.seen, ekf.TipCondition.of(sums.C, sums.r[:, -TIP_ROWS:]))


@dataclass(frozen=True)
class KernelEvaluator:
    """By the compiled kernel, held to TorchEvaluator by tests/test_fit.py."""

    problem: Problem
    nu: float = math.inf

    @cached_property
    def walk(self) -> Walk:
        """The kernel's tables."""
        return Walk(self.problem, self.nu)

    def take(self, index: Int[Tensor, " b"]) -> "KernelEvaluator":
        """The samples of an index."""
        return KernelEvaluator(self.walk.take(index).problem, self.nu)

    def tables(self, x: Float[Tensor, "B n"]) -> kernel.FitTables:
        """What the kernel is handed, for all samples."""
        return self.walk.tables(x)

    def cost(self, x: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
        """See Evaluator."""
        t = self.walk.tables(x, slopes=False)  # which must outlive the call: the structure holds bare addresses
        return kernel.cost_now(x, self.problem.mean, self.problem.precision, t.structure)

    def sums(self, x: Float[Tensor, "B n"]) -> kernel.Sums:
        """See Evaluator."""
        t = self.tables(x)
        return kernel.normal_equations_now(x, t.structure, t.markers)

    def posterior(self, sums: kernel.Sums, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B n n"], Float[Tensor, " B"]]:
        """See Evaluator."""
        return kernel.posterior_now(sums, x, self.problem.mean, self.problem.precision, self.problem.exact_tip)

    def h(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B z"]:
        """See Problem."""
        t = self.walk.tables(x, slopes=False)
        return kernel.measured_now(x, t.structure, t.markers, slopes=False)[0]

    def linearized(self, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"]]:
        """See Problem."""
        t = self.tables(x)
        h, H = kernel.measured_now(x, t.structure, t.markers, slopes=True)
        assert H is not None
        return h, H

    def line(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B P 3"]:
        """The centre line (m, the rod's own frame)."""
        return self.sums(x).line

    def _compiled(self, run: Run, limits: ekf.Limits) -> kernel.Iteration:
        filtering = {"Sigma0": run.Sigma0, "mean": self.problem.mean, "precision": self.problem.precision, "Q": run.Q}
        return kernel.Iteration(vars(run.at), filtering, limits._asdict(), run.sums)

    def iteration(self, run: Run, limits: ekf.Limits) -> Callable[[Int[Tensor, " b"]], None]:
        """See Evaluator."""
        call = self._compiled(run, limits)
        return lambda live: call(self.tables(run.at.x), live)

    def iterate_all(
        self, fine: Evaluator, run: Run, limits: tuple[ekf.Limits, ekf.Limits], live: Int[Tensor, " b"], most: int
    ) -> tuple[Bool[Tensor, " B"], Int[Tensor, " B"]] | None:
        """See Evaluator."""
        if self.walk.moving or not isinstance(fine, KernelEvaluator):
            return None
        calls = [(e._compiled(run, own), e.tables(run.at.x)) for e, own in zip((self, fine), limits, strict=True)]
        return kernel.iterate_all(calls[0], calls[1], live, run.near, most)


@dataclass(frozen=True)
class SensorEvaluator(TorchEvaluator):
    """Any sensors: the rod by the kernel, and what they read of its states by Problem.read. tests/test_sensors.py holds it to
    TorchEvaluator.
    """

    @cached_property
    def walk(self) -> Walk:
        """The rod by the kernel."""
        return Walk(self.problem, self.nu)

    def take(self, index: Int[Tensor, " b"]) -> "SensorEvaluator":
        """The samples of an index."""
        return SensorEvaluator(self.walk.take(index).problem, self.nu)

    def h(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B z"]:
        """See Problem."""
        y, c, *_ = self.walk.states(x, slopes=False)
        return torch.cat([self.problem.read(y, x), c], -1)

    def linearized(self, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"]]:
        """See Problem."""
        y, c, dy, dc = self.walk.states(x, slopes=True)
        assert dy is not None and dc is not None
        axes = torch.eye(x.shape[-1], dtype=x.dtype).unsqueeze(1).expand(-1, *x.shape)
        rows, slopes = moved_along(self.problem.read, (y, x), (dy.movedim(-1, 0), axes))
        return torch.cat([rows, c], -1), torch.cat([slopes, dc], 1)

    def line(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B P 3"]:
        """The centre line (m, the rod's own frame)."""
        return self.walk.states(x, slopes=False)[0][:, :-1, :3]


@dataclass(frozen=True)
class MisreadEvaluator(TorchEvaluator):
    """Isotropic markers of which it is only nearly known how they are measured: where they are by the kernel, the rest by torch."""

    @cached_property
    def _plain(self) -> KernelEvaluator:
        """Of where the markers are."""
        return KernelEvaluator(self.problem, self.nu)

    @property
    def walk(self) -> Walk:
        """The rod by the kernel."""
        return self._plain.walk

    def take(self, index: Int[Tensor, " b"]) -> "MisreadEvaluator":
        """The samples of an index."""
        plain = self._plain.take(index)
        part = MisreadEvaluator(plain.problem, self.nu)
        vars(part)["_plain"] = plain
        return part

    def h(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B z"]:
        """See Problem."""
        h, nearly = self._plain.h(x), self.problem.deviations
        assert nearly is not None
        measured = nearly.warp(x[:, self.problem.state.parameters.at])(h[:, :-TIP_ROWS].unflatten(-1, (-1, 3)))
        return torch.cat([measured.flatten(-2), h[:, -TIP_ROWS:]], -1)

    def linearized(self, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B z"], Float[Tensor, "B z n"]]:
        """See Problem."""
        (h, H), nearly, at = self._plain.linearized(x), self.problem.deviations, self.problem.state.parameters.at
        assert nearly is not None
        warp, p = nearly.warp(x[:, at]), h[:, :-TIP_ROWS].unflatten(-1, (-1, 3))
        slopes = warp.matrix.unsqueeze(1) @ H[:, :-TIP_ROWS].unflatten(1, (-1, 3))
        slopes[..., at] += warp.slopes(p) @ nearly.warp_root
        return torch.cat([warp(p).flatten(-2), h[:, -TIP_ROWS:]], -1), torch.cat([slopes.flatten(1, 2), H[:, -TIP_ROWS:]], 1)

    def line(self, x: Float[Tensor, "B n"]) -> Float[Tensor, "B P 3"]:
        """The centre line (m, the rod's own frame)."""
        return self._plain.line(x)


Walked = KernelEvaluator | SensorEvaluator | MisreadEvaluator  # by the kernel, along the rod
