"""The network of a learned start, and its file: safetensors weights beside a JSON card.

Per load, from the features of learned.features, in the canonical frame:

(1)  F = amp o_F / (2 S(eta)^1.5),    eta = o_eta,    log c = prior mean + o_c

     A force F at mu L bends the rod to an rms curvature in proportion to F mu^1.5, which (1) takes out of what has to be learned.

(2)  The error of (1) is taken as normal: U^T D^-1 (gamma - gamma_true) ~ N(0, I), D = diag(F's factor in (1) twice, 1, 1) per load,
     U lower triangular with a positive diagonal, from a second head that does not reach back into the first.
"""

import hashlib
import json
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from .. import kernel
from ..util.errors import InputError, shown
from ..util.files import reading

SCHEMA = 1  # of the card
PER_LOAD = 4
ETA_LARGEST = 6.0
INPUT_LARGEST = 8.0  # standard deviations: beyond them the network has seen nothing
LOG_DIAGONAL = 6.0
SPREAD_WIDTH = 64
CLOSED = ("tendons", "amp", "markers_seen")  # ranges of a card with both limits; others may be open
SIZES = ("inputs", "count", "width", "depth")


@dataclass(frozen=True)
class Prediction:
    """gamma (B, 4 K) in the canonical frame; D (B, 4 K) and U (B, 4 K, 4 K) of (2)."""

    gamma: Float[Tensor, "B n"]
    D: Float[Tensor, "B n"]
    U: Float[Tensor, "B n n"]

    def whitened(self, error: Float[Tensor, "B n"]) -> Float[Tensor, "B n"]:
        """U^T D^-1 error."""
        return ((error / self.D).unsqueeze(-2) @ self.U).squeeze(-2)

    @property
    def covariance(self) -> Float[Tensor, "B n n"]:
        """D U^-T U^-1 D."""
        eye = torch.eye(self.U.shape[-1], dtype=self.U.dtype).expand_as(self.U)
        root = self.D.unsqueeze(-1) * torch.linalg.solve_triangular(self.U.mT, eye, upper=True)
        return root @ root.mT


class Network(torch.nn.Module):
    """An MLP with GELU, from features (B, inputs) to a Prediction for `count` loads."""

    mean: Tensor
    std: Tensor

    def __init__(self, inputs: int, count: int, width: int, depth: int):
        super().__init__()
        self.inputs, self.count, self.width, self.depth = inputs, count, width, depth
        n = PER_LOAD * count
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("std", torch.ones(inputs))
        sizes = [inputs] + [width] * depth
        layers = [m for i in range(depth) for m in (torch.nn.Linear(sizes[i], sizes[i + 1]), torch.nn.GELU())]
        self.body = torch.nn.Sequential(*layers)
        self.head = torch.nn.Linear(width, n)
        spread = torch.nn.Linear(SPREAD_WIDTH, n * (n + 1) // 2)
        self.spread = torch.nn.Sequential(torch.nn.Linear(width, SPREAD_WIDTH), torch.nn.GELU(), spread)
        with torch.no_grad():  # begin evenly spread along the rod, with hardly any force
            places = torch.logit((torch.arange(count) + 1.0) / (count + 1))
            self.head.weight.mul_(0.1)
            self.head.bias.copy_(torch.nn.functional.pad(places.unsqueeze(-1), (2, 1)).flatten())

    def forward(self, x: Float[Tensor, "B i"], amp: Float[Tensor, " B"], log_c: Float[Tensor, " B"]) -> Prediction:
        """amp (B,) as in Features, log_c (B,) the prior mean of log(c L^2)."""
        z = self.hidden(x)
        gamma, unit = self._gamma(z, amp, log_c)
        one = torch.ones_like(unit)
        D = torch.cat([unit, unit, one, one], -1).flatten(1).detach()
        n = gamma.shape[-1]
        rows, columns = torch.tril_indices(n, n)
        U = gamma.new_zeros(len(x), n, n)
        U[:, rows, columns] = self.spread(z.detach())
        diagonal = U.diagonal(dim1=-2, dim2=-1).clamp(-LOG_DIAGONAL, LOG_DIAGONAL).exp()
        return Prediction(gamma, D, U.tril(-1) + torch.diag_embed(diagonal))

    def guess(self, x: Float[Tensor, "B i"], amp: Float[Tensor, " B"], log_c: Float[Tensor, " B"]) -> Float[Tensor, "B n"]:
        """gamma alone."""
        return self._gamma(self.hidden(x), amp, log_c)[0]

    def hidden(self, x: Float[Tensor, "B i"]) -> Float[Tensor, "B width"]:
        """The last hidden layer: by the compiled kernel where it serves and no derivative is wanted."""
        plain = x.dtype == self.mean.dtype == torch.float64 and x.device.type == "cpu"
        if plain and not self.head.weight.requires_grad and not x.requires_grad and kernel.available():
            return self._compiled(tuple(0 if p.is_inference() else p._version for p in self.body.parameters()))(self._scaled(x))
        return self.body(self._scaled(x))

    def _scaled(self, x: Float[Tensor, "B i"]) -> Float[Tensor, "B i"]:
        return ((x - self.mean) / self.std).clamp(-INPUT_LARGEST, INPUT_LARGEST)

    @lru_cache(maxsize=8)  # noqa: B019 - a handful of networks, kept with their copies
    def _compiled(self, versions: tuple[int, ...]) -> kernel.Perceptron:
        """A copy of the weights as they are now; versions: changed with them."""
        return kernel.Perceptron([m for m in self.body if isinstance(m, torch.nn.Linear)])

    def _gamma(
        self, z: Float[Tensor, "B width"], amp: Float[Tensor, " B"], log_c: Float[Tensor, " B"]
    ) -> tuple[Float[Tensor, "B n"], Float[Tensor, "B k 1"]]:
        """(1), and F's factor in it."""
        o = self.head(z).unflatten(-1, (self.count, PER_LOAD))
        eta = o[..., 2:3].clamp(-ETA_LARGEST, ETA_LARGEST)
        unit = 0.5 * amp[:, None, None] / torch.sigmoid(eta) ** 1.5
        return torch.cat([unit * o[..., :2], eta, o[..., 3:] + log_c[:, None, None]], -1).flatten(1), unit


def turn_of_gamma(turn: Float[Tensor, "B 2 2"], count: int) -> Float[Tensor, "B n n"]:
    """The orthogonal matrix that takes gamma of `count` loads from the section frame to the canonical one: F turns."""
    out = torch.eye(PER_LOAD * count, dtype=turn.dtype).repeat(len(turn), 1, 1)
    for first in range(0, PER_LOAD * count, PER_LOAD):
        out[:, first : first + 2, first : first + 2] = turn
    return out


def digest(path: Path) -> str:
    """sha256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def save_checkpoint(path: Path, network: Network, card: dict[str, Any]) -> None:
    """Write NAME.safetensors and NAME.json; the card gains the network's sizes and the weights' sha256."""
    state = {name: value.detach().cpu().float().contiguous() for name, value in network.state_dict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(state, path)
    path.chmod(0o644)  # safetensors leaves it to its owner alone, and an installed package is read by all
    sizes = {key: getattr(network, key) for key in SIZES}
    full = {"schema": SCHEMA, "name": path.stem, **card, "network": sizes, "sha256": digest(path)}
    path.with_suffix(".json").write_text(json.dumps(full, indent=1) + "\n", encoding="utf-8")


def numbers_in(inputs: int, count: int, width: int, depth: int) -> int:
    """How many numbers a Network of these sizes holds, mean and std of its inputs included."""
    n = PER_LOAD * count
    body = (inputs + 1) * width + (depth - 1) * (width + 1) * width
    return 2 * inputs + body + (width + 1) * n + (width + 1) * SPREAD_WIDTH + (SPREAD_WIDTH + 1) * (n * (n + 1) // 2)


def _check_card(card: dict[str, Any]) -> None:
    """Every entry of a card that the library reads, by its type. Errors: ValueError, KeyError."""

    def of(name: str, value: object, kind: type | tuple[type, ...], least: float = -math.inf) -> None:
        flag = isinstance(value, bool) and kind is not bool
        small = isinstance(value, int | float) and not value >= least
        if not isinstance(value, kind) or flag or small:
            raise ValueError(f"its card has {shown(value)} for {name}")

    sizes = card["network"]
    of("network", sizes, dict)
    for key in SIZES:
        of(f"network.{key}", sizes[key], int, least=1)
    kinds = {"name": str, "contacts": int, "load_priors": list, "active": bool, "tendons": list, "predicted_spread": bool}
    for key, kind in kinds.items():
        if key in card:
            of(key, card[key], kind)
    for prior in card.get("load_priors", []):
        of("load_priors", prior, str)
    ranges = {"tendons": card.get("tendons", [0, 0]), **_table(card.get("range", {}))}
    for key, limits in ranges.items():
        of(key, limits, list)
        if len(limits) != 2:
            raise ValueError(f"its card has {shown(limits)} for {key}, not two limits")
        for limit in limits:
            of(key, limit, (int, float) if key in CLOSED else (int, float, type(None)))


def _table(value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"its card has {shown(value)} for range")
    return value


def load_checkpoint(path: Path) -> tuple[Network, dict[str, Any]]:
    """The network, in float64 for evaluation, and its card. Errors: InputError in one sentence for what is damaged or foreign.

    The weights are float32 numbers; evaluated in float64, a sample's answer does not depend on how the batch was blocked.
    """
    for file in (path, path.with_suffix(".json")):
        with reading(file):
            if not file.is_file():
                raise InputError(f"{file}: no such file; a checkpoint is NAME.safetensors with NAME.json beside it")
            file.open("rb").close()
    try:
        card = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        if card["schema"] != SCHEMA:
            raise InputError(f"{path}: its card has schema {card['schema']}, this version reads {SCHEMA}; train it again")
        if card["sha256"] != digest(path):
            raise InputError(f"{path}: is not the file that its card describes; fetch or train it again")
        _check_card(card)
        sizes = {key: card["network"][key] for key in SIZES}
        least = 4 * numbers_in(**sizes)
        if least > path.stat().st_size:  # before it takes memory for a network that is not there
            raise ValueError(f"its card tells of a network of {least} bytes, and the file has {path.stat().st_size}")
        network = Network(**sizes)
        network.load_state_dict(load_file(path))
    except InputError:
        raise
    except (
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        ArithmeticError,
        MemoryError,
        RuntimeError,
        OSError,
        SafetensorError,
    ) as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: is not a checkpoint of torchrod ({reason}); train one with training.train") from None
    return network.double().eval().requires_grad_(False), card
