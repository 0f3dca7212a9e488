"""Train a learned start.

    python -m training.train --config training/configs/rod_1.yaml

Makes its cases (kept in training/cache), trains, and writes checkpoints/NAME.safetensors with its card NAME.json; log, curves and
the state to resume from go to training/runs/NAME. Every value of the configuration can be given on the command line:
--trainer.max_epochs 5, --data.recipe.seed 1, --trainer.accelerator gpu. A run that was stopped goes on with --ckpt_path LAST.ckpt.
"""

import torch
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI

from .data import ShapeData
from .module import WarmStartModule

THREADS = 1  # steps of this size gain nothing from a second one, and beside a busy neighbour lose a factor of ten (measured)


class TrainCLI(LightningCLI):
    """The options of LightningCLI, and --ckpt_path."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """--ckpt_path."""
        parser.add_argument("--ckpt_path", type=str, default=None, help="the state to resume from")


def main(arguments: list[str] | None = None) -> None:
    """Train by a configuration."""
    torch.set_num_threads(THREADS)
    cli = TrainCLI(WarmStartModule, ShapeData, run=False, save_config_callback=None, args=arguments)
    cli.trainer.fit(cli.model, datamodule=cli.datamodule, ckpt_path=cli.config.ckpt_path)


if __name__ == "__main__":
    main()
