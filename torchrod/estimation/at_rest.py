"""The robot in equilibrium under loads that are known, roughly and fast: what a start of the filter is made of."""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from .. import kernel
from ..mechanics.robot import Robot
from ..mechanics.statics import LOAD_PER_INCREMENT, ROUGH_TOLERANCE, solve_shape
from ..model.load_families import GaussianCoordinates
from ..model.measurement import Markers, Model
from ..util.kept import versions
from .evaluator import Prepared, family_of, served

HEAVY = 7.0  # in EI / L^3: the weight under which an upright rod buckles is 7.84


@dataclass(frozen=True)
class Rest:
    """B robots in equilibrium: wrench (B, 6) = [n(0) N, m(0) N m] and p (B, P, 3) m, base frame; NaN where there is none."""

    wrench: Float[Tensor, "B 6"]
    p: Float[Tensor, "B P 3"]


def at_rest(model: Model, markers: Markers, gamma: Float[Tensor, "B g"], q_tip: Float[Tensor, "B 4"] | None = None) -> Rest:
    """The base wrench and the shape at markers.s under the loads gamma and the tensions, to ROUGH_TOLERANCE on coarse steps.

    q_tip: the orientation of the tip near which to look, where it is known: sooner found. By the compiled kernel where it serves;
    what does not settle there, rods so heavy that an upright one would fall over, and all else, by torchrod.solve_shape, which is
    the definition and stays in stable equilibrium.
    """
    B, P = len(gamma), len(markers.s)
    rough = replace(model.coarse, registration=False, tip="none", tension_std=None)
    wrench, p = gamma.new_full((B, 6), torch.nan), gamma.new_full((B, P, 3), torch.nan)
    settled = torch.zeros(B, dtype=torch.bool)
    light = model.robot.gravity.ndim == 1 and math.isfinite(_weight(model))
    if light and family_of(rough) != "point" and served(rough, markers.positions):
        x = rough.join(gamma, wrench.new_zeros(B, 6))
        tables = Prepared(rough, markers, gamma.new_zeros(B, 0)).tables(x)
        wrench, missed, p = kernel.balance_now(
            x, q_tip, _increments(model) if q_tip is None else 1, ROUGH_TOLERANCE, tables.structure, tables.markers
        )
        settled = (missed <= ROUGH_TOLERANCE) & torch.isfinite(wrench).all(-1)
    if bool(settled.all()):
        return Rest(wrench, p)
    index = (~settled).nonzero().squeeze(-1)
    tension = None if markers.tension is None else markers.tension[index]
    start = None if q_tip is None else q_tip[index]
    loads = model.coordinates.loads(gamma[index]) if gamma.shape[-1] else ()
    solved = solve_shape(model.robot, loads, tension, markers.s, len(index), rough.steps, ROUGH_TOLERANCE, start)
    return Rest(wrench.index_copy(0, index, solved.base_wrench), p.index_copy(0, index, solved.p))


def without_load(model: Model, markers: Markers) -> Rest:
    """The robot under its tensions and its weight alone: one forward solve where the samples are alike before the load."""
    if markers.tension is not None or model.robot.gravity.ndim > 1:
        return _bare(model.robot, model.steps, markers)
    B, now, compiled = len(markers.positions), model.robot.versions + versions(markers.s), served(model, markers.positions)
    rest = _kept_bare(model.robot, model.steps, markers.s, now, compiled)
    return Rest(rest.wrench.expand(B, 6), rest.p.expand(B, *rest.p.shape[1:]))


def _bare(robot: Robot, steps: int, markers: Markers) -> Rest:
    model = Model(robot, GaussianCoordinates(0, robot.rod.length, robot.rod.force_scale), steps=steps)
    return at_rest(model, markers, markers.positions.new_zeros(len(markers.positions), 0))


@lru_cache(maxsize=32)
@torch.inference_mode(False)  # it outlives the call
def _kept_bare(robot: Robot, steps: int, s: Float[Tensor, " P"], now: tuple[int, ...], compiled: bool) -> Rest:
    """The same for the next shapes, unless a tensor of the robot or s has been changed since, or another path serves."""
    return _bare(robot, steps, Markers(s, s.new_zeros(1, len(s), 3)))


def _weight(model: Model) -> float:
    """In EI / L^3; infinite where the rod has no stiffness to speak of."""
    rod = model.robot.rod
    load = float(model.robot.weight.norm()) * rod.length**3
    return load / rod.bending_stiffness if load < HEAVY * rod.bending_stiffness else math.inf


def _increments(model: Model) -> int:
    """In how many parts the weight is put on, so that each is no more than solve_shape's."""
    return max(1, math.ceil(_weight(model) / LOAD_PER_INCREMENT))
