"""What is learned, and by which measure."""

from typing import Any

import torch
from lightning import LightningModule
from torch import Tensor

from torchrod.learned.features import ACTIVE_SIZE, PASSIVE_SIZE
from torchrod.learned.network import Network, Prediction

from .data import ShapeData

STD_LEAST = 1e-3
QUANTILES = (0.25, 0.5, 0.75, 0.95)


class WarmStartModule(LightningModule):
    """The network of torchrod.learned.network, trained by AdamW under a one-cycle schedule.

    (1)  loss = mean log(1 + d^T M d) + NLL,    d = predicted - target gamma, M the information on gamma: what the error costs
                                                the filter in chi^2, on a scale on which the worst cases do not drown the rest
    (2)  NLL = |U^T D^-1 d|^2 / 2 - sum log U_ii  with d held fixed: it trains the spread only
    """

    def __init__(self, width: int = 128, depth: int = 3, learning_rate: float = 2e-3, weight_decay: float = 1e-4):
        super().__init__()
        self.save_hyperparameters()
        self.network: Network | None = None

    @property
    def data(self) -> ShapeData:
        """The cases."""
        return self.trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]

    def configure_model(self) -> None:
        """The sizes of input and output, and the scale of the input, come from the data."""
        if self.network is not None:
            return
        recipe, x = self.data.recipe, self.data.train["x"]
        inputs = ACTIVE_SIZE if recipe.tendons[1] or recipe.weight else PASSIVE_SIZE
        self.network = Network(inputs, recipe.contacts, self.hparams["width"], self.hparams["depth"]).float()
        self.network.mean.copy_(x.mean(0))
        self.network.std.copy_(x.std(0) + STD_LEAST)

    def forward(self, x: Tensor, amp: Tensor, log_c: Tensor) -> Prediction:
        """gamma and its spread."""
        assert self.network is not None
        return self.network(x, amp, log_c)

    def _losses(self, batch: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """d^T M d per case, and the two terms of (1)."""
        x, amp, log_c, target, M, _ = batch
        prediction = self(x, amp, log_c)
        error = prediction.gamma - target
        excess = torch.einsum("bi,bij,bj->b", error, M, error)
        z = prediction.whitened(error.detach())
        nll = 0.5 * z.square().sum(-1) - prediction.U.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return excess, torch.log1p(excess).mean(), nll.mean()

    def training_step(self, batch: list[Tensor]) -> Tensor:
        """(1)."""
        _, cost, nll = self._losses(batch)
        self.log_dict({"train/cost": cost, "train/nll": nll}, on_step=False, on_epoch=True)
        return cost + nll

    def validation_step(self, batch: list[Tensor]) -> None:
        """The terms of (1), and quantiles of the excess cost."""
        excess, cost, nll = self._losses(batch)
        levels = excess.new_tensor(QUANTILES)
        quantiles = dict(zip((f"held_out/excess_{q:g}" for q in QUANTILES), excess.quantile(levels), strict=True))
        self.log_dict({"held_out/cost": cost, "held_out/nll": nll, **quantiles}, batch_size=len(excess))

    def configure_optimizers(self) -> Any:
        """AdamW, one cycle over the whole run, stepped per batch."""
        optimizer = torch.optim.AdamW(self.parameters(), self.hparams["learning_rate"], weight_decay=self.hparams["weight_decay"])
        total = int(self.trainer.estimated_stepping_batches)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, self.hparams["learning_rate"], total, pct_start=0.1)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
