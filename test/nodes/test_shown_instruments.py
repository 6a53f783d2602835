"""rendering_node: instruments where their links are said to be, the other eye, labels, and compressed images."""

import numpy as np
import pytest
import rclpy
from ros_bench import HEIGHT, WIDTH, Bench, K, S, await_image, newest_image, send_camera, send_model, sheet
from waiting import wait_until

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, make_pose
from endo_sim_ros.instruments import LINKS, build_instrument, link_poses, load_arm, part_links, place_arm
from endo_sim_ros.instruments.config import DrawingConfig
from endo_sim_ros.instruments.drawing import InstrumentDrawing
from endo_sim_ros.learning.tasks import Clip
from endo_sim_ros.messages import OK, MessageError
from endo_sim_ros.nodes.rendering_node import RenderingNode
from endo_sim_ros.nodes.shown_instruments import THING, ShownInstruments
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig

pytestmark = pytest.mark.dds

TOOLS = {"PSM1": "LARGE_NEEDLE_DRIVER:400006", "PSM2": "PROGRASP_FORCEPS"}
CAMERA = Camera(K, WIDTH, HEIGHT)
BASELINE = 0.005


def links(name, aside=0.0):
    arm = load_arm("PSM", TOOLS[name])
    place = place_arm(name, arm, CAMERA, 0.08)
    shift = make_pose([aside, 0, 0], [1, 0, 0, 0])
    return {link: shift @ place.base @ pose for link, pose in link_poses(arm, place.joints, 0.6).items()}


def send_links(bench, name, poses, stamp=S):
    bench.publish(messages.tool_links(name), messages.encode_poses(list(poses.values()), stamp, "world"))


def send_type(bench, name, tool=None):
    bench.publish(messages.tool_type(name), messages.encode_text(tool or TOOLS[name]))


def send_state(bench, stamp, shift=0.0, model_stamp=5 * S):
    rest = sheet(8).means.numpy()
    F = np.tile(np.eye(3, dtype=np.float32), (len(rest), 1, 1))
    cloud = messages.ControlNodeCloud(rest, rest + np.float32([shift, 0, 0]), F, model_stamp)
    bench.publish(messages.CONTROL_NODES, messages.encode_control_nodes(cloud, stamp, "world"))


def expected(names, cameras=(CAMERA,)):
    """What the library renders at rest."""
    tools = [build_instrument(load_arm("PSM", TOOLS[name])) for name in names]
    posed = None
    if tools:
        drawing = InstrumentDrawing([parts for parts, _ in tools], device="cpu", capsules=[capsules for _, capsules in tools])
        posed = drawing.at([links(name) for name in names])
    renderer = DeformableRenderer(sheet(), None, RenderingConfig(device="cpu"))
    return renderer.views(list(cameras), labels=True, instruments=posed)


def expected_at(shift):
    """What the library renders of PSM1, shifted."""
    parts, capsules = build_instrument(load_arm("PSM", TOOLS["PSM1"]))
    posed = InstrumentDrawing([parts], device="cpu", capsules=[capsules]).at([links("PSM1", shift)])
    return DeformableRenderer(sheet(), None, RenderingConfig(device="cpu")).views([CAMERA], instruments=posed)[0]


def start(mode, *parameters):
    given = ("arms:=[PSM1, PSM2]", "device:=cpu", f"mode:={mode}", *parameters)
    rclpy.init(args=["--ros-args", *(word for each in given for word in ("-p", each))])
    bench = Bench()
    bench.hear(messages.RENDERED_IMAGE)
    bench.add(RenderingNode)
    return bench


@pytest.fixture
def bench():
    bench = start("realtime")
    send_model(bench)
    send_camera(bench)
    await_image(bench, lambda image: image.max() > 100)
    yield bench
    bench.close()
    rclpy.try_shutdown()


@pytest.fixture
def steps():
    bench = start("lockstep")
    send_camera(bench)
    send_model(bench)
    yield bench
    bench.close()
    rclpy.try_shutdown()


def shows(bench, view, what):
    await_image(bench, lambda image: np.array_equal(image, view.image), what)


def newest(bench, topic, condition=lambda message: True):
    heard = bench.heard[topic.name]
    bench.until(lambda: heard and condition(heard[-1]), f"{topic.name}")
    return heard[-1]


def test_instruments_come_go_and_are_told_apart(bench):
    for name in TOOLS:
        send_type(bench, name)
    send_links(bench, "PSM2", links("PSM2"))
    shows(bench, expected(["PSM2"])[0], "PSM2 alone")
    told = lambda: bench.nodes[1].status()[2]["instruments"]
    assert told() == 1
    bench.hear(messages.RENDERED_SEGMENTATION)
    of_second = {2 + 5 + LINKS.index(link) for link in ("roll", "wrist_pitch", "jaw_left", "jaw_right")}
    labels = lambda message: np.frombuffer(message.data, np.uint8)
    found = lambda message: set(labels(message).tolist())
    newest(bench, messages.RENDERED_SEGMENTATION, lambda message: of_second <= found(message) <= of_second | {0, 1})
    send_links(bench, "PSM1", links("PSM1"))
    shows(bench, expected(["PSM1", "PSM2"])[0], "both")
    assert told() == 2
    both = newest(bench, messages.RENDERED_SEGMENTATION, lambda message: 2 in found(message))
    assert (both.encoding, both.height, both.width) == ("mono8", HEIGHT, WIDTH)
    library = expected(["PSM1", "PSM2"])[0]  # once: nothing is heard meanwhile
    assert np.array_equal(labels(both).reshape(HEIGHT, WIDTH) > 1, library.labels > 1)
    send_links(bench, "PSM1", links("PSM1", 0.004))
    await_image(bench, lambda image: np.abs(image - library.image).max() > 60, "PSM1 to move")
    assert bench.set("rendering_node", instruments=False)[0]
    shows(bench, expected([])[0], "the tissue alone")
    assert told() == 0


def test_the_first_picture_after_its_links_shows_an_instrument(bench):
    assert bench.set("rendering_node", idle_rate=0.1)[0]
    send_type(bench, "PSM1")
    prepared = bench.nodes[1].instruments._background
    bench.until(lambda: prepared._future is not None and prepared._future.done(), "what draws it")
    bench.spin(0.2)  # no more pictures come
    bench.heard[messages.RENDERED_IMAGE.name].clear()
    send_links(bench, "PSM1", links("PSM1"))
    bench.until(lambda: bench.heard[messages.RENDERED_IMAGE.name], "a picture")
    first = messages.decode_image(bench.heard[messages.RENDERED_IMAGE.name][0], "rendered")
    np.testing.assert_array_equal(first, expected(["PSM1"])[0].image)


def test_pictures_show_a_state_with_its_own_links_unless_these_are_lost(bench):
    images = bench.heard[messages.RENDERED_IMAGE.name]
    send_type(bench, "PSM1")
    send_links(bench, "PSM1", links("PSM1"), 6 * S)
    send_state(bench, 6 * S)
    bench.until(lambda: bench.nodes[1].status()[2]["following control nodes"], "the renderer to follow")
    shows(bench, expected(["PSM1"])[0], "the instrument")
    assert bench.set("rendering_node", rate=1.0, idle_rate=0.1)[0]  # nothing in between, and links may take a second
    bench.spin(0.5)

    def first_picture(*sends):
        """The first picture after the last of some messages; before that there is none."""
        count = len(images)
        for send, shift, stamp in sends[:-1]:
            send(stamp, shift)
            bench.spin(0.2)
        assert len(images) == count
        send, shift, stamp = sends[-1]
        send(stamp, shift)
        bench.until(lambda: len(images) > count, "a picture")
        return messages.decode_image(images[count])

    state = lambda stamp, shift: send_state(bench, stamp, shift)
    moved = lambda stamp, shift: send_links(bench, "PSM1", links("PSM1", shift), stamp)
    away = first_picture((state, 0.004, 7 * S), (moved, 0.004, 7 * S))
    back = first_picture((state, 0.0, 8 * S), (moved, 0.0, 8 * S))
    assert np.abs(away.astype(int) - back).max() > 60
    assert np.array_equal(first_picture((moved, 0.004, 9 * S), (state, 0.004, 9 * S)), away)  # links overtake their state
    alone = first_picture((state, 0.0, 10 * S))  # after a second, as its links are lost
    assert not any(np.array_equal(alone, picture) for picture in (away, back))


def test_what_cannot_be_drawn_is_one_sentence(bench):
    send_links(bench, "PSM1", dict(list(links("PSM1").items())[:3]))
    bench.refused("rendering_node", "3 poses; publish those of roll, wrist_pitch", "PSM1/link_poses")
    send_type(bench, "PSM1", "SPOON")
    bench.refused("rendering_node", "SPOON", "PSM1/tool_type")
    bench.until(lambda: "SPOON" in bench.nodes[1].status()[1], "a status that goes on saying so")
    send_links(bench, "PSM1", links("PSM1"))
    shows(bench, expected([])[0], "the tissue alone")
    send_type(bench, "PSM1")
    shows(bench, expected(["PSM1"])[0], "the instrument after all")
    send_type(bench, "PSM1", "LADLE")
    bench.refused("rendering_node", "LADLE", "PSM1/tool_type", "PSM1 is drawn as before")
    send_links(bench, "PSM1", links("PSM1", 0.004))
    await_image(bench, lambda image: np.array_equal(image, expected_at(0.004).image), "the instrument where it moves")


def test_the_right_eye_and_compressed_images_for_those_who_ask(bench):
    send_type(bench, "PSM1")
    send_links(bench, "PSM1", links("PSM1"))
    topics = messages.RENDERED_RIGHT_IMAGE, messages.RENDERED_RIGHT_INFO, messages.RENDERED_RIGHT_COMPRESSED, messages.RENDERED_COMPRESSED
    for topic in topics:
        bench.hear(topic)
    newest(bench, messages.RENDERED_COMPRESSED)
    assert not bench.heard[messages.RENDERED_RIGHT_IMAGE.name]  # nobody knows the baseline
    right = messages.encode_camera_info(K, WIDTH, HEIGHT, S, "endoscope_right", BASELINE)
    bench.publish(messages.RIGHT_INFO, right)
    eyes = expected(["PSM1"], [CAMERA, CAMERA.at(make_pose([BASELINE, 0, 0], [1, 0, 0, 0]))])
    stamps = lambda topic: {messages.stamp_to_ns(m.header.stamp): m for m in bench.heard[topic.name]}
    complete = lambda: stamps(messages.RENDERED_RIGHT_IMAGE).keys() & stamps(messages.RENDERED_RIGHT_INFO).keys()
    shown = lambda: [s for s in complete() if np.array_equal(messages.decode_image(stamps(topics[0])[s]), eyes[1].image)]
    stamp = bench.until(shown, "the right eye")[0]
    image, info = (stamps(topic)[stamp] for topic in topics[:2])
    assert image.header.frame_id == info.header.frame_id == "endoscope_right"
    assert messages.decode_camera_info(info).baseline == pytest.approx(BASELINE)
    assert stamp in stamps(messages.RENDERED_IMAGE)
    for topic, view in ((messages.RENDERED_RIGHT_COMPRESSED, eyes[1]), (messages.RENDERED_COMPRESSED, eyes[0])):
        heard = bench.heard[topic.name]
        near = lambda: heard and np.abs(messages.decode_image(heard[-1]).astype(int) - view.image).mean() < 4  # noqa: B023
        bench.until(near, topic.name)
        assert len(heard[-1].data) < 0.5 * view.image.nbytes


def test_in_lockstep_a_renderer_that_lags_episodes_behind_shows_each_state_with_its_own_links():
    bench = start("lockstep")
    send_model(bench)
    send_type(bench, "PSM1")
    # Stamps and where the instrument is: in both episodes two resets after the first one, of which the last is shown.
    episodes = [
        [(5 * S, 0.0), (5 * S, 0.001), (5 * S, 0.002), (6 * S, 0.003), (7 * S, 0.004)],
        [(5 * S, 0.006), (5 * S, 0.007), (5 * S, 0.008), (6 * S, 0.009), (7 * S, 0.010)],
    ]
    for stamp, shift in (state for episode in episodes for state in episode):
        send_links(bench, "PSM1", links("PSM1", shift), stamp)
        send_state(bench, stamp)
    shown = [state for episode in episodes for state in episode[2:]]
    images = bench.heard["rendered/image_raw"]
    bench.status("rendering_node", "waiting for a camera")
    send_camera(bench)
    bench.until(lambda: len(images) == len(shown), "all pictures", 60)
    assert [messages.stamp_to_ns(image.header.stamp) for image in images] == [stamp for stamp, _ in shown]
    for image, (stamp, shift) in zip(images, shown):
        assert np.array_equal(messages.decode_image(image), expected_at(shift).image), stamp
    bench.close()
    rclpy.try_shutdown()


def test_in_lockstep_poses_of_the_camera_that_come_after_the_states_of_two_episodes_are_those_of_their_own():
    bench = start("lockstep", "lockstep_camera:=true")
    poses = bench.hear(messages.RENDERED_POSE)
    send_model(bench)
    send_camera(bench)
    bench.status("rendering_node", "in lockstep", OK)
    states = [5 * S, 6 * S, 7 * S] * 2
    for stamp in states:
        send_state(bench, stamp)
    for k, stamp in enumerate(states):
        if stamp > 5 * S:
            pose = make_pose([0.001 * k, 0, 0], [1, 0, 0, 0])
            bench.publish(messages.CAMERA_POSE, messages.encode_pose(pose, stamp, "world"))
    bench.until(lambda: len(poses) == len(states), "all pictures", 60)
    assert [messages.stamp_to_ns(pose.header.stamp) for pose in poses] == states
    shown = [messages.decode_pose(pose, "world", "")[0, 3] for pose in poses]
    assert [shown[k] for k in (1, 2, 4, 5)] == pytest.approx([0.001, 0.002, 0.004, 0.005])
    bench.close()
    rclpy.try_shutdown()


def test_in_lockstep_each_state_waits_for_its_links(steps):
    images = steps.heard["rendered/image_raw"]
    stamp_of = lambda message: messages.stamp_to_ns(message.header.stamp)
    send_type(steps, "PSM1")
    send_state(steps, 5 * S)
    steps.status("rendering_node", "for PSM1/link_poses of 5.000000 s", OK)
    assert not images
    send_state(steps, 6 * S)
    for stamp, aside in ((5 * S, 0.0), (6 * S, 0.004)):
        send_links(steps, "PSM1", links("PSM1", aside), stamp)
    steps.until(lambda: len(images) == 2, "both images", 60)
    assert [stamp_of(image) for image in images] == [5 * S, 6 * S]
    moved = [messages.decode_image(image).astype(int) for image in images]
    assert np.abs(moved[0] - moved[1]).max() > 60
    send_links(steps, "PSM1", {}, 7 * S)  # nobody knows where it is
    send_state(steps, 7 * S)
    steps.until(lambda: len(images) == 3, "the tissue alone")
    assert np.abs(newest_image(steps) - moved[1]).max() > 60
    send_links(steps, "PSM1", links("PSM1"), 5 * S)  # a reset
    send_state(steps, 5 * S)
    steps.until(lambda: len(images) == 4, "the first observation")
    assert np.array_equal(newest_image(steps), moved[0])
    send_state(steps, 6 * S)
    send_state(steps, 7 * S)
    send_links(steps, "PSM1", links("PSM1"), 7 * S)  # those of 6 s are lost
    steps.until(lambda: len(images) == 6, "the states after")
    assert [stamp_of(image) for image in images[-2:]] == [6 * S, 7 * S]


def test_in_lockstep_links_of_a_rest_that_were_lost_hold_up_no_rest_after_it(steps):
    images = steps.heard["rendered/image_raw"]
    send_type(steps, "PSM1")
    send_state(steps, 5 * S)  # its links came before anybody listened
    for count, aside in enumerate((0.0, 0.004), 1):
        send_state(steps, 5 * S)
        send_links(steps, "PSM1", links("PSM1", aside), 5 * S)
        steps.until(lambda: len(images) == count, "the picture at rest", 60)
    send_state(steps, 6 * S)
    send_links(steps, "PSM1", links("PSM1"), 6 * S)
    steps.until(lambda: len(images) == 3, "the first step")
    at_rest, placed, stepped = (messages.decode_image(image) for image in images)
    assert np.array_equal(stepped, at_rest) and not np.array_equal(placed, at_rest)


def test_in_lockstep_arms_that_were_found_one_after_another_are_shown_with_links_of_one_state(steps):
    images = steps.heard["rendered/image_raw"]
    for arm in ("PSM1", "PSM2"):
        send_type(steps, arm)
    send_state(steps, 5 * S)
    for arms in (("PSM1",), ("PSM1", "PSM2")):  # those of PSM2 were lost twice, those of PSM1 once
        send_state(steps, 5 * S)
        for arm in arms:
            send_links(steps, arm, links(arm), 5 * S)
    steps.until(lambda: len(images) == 1, "the picture at rest", 60)
    send_state(steps, 5 * S)  # placed
    for arm in ("PSM1", "PSM2"):
        send_links(steps, arm, links(arm, 0.004), 5 * S)
    steps.until(lambda: len(images) == 2, "the picture of where they are placed")
    send_state(steps, 6 * S)
    for arm in ("PSM1", "PSM2"):
        send_links(steps, arm, links(arm, 0.004), 6 * S)
    steps.until(lambda: len(images) == 3, "the first step")
    at_rest, placed, stepped = (messages.decode_image(image) for image in images)
    assert np.array_equal(stepped, placed) and not np.array_equal(placed, at_rest)


def prepared(*arms, thing=None):
    """Instruments of arms whose tools are known, prepared before any links came."""
    shown = ShownInstruments(arms, False, thing)
    for name in arms:
        shown.receive_type(name, messages.encode_text(TOOLS[name]))
    assert shown.posed({}, DrawingConfig(), "cpu") is None
    wait_until(lambda: shown._background._future.done(), 20, "the preparation")
    return shown


def posed_soon(shown, names):
    """What draws arms, once that is prepared."""
    at = {name: np.array(list(links(name).values())) for name in names}
    found = lambda: shown.posed(at, DrawingConfig(), "cpu")
    return wait_until(lambda: (posed := found()) is not False and (posed,), 10, "instruments")[0]


def test_what_draws_two_arms_is_kept_while_links_of_one_have_come():
    shown = prepared(*TOOLS)
    first = {"PSM1": np.array(list(links("PSM1").values()))}
    assert shown.posed(first, DrawingConfig(), "cpu") is False
    for names in (("PSM1", "PSM2"), ("PSM2",), ("PSM1", "PSM2"), ("PSM1",)):
        assert len(posed_soon(shown, names).poses) == len(names)
    shown.stop()


def test_a_failure_is_told_when_its_arms_are_to_be_drawn():
    capsules = build_instrument(load_arm("PSM", TOOLS["PSM1"]))[1]
    shown = prepared("PSM1", thing=([], capsules[:1] * 65))
    first = np.array(list(links("PSM1").values()))
    assert shown.posed({"PSM1": first}, DrawingConfig(), "cpu") is False
    with pytest.raises(ValueError, match="capsules"):
        wait_until(lambda: shown.posed({"PSM1": first, THING: first[:0]}, DrawingConfig(), "cpu"), 5, "the failure")
    assert shown.posed({"PSM1": first, THING: first[:0]}, DrawingConfig(), "cpu") is None
    assert len(posed_soon(shown, ("PSM1",)).poses) == 1
    shown.stop()


def test_poses_of_another_thing_than_that_of_the_task_are_refused():
    shown = ShownInstruments(("PSM1",), True, Clip.thing())
    shown.check_thing(np.zeros((len(part_links(Clip.thing()[0])), 4, 4)))
    with pytest.raises(MessageError, match=r"thing_poses: 1 poses for a thing of 78 links; publish its own"):
        shown.check_thing(np.zeros((1, 4, 4)))
