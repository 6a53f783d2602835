"""The error of all encoders and decoders."""


class MessageError(ValueError):
    """A message that cannot be used. The sentence names the topic, the field and what to do."""
