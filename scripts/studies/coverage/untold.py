"""What is said where other loads act than those that were told of."""

import time
from dataclasses import replace

import torch

import torchrod as tr

from . import bands
from .cases import COUNTED, TOLD, Kind, posed
from .told import share

HEAD = [
    "## Loads that nobody told of",
    "",
    "With a number of contacts told, as by default, and nothing at the tip. Accepted: share (%) of fits. Of these: held, of",
    "resultants inside their interval, and named, of samples with a sentence on a load more or another one. Silent: share of",
    "all that are accepted, have a resultant outside of its interval, and no sentence. CPU in ms a shape, draws included. In the",
    "first four rows the truth is told: there a sentence is a false alarm, or says that the readings leave two explanations.",
    "",
    "| what there is | contacts told | cases | accepted | held | named | silent | CPU |",
    "|" + "---|" * 8,
]
SPREAD = "uniform over 30 % of the rod", "uniform over 60 %", "ramp", "half sine"


def _beside(force: tuple[float, float], noise: float) -> Kind:
    name = f"push beside a force of {force[0]:g} to {force[1]:g} scales at the tip, {100 * noise:g} % noise"
    return Kind(name, 1, noise, (0.3, 1.0), tip="force", size=force)


ROWS: dict[str, tuple[Kind | str, int]] = {
    "one": (TOLD["one"], 1),
    "one-exact": (TOLD["one-exact"], 1),
    "two": (TOLD["two"], 2),
    "three": (TOLD["three"], 3),
    "tip": (COUNTED["tip"], 1),
    "tip-noisy": (Kind("nothing but a force at the tip, 0.25 % noise", 0, 2.5e-3, tip="force", size=(0.3, 1.0)), 1),
    "moment": (Kind("nothing but a moment at the tip", 0, 1e-3, tip="moment", size=(0.1, 0.5)), 1),
    "weak": (_beside((0.1, 0.5), 1e-3), 1),
    "weak-noisy": (_beside((0.1, 0.5), 2.5e-3), 1),
    "strong": (_beside((0.3, 1.0), 1e-3), 1),
    "strong-noisy": (_beside((0.3, 1.0), 2.5e-3), 1),
    **{row: (row, 1) for row in bands.ROWS if bands.form_of(row)[0] in SPREAD},
    "two-as-one": (TOLD["two"], 1),
    "close-as-one": (TOLD["close"], 1),
    "opposed-as-one": (TOLD["opposed"], 1),
    "three-as-two": (TOLD["three"], 2),
}


def line(name: str, cases: int) -> str:
    """One line of the table."""
    kind, contacts = ROWS[name]
    if isinstance(kind, str):
        form, noise = bands.form_of(kind)
        problem, truth = bands.posed(bands.FORMS[form], noise, cases, seed=2)
        what, couple = f"one load, {kind} noise", False
    else:
        problem, truth = posed(kind, cases, seed=2)
        what, couple = kind.name, kind.tip == "moment"
    rod = problem.robot.rod
    loads = tr.GaussianCoordinates(contacts, rod.length, rod.force_scale)
    problem = problem.of(replace(problem.unknowns, loads=loads))
    begun = time.process_time()
    result = tr.analyze(problem, sampled=True, named=True)
    spent = 1e3 * (time.process_time() - begun) / cases
    accepted, found = result.estimate.accepted, result.intervals
    assert found is not None
    whole = found.resultant[:, 3]
    inside = (truth.whole >= whole[:, 0]) & (truth.whole <= whole[:, 1])
    named = torch.tensor([bool(words) for words in result.diagnosis.rivals])
    said = torch.tensor([bool(result.diagnosis.message(b)) for b in range(cases)])
    held = share(truth.whole, whole, accepted) if accepted.any() and not couple else "-"
    alarms = f"{100 * float(named[accepted].double().mean()):.1f}" if accepted.any() else "-"
    silent = 100 * float((accepted & ~inside & ~said).double().mean())
    return (
        f"| {what} | {contacts} | {cases} | {100 * float(accepted.double().mean()):.1f} | {held} | {alarms} | {silent:.1f} "
        f"| {spent:.1f} |"
    )
