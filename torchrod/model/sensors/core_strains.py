"""Core strains: the strain of each core of a multicore fibre at its gratings, what an interrogator reads before any curvature."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...mechanics.lie import Matrix, Vector
from ...util.precision import Float64
from .sensor import RodState, as_numbers, check_noise, rows_of, shape_error, variance


@dataclass(frozen=True)
class CoreStrains(Float64):
    """Measured strains of C cores at P gratings on B samples, of a core at r = radius [cos(angle), sin(angle)] in the section:

        e = v_z - 1 + u_x r_y - u_y r_x + e_0

    with p' = R v, R' = R hat(u). s: (P,) m. readings: (B, P, C), strains (-, not microstrain), NaN where missing. angles: (C,) or
    (P, C) rad, from the section's x axis to y; (P, C) for a fibre that is twisted as it lies in the rod. radius: m, of all cores or
    (C,), 0 for a core in the middle. noise: standard deviation of a strain, one number or one for each sample (B,). common: whether
    e_0, a strain that all cores of a grating share, such as that of temperature, is unknown at every grating; it is then projected
    out, v_z with it, and a grating of C cores has C - 1 rows. Only differences of orientation show, so it tells nothing of the base
    frame. Errors: ValueError of `check`. Source: J. P. Moore and M. D. Rogge, Shape sensing using multi-core fiber optic cable and
    parametric curve solutions, Optics Express 2012, (2).
    """

    s: Float[Tensor, " P"]
    readings: Float[Tensor, "B P C"]
    angles: Float[Tensor, "*P C"]
    radius: float | Float[Tensor, " C"]
    noise: float | Float[Tensor, " B"]
    common: bool = True

    def __post_init__(self):
        super().__post_init__()
        as_numbers(self, "radius", "noise")

    @property
    def _each(self) -> int:
        """Rows for each grating."""
        return self.readings.shape[-1] - self.common

    @property
    def rows(self) -> int:
        """One for each core, less one for each grating where the common strain is unknown."""
        return self._each * len(self.s)

    @property
    def groups(self) -> Int[Tensor, " rows"]:
        """A grating's rows."""
        return torch.arange(len(self.s)).repeat_interleave(self._each)

    def _contrasts(self, e: Float[Tensor, "... P C"]) -> Float[Tensor, "... P c"]:
        """Each core but the first against the mean of the read ones before it: orthonormal, blind to what all cores share.

        NaN for a core that was not read, or that has none before it.
        """
        if not self.common:
            return e
        read = torch.isfinite(self.readings)
        count = read[..., :-1].to(e.dtype).cumsum(-1)
        before = torch.where(read, e, 0.0)[..., :-1].cumsum(-1) / count.clamp(min=1)
        size = (count / (count + 1)).sqrt()
        return torch.where(read[..., 1:] & (count > 0), size * (e[..., 1:] - before), torch.nan)

    def predict(self, rod: RodState) -> Float[Tensor, "... rows"]:
        """The strains, or their contrasts."""
        v, u = rod.strains()
        x, y = self.radius * self.angles.cos(), self.radius * self.angles.sin()
        e = v[..., 2:] - 1 + u[..., :1] * y - u[..., 1:2] * x
        return self._contrasts(e).nan_to_num(0.0).flatten(-2)

    @property
    def reading(self) -> Float[Tensor, "B rows"]:
        """The strains as read, or their contrasts."""
        return self._contrasts(self.readings).flatten(1)

    @property
    def weights(self) -> Float[Tensor, "B rows"]:
        """1 / noise^2: the contrasts of independent strains are independent, and of the same noise."""
        return torch.isfinite(self.reading).to(self.readings.dtype) / variance(self.noise)

    def distances(self, rows: Float[Tensor, "B rows"]) -> Float[Tensor, "B K 3"]:
        """None."""
        return rows.new_empty(len(rows), 0, 3)

    def take(self, index: Int[Tensor, " b"]) -> "CoreStrains":
        """The samples of an index."""
        return replace(self, **rows_of(self, index, "readings", "noise"))

    def without(self, groups: Bool[Tensor, "B G"]) -> "CoreStrains":
        """The gratings of these groups not read."""
        return replace(self, readings=self.readings.masked_fill(groups.unsqueeze(-1), torch.nan))

    def moved(self, R: Matrix, t: Vector) -> "CoreStrains":
        """Itself: it sits in the rod, whatever frame others measure in."""
        return self

    def check(self) -> None:
        """Shapes that belong together, as many cores as leave rows, finite angles, a noise."""
        P, B, C = self.s.numel(), len(self.readings), self.readings.shape[-1]
        angles = {"angles": (P, C) if self.angles.ndim == 2 else (C,)}
        if said := shape_error(self, {"s": (P,), "readings": (B, P, None), "radius": (C,), "noise": (B,)} | angles):
            raise ValueError(f"{said} with {P} gratings of {C} cores and {B} samples")
        if not P or not B or not self._each:
            raise ValueError("there are no core strains; give at least one sample with one grating of two cores, or common=False")
        if not bool(torch.isfinite(self.angles).all()):
            raise ValueError("CoreStrains.angles must be finite (rad)")
        if not bool((torch.as_tensor(self.radius) >= 0).all()):
            raise ValueError("CoreStrains.radius must not be negative (m)")
        check_noise("CoreStrains.noise", self.noise, "")
