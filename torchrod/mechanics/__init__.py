"""The physics: Lie algebra, rod, tendons, loads, the section's statics, its integration along the rod, and the forward solve.

The equations are written here once, in torch. `section` is one arc-length step, `integrate` walks it along the rod, `statics`
solves for the shape under known loads. The compiled kernel is a copy that the tests hold to this package."""
