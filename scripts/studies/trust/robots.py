"""What intervals are worth on robots that are not quite as their file says.

Every sample is the shape of a robot of its own, whose parameter is off by a draw of the stated standard deviation, under one push
of 0.5 to 1 force scale; its load is estimated once with the robot taken as exact and once with the deviation stated.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchrod import (
    Estimate,
    GaussianCoordinates,
    Markers,
    PointForces,
    Problem,
    Registration,
    Robot,
    Rod,
    Tendon,
    Tendons,
    Uncertainty,
    Unknowns,
    analyze,
    contact_hypotheses,
    estimate,
    solve_shape,
)
from torchrod.mechanics.lie import move

from .cases import generator, in_parallel

LENGTH, MARKERS = 0.4, 20
NOISES = 0.001, 0.0025  # of the length
Reading = Tensor | None
Change = Callable[[Robot, Reading, torch.Generator], tuple[Robot, Reading]]
ABOUT = """\
One push of 0.5 to 1 force scale between 30 and 95 % of the length, 20 markers. Every sample is the shape of a robot of its own, off
by a draw of the deviation in the first column; the forward solve is the library's. Shares of the 95 % intervals of force / place
that hold the truth, of converged samples, first with the robot taken as exact, then with the deviation stated under
`[uncertainty]`. With {cases} cases a share of 95 % is known to about {error:.1f} %.

| what is off | noise (% of L) | exact: accepted | force / place (%) | stated: accepted | force / place (%) | error of place (mm) |
|---|---|---|---|---|---|---|"""
SOUND = 93, 97  # %: rows with a share outside are repeated
MORE = 2  # times as many cases
AGAIN = """
Rows with a share below {least} or above {most} %, repeated with {cases} other cases:

| what is off | noise (% of L) | exact: accepted | force / place (%) | stated: accepted | force / place (%) | error of place (mm) |
|---|---|---|---|---|---|---|"""
CONTACTS = """
### Whether anything pushes

The same with `--contacts auto` and intervals of draws, as by default, {cases} cases a row, first without a push, then with one of
0.5 to 1 force scale. Found: shapes with an accepted contact whose 95 % interval of the force excludes zero. Of pushed shapes: found
/ counted as one / of those, the intervals of force / place hold (%). The last row is of all cases.

| what is off | noise (% of L) | no push, exact: found (%) | stated: found (%) | push, exact | stated |
|---|---|---|---|---|---|"""


@dataclass(frozen=True)
class Row:
    """What is off, how one robot of it is drawn, and what is stated of it."""

    name: str
    robot: Robot
    change: Change
    stated: Uncertainty | None = None
    frame: Registration | None = None


def _normal(g: torch.Generator, std: float, *shape: int) -> Tensor:
    return std * torch.randn(shape, generator=g, dtype=torch.float64)


def _stiffness(std: float) -> Change:
    def change(robot: Robot, tension: Reading, g: torch.Generator) -> tuple[Robot, Reading]:
        k = 1 + float(_normal(g, std))
        return replace(robot, rod=replace(robot.rod, K_se=k * robot.rod.K_se, K_bt=k * robot.rod.K_bt)), tension

    return change


def _oval(std: float) -> Change:
    def change(robot: Robot, tension: Reading, g: torch.Generator) -> tuple[Robot, Reading]:
        a, b = _normal(g, std, 2).tolist()
        shape = torch.tensor([[a, b, 0.0], [b, -a, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
        return replace(robot, rod=replace(robot.rod, K_bt=robot.rod.K_bt + robot.rod.bending_stiffness * shape)), tension

    return change


def _mass(std: float) -> Change:
    return lambda robot, tension, g: (replace(robot, gravity=(1 + float(_normal(g, std))) * robot.gravity), tension)


def _set(std: float) -> Change:
    def change(robot: Robot, tension: Reading, g: torch.Generator) -> tuple[Robot, Reading]:
        rows = robot.rod.reference_curvature.clone()
        rows[:, 1:3] += _normal(g, std, 1, 2)
        return replace(robot, rod=replace(robot.rod, reference_curvature=rows)), tension

    return change


def _gain(std: float) -> Change:
    return lambda robot, tension, g: (robot, None if tension is None else tension * (1 + _normal(g, std, 1, tension.shape[-1])))


def _friction(std: float) -> Change:
    def change(robot: Robot, tension: Reading, g: torch.Generator) -> tuple[Robot, Reading]:
        mu = _normal(g, std, len(robot.tendons)).tolist()
        own = tuple(replace(t, friction=m) for t, m in zip(robot.tendons.tendons, mu, strict=True))
        return replace(robot, tendons=Tendons(own)), tension

    return change


def _all_of(*changes: Change) -> Change:
    def change(robot: Robot, tension: Reading, g: torch.Generator) -> tuple[Robot, Reading]:
        for one in changes:
            robot, tension = one(robot, tension, g)
        return robot, tension

    return change


def _gravity(std: float) -> Change:
    def change(robot: Robot, tension: Reading, g: torch.Generator) -> tuple[Robot, Reading]:
        turn = torch.cat([torch.zeros(3, dtype=torch.float64), _normal(g, std, 3)])
        return replace(robot, gravity=move(turn, robot.gravity.unsqueeze(0))[0]), tension

    return change


def _nothing(robot: Robot, tension: Reading, g: torch.Generator) -> tuple[Robot, Reading]:
    return robot, tension


def rows() -> list[Row]:
    """All of them."""
    rod = Rod.circular(LENGTH, 0.0014, 207e9, 79e9, 0.0122)
    passive = Robot(rod, gravity=torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64))
    around = [(0.006 * math.cos(a), 0.006 * math.sin(a)) for a in (0.0, 2 * math.pi / 3, 4 * math.pi / 3)]
    tendons = Tendons(tuple(Tendon.straight(x, y, LENGTH) for x, y in around))
    pulled = Robot(rod, tendons, torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64))
    found = []
    for name, robot in (("passive", passive), ("three tendons", pulled)):
        found += [
            Row(f"{name}: stiffness 3 %", robot, _stiffness(0.03), Uncertainty(stiffness=0.03)),
            Row(f"{name}: stiffness 10 %", robot, _stiffness(0.1), Uncertainty(stiffness=0.1)),
            Row(f"{name}: mass 20 %", robot, _mass(0.2), Uncertainty(mass=0.2)),
            Row(f"{name}: set 0.2/m", robot, _set(0.2), Uncertainty(set=0.2)),
            Row(f"{name}: oval 10 %", robot, _oval(0.1), Uncertainty(oval=0.1)),
            Row(f"{name}: gravity 5 degrees", robot, _gravity(math.radians(5)), Uncertainty(gravity=math.radians(5))),
            Row(f"{name}: frame 1 mm, 0.5 degrees", robot, _nothing, None, Registration(1e-3, math.radians(0.5))),
        ]
    found += [
        Row("three tendons: tension 5 %", pulled, _gain(0.05), Uncertainty(tension=0.05)),
        Row("three tendons: friction 0.05", pulled, _friction(0.05), Uncertainty(friction=0.05)),
        Row("three tendons: friction 0.2", pulled, _friction(0.2), Uncertainty(friction=0.2)),
    ]
    return found


def shapes_of(row: Row, noise: float, cases: int, pushed: bool, seed: int) -> tuple[Markers, Reading, Tensor, Tensor]:
    """Markers and tensions of as many shapes, each of a robot of its own, and the size (N) and place (m) of its push."""
    g, robot = generator(seed), row.robot
    size = robot.rod.force_scale * (0.5 + 0.5 * torch.rand(cases, 1, generator=g, dtype=torch.float64))
    turn = 2 * math.pi * torch.rand(cases, 1, generator=g, dtype=torch.float64)
    place = LENGTH * (0.3 + 0.65 * torch.rand(cases, 1, generator=g, dtype=torch.float64))
    load = PointForces(torch.stack([size * turn.cos(), size * turn.sin(), 0 * size], -1), place)
    count = len(robot.tendons)
    tension = 4 * torch.rand(cases, count, generator=g, dtype=torch.float64) if count else None
    s = torch.linspace(LENGTH / MARKERS, LENGTH, MARKERS, dtype=torch.float64)
    shapes = []
    for b in range(cases):
        own, readings = row.change(robot, None if tension is None else tension[b : b + 1], g)
        shapes.append(solve_shape(own, (load.take(torch.tensor([b])),) if pushed else (), readings, s, 1).p)
    p = torch.cat(shapes)
    if row.frame is not None and row.frame.shift_std is not None and row.frame.turn_std is not None:
        zeta = torch.cat([_normal(g, row.frame.shift_std, cases, 3), _normal(g, row.frame.turn_std, cases, 3)], -1)
        p = move(zeta, p)
    p = p + _normal(g, noise * LENGTH, *p.shape)
    return Markers(s, p, noise * LENGTH), tension, size, place


def _problem(row: Row, markers: Markers, tension: Reading, stated: bool) -> Problem:
    loads = GaussianCoordinates(1, LENGTH, row.robot.rod.force_scale)
    own = (row.frame, row.stated) if stated else (None, None)
    return Problem(row.robot, Unknowns(loads, registration=own[0], uncertainty=own[1]), [markers], tension)


def counted(which: tuple[str, float], cases: int, seed: int) -> tuple[str, Tensor]:
    """The row of the second table, by its name and noise: is there a contact, where nothing pushes and where something does?

    With what it is made of, (2, 5, 2): exact and stated; found without a push, found with one, one, force held and place held; how
    often, and of how many.
    """
    (name, noise), counts = which, torch.zeros(2, 5, 2, dtype=torch.int64)
    row = next(row for row in contact_rows() if row.name == name)
    for pushed in (False, True):
        markers, tension, size, place = shapes_of(row, noise, cases, pushed, seed)
        for stated in (0, 1):
            problem = _problem(row, markers, tension, bool(stated))
            result = analyze(problem, contact_hypotheses(problem), sampled=True)
            assert result.intervals is not None
            fit, found = result.estimate, result.intervals
            there = torch.isfinite(fit.location)
            sure = (there & (found.magnitude[..., 0] > 0)).any(-1) & fit.accepted
            counts[stated, int(pushed)] = torch.tensor([int(sure.sum()), cases])
            if pushed:
                one = there.sum(-1) == 1
                counts[stated, 2] = torch.tensor([int(one.sum()), cases])
                for i, (interval, truth) in enumerate(((found.magnitude, size), (found.location, place))):
                    held = (interval[:, 0, 0] <= truth[:, 0]) & (truth[:, 0] <= interval[:, 0, 1])
                    counts[stated, 3 + i] = torch.tensor([int(held[one].sum()), int(one.sum())])
    return counted_line(row.name, f"{100 * noise:g}", counts, 0), counts


def counted_line(name: str, noise: str, counts: Tensor, digits: int) -> str:
    """A row of the second table, of what `counted` counts."""
    cells = [[f"{100 * int(k) / int(n):.{digits}f}" if n else "-" for k, n in part] for part in counts]
    pushed = [" / ".join(part[1:]) for part in cells]
    return f"| {name} | {noise} | {cells[0][0]} | {cells[1][0]} | {pushed[0]} | {pushed[1]} |"


def measured(which: tuple[str, float], cases: int, seed: int) -> tuple[str, bool]:
    """The row of the first table, by its name and noise, and whether both shares are within SOUND where the deviation is stated."""
    name, noise = which
    row = next(row for row in rows() if row.name == name)
    markers, tension, size, place = shapes_of(row, noise, cases, True, seed)

    cells, errors, shares = [], [], [0.0]
    for stated in (False, True):
        fit = estimate(_problem(row, markers, tension, stated))
        shares = _held(fit, size, place)
        cells += [f"{100 * float(fit.accepted.double().mean()):.0f} %", " / ".join(f"{share:.0f}" for share in shares)]
        errors.append(f"{1e3 * float((fit.location - place)[fit.status == 0].abs().mean()):.1f}")
    sound = all(SOUND[0] <= round(share) <= SOUND[1] for share in shares)
    return f"| {row.name} | {100 * noise:g} | {' | '.join(cells)} | {' / '.join(errors)} |", sound


def _held(fit: Estimate, size: Tensor, place: Tensor) -> list[float]:
    """How often the intervals of force and place hold the truth (%)."""
    done, shares = fit.status == 0, []
    for interval, truth in ((fit.magnitude_interval, size), (fit.location_interval, place)):
        inside = (interval[..., 0] <= truth) & (truth <= interval[..., 1])
        shares.append(100 * float(inside[done].double().mean()))
    return shares


def contact_rows() -> list[Row]:
    """What each is off by where it is asked whether anything pushes."""
    every = {row.name: row.robot for row in rows()}
    passive, three = every["passive: mass 20 %"], every["three tendons: tension 5 %"]
    one = replace(three, tendons=Tendons(three.tendons.tendons[:1]))
    found = []
    frame = Registration(5e-4, math.radians(0.3))
    for name, robot in (("passive", passive), ("one tendon", one), ("three tendons", three)):
        off = {"stiffness 3 %": _stiffness(0.03), "mass 5 %": _mass(0.05), "set 0.1/m": _set(0.1)}
        stated: dict[str, Any] = {"stiffness": 0.03, "mass": 0.05, "set": 0.1}
        if len(robot.tendons):
            off |= {"tension 3 %": _gain(0.03), "friction 0.1": _friction(0.1)}
            stated |= {"tension": 0.03, "friction": 0.1}
        for (what, change), (key, std) in zip(off.items(), stated.items(), strict=True):
            found.append(Row(f"{name}: {what}", robot, change, Uncertainty(**{key: std})))
        found.append(Row(f"{name}: frame 0.5 mm, 0.3 degrees", robot, _nothing, None, frame))
        found.append(Row(f"{name}: all of these", robot, _all_of(*off.values()), Uncertainty(**stated), frame))
    return found


def run(cases: int) -> list[str]:
    """Both tables; whether anything pushes by a tenth of the samples."""
    few = max(1, cases // 10)
    lines = ["## Robots that are not quite as their file says", ""]
    lines.append(ABOUT.format(cases=cases, error=100 * math.sqrt(0.95 * 0.05 / cases)))
    every = [(row.name, noise) for row in rows() for noise in NOISES]
    found = in_parallel(measured, every, cases, 1000, "robots")
    lines += [line for line, _ in found]
    if again := [which for which, (_, sound) in zip(every, found, strict=True) if not sound]:
        lines.append(AGAIN.format(least=SOUND[0], most=SOUND[1], cases=MORE * cases))
        lines += [line for line, _ in in_parallel(measured, again, MORE * cases, 1200, "robots, again")]
    lines.append(CONTACTS.format(cases=few))
    every = [(row.name, noise) for row in contact_rows() for noise in NOISES]
    of_pushes = in_parallel(counted, every, few, 1100, "pushes")
    total = torch.stack([counts for _, counts in of_pushes]).sum(0)
    return [*lines, *(line for line, _ in of_pushes), counted_line("all", "", total, 1)]
