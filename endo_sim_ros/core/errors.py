"""What is wrong with a Gaussian model and with what lies beside it, for modules that import no torch."""


class ModelError(ValueError):
    """A Gaussian model or model file that cannot be used; the message says which field and why."""


class MotionError(ValueError):
    """A file of a motion that cannot be used; the message names it, and why."""
