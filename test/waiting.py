"""Waiting for a condition."""

import time

import pytest


def wait_until(condition, seconds, what, step=lambda: time.sleep(0.02)):
    """Repeat a step until a condition is true and return its value; fail with `what` was awaited after some seconds."""
    seconds *= 3  # many processes share a machine that tests; only what fails waits so long
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        if time.monotonic() > deadline:
            pytest.fail(f"waited {seconds} s in vain for {what() if callable(what) else what}")
        step()
    return value
