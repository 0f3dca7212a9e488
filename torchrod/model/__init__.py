"""What is unknown and what is measured: load families, and the model h(x) of what the markers show."""
