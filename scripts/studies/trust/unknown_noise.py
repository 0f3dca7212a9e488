"""--noise auto with --contacts auto: is the noise found, and the number of contacts still right?"""

from dataclasses import dataclass

import torch

from torchrod import Hypothesis, estimate_noise_among, select
from torchrod.analysis.noise import with_noise

from .cases import generator, in_parallel, posed, pushed, touched

SIZE = 0.5, 2.0  # N
FAR = 1.5  # times too large or too small


@dataclass(frozen=True)
class Row:
    """So many pushes, markers and metres of noise."""

    contacts: int
    markers: int
    noise: float


ROWS = tuple(Row(k, markers, noise) for markers in (20, 8) for noise in (1e-3, 2e-4) for k in range(3))


def measured(row: Row, samples: int, seed: int) -> list[float]:
    """Share of right counts with the noise known and unknown; accepted; mean of found / true noise, its ends, share FAR off."""
    g = generator(seed)
    true = touched(row.contacts, samples, g, row.markers, SIZE)
    draw = torch.randn(true.positions.shape, generator=g, dtype=torch.float64)
    counts = [Hypothesis(str(k), k, pushed(k)) for k in range(4)]
    problem = posed(true.markers(row.noise * draw, row.noise), pushed(1))
    found, sigma = estimate_noise_among(problem, [h.unknowns for h in counts])
    right = []
    for told in (problem, with_noise(problem, sigma)):
        fit, evidence = select(told, counts)
        right.append(float((evidence.choice == row.contacts).double().mean()))
    off = found.sigma / row.noise
    far = ((off > FAR) | (off < 1 / FAR)).double().mean()
    accepted = found.judged(fit).accepted.double().mean()
    return [*right, *(float(v) for v in (accepted, off.mean(), off.min(), off.max(), far))]


def run(samples: int) -> list[str]:
    """The table."""
    lines = [
        "## Noise and number of contacts both unknown",
        "",
        f"`--noise auto --contacts auto`, {samples} shapes a row, pushes of",
    ]
    lines += ["0.5 to 2 N, two at least 80 mm apart.", ""]
    heads = ["markers", "noise", "contacts", "count right, noise known", "count right, noise unknown", "accepted"]
    heads += ["found / true noise, mean", "least", "most", "more than 1.5 off"]
    lines += ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for row, v in zip(ROWS, in_parallel(measured, ROWS, samples, 600, "noise"), strict=True):
        shares = [f"{100 * x:.1f} %" for x in v[:3]] + [f"{x:.2f}" for x in v[3:6]] + [f"{100 * v[6]:.1f} %"]
        lines.append("| " + " | ".join([str(row.markers), f"{1e3 * row.noise:g} mm", str(row.contacts), *shares]) + " |")
    return [*lines, "", *ABOUT]


ABOUT = """\
The noise is told by the fit of three contacts or, where that has not settled and leaves more than a fit of fewer, by that one.
With 8 markers 24 coordinates less 9 unknowns are left to tell it by: its own standard deviation is 18 %, and some are far off by
chance alone.""".splitlines()
