"""Digital twins of the paper's two tendon robots: displaced tendons, pushes, noisy markers on the discs, a model a little wrong.

1-DoF robot (Tables I and II, whose loads sit within its 40 cm): 1.4 mm ASTM A228, a tendon parallel at 7 mm to the last disc, discs
5 cm apart, 0.144 kg/m. 2-DoF robot (Table III): 56 cm, tendons parallel at 25 mm on orthogonal sides, one to the tip, the other to
the disc halfway, discs 7 cm apart, 0.252 kg/m. Nine discs so far apart fill either robot from base to tip, so the nine markers sit
at 0, 1/8, ..., 1 of the length; the one on the base disc tells nothing of the load.

Not printed, and our choice: gravity along +x, the gravity plane's tendon below the rod (at +x, so that pulling adds to the sag),
the other at +y; in-plane loads hang along +x, out-of-plane ones pull along +y, those of Table III half way between; 0.25 mm of
marker noise; the 2-DoF backbone's diameter (DIAMETER). With the gravity plane's tendon above, loads of Table II that hang down need
50 to 80 N of tension. Under it, without load, the robot is curled up: a cold start begins there, and no fit comes of it.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrod import (
    Estimate,
    GaussianCoordinates,
    Markers,
    PointForces,
    Problem,
    Robot,
    Rod,
    Status,
    Tendon,
    Tendons,
    Unknowns,
    estimate,
    solve_displacement,
)

NOISE = 0.25e-3  # m
MARKERS = 9
MISMATCH = 0.03  # one standard deviation of stiffness, mass and tension, relative
TENSION_STD = 1.0  # N: what the estimator is told of the errors of the tension readings
GRAVITY = (9.81, 0.0, 0.0)  # m/s^2: the robots lie across it
# m, of the 2-DoF robot's backbone. Steel of 2.5 mm weighs 0.039 of the 0.252 kg/m and leaves 13 g for each disc (6 g on the 1-DoF
# robot, whose tendon runs at 7 mm instead of 25). The largest stroke, 30 mm, turns the tip by 69 degrees and takes 34 N (x EI /
# r^2 L); with 2 mm the weight alone would turn it by 25 degrees, with 3.5 mm the stroke would take 130 N.
DIAMETER = 2.5e-3


def _robot(length: float, diameter: float, mass: float, tendons: tuple[Tendon, ...]) -> Robot:
    rod = Rod.circular(length, diameter, 207e9, 79e9, mass)
    return Robot(rod, Tendons(tendons), torch.tensor(GRAVITY, dtype=torch.float64))


def one_tendon() -> Robot:
    """The 1-DoF robot."""
    return _robot(0.4, 1.4e-3, 0.144, (Tendon.straight(7e-3, 0.0, 0.4),))


def two_tendons() -> Robot:
    """The 2-DoF robot."""
    return _robot(0.56, DIAMETER, 0.252, (Tendon.straight(25e-3, 0.0, 0.56), Tendon.straight(0.0, 25e-3, 0.28)))


@dataclass(frozen=True)
class Twin:
    """What was done to a robot and seen of it: displacement (B, T) m, force (B, K, 2) N, location (B, K) m, true tension (B, T) N,
    base wrench (B, 6), whether there is an equilibrium (B,), and what the estimator is told: noisy markers and `read` (B, T) N, the
    tensions as read.
    """

    robot: Robot
    force: Tensor
    location: Tensor
    tension: Tensor
    base_wrench: Tensor
    solved: Tensor
    told: Markers
    read: Tensor

    def estimate(self) -> Estimate:
        """As many contacts as there are, gravity and tensions known, registration perfect; NaN markers where there is no shape."""
        rod = self.robot.rod
        loads = GaussianCoordinates(self.location.shape[1], rod.length, rod.force_scale, "point")
        return estimate(Problem(self.robot, Unknowns(loads, tension_std=TENSION_STD), [self.told], self.read))


def twin(robot: Robot, displacement: Tensor, force: Tensor, location: Tensor, mismatch: float, draws: int, seed: int) -> Twin:
    """Every row of displacement (R, T) m, force (R, K, 2) N and location (R, K) m, `draws` times over.

    The true robot is k times as stiff as the model and m times as heavy, and a tension is read with a relative error. A rod k times
    as stiff has the same shape under k times the loads, so the model's own rod is solved under the loads divided by k.
    """
    generator = torch.Generator().manual_seed(seed)
    d, f, at = (x.repeat_interleave(draws, 0) for x in (displacement, force, location))
    B = len(d)
    wrong = 1 + mismatch * torch.randn(B, 2 + d.shape[-1], generator=generator, dtype=torch.float64).clamp(-3, 3)
    k, m, read = wrong[:, :1], wrong[:, 1:2], wrong[:, 2:]
    real = Robot(robot.rod, robot.tendons, robot.gravity * m / k)
    push = PointForces(torch.nn.functional.pad(f / k.unsqueeze(-1), (0, 1)), at)
    s = robot.rod.length * torch.arange(MARKERS, dtype=torch.float64) / (MARKERS - 1)
    answer = solve_displacement(real, (push,), d, s)
    tension = k * answer.tension
    p = answer.equilibrium.p
    noisy = p + NOISE * torch.randn(p.shape, generator=generator, dtype=torch.float64)
    solved = answer.equilibrium.status == int(Status.CONVERGED)
    wrench, told = k * answer.equilibrium.base_wrench, Markers(s, noisy, NOISE)
    return Twin(robot, f, at, tension, wrench, solved, told, (tension * read).nan_to_num(0.0))
