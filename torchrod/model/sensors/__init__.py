"""What is measured: one file for each sensor, on the protocol of `sensor`.

A sensor says at which arc lengths it sits, what it would read of a rod (`predict`), what it did read and how well. The problem
joins the rows of all its sensors; nothing else knows what a row means.
"""

from .base_wrench import BaseWrench
from .camera import Camera
from .centre_line import CentreLine
from .core_strains import CoreStrains
from .curvature import Curvature
from .directions import Directions
from .markers import Markers
from .pose import Poses
from .sensor import RodState, Sensor
from .tip_wrench import TipWrench

__all__ = [
    "BaseWrench",
    "Camera",
    "CentreLine",
    "CoreStrains",
    "Curvature",
    "Directions",
    "Markers",
    "Poses",
    "RodState",
    "Sensor",
    "TipWrench",
]
