"""Data sets of shape-to-load pairs: the specification, and its shards, each a pure function of (specification, index).

A shard has its own random streams, spawned from (seed, index), and is solved on one thread in chunks of a fixed size. So its bytes
depend neither on the number of threads or processes, nor on the order of the shards, nor on which other shards are made.
The loads and the noise come from two streams: the same seed with another noise has the same loads.
"""

import hashlib
import json
import math
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..mechanics.loads import GaussianLoads, Load, PointForces, on_rod_fraction
from ..mechanics.robot import Robot
from ..mechanics.statics import solve_shape
from ..util.errors import InputError
from ..util.precision import DTYPE
from ..util.status import Status
from ..util.threads import one_thread

SCHEMA = 1  # raise it when the same specification makes other arrays
CHUNK = 256  # samples solved together: the working set stays in the cache, and other threads would only wait (measured)
LEAST_DRAW = 16  # a further draw for a few missing samples costs no less than this many
JUDGED_AFTER = 64  # draws: fewer say little about how many can be solved
FAMILIES = ("point", "gaussian")
DISTRIBUTIONS = ("uniform", "log-uniform")
Range = tuple[float, float]

# Every array of a shard, in the order of its checksum: shape (n samples, P markers, K contacts, T tendons), unit, frame or meaning.
ARRAYS = {
    "s": ("(P,)", "m", "arc lengths of the markers"),
    "positions": ("(n, P, 3)", "m", "markers with noise, base frame"),
    "positions_clean": ("(n, P, 3)", "m", "markers without noise, base frame"),
    "force": ("(n, K, 2)", "N", "net force on the rod, section frame x and y; contacts sorted by location"),
    "location": ("(n, K)", "m", "arc length of the contact"),
    "width": ("(n, K)", "m", "standard deviation of a Gaussian contact, 0 for a point"),
    "base_wrench": ("(n, 6)", "N, N m", "force and moment of the whole section at the base, base frame"),
    "tension": ("(n, T)", "N", "tendon tensions"),
    "gravity": ("(n, 3)", "m/s^2", "base frame"),
    "rejected": ("()", "1", "draws without an equilibrium, replaced by further ones"),
}
AXIAL = {"axial": ("(n, K)", "N", "force along the rod, positive towards the tip")}  # where contacts drag


@dataclass(frozen=True)
class DatasetSpec:
    """What a data set holds. Shard i is of robots[i % len(robots)]; every robot has the same number of tendons.

    Ranges are (lowest, highest). force: in force_unit, "N" or "EI/L^2" of the shard's robot. location, min_gap, width (sigma of a
    Gaussian; None for points) and markers: fractions of the rod's length. noise: m, on every coordinate. tension: N, None without
    tendons. gravity: magnitude (m/s^2) in a direction drawn anew for every sample; None leaves the robot's own.
    contact_friction: mu of contacts that drag along the rod, each by a force drawn from N(0, (mu |F|)^2); None: none does.
    read_dataset_spec checks what a file says; a specification made in Python is taken as it is.
    """

    robots: tuple[Robot, ...]
    samples: int
    shard_size: int
    seed: int
    noise: float
    contacts: int
    family: str
    force: Range
    force_unit: str
    distribution: str
    location: Range
    min_gap: float
    width: Range | None
    markers: tuple[float, ...]
    tension: Range | None
    gravity: Range | None
    contact_friction: float | None = None

    @property
    def arrays(self) -> dict[str, tuple[str, str, str]]:
        """ARRAYS, and AXIAL where contacts drag."""
        return ARRAYS if self.contact_friction is None else ARRAYS | AXIAL

    @property
    def shards(self) -> int:
        """How many shards: all of shard_size samples but the last."""
        return -(-self.samples // self.shard_size)

    def samples_in(self, index: int) -> int:
        """The number of samples of a shard."""
        return min(self.shard_size, self.samples - index * self.shard_size)

    def robot_of(self, index: int) -> Robot:
        """The robot of a shard."""
        return self.robots[index % len(self.robots)]

    def arc_lengths(self, robot: Robot) -> Float[Tensor, " P"]:
        """The markers' arc lengths (m)."""
        return robot.rod.length * torch.tensor(self.markers, dtype=DTYPE)

    def record(self) -> dict[str, object]:
        """Plain values for JSON, the robots by content."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        if self.contact_friction is None:  # not recorded, so that a specification keeps its checksum from version to version
            del plain["contact_friction"]
        return {"schema": SCHEMA, **plain, "robots": [_robot_record(robot) for robot in self.robots]}

    def sha256(self) -> str:
        """The identity of the data set: equal specifications make equal shards."""
        return hashlib.sha256(json.dumps(self.record(), sort_keys=True).encode()).hexdigest()


def _robot_record(robot: Robot) -> dict[str, object]:
    rod = robot.rod
    return {
        "name": robot.name,
        "length": rod.length,
        **{key: getattr(rod, key).tolist() for key in ("K_se", "K_bt", "mass_per_length", "reference_curvature")},
        "gravity": robot.gravity.tolist(),
        # What a robot does not have is not recorded, so that a specification keeps its checksum from version to version.
        **({} if rod.pieces is None else {"pieces": {name: value.tolist() for name, value in vars(rod.pieces).items()}}),
        **({"masses": rod.masses.tolist()} if len(rod.masses) else {}),
        "tendons": [
            {"routing": t.routing, "ends_at": t.ends_at}
            | ({"tension_offset": t.tension_offset} if t.tension_offset else {})
            | ({"tension_gain": t.tension_gain} if t.tension_gain != 1 else {})
            | ({"friction": t.friction, "motion": t.motion} if t.friction else {})
            | ({"discs": t.discs} if t.discs else {})
            for t in robot.tendons.tendons
        ],
    }


def _stream(spec: DatasetSpec, index: int, purpose: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(spec.seed, spawn_key=(index, purpose))))


def _between(rng: np.random.Generator, shape: tuple[int, ...], span: Range, logarithmic: bool = False) -> np.ndarray:
    """Uniform in the value, or in its logarithm."""
    u, (low, high) = rng.random(shape), span
    if logarithmic:
        return np.clip(np.exp(math.log(low) + u * math.log(high / low)), low, high)
    return low + u * (high - low)


def _draw(spec: DatasetSpec, robot: Robot, rng: np.random.Generator, count: int) -> dict[str, Tensor]:
    """Loads, tensions and gravity of `count` samples.

    K places at least a gap g apart are uniform over all such places: draw on a range shorter by (K - 1) g, sort, and move the
    k-th by k g.
    """
    each, rod = (count, spec.contacts), robot.rod
    unit = rod.bending_stiffness / rod.length**2 if spec.force_unit == "EI/L^2" else 1.0
    size = unit * _between(rng, each, spec.force, spec.distribution == "log-uniform")
    angle = _between(rng, each, (0.0, 2 * math.pi))
    gaps, (low, high) = spec.min_gap * np.arange(spec.contacts), spec.location
    place = np.minimum(np.sort(_between(rng, each, (low, high - gaps[-1])), -1) + gaps, high)
    width = np.zeros(each) if spec.width is None else _between(rng, each, spec.width, True)
    tension = _between(rng, (count, len(robot.tendons)), spec.tension or (0.0, 0.0))
    gravity = np.broadcast_to(robot.gravity.numpy(), (count, 3)).copy()
    if spec.gravity is not None:
        direction = rng.standard_normal((count, 3))
        direction /= np.sqrt((direction**2).sum(-1, keepdims=True))
        gravity = _between(rng, (count, 1), spec.gravity) * direction
    arrays = {
        "force": np.stack([size * np.cos(angle), size * np.sin(angle)], -1),
        "location": rod.length * place,
        "width": rod.length * width,
        "tension": tension,
        "gravity": gravity,
    }
    if spec.contact_friction is not None:  # drawn last: the same loads as without
        arrays["axial"] = spec.contact_friction * size * rng.standard_normal(each)
    return {name: torch.from_numpy(value) for name, value in arrays.items()}


def drawn_load(
    family: str,
    force: Float[Tensor, "B K 2"],
    location: Float[Tensor, "B K"],
    width: Float[Tensor, "B K"],
    length: float,
    axial: Float[Tensor, "B K"] | None = None,
) -> Load:
    """The load family of a data set's force (N), location (m) and width (m); the force is what acts on the rod of this length (m).

    axial: the forces along the rod (N).

    For a Gaussian a = F sqrt(c / pi) / fraction, with 2 c = 1 / width^2 and the fraction of it that lies on the rod.
    """
    if axial is not None:
        force = torch.cat([force, axial.unsqueeze(-1)], -1)
    if family == "point":
        return PointForces(torch.nn.functional.pad(force, (0, 3 - force.shape[-1])), location)
    c = 0.5 / width**2
    height = (c / math.pi).sqrt() / on_rod_fraction(location, c, length)
    return GaussianLoads(force * height.unsqueeze(-1), location, c)


def _solved(spec: DatasetSpec, robot: Robot, rng: np.random.Generator, count: int) -> dict[str, Tensor]:
    """Of `count` draws, those that have an equilibrium."""
    draw = _draw(spec, robot, rng, count)
    load = drawn_load(spec.family, draw["force"], draw["location"], draw["width"], robot.rod.length, draw.get("axial"))
    tension = draw["tension"] if len(robot.tendons) else None
    shape = solve_shape(replace(robot, gravity=draw["gravity"]), (load,), tension, spec.arc_lengths(robot), count)
    solved = shape.status == int(Status.CONVERGED)
    return {name: value[solved] for name, value in {**draw, "positions_clean": shape.p, "base_wrench": shape.base_wrench}.items()}


def simulate_shard(spec: DatasetSpec, index: int) -> dict[str, np.ndarray]:
    """The arrays of shard `index` by name, as in DatasetSpec.arrays: float64, contiguous. A pure function of its arguments.

    Draws without an equilibrium are replaced by further draws, so that the number of samples is exact.
    Errors: InputError where more than half of the draws have none.
    """
    robot, n = spec.robot_of(index), spec.samples_in(index)
    rng, blocks, drawn, kept = _stream(spec, index, 0), [], 0, 0
    with one_thread(kernel=True):  # a shard is a process's; and no result can depend on how a sum was divided
        while kept < n:
            count = min(CHUNK, max(n - kept, LEAST_DRAW))
            blocks.append(_solved(spec, robot, rng, count))
            drawn, kept = drawn + count, kept + len(blocks[-1]["force"])
            if drawn >= JUDGED_AFTER and 2 * kept < drawn:
                raise InputError(
                    f"shard {index} ({robot.name}): {drawn - kept} of {drawn} draws have no equilibrium; "
                    "lower the forces, the tensions or the robot's weight"
                )
    arrays = {name: np.concatenate([b[name].numpy() for b in blocks])[:n] for name in blocks[0]}
    clean = arrays["positions_clean"]
    noise = spec.noise * _stream(spec, index, 1).standard_normal(clean.shape)
    arrays |= {"s": spec.arc_lengths(robot).numpy(), "positions": clean + noise, "rejected": np.array(drawn - kept, dtype=float)}
    return {name: np.asarray(arrays[name], order="C") for name in spec.arrays}


def digest(arrays: dict[str, np.ndarray]) -> str:
    """sha256 of a shard's contents: of every array, in the order of DatasetSpec.arrays, name, type, shape, little-endian bytes."""
    sha = hashlib.sha256()
    for name in (n for n in ARRAYS | AXIAL if n in arrays):
        value = arrays[name]
        sha.update(f"{name} {value.dtype.newbyteorder('<').str} {value.shape}\n".encode())
        sha.update(np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("<")).data)
    return sha.hexdigest()
