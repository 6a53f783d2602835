"""Whether the images of a stereo pair are of the eyes that they are said to be of."""

from collections.abc import Iterable, Iterator

import numpy as np

from endo_sim_ros.core.features import detect, match_pair
from endo_sim_ros.core.frames import Frame, SequenceError


def with_eyes_checked(
    frames: Iterable[Frame],
    *,
    pairs: int = 5,
    features: int = 1000,
    ratio: float = 0.8,
    rows: float = 0.05,
    least_matches: int = 30,
    share: float = 0.9,
) -> Iterator[Frame]:
    """The frames, of which the first pair with features enough tells whether its eyes are exchanged.

    What lies before two eyes is farther to the left in the right image.

    Args:
        frames: Rectified.
        pairs: Pairs that are looked at until one tells.
        features, ratio: As `detect` and `match_pair`.
        rows: Share of the image's height by which rows of a feature may be apart; rectification is seldom exact.
        least_matches: Fewer tell nothing.
        share: Of the features that must be on the wrong side; those far away are on either.

    Raises:
        SequenceError: If they are.
    """
    for frame in frames:
        if frame.right is not None and pairs:
            pairs -= 1
            left, right = match_pair(detect(frame.image, frame.mask, features), detect(frame.right, None, features), ratio)
            right_K = frame.camera.K if frame.right_K is None else frame.right_K
            moved = (right - right_K[:2, 2]) - (left - frame.camera.K[:2, 2])
            moved = moved[np.abs(moved[:, 1]) < rows * frame.camera.height]
            if len(moved) >= least_matches:
                pairs, wrong = 0, float(np.mean(moved[:, 0] > 0))
                if wrong > share:
                    raise SequenceError(
                        f"left and right eye are exchanged, or their principal points wrong: {wrong:.0%} of {len(moved)} features of the "
                        f"view at {frame.stamp_ns * 1e-9:.3f} s lie farther right in the right image, which nothing before two eyes does; "
                        "exchange the images, or correct the calibration"
                    )
        yield frame
