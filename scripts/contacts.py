"""How often --contacts auto finds the right number: python scripts/contacts.py [--samples N] [--out DIR] writes DIR/contacts.md.

The paper's steel rod, pushes of 0.5 to 2 N at 10 to 39 cm, two of them at least 8 cm apart, 1 mm noise, 20 and 8 markers.
"""

import argparse
import math
from contextlib import AbstractContextManager
from pathlib import Path

import torch
from reproduction.cases import L, steel_rod
from tqdm import tqdm

from torchrod import GaussianCoordinates, Markers, Model, PointForces, Settings, cold_start, find_warm_start, solve_shape
from torchrod.selection import Hypothesis, select

NOISE, GAP, MOST = 1e-3, 0.08, 3
LEAST = {20: (97, 97, 95), 8: (97, 97, 92)}  # percent right that we ask for, for 0, 1, 2 contacts


def cases(contacts: int, markers: int, samples: int, seed: int) -> Markers:
    """Noisy markers of random pushes."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    s = torch.linspace(L / markers, L, markers, dtype=torch.float64)
    place = (0.1 + 0.29 * uniform(20 * samples, contacts)).sort(-1).values
    place = place[(place.diff(dim=-1) >= GAP).all(-1)][:samples]
    size, angle = 0.5 + 1.5 * uniform(samples, contacts), 2 * math.pi * uniform(samples, contacts)
    force = torch.stack([size * angle.cos(), size * angle.sin(), 0 * size], -1)
    p = solve_shape(steel_rod(), (PointForces(force, place),) if contacts else (), None, s, samples, 80).p
    return Markers(s, p + NOISE * torch.randn(p.shape, generator=generator, dtype=torch.float64))


def chosen(markers: Markers) -> torch.Tensor:
    """How many samples chose 0, 1, 2, 3 contacts."""
    robot = steel_rod()
    counts = [Hypothesis(str(k), k, Model(robot, GaussianCoordinates(k, L, robot.rod.force_scale))) for k in range(MOST + 1)]

    def bar(total: int, what: str) -> AbstractContextManager[tqdm]:
        return tqdm(total=total, desc=f"{what} contacts", delay=1.0, leave=False)

    _, evidence = select(counts, markers, NOISE, Settings(), lambda model: find_warm_start(model) or cold_start, bar)
    return torch.bincount(evidence.choice, minlength=MOST + 1)


def main() -> None:
    """Write the confusion matrices."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs")
    options = parser.parse_args()
    lines = ["# How many contacts", "", "Made by `python scripts/contacts.py`: `--contacts auto` with the contact prior."]
    lines += [f"{options.samples} cases a row; pushes of 0.5 to 2 N at 100 to 390 mm of the 400 mm steel rod, two at least"]
    lines += ["80 mm apart, 1 mm noise.", "", "| markers | true | chosen 0 | 1 | 2 | 3 | right | asked for |", "|" + "---|" * 8]
    for markers, least in LEAST.items():
        for contacts in range(3):
            found = chosen(cases(contacts, markers, options.samples, 100 * markers + contacts)).tolist()
            right = 100 * found[contacts] / options.samples
            cells = [markers, contacts, *found, f"{right:.1f} %", f"{least[contacts]} %"]
            lines.append("| " + " | ".join(map(str, cells)) + " |")
            print(lines[-1], flush=True)
    (options.out / "contacts.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
