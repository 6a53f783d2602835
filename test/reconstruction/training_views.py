"""Training views of frames."""

import dataclasses

from endo_sim_ros.reconstruction.scene import TrainingView


def unknown(frames):
    """Views of the frames, without a depth prior."""
    return [TrainingView.of(frame) for frame in frames]


def with_prior(frames):
    """Views of the frames, whose depth prior is the frames' depth, and which have no other depth."""
    return [dataclasses.replace(TrainingView.of(frame), depth=None, depth_prior=frame.depth) for frame in frames]
