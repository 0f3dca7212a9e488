"""What is unknown: named blocks of one state vector x, each with its units, its prior and its scope.

    x = [loads, tip, tension, parameters, registration, base]

loads: gamma, the load family's own (model.load_families). tip: a dead force, or wrench, at the tip. tension: errors of the
tensions' readings. parameters: errors of what is only nearly known of the robot (model.uncertainty). registration: zeta, the twist
by which the base frame is off. base: the base wrench alpha (18). A block of scope SHARED has one value for all samples of a problem
(estimation.shared); the others have one for each.
"""

from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from ..mechanics.robot import Robot
from ..util.precision import DTYPE
from .load_families import LoadFamily
from .uncertainty import Uncertainty

TIP_SIZE = {"none": 0, "force": 3, "wrench": 6}
TIP_STD = 10.0  # of the weak prior on the unknown tip force and moment about zero, in force and moment scales
FRAME_SHIFT, FRAME_TURN = 0.05, 0.175  # of the length, and rad (10 degrees): where nothing better is known of a base frame
TURN_SCALE = 0.1  # rad, one unit of a registration angle; a unit of translation is this part of the rod's length


class Scope(Enum):
    """Whether every sample has its own value of a block, or all samples of a problem share one."""

    SAMPLE = "sample"
    SHARED = "shared"


@dataclass(frozen=True)
class Registration:
    """A rigid error of the base frame is unknown: zeta = [translation m, rotation vector rad], measured p = R p_rod + t.

    shift_std (m), turn_std (rad): standard deviations of each component about zero; None: 5 % of the length and 10 degrees, what a
    base frame is off by after it was once set up. A wider prior lets an unlikely frame pass for a push near the base, a narrower
    one is worth having (docs/trust.md). scope: SHARED where a camera that stood still is off by the same in all samples. Errors:
    ValueError for what is no standard deviation.
    """

    shift_std: float | None = None
    turn_std: float | None = None
    scope: Scope = Scope.SAMPLE

    def __post_init__(self):
        for name, std in (("shift_std", self.shift_std), ("turn_std", self.turn_std)):
            if std is not None and not 0 < std < float("inf"):
                raise ValueError(f"Registration.{name} is {std}; it must be positive and finite (m, rad), or None")


@dataclass(frozen=True)
class Block:
    """A named part of x.

    at: its slice. unit (k,): SI value of one unit of each entry (N, N m, m, rad; 1 for a load family's own entries). root (k, k):
    where entries are errors that go together, the matrix that makes SI values of them instead, L of `Uncertainty.root`. mean,
    precision (k,): its Gaussian prior in those units; precision 0 where (17) or the data alone hold it. informative: how many of
    its priors count as data in the chi-square test.
    """

    name: str
    at: slice
    unit: Float[Tensor, " k"]
    mean: Float[Tensor, " k"]
    precision: Float[Tensor, " k"]
    scope: Scope = Scope.SAMPLE
    informative: int = 0
    root: Float[Tensor, "k k"] | None = None

    @property
    def size(self) -> int:
        """Number of entries."""
        return self.at.stop - self.at.start

    def of(self, x: Float[Tensor, "... n"]) -> Float[Tensor, "... k"]:
        """The block's entries of x in SI units."""
        return x[..., self.at] * self.unit if self.root is None else x[..., self.at] @ self.root.mT

    def covariance(self, C: Float[Tensor, "... n n"]) -> Float[Tensor, "... k k"]:
        """The block's covariance in SI units, from that of x."""
        own = C[..., self.at, self.at]
        return own * self.unit * self.unit.unsqueeze(-1) if self.root is None else self.root @ own @ self.root.mT


@dataclass(frozen=True)
class State:
    """The blocks of x in their order, bound to one robot's scales."""

    loads: Block
    tip: Block
    tension: Block
    parameters: Block
    registration: Block
    base: Block

    @property
    def blocks(self) -> tuple[Block, ...]:
        """All of them in the order of x; absent ones have no entries."""
        return self.loads, self.tip, self.tension, self.parameters, self.registration, self.base

    @property
    def size(self) -> int:
        """The length of x."""
        return self.base.at.stop

    @property
    def external(self) -> slice:
        """The entries that are external loads: loads and tip."""
        return slice(0, self.tip.at.stop)

    @property
    def free_size(self) -> int:
        """How many entries only the sensors determine: not the base wrench, which (17) holds, nor what has a narrow prior."""
        return self.size - self.base.size - self.tension.size - self.parameters.size

    @cached_property
    def informative(self) -> int:
        """How many prior entries count as data in the chi-square test."""
        return sum(block.informative for block in self.blocks)

    @cached_property
    def mean(self) -> Float[Tensor, " n"]:
        """The prior mean of x."""
        return torch.cat([block.mean for block in self.blocks])

    @cached_property
    def precision(self) -> Float[Tensor, " n"]:
        """The prior precision of every entry of x."""
        return torch.cat([block.precision for block in self.blocks])

    def join(self, gamma: Float[Tensor, "B g"], alpha: Float[Tensor, "B 6"]) -> Float[Tensor, "B n"]:
        """x from loads and a base wrench (N, N m), with nothing unknown at the tip and neither tension nor registration error."""
        between = alpha.new_zeros(alpha.shape[0], self.base.at.start - self.loads.at.stop)
        return torch.cat([gamma, between, alpha / self.base.unit], -1)

    def tip_wrench(self, x: Float[Tensor, "... n"]) -> Float[Tensor, "... 6"]:
        """The unknown force (N) and moment (N m) at the tip, base frame; zero where they are not unknown."""
        tip = self.tip.of(x)
        return torch.nn.functional.pad(tip, (0, 6 - tip.shape[-1]))


@dataclass(frozen=True)
class Unknowns:
    """What is to be estimated of every sample; the base wrench always is.

    loads: a load family. tip: "none", or the unknown dead "force" or "wrench" at the tip, in the base frame; the sensors know it
    through the base wrench alone, so it costs no tangent of the march. tension_std: standard deviation (N) of the tensions'
    sensors, whose errors are then unknown; None takes the tensions as exact. registration: the base frame's error; None takes the
    frame as exact. scaled: the base wrench in the rod's force and moment scales and zeta in tenths of L and of a radian; otherwise
    in SI (the paper's). uncertainty: what is only nearly known of the robot, whose errors are then unknown; None takes it as exact.
    Errors: ValueError for another tip, a standard deviation that is not positive, and tension_std beside an uncertainty.
    """

    loads: LoadFamily
    tip: str = "none"
    tension_std: float | None = None
    registration: Registration | None = None
    scaled: bool = True
    uncertainty: Uncertainty | None = None

    def __post_init__(self):
        if self.tip not in TIP_SIZE:
            raise ValueError(f"Unknowns.tip is {self.tip!r}; it must be one of {', '.join(TIP_SIZE)}")
        if self.tension_std is not None and not 0 < self.tension_std < float("inf"):
            raise ValueError(f"Unknowns.tension_std is {self.tension_std} N; it must be positive and finite, or None")
        if self.tension_std is not None and self.uncertainty is not None:
            raise ValueError(
                "tension_std (--tension-std) and an uncertainty do not go together; state the tension's there, as a share"
            )

    def state(self, robot: Robot) -> State:
        """The blocks of x for a robot."""
        rod, scaled, first = robot.rod, self.scaled, 0

        def block(name: str, unit: list[float], precision: Tensor | float, **further) -> Block:
            nonlocal first
            at = slice(first, first + len(unit))
            first = at.stop
            precision = precision if isinstance(precision, Tensor) else torch.full((len(unit),), precision, dtype=DTYPE)
            mean = further.pop("mean", torch.zeros(len(unit), dtype=DTYPE))
            return Block(name, at, torch.tensor(unit, dtype=DTYPE), mean, precision, **further)

        wrench = [rod.force_scale] * 3 + [rod.moment_scale] * 3 if scaled else [1.0] * 6
        mean, precision = self.loads.prior()
        loads = block("loads", [1.0] * self.loads.size, precision, mean=mean, informative=self.loads.informative_priors)
        tip = block("tip", wrench[: TIP_SIZE[self.tip]], TIP_STD**-2)
        tendons = 0 if self.tension_std is None else len(robot.tendons)
        tension = block("tension", [self.tension_std or 0.0] * tendons, 1.0, informative=tendons)
        root = None if self.uncertainty is None else self.uncertainty.root(robot)
        nearly = [] if root is None else root.diagonal().tolist()
        parameters = block("parameters", nearly, 1.0, informative=len(nearly), root=root)
        if self.registration is None:
            registration = block("registration", [], 0.0)
        else:
            shift, turn = (TURN_SCALE * rod.length, TURN_SCALE) if scaled else (1.0, 1.0)
            zeta = torch.tensor([shift] * 3 + [turn] * 3, dtype=DTYPE)
            off = [self.registration.shift_std or FRAME_SHIFT * rod.length] * 3 + [self.registration.turn_std or FRAME_TURN] * 3
            known = (zeta / torch.tensor(off, dtype=DTYPE)) ** 2
            registration = block("registration", zeta.tolist(), known, scope=self.registration.scope)
        return State(loads, tip, tension, parameters, registration, block("base", wrench, 0.0))
