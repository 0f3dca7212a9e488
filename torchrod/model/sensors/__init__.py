"""What is measured: one file for each sensor, on the protocol of `sensor`.

A sensor says at which arc lengths it sits, what it would read of a rod (`predict`), what it did read and how well. The problem
joins the rows of all its sensors; nothing else knows what a row means.
"""

from .base_wrench import BaseWrench
from .markers import Markers
from .pose import Poses
from .sensor import RodState, Sensor

__all__ = ["BaseWrench", "Markers", "Poses", "RodState", "Sensor"]
