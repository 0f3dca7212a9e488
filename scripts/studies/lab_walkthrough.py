"""Exports of measuring systems, simulated: what a lab would have on its disk, the commands from there to loads, and what is true.

Each case writes its files into a folder and says which commands follow. Errors are those of the commands' RESULT, whitened by the
Cramer-Rao bound, which comes from differences of the forward solve; of a tip pose by the likelihood ratio.
"""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import roma
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchrod import GaussianLoads, PointForces, PointWrenches, Robot, Tendon, Tendons, solve_shape
from torchrod.mechanics.statics import Equilibrium

from .reproduction.cases import L, steel_rod

ROD = 'name = "steel rod"\n[rod]\nlength_mm = 400\ndiameter_mm = 1.4\nyoungs_modulus = 207e9\nshear_modulus = 79e9\n'
PULLED = ROD + "[[tendons]]\noffset_mm = [7, 0]\n[[tendons]]\noffset_mm = [-7, 0]\n"
TENDONS = Tendons((Tendon.straight(0.007, 0, L), Tendon.straight(-0.007, 0, L)))
D = torch.float64
PLATE = torch.tensor([[30.0, 0, 0], [-20, 25, 0], [-20, -25, 0], [10, 15, 8]], dtype=D) * 1e-3
WIDTH = L / 100  # m: of a point-like load
PULL_STD = 0.05  # N
MANY, TAKES = 600, 10  # frames; takes of a case that has fewer
HANGS = Rotation.from_rotvec([0.0, math.pi, 0.0]) * Rotation.from_rotvec([0.4, 0.2, -0.9])  # down, and turned
TURN = torch.from_numpy(HANGS.as_matrix())
ORIGIN = torch.tensor([0.3, -1.2, 0.8], dtype=D)
POSE = f"position = {ORIGIN.tolist()}\nrotation = {TURN.tolist()}\n"


@dataclass(frozen=True)
class Truth:
    """What acts on B shapes: forces (B, 2) N at places (B,) m, section frame; a force (B, 3) N at the tip; tensions (B, T) N."""

    force: Tensor
    place: Tensor
    tip: Tensor
    pull: Tensor | None = None

    @classmethod
    def take(cls, frames: int) -> "Truth":
        """A push of 0.5 to 1 N that wanders between 10 and 39 cm and turns about the rod."""
        k = torch.arange(frames) / 600
        size, angle = 0.75 + 0.25 * (2 * math.pi * 3 * k).sin(), 2 * math.pi * k
        force = torch.stack([size * angle.cos(), size * angle.sin()], -1)
        return cls(force, 0.245 + 0.145 * (2 * math.pi * k).sin(), torch.zeros(frames, 3))

    def at(self, robot: Robot, s: Tensor) -> Equilibrium:
        """The shapes at s, under point forces."""
        force = torch.cat([self.force, torch.zeros_like(self.place).unsqueeze(-1)], -1).unsqueeze(1)
        return solve_shape(robot, (PointForces(force, self.place.unsqueeze(1)), _tip(self.tip)), self.pull, s, len(self.place), 80)


def _tip(force: Tensor) -> PointWrenches:
    return PointWrenches(force.unsqueeze(1), torch.zeros_like(force).unsqueeze(1), torch.tensor([L]))


Reads = Callable[[Equilibrium], Tensor]


@dataclass(frozen=True)
class Case:
    """A take and its files: commands (without `torchrod`), truth, and how the bound of it comes about.

    read: from shapes at s the numbers that are measured, (B, k), each over its standard deviation, NaN where it is missing. tip:
    where a force at the tip is looked for, chi^2 (B,) of the true one.
    """

    commands: list[str]
    truth: Truth
    robot: Robot
    s: Tensor
    read: Reads
    tip: Tensor | None = None


def _bound(case: Case) -> Tensor:
    """Covariance (B, n, n) of [F_x, F_y, place, log c, tensions]."""
    truth, B = case.truth, len(case.truth.place)
    pulls = torch.zeros(B, 0) if truth.pull is None else truth.pull[:, :1]  # the other one is slack
    at = torch.cat([truth.force, truth.place.unsqueeze(-1), torch.full((B, 1), math.log(0.5 / WIDTH**2)), pulls], -1)
    prior = [0.0, 0.0, 0.0, 1.0, *[PULL_STD**-2] * pulls.shape[1]]
    steps = [1e-3, 1e-3, 1e-4, 1e-2, *[1e-3] * pulls.shape[1]]

    def under(theta: Tensor) -> Tensor:
        c = theta[:, 3].exp()
        load = GaussianLoads((theta[:, :2] * (c / math.pi).sqrt().unsqueeze(-1)).unsqueeze(1), theta[:, 2:3], c.unsqueeze(-1))
        pull = None if truth.pull is None else torch.cat([theta[:, 4:], torch.zeros(B, 1)], -1)
        return case.read(solve_shape(case.robot, (load,), pull, case.s, B, 80))

    moves = []
    for k, step in enumerate(steps):
        d = step * torch.eye(len(steps))[k]
        moves.append((under(at + d) - under(at - d)) / (2 * step))
    J = torch.stack(moves, -1).nan_to_num(0.0)
    return torch.linalg.inv(J.mT @ J + torch.diag(torch.tensor(prior)))


@dataclass(frozen=True)
class Errors:
    """Of accepted fits: names with the rms error (SI) and the same over the bound; accepted: a share of the frames."""

    frames: int
    accepted: float
    of: dict[str, tuple[float, float]]

    @classmethod
    def of_all(cls, takes: "list[Errors]") -> "Errors":
        """Of takes as long as each other, together."""
        share = torch.tensor([take.accepted for take in takes])

        def whole(values: list[float]) -> float:
            return float(((share * torch.tensor(values).square()).sum() / share.sum()).sqrt())

        of = {name: (whole([t.of[name][0] for t in takes]), whole([t.of[name][1] for t in takes])) for name in takes[0].of}
        return cls(sum(take.frames for take in takes), float(share.mean()), of)


def judged(case: Case, result: Path) -> Errors:
    """The loads of RESULT.json beside the truth.

    A tip pose hardly reads the force along the rod, and through it the others lie on a curved valley that the bound, which is of
    small errors, does not know. In its place stands what it is on a straight one, the likelihood ratio: chi^2 of the truth less
    that of the fit, which has the mean 3 of as many unknowns where the fit is as good as can be.
    """
    records = json.loads(result.read_text())["results"]
    ok = torch.tensor([bool(r["accepted"]) for r in records])
    truth = case.truth
    if case.tip is not None:
        error = torch.tensor([r["tip"]["force_N"] for r in records]) - truth.tip
        over = (case.tip - torch.tensor([r["chi2"] for r in records])).clamp(min=0) / 3
        found = {"force, by the likelihood": (_rms(error[ok, :2].flatten()), float(over[ok].mean().sqrt()))}
        return Errors(len(ok), float(ok.double().mean()), found)
    C = _bound(case)
    size = truth.force.norm(dim=-1)
    way = truth.force / size.unsqueeze(-1)
    variance = {"force": (way.unsqueeze(1) @ C[:, :2, :2] @ way.unsqueeze(-1)).flatten(), "place": C[:, 2, 2]}
    force = torch.tensor([r["loads"][0]["magnitude_N"] for r in records]) - size
    place = torch.tensor([r["loads"][0]["location_m"] for r in records]) - truth.place
    errors = {"force": force, "place": place}
    over = {n: (_rms(e[ok]), _rms((e / variance[n].sqrt())[ok])) for n, e in errors.items()}
    return Errors(len(ok), float(ok.double().mean()), over)


def _rms(x: Tensor) -> float:
    return float(x.square().mean().sqrt())


def _lab(p: Tensor) -> Tensor:
    """Base frame to the lab's, z up."""
    return p @ TURN.mT + ORIGIN


def _line(values: Tensor, digits: int, mark: str = ",") -> str:
    return mark.join("" if math.isnan(v) else f"{v:.{digits}f}" for v in values.flatten().tolist())


def _put(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).write_text(text + "\n")


def motive(folder: Path, seed: int = 0, frames: int = MANY) -> Case:
    """A take without labels: y up, millimetres, the base away from the origin and upside down, 5 % of the markers missing."""
    truth, s, g = Truth.take(frames), torch.linspace(0.02, L, 20), np.random.default_rng(seed)
    clean = truth.at(steel_rod(), s)
    p = clean.p + 1e-3 * torch.from_numpy(g.normal(size=clean.p.shape))
    gone = torch.from_numpy(g.random(p.shape[:2]) < 0.05)
    p[gone] = torch.nan
    plate = _lab(PLATE).expand(frames, -1, -1)
    points = torch.cat([_lab(p), plate], 1)[:, torch.from_numpy(g.permutation(24))]
    up = 1e3 * torch.stack([points[..., 0], points[..., 2], -points[..., 1]], -1)
    n = points.shape[1]
    rows = ["Format Version,1.23,Take Name,push,Rotation Type,Quaternion,Length Units,Millimeters", "", ",Type" + ",Marker" * 3 * n]
    rows += [",Name" + "".join(f",Unlabeled {1000 + i}" * 3 for i in range(n)), ",ID" + ",1" * 3 * n, "," + ",Position" * 3 * n]
    rows += ["Frame,Time (Seconds)" + ",X,Y,Z" * n, *(f"{k},{0.01 * k:.6f},{_line(up[k], 4)}" for k in range(frames))]
    plan = f'up = "y"\n[base]\nat_mm = {(1e3 * PLATE).tolist()}\n[markers]\ns_mm = {(1e3 * s).tolist()}'
    _put(folder, {"rod.toml": ROD, "take.csv": "\n".join(rows), "layout.toml": plan})
    lost = torch.where(gone, torch.nan, 0.0).unsqueeze(-1)
    commands = ["import motive take.csv --robot rod.toml --layout layout.toml --out shapes.csv"]
    commands.append("estimate rod.toml shapes.csv --load-prior point --noise 1e-3 --out loads.json")
    return Case(commands, truth, steel_rod(), s, lambda shape: ((shape.p + lost) / 1e-3).flatten(1))


def _aurora(folder: Path, truth: Truth, s: Tensor, seed: int, options: str) -> tuple[Case, Tensor]:
    """Tools with six degrees of freedom, 0.5 mm and 0.5 degrees, w first, in a tracker's frame that ROBOT.toml states.

    And chi^2 (B,) of the truth.
    """
    noise, angle, g = 5e-4, math.radians(0.5), torch.Generator().manual_seed(seed)
    clean = truth.at(steel_rod(), s)
    R0, B, P = roma.unitquat_to_rotmat(clean.q), len(truth.place), len(s)
    turn, shift = torch.randn(B, P, 3, generator=g), torch.randn(clean.p.shape, generator=g)
    R, p = R0 @ roma.rotvec_to_rotmat(angle * turn), 1e3 * _lab(clean.p + noise * shift)
    q = roma.rotmat_to_unitquat(TURN @ R)[..., [3, 0, 1, 2]]
    names = "abc"[:P]
    rows = ["Sample:,Hour,Minutes,Seconds,ms" + "".join(f",X{n},Y{n},Z{n},qo{n},qx{n},qy{n},qz{n}" for n in names)]
    rows += [f"{k + 1},10,15,{k // 25},{40 * (k % 25)}," + _line(torch.cat([p[k], q[k]], -1), 5) for k in range(B)]
    plan = f"[bodies]\nnames = {[*names]}\ns_mm = {(1e3 * s).tolist()}"
    _put(folder, {"rod.toml": f"{ROD}[base]\n{POSE}", "tools.csv": "\n".join(rows), "layout.toml": plan})

    def read(shape: Equilibrium) -> Tensor:
        off = roma.rotmat_to_rotvec(R0.mT @ roma.unitquat_to_rotmat(shape.q)) / angle
        return torch.cat([(shape.p / noise).flatten(1), off.flatten(1)], -1)

    commands = ["import aurora tools.csv --robot rod.toml --layout layout.toml --out shapes.csv"]
    commands.append(f"estimate rod.toml shapes.csv {options} --noise 5e-4 --angle-noise 0.00873 --out loads.json")
    return Case(commands, truth, steel_rod(), s, read), (turn.square() + shift.square()).sum((1, 2))


def aurora(folder: Path, seed: int = 0, frames: int = 60) -> Case:
    """Three sensors along the rod."""
    return _aurora(folder, Truth.take(frames), torch.tensor([0.15, 0.28, 0.4]), seed, "--load-prior point")[0]


def tip_pose(folder: Path, seed: int = 0, frames: int = 60) -> Case:
    """One sensor at the tip, on which a force acts."""
    tip = 0.15 * torch.randn(frames, 3, generator=torch.Generator().manual_seed(seed + 1))
    tip[:, 2] *= 0.2
    truth = Truth(torch.zeros(frames, 2), torch.full((frames,), 0.2), tip)
    case, chi2 = _aurora(folder, truth, torch.tensor([L]), seed, "--contacts 0 --unknown-tip force")
    return replace(case, tip=chi2)


def gratings(folder: Path, seed: int = 0, frames: int = 60) -> Case:
    """Strains of a fibre of three cores at 20 places, with temperature; 0.05 1/m of curvature."""
    truth, s, ds = Truth.take(frames), torch.linspace(0.01, L - 0.01, 20), 1e-4
    core = 35e-6 * torch.tensor([[math.cos(a), math.sin(a)] for a in (0.0, 2 * math.pi / 3, 4 * math.pi / 3)])
    places = torch.cat([s - ds, s + ds])

    def curvature(shape: Equilibrium) -> Tensor:
        R = roma.unitquat_to_rotmat(shape.q)
        return roma.rotmat_to_rotvec(R[:, : len(s)].mT @ R[:, len(s) :])[..., :2] / (2 * ds)

    u, g = curvature(truth.at(steel_rod(), places)), torch.Generator().manual_seed(seed)
    e = u[..., :1] * core[:, 1] - u[..., 1:] * core[:, 0] + 1e-4 * torch.randn(frames, 20, 1, generator=g)
    e = 1e6 * (e + 0.05 * 35e-6 * math.sqrt(1.5) * torch.randn(e.shape, generator=g))
    names = [[f"G{i}C{c}" for c in range(3)] for i in range(20)]
    rows = ["\t".join(["Date", "Time", "Linenumber", "Error status", *np.ravel(names)])]
    rows += [f"2026-01-02T10:{k // 60:02d}:{k % 60:02d}+00:00\t\t{k}\t0;0\t{_line(e[k], 4, chr(9))}" for k in range(frames)]
    plan = f"[gratings]\ns_mm = {(1e3 * s).tolist()}\ncores = {names}\ncore_mm = {(1e3 * core).tolist()}"
    _put(folder, {"rod.toml": ROD, "fibre.txt": "\n".join(rows), "layout.toml": plan})
    commands = ["import fbgs fibre.txt --robot rod.toml --layout layout.toml --out shapes.csv"]
    commands.append("estimate rod.toml shapes.csv --load-prior point --curvature-noise 0.05 --out loads.json")
    return Case(commands, truth, steel_rod(), places, lambda shape: (curvature(shape) / 0.05).flatten(1))


def centre_line(folder: Path, seed: int = 0, frames: int = 10) -> Case:
    """200 points of each frame without arc lengths, in no order, 1 mm, millimetres in the lab's frame."""
    g = torch.Generator().manual_seed(seed)
    whole = Truth.take(600)
    pick = torch.linspace(0, 599, frames).long()
    truth = Truth(whole.force[pick], whole.place[pick], whole.tip[pick])
    s = torch.sort(L * torch.rand(200, generator=g)).values
    clean = truth.at(steel_rod(), s)
    p = 1e3 * _lab(clean.p + 1e-3 * torch.randn(clean.p.shape, generator=g))
    rows = ["frame,x,y,z"]
    rows += [f"{k},{_line(p[k, i], 4)}" for k in range(frames) for i in torch.randperm(200, generator=g).tolist()]
    plan = f'units = "mm"\nrate = 30\n[base]\n{POSE}[centre_line]'
    _put(folder, {"rod.toml": ROD, "points.csv": "\n".join(rows), "layout.toml": plan})
    t = roma.unitquat_to_rotmat(clean.q)[..., 2]

    def read(shape: Equilibrium) -> Tensor:
        d = shape.p - clean.p
        return ((d - (d * t).sum(-1, keepdim=True) * t) / 1e-3).flatten(1)

    commands = ["import line points.csv --robot rod.toml --layout layout.toml --out shapes.csv"]
    commands.append("estimate rod.toml shapes.csv --load-prior point --noise 1e-3 --out loads.json")
    return Case(commands, truth, steel_rod(), s, read)


def tensions(folder: Path, seed: int = 0, frames: int = 60) -> Case:
    """Two opposite tendons, one pulled, the other slack, whose cell reads noise about zero, in a file of their own."""
    take, g = Truth.take(frames), torch.Generator().manual_seed(seed)
    robot, s = Robot(steel_rod().rod, TENDONS), torch.linspace(0.02, L, 20)
    truth = Truth(take.force, take.place, take.tip, torch.stack([torch.full((frames,), 3.0), torch.zeros(frames)], -1))
    clean = truth.at(robot, s)
    p = clean.p + 1e-3 * torch.randn(clean.p.shape, generator=g)
    rows = ["time,s,x,y,z"]
    rows += [f"{0.02 * k:.3f},{float(s[i])!r},{_line(p[k, i], 7)}" for k in range(frames) for i in range(len(s))]
    pull = torch.tensor([3.0, 0.0]) + PULL_STD * torch.randn(frames, 2, generator=g)
    cells = [f"{0.02 * k:.3f},{_line(pull[k], 5)}" for k in range(frames)]
    _put(folder, {"rod.toml": PULLED, "shapes.csv": "\n".join(rows), "cells.csv": "time,tension_1,tension_2\n" + "\n".join(cells)})
    options = f"--load-prior point --noise 1e-3 --tensions cells.csv --tension-std {PULL_STD}"
    command = f"estimate rod.toml shapes.csv {options} --out loads.json"
    return Case([command], truth, robot, s, lambda shape: (shape.p / 1e-3).flatten(1))


CASES: dict[str, Callable[[Path, int], Case]] = {
    "Motive, 600 frames without labels": motive,
    "three Aurora sensors": aurora,
    "20 gratings of three cores": gratings,
    "a centre line of 200 points": centre_line,
    "tensions with noise about zero": tensions,
    "a tip pose alone": tip_pose,
}
