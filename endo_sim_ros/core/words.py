"""Words of messages for people."""


def counted(count: int, noun: str) -> str:
    """A count with its noun, which takes an s unless there is one: *1 view*, *5 views*."""
    return f"{count} {noun}{'s' * (count != 1)}"
