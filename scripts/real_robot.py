"""A real tendon robot, by the shipped commands: python scripts/real_robot.py DATA.json [--out docs].

DATA.json: unloaded shapes, singles and doubles of a public tendon robot (docs/real_robot.md says which, and its conventions). Writes
ROBOT.toml, unloaded.csv and loaded.csv, calibrates the robot from its unloaded shapes alone by `torchrod calibrate`, and estimates
the loads of all others by `torchrod estimate`, once for each line of the table. Writes real_robot.md and real_robot.png.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrod.cli import main as torchrod

NOISE = 0.8e-3  # m, of a coordinate that was clicked by hand in two images (the data's own notes)
PULLEY = 0.74  # the peer's factor of the hung weight; what is lost at the pulley is not known
PEER = "6.3 / 3.8"
DENSITY = 7850.0
OWN = "[uncertainty]\n"
SHARED = "\n[uncertainty.shared]\nstiffness = 0.3\nfriction = 0.2\ntendon_place_mm = 1.0\nframe = [3e-3, 0.035]\n"


@dataclass(frozen=True)
class Row:
    """A line of the table: its name, what ROBOT.toml says is not known, and options of the two commands."""

    name: str
    stated: str = ""
    calibrate: tuple[str, ...] = ("--hold-mass",)
    estimate: tuple[str, ...] = ()


ROWS = (
    Row("E and mass calibrated, the rest as built", "", ("--youngs-modulus",), ("--noise", str(NOISE))),
    Row("weighed mass; E, friction, tendon's place, base frame", SHARED),
    Row("+ tension of every trial to 10 %", OWN + "tension = 0.1\n" + SHARED),
    Row("+ markers' offsets", OWN + "tension = 0.1\n" + SHARED, ("--hold-mass", "--marker-offsets")),
    Row("+ metric of the cameras to 2 %", OWN + "tension = 0.1\nmetric = 0.02\n" + SHARED, ("--hold-mass", "--marker-offsets")),
)


def robot_file(data: dict[str, Any], stated: str) -> str:
    """ROBOT.toml of the robot as it was built."""
    built = data["robot"]
    E, r = built["youngs_modulus_nominal_Pa"], built["rod_diameter_m"] / 2
    x, y = built["tendons"][0]["offset_m"]
    discs = "".join(f"\n[[rod.masses]]\ns = {s}\nmass = {built['disc_mass_kg']}\n" for s in built["s_m"] if s > 0)
    return (
        f'name = "tendon robot"\n[rod]\nlength = {built["length_m"]}\ndiameter = {2 * r}\nyoungs_modulus = {E}\n'
        f"shear_modulus = {E / (2 * (1 + built['poisson']))}\nmass_per_length = {DENSITY * math.pi * r**2}\n"
        f"gravity = {built['gravity']}\n{discs}\n[[tendons]]\noffset = [{x}, {y}]\n\n{stated}"
    )


def shapes_file(data: dict[str, Any], trials: list[dict[str, Any]]) -> str:
    """SHAPES.csv of the markers beyond the base, with the load cell's reading; a slack one reads less than nothing."""
    lines = ["sample,s,x,y,z,tension_1"]
    for i, trial in enumerate(trials):
        for s, p in zip(data["robot"]["s_m"], trial["positions_m"], strict=True):
            if s > 0:
                cells = ",".join("" if v is None else repr(v) for v in p)
                lines.append(f"{i},{s},{cells},{max(trial['tension_N'], 0.0)}")
    return "\n".join(lines) + "\n"


def run(*command: str) -> None:
    """A command of torchrod. Errors: SystemExit where it fails."""
    if torchrod(list(command)):
        raise SystemExit(f"torchrod {' '.join(command)} failed")


@dataclass(frozen=True)
class Outcome:
    """What came of a line: errors of place (m) and whether intervals hold, of the singles; numbers of loads found."""

    error: list[float]
    held: list[bool]
    force: list[float]
    force_held: list[bool]
    accepted: int
    counts: list[int]
    doubles: list[int]
    found: list[dict[str, Any]]
    calibration: dict[str, Any]


def _inside(value: float, interval: list[float]) -> bool:
    return interval[0] <= value <= interval[1]


def outcome(data: dict[str, Any], row: Row, folder: Path, counts: bool) -> Outcome:
    """One line, from the raw data to errors."""
    robot, calibrated = folder / "robot.toml", folder / "calibrated.toml"
    robot.write_text(robot_file(data, row.stated))
    singles, doubles = data["single"], data["double"]
    unloaded, loaded = folder / "unloaded.csv", folder / "loaded.csv"
    unloaded.write_text(shapes_file(data, data["unloaded"]))
    loaded.write_text(shapes_file(data, singles + doubles))
    record, result, auto = folder / "calibration.json", folder / "result.json", folder / "auto.json"
    run(
        "calibrate",
        str(robot),
        str(unloaded),
        "--noise",
        str(NOISE),
        *row.calibrate,
        "--out",
        str(calibrated),
        "--json",
        str(record),
    )
    common = (str(calibrated), str(loaded), "--load-prior", "point", "--profile", "off", *row.estimate)
    run("estimate", *common, "--out", str(result))
    samples = json.loads(result.read_text())["results"][: len(singles)]
    numbers = [1] * (len(singles) + len(doubles))
    if counts:
        run("estimate", *common, "--contacts", "auto", "--out", str(auto))
        numbers = [len(sample["loads"]) for sample in json.loads(auto.read_text())["results"]]
    error, held, force, force_held = [], [], [], []
    for sample, trial in zip(samples, singles, strict=True):
        load = sample["loads"][0]
        if load["location_m"] is None:
            continue
        error.append(abs(load["location_m"] - trial["s_m"]))
        held.append("interval_95" in load and _inside(trial["s_m"], load["interval_95"]["location_m"]))
        force.append(load["magnitude_N"] / trial["weight_N"])
        weights = (trial["weight_N"], PULLEY * trial["weight_N"])
        force_held.append("interval_95" in load and any(_inside(w, load["interval_95"]["magnitude_N"]) for w in weights))
    accepted = sum(sample["accepted"] for sample in samples)
    ones, twos = numbers[: len(singles)], numbers[len(singles) :]
    return Outcome(error, held, force, force_held, accepted, ones, twos, samples, json.loads(record.read_text()))


if __name__ == "__main__":
    pass
