"""The one exception that bad input raises."""


class HyliosError(ValueError):
    """Input that cannot be used: the message says what was expected, what came and where."""
