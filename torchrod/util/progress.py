"""Progress bars."""

from tqdm import tqdm


def bar(total: int, what: str, done: int = 0) -> tqdm:
    """Of samples, on stderr: shown where that is a terminal and there is more than a second of work."""
    look = {"unit": "sample", "unit_scale": True, "delay": 1.0, "leave": False, "dynamic_ncols": True}
    return tqdm(total=total, initial=done, desc=what, disable=None, **look)
