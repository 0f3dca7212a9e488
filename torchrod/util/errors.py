"""The one error that a person's input can cause."""


class InputError(ValueError):
    """Input that cannot be used; its text is one sentence naming the file, the key and the remedy."""


MOST_SHOWN = 80  # letters


def shown(value: object) -> str:
    """A value as a refusal quotes it: short, whatever it is."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # Python writes no whole number of thousands of digits
        text = "a number of too many digits"
    return text if len(text) <= MOST_SHOWN else f"{text[: MOST_SHOWN - 3]}..."
