"""Hostile models and cameras: the same model of every kind, or one sentence."""

import json
import tracemalloc

import numpy as np
import pytest

from endo_sim_ros.core.cameras import load_cameras
from endo_sim_ros.core.gaussians import ModelError, load_ply, ply_fields

COUNT = 10
NUMBERS = np.linspace(-1, 1, COUNT * len(ply_fields(0))).reshape(COUNT, -1)


def ply(order="binary_little_endian", count=COUNT, extra=(), before=""):
    lines = ["ply", f"format {order} 1.0", *([before] if before else []), f"element vertex {count}"]
    lines += [*(f"property float {name}" for name in [*ply_fields(0), *extra]), "end_header", ""]
    return "\n".join(lines).encode()


LITTLE = NUMBERS.astype("<f4").tobytes()
TEXT = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in NUMBERS).encode()


@pytest.mark.parametrize(
    "data",
    [
        ply() + LITTLE,
        ply().replace(b"\n", b"\r\n") + LITTLE,
        ply("binary_big_endian") + NUMBERS.astype(">f4").tobytes(),
        ply("ascii") + TEXT,
        ply().replace(b"end_header", b"element face 9\nproperty list uchar int corners\nend_header") + LITTLE,
    ],
)
def test_every_kind_of_ply_gives_the_same_model(tmp_path, data):
    (tmp_path / "model.ply").write_bytes(data)
    np.testing.assert_allclose(load_ply(tmp_path / "model.ply").means, NUMBERS[:, :3], rtol=1e-6)


HOSTILE_PLYS = {
    "a_trillion_vertices": (ply(count=10**12) + LITTLE, "claims 1000000000000 vertices"),
    "a_trillion_lines": (ply("ascii", count=10**12) + TEXT, "claims 1000000000000 vertices"),
    "more_than_any_integer": (ply(count=10**40) + LITTLE, "claims 1"),
    "less_than_none": (ply(count=-1) + LITTLE, "claims -1 vertices"),
    "truncated": (ply() + LITTLE[:-1], "claims 10 vertices of 56 bytes or more, 559 bytes follow"),
    "truncated_text": (ply("ascii") + TEXT[:-8], "not a readable PLY"),
    "a_hundred_thousand_properties": (ply(extra=[f"p{i}" for i in range(100_000)]) + LITTLE, "no PLY header within"),
    "a_comment_without_end": (b"ply\ncomment " + b"x" * 10**7, "no PLY header within"),
    "lists": (ply().replace(b"float x", b"list uint float x") + LITTLE, "'property list uint float x'"),
    "a_trillion_faces_first": (ply(before="element face 1000000000000\nproperty list uint int i") + LITTLE, "'property list"),
    "unknown_type": (ply().replace(b"float x", b"object x") + LITTLE, "'property object x'"),
    "equal_names": (ply(extra=["x"]) + LITTLE * 2, "not a readable PLY"),
}


@pytest.mark.parametrize("name", HOSTILE_PLYS)
def test_a_ply_that_lies_is_refused_without_the_memory_it_claims(tmp_path, name):
    data, sentence = HOSTILE_PLYS[name]
    (tmp_path / "model.ply").write_bytes(data)
    tracemalloc.start()
    with pytest.raises(ModelError, match=f"model.ply: .*{sentence}") as caught:
        load_ply(tmp_path / "model.ply")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000 and len(str(caught.value)) < 500


CAMERA = {"K": [[90, 0, 48], [0, 90, 40], [0, 0, 1]], "width": 96, "height": 80, "pose": np.eye(4).tolist()}
HOSTILE_CAMERAS = {
    "no_list": ("{}", "expected a list"),
    "missing_key": (json.dumps([{"K": CAMERA["K"]}]), "'width'"),
    "not_finite": (json.dumps([CAMERA | {"K": [[float("nan")] * 3] * 3}]), "must be a finite 3×3"),
    "infinite_width": (json.dumps([CAMERA]).replace("96", "1e999"), "cannot convert float infinity"),
    "huge_width": (json.dumps([CAMERA | {"width": 10**12}]), "no camera has 1000000000000×80 pixels"),
    "no_rotation": (json.dumps([CAMERA | {"pose": np.zeros((4, 4)).tolist()}]), "no camera has"),
    "ragged": (json.dumps([CAMERA | {"pose": [[1], [2, 3]]}]), "not a readable list of cameras"),
    "a_hundred_thousand_brackets": ("[" * 100_000, "not a readable list of cameras"),
    "a_hundred_thousand_digits": (json.dumps([CAMERA]).replace("96", "9" * 100_000), "not a readable list of cameras"),
    "a_long_matrix": (json.dumps([CAMERA | {"K": [0.0] * 100_000}]), "must be a finite 3×3"),
    "too_long": (" " * 65_000_000, "far more than cameras need"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE_CAMERAS)
def test_hostile_cameras_are_one_sentence(tmp_path, name):
    text, sentence = HOSTILE_CAMERAS[name]
    (tmp_path / "cameras.json").write_text(text)
    with pytest.raises(ValueError, match=f"cameras.json: .*{sentence}") as caught:
        load_cameras(tmp_path / "cameras.json")
    assert len(str(caught.value)) < 500
