"""Tissue that moves by itself is undone in frames and done to models, as far as it is known to move."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from lit_wall import CAMERA

from endo_sim_ros.core.errors import MotionError
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.gaussians import GaussianModel, load_ply, save_ply
from endo_sim_ros.core.tissue_motion import MovingModel, PeriodicMotion, TissueMotion
from endo_sim_ros.physics import PhysicsConfig
from endo_sim_ros.reconstruction.still_frames import stilled, unstilled

FAR = np.array([0.004, -0.002, 0.006])  # metres, from the mean at phase 0
DEPTH = 0.1
POINTS = np.stack([*np.meshgrid(np.linspace(-0.06, 0.06, 13), np.linspace(-0.05, 0.05, 11)), np.full((11, 13), DEPTH)], -1).reshape(-1, 3)


def breath(shares: np.ndarray) -> TissueMotion:
    return TissueMotion(1.0, POINTS, (PeriodicMotion("breathing", 4.0, 1.0, 3.0, np.stack([FAR, 0 * FAR]), shares),))


def wall_seen_from(camera, shift=(0.0, 0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """Smooth stripes on a wall that is displaced by so much."""
    distance = DEPTH + shift[2] - camera.position[2]
    x, y, _ = np.moveaxis(camera.rays() * distance + camera.position - np.array(shift), -1, 0)
    image = 128 + 60 * np.stack([np.sin(400 * x), np.cos(350 * y), np.sin(250 * (x + y))], -1)
    return image.round().astype(np.uint8), np.full(x.shape, distance, np.float32)


def frame_at(seconds: float, shift: np.ndarray) -> Frame:
    image, depth = wall_seen_from(CAMERA, shift)
    right = wall_seen_from(CAMERA.beside(0.005), shift)[0]
    return Frame(round(1e9 * (1.0 + seconds)), image, CAMERA, right=right, baseline=0.005, depth=depth)


def test_frames_show_tissue_in_its_mean_position():
    motion = breath(np.ones(len(POINTS)))
    truth, right = wall_seen_from(CAMERA)[0], wall_seen_from(CAMERA.beside(0.005))[0]
    inner = np.s_[20:-20, 20:-20]
    for seconds, share in ((0.0, 1.0), (2.0, -1.0), (10.0, -1.0), (0.5, np.sqrt(0.5))):
        frame = frame_at(seconds, share * FAR)
        still = stilled(frame, motion)
        assert np.abs(frame.image[inner].astype(int) - truth[inner]).max() > 60
        assert np.abs(still.image[inner].astype(int) - truth[inner]).max() <= 4
        assert np.abs(still.right[inner].astype(int) - right[inner]).max() <= 4
        np.testing.assert_allclose(still.depth[inner], DEPTH, atol=1e-4)
        shown = still.mask > 0  # the rest comes from beyond the picture
        assert shown[inner].all() and not shown.all()
        assert np.abs(still.image[shown].astype(int) - truth[shown]).max() <= 12


def behind_a_ball(shift=(0.0, 0.0, 0.0), camera=CAMERA) -> tuple[np.ndarray, np.ndarray]:
    """The wall behind a ball, which are displaced by so much, and their depth."""
    image, depth = wall_seen_from(camera, shift)
    rays, middle = camera.rays(), np.array([0.0, 0.0, 0.075]) + shift - camera.position
    squared, along = (rays**2).sum(-1), rays @ middle
    root = along**2 - squared * (middle @ middle - 0.012**2)
    near = (along - np.sqrt(root.clip(0))) / squared
    x, y, _ = np.moveaxis(rays * near[..., None] + camera.position - np.array(shift), -1, 0)
    stripes = 128 + 60 * np.stack([np.cos(900 * y), np.sin(800 * x), np.sin(600 * (x - y))], -1)
    return np.where((root > 0)[..., None], stripes.round().astype(np.uint8), image), np.where(root > 0, near, depth).astype(np.float32)


def test_what_is_in_front_moves_as_far_as_its_depth_tells():
    """Between points of the wall it would move as far as that."""
    motion, eye = breath(np.ones(len(POINTS))), CAMERA.beside(0.005)
    still_image, still_depth = behind_a_ball()
    image, depth = behind_a_ball(FAR)
    frame = Frame(10**9, image, CAMERA, right=behind_a_ball(FAR, eye)[0], baseline=0.005, depth=depth)
    rough, fine = stilled(frame, motion), stilled(frame, motion, depth)
    ball = cv2.erode(np.uint8(still_depth < 0.08), np.ones((5, 5))) > 0
    off = lambda image, truth: np.abs(image[ball].astype(int) - truth[ball]).mean()
    assert ball.sum() > 300 and off(rough.image, still_image) > 15
    assert off(fine.image, still_image) < 4 and off(fine.right, behind_a_ball(camera=eye)[0]) < 8
    np.testing.assert_allclose(np.median(np.abs(fine.depth - still_depth)), 0, atol=1e-4)
    again, _ = unstilled(CAMERA, still_depth, None, 10**9, motion)
    assert np.quantile(np.abs(again - depth)[20:-20, 20:-20], 0.9) < 3e-4


def test_noise_of_points_hardly_hides_how_motion_fades_around_its_place():
    """Shares with a noise of 0.08 between 220 points: linear between the 24 nearest they are off by 0.036."""
    rng = np.random.default_rng(0)
    points, others = (np.c_[rng.uniform([-x, -y], [x, y], (n, 2)), np.zeros(n)] for x, y, n in ((0.06, 0.05, 220), (0.05, 0.04, 12_000)))
    truth = lambda places: np.exp(-0.5 * (places**2).sum(1) / 0.04**2)
    noisy = truth(points) + rng.normal(0, 0.08, len(points))
    motion = TissueMotion(1.0, points, (PeriodicMotion("breathing", 4.0, 1.0, 3.0, np.stack([FAR, 0 * FAR]), noisy),))
    assert np.sqrt(((motion.shares(others)[:, 0] - truth(others)) ** 2).mean()) < 0.033
    assert motion.amplitudes[0] == pytest.approx(2 * np.linalg.norm(FAR), rel=0.05)
    assert motion.shares(others[:0]).shape == (0, 1)


def test_masks_follow_the_tissue_and_frames_without_points_stay():
    motion = breath(np.ones(len(POINTS)))
    mask = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    mask[:, :80] = 0
    frame = dataclasses.replace(frame_at(0.0, FAR), mask=mask)
    edge = int(np.argmax(stilled(frame, motion).mask[64] > 0))
    assert abs(edge - (80 - 200 * FAR[0] / DEPTH)) <= 2
    away = CAMERA.at(np.diag([1.0, -1.0, -1.0, 1.0]))
    behind = dataclasses.replace(frame, camera=away)
    assert stilled(behind, motion) is behind and stilled(frame, None) is frame


def test_models_move_by_the_shares_of_the_points_near_them():
    shares = np.where(POINTS[:, 0] > 0, 1.0, 0.0)
    model = GaussianModel.from_points(
        torch.tensor([[0.05, 0, DEPTH], [-0.05, 0, DEPTH], [0.3, 0, DEPTH]]).float(), torch.rand(3, 3), torch.full((3,), 0.001)
    )
    moved = MovingModel(model, breath(shares)).at(round(3e9)).means - model.means  # half a period after phase 0
    np.testing.assert_allclose(moved, np.stack([-FAR, 0 * FAR, -FAR]), atol=1e-6)
    assert MovingModel(model, None).at(0) is model


def test_normals_turn_as_the_surface_that_moves():
    """Where shares rise by 5 a metre, tissue that goes 6 mm deeper turns by 1.7°, there and then back."""
    motion = breath(0.5 + 5 * POINTS[:, 0])
    corners = torch.tensor([[0.01, 0.005, DEPTH], [0.011, 0.005, DEPTH], [0.01, 0.006, DEPTH]])
    model = GaussianModel.from_points(corners, torch.rand(3, 3), torch.full((3,), 0.001))
    film = torch.tensor([0.3, 0.2, -1.0])
    gloss = torch.cat([torch.tensor([0.0, 0.0, -1.0]), film, torch.tensor([0.1, 0.2])]).repeat(3, 1)
    moving = MovingModel(dataclasses.replace(model, gloss=gloss), motion)
    for seconds, turn in ((1.0, 0.03), (3.0, -0.03)):
        moved = moving.at(round(seconds * 1e9))
        a, b, c = moved.means
        across = torch.linalg.cross(c - a, b - a)
        normals = torch.nn.functional.normalize(moved.gloss[:, :6].unflatten(1, (2, 3)), dim=2)
        np.testing.assert_allclose(normals[0, 0], across / across.norm(), atol=1.5e-3)
        assert normals[0, 0, 0] == pytest.approx(turn, abs=3e-3)
        F = np.eye(3) + np.outer((-1) ** (seconds > 2) * FAR, [5, 0, 0])
        ripple = np.linalg.solve(F.T, film)  # the film is tied to the tissue
        np.testing.assert_allclose(normals[0, 1], ripple / np.linalg.norm(ripple), atol=1.5e-3)
        assert torch.equal(moved.gloss[:, 6:], gloss[:, 6:])


def plain_model(count: int = 50) -> GaussianModel:
    means = torch.from_numpy(np.random.default_rng(1).uniform([-0.05, -0.04, 0.09], [0.05, 0.04, 0.11], (count, 3))).float()
    return GaussianModel.from_points(means, torch.rand(count, 3), torch.full((count,), 0.001))


def test_a_motion_is_saved_beside_its_model_for_physics(tmp_path):
    heart = PeriodicMotion("heartbeat", 0.9, 0.7, 13.0, np.stack([FAR / 8, FAR / 9, FAR / 20, 0 * FAR]), 1 + POINTS[:, 1])
    motion, model = dataclasses.replace(breath(0.5 + 5 * POINTS[:, 0]), start=7.5), plain_model()
    regular = dataclasses.replace(motion, parts=(*motion.parts, heart))
    irregular = dataclasses.replace(motion, parts=(unsteady(motion.parts[0]), heart))
    assert np.abs(irregular.paths(8_300_000_000) - regular.paths(8_300_000_000)).max() > 1e-4
    for each in (regular, irregular):
        check_saved(each, model, tmp_path)


def unsteady(part: PeriodicMotion) -> PeriodicMotion:
    """The same beside its period, too."""
    return dataclasses.replace(part, way=np.concatenate([part.way, FAR[None]]), beside=np.array([0.1, -0.2, 0.3]))


def check_saved(motion: TissueMotion, model: GaussianModel, tmp_path: Path) -> None:
    motion.save(tmp_path, model)
    same = TissueMotion.load(tmp_path / "motion.npz", model)
    assert same.parameters == motion.parameters and same.start == motion.start and same.end == motion.end
    np.testing.assert_array_equal(same.points, motion.points)
    for stamp in (0, 8_300_000_000):
        np.testing.assert_array_equal(same.paths(stamp), motion.paths(stamp))
    np.testing.assert_array_equal(same.follows(POINTS), motion.follows(POINTS))
    found = yaml.safe_load((tmp_path / "motion.yaml").read_text())["/**/physics_node"]["ros__parameters"]
    config = PhysicsConfig.from_mapping(found).motion
    assert (config.file, config.breathing_period, config.heartbeat_period) == ("motion.npz", 4.0, 0.9)
    assert [config.breathing, config.heartbeat] == pytest.approx(motion.amplitudes, abs=1e-6)
    save_ply(model, tmp_path / "model.compressed.ply")  # has fewer digits, in another order
    assert TissueMotion.load(tmp_path / "motion.npz", load_ply(tmp_path / "model.compressed.ply")).parts


def test_a_file_of_another_motion_or_none_is_refused_in_a_sentence(tmp_path):
    model, path = plain_model(), tmp_path / "motion.npz"
    breath(np.ones(len(POINTS))).save(tmp_path, model)
    moved = dataclasses.replace(model, means=model.means + torch.tensor([0.001, 0, 0]))
    for other in (plain_model(51), moved):
        with pytest.raises(
            MotionError, match=r"motion.npz: this is the motion of another model, of 50 Gaussians about \[.*\] m; the model"
        ):
            TissueMotion.load(path, other)
    with pytest.raises(MotionError, match="there is no such file"):
        TissueMotion.load(tmp_path / "missing.npz", model)
    read = dict(np.load(path))
    wrong = {"points": read["points"][1:], "period": [-4.0], "way breathing": np.zeros((3, 3)), "name": ["walking"], "shares": [[np.nan]]}
    wrong |= {"gaussians": [50, 50], "start": [0.0, 1.0]}
    twice = {name: np.repeat(read[name], 2, 0) for name in ("name", "period", "explained", "cycles", "shares")}
    huge = [("way breathing", 1e200 * read["way breathing"]), ("period", [1e-9]), ("shares", 1e9 * read["shares"])]
    for name, value in [*wrong.items(), *huge, ("shares", read["shares"] + 1j)]:
        np.savez(path, **read | {name: np.array(value)})
        with pytest.raises(MotionError, match="this is no motion that a reconstruction has written"):
            TissueMotion.load(path, model)
    beside = {"way breathing": np.concatenate([read["way breathing"], FAR[None]]), "beside breathing": np.array([0.1, 0.2])}
    np.savez(path, **read | beside)
    assert len(TissueMotion.load(path, model).parts[0].beside) == 2
    bad = [
        {"beside breathing": x} for x in (np.ones((2, 1)), np.array(1.0), np.array([np.nan]), np.array([1j]), np.zeros(0), np.array(["a"]))
    ]
    for values in [*bad, {"way breathing": read["way breathing"]}, *({"cycles": np.array([x])} for x in (0.0, -1.0, np.inf))]:
        np.savez(path, **read | beside | values)
        with pytest.raises(MotionError, match="this is no motion that a reconstruction has written"):
            TissueMotion.load(path, model)
    np.savez(path, **read | twice)
    with pytest.raises(MotionError, match="this is no motion that a reconstruction has written"):
        TissueMotion.load(path, model)
    for data in (b"", b"no archive", b"PK\x03\x04" + bytes(40)):
        path.write_bytes(data)
        with pytest.raises(MotionError, match="this is no motion that a reconstruction has written"):
            TissueMotion.load(path, model)
