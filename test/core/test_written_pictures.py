"""Pictures for people."""

from itertools import groupby

import numpy as np
import pytest

from endo_sim_ros.core.drawing import sheet, write_png


def test_captions_of_narrow_pictures_can_be_read():
    drawn = sheet([("cut over 26 mm, its edges held apart", np.zeros((96, 128, 3), np.uint8))], columns=1)
    letters = (drawn[:18] > 100).any((0, 2))
    assert sum(len(list(run)) > 2 for seen, run in groupby(letters) if not seen) >= 7, "between eight words"


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
