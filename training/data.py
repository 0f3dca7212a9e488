"""The data: blocks of training.cases, made once and kept in a folder, served as tensors."""

import hashlib
import json
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import torch
from lightning import LightningDataModule
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.utils.data import DataLoader, Sampler, TensorDataset
from tqdm import tqdm

import torchrod
from torchrod.util.threads import one_thread

from .cases import COLUMNS, Recipe, block

HELD_OUT = 50  # of so many blocks one is not learned from, and two at least


def make_block(recipe: Recipe, folder: Path, index: int) -> None:
    """Write one block, under another name until it is whole; on one thread, so that no sum depends on how it was divided."""
    path = folder / f"{index:04d}.safetensors"
    part = path.with_suffix(f".{os.getpid()}")
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)  # the smoothing of a learned start's features follows it, by 1e-8
    try:
        with one_thread(kernel=True):
            save_file({name: value.contiguous() for name, value in block(recipe, index).items()}, part)
    finally:
        torch.set_default_dtype(before)
    part.replace(path)


class Batches(Sampler[list[int]]):
    """Indices of every batch of an epoch, a pure function of (seed, epoch), so that a run that is resumed repeats itself.

    They are drawn when the first is asked for: a resumed trainer tells the epoch only after it has asked for the iterator.
    """

    def __init__(self, count: int, size: int, seed: int):
        self.count, self.size, self.seed, self.epoch = count, size, seed, 0

    def set_epoch(self, epoch: int) -> None:
        """Called by the trainer."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.count // self.size

    def __iter__(self) -> Iterator[list[int]]:
        order = torch.randperm(self.count, generator=torch.Generator().manual_seed(self.seed * 1_000_003 + self.epoch))
        yield from order[: len(self) * self.size].reshape(-1, self.size).tolist()


class ShapeData(LightningDataModule):
    """Training cases by a recipe (training.cases.Recipe). cache: the folder of the blocks; workers: processes that make them."""

    def __init__(self, recipe: Recipe, batch_size: int = 512, cache: str = "training/cache", workers: int = 2):
        super().__init__()
        self.recipe, self.batch_size, self.workers = replace(recipe, priors=tuple(recipe.priors)), batch_size, workers
        identity = json.dumps([torchrod.__version__, self.recipe.record()], sort_keys=True)
        self.folder = Path(cache) / hashlib.sha256(identity.encode()).hexdigest()[:16]
        self.train: dict[str, Tensor] = {}
        self.held_out: dict[str, Tensor] = {}

    def prepare_data(self) -> None:
        """Make the blocks that are not there."""
        self.folder.mkdir(parents=True, exist_ok=True)
        missing = [i for i in range(self.recipe.blocks) if not (self.folder / f"{i:04d}.safetensors").is_file()]
        make = partial(make_block, self.recipe, self.folder)
        if self.workers < 2 or len(missing) < 2:
            for i in tqdm(missing, desc="cases", unit="block", delay=1.0, disable=None):
                make(i)
            return
        with ProcessPoolExecutor(self.workers, get_context("spawn")) as pool:
            list(tqdm(pool.map(make, missing), total=len(missing), desc="cases", unit="block", delay=1.0, disable=None))

    def setup(self, stage: str) -> None:
        """Read the blocks; the last of them are held out."""
        if self.train:
            return
        blocks = [load_file(self.folder / f"{i:04d}.safetensors") for i in range(self.recipe.blocks)]
        last = len(blocks) - max(2, len(blocks) // HELD_OUT)
        self.train, self.held_out = (
            {name: torch.cat([b[name] for b in part]) for name in COLUMNS} for part in (blocks[:last], blocks[last:])
        )

    def train_dataloader(self) -> DataLoader:
        """Shuffled batches."""
        rows = TensorDataset(*self.train.values())
        return DataLoader(rows, sampler=Batches(len(rows), min(self.batch_size, len(rows)), self.recipe.seed), batch_size=None)

    def val_dataloader(self) -> DataLoader:
        """What was held out, in one batch."""
        rows = TensorDataset(*self.held_out.values())
        return DataLoader(rows, sampler=[list(range(len(rows)))], batch_size=None)
