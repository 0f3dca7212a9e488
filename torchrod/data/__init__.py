"""Data sets of simulated shapes: what is drawn, the specification, shards on disk and the workers that make them."""
