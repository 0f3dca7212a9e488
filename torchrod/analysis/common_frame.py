"""One error of the base frame for all samples: a camera that stood still is off by the same in every shape.

Alone, a shape hardly tells a base frame that is off from a push near the base: with it unknown, the Cramer-Rao bound of a push on
Study 1 is four (location) to eight (magnitude) times wider (docs/trust.md). Together they do. With x the loads and base wrench of a
sample, z the error of the frame in which the markers are taken, A and g the information and gradient of [x, z] at
a fit without registration, eliminating every x from the joint Gauss-Newton step leaves

    (1)  S = A_zz - A_zx A_xx^-1 A_xz,   q = g_z - A_zx A_xx^-1 g_x     per sample
    (2)  (P + sum S) dz = sum q - P z                                    P: the prior, about no error
    (3)  x of a fit in the corrected frame moves by -A_xx^-1 A_xz dz, and its covariance grows by what that does to (P + sum S)^-1
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..estimation import filter as ekf
from ..estimation.result import Estimate, load_covariance
from ..estimation.solve import Settings, estimate, linearize
from ..mechanics.lie import matvec
from ..model.measurement import Markers, Model
from ..util.precision import DTYPE
from ..util.status import Status

Parts = Sequence[tuple[Model, Int[Tensor, " b"]]]
STEPS = 3
CHUNK = 256


@dataclass(frozen=True)
class BaseFrame:
    """The error of the base frame that all samples share: zeta (6,) [m, rad] as in torchrod.Estimate, and its covariance (6, 6)."""

    zeta: Float[Tensor, " 6"]
    covariance: Float[Tensor, "6 6"]

    def corrected(self, markers: Markers) -> Markers:
        """The markers in the rod's own frame."""
        import roma

        back = roma.rotvec_to_rotmat(self.zeta[3:]).T
        return replace(markers, positions=matvec(back, markers.positions - self.zeta[:3]))

    def moved_by(self, dz: Float[Tensor, " 6"]) -> Float[Tensor, " 6"]:
        """zeta after an error dz that is left in the corrected frame."""
        import roma

        R = roma.rotvec_to_rotmat(self.zeta[3:])
        return torch.cat([self.zeta[:3] + R @ dz[:3], roma.rotmat_to_rotvec(R @ roma.rotvec_to_rotmat(dz[3:]))])

    def widened(self, parts: Parts, markers: Markers, noise: float, fit: Estimate) -> Estimate:
        """A fit of the corrected markers, made by models without registration, with what is left unknown of the frame (3)."""
        covariance, loads = fit.covariance.clone(), fit.load_covariance.clone()
        for model, index in parts:
            for some in _chunks(index[fit.status[index] == int(Status.CONVERGED)]):
                n, k = model.size, model.coordinates.describe(fit.x[some, : model.coordinates.size]).location.shape[-1]
                G, _, _ = _eliminated(model, fit.x[some, :n], markers.take(some), noise)
                C = covariance[some, :n, :n] + G @ self.covariance @ G.mT
                covariance[some, :n, :n] = C
                loads[some, :k] = load_covariance(model, fit.x[some, :n], C)
        return replace(fit, covariance=covariance, load_covariance=loads, registration=self.zeta.expand(len(fit.x), 6).clone())


def _chunks(index: Int[Tensor, " b"]) -> list[Int[Tensor, " c"]]:
    return [some for some in index.split(CHUNK) if len(some)]


def _eliminated(
    model: Model, x: Float[Tensor, "b n"], markers: Markers, noise: float
) -> tuple[Float[Tensor, "b n 6"], Float[Tensor, "b 6 6"], Float[Tensor, "b 6"]]:
    """A_xx^-1 A_xz, and S and q of (1), of samples fitted by a model without registration; z in m and rad."""
    wide, first = replace(model, registration=True), model.load_size + model.tension_size
    at_z = torch.arange(first, first + 6)
    at_x = torch.cat([torch.arange(first), torch.arange(first + 6, model.size + 6)])
    full = x.new_zeros(len(x), wide.size).index_copy(1, at_x, x)
    at = linearize(wide, full, markers, wide.exact_weights(wide.weights(markers, noise)))
    _, held = wide.prior()
    unit = wide.zeta_scale(x).reciprocal()
    A_xz = at.A[:, at_x][:, :, at_z] * unit
    both = ekf.solve_spd(at.A[:, at_x][:, :, at_x], torch.cat([A_xz, at.g[:, at_x].unsqueeze(-1)], -1))
    A_zz = (at.A[:, at_z][:, :, at_z] - torch.diag(held[at_z])) * unit * unit.unsqueeze(-1)
    q = at.g[:, at_z] * unit - (A_xz.mT @ both[..., -1:]).squeeze(-1)
    return both[..., :-1], A_zz - A_xz.mT @ both[..., :-1], q


def _prior(model: Model) -> Float[Tensor, "6 6"]:
    """P of (2), in m and rad: the prior that a registration of one sample has."""
    _, precision = replace(model, registration=True).prior()
    first = model.load_size + model.tension_size
    return torch.diag(precision[first : first + 6] / model.zeta_scale(precision) ** 2)


def _first(parts: Parts, fit: Estimate, used: Bool[Tensor, " B"]) -> BaseFrame:
    """The registrations of every sample by itself, each with the weight of its information beyond the prior."""
    P = _prior(replace(parts[0][0], registration=False))
    total, weighted = P.clone(), torch.zeros(6, dtype=DTYPE)
    assert fit.registration is not None
    for model, index in parts:
        some, first = index[used[index]], model.load_size + model.tension_size
        if not len(some):  # of a model that no sample chose the kept fits may hold fewer entries than it has
            continue
        scale = model.zeta_scale(fit.x)
        C = fit.covariance[some, first : first + 6, first : first + 6] * scale * scale.unsqueeze(-1)
        known = torch.linalg.inv(C) - P
        total, weighted = total + known.sum(0), weighted + (known @ fit.registration[some].unsqueeze(-1)).sum((0, 2))
    return BaseFrame(torch.linalg.solve(total, weighted), torch.linalg.inv(total))


def common_frame(
    parts: Parts,
    markers: Markers,
    noise: float,
    fit: Estimate,
    settings: Settings | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> BaseFrame:
    """The error of the base frame from all samples together, by (1)-(2), from a fit that gave each its own registration.

    parts: of the batch, each with the model (with registration) it was fitted by. Samples that the fit does not explain have no
    say, unless that is so of all. Errors: ValueError where no sample has converged.
    """
    used = fit.accepted if bool(fit.accepted.any()) else fit.status == int(Status.CONVERGED)
    if not bool(used.any()):
        raise ValueError("no sample has converged, so none tells where the base frame is; check units, marker order and frame")
    frame, P = _first(parts, fit, used), _prior(replace(parts[0][0], registration=False))
    for _ in range(STEPS):
        here = frame.corrected(markers)
        total, pull = P.clone(), -P @ frame.zeta
        for model, index in parts:
            plain = replace(model, registration=False)
            for some in _chunks(index[used[index]]):
                part = here.take(some)
                again = estimate(plain, part, noise, settings, progress=progress)
                good = (again.status == int(Status.CONVERGED)).nonzero().squeeze(-1)
                _, S, q = _eliminated(plain, again.x[good], part.take(good), noise)
                total, pull = total + S.sum(0), pull + q.sum(0)
        step = torch.linalg.solve(total, pull)
        step = step * min(1.0, math.radians(10) / max(float(step[3:].norm()), 1e-12))
        frame = BaseFrame(frame.moved_by(step), torch.linalg.inv(total))
    return frame
