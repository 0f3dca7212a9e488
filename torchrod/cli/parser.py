"""The command line. Nothing heavy is imported until a command runs, so that --help answers at once."""

import importlib
import re
import warnings
from argparse import SUPPRESS, Action
from typing import Any, NoReturn

from jsonargparse import ArgumentParser, DefaultHelpFormatter, Namespace
from jsonargparse.typing import restricted_number_type

import torchrod

from ..util.errors import InputError
from ..util.units import LENGTHS
from .arguments import MOST_STEPS, apart
from .screen import held_back, one_line, tell

IMPORTED = ("motive", "vicon", "qualisys", "trc", "c3d", "aurora", "toolbox", "fbgs", "luna", "wide", "line")
Steps = restricted_number_type("from 1 to 100,000", int, [(">=", 1), ("<=", MOST_STEPS)])


class _HelpFormatter(DefaultHelpFormatter):
    """The help text and, where there is one, the default; no Python types, which say nothing that the text does not."""

    def _get_help_string(self, action: Action) -> str:
        text = action.help or ""
        if text and (not action.option_strings or action.default in (None, False, SUPPRESS)):
            return text
        return f"{text} (default: %(default)s)" if text else super()._get_help_string(action)


class _Parser(ArgumentParser):
    """Bad arguments are bad input: one line, exit status 2."""

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, formatter_class=_HelpFormatter, **options)
        # argparse takes -1 and -0.5 for numbers, but -5e-4 for an option
        self._negative_number_matcher = re.compile(r"-(\d[\d_]*\.?\d*|\.\d+)(e[+-]?\d+)?$|-(inf|infinity|nan)$", re.IGNORECASE)

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        hint = "see torchrod --help"
        if "<class 'float'>" in message or "required" in message:
            hint += "; files come before options that take several values"
        raise InputError(f"{' '.join(str(message).split())} ({hint})") from ex


def _number_list(
    parser: ArgumentParser, name: str, help: str, count: int | str = "+", metavar: str | tuple[str, ...] | None = None
) -> None:
    parser.add_argument(name, type=float, nargs=count, metavar=metavar, help=help)


def _units(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--units", type=str, choices=list(LENGTHS), default=None, help="of the lengths in SHAPES; by default metres"
    )


def _tensions(parser: ArgumentParser) -> None:
    help = "TENSIONS.csv: time,tension_1,.. (s, N) at a rate of their own, matched to the samples' times"
    parser.add_argument("--tensions", type=str, default=None, help=help)


def _estimate_parser() -> ArgumentParser:
    parser = _Parser(
        description="Estimate where, which way and how hard a robot is pushed, from the measured positions of its markers."
    )
    parser.add_argument("robot", type=str, help="ROBOT.toml")
    parser.add_argument("shapes", type=str, help="SHAPES.csv or .npz: marker positions (m), base frame")
    _units(parser)
    parser.add_argument("--contacts", type=str, default=None, help="number of loads (1), or auto: as many as the data ask for")
    parser.add_argument(
        "--load-prior",
        type=str,
        choices=["point", "contact", "distributed", "smooth", "none", "auto"],
        default="contact",
        help="what is known of the width; smooth: one load of any form along the rod; auto: contact, distributed or smooth, as the "
        "data ask for",
    )
    drag = "friction of the contacts: each may drag along the rod by 0 +- MU times its force"
    parser.add_argument("--contact-friction", type=float, default=None, metavar="MU", help=drag)
    parser.add_argument("--axial", action="store_true", help="each load may drag along the rod by any force, whatever its friction")
    about = "std of a marker coordinate (m); auto: from the residual (default: as calibrated, else 1e-3)"
    parser.add_argument("--noise", type=str, default=None, help=about)  # None tells that nobody gave it
    along = "std of the arc lengths s of markers, each off by itself along the rod (m); else exact"
    parser.add_argument("--s-std", type=float, default=None, help=along)
    angle = "std of a measured orientation, about each axis (rad) (default: 0.01)"
    parser.add_argument("--angle-noise", type=float, default=None, help=angle)
    _number_list(parser, "--base-noise", "std of a measured base wrench (N, N m)", 2, ("FORCE", "MOMENT"))
    parser.add_argument("--curvature-noise", type=float, default=None, help="std of a measured curvature kx, ky (1/m)")
    _tensions(parser)
    parser.add_argument("--robust", action="store_true", help="let markers far off weigh little, and name them")
    parser.add_argument("--tension-std", type=float, default=None, help="std of the tensions' sensors (N); else exact")
    parser.add_argument("--warm-start", type=str, default="auto", help="auto: a learned start where one fits; off; or CHECKPOINT")
    parser.add_argument("--registration", action="store_true", help="also estimate a rigid error of the base frame")
    parser.add_argument("--one-frame", action="store_true", help="with --registration: it is the same in all samples")
    frame_std = "with --registration: std of the error (m, rad); by default 0.05 of the length and 10 degrees"
    _number_list(parser, "--frame-std", frame_std, 2, ("SHIFT", "TURN"))
    parser.add_argument(
        "--unknown-tip", type=str, choices=["none", "force", "wrench"], default="none", help="also estimate what acts on the tip"
    )
    _number_list(parser, "--location", "known locations of the loads (m), one per load")
    parser.add_argument(
        "--intervals",
        type=str,
        choices=["auto", "sampled", "gaussian"],
        default="auto",
        help="what the 95-percent intervals in RESULT come from: draws of the posterior (10 ms a shape, more where "
        "hypotheses compete) or the covariance; "
        "auto: draws for up to 1,000 samples of markers on a robot that is taken as exact, 100 where other sensors read or "
        "something at the tip or tensions are unknown (20 ms to 3 s a shape)",
    )
    parser.add_argument("--out", type=str, default=None, help="RESULT.json or RESULT.npz, or LOADS.csv: a row for each load")
    about = "whether RESULT has the load profiles and their bands; auto: up to 1,000 samples"
    parser.add_argument("--profile", type=str, choices=["auto", "on", "off"], default="auto", help=about)
    parser.add_argument("--plot", type=str, default=None, help="FIGURE.png of the first sample")
    parser.add_argument(
        "--steps",
        type=Steps,
        default=None,
        help="least number of steps along the rod; by default as many as the unloaded shape needs",
    )
    parser.add_argument("--max-iterations", type=int, default=100, help="give a sample up after this many")
    return parser


def _calibrate_parser() -> ArgumentParser:
    about = "What a robot's file does not say well enough, from shapes that only gravity, its tendons and known weights bend."
    parser = _Parser(description=about)
    parser.add_argument("robot", type=str, help="ROBOT.toml with gravity; its mass_per_length is the start, if positive")
    parser.add_argument("shapes", type=str, help="SHAPES.csv or .npz without external load, all of this robot")
    _units(parser)
    _tensions(parser)
    parser.add_argument("--noise", type=float, default=1e-3, help="standard deviation of a marker coordinate (m)")
    parser.add_argument("--youngs-modulus", action="store_true", help="also the stiffness, E and G together; needs tensions")
    parser.add_argument("--tension-offset", action="store_true", help="also one offset (N) per tendon, added to its readings")
    about = "further kinds of which nothing is known: friction, tendon_place, set, gravity, tension, frame"
    parser.add_argument("--free", type=str, nargs="+", action="extend", default=None, metavar="KIND", help=about)
    parser.add_argument("--hold-mass", action="store_true", help="take the mass per length as the file has it")
    about = "also by how much each marker is measured off, the same in all samples"
    parser.add_argument("--marker-offsets", action="store_true", help=about)
    about = "so many unknown loads on every shape; by default none, but for the weights that the shapes say hang there"
    parser.add_argument("--contacts", type=int, default=0, help=about)
    parser.add_argument("--out", type=str, default=None, help="CALIBRATED.toml: ROBOT.toml with the new values, comments kept")
    parser.add_argument("--json", type=str, default=None, help="RESULT.json")
    parser.add_argument("--max-iterations", type=int, default=100, help="give up after this many")
    return parser


def _observability_parser() -> ArgumentParser:
    parser = _Parser(description="What markers will see of a push along the rod, before any measurement, and where to put them.")
    parser.add_argument("robot", type=str, help="ROBOT.toml")
    parser.add_argument("--markers", type=int, default=None, help="number of markers, evenly spaced, the last at the tip (20)")
    _number_list(parser, "--at", "arc lengths of the markers (m), instead of --markers")
    parser.add_argument("--noise", type=float, default=1e-3, help="standard deviation of a marker coordinate (m)")
    parser.add_argument(
        "--force", type=float, default=None, help="the push (N); by default one that bends the rod visibly, 4 EI/L^2"
    )
    _number_list(parser, "--tension", "tensions T1 T2 ... (N), one per tendon")
    parser.add_argument("--registration", action="store_true", help="the base frame is not known either")
    parser.add_argument("--place", type=int, default=None, help="propose places for so many markers, instead of --markers")
    parser.add_argument(
        "--from", type=float, default=None, help="with --place: the push nearest the base (m); by default 0.1 of the length"
    )
    parser.add_argument(
        "--gap", type=float, default=None, help="with --place: least distance of markers (m); by default 0.02 of the length"
    )
    parser.add_argument("--out", type=str, default=None, help="FIGURE.png")
    parser.add_argument("--csv", type=str, default=None, help="TABLE.csv")
    parser.add_argument("--json", type=str, default=None, help="RESULT.json")
    return parser


def _simulate_parser() -> ArgumentParser:
    parser = _Parser(description="The shape of a robot under known loads, as marker positions.")
    parser.add_argument("robot", type=str, help="ROBOT.toml")
    parser.add_argument(
        "--point",
        nargs="+",
        action="append",
        metavar=("S FX FY", "FZ"),
        help="a point force at S (m) of FX FY, and FZ along the rod (N, section frame); repeatable",
    )
    _number_list(parser, "--tip-force", "a force at the tip (N, base frame)", 3, ("X", "Y", "Z"))
    _number_list(parser, "--tip-moment", "a moment at the tip (N m, base frame)", 3, ("X", "Y", "Z"))
    _number_list(parser, "--tension", "tensions T1 T2 ... (N)")
    _number_list(parser, "--displacement", "instead: how far each tendon is pulled out D1 D2 ... (m); a slack one carries nothing")
    parser.add_argument("--markers", type=int, default=None, help="number of markers, evenly spaced, the last at the tip (20)")
    _number_list(parser, "--at", "arc lengths of the markers (m), instead of --markers")
    parser.add_argument("--noise", type=float, default=0.0, help="standard deviation added to every coordinate (m)")
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    parser.add_argument("--steps", type=Steps, default=None, help="arc-length steps, instead of as many as 5e-6 of the length take")
    parser.add_argument("--out", type=str, required=True, help="SHAPE.csv")
    return parser


def _dataset_parser() -> ArgumentParser:
    parser = _Parser(description="Shapes of random known loads, by the million: a folder of shards that can be resumed and shared.")
    parser.add_argument("spec", type=str, help="DATASET.toml: robots, loads and markers to draw from")
    parser.add_argument("--out", type=str, required=True, help="FOLDER; shards that are there and sound are kept")
    parser.add_argument("--samples", type=int, default=None, help="number of samples, instead of the file's")
    parser.add_argument("--seed", type=int, default=None, help="instead of the file's")
    parser.add_argument("--shard", type=str, default=None, metavar="I/N", help="only shards I, I + N, ...: one of N jobs, I from 0")
    parser.add_argument(
        "--workers", type=int, default=None, help="processes on this machine; by default as many as torch has threads, one per core"
    )
    parser.add_argument("--scheduler", type=str, default=None, help="tcp://HOST:PORT of a dask cluster, instead of this machine")
    return parser


def _import_parser() -> ArgumentParser:
    parser = _Parser(description="Shapes from a file of a measuring system, in the robot's base frame.")
    parser.add_argument("format", type=str, choices=IMPORTED, help="what wrote it; wide, line: tables of frames, of points")
    parser.add_argument("file", type=str, help="the file, as it was exported")
    parser.add_argument("--robot", type=str, required=True, help="ROBOT.toml")
    parser.add_argument("--layout", type=str, required=True, help="LAYOUT.toml: which name is what on the robot")
    _tensions(parser)
    parser.add_argument("--out", type=str, required=True, help="SHAPES.csv or .npz")
    return parser


def _plot_parser() -> ArgumentParser:
    parser = _Parser(description="Draw one sample of an estimate.")
    parser.add_argument("robot", type=str, help="ROBOT.toml")
    parser.add_argument("shapes", type=str, help="the shapes that were estimated")
    _units(parser)
    parser.add_argument("result", type=str, help="RESULT.json or .npz of torchrod estimate")
    _tensions(parser)
    parser.add_argument("--sample", type=str, default=None, help="which sample; the first by default")
    parser.add_argument("--out", type=str, required=True, help="FIGURE.png")
    return parser


def _build_parser() -> ArgumentParser:
    about = "Compile the kernel for this machine, which the first estimate would do otherwise (about 20 s, needs a C++ compiler)."
    return _Parser(description=about)


COMMANDS = {
    "estimate": (_estimate_parser, "loads from marker positions"),
    "calibrate": (_calibrate_parser, "what the robot file does not say well enough, from shapes under known loads"),
    "observability": (_observability_parser, "what markers will see, and where to put them"),
    "simulate": (_simulate_parser, "marker positions from known loads"),
    "simulate-dataset": (_dataset_parser, "many shapes of random loads, for learning and studies"),
    "import": (_import_parser, "shapes from files of motion capture, trackers and fibres"),
    "plot": (_plot_parser, "a figure of an estimate"),
    "build": (_build_parser, "compile the kernel before it is needed"),
}


HOMES = {"simulate-dataset": "simulate", "import": "lab_import"}  # commands that share a module, or have a word of Python's as name
FUNCTIONS = {"import": "lab_import"}


def _parser() -> ArgumentParser:
    about = "Forces from shape: the loads on a continuum robot from its measured markers."
    parser = _Parser(prog="torchrod", description=about, version=torchrod.__version__)
    commands = parser.add_subcommands(required=True)
    for name, (make, help) in COMMANDS.items():
        commands.add_subcommand(name, make(), help=help)
    return parser


def _run(options: Namespace) -> None:
    name = str(options.subcommand)
    home = importlib.import_module(f".{HOMES.get(name, name)}", __package__)
    apart(options[name])
    getattr(home, FUNCTIONS.get(name, name.replace("-", "_")))(options[name])


def main(arguments: list[str] | None = None) -> int:
    """The command `torchrod`. Exit status 0 when it did its work, 2 with one line on stderr for bad input, 130 when interrupted.

    What a command prints is held back until its files are written: a screen that cannot take it loses no result.
    """
    said: set[str] = set()

    def warned(message: Warning | str, *_: object) -> None:
        line = one_line(f"torchrod: warning: {message}")
        if line not in said:  # 600 samples may each find the same wrong with one file
            said.add(line)
            tell(line)

    try:
        with warnings.catch_warnings(), held_back():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = warned
            _run(_parser().parse_args(arguments))
    except InputError as error:
        tell(one_line(f"torchrod: {error}"))
        return 2
    except KeyboardInterrupt:
        tell("torchrod: interrupted")
        return 130
    return 0
