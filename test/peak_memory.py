"""The memory that an action needs."""

import tracemalloc


def peak_of(action) -> float:
    """Megabytes that an action held at its worst, in arrays and objects of Python."""
    tracemalloc.start()
    try:
        action()
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
