"""What became of a sample, and what its owner can do about it."""

from enum import IntEnum


class Status(IntEnum):
    """Outcome per sample; `.label` is the word that files carry, `.message` names the remedy."""

    CONVERGED = 0
    NOT_CONVERGED = 1
    INVALID = 2

    @property
    def label(self) -> str:
        """The contract's word for it: converged, not_converged, invalid."""
        return self.name.lower()

    @property
    def message(self) -> str:
        """One sentence, with the remedy where there is something to do."""
        return _MESSAGES[self]


_MESSAGES = {
    Status.CONVERGED: "Converged.",
    Status.NOT_CONVERGED: "Did not converge: check units, marker order and tensions; then state more noise or more iterations.",
    Status.INVALID: "No fit: too few markers for the unknowns, or numbers that leave the rod no shape; "
    "give this sample more markers or fewer unknown loads, and check the units of robot and tensions.",
}
