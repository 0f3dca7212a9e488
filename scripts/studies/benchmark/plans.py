"""How much is measured: in full, and in --quick."""

from dataclasses import dataclass, field

SHOWN = (256, 4096)  # the batches of the bars
WHOLE = "torchrod, whole estimates"  # beside iterations, where time is compared over batches


@dataclass(frozen=True)
class Plan:
    """Batches, and the values along which growth is measured.

    rounds: how often every path is asked in turn; budget: seconds that a timing takes. largest: the largest batch of a path that is
    slow. growing: the paths whose growth is measured, at `growth_batch` samples. estimates: how many whole estimates of a path are
    timed at once, "" for the others. linear: batches whose time per sample is compared, over `linear_samples` samples each, in
    turn, `linear_rounds` times, or `linear_rounds_whole` times for whole estimates.
    """

    batches: tuple[int, ...] = (1, 16, 256, 1024, 4096, 16384, 65536)
    rounds: int = 2
    budget: float = 1.0
    largest: dict[str, int] = field(default_factory=lambda: {"torchrod, eager": 1024, "scipy": 1})
    growing: tuple[str, ...] = ("torchrod", "numba", "jax, tuned")
    growth_batch: int = 256
    steps: tuple[int, ...] = (20, 40, 80, 160)
    markers: tuple[int, ...] = (5, 10, 20, 40)
    loads: tuple[int, ...] = (1, 2, 3, 4)
    core_batch: int = 4096
    linear: tuple[int, ...] = (256, 1024, 4096, 16384, 65536)
    linear_samples: int = 65536
    linear_rounds: int = 11
    linear_rounds_whole: int = 5
    estimates: dict[str, int] = field(default_factory=lambda: {"torchrod, eager": 256, "scipy": 4, "": 4096})
    memory: tuple[int, ...] = (256, 4096, 65536)
    frames: int = 400
    commands: int = 3
    without_first_call: tuple[str, ...] = ()

    def batch_of_estimates(self, name: str) -> int:
        """How many whole estimates of a path are timed at once."""
        return self.estimates.get(name, self.estimates[""])


FULL = Plan()
QUICK = Plan(
    batches=(1, 256, 4096),
    rounds=1,
    budget=0.15,
    largest={"torchrod, eager": 0, "scipy": 1},
    growing=("torchrod", "numba"),
    steps=(20, 40, 80),
    markers=(10, 20, 40),
    loads=(1, 2, 3),
    core_batch=1024,
    linear=(256, 1024, 4096),
    linear_samples=4096,
    linear_rounds=5,
    linear_rounds_whole=3,
    estimates={"torchrod, eager": 0, "scipy": 1, "": 1024},
    memory=(256, 1024),
    frames=120,
    commands=1,
    without_first_call=("torchrod, eager, from scratch", "numba, from scratch"),
)
