"""The parts of scripts/ablation.py."""
