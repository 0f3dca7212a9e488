"""Training of the learned starts: `python -m training.train --config training/configs/rod_1.yaml` (docs/training.md)."""
