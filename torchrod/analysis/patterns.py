"""Samples with arc lengths of their own: fitted pattern by pattern, because a batch of all their markers grows with their square.

400 samples of 20 markers at places of their own are 8,000 markers, of which each sample has seen 20.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Int
from torch import Tensor

from ..estimation.intervals import Intervals
from ..estimation.result import Estimate
from ..model.problem import Problem
from ..model.sensors import Markers
from .alternatives import Solution
from .count import Evidence
from .diagnosis import Diagnosis
from .noise import Noise

WASTE, FEW = 2.0, 64  # markers of the batch for one of a sample, and in all, up to which it is fitted as it is
OF_PLACES: tuple[str, ...] = ("centre_line", "residual", "outlier")  # fields of Estimate with an entry for each marker,
OF_ROWS: tuple[str, ...] = ("row_residual",)  # and with three


@dataclass(frozen=True)
class Pattern:
    """Samples (b,) of a batch that have seen markers at the same places (p,), both as indices."""

    samples: Int[Tensor, " b"]
    places: Int[Tensor, " p"]


def patterns(problem: Problem) -> list[Pattern]:
    """How a batch is to be split; not at all where its samples share most of their places, or markers are not all that was read."""
    markers = problem.markers
    if markers is None or len(markers.s) <= FEW:
        return []
    seen = markers.present
    if len(markers.s) <= WASTE * int(seen.sum(-1).max()):
        return []
    kinds, which = torch.unique(seen, dim=0, return_inverse=True)
    order = which.argsort(stable=True).split(torch.bincount(which, minlength=len(kinds)).tolist())
    return [Pattern(index, kind.nonzero().squeeze(-1)) for index, kind in zip(order, kinds, strict=True)]


def part_of(problem: Problem, pattern: Pattern) -> Problem:
    """The samples of a pattern with their own places; of samples that have seen nothing with the first."""
    places = pattern.places if len(pattern.places) else torch.arange(1)
    part = problem.take(pattern.samples)
    own = part.markers
    assert own is not None
    noise = own.noise[:, places] if isinstance(own.noise, Tensor) and own.noise.ndim > 1 else own.noise
    offsets = None if own.offsets is None else own.offsets[places]
    s_std = None if own.s_std is None else own.s_std[places]
    return replace(part, sensors=[Markers(own.s[places], own.positions[:, places], noise, offsets, s_std)])


def _whole(
    values: Sequence[Tensor | None], found: Sequence[Pattern], count: int, columns: Sequence[Tensor] | None = None
) -> Tensor | None:
    """(count, ..) of the parts' (b, ..), each at its samples; columns: where its second dimension goes. NaN, or 0, elsewhere."""
    there = [v for v in values if v is not None]
    if not there:
        return None
    trailing = [max(sizes) for sizes in zip(*(v.shape[1:] for v in there), strict=True)]
    if columns is not None:
        trailing[0] = 1 + max(int(c.max()) for c in columns)
    like = there[0]
    whole = like.new_full((count, *trailing), torch.nan if like.is_floating_point() else 0)
    for value, pattern, i in zip(values, found, range(len(found)), strict=True):
        if value is None:
            continue
        if columns is not None:
            whole[pattern.samples.unsqueeze(-1), columns[i][: value.shape[1]]] = value
        else:
            whole[(pattern.samples, *(slice(0, n) for n in value.shape[1:]))] = value
    return whole


def joined_estimate(parts: Sequence[Estimate], found: Sequence[Pattern], problem: Problem) -> Estimate:
    """The estimate of the whole batch; markers that a sample has not are NaN in it."""
    B, P = problem.batch, len(problem.s)
    places = [p.places if len(p.places) else torch.arange(1) for p in found]
    ends = [torch.cat([p, torch.tensor([P - 1])]) for p in places]  # so that every part reaches to the last marker
    rows = [(3 * p.unsqueeze(-1) + torch.arange(3)).flatten() for p in ends]
    columns: dict[str, list[Tensor]] = dict.fromkeys(OF_PLACES, ends) | dict.fromkeys(OF_ROWS, rows)
    whole = {f.name: _whole([getattr(p, f.name) for p in parts], found, B, columns.get(f.name)) for f in fields(Estimate)}
    residual = whole["row_residual"]
    assert residual is not None
    return Estimate(**whole | {"row_residual": residual.nan_to_num(0.0)})  # pyright: ignore[reportArgumentType]


def joined_evidence(parts: Sequence[Evidence | None], found: Sequence[Pattern], count: int) -> Evidence | None:
    """The evidence of the whole batch."""
    known = [p for p in parts if p is not None]
    if len(known) < len(parts):
        return None
    of_samples = ("choice", "bic", "foreseen", "probability")
    choice, bic, foreseen, probability = (_whole([getattr(p, f) for p in known], found, count) for f in of_samples)
    assert choice is not None and bic is not None and foreseen is not None
    return Evidence(known[0].names, choice, bic, foreseen, known[0].spare, probability, known[0].loaded)


def joined_noise(parts: Sequence[Noise | None], found: Sequence[Pattern], count: int) -> Noise | None:
    """The noise of every sample."""
    known = [p for p in parts if p is not None]
    if len(known) < len(parts):
        return None
    sigma, std, freedom = (_whole([getattr(p, f) for p in known], found, count) for f in ("sigma", "std", "freedom"))
    assert sigma is not None and std is not None and freedom is not None
    return Noise(sigma, std, freedom)


def joined_intervals(parts: Sequence[Intervals | None], found: Sequence[Pattern], count: int) -> Intervals | None:
    """The intervals of every sample."""
    known = [p for p in parts if p is not None]
    if len(known) < len(parts):
        return None
    return Intervals(**{f.name: _whole([getattr(p, f.name) for p in known], found, count) for f in fields(Intervals)})  # pyright: ignore[reportArgumentType]


def joined_diagnosis(parts: Sequence[Diagnosis], found: Sequence[Pattern], problem: Problem) -> Diagnosis:
    """What is said of every sample, its markers counted among all of the batch."""
    B = problem.batch
    registration = _whole([p.registration for p in parts], found, B)
    more, couple, instead = (_whole([getattr(p, f) for p in parts], found, B) for f in ("one_more", "couple", "tip_instead"))
    assert registration is not None and more is not None and couple is not None and instead is not None
    exchanged: list[tuple[tuple[int, ...], ...]] = [()] * B
    geometry, outliers = [""] * B, [()] * B
    others: list[tuple[Solution, ...]] = [()] * B
    rivals, slip = [""] * B, [math.nan] * B
    for part, pattern in zip(parts, found, strict=True):
        at = pattern.places.tolist()
        for k, b in enumerate(pattern.samples.tolist()):
            exchanged[b] = tuple(tuple(at[i] for i in cycle) for cycle in part.exchanged[k])
            outliers[b] = tuple(at[i] for i in part.outliers[k])
            geometry[b] = part.geometry[k]
            others[b] = part.others[k] if part.others else ()
            rivals[b] = part.rivals[k] if part.rivals else ""
            slip[b] = part.slip[k] if part.slip else math.nan
    return Diagnosis(
        problem.s,
        tuple(exchanged),
        registration,
        more,
        tuple(geometry),
        tuple(outliers),
        couple,
        instead,
        tuple(others),
        tuple(rivals),
        tuple(slip),
    )
