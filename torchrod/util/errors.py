"""The one error that a person's input can cause."""


class InputError(ValueError):
    """Input that cannot be used; its text is one sentence naming the file, the key and the remedy."""
