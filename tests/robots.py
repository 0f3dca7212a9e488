"""Robots and loads that several tests share."""

import math

import torch
from studies.reproduction.cases import steel_rod

from torchrod import GaussianLoads, PointForces, Robot, Rod, Tendon, Tendons

__all__ = ["T", "busy_robot", "csv_of", "loads_of", "robot_of", "steel_rod", "toml_of"]

T = torch.tensor


def busy_robot() -> Robot:
    """Gravity, a helical tendon, and a straight one that ends half way."""
    s = torch.linspace(0, 0.4, 15).tolist()
    helix = Tendon(tuple((x, 0.007 * math.cos(12 * x), 0.007 * math.sin(12 * x)) for x in s), 0.4)
    rod = Rod.circular(0.4, 0.0014, 207e9, 79e9, 0.1)
    return Robot(rod, Tendons((helix, Tendon.straight(0.0, 0.007, 0.23))), T([9.81, 0.0, 0.0]))


def robot_of(case: dict) -> Robot:
    """A robot of shape_reference.json."""
    r = case["robot"]
    rod = Rod.circular(r["length"], r["diameter"], r["youngs_modulus"], r["shear_modulus"], 1.0 if r["weight"] else 0.0)
    tendons = Tendons(tuple(Tendon.straight(x, y, end) for x, y, end in r["tendons"]))
    return Robot(rod, tendons, T(r["weight"] or [0.0] * 3, dtype=torch.float64))


def loads_of(case: dict) -> tuple:
    """Its loads."""
    loads = []
    if case["points"]:
        force = T([[[p["fx"], p["fy"], 0.0] for p in case["points"]]])
        loads.append(PointForces(force, T([[p["s"] for p in case["points"]]])))
    if case["desc"]:
        d = case["desc"]
        loads.append(GaussianLoads(T([[[d["ax"], d["ay"]]]]), T([[d["mu"]]]), T([[d["c"]]])))
    return tuple(loads)


def toml_of(robot: dict, name: str = "reference") -> str:
    """ROBOT.toml of a robot of shape_reference.json; its weight per length is written as a mass of 1 kg/m under that gravity."""
    lines = [f'name = "{name}"', "[rod]"]
    lines += [f"{key} = {robot[key]!r}" for key in ("length", "diameter", "youngs_modulus", "shear_modulus")]
    if robot["weight"]:
        lines += ["mass_per_length = 1.0", f"gravity = {[float(v) for v in robot['weight']]}"]
    for x, y, end in robot["tendons"]:
        lines += ["[[tendons]]", f"offset = [{x}, {y}]", f"ends_at = {end}"]
    return "\n".join(lines) + "\n"


def csv_of(case: dict) -> str:
    """SHAPES.csv of a case."""
    tensions = case["tensions"]
    lines = ["s,x,y,z" + "".join(f",tension_{i + 1}" for i in range(len(tensions)))]
    lines += [",".join(repr(v) for v in [s, *p, *tensions]) for s, p in zip(case["s"], case["positions"], strict=True)]
    return "\n".join(lines) + "\n"
