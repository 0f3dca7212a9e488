"""What each command does, once its arguments are known."""

from jsonargparse import Namespace

from .arguments import FIGURE_SUFFIXES, writable
from .calibrate_command import calibrate
from .errors import InputError
from .estimate_command import estimate
from .io import read_fit, read_robot, read_shapes
from .observability_command import observability
from .simulate_command import simulate, simulate_dataset

__all__ = ["calibrate", "estimate", "observability", "plot", "simulate", "simulate_dataset"]


def plot(options: Namespace) -> None:
    """torchrod plot."""
    from .plot import draw

    robot = read_robot(options.robot)
    shapes = read_shapes(options.shapes, robot)
    sample = options.sample or shapes.samples[0]
    if sample not in shapes.samples:
        raise InputError(f"{options.shapes}: has no sample {sample}; choose one of its samples with --sample")
    writable(options.out, FIGURE_SUFFIXES)
    fit = read_fit(options.result, sample)
    draw(options.out, robot, fit, shapes.markers, shapes.samples.index(sample), f"{robot.name}, sample {sample}")
