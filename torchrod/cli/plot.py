"""torchrod plot."""

from jsonargparse import Namespace

from ..io import read_fit, read_robot, read_shapes, read_uncertainty
from ..util.errors import InputError
from .arguments import FIGURE_SUFFIXES, as_calibrated, writable


def plot(options: Namespace) -> None:
    """torchrod plot."""
    from ..plotting.estimate import draw

    robot = read_robot(options.robot)
    shapes = read_shapes(options.shapes, robot, options.units, options.tensions)
    known = read_uncertainty(options.robot)
    shapes = as_calibrated(options.shapes, shapes, known.calibrated)
    sample = shapes.samples[0] if options.sample is None else options.sample
    if sample not in shapes.samples:
        raise InputError(f"{options.shapes}: has no sample {sample}; choose one of its samples with --sample")
    writable(options.out, FIGURE_SUFFIXES)
    fit = read_fit(options.result, sample, robot.name, shapes.groups, robot.rod.length)
    b = shapes.samples.index(sample)
    tension = None if shapes.tension is None else shapes.tension[b]
    points, nearly = shapes.points[b], known.of_a_sample
    if nearly is not None and fit.errors:
        robot, warp = nearly.found_at(robot, fit.errors)
        points = warp.undone(points)
    draw(options.out, robot, fit, points, tension, f"{robot.name}, sample {sample}")
