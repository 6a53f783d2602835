"""Poses by VGGT. Its package is on no index: one of its interface stands in, which reads a checkpoint made here.

Its network sees the red of an image as where the camera is.
"""

import sys

import numpy as np
import pytest
from plane_scene import write_rgb

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.estimated_poses import pose_estimator, with_estimated_poses
from endo_sim_ros.sequences.folder import read_folder
from endo_sim_ros.sequences.recording import Recording
from endo_sim_ros.sequences.structure_from_motion import View

PACKAGE = {
    "models/vggt.py": """
import json
from pathlib import Path
import torch

class VGGT(torch.nn.Module):
    @classmethod
    def from_pretrained(cls, folder, local_files_only):
        assert local_files_only
        network = cls()
        network.gain = torch.nn.Parameter(torch.load(Path(folder) / "weights.pt")["gain"])
        return network

    def forward(self, images):  # [S, 3, H, W]
        assert images.shape[-1] == 518 and images.shape[-2] % 14 == 0 and 0 <= images.min() <= images.max() <= 1
        encoding = torch.zeros(1, len(images), 9)
        encoding[0, :, 0] = -self.gain * images[:, 0].mean((1, 2))  # translation of the world, seen from the camera
        encoding[..., 6], encoding[..., 7:] = 1, 0.9
        return {"pose_enc": encoding, "depth": torch.full((1, len(images), 8, 8, 1), 2.0)}
""",
    "utils/pose_enc.py": """
import torch

def pose_encoding_to_extri_intri(encoding, image_size_hw):
    turn = torch.eye(3).expand(1, encoding.shape[1], 3, 3)
    views, K = torch.cat([turn, encoding[..., :3, None]], -1), turn.clone()
    for axis, side in enumerate(reversed(image_size_hw)):
        K[..., axis, axis], K[..., axis, 2] = side / 2 / torch.tan(encoding[..., 8 - axis] / 2), side / 2
    return views, K
""",
}


@pytest.fixture
def package(tmp_path, monkeypatch):
    for name, text in PACKAGE.items():
        file = tmp_path / "site/vggt" / name
        file.parent.mkdir(parents=True)
        file.write_text(text)
    monkeypatch.syspath_prepend(tmp_path / "site")
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] == "vggt"]:
        del sys.modules[name]


@pytest.fixture
def checkpoint(tmp_path):
    torch = pytest.importorskip("torch")
    folder = tmp_path / "VGGT-1B"
    folder.mkdir()
    (folder / "config.json").write_text("{}")
    torch.save({"gain": torch.tensor(2.0)}, folder / "weights.pt")
    return folder


def images(*reds):
    return [np.full((64, 80, 3), (red, 100, 50), np.uint8) for red in reds]


def views(*reds):
    return map(View, images(*reds))


def test_poses_of_a_stereo_recording_have_its_scale(package, checkpoint, tmp_path, caplog):
    for eye, reds in (("left", (20, 40, 80)), ("right", (30, 50, 90))):
        for number, image in enumerate(images(*reds)):
            write_rgb(tmp_path / f"{eye}/{number:06d}.png", image)
    (tmp_path / "calibration.yaml").write_text("fx: 70\nfy: 70\ncx: 40\ncy: 32\nbaseline_m: 0.005\n")
    (tmp_path / "poses_left.txt").write_text("0 9 9 9 0 0 0 1\n")  # of which it takes none
    frames = list(read_folder(tmp_path, mask_border=False, poses=f"vggt:{checkpoint}"))
    positions = np.array([frame.camera.position for frame in frames])
    np.testing.assert_allclose(positions, 0.005 / 10 * np.array([[0, 0, 0], [20, 0, 0], [60, 0, 0]]), atol=1e-8)
    assert "GUESS" not in caplog.text


def test_one_eye_gives_a_guessed_scale_and_the_focal_length_that_the_network_sees(package, checkpoint, monkeypatch, tmp_path, caplog):
    hub = tmp_path / "hub/models--facebook--VGGT-1B/snapshots"
    hub.mkdir(parents=True)
    checkpoint.rename(hub / "0123")
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    result = pose_estimator("vggt")(views(0, 51))
    np.testing.assert_allclose(result.poses[1][:3, 3], [0.1 / 2 * 2 * 51 / 255, 0, 0], rtol=1e-5)
    assert not result.metric and "THE SCALE IS A GUESS" in caplog.text
    np.testing.assert_allclose(result.K[[0, 1], [0, 1]], np.array([80, 64]) / 2 / np.tan(0.45), rtol=1e-5)
    assert pose_estimator("vggt")(views(0, 51), scale=3.0).poses[1][0, 3] == pytest.approx(3 / 2 * 2 * 0.2, rel=1e-5)


def test_recorded_depth_sets_the_scale_of_one_eye(package, checkpoint):
    depth = np.zeros((64, 80), np.float32)
    depth[:32] = 3
    first, second = views(0, 51)
    result = pose_estimator(f"vggt:{checkpoint}")([first, second._replace(depth=depth)])
    assert result.metric and result.poses[1][0, 3] == pytest.approx(3 / 2 * 2 * 0.2, rel=1e-5)


def test_a_recording_is_read_once_for_its_poses(package, checkpoint, tmp_path):
    camera = Camera(intrinsic_matrix(70, 70, 40, 32), 80, 64)
    read = []

    def frames():
        for number, image in enumerate(images(0, 51, 102)):
            read.append(number)
            yield Frame(number, image, camera, depth=np.ones((64, 80), np.float32))

    with_estimated_poses(Recording(frames, 3), tmp_path, f"vggt:{checkpoint}", "", "012").prepare(None)
    assert read == [0, 0, 1, 2]  # the first one tells of what camera they are


def test_what_is_missing_is_one_clear_sentence(package, checkpoint, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "nothing"))
    with pytest.raises(SequenceError, match=r"nothing: there is no checkpoint of VGGT; copy facebook/VGGT-1B .* poses=vggt:FOLDER"):
        pose_estimator("vggt")
    with pytest.raises(SequenceError, match="2 or more images"):
        pose_estimator(f"vggt:{checkpoint}")(views(1))
    (checkpoint / "weights.pt").write_bytes(b"nothing")
    with pytest.raises(SequenceError, match="VGGT-1B: not a readable checkpoint"):
        pose_estimator(f"vggt:{checkpoint}")(views(1, 2))
    monkeypatch.setitem(sys.modules, "vggt.models.vggt", None)
    with pytest.raises(SequenceError, match=r"needs the package vggt \(github.com/facebookresearch/vggt\)"):
        pose_estimator(f"vggt:{checkpoint}")(views(1, 2))
    (tmp_path / "calibration.yaml").write_text("fx: 70\nfy: 70\ncx: 40\ncy: 32\n")
    write_rgb(tmp_path / "left/000000.png", images(1)[0])
    with pytest.raises(SequenceError, match="poses must be sfm, vggt or vggt:FOLDER, got 'orb'"):
        read_folder(tmp_path, poses="orb")
