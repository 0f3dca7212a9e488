"""What `torchrod calibrate` does, once its arguments are known."""

import tomllib
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jsonargparse import Namespace
from torch import Tensor

from ..analysis.calibration import OFFSET, SOUGHT, STIFFNESS, Calibration
from ..analysis.calibration import calibrate as run_calibration
from ..estimation.solve import Settings
from ..io import (
    CALIBRATION_SUFFIXES,
    NearlyKnown,
    Shapes,
    calibrated_by,
    read_robot,
    read_shapes,
    read_uncertainty,
    write_calibrated,
    write_calibration,
)
from ..mechanics.robot import Robot
from ..model.load_families import GaussianCoordinates
from ..model.unknowns import Registration
from ..util.errors import InputError
from ..util.status import Status
from .arguments import noise_std, positive, writable

FAR_OFF = 0.05  # of the length: no noise, and no robot like that of the file
USED = {"position_std", "hung", "hung_at"}


def calibrate(options: Namespace) -> None:
    """torchrod calibrate."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*nothing hangs")  # the mass is what is sought
        robot = read_robot(options.robot)
    nearly = read_uncertainty(options.robot)
    if nearly.calibrated is not None:
        raise InputError(
            f"{options.robot}: has been calibrated; give calibrate the file it was made from, or take out [calibration]"
        )
    shapes = read_shapes(options.shapes, robot, options.units, options.tensions)
    if options.marker_offsets and len(shapes.s.unique()) < len(shapes.s):
        raise InputError(f"{options.shapes}: several markers have one s, so --marker-offsets cannot be written; leave it out")
    if "centre_line" in shapes.readings:
        raise InputError(f"{options.shapes}: calibrate reads markers, at known s; a centre line alone does not serve")
    if unused := sorted(set(shapes.readings) - USED):
        warnings.warn(f"{options.shapes}: {', '.join(unused)} play no part: calibrate reads positions", stacklevel=2)
    noise_std(options.noise)
    positive("--max-iterations", options.max_iterations)
    writable(options.out, (".toml",))
    writable(options.json, CALIBRATION_SUFFIXES)
    settings = Settings(max_iterations=options.max_iterations)
    try:
        found = run_calibration(
            robot, shapes.markers(options.noise), shapes.tension, settings=settings, **_sought(options, robot, shapes, nearly)
        )
    except ValueError as error:
        raise InputError(f"{options.shapes}: {error}") from None
    out = [name for name, used in zip(shapes.samples, found.used.tolist(), strict=True) if not used]
    if out:
        who = (
            f"sample {out[0]} is left out: it has" if len(out) == 1 else f"{len(out)} samples are left out ({_few(out)}): they have"
        )
        warnings.warn(f"{options.shapes}: {who} no markers, no finite tensions or no equilibrium", stacklevel=2)
    print(_report(found, shapes, options))  # noqa: T201
    if options.json:
        write_calibration(options.json, found, shapes.samples, robot.name, options.noise)
    if options.out:
        _write_robot(options, robot, found, shapes)


def _sought(options: Namespace, robot: Robot, shapes: Shapes, nearly: NearlyKnown) -> dict[str, Any]:
    """What is to be found, and what is known."""
    if options.contacts < 0:
        raise InputError(f"--contacts is {options.contacts}; it must be at least 0")
    free = list(options.free or [])
    plain = {"mass": options.hold_mass, "stiffness": options.youngs_modulus, "tension_offset": options.tension_offset}
    without = {*free} & {*SOUGHT} | {kind for kind, asked in plain.items() if asked}  # free, or held: no prior
    shared = None if nearly.shared is None else replace(nearly.shared, **dict.fromkeys(without, 0.0))
    frame = Registration() if "frame" in free else nearly.shared_frame
    weight, place = shapes.readings.get("hung"), shapes.readings.get("hung_at")
    if (weight is None) != (place is None):
        missing = "hung_kg" if weight is None else "hung_s"
        raise InputError(f"{options.shapes}: {missing} is missing; a known weight needs hung_s (m) and hung_kg (kg)")
    if weight is not None and place is not None:
        _check_weights(options, shapes, weight[:, 0], place[:, 0], robot.rod.length)
    stated = shared is not None and (shared.mass > 0 or not bool(robot.gravity.any()))
    return {
        "youngs_modulus": options.youngs_modulus,
        "tension_offset": options.tension_offset,
        "mass": not options.hold_mass and not stated,
        "free": [kind for kind in free if kind != "frame"],
        "shared": shared,
        "frame": frame,
        "own": nearly.own,
        "hung": None if weight is None or place is None else torch.cat([place, weight], -1).nan_to_num(0.0),
        "loads": GaussianCoordinates(options.contacts, robot.rod.length, robot.rod.force_scale) if options.contacts else None,
    }


def _check_weights(options: Namespace, shapes: Shapes, kg: Tensor, s: Tensor, L: float) -> None:
    """Refuse a known weight that hangs nowhere, or is none."""
    heavy = torch.nan_to_num(kg, 0.0) != 0
    for bad, what in (
        (heavy & ~(kg > 0), "hung_kg must be at least 0"),
        (heavy & ~((s >= 0) & (s <= L * (1 + 1e-9))), f"hung_s must say where on the rod of 0 to {L:g} m the weight hangs"),
    ):
        if bool(bad.any()):
            raise InputError(f"{options.shapes}: sample {shapes.samples[int(bad.nonzero()[0])]}: {what}")


def _few(names: list[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")


def _write_robot(options: Namespace, robot: Robot, found: Calibration, shapes: Shapes) -> None:
    """The calibrated robot file; none where the calibration has nothing to say."""
    if found.status is not Status.CONVERGED or found.undetermined:
        warnings.warn(f"{options.out}: not written, because the values are not known; see the message", stacklevel=2)
        return
    off = found.rms_residual / robot.rod.length
    if not found.accepted and off > FAR_OFF:
        far = f"the calibrated robot is still {1e3 * found.rms_residual:.3g} mm off, {100 * off:.0f} % of its length"
        warnings.warn(f"{options.out}: not written, because {far}; see the message", stacklevel=2)
        return
    factor, offsets = found.value(STIFFNESS, 1.0), any(name.startswith(OFFSET) for name in found.names)
    calibrated = calibrated_by(found, options.noise, shapes.s if options.marker_offsets else None)
    write_calibrated(options.out, options.robot, found.applied(robot), factor, offsets, calibrated)


def _rows(found: Calibration, path: str) -> list[tuple[str, float, float, float]]:
    """Name with unit, before, after and standard deviation; a circular section's stiffness is shown as Young's modulus."""
    modulus = tomllib.loads(Path(path).read_text(encoding="utf-8"))["rod"].get("youngs_modulus")
    rows = []
    for i, name in enumerate(found.names):
        label, size = f"{name} ({found.units[i]})", 1.0
        if name == STIFFNESS and modulus is not None:
            label, size = "youngs_modulus (Pa)", float(modulus)
        rows.append((label, *(size * float(x[i]) for x in (found.before, found.values, found.std))))
    return rows


def _report(found: Calibration, shapes: Shapes, options: Namespace) -> str:
    """The table on the screen, and how good the fit is."""
    lines = [f"{'parameter':<24}{'before':>14}{'after':>14}{'+-':>12}"]
    lines += [f"{label:<24}{before:>14.6g}{after:>14.6g}{std:>12.3g}" for label, before, after, std in _rows(found, options.robot)]
    lines.append(
        f"{int(found.used.sum())} of {len(shapes.samples)} samples, {found.iterations} iterations, rms residual "
        f"{found.rms_residual * 1e3:.3f} mm, chi2/dof {found.chi2 / max(found.dof, 1):.3g}"
    )
    source = "the residuals, which are larger than --noise" if found.rescaled else f"--noise {options.noise:g} m"
    lines.append(f"+- is one standard deviation, from {source}")
    return "\n".join([*lines, found.message])
