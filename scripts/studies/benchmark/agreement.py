"""Whether every path and peer gives torchrod's answers: nothing is compared in speed that is not the same."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .cases import ITERATION, STUDY, Case, write
from .processes import Process


@dataclass(frozen=True)
class Tolerance:
    """Largest relative error of h and of each column of H; of the filter's next x (its own units) and Sigma (relative).

    And of a finished fit: force (N), location (m), cost (chi^2). elsewhere: the share of fits that may end at another, dearer
    minimum; they are counted and not compared.
    """

    h: float = 1e-8
    H: float = 1e-8
    x: float = 1e-6
    Sigma: float = 1e-6
    force: float = 1e-4
    location: float = 1e-5
    cost: float = 1e-4
    elsewhere: float = 0.0
    samples: int = 64


OTHER = Case(loads=3, markers=10, steps=80)  # what grows is right, too
DEARER = 1.0  # of chi^2: another minimum
# scipy takes differences, has its own test of convergence, which leaves it elsewhere in the flat valley of the width, and nothing
# that keeps it from another minimum.
TOLERANCES = {
    "scipy": Tolerance(H=3e-5, force=5e-3, location=2e-4, cost=5e-3, elsewhere=0.25, samples=4),
    "torchrod, eager": Tolerance(samples=16),
}
CHECKED = ("h", "H", "x", "Sigma", "force", "location", "cost", "elsewhere")


class Disagreement(Exception):
    """A peer does not compute what torchrod computes; says what and by how much."""


def linear_differences(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> dict[str, float]:
    """Largest differences of h, H and, where there is a filter, of one pass of it; infinite where one is not finite."""
    size = {name: np.abs(ours[name]) for name in ("h", "H", "x", "Sigma") if name in ours and name in theirs}
    off = {name: np.abs(theirs[name] - ours[name][: len(theirs[name])]) for name in size}
    values = {"h": off["h"].max() / size["h"].max(), "H": (off["H"].max((0, 1)) / size["H"].max((0, 1))).max()}
    if "x" in off:
        values |= {"x": off["x"].max(), "Sigma": off["Sigma"].max() / size["Sigma"].max()}
    return {name: float(np.nan_to_num(value, nan=np.inf)) for name, value in values.items()}


def fit_differences(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> dict[str, float]:
    """Largest differences of finished fits; the shares that ended elsewhere, and that both call converged or not."""
    ours = {name: value[: len(theirs["x"])] for name, value in ours.items()}
    elsewhere = theirs["cost"] > ours["cost"] + DEARER
    both = ours["converged"] & theirs["converged"] & ~elsewhere
    found = {name: np.abs(theirs[name] - ours[name])[both].max(initial=0.0) for name in ("force", "location", "cost")}
    found |= {"elsewhere": elsewhere.mean(), "converged": np.mean(ours["converged"] == theirs["converged"])}
    return {name: float(np.nan_to_num(value, nan=np.inf)) for name, value in found.items()}


def verify(name: str, found: dict[str, float], tolerance: Tolerance) -> None:
    """Raise Disagreement where a difference is larger than allowed."""
    for what in (what for what in CHECKED if what in found):
        most = getattr(tolerance, what)
        if not found[what] <= most:
            raise Disagreement(f"{name} differs from torchrod in {what} by {found[what]:.2g}, more than {most:g}")
    if found["converged"] < 1.0:
        raise Disagreement(f"{name} and torchrod converge on different samples: they agree on {100 * found['converged']:.0f} %")


def answers(process: Process, folder: Path, samples: int) -> list[dict[str, np.ndarray]]:
    """What a worker finds: h, H and a pass of the filter of two cases, and fits of Study 1."""
    found = []
    for case, fits in ((ITERATION, False), (OTHER, False), (STUDY, True)):
        out = folder / f"{process.name.replace(', ', '-')}-{case.name}-answers.npz"
        process.ask("answers", data=str(write(case, folder)), out=str(out), samples=samples, fits=fits)
        with np.load(out) as file:
            found.append(dict(file))
    return found


def checked(processes: dict[str, Process], folder: Path) -> dict[str, dict[str, Any]]:
    """Differences of every worker from torchrod's compiled path; all work at once, for here no time is taken.

    Errors: Disagreement.
    """
    limits = {name: TOLERANCES.get(name, Tolerance()) for name in processes}
    for case in (ITERATION, OTHER, STUDY):
        write(case, folder)
    with ThreadPoolExecutor() as pool:
        asked = {name: pool.submit(answers, process, folder, limits[name].samples) for name, process in processes.items()}
        said = {name: future.result() for name, future in asked.items()}
    found: dict[str, dict[str, Any]] = {}
    reference = said.pop("torchrod")
    for name, theirs in said.items():
        one, two = (linear_differences(a, b) for a, b in zip(reference[:2], theirs[:2], strict=True))
        found[name] = {what: max(one[what], two[what]) for what in one} | fit_differences(reference[2], theirs[2])
        verify(name, found[name], limits[name])
        found[name]["samples"] = limits[name].samples
    return found
