"""Units of length that a file, a layout or an option may name."""

from pathlib import Path

from .errors import InputError, shown

LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
SPELLED = {
    "meters": "m",
    "metres": "m",
    "meter": "m",
    "metre": "m",
    "centimeters": "cm",
    "centimetres": "cm",
    "millimeters": "mm",
    "millimetres": "mm",
    "micrometers": "um",
    "inches": "in",
}


def metres_per(where: str | Path, unit: object) -> float:
    """Metres in one unit of length, by its symbol or its English name. Errors: InputError."""
    name = unit.strip() if isinstance(unit, str) else ""
    factor = LENGTHS.get(SPELLED.get(name.lower(), name.lower()))
    if factor is None:
        raise InputError(f"{where} is {shown(unit)}; it must be one of {', '.join(LENGTHS)}")
    return factor
