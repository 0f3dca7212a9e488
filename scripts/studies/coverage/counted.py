"""Intervals where the number of loads is found (--contacts auto), and of what was merged where fewer are told."""

import time

import torch
from torch import Tensor

import torchrod as tr

from .cases import COUNTED, posed
from .told import share

HEAD = [
    "## The number of loads found",
    "",
    "With `--contacts auto`. Right: that number, and a force at the tip where there is one. Of these, the shares (%) of",
    "truths inside sampled intervals of force (of the tip's where nothing pushes) and place. Resultant: where what",
    "there is is told, and where other loads are. Silent: accepted with other loads, a resultant outside of its",
    "interval, no sentence about it. Doubted: the message names another number or kind of loads. CPU in seconds a shape.",
    "",
    "| kind | cases | right (%) | told 0 / 1 / 2 / 3 / 4 / tip | force | place | resultant, right | other | silent "
    "| doubted | CPU (s) |",
    "|" + "---|" * 11,
]


def line(name: str, cases: int) -> str:
    """One line of the table."""
    kind = COUNTED[name]
    problem, truth = posed(kind, cases, seed=1)
    begun = time.process_time()
    result = tr.analyze(problem, tr.contact_hypotheses(problem, "auto"), sampled=True)
    spent = (time.process_time() - begun) / cases
    fit, found = result.estimate, result.intervals
    assert found is not None
    number, tip = torch.zeros(cases, dtype=torch.int64), torch.zeros(cases, dtype=torch.bool)
    for unknowns, rows in result.parts:
        number[rows], tip[rows] = getattr(unknowns.loads, "count", 1), unknowns.tip != "none"
    right = fit.accepted & (number == kind.contacts) & (tip == (kind.tip != "none"))
    K, cells = kind.contacts, ["-", "-"]
    if K and right.any():
        order = fit.location[:, :K].argsort(-1)

        def along(interval: Tensor) -> Tensor:
            return interval[:, :K].gather(1, order.unsqueeze(-1).expand(-1, -1, 2))

        cells = [share(truth.size, along(found.magnitude), right), share(truth.at, along(found.location), right)]
    elif right.any() and kind.tip != "none":
        assert found.tip is not None
        cells = [share(truth.tip[:, :3], found.tip[:, :3], right), "-"]
    whole, pushed = found.resultant[:, 3], K or kind.tip != "none"
    inside = (truth.whole >= whole[:, 0]) & (truth.whole <= whole[:, 1])
    said = torch.tensor([bool(result.diagnosis.message(b)) for b in range(cases)])
    silent = fit.accepted & ~right & ~inside & ~said
    cells += [share(truth.whole, whole, rows) if pushed and rows.any() else "-" for rows in (right, fit.accepted & ~right)]
    told = " / ".join(str(int(((number == k) & ~tip).sum())) for k in range(5)) + f" / {int(tip.sum())}"
    doubted = sum("remain possible" in result.diagnosis.message(b) for b in range(cases)) / cases
    numbers = f"{100 * float(silent.double().mean()):.1f} | {100 * doubted:.1f} | {spent:.2f}"
    return f"| {kind.name} | {cases} | {100 * float(right.double().mean()):.1f} | {told} | {' | '.join(cells)} | {numbers} |"
