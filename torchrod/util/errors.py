"""The one error that a person's input can cause."""

import re

MOST_SHOWN = 80  # letters
MOST_IN_A_WORD = 400  # a path may be long; a name of thousands of letters that a damaged file holds is not repeated


class InputError(ValueError):
    """Input that cannot be used; its text is one sentence naming the file, the key and the remedy."""

    def __init__(self, said: str):
        super().__init__(re.sub(rf"\S{{{MOST_IN_A_WORD},}}", lambda word: f"{word[0][:MOST_SHOWN]}...", said))


def shown(value: object) -> str:
    """A value as a refusal quotes it: short, whatever it is."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # Python writes no whole number of thousands of digits
        text = "a number of too many digits"
    return text if len(text) <= MOST_SHOWN else f"{text[: MOST_SHOWN - 3]}..."
