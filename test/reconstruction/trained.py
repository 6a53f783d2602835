"""A training of frames, prepared."""

from endo_sim_ros.reconstruction import Trainer, prepare


def trainer_of(frames, config, points=None):
    """The trainer of what is prepared from frames."""
    return Trainer(prepare(frames, config, points), config)
