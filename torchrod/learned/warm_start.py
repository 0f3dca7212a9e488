"""Learned starts: which checkpoint fits a model, and what it predicts as a Start for torchrod.estimate."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..estimation.at_rest import at_rest
from ..estimation.starts import Origin, Start, cold_from, cold_start
from ..mechanics.rod import Rod
from ..model.load_families import GaussianCoordinates
from ..model.problem import Problem
from ..model.sensors import Markers
from ..util.errors import InputError
from .features import Features, features, is_active, noise_of, prior_log_c
from .network import PER_LOAD, Network, load_checkpoint, turn_of_gamma

SLACK = 1.001  # on a stated range: 0.1 mm on 0.4 m is 2.5e-4 but for round-off
INFLATION = 10.0  # of the predicted covariance: on cases it has not seen a network errs more than it thinks
SPREAD = (1.0, 1e4)  # what Sigma0 has at least in every direction, and at most in all
PACKAGE = Path(__file__).resolve().parents[1]
FOLDERS = (PACKAGE.parent / "checkpoints", PACKAGE / "checkpoints")  # of a source tree, of an installed package


@dataclass(frozen=True)
class WarmStart:
    """A learned start, to be given to torchrod.estimate as `start`: a network, and the card of what it knows.

    predicted_spread: let the filter begin with the network's own covariance of gamma instead of the settings' Sigma0; by default
    as the card has it, which is as it did better (docs/training.md). strict: refuse what the network was not trained for, instead
    of starting cold there. Errors: InputError, when it is called with a problem it was not trained for.
    """

    network: Network
    card: dict[str, Any]
    predicted_spread: bool = False
    strict: bool = True

    @classmethod
    def read(cls, path: str | Path) -> "WarmStart":
        """From NAME.safetensors with NAME.json beside it. Errors: InputError in one sentence."""
        network, card = load_checkpoint(Path(path))
        try:
            _ = [card[key] for key in ("name", "contacts", "load_priors", "active", "tendons", "predicted_spread")]
            _ = [len(card["range"][key]) for key in RANGES]
        except (KeyError, TypeError) as error:
            raise InputError(f"{path}: its card lacks {error}; train it again") from None
        return cls(network, card, bool(card["predicted_spread"]))

    def misfit(self, problem: Problem, measured: bool = True) -> str | None:
        """Why this start cannot serve a problem, in one sentence; None where it can. measured=False leaves the readings aside."""
        reason = _unknowns_misfit(self.card, problem) or _robot_misfit(self.card, problem)
        markers = problem.markers
        if reason is not None or not measured or markers is None:
            return reason
        return _noise_misfit(self.card, noise_of(markers) / problem.robot.rod.length) or _markers_misfit(self.card, markers)

    def known(self, problem: Problem, read: Features) -> Bool[Tensor, " B"]:
        """Samples whose bend and number of markers lie in the range that was learned."""
        (low, high), (fewest, most) = self.card["range"]["amp"], self.card["range"]["markers_seen"]
        inside = (read.amp >= low) & (read.amp <= high) & (read.seen >= fewest) & (read.seen <= most)
        return inside if problem.tension is None else inside & torch.isfinite(problem.tension).all(-1)

    def __call__(self, problem: Problem) -> Start:
        """gamma from the network, alpha from the equilibrium under it; cold where the sample lies outside of what was learned.

        Errors: InputError if strict, where the checkpoint does not fit the robot, the unknowns or the noise at all.
        """
        markers = problem.markers
        reason = self.misfit(problem, False)
        if reason is None and markers is not None:
            reason = _noise_misfit(self.card, noise_of(markers) / problem.robot.rod.length)
        if reason is not None and self.strict:
            raise InputError(f"checkpoint {self.card['name']}: {reason}")
        if reason is not None or markers is None or markers.offsets is not None:
            return cold_start(problem)
        read = features(problem)
        warm, at = self.known(problem, read), problem.state.loads.at
        index, cold = warm.nonzero().squeeze(-1), cold_from(problem, read.alpha)
        origin = torch.where(warm, int(Origin.LEARNED), int(Origin.COLD))
        if not len(index):
            return Start(cold, origin, warm)
        part, seen = (read, problem) if len(index) == len(warm) else (read.take(index), problem.take(index))
        gamma, spread = self.guess(problem, part)
        rest = at_rest(seen, gamma, part.q_tip)
        guessed = problem.state.join(gamma, rest.wrench.nan_to_num(0.0))
        x, costs = cold.index_copy(0, index, guessed), cold.new_zeros(len(cold), 2)
        costs[index] = _costs(seen, torch.stack([guessed, cold[index]], 1), torch.stack([rest.p, part.p0], 1))
        if spread is None:
            return Start(x, origin, warm, None, cold, costs)
        Sigma0 = torch.eye(problem.size, dtype=x.dtype).repeat(len(x), 1, 1)
        Sigma0[index, at, at] = spread
        return Start(x, origin, warm, Sigma0, cold, costs)

    def guess(self, problem: Problem, read: Features) -> tuple[Float[Tensor, "B g"], Float[Tensor, "B g g"] | None]:
        """What the network says of features: gamma, and its covariance if that is to be believed; in the section frame."""
        loads = problem.unknowns.loads
        assert isinstance(loads, GaussianCoordinates)
        turn = turn_of_gamma(read.turn, loads.count)
        log_c = torch.full_like(read.amp, prior_log_c(problem))
        if not self.predicted_spread:
            return loads.with_drag(_turned(turn, self.network.guess(read.x, read.amp, log_c))), None
        prediction = self.network(read.x, read.amp, log_c)
        known = loads.with_drag(torch.arange(1, 1 + PER_LOAD * loads.count)).nonzero().squeeze(-1)
        spread = torch.eye(loads.size, dtype=read.amp.dtype).repeat(len(read.amp), 1, 1)
        spread[:, known.unsqueeze(-1), known] = turn.mT @ bounded(prediction.covariance) @ turn
        return loads.with_drag(_turned(turn, prediction.gamma)), spread


def _turned(turn: Float[Tensor, "B g g"], gamma: Float[Tensor, "B g"]) -> Float[Tensor, "B g"]:
    return (turn.mT @ gamma.unsqueeze(-1)).squeeze(-1)


def bounded(covariance: Float[Tensor, "B n n"]) -> Float[Tensor, "B n n"]:
    """Times INFLATION, plus SPREAD[0] in every direction, with a trace of no more than SPREAD[1]: it can be inverted."""
    trace = covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
    wide = (SPREAD[1] / trace).clamp(max=INFLATION)[:, None, None] * covariance
    wide.diagonal(dim1=-2, dim2=-1).add_(SPREAD[0])
    return wide


def _costs(problem: Problem, x: Float[Tensor, "B k n"], p: Float[Tensor, "B k P 3"]) -> Float[Tensor, "B k"]:
    """The cost of (3) with the prior's at k states x, whose markers p (m) in equilibrium are known: there is no tip residual."""
    markers = problem.markers
    assert markers is not None
    square = (markers.positions.unsqueeze(1) - p).square().sum(-1)
    own = markers.deviation
    own = own * own
    if isinstance(own, Tensor) and own.shape[-1] > 1:  # each marker has its own
        square, own = square / own.unsqueeze(1), 1.0
    seen = torch.where(markers.present.unsqueeze(1), square, 0.0).sum(-1)
    mean, precision = problem.mean.unsqueeze(-2), problem.precision.unsqueeze(-2)
    return seen / own + (precision * (mean - x) ** 2).sum(-1)


RANGES = ("amp", "noise_over_length", "markers_seen", "shear_over_bending", "torsion_over_bending")


def _unknowns_misfit(card: dict[str, Any], problem: Problem) -> str | None:
    unknowns, coordinates = problem.unknowns, problem.unknowns.loads
    if problem.markers is None:
        return "it reads markers, and here other sensors were read as well"
    if not problem.markers.alike:
        return "it knows one noise for all markers of a sample; start cold where each has its own, or uncertain arc lengths"
    if not isinstance(coordinates, GaussianCoordinates) or not unknowns.scaled:
        return "it knows Gaussian loads in scaled coordinates only"
    if coordinates.locations is not None:
        return "it predicts locations, and here they are known; leave out --location or --warm-start"
    if unknowns.registration is not None:
        return "it was not trained with a registration error; leave out --registration or --warm-start"
    if unknowns.tension_std is not None:
        return "it was trained with tensions that are known; leave out --tension-std or --warm-start"
    if unknowns.tip != "none":
        return "it was not trained with an unknown force at the tip; leave out --unknown-tip or --warm-start"
    if coordinates.count != card["contacts"]:
        return f"it was trained for {card['contacts']} loads, and here are {coordinates.count}"
    if coordinates.prior_name not in card["load_priors"]:
        return f"it was trained with the load priors {', '.join(card['load_priors'])}, not {coordinates.prior_name}"
    return None


def _robot_misfit(card: dict[str, Any], problem: Problem) -> str | None:
    robot, rod = problem.robot, problem.robot.rod
    if is_active(robot) != card["active"]:
        return "it was trained " + ("for" if card["active"] else "without") + " tendons and weight, unlike this robot"
    least, most = card["tendons"]
    if card["active"] and len(robot.tendons) > most:
        return f"it was trained with {least} to {most} tendons, and the robot has {len(robot.tendons)}"
    if rod.pieces is not None or len(rod.masses):
        return "it knows rods of one section without masses on them only"
    if robot.tendons.friction is not None:
        return "it knows tendons without friction only"
    if any(t.discs for t in robot.tendons.tendons):
        return "it knows tendons that follow the rod only, not from disc to disc"
    if not _round_and_straight(rod):
        return "it knows straight rods that bend alike in all directions only"
    ratios = {
        "shear_over_bending": float(rod.K_se[0, 0]) * rod.length**2 / rod.bending_stiffness,
        "torsion_over_bending": float(rod.K_bt[2, 2]) / rod.bending_stiffness,
    }
    for key, value in ratios.items():
        if not _within(value, card["range"][key]):
            return f"it was trained for a {key.replace('_', ' ')} ratio in {card['range'][key]}, and here it is {value:.3g}"
    return None


def _noise_misfit(card: dict[str, Any], noise: float) -> str | None:
    low, high = card["range"]["noise_over_length"]
    if _within(noise, (low, high)):
        return None
    return f"it was trained with a noise of {low:g} to {high:g} of the rod's length, and here it is {noise:.3g}"


def _markers_misfit(card: dict[str, Any], markers: Markers) -> str | None:
    """Judges the whole: a sample that alone has too few markers starts cold."""
    if markers.offsets is not None:
        return "it knows markers on the centre line only"
    fewest, most = card["range"]["markers_seen"]
    seen = markers.present.sum(-1)
    if bool(((seen >= fewest) & (seen <= most)).any()):
        return None
    return f"it was trained with {fewest} to {most} markers seen, and here are at most {int(seen.max())}"


def _within(value: float, limits: tuple[float | None, float | None]) -> bool:
    low, high = limits
    return (low is None or value * SLACK >= low) and (high is None or value <= high * SLACK)


def _round_and_straight(rod: Rod) -> bool:
    """No reference curvature, and a section without a weak side."""
    level = 0.01 * rod.bending_stiffness
    even = (rod.K_bt - torch.diag(torch.stack([rod.K_bt[0, 0], rod.K_bt[0, 0], rod.K_bt[2, 2]]))).abs().max() <= level
    return bool(even) and not bool(rod.reference_curvature[:, 1:].any())


@lru_cache(maxsize=1)
@torch.inference_mode(False)  # they outlive the first call
def shipped() -> tuple[WarmStart, ...]:
    """The checkpoints that come with torchrod, beside the package or within it. They start cold what they do not know."""
    folder = next((f for f in FOLDERS if any(f.glob("*.safetensors"))), None)
    paths = [] if folder is None else sorted(folder.glob("*.safetensors"))
    return tuple(replace(WarmStart.read(path), strict=False) for path in paths)


def find_warm_start(problem: Problem) -> WarmStart | None:
    """The shipped checkpoint that fits a problem's robot and unknowns, or None: then every start is cold."""
    return next((start for start in shipped() if start.misfit(problem, False) is None), None)
