"""The hidden layers of a perceptron by the compiled kernel: mlp.h. Each sample's numbers are its own, whatever its batch."""

import ctypes

import torch
from jaxtyping import Float
from torch import Tensor

from . import structures
from .fitting import run
from .structures import fill


class Perceptron:
    """Layers y = GELU(W x + b), of an input that is centred, scaled and clipped at +- largest; all float64."""

    def __init__(self, layers: list[torch.nn.Linear], mean: Float[Tensor, " i"], std: Float[Tensor, " i"], largest: float):
        sizes = [layers[0].in_features, *(layer.out_features for layer in layers)]
        parts = [part for layer in layers for part in (layer.weight.detach().mT.reshape(-1), layer.bias.detach())]
        self._held = {"sizes": torch.tensor(sizes), "mean": mean.contiguous(), "std": std.contiguous(), "weights": torch.cat(parts)}
        self._structure, self.outputs = structures.Perceptron(), sizes[-1]
        fill(self._structure, self._held, {"depth": len(layers), "largest": largest})

    def __call__(self, x: Float[Tensor, "B i"]) -> Float[Tensor, "B o"]:
        """The last layer's output."""
        x, y = x.contiguous(), x.new_empty(len(x), self.outputs)
        addresses = [ctypes.c_void_p(t.data_ptr()) for t in (x, y)]
        run("torchrod_perceptron", len(x), ctypes.byref(self._structure), addresses[0], ctypes.c_int64(len(x)), addresses[1])
        return y
