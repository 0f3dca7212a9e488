"""What `torchrod observability` does, once its arguments are known."""

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise

import torch
from jsonargparse import Namespace
from torch import Tensor

from ..analysis.marker_placement import Placement, even_layout, place
from ..analysis.observability import BENDS, LOCALIZED, Observability, bounds
from ..io import check_parameters, read_robot, read_uncertainty, write_observability, write_observability_table
from ..mechanics.robot import Robot
from ..model.uncertainty import KINDS, Uncertainty
from ..model.unknowns import Registration
from ..util.errors import InputError
from ..util.precision import DTYPE
from .arguments import FIGURE_SUFFIXES, noise_std, positive, writable

DEFAULT_MARKERS = 20
MOST_MARKERS = 200
ROWS = 10  # of the table on the screen


def observability(options: Namespace) -> None:
    """torchrod observability."""
    robot = read_robot(options.robot)
    noise_std(options.noise)
    force = robot.rod.force_scale if options.force is None else options.force
    positive("--force", force)
    tension = _tension(options, robot)
    s = _layout(options, robot)
    _check_place(options, robot)
    writable(options.out, FIGURE_SUFFIXES)
    writable(options.csv, (".csv",))
    writable(options.json, (".json",))
    nearly = read_uncertainty(options.robot)
    registration, uncertainty = _registration(options) or nearly.frame_of_a_sample, nearly.of_a_sample
    check_parameters(uncertainty, robot, options.robot)
    placed = None
    if options.place is not None:
        try:
            placed = place(
                robot,
                options.place,
                options.noise,
                force,
                tension,
                registration,
                options["from"],
                options.gap,
                uncertainty=uncertainty,
            )
        except ValueError as error:
            raise InputError(f"{options.robot}: {error}") from None
        s = placed.s
    asked = partial(bounds, robot, noise=options.noise, force=force, tension=tension, registration=registration)
    seen = asked(s, uncertainty=uncertainty)
    if bool(torch.isnan(seen.location_std).all()):
        raise InputError(f"--force {force:g}: no equilibrium was found under it anywhere along the rod; check its size and units")
    print(_report(robot, seen, s, options, placed))  # noqa: T201
    if uncertainty is not None:
        print(_worth(seen, uncertainty, lambda left: asked(s, uncertainty=left)))  # noqa: T201
    _warn(seen)
    if options.csv:
        write_observability_table(options.csv, seen)
    if options.json:
        pulled = [] if tension is None else tension.tolist()
        write_observability(options.json, seen, s.tolist(), robot.name, options.noise, pulled, registration is not None, placed)
    if options.out:
        _draw(options, robot, seen, s, placed, lambda layout: asked(layout, uncertainty=uncertainty))


def _registration(options: Namespace) -> Registration | None:
    return Registration() if options.registration else None


def _tension(options: Namespace, robot: Robot) -> Tensor | None:
    given, tendons = options.tension or [], len(robot.tendons)
    if len(given) != tendons:
        raise InputError(f"--tension has {len(given)} values but the robot has {tendons} tendons; give one per tendon, in newtons")
    if not all(math.isfinite(t) and t >= 0 for t in given):
        raise InputError(f"--tension {given}: must be finite and at least 0 N")
    return torch.tensor(given, dtype=DTYPE) if tendons else None


def _layout(options: Namespace, robot: Robot) -> Tensor:
    """The markers (m) of --at or --markers."""
    L, least = robot.rod.length, 3 if options.registration else 2
    if sum(option is not None for option in (options.at, options.markers, options.place)) > 1:
        raise InputError("--markers, --at and --place each say where the markers are; give one of them")
    if options.at is not None:
        if any(not 0 < s <= L for s in options.at) or any(b <= a for a, b in pairwise(options.at)):
            raise InputError(f"--at {options.at}: must increase and lie on the rod, above 0 and up to {L} m")
        if len(options.at) < least:
            raise InputError(f"--at has {len(options.at)} places; give at least {least}, or the push cannot be told from its place")
        return torch.tensor(options.at, dtype=DTYPE)
    name, count = ("--markers", options.markers) if options.place is None else ("--place", options.place)
    count = DEFAULT_MARKERS if count is None else count
    if not least <= count <= MOST_MARKERS:
        why = " with --registration" if options.registration else ""
        raise InputError(f"{name} is {count}; it must be from {least} to {MOST_MARKERS}{why}")
    return even_layout(robot, count)


def _check_place(options: Namespace, robot: Robot) -> None:
    """Refuse --from and --gap that --place cannot use."""
    L = robot.rod.length
    if options.place is None:
        for name in ("from", "gap"):
            if options[name] is not None:
                raise InputError(f"--{name} is for --place, which proposes markers; add --place N or leave it out")
        return
    if options["from"] is not None and not 0 < options["from"] < L:
        raise InputError(f"--from is {options['from']}; it must lie on the rod, above 0 and below {L} m")
    if options.gap is not None and not 0 <= options.gap <= L / options.place * (1 + 1e-9):
        raise InputError(
            f"--gap is {options.gap}; for {options.place} markers on {L} m it must be from 0 to {L / options.place:.6g} m"
        )


def _short(value: float, most: float = math.inf) -> str:
    """A number of the table; what is beyond `most` says no more than that."""
    if math.isnan(value):
        return "no equilibrium"
    if value > most:
        return f"> {most:.4g}"
    return f"{value:.4g}" if math.isfinite(value) else "none"


def _report(robot: Robot, seen: Observability, s: Tensor, options: Namespace, placed: Placement | None) -> str:
    """The table on the screen: the worst direction at about ten places."""
    L, force = robot.rod.length, seen.force
    lines = []
    if placed is not None:
        at = " ".join(f"{v:.6g}" for v in placed.s.tolist())
        lines += [f"proposed markers (m): {at}"]
        worst = [f"{_short(1e3 * v, 1e3 * L)} mm" for v in (placed.worst_even, placed.worst)]
        asked = f"location of {force:.4g} N from {1e3 * placed.nearest:.4g} mm on, worst case"
        lines += [f"{asked}: {worst[0]} evenly spaced, {worst[1]} proposed"]
    lines += [f"{len(s)} markers, noise {options.noise:g} m, worst direction; +- is one standard deviation for {force:.4g} N"]
    heads = ("s (mm)", "detected (N)", "located (N)", "force +- (N)", "location +- (mm)")
    lines.append("".join(f"{head:>{18 if i else 8}}" for i, head in enumerate(heads)))
    worst = [x.amax(-1) for x in (seen.detectable, seen.localizable, seen.magnitude_std, 1e3 * seen.location_std)]
    for k in torch.linspace(0, len(seen.location) - 1, min(ROWS, len(seen.location))).round().int().tolist():
        cells = [_short(float(x[k]), most) for x, most in zip(worst, (math.inf, math.inf, math.inf, 1e3 * L), strict=True)]
        lines.append(f"{1e3 * float(seen.location[k]):>8.1f}" + "".join(f"{cell:>18}" for cell in cells))
    lines.append(f"detected: found 95 % of the time, 5 % false alarms; located: standard deviation {LOCALIZED:.0%} of the length")
    if bool(torch.isinf(seen.localizable).any()):
        lines.append(f"none: not even where the push turns the rod by {BENDS[-1]:g} rad")
    return "\n".join(lines)


def _worth(seen: Observability, uncertainty: Uncertainty, of: Callable[[Uncertainty], Observability]) -> str:
    """What knowing one kind of parameter exactly would do to the spread of a push's place."""
    kinds = [kind for kind in KINDS if kind != "curvature_length" and getattr(uncertainty, kind)]
    kinds += ["found"] if uncertainty.found is not None else []
    now, lines = seen.location_std.nanmedian(), []
    for kind in kinds:
        left = of(replace(uncertainty, **{kind: None if kind == "found" else 0.0})).location_std.nanmedian()
        name = "what was calibrated" if kind == "found" else kind.replace("_", " ")
        lines.append((float(1 - left / now), name))
    if not lines:
        return "[uncertainty] states nothing but zeros: this is of the robot as its file has it"
    said = ", ".join(f"{name} {100 * share:.0f} %" for share, name in sorted(lines, reverse=True))
    return f"spread of the location that would go if this were known exactly (median over places and directions): {said}"


def _warn(seen: Observability) -> None:
    """Say where there is nothing to say."""
    lost = int(torch.isnan(seen.location_std).any(-1).sum())
    if lost:
        warnings.warn(f"no equilibrium was found under {seen.force:.4g} N at {lost} of {len(seen.location)} places", stacklevel=2)


def _draw(
    options: Namespace,
    robot: Robot,
    seen: Observability,
    s: Tensor,
    placed: Placement | None,
    of: Callable[[Tensor], Observability],
) -> None:
    from ..plotting.observability import Layout, draw_observability

    layouts = [Layout("proposed" if placed else "markers", s, seen)]
    if placed is not None:
        layouts.append(Layout("evenly spaced", placed.even, of(placed.even)))
    title = f"{robot.name}: {len(s)} markers, {1e3 * options.noise:g} mm noise"
    title += f", tendons at {', '.join(f'{t:g}' for t in options.tension)} N" if options.tension else ""
    title += ", base frame unknown" if options.registration else ""
    draw_observability(options.out, layouts, robot.rod.length, title, None if placed is None else placed.nearest)
