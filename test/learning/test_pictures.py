"""What the endoscope shows of the environments: the tool, both eyes, labels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from played_tasks import first_steps, make, play
from thorough import mostly_thorough

from endo_sim_ros.core.light import Light
from endo_sim_ros.instruments import LINKS
from endo_sim_ros.instruments.drawing import FIRST_LINK, InstrumentDrawing
from endo_sim_ros.instruments.shapes import SHAPES
from endo_sim_ros.learning.held_tools import hold_tools
from endo_sim_ros.learning.policies import scripted_policy
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.tasks import TASKS
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig

JAWS = [FIRST_LINK + LINKS.index(link) for link in ("jaw_left", "jaw_right")]  # of PSM1


@pytest.mark.slow
@pytest.mark.parametrize("instrument", mostly_thorough([True, False]))
@pytest.mark.parametrize("light, degree", [(None, 0), (None, 1), (Light(distance=0.9, angle=0.4, response=0.3), 0)])
def test_pictures_are_those_of_the_renderer(light, degree, instrument):
    scene = load_scene()
    sh = torch.cat([scene.model.sh, torch.randn(len(scene.model), 3, 3, generator=torch.Generator().manual_seed(0))], 1)
    model = replace(scene.model, light=light, sh=sh[:, : (degree + 1) ** 2], bared=-sh[:, 0])
    scene = replace(scene, model=model, beyond=None)
    environment = make(observations="image", scene=scene, instrument=instrument, eyes=2, segmentation=True, baseline=0.005)
    batch = environment.unwrapped.batch
    script = scripted_policy("retraction")
    seen, _ = environment.reset(seed=0)
    for _ in range(16):
        seen, *_ = environment.step(script.act(batch.state())[0])
    renderer = DeformableRenderer(scene.model, batch.task.nodes.rest, RenderingConfig(device="cpu"))
    renderer.dye(batch.task.dyed_spots(0))
    pinned = torch.from_numpy(batch.task.nodes.pinned)[:, None, None]
    F = torch.where(pinned, torch.eye(3), batch.tissue.F[0])  # as on control_nodes
    camera = batch.pictures.camera
    right = camera.at(camera.pose + [[0, 0, 0, 0.005], [0] * 4, [0] * 4, [0] * 4])
    posed = None
    if instrument:
        parts, capsules = batch.tools.tools[0].shape
        drawing = InstrumentDrawing([parts], device="cpu", capsules=[capsules])
        posed = drawing.at([{link: poses[0] for link, poses in batch.tools.links(0, np.array([0])).items()}])
    views = renderer.views([camera, right], batch.tissue.positions()[0], F, labels=True, instruments=posed)
    assert batch.tissue.displacements.abs().max() > 1e-3
    np.testing.assert_array_equal(seen["image"], views[0].image)
    np.testing.assert_array_equal(seen["image_right"], views[1].image)
    assert np.abs(views[0].image.astype(int) - views[1].image).mean() > 1
    assert set(np.unique(seen["segmentation"])) & set(JAWS) if instrument else seen["segmentation"].max() == 1
    np.testing.assert_array_equal(seen["segmentation"][..., 0] > 1, views[0].labels > 1)


def test_pictures_of_two_sizes_take_nothing_from_each_other():
    """As where a person sees larger ones than the dataset has: what they are drawn with is not made anew each time."""
    environment = make(observations="image")
    environment.reset(seed=0)
    small = environment.unwrapped.batch.pictures
    large = small.at_width(100)
    drawn, frames = [], []
    for _ in range(2):
        drawn.append((small.draw()["image"], large.draw()["image"]))
        frames.append([pictures._drawings[0]._newest[2] for pictures in (small, large)])
    assert drawn[0][1].shape[2] == 100 and frames[0][0] is frames[1][0] and frames[0][1] is frames[1][1]
    for before, after in zip(*drawn, strict=True):
        np.testing.assert_array_equal(before, after)


@pytest.mark.slow
@pytest.mark.parametrize("task", mostly_thorough(TASKS, 3))
def test_the_tool_is_seen_and_changes_nothing_else(task):
    steps, made = first_steps(task), [make(task, observations="both", instrument=shown) for shown in (True, False)]
    (shown, rewards), (bare, others) = (play(each, scripted_policy(task), 3, steps)[:2] for each in made)
    assert rewards == others
    for a, b in zip(shown, bare, strict=True):
        np.testing.assert_array_equal(a["state"], b["state"])
    assert (shown[-1]["image"] != bare[-1]["image"]).any(2).mean() > 0.02


@pytest.mark.slow
@pytest.mark.parametrize("task", mostly_thorough(reversed(TASKS), 3))
def test_the_tool_is_where_the_actions_put_its_tip(task):
    environment = make(task, observations="both", segmentation=True, image_width=200)
    batch = environment.unwrapped.batch
    observation, _ = environment.reset(seed=5)
    scripts, found = scripted_policy(task), np.zeros(len(batch.task.arms), int)
    cuts = batch.task.cuts(np.ones(batch.task.fourth.shape)).ravel()
    for _ in range(36):
        for arm, tip in enumerate(batch.task.tips().reshape(-1, 3)):
            at = tip + [0, 0, batch.task.physics().contact_radius]  # a still camera looks along z
            pose = batch.pictures.poses[0]
            seen = batch.pictures.camera.K @ pose[:3, :3].T @ (at - pose[:3, 3])
            column, row = (seen[:2] / seen[2]).astype(int)
            jaws = np.argwhere(np.isin(observation["segmentation"][..., 0], np.add(JAWS, arm * len(LINKS))))
            if len(jaws) > 50:  # not out of the picture
                closed = batch.tools.angles[arm] < 0.3  # open jaws are around their tip
                assert np.linalg.norm(jaws - [row, column], axis=1).min() < (4 if closed else 30)
                found[arm] += closed or cuts[arm]  # which stay half open
        np.testing.assert_allclose(batch.tools.poses(), batch._poses(), atol=1e-9)
        observation, *_ = environment.step(scripts.act(observation["state"][None])[0])
    assert found.min() > 4


@pytest.mark.thorough
def test_every_place_of_a_task_is_in_reach():
    for name in TASKS:
        environment = make(name, observations="image")
        batch = environment.unwrapped.batch
        for seed in range(6):
            environment.reset(seed=seed)
            corners = np.array(np.meshgrid(*zip(batch.task.low, batch.task.high), indexing="ij")).reshape(3, -1).T
            for corner in corners:
                batch.task.tip[0] = corner
                arms = batch.task.hands([0])[0]
                batch.tools.move(arms, batch._poses(), np.zeros(len(arms), bool))
                np.testing.assert_allclose(batch.tools.poses(), batch._poses(), atol=1e-8)


@pytest.mark.thorough
@pytest.mark.slow
def test_tools_trocars_metal_and_lamps_vary_and_are_told():
    def first(seed=5, **kinds):
        environment = make(observations="both", randomisation=kinds, image_width=128)
        observation, info = environment.reset(seed=seed)
        environment.unwrapped.batch.task.tip[:] = 0, 0, 0.01  # in the picture
        batch = environment.unwrapped.batch
        batch.tools.begin(np.array([0]), batch._poses())
        return batch, batch.pictures.draw()["image"][0], observation["state"], info

    plain, image, state, info = first()
    assert set(info) == {"success", "force", "faults"}
    for name, most in {"trocar_angle": 20.0, "trocar_position": 0.02, "metal": 0.8, "lamp": 0.01}.items():
        batch, other, same, info = first(**{name: most})
        np.testing.assert_array_equal(same, state)
        assert (other != image).any(2).mean() > 0.01, name
        drawn = np.abs(info[name] - 1 if name == "metal" else info[name])
        assert 0.1 * most < drawn.max() < most
    moved = first(trocar_position=0.02)[0].tools.bases[0, :3, 3] - plain.tools.bases[0, :3, 3]
    np.testing.assert_allclose(moved, first(trocar_position=0.02)[3]["trocar_position"], atol=1e-12)
    names = {first(seed, tool=1.0)[3]["tool"] for seed in range(12)}
    assert len(names) > 3 and names <= set(SHAPES) - {"PERMANENT_CAUTERY_HOOK"}  # retraction closes jaws
    batch = first(tool=1.0)[0]
    assert {tool.name for tool in batch.tools.tools} == set(SHAPES) - {"PERMANENT_CAUTERY_HOOK"}
    others = hold_tools(TASKS["tracking"], load_scene(), others=True)
    assert {tool.name for tool in others} == set(SHAPES)
    assert {first(seed, tool=0.01)[3]["tool"] for seed in range(4)} == {TASKS["retraction"].tool}


def test_an_endoscope_that_moves_sees_beyond_the_edge_of_the_scene():
    black = {}
    for scene in (load_scene(), replace(load_scene(), beyond=None)):
        environment = make(observations="image", scene=scene, randomisation={"camera_position": 0.005, "camera_angle": 8.0})
        seen = np.stack([environment.reset(seed=seed)[0] for seed in range(6)])
        black[scene.beyond is None] = (seen.max(-1) < 8).mean((1, 2))
    assert (black[True] > 0.1).all() and black[False].max() == 0


def test_arms_are_measured_where_the_endoscope_of_the_episode_is():
    for task in ("retraction", "camera"):
        varied = {"camera_position": 0.005, "camera_angle": 4.0}
        environment, off = make(task, observations="sensors", segmentation=True, randomisation=varied), []
        for seed in range(4):
            seen, _ = environment.reset(seed=seed)
            x, y, z = seen["arm"][:3].astype(np.float64)
            column, row, _ = environment.unwrapped.batch.pictures.camera.K @ [x, y, z] / z
            shown = np.argwhere(np.isin(seen["segmentation"][..., 0], JAWS))
            if len(shown) > 10:  # else it begins beside the picture
                off.append(np.linalg.norm(shown - [row, column], axis=1).min())
        assert len(off) > 1 and max(off) < 4  # pixels


@pytest.mark.parametrize("task", ["retraction", "tracking"])
def test_no_picture_ends_where_the_scene_does(task):
    """Neither that of the right eye, nor that of tissue which breathes."""
    environment = make(task, observations="image", image_width=128, eyes=2, instrument=False)
    seen, _ = environment.reset(seed=0)
    for _ in range(1 if task == "retraction" else 30):
        for image in seen.values():
            assert image.max(-1).min() > 12, "black columns or rows at the edge"
        seen, *_ = environment.step(np.zeros(4))
    scene = load_scene()
    assert len(scene.seen_within(0.0, 0.0)) == len(scene.model) < len(scene.seen_within(0.004, 0.0)) < 1.2 * len(scene.model)
