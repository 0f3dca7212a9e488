"""The learned start: features of a measured shape, the network, its checkpoint, and when a checkpoint serves a model."""
