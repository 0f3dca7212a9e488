"""The hidden layers of a perceptron by the compiled kernel: mlp.h. Each sample's numbers are its own, whatever its batch."""

import ctypes

import torch
from jaxtyping import Float
from torch import Tensor

from . import structures
from .fitting import run
from .structures import fill

OUT = 4  # of mlp.h


def _packed(layer: torch.nn.Linear, into: int) -> Float[Tensor, " m"]:
    """Bias and weights as mlp.h has them, filled up with zeros to `into` inputs and a multiple of OUT outputs."""
    w = torch.cat([layer.bias.detach().unsqueeze(-1), layer.weight.detach()], -1)
    w = torch.nn.functional.pad(w, (0, into + 1 - w.shape[1], 0, -len(w) % OUT))
    return w.unflatten(0, (-1, OUT)).mT.reshape(-1)


class Perceptron:
    """Layers y = GELU(W x + b), in single precision."""

    def __init__(self, layers: list[torch.nn.Linear]):
        sizes = [layers[0].in_features, *(layer.out_features + -layer.out_features % OUT for layer in layers)]
        parts = [_packed(layer, into) for layer, into in zip(layers, sizes, strict=False)]
        self._held = {"sizes": torch.tensor(sizes), "weights": torch.cat(parts).float()}
        self._structure, self._padded, self.outputs = structures.Perceptron(), sizes[-1], layers[-1].out_features
        fill(self._structure, self._held, {"depth": len(layers)})

    def __call__(self, x: Float[Tensor, "B i"]) -> Float[Tensor, "B o"]:
        """The last layer's output, in the precision of the input."""
        given = x.float().contiguous()
        y = given.new_empty(len(x), self._padded)
        addresses = [ctypes.c_void_p(t.data_ptr()) for t in (given, y)]
        run("torchrod_perceptron", len(x), ctypes.byref(self._structure), addresses[0], ctypes.c_int64(len(x)), addresses[1])
        return y[:, : self.outputs].to(x.dtype)
