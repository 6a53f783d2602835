"""rendering_node: good and bad cameras and states, and what its images show."""

import numpy as np
import pytest
from bad_messages import BAD_RECORDINGS, truncate
from ros_bench import HEIGHT, WIDTH, K, S, await_image, await_nodes, newest_image, pull, send_camera, send_model, sheet

from endo_sim_ros import messages
from endo_sim_ros.core.dye import DyedSpot
from endo_sim_ros.messages import OK, WARN
from endo_sim_ros.nodes.configs import RenderingNodeConfig
from endo_sim_ros.nodes.rendering_node import idle_period

pytestmark = pytest.mark.dds


def bad_camera(**changes):
    message = messages.encode_camera_info(K, WIDTH, HEIGHT, S, "endoscope_left")
    for name, value in changes.items():
        setattr(message, name, value)
    return messages.LEFT_INFO, message


BAD_CAMERAS = {
    "zero_K": (lambda: bad_camera(k=np.zeros(9)), "the camera is not calibrated"),
    "no_size": (lambda: bad_camera(width=0), "the image size is 0×80"),
    "absurd_size": (lambda: bad_camera(width=4_000_000_000, k=np.diag([2e9, 2e9, 1]).ravel(), p=np.zeros(12)), "too large to render"),
    "non_finite_pose": (lambda: BAD_RECORDINGS["non_finite_pose"][0](_Posed), "the pose is not finite"),
    "non_unit_pose": (lambda: BAD_RECORDINGS["non_unit_pose"][0](_Posed), "normalise it"),
    "unknown_frame": (lambda: BAD_RECORDINGS["unknown_frame"][0](_Posed), "unknown frame 'base_link'"),
}


class _Posed:
    stamp_ns = S

    class camera:  # noqa: N801
        pose = np.eye(4)


@pytest.mark.parametrize("name", BAD_CAMERAS)
def test_bad_camera_is_one_sentence_and_a_good_one_still_renders(bench, rendering, name):
    send_model(bench)
    make, sentence = BAD_CAMERAS[name]
    topic, message = make()
    bench.publish(topic, message)
    bench.refused("rendering_node", sentence, topic.name)
    send_camera(bench)
    assert await_image(bench, lambda image: image.max() > 100).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("place", [(20.0, 0.0, 60.0), (0.0, 0.0, -20.0)])  # beside it, and a speck of it
def test_a_camera_that_sees_next_to_no_tissue_is_told_until_one_does(bench, rendering, place):
    send_model(bench)
    pose = np.eye(4)
    pose[:3, 3] = place  # millimetres
    send_camera(bench, pose)
    _, text, values = bench.status(
        "rendering_node", f"the camera at {list(place)} sees next to no tissue, the middle of which is at [", WARN
    )
    middle = text.partition("middle of which is at [")[2].partition("]")[0]
    assert all(len(number) < 8 for number in middle.split(", ")), "to a tenth of a millimetre"
    assert "ECM/measured_cp" in text and "metres" in text and values["state"] == "rendering"
    send_camera(bench)
    await_image(bench, lambda image: image.max() > 100)
    bench.status("rendering_node", "rendering", OK, since=len(bench.statuses["rendering_node"]))


def test_a_spot_of_dye_is_shown_until_it_is_taken_away_and_a_bad_one_changes_nothing(bench, rendering):
    """Of a blue spot in the middle of what the camera sees, the blue stays in its place, also when a new model comes."""
    send_model(bench)
    send_camera(bench)
    plain = await_image(bench, lambda image: image.max() > 100)
    middle = sheet(8).means.numpy().mean(0)
    blue = lambda image: image[HEIGHT // 2, WIDTH // 2, 2] > 200 > 60 > image[HEIGHT // 2, WIDTH // 2, 0]
    assert not blue(plain)
    bench.publish(messages.DYE, messages.encode_dye([DyedSpot(middle, 0.004, (0.0, 0.0, 1.0))], S, "world"))
    shown = await_image(bench, blue)
    np.testing.assert_array_equal(shown[:5, :5], plain[:5, :5])
    for bad, sentence in (
        (DyedSpot(middle * np.nan, 0.004), "spots are spheres (type 2) with a finite position"),
        (DyedSpot(middle, -1.0), "a scale above 0"),
        (DyedSpot(middle, 0.004, (0.0, 0.0, 9.0)), "colours from 0 to 1"),
    ):
        bench.publish(messages.DYE, messages.encode_dye([bad], S, "world"))
        bench.refused("rendering_node", sentence, "dye: marker 0")
    bench.publish(messages.DYE, messages.encode_dye([], S, "PSM1"))  # no spots are in no frame
    await_image(bench, lambda image: np.array_equal(image, plain))
    bench.publish(messages.DYE, messages.encode_dye([DyedSpot(middle, 0.004)], S, "PSM1"))
    bench.refused("rendering_node", "unknown frame 'PSM1'")


def test_control_nodes_that_are_damaged_or_of_another_model_leave_the_picture_alone(bench, rendering):
    send_model(bench)
    send_camera(bench)
    at_rest = await_image(bench, lambda image: image.max() > 100)
    rest = sheet(8).means.numpy()
    F = np.tile(np.eye(3, dtype=np.float32), (len(rest), 1, 1))

    def state(stamp, positions):
        return messages.encode_control_nodes(messages.ControlNodeCloud(rest, positions, F, stamp), S, "world")

    damaged = state(5 * S, rest)
    truncate(damaged)
    lacking = state(5 * S, rest)
    lacking.fields = lacking.fields[:5]
    for message, sentence in (
        (damaged, "the cloud is truncated"),
        (lacking, "missing field rest_z"),
        (state(5 * S, rest * np.nan), "a control node is not finite"),
    ):
        bench.publish(messages.CONTROL_NODES, message)
        bench.refused("rendering_node", sentence, "control_nodes")
    count = len(bench.heard["rendered/image_raw"])
    bench.publish(messages.CONTROL_NODES, state(4 * S, rest + np.float32(0.02)))
    bench.until(lambda: len(bench.heard["rendered/image_raw"]) > count + 3, "more pictures")
    assert np.array_equal(newest_image(bench), at_rest)
    bench.publish(messages.CONTROL_NODES, state(5 * S, rest + np.float32(0.02)))
    await_image(bench, lambda image: np.abs(image - at_rest).max() > 50, "the tissue to move with its nodes")
    assert bench.status("rendering_node", "rendering", OK)


def test_extreme_nodes_and_poses_do_not_end_the_node(bench, rendering):
    send_model(bench)
    send_camera(bench)
    await_image(bench, lambda image: image.max() > 100)
    rest = sheet(8).means.numpy()
    for scale in (1e-30, 1e10, 1e30):
        F = np.full((len(rest), 3, 3), scale, np.float32)
        cloud = messages.ControlNodeCloud(rest, (rest * np.float32(scale)), F, 5 * S)
        bench.publish(messages.CONTROL_NODES, messages.encode_control_nodes(cloud, S, "world"))
        far = np.eye(4)
        far[:3, 3] = scale
        send_camera(bench, far)
        count = len(bench.heard["rendered/image_raw"])
        bench.until(lambda: len(bench.heard["rendered/image_raw"]) > count + 2, f"pictures at {scale}")
    F = np.tile(np.eye(3, dtype=np.float32), (len(rest), 1, 1))
    cloud = messages.ControlNodeCloud(rest, rest, F, 5 * S)
    bench.publish(messages.CONTROL_NODES, messages.encode_control_nodes(cloud, S, "world"))
    send_camera(bench)
    await_image(bench, lambda image: image.max() > 100, "the tissue again")


def test_the_picture_follows_camera_info_pose_and_parameters(bench, rendering):
    send_model(bench)
    send_camera(bench)
    first = await_image(bench, lambda image: image.max() > 100)
    send_camera(bench, width=48, height=40)
    await_image(bench, lambda image: image.shape == (40, 48, 3), "the size of the new camera_info")
    aside = np.eye(4)
    aside[0, 3] = 0.03
    send_camera(bench, aside)
    await_image(bench, lambda image: image.shape == first.shape and np.abs(image - first).max() > 50, "the new pose")
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    send_camera(bench, away)
    await_image(bench, lambda image: image.max() == 0, "nothing behind the camera")
    assert bench.set("rendering_node", background=1.0)[0]
    await_image(bench, lambda image: image.min() == 255, "a white background")
    assert bench.set("rendering_node", image_width=32)[0]
    await_image(bench, lambda image: image.shape[1] == 32, "the width asked for")
    assert not bench.set("rendering_node", device="cuda:99")[0]


def test_images_bear_the_stamp_of_the_state_that_they_show(bench, rendering):
    infos, poses, depths = (bench.hear(topic) for topic in messages.RENDERED_TOPICS if topic != messages.RENDERED_IMAGE)
    images = bench.heard["rendered/image_raw"]
    stamp_of = lambda message: messages.stamp_to_ns(message.header.stamp)  # noqa: E731
    send_model(bench)
    send_camera(bench)
    await_image(bench, lambda image: image.max() > 100)
    rest = sheet(8).means.numpy()
    F = np.tile(np.eye(3, dtype=np.float32), (len(rest), 1, 1))

    def shown(shift, stamp):
        """Stamp of the first image of this state."""
        before = newest_image(bench)
        cloud = messages.ControlNodeCloud(rest, rest + np.float32([shift, 0, 0]), F, 5 * S)
        count = len(images)
        bench.publish(messages.CONTROL_NODES, messages.encode_control_nodes(cloud, stamp, "world"))

        def first():
            new = [image for image in images[count:] if np.abs(messages.decode_image(image).astype(int) - before).max() > 50]
            return new and stamp_of(new[0])

        return bench.until(first, "an image of the state")

    shown(0.01, rendering.now_ns())  # from now on the renderer is bound to the nodes
    bench.until(lambda: rendering.status()[2]["following control nodes"], "the renderer to follow")
    assert bench.set("rendering_node", idle_rate=0.1)[0]  # nothing in between
    for shift in (0.02, 0.03):
        while True:
            bench.spin(0.1)
            taken = rendering.now_ns()
            bench.spin(0.2)  # on its way
            if stamp_of(images[-1]) < taken:  # no picture at rest, of which one comes in ten seconds, came meanwhile
                break
        assert shown(shift, taken) == taken
    moved_at = rendering.now_ns()
    aside = np.eye(4)
    aside[0, 3] = 0.03
    send_camera(bench, aside)
    await_image(bench, lambda _: stamp_of(images[-1]) > moved_at, "an image of the moved camera, of the time when it is shown")
    assert shown(0.0, moved_at - S) > moved_at, "no stamp goes back"
    assert shown(0.02, rendering.now_ns() + 100 * S) < rendering.now_ns(), "a clock that is ahead is not believed"
    assert bench.set("rendering_node", idle_rate=20.0)[0]
    count = len(images)
    bench.until(lambda: len(images) > count + 3, "the same again")
    stamps = [stamp_of(image) for image in images]
    assert stamps == sorted(set(stamps))
    bench.until(lambda: len(poses) == len(infos) == len(images) and stamp_of(depths[-1]) == stamp_of(images[-1]))
    assert stamps == [stamp_of(info) for info in infos][: len(stamps)] == [stamp_of(pose) for pose in poses][: len(stamps)]


def test_training_cameras_are_used_until_a_camera_comes(bench, rendering):
    bench.status("rendering_node", "waiting for a model", WARN)
    send_model(bench)
    bench.status("rendering_node", "waiting for a camera", WARN)
    info = messages.encode_camera_info(K, WIDTH, HEIGHT, 5 * S, "endoscope_left")
    bench.publish(messages.TRAINING_CAMERA_INFO, info)
    poses, infos = bench.hear(messages.RENDERED_POSE), bench.hear(messages.RENDERED_INFO)
    image = await_image(bench, lambda image: image.max() > 100)
    assert image.shape == (HEIGHT, WIDTH, 3)
    bench.until(lambda: poses and infos)
    stamps = {messages.stamp_to_ns(m.header.stamp) for m in bench.heard["rendered/image_raw"]}
    assert messages.stamp_to_ns(poses[0].header.stamp) in stamps and infos[0].width == WIDTH


def test_rendered_tissue_follows_a_wrench_and_comes_back(bench, physics, rendering):
    send_model(bench, sheet(tilt=0.3))
    send_camera(bench)
    await_nodes(bench, 5 * S)
    bench.status("rendering_node", "rendering", OK)
    bench.until(lambda: rendering.status()[2]["following control nodes"], "the renderer to follow the nodes")
    at_rest = await_image(bench, lambda image: image.max() > 100)
    pull(bench, lambda: np.abs(newest_image(bench) - at_rest).max() > 30, (0.8, 0, -1.5), what="pixels to change")
    await_image(bench, lambda image: np.abs(image - at_rest).max() < 12, "the tissue to come back")


@pytest.mark.parametrize(("rate", "idle"), [(25.0, 5.0), (6.0, 5.0), (2.0, 5.0), (100.0, 0.5)])
def test_images_of_what_rests_are_no_more_than_asked_for(rate, idle):
    """The timer asks four times per image; at the first moment that is late enough an image comes."""
    options = RenderingNodeConfig(rate=rate, idle_rate=idle)
    poll = 1 / rate / 4
    period = np.ceil(idle_period(options) / poll - 1e-9) * poll
    assert period == pytest.approx(1 / min(rate, idle), abs=poll / 2)
