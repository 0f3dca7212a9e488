"""Whether markers, robot and model belong together."""

import torch
from jaxtyping import Bool
from torch import Tensor

from ..mechanics.grid import on_rod
from .measurement import Markers, Model


def usable(model: Model, markers: Markers) -> Bool[Tensor, " B"]:
    """Samples with a marker, as many marker coordinates as unknown loads and registration numbers, and finite tensions."""
    enough = 3 * markers.present.sum(-1) >= max(model.free_size, 1)
    if markers.tension is not None:
        enough = enough & torch.isfinite(markers.tension).all(-1)
    return enough


def check(model: Model, markers: Markers, noise: float) -> None:
    """Raise ValueError, naming the remedy, for measurements that do not fit the robot or the model."""
    L = model.robot.rod.length
    tendons = len(model.robot.tendons)
    if (misshapen := markers.misshapen) is not None:
        raise ValueError(misshapen)
    if not noise > 0:
        raise ValueError(f"noise is {noise} m; it must be positive")
    if len(markers.s) == 0 or len(markers.positions) == 0:
        raise ValueError("there are no markers; give at least one sample with markers")
    if not bool(on_rod(markers.s, L).all()):
        raise ValueError(f"marker arc lengths run from {markers.s.min()} to {markers.s.max()} m, outside the rod of 0 to {L} m")
    if 3 * len(markers.s) < model.free_size:
        raise ValueError(
            f"{len(markers.s)} marker{'s' * (len(markers.s) > 1)} cannot determine {model.free_size} unknowns; "
            "add markers or drop loads or --registration"
        )
    if tendons and markers.tension is None:
        raise ValueError(f"the robot has {tendons} tendons but the shapes carry no tensions; add tension_1..tension_{tendons}")
    if markers.tension is not None and markers.tension.shape[-1] != tendons:
        raise ValueError(f"the shapes carry {markers.tension.shape[-1]} tensions but the robot has {tendons} tendons")
