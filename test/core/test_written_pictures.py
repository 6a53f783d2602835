"""Pictures for people."""

import numpy as np
import pytest

from endo_sim_ros.core.drawing import write_png


def test_a_picture_that_cannot_be_written_says_why(tmp_path):
    image = np.zeros((8, 8, 3), np.uint8)
    (tmp_path / "full.png.part").symlink_to("/dev/full")  # what is written until the picture is whole
    (tmp_path / "folder.png").mkdir()
    for name, reason in (
        ("full.png", "the disk is full"),
        ("folder.png", "Is a directory"),
        ("nowhere/a.png", "does the folder exist?"),
    ):
        with pytest.raises(OSError, match=f"{name}: the picture cannot be written[:;] {reason}"):
            write_png(tmp_path / name, image)
    assert [file.name for file in tmp_path.iterdir()] == ["folder.png"]
