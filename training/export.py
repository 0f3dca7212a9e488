"""At the end of a run: the checkpoint that torchrod reads, its card, and the curves."""

import csv
import sys
from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import CSVLogger
from matplotlib.figure import Figure

import torchrod
from torchrod.learned.network import save_checkpoint

from .data import ShapeData
from .module import WarmStartModule

TAIL = 1e-3  # of the cases on either side lie outside the card's range of amp


class Export(Callback):
    """Writes FOLDER/NAME.safetensors and NAME.json, and the curves as curves.png beside the log.

    predicted_spread: whether the filter is to start with the covariance that the network predicts.
    """

    def __init__(self, name: str, folder: str = "checkpoints", predicted_spread: bool = False):
        self.path, self.predicted_spread = Path(folder) / f"{name}.safetensors", predicted_spread

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Once, by the first process."""
        if not trainer.is_global_zero:
            return
        assert isinstance(pl_module, WarmStartModule) and pl_module.network is not None
        save_checkpoint(self.path, pl_module.network, {**card(trainer, pl_module.data), "predicted_spread": self.predicted_spread})
        if isinstance(trainer.logger, CSVLogger):
            trainer.logger.save()
            draw_curves(Path(trainer.logger.log_dir))


def card(trainer: Trainer, data: ShapeData) -> dict[str, Any]:
    """What the network has seen, and how it did on what it has not; everything a misfit is judged by."""
    recipe, amp, seen = data.recipe, data.train["amp"], data.train["seen"]
    measured = {name.removeprefix("held_out/"): float(v) for name, v in trainer.callback_metrics.items() if "held_out/" in name}
    levels = amp.new_tensor([TAIL, 1 - TAIL]).to(amp.dtype)
    return {
        "torchrod": torchrod.__version__,
        "command": "python -m training.train " + " ".join(sys.argv[1:]),
        "seed": recipe.seed,
        "recipe": recipe.record(),
        "cases": len(amp),
        "epochs": trainer.current_epoch,
        "range": {
            "amp": amp.quantile(levels).tolist(),
            "noise_over_length": list(recipe.noise),
            "markers_seen": [int(seen.min()), int(seen.max())],
            "shear_over_bending": [2000.0, None],
            "torsion_over_bending": [0.6, 1.0],
        },
        "contacts": recipe.contacts,
        "load_priors": sorted(set(recipe.priors)),
        "tendons": list(recipe.tendons),
        "active": bool(recipe.tendons[1] or recipe.weight),
        "held_out": measured,
    }


def draw_curves(folder: Path) -> None:
    """curves.png from metrics.csv."""
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    figure = Figure(figsize=(9, 3.5), layout="constrained")
    for axes, what, label in zip(
        figure.subplots(1, 2), ("cost", "nll"), ("mean log(1 + excess cost)", "NLL of the error"), strict=True
    ):
        for part, colour in (("train", "#1b2a41"), ("held_out", "#c8102e")):
            points = [(int(r["epoch"]), float(r[f"{part}/{what}"])) for r in rows if r.get(f"{part}/{what}")]
            axes.plot(*zip(*points, strict=True) if points else ([], []), color=colour, label=part.replace("_", " "))
        axes.set_xlabel("epoch")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(folder / "curves.png", dpi=150)
