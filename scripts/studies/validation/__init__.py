"""The parts of scripts/validate.py."""
