"""What is wrong with a Gaussian model, for modules that import no torch."""


class ModelError(ValueError):
    """A Gaussian model or model file that cannot be used; the message says which field and why."""
