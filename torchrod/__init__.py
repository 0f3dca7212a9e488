"""torchrod: forces from shape. Estimates the external loads on continuum robots from measured marker positions.

`__init__.pyi` lists the whole public surface, every name with its home; each is imported on first use, so that `torchrod --help`
need not wait for torch. Batch dimension first, physical dimensions last; SI units; float64.
"""

import lazy_loader

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
