"""A model that follows its nodes."""

import dataclasses
import gc
import weakref

import numpy as np
import pytest
import torch

from endo_sim_ros.core.cameras import Camera, make_pose
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.light import Light
from endo_sim_ros.instruments import Capsule, Material, Part
from endo_sim_ros.instruments.drawing import DrawingConfig, InstrumentDrawing
from endo_sim_ros.instruments.shapes import lofted
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig

CAMERA = Camera(np.array([[120.0, 0, 48], [0, 120, 40], [0, 0, 1]]), 96, 80)
CPU = RenderingConfig(device="cpu")


def sheet(degree=0):
    g = torch.Generator().manual_seed(0)
    xy = torch.rand(4000, 2, generator=g) * 0.1 - 0.05
    points = torch.cat([xy, 0.1 + 0.01 * torch.rand(4000, 1, generator=g)], 1)  # distinct depths: one order
    model = GaussianModel.from_points(points, torch.rand(4000, 3, generator=g), torch.full((4000,), 1.5e-3), 0.9, degree)
    if degree:
        model.sh[:, 1:] = 0.3 * torch.randn(model.sh[:, 1:].shape, generator=g)
    return model


NODES = sheet().means[::10].numpy()
IDENTITY = np.tile(np.eye(3, dtype=np.float32), (len(NODES), 1, 1))


def test_nodes_at_rest_change_nothing():
    renderer = DeformableRenderer(sheet(), NODES, CPU)
    image, depth = renderer.render(CAMERA)
    same, same_depth = renderer.render(CAMERA, NODES, IDENTITY)
    assert np.abs(image.astype(int) - same).max() <= 1
    np.testing.assert_allclose(depth, same_depth, atol=1e-5)
    assert depth[40, 48] == pytest.approx(0.1, abs=1e-2) and image.std() > 10


@pytest.mark.parametrize("degree", [0, 2])
def test_moving_all_nodes_rigidly_is_moving_the_camera_back(degree):
    motion = make_pose([0.004, -0.003, 0.01], [1, 0.03, -0.02, 0.05])
    renderer = DeformableRenderer(sheet(degree), NODES, CPU)
    positions = (NODES @ motion[:3, :3].T + motion[:3, 3]).astype(np.float32)
    F = np.tile(motion[:3, :3].astype(np.float32), (len(NODES), 1, 1))
    moved, _ = renderer.render(CAMERA.at(motion), positions, F)
    rest, _ = renderer.render(CAMERA)
    assert np.abs(moved.astype(int) - rest).mean() < 0.2
    unmoved, _ = renderer.render(CAMERA, positions, F)
    assert np.abs(unmoved.astype(int) - rest).mean() > 3


def test_the_clamp_of_stretches_matters_to_wild_tissue_alone():
    model = sheet()
    rest = model.means[::5].numpy()
    pictures = {}
    for clamp in (True, False):
        renderer = DeformableRenderer(model, rest, RenderingConfig(device="cpu", clamp_stretch=clamp))
        for stretch in (1.5, 9.0):
            F = np.tile(np.diag([stretch, 1.0, 1.0]), (len(rest), 1, 1))
            pictures[stretch, clamp] = renderer.deform(rest, F)[1]
    assert torch.equal(pictures[1.5, True], pictures[1.5, False])
    assert pictures[9.0, False].amax() > 4 * pictures[9.0, True].amax()


def test_background_and_empty_pixels():
    renderer = DeformableRenderer(sheet(), None, RenderingConfig(device="cpu", background=0.5))
    image, depth = renderer.render(CAMERA.at(make_pose([0, 0, 0], [0, 0, 1, 0])))  # looking away
    assert (image == 128).all() and not depth.any()


def test_width_sets_the_size_and_keeps_the_shape():
    renderer = DeformableRenderer(sheet(), None, RenderingConfig(device="cpu", image_width=48))
    image, _ = renderer.render(renderer.camera(CAMERA))
    assert image.shape == (40, 48, 3)


def instruments(at=(0.0, 0.0, 0.06), config=DrawingConfig(), device="cpu"):
    """A short steel cylinder across the view, posed."""
    angle = 2 * np.pi * np.arange(64) / 64
    rings = np.array([np.stack([4e-3 * np.cos(angle), 4e-3 * np.sin(angle), np.full(64, z)], 1) for z in (-8e-3, 8e-3)])
    capsule = Capsule("roll", np.array([0.0, 0, -8e-3]), np.array([0.0, 0, 8e-3]), 4e-3)
    drawing = InstrumentDrawing([[Part("roll", Material.STEEL, *lofted(rings))]], config, device, [[capsule]])
    pose = np.array([[0, 0, 1.0, at[0]], [0, 1, 0, at[1]], [-1, 0, 0, at[2]], [0, 0, 0, 1]])
    return drawing.at([{"roll": pose}])


def lit_sheet(response=0.0):
    model = sheet()
    return dataclasses.replace(model, light=Light(distance=0.9, response=response, level_r=-0.2, level_g=-0.2, level_b=-0.2))


def test_without_instruments_views_are_what_render_gives():
    renderer = DeformableRenderer(lit_sheet(1.0), NODES, CPU)
    image, depth = renderer.render(CAMERA, NODES, IDENTITY)
    (view,) = renderer.views([CAMERA], NODES, IDENTITY, labels=True)
    assert np.array_equal(image, view.image) and np.array_equal(depth, view.depth) and set(np.unique(view.labels)) <= {0, 1}
    (behind,) = renderer.views([CAMERA], NODES, IDENTITY, labels=True, instruments=instruments((0.0, 0.0, -0.06)))
    assert np.array_equal(image, behind.image) and np.array_equal(depth, behind.depth) and np.array_equal(view.labels, behind.labels)


def test_light_and_exposure_see_the_instrument():
    pictures = {}
    for response in (0.0, 1.0):
        renderer = DeformableRenderer(lit_sheet(response), None, CPU)
        for z in (0.02, 0.06, None):
            posed = None if z is None else instruments((0.0, 0.0, z), DrawingConfig(shadows=False))
            pictures[response, z] = renderer.views([CAMERA], labels=True, instruments=posed)[0]
    steel = {z: pictures[0.0, z].image[pictures[0.0, z].labels == 2].mean() for z in (0.02, 0.06)}
    assert steel[0.02] > 1.3 * steel[0.06]  # nearer to the lamp, but the tissue that it mirrors is not
    corner = lambda response, z: pictures[response, z].image[:8, :8].astype(float).mean()
    assert corner(0.0, 0.02) == corner(0.0, None)
    assert abs(corner(1.0, 0.02) / corner(1.0, None) - 1) > 0.05  # what is bright in the middle darkens the rest, or the other way round


def check_eyes_drawn_together(degree, device):
    renderer = DeformableRenderer(sheet(degree), NODES, RenderingConfig(device=device))
    state = (NODES + 1e-3 * np.sin(300 * NODES[:, ::-1])).astype(np.float32), 1.05 * IDENTITY
    eyes, light = (CAMERA, CAMERA.at(make_pose([0.004, 0, 0], [1, 0, 0, 0]))), Light(distance=0.9, level_r=0.1, response=0.5)
    together = renderer.views(eyes, *state, labels=True, light=light)
    for eye, view in zip(eyes, together, strict=True):
        (alone,) = renderer.views([eye], *state, labels=True, light=light, lamp=eyes[0])
        for name, picture in vars(view).items():
            assert np.array_equal(picture, getattr(alone, name)), name
    assert (together[0].image != together[1].image).any()


@pytest.mark.parametrize("degree", [0, 2])
def test_eyes_drawn_together_see_what_each_sees_alone(degree):
    check_eyes_drawn_together(degree, "cpu")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("degree", [0, 2])
def test_on_a_gpu_eyes_drawn_together_see_what_each_sees_alone(degree):
    check_eyes_drawn_together(degree, "cuda")


def test_what_pictures_were_drawn_with_is_freed_at_once():
    """Not once garbage is looked for, which is seldom: on a GPU it holds memory, and scissors cut again and again."""
    renderer, refs = DeformableRenderer(sheet(), NODES, CPU), []
    gc.collect()
    gc.disable()
    try:
        for step in range(3):
            renderer.views([CAMERA], NODES, IDENTITY, instruments=instruments())
            refs += [weakref.ref(draw) for draw in renderer._works.values()]
            renderer.cut(np.array([[[-0.03, 0.001, 0.08], [-0.02 + 0.01 * step, 0.001, 0.08], [0.0, 0.001, 0.14]]], np.float32))
        assert [ref() for ref in refs] == [None] * 3
        whole = weakref.ref(renderer)
        renderer.views([CAMERA])
        del renderer
        assert whole() is None
    finally:
        gc.enable()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("shown", ["plain", "colours by direction", "film"])
def test_on_a_gpu_pictures_that_repeat_their_work_are_those_that_do_it_for_the_first_time(shown):
    model = lit_sheet(0.5)
    if shown == "colours by direction":
        model = dataclasses.replace(model, sh=sheet(2).sh)
    elif shown == "film":
        gloss = torch.tensor([0, 0, -1.0, 0, 0.1, -1.0, 0.2, 0.3]).expand(len(model), -1).clone()
        model = dataclasses.replace(model, gloss=gloss, light=dataclasses.replace(model.light, sheen_sharpness=8.0, glint_sharpness=90.0))
    nodes = np.concatenate([NODES, NODES + np.array([0, 0, 0.006], np.float32)])  # the latter are behind the skin
    config, F = RenderingConfig(device="cuda"), np.tile(np.eye(3, dtype=np.float32), (len(nodes), 1, 1))
    right = make_pose([0.004, 0, 0], [1, 0, 0, 0])
    drawing = instruments(device="cuda").drawing
    kept = DeformableRenderer(model, nodes, config)
    done, triangles = 0, np.array([[[-0.03, 0.001, 0.08], [0.03, 0.001, 0.08], [0.0, 0.001, 0.14]]])
    for step in range(12):
        grown = nodes + np.float32(2e-3 * step * (nodes[:, :1] > 0)) * np.array([0.3, 0.0, -1.0], np.float32)
        camera = CAMERA.at(make_pose([1e-3 * step, 0, 0], [1, 0.01 * step, 0, 0]))
        eyes = [camera] if step % 4 == 3 else [camera, camera.at(camera.pose @ right)]
        pose = make_pose([0.0, 1e-3 * step, 0.06], [1, 0, 1, 0])
        posed, fresh = drawing.at([{"roll": pose}]), DeformableRenderer(model, nodes, config)
        if step >= 6:
            kept.cut(triangles)
            fresh.cut(triangles)
        pictures = [each.views(eyes, grown, (1 + 0.01 * step) * F, labels=True, instruments=posed) for each in (kept, fresh)]
        for again, first in zip(*pictures, strict=True):
            for name in ("image", "depth", "labels"):
                one, other = (getattr(view, name).astype(np.float64) for view in (again, first))
                near = np.isclose(one, other, rtol=1e-5, atol=1.01 * (name == "image"))  # sums of the light come in any order
                assert near.mean() > 0.9999, (step, name)
        done += kept.sees_tissue
    assert done == 12 and len(kept._works) == 2 and all(draw._captured for draw in kept._works.values())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_on_a_gpu_nothing_is_left_to_capture_when_a_prepared_picture_is_drawn_again(monkeypatch):
    renderer, moved = DeformableRenderer(sheet(), NODES, RenderingConfig(device="cuda")), NODES + np.float32(1e-3)
    renderer.views([CAMERA], NODES, IDENTITY)
    renderer.prepare()
    monkeypatch.setattr(torch.cuda, "graph", lambda *_, **__: pytest.fail("the picture is captured only now"))
    (again,) = renderer.views([CAMERA], moved, IDENTITY)
    (fresh,) = DeformableRenderer(sheet(), NODES, RenderingConfig(device="cuda")).views([CAMERA], moved, IDENTITY)
    assert np.abs(again.image.astype(int) - fresh.image).max() <= 1


def test_two_eyes_see_a_point_as_far_apart_as_its_depth_says():
    baseline, z = 0.005, 0.05
    renderer = DeformableRenderer(sheet(), None, CPU)
    right = CAMERA.at(make_pose([baseline, 0, 0], [1, 0, 0, 0]))
    views = renderer.views([CAMERA, right], labels=True, instruments=instruments((0.0, 0.0, z)))
    middles = [np.argwhere(view.labels == 2).mean(0) for view in views]
    nearest = z - 4e-3  # the outline lies between the middle and the front
    assert 120 * baseline / z - 0.1 < middles[0][1] - middles[1][1] < 120 * baseline / nearest + 0.1
    assert abs(middles[0][0] - middles[1][0]) < 0.1
    for view in views:
        assert view.depth[view.labels == 2].min() == pytest.approx(nearest, abs=1e-4)
    (alone,) = renderer.views([CAMERA], labels=True, instruments=instruments((0.0, 0.0, z)))
    assert np.array_equal(alone.image, views[0].image) and np.array_equal(alone.labels, views[0].labels)
    for view, eye in zip(views, (CAMERA, right)):  # one lamp for both: what is dark lies behind the instrument seen from it
        (plain,) = renderer.views([eye])
        dark = (view.labels == 1) & (view.image.astype(int).sum(-1) < 0.8 * plain.image.astype(int).sum(-1))
        points, lamp = eye.backproject(plain.depth)[dark], np.array([0.003, -0.002, 0])
        passed = lamp + (z - lamp[2]) / (points[:, 2:] - lamp[2]) * (points - lamp)  # where the light came through its plane
        assert dark.sum() > 20 and np.abs(passed[:, 1]).max() < 5.5e-3 and np.abs(passed[:, 0]).max() < 13.5e-3
