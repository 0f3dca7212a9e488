"""Whole fits by the compiled kernel and by the torch model, on cases that torchrod is measured by: the same loads to 1e-8.

TORCHROD_EVERY=1 takes all of them, which keeps the torch path busy for about ten minutes.
"""

import os
from dataclasses import replace

import pytest
import torch
from studies.ablation.plans import make, reference_parts

from tests.test_fast import needs_compiler
from torchrod import cold_start, estimate, kernel
from torchrod.estimation.solve import CHUNK_TORCH

pytestmark = needs_compiler
# So many samples of a row of docs/warm_start.md; of "reference", draws of noise for every shape of the independent solver.
EVERY = {"study1_clean": 100, "study1_1mm": 100, "two_contacts": 60, "one_tendon": 40, "two_tendons": 40, "reference": 1}
SAMPLES = EVERY if os.environ.get("TORCHROD_EVERY") else {"study1_1mm": 20, "two_contacts": 6, "one_tendon": 4}


def parts(name: str):
    if name == "reference":
        return reference_parts(SAMPLES[name])
    some = [replace(p, problem=p.problem.take(torch.arange(SAMPLES[name]))) for p in make(name, False).parts]
    # Both paths walk the same grid: a coarse one tells their operations apart as well, in a quarter of the time.
    return some if SAMPLES is EVERY else [replace(p, problem=replace(p.problem, steps=10)) for p in some]


@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.study
def test_both_paths_find_the_same_loads(name, monkeypatch):
    for part in parts(name):
        assert part.problem.batch <= CHUNK_TORCH
        found = []
        for compiled in (True, False):
            with monkeypatch.context() as m:
                if not compiled:
                    m.setattr(kernel, "available", lambda: False)
                found.append(estimate(part.problem, start=cold_start))
        one, other = found
        # Twenty iterations on the way amplify round-off: to 1e-5 of a standard deviation in one of the two contacts' samples.
        tolerance = 1e-6 if name == "two_contacts" else 1e-8
        assert torch.equal(one.status, other.status)
        assert torch.equal(one.accepted, other.accepted)
        assert torch.equal(one.iterations, other.iterations)
        for what in ("force", "location", "base_wrench"):
            a, b = getattr(one, what), getattr(other, what)
            scale = b if what == "location" else b.abs().amax(-1, keepdim=True)
            assert float(((a - b).abs() / scale).max()) < tolerance, what
