"""Points that are followed through images of tissue whose motion is known."""

from dataclasses import replace

import numpy as np
import pytest
from made_touches import STEP, S

from endo_sim_ros import messages
from endo_sim_ros.core.frames import LEFT_FRAME, Frame
from endo_sim_ros.identification.following import follow_points
from endo_sim_ros.identification.from_bag import read_frames
from endo_sim_ros.identification.recording_config import RecordingConfig
from endo_sim_ros.identification.touches import Timeline
from endo_sim_ros.messages import bag_types
from endo_sim_ros.physics import PhysicsConfig
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.bag import BagWriter

pytestmark = pytest.mark.slow
STEPS, WIDTH, SHIFT = 16, 256, 0.003  # m, of the tissue at the end
CONFIG = RecordingConfig(motion_rate=100.0, instrument_radius=0.003)


@pytest.fixture(scope="module")
def seen():
    """A model, frames in which its middle is drawn to the right, more and more, and the field of this motion."""
    from endo_sim_ros.learning.scenes import patient_scene

    scene = patient_scene()
    camera = scene.camera.resized(WIDTH, round(WIDTH * scene.camera.height / scene.camera.width))
    middle = scene.camera.position + scene.depth * scene.camera.pose[:3, 2]
    nodes = scene.nodes(PhysicsConfig(node_count=3000))
    along, width = scene.camera.pose[:3, 0], 0.01

    def field(points, share):
        return share * SHIFT * np.exp(-((points - middle) ** 2).sum(1, keepdims=True) / (2 * width**2)) * along

    renderer, frames = DeformableRenderer(scene.model, nodes.rest, RenderingConfig(image_width=0, device="cpu")), []
    for step in range(STEPS):
        share, rest = step / (STEPS - 1), nodes.rest.astype(np.float64)
        moved = field(rest, share)
        F = np.eye(3) - moved[:, :, None] * (rest - middle)[:, None] / width**2
        image = renderer.render(camera, (rest + moved).astype(np.float32), F.astype(np.float32))[0]
        frames.append(Frame(S + round(step * STEP * S), image, camera))
    return scene, frames, field, middle


def line_at(tip, touching=True):
    times = S + np.round(np.arange(STEPS) * STEP * S).astype(np.int64)
    none = np.full((STEPS, 3), np.nan)
    tips = np.tile(tip, (STEPS, 1))
    turned = np.tile(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), (STEPS, 1, 1))  # it comes from the left
    return Timeline(times, tips, turned, np.zeros(STEPS, bool), none, np.zeros(STEPS), np.full(STEPS, touching), np.zeros((STEPS, 3)))


def test_points_are_where_the_tissue_took_them(seen):
    scene, frames, field, middle = seen
    found, images, shown = follow_points(scene.model, frames, line_at(middle), [(0, STEPS)], replace(CONFIG, instrument_radius=0.0))
    tracks = found[0]
    assert images == STEPS and shown and len(tracks.rest) > 20
    np.testing.assert_array_equal(tracks.steps, np.arange(STEPS))
    errors, ways = [], []
    for step, pixels in zip(tracks.steps, tracks.pixels):
        true = tracks.cameras[step].project(tracks.rest + field(tracks.rest, step / (STEPS - 1)))[0]
        errors.append(np.linalg.norm(pixels - true, axis=1))
        ways.append(np.linalg.norm(true - tracks.cameras[step].project(tracks.rest)[0], axis=1))
    assert np.nanmax(ways) > 3  # pixels
    assert np.nanmedian(errors) < 0.25 and np.nanquantile(np.array(errors), 0.9) < 0.8
    assert np.isfinite(errors[-1]).mean() > 0.7


def test_pixels_of_the_instrument_are_left_out(seen):
    scene, frames, _, middle = seen
    camera = frames[0].camera
    line = line_at(middle)
    found, _, _ = follow_points(scene.model, frames, line, [(0, STEPS)], CONFIG)
    places = found[0].pixels[0]
    tip, z = camera.project(middle[None])
    radius = CONFIG.instrument_radius * camera.K[0, 0] / z[0]
    assert np.linalg.norm(places - tip, axis=1).min() > radius
    assert np.abs(places[places[:, 0] < tip[0, 0]][:, 1] - tip[0, 1]).min() > radius
    left = np.where(np.arange(WIDTH) < WIDTH // 2, 255, 0).astype(np.uint8)[None].repeat(camera.height, 0)
    masked = [replace(frame, mask=left) for frame in frames]
    found, _, _ = follow_points(scene.model, masked, line, [(0, STEPS)], CONFIG)
    assert np.nanmax(found[0].pixels[..., 0]) < WIDTH / 2
    found, _, _ = follow_points(scene.model, frames, line, [(0, STEPS)], replace(CONFIG, motion_reach=0.008))
    assert np.linalg.norm(found[0].rest - middle, axis=1).max() < 0.0085


def test_a_masked_instrument_takes_no_points_along(seen):
    scene, frames, field, middle = seen
    config, covered = replace(CONFIG, instrument_radius=0.0), []
    for step, frame in enumerate(frames):  # a bright bar that goes against the tissue
        image, mask = frame.image.copy(), np.full(frame.image.shape[:2], 255, np.uint8)
        left = round(WIDTH * 0.55) - 2 * step
        image[:, left : left + 24], mask[:, left : left + 24] = 230, 0
        covered.append(replace(frame, image=image, mask=mask))
    tracks = follow_points(scene.model, covered, line_at(middle), [(0, STEPS)], config)[0][0]
    errors = []
    for step, pixels in zip(tracks.steps, tracks.pixels):
        true = tracks.cameras[step].project(tracks.rest + field(tracks.rest, step / (STEPS - 1)))[0]
        errors.append(np.linalg.norm(pixels - true, axis=1))
    assert np.isfinite(errors[-1]).sum() > 10 and np.nanmax(errors) < 1.0  # pixels


def test_images_between_steps_are_taken_to_the_ends_of_steps(seen):
    scene, frames, field, middle = seen
    late = [replace(frame, stamp_ns=frame.stamp_ns + round(0.3 * STEP * S)) for frame in frames]
    found, _, _ = follow_points(scene.model, late, line_at(middle), [(0, STEPS)], replace(CONFIG, instrument_radius=0.0))
    tracks = found[0]
    step = int(np.flatnonzero(tracks.steps == STEPS - 3)[0])
    true = tracks.cameras[step].project(tracks.rest + field(tracks.rest, (STEPS - 3.3) / (STEPS - 1)))[0]
    assert np.nanmedian(np.linalg.norm(tracks.pixels[step] - true, axis=1)) < 0.25


def test_points_that_were_hidden_are_found_again_and_as_many_images_count_as_are_wanted(seen):
    scene, frames, _, middle = seen
    dark = [replace(frame, image=frame.image // 50) if 5 <= k < 8 else frame for k, frame in enumerate(frames)]
    config = replace(CONFIG, instrument_radius=0.0, motion_rate=8.0)
    found, _, _ = follow_points(scene.model, dark, line_at(middle), [(0, STEPS)], config)
    tracks = found[0]
    np.testing.assert_array_equal(tracks.steps, [0, 4, 7, 10, 13])
    seen_in = np.isfinite(tracks.pixels[:, :, 0]).mean(1)
    assert seen_in[2] < 0.5 and seen_in[-1] > 0.7
    few, _, _ = follow_points(scene.model, frames[::3], line_at(middle), [(0, STEPS)], replace(config, motion_rate=9.0))
    np.testing.assert_array_equal(few[0].steps, [0, 3, 6, 9, 12, 15])


def test_a_camera_that_looks_away_is_told(seen):
    scene, frames, _, middle = seen
    away = frames[0].camera.pose.copy()
    away[:3, :3] = away[:3, :3] @ np.diag([1.0, -1, -1])
    turned = [replace(frame, camera=frame.camera.at(away)) for frame in frames]
    found, _, shown = follow_points(scene.model, turned, line_at(middle), [(0, STEPS)], CONFIG)
    assert not found and not shown


@pytest.mark.parametrize("rendered", [True, False])
def test_images_of_a_recording_come_with_cameras_and_masks(seen, tmp_path, rendered):
    _, frames, _, _ = seen
    types, camera = bag_types(), frames[0].camera
    labels = np.where(np.arange(WIDTH) < 50, 1, 4).astype(np.uint8)[None].repeat(camera.height, 0)
    mask = np.where(labels == 1, 255, 0).astype(np.uint8)
    info, pose, image, third = (
        (messages.RENDERED_INFO, messages.RENDERED_POSE, messages.RENDERED_IMAGE, messages.RENDERED_SEGMENTATION)
        if rendered
        else (messages.LEFT_INFO, messages.CAMERA_POSE, messages.LEFT_IMAGE, messages.MASK)
    )
    with BagWriter(tmp_path / "bag") as bag:
        for frame in frames[:4]:
            stamp, size = frame.stamp_ns, (camera.width, camera.height)
            bag.write(info, messages.encode_camera_info(camera.K, *size, stamp, LEFT_FRAME, types=types), stamp)
            bag.write(pose, messages.encode_pose(camera.pose, stamp, "world", types), stamp)
            bag.write(third, messages.encode_image(labels if rendered else mask, stamp, LEFT_FRAME, types), stamp)
            bag.write(image, messages.encode_image(frame.image, stamp, LEFT_FRAME, types), stamp)
    topics = {info: "info", pose: "pose", image: "image", third: "mask"}
    read = list(read_frames(tmp_path / "bag", topics, {"world": np.eye(4)}))
    assert [frame.stamp_ns for frame in read] == [frame.stamp_ns for frame in frames[:4]]
    np.testing.assert_array_equal(read[2].image, frames[2].image)
    np.testing.assert_array_equal(read[2].mask, mask)
    np.testing.assert_allclose(read[2].camera.pose, camera.pose, atol=1e-9)
