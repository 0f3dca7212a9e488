"""Coordinates of the unknown loads: how a vector gamma of unit-sized numbers becomes loads, and what is known of it.

The filter works on gamma; these classes are the only place that knows what its entries mean. Each supplies loads(gamma), a cold
start, a Gaussian prior (mean and precision per entry; precision 0 for none) and describe(gamma), the quantities a person asks for.
"""

from .family import Gamma, LoadFamily, LoadReport
from .fourier import FourierCoordinates
from .gaussian import WIDTH_OF_PRIOR, GaussianCoordinates
from .paper import PaperCoordinates
from .point import PointCoordinates
from .smooth import SmoothCoordinates

__all__ = [
    "WIDTH_OF_PRIOR",
    "FourierCoordinates",
    "Gamma",
    "GaussianCoordinates",
    "LoadFamily",
    "LoadReport",
    "PaperCoordinates",
    "PointCoordinates",
    "SmoothCoordinates",
]
