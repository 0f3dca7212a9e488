"""Parts of scripts/benchmark.py: cases, worker processes, what is measured, and how it is shown."""
