"""The arc-length grid: where the steps of the integration begin and end."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

DEFAULT_STEPS = 40  # RK4 is then within 1e-7 m of the exact shape for ordinary loads (docs/model.md)
TURN_OF_ALL = 10.0  # rad: the turn of the unloaded rod that is shared out among the steps; one that turns further gets more of them
SAME_POINT = 1e-9  # m: marker and tendon end closer than this share a node
TIP = 1e-6  # of the length: so far beyond it, a place is at the tip, in single precision


def on_rod(s: Float[Tensor, "*K"], length: float) -> Bool[Tensor, "*K"]:
    """Whether arc lengths (m) lie on the rod; NaN does not."""
    return (s >= -SAME_POINT) & (s <= length * (1 + TIP))


@dataclass(frozen=True)
class Grid:
    """Nodes (..., S + 1) in m, from the first to the last of them, and the node of each output, (..., P).

    Outputs, tendon ends and jumps of the load are nodes, so no step straddles a discontinuity and no output is interpolated.
    Nodes may differ from sample to sample (a point load's location is part of the state) and carry derivatives.
    """

    nodes: Float[Tensor, "... S1"]
    outputs: Int[Tensor, "... P"]

    @property
    def outputs_and_tip(self) -> Int[Tensor, "... P1"]:
        """The outputs' nodes, and the last node."""
        return torch.cat([self.outputs, self.outputs.new_full((*self.outputs.shape[:-1], 1), self.nodes.shape[-1] - 1)], -1)

    @property
    def outputs_and_base(self) -> Int[Tensor, "... P1"]:
        """The outputs' nodes, and the first node."""
        return torch.cat([self.outputs, self.outputs.new_zeros(*self.outputs.shape[:-1], 1)], -1)

    def cut(self, pieces: int) -> Int[Tensor, "... n"]:
        """The nodes at or just beyond the ends of so many equal pieces."""
        places = self.nodes[..., -1:] * torch.linspace(0, 1, pieces + 1, dtype=self.nodes.dtype)
        return torch.searchsorted(self.nodes.detach().contiguous(), (places - SAME_POINT).contiguous())

    def take(self, index: Int[Tensor, " b"]) -> "Grid":
        """The samples of an index."""
        return self if self.nodes.ndim == 1 or len(self.nodes) == 1 else Grid(self.nodes[index], self.outputs[index])

    @property
    def h(self) -> Float[Tensor, "... S"]:
        """Step lengths (m)."""
        return self.nodes.diff(dim=-1)

    @property
    def stages(self) -> Float[Tensor, "... S 3"]:
        """Arc lengths of the start, middle and end of every step (m)."""
        a, b = self.nodes[..., :-1], self.nodes[..., 1:]
        return torch.stack([a, 0.5 * (a + b), b], -1)

    @property
    def inside(self) -> Float[Tensor, "... S 3"]:
        """The middle of each step, once for each of its three stages: decides on which side of a jump a stage lies."""
        return self.stages[..., 1:2].expand_as(self.stages)


@dataclass(frozen=True)
class Places:
    """Single places s (P,) m along the rod, each on the base's side of what jumps there: what a table has of one stage each."""

    s: Float[Tensor, " P"]

    @property
    def stages(self) -> Float[Tensor, "P 1"]:
        """The places themselves."""
        return self.s.unsqueeze(-1)

    @property
    def inside(self) -> Float[Tensor, "P 1"]:
        """Just below each; just above at the base."""
        return (self.s - 2 * SAME_POINT).clamp(min=SAME_POINT).unsqueeze(-1)


def make_grid(
    length: float,
    outputs: Float[Tensor, " P"],
    ends: tuple[float, ...] = (),
    breakpoints: Float[Tensor, "... K"] | None = None,
    steps: int = DEFAULT_STEPS,
    curvature: Callable[[Float[Tensor, " K"], Float[Tensor, " K"]], Float[Tensor, "K 3"]] | None = None,
) -> Grid:
    """Nodes at 0, L, the outputs, the ends (of tendons, of pieces of the reference curvature) and the breakpoints.

    Filled up so that no step is longer than L / steps (m), nor turns the unloaded rod by more than TURN_OF_ALL / steps (rad).
    curvature: u* (1/m) at s on the side of `inside`, linear between the ends. Errors: ValueError for outputs that do not lie on the
    rod.
    """
    if not bool(on_rod(outputs, length).all()):
        raise ValueError(f"outputs run from {float(outputs.min())} to {float(outputs.max())} m, outside the rod of 0 to {length} m")
    outputs = outputs.clamp(0.0, length)  # the tip in single precision lies beyond it
    fixed = torch.cat([outputs.new_tensor([0.0, length, *ends]), outputs]).sort().values
    fixed = fixed[torch.cat([torch.tensor([True]), fixed.diff() > SAME_POINT])]
    pieces = (fixed.diff() / (length / steps) - 1e-9).ceil().clamp(min=1).to(torch.int64)
    if curvature is not None:
        a, b, inside = fixed[:-1], fixed[1:], 0.5 * (fixed[:-1] + fixed[1:])
        bend = torch.maximum(curvature(a, inside).norm(dim=-1), curvature(b, inside).norm(dim=-1)).detach().nan_to_num(0.0)
        pieces = torch.maximum(pieces, (bend * fixed.diff() * steps / TURN_OF_ALL - 1e-9).ceil().to(torch.int64))
    fill = [
        a + (b - a) * torch.arange(n, dtype=fixed.dtype) / n for a, b, n in zip(fixed[:-1], fixed[1:], pieces.tolist(), strict=True)
    ]
    nodes = torch.cat([*fill, fixed[-1:]])
    at = (nodes.unsqueeze(0) - outputs.unsqueeze(-1)).abs().argmin(-1)
    if breakpoints is None:
        return Grid(nodes, at)
    moving = breakpoints.clamp(0.0, length)
    together = torch.cat([nodes.expand(*moving.shape[:-1], -1), moving], -1)
    order = together.detach().argsort(dim=-1, stable=True)
    return Grid(together.gather(-1, order), at + (moving.detach().unsqueeze(-2) < outputs.unsqueeze(-1)).sum(-1))
