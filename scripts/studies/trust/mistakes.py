"""Exchanged labels, outliers, base frames that are off: how often they are told, and how often of shapes without them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from torchrod import Hypothesis, diagnose, estimate, select
from torchrod.analysis.count import parts_of

from .cases import NOISE, exchanged, generator, in_parallel, moved, noisy, posed, pushed, touched
from .markers import Row as Spoiled
from .markers import chosen, spoiled


@dataclass(frozen=True)
class Row:
    """Shapes with `contacts` pushes fitted with `fitted` ones (0: auto), and what is wrong with them."""

    name: str
    contacts: int = 1
    fitted: int = 1
    markers: int = 20
    pairs: int = 0
    off: bool = False
    stated: float = NOISE
    astray: int = 0


ROWS = (
    Row("nothing wrong"),
    Row("nothing wrong, two contacts", 2, 2),
    Row("nothing wrong, two contacts, auto", 2, 0),
    Row("noise understated, 0.5 mm", stated=NOISE / 2),
    Row("a contact too few", 2, 1),
    Row("one pair exchanged", pairs=1),
    Row("two pairs exchanged", pairs=2),
    Row("one pair exchanged, two contacts", 2, 2, pairs=1),
    Row("one pair exchanged, a contact too few", 2, 1, pairs=1),
    Row("one pair exchanged, 8 markers", markers=8, pairs=1),
    Row("2 markers 50 mm off", astray=2),
    Row("2 markers 50 mm off, two contacts", 2, 2, astray=2),
    Row("2 markers 50 mm off, auto", 1, 0, astray=2),
    Row("base frame off", off=True),
    Row("base frame off, two contacts", 2, 2, off=True),
    Row("base frame off, auto", 1, 0, off=True),
    Row("base frame off, 8 markers", markers=8, off=True),
)


def measured(row: Row, samples: int, seed: int) -> Sequence[object]:
    """accepted; right and wrong exchanges; exactly the outliers told, others told; base frame; one more contact; unit or frame."""
    g = generator(seed)
    true = touched(row.contacts, samples, g, row.markers)
    p = moved(true.positions, g) if row.off else true.positions
    markers, pairs = noisy(true.s, p, g), [()] * samples
    if row.pairs:
        p, pairs = exchanged(markers.positions, row.pairs, g)
        markers = replace(markers, positions=p)
    kind = Spoiled("", row.astray, row.markers, off=True)
    bad = chosen(kind, samples, g)
    markers = replace(spoiled(kind, markers, bad, g) if row.astray else markers, noise=row.stated)
    problem, parts = posed(markers, pushed(row.fitted or 1)), None
    if row.fitted:
        fit = estimate(problem)
    else:
        counts = [Hypothesis(str(k), k, pushed(k)) for k in range(4)]
        fit, evidence = select(problem, counts)
        parts = parts_of(counts, evidence)
    told = diagnose(problem, fit, parts=parts)
    right = sum(bool(b) and a == b for a, b in zip(told.exchanged, pairs, strict=True))
    wrong = sum(bool(a) and a != b for a, b in zip(told.exchanged, pairs, strict=True))
    astray = [tuple(row.nonzero().flatten().tolist()) for row in bad]
    named = sum(bool(a) and a == b for a, b in zip(told.outliers, astray, strict=True))
    others = sum(bool(a) and a != b for a, b in zip(told.outliers, astray, strict=True))
    frame = int(torch.isfinite(told.registration).all(-1).sum())
    return int(fit.accepted.sum()), right, wrong, named, others, frame, int(told.one_more.sum()), sum(map(bool, told.geometry))


def run(samples: int) -> list[str]:
    """The table."""
    lines = ["## Exchanged labels, outliers, and a base frame that is off", ""]
    lines += [
        f"{samples} shapes a row, pushes of 0.5 to 1 N. In every other shape the (first) pair are neighbours, 20 mm apart with 20"
    ]
    lines += ["markers, else any two. A base frame that is off is so by 5 mm and 3 degrees, in a new direction in every shape."]
    lines += ["What the message says, by number of shapes:", ""]
    lines += ["| | accepted | exchanged: the right ones | others | outliers: the right ones | others | registration error "]
    lines[-1] += "| one more contact | unit or frame |"
    lines += ["|" + "---|" * 9]
    for row, cells in zip(ROWS, in_parallel(measured, ROWS, samples, 200, "mistakes"), strict=True):
        lines.append(f"| {row.name} | " + " | ".join(map(str, cells)) + " |")
    return [*lines, "", *WHAT]


WHAT = """\
An exchange is told where fitting the exchanged labels more than halves chi^2; the reported fit is always that of the labels as
they are. A registration error is told where estimating one explains the markers (accepted) and has a lower BIC than one more
contact; with `auto` also where it explains them with fewer contacts than were chosen and a BIC lower by 10, because a base frame
that is off passes for contacts near the base. Outliers are told where none of this explains the markers and a robust fit does,
without a fifth of them at most. Where one parameter of the robot, or the arc lengths, would explain a shape better than all of
this, the message names it (torchrod/analysis/suspects.py; of 16 shapes of a batch at most). With `auto` 16 accepted shapes are
asked as well: what is off of a robot passes for contacts, and is named where it explains the readings with fewer of them, or with
as many and a BIC lower by 10. Of rods bent by 0.3/m under one push, that is said of 14 of 16 at 0.1 % noise and of 8 of 16 at
0.25 %; of 96 shapes of the robot as its file says, under one push or two, of none (tests/test_diagnosis.py).""".splitlines()
