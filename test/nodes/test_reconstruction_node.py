"""reconstruction_node: good and bad recordings, and when they come and go."""

import dataclasses
import errno
import itertools
import logging
import re
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from bad_messages import BAD_RECORDINGS
from ros_bench import K, S, send_frames, sheet
from std_srvs.srv import Trigger

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import rigid_pose
from endo_sim_ros.core.gaussians import load_ply, save_ply
from endo_sim_ros.core.tissue_motion import PeriodicMotion, TissueMotion
from endo_sim_ros.messages import ERROR, OK, WARN
from endo_sim_ros.nodes import reconstruction_node
from endo_sim_ros.nodes.reconstruction_node import ReconstructionNode
from endo_sim_ros.reconstruction import Trainer
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence
from endo_sim_ros.sequences.recording import store

pytestmark = pytest.mark.dds


@pytest.fixture
def reconstruction(bench):
    return bench.add(ReconstructionNode)


def views_arrive(bench, frames, shift_ns=S, count=12):
    """Whether a good recording still becomes views."""
    send_frames(bench, frames, shift_ns)
    bench.call(Trigger, "/reconstruction_node/save")  # some round trip; then flush as the end of a recording does
    node = next(node for node in bench.nodes if isinstance(node, ReconstructionNode))
    bench.until(lambda: (node.flush(), len(node.frames) == count)[1], lambda: f"{count} views: {node.status()}")


@pytest.mark.parametrize("name", BAD_RECORDINGS)
def test_bad_recording_is_one_sentence_and_good_views_still_arrive(bench, reconstruction, small_frames, name):
    make, sentence = BAD_RECORDINGS[name]
    topic, message = make(small_frames[0])
    bench.publish(topic, message)
    where = "image: " if name == "stamp_of_zero" else topic.name  # the synchroniser knows streams, not topics
    bench.refused("reconstruction_node", sentence, where)
    views_arrive(bench, small_frames)


def test_image_and_camera_info_of_different_sizes_are_refused_and_good_views_still_arrive(bench, reconstruction, small_frames):
    frame = small_frames[0]
    bench.publish(messages.LEFT_INFO, messages.encode_camera_info(K, 640, 512, frame.stamp_ns, "endoscope_left"))
    bench.publish(messages.CAMERA_POSE, messages.encode_pose(frame.camera.pose, frame.stamp_ns, "world"))
    bench.publish(messages.LEFT_IMAGE, messages.encode_image(frame.image, frame.stamp_ns, "endoscope_left"))
    bench.until(lambda: reconstruction.synchronizer.pending)
    assert not bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.refused("reconstruction_node", "the image is 96×80 but camera_info says 640×512", "endoscope/left")
    views_arrive(bench, small_frames)


def test_no_images_within_the_timeout_is_a_warning_with_the_topic_until_views_come(bench, reconstruction, small_frames):
    assert bench.set("reconstruction_node", image_timeout=0.5)[0]
    bench.status("reconstruction_node", "no image on /endoscope/left/image_raw", WARN)
    views_arrive(bench, small_frames)
    assert reconstruction.status()[0] == OK
    for start_after, level in ((100.0, OK), (0.0, WARN)):  # where training begins by itself, a slow recording may have ended
        assert bench.set("reconstruction_node", start_after=start_after)[0]
        reconstruction.last_view -= 1.0
        assert reconstruction.status()[0] == level


def test_images_that_never_become_views_are_a_warning_that_says_why(bench, reconstruction, small_frames):
    assert bench.set("reconstruction_node", image_timeout=0.5)[0]
    stamps = itertools.count(1)

    def warned():
        send_frames(bench, small_frames, next(stamps) * S, poses=False)
        return any("images arrive but none is usable" in text for _, text, _ in bench.statuses["reconstruction_node"])

    bench.until(warned, "a warning")
    assert "without pose" in bench.status("reconstruction_node", "images arrive but", WARN)[1]


def test_camera_info_of_another_size_in_mid_stream_is_followed(bench, reconstruction, small_frames):
    import cv2

    views_arrive(bench, small_frames)
    big = [f.__class__(f.stamp_ns, cv2.resize(f.image, (192, 160)), f.camera.resized(192, 160),
                       depth=cv2.resize(f.depth, (192, 160))) for f in small_frames]  # fmt: skip
    views_arrive(bench, big, shift_ns=3 * S, count=24)
    assert {frame.camera.width for frame in reconstruction.frames} == {96, 192}


@pytest.mark.thorough
def test_a_slow_recording_is_not_taken_for_one_that_ended(bench, reconstruction, small_frames):
    """Images every half second, with a silence of 0.2 s set to mean the end."""
    assert bench.set("reconstruction_node", start_after=0.2, image_timeout=4.0)[0]
    for count in range(1, 4):
        send_frames(bench, small_frames[count - 1 : count])
        bench.until(lambda: time.monotonic() - reconstruction.last_image > 0.5, "half a second")
        assert reconstruction.trained is None
    bench.status("reconstruction_node", "finished, model saved in")
    assert len(reconstruction.frames) == 3


def test_recording_is_reconstructed_published_latched_and_saved(bench, reconstruction, small_frames, tmp_path):
    # Iterations enough to outlast the publish period on the fastest machine.
    assert bench.set("reconstruction_node", publish_period=0.1, output_dir=str(tmp_path), keyframes=3, iterations=200)[0]
    models = bench.hear(messages.GAUSSIANS)
    refused = bench.call(Trigger, "/reconstruction_node/reconstruct")
    assert not refused.success and "no views yet" in refused.message
    assert not bench.call(Trigger, "/reconstruction_node/save").success
    send_frames(bench, small_frames)
    assert bench.set("reconstruction_node", start_after=0.3)[0]
    bench.status("reconstruction_node", "finished, model saved in")
    level, text, values = bench.statuses["reconstruction_node"][-1]
    assert level == OK and values["views"] == "12"
    saved = load_ply(next(tmp_path.glob("*/model.ply")))
    # The final model may come after the status, and behind more than one intermediate model.
    as_saved = lambda: len(saved) == len(newest := messages.decode_gaussians(models[-1])) and torch.allclose(saved.means, newest.means)
    bench.until(lambda: len(models) >= 2 and as_saved(), "an intermediate and the final model, which is the saved one")
    final = messages.decode_gaussians(models[-1])
    assert 100 < len(final) <= 1500 and len(list(tmp_path.glob("*/checkpoint.pt"))) == 1
    cameras = bench.hear(messages.TRAINING_CAMERAS)  # a late joiner
    bench.until(lambda: cameras, "the latched training cameras")
    assert cameras[-1].header.stamp == models[-1].header.stamp
    assert len(cameras[-1].poses) == 3
    count = len(models)
    time.sleep(0.5)  # nothing new came: nothing may be reconstructed again
    bench.until(lambda: not reconstruction.training)
    assert len(models) == count
    answer = bench.call(Trigger, "/reconstruction_node/save")
    assert answer.success and answer.message.startswith(str(tmp_path))
    # The newest model comes back by name, with the cameras that were saved beside it.
    assert bench.set("reconstruction_node", model_file="latest")[0]
    bench.until(lambda: len(models) > count, "the saved model")
    bench.until(lambda: cameras[-1].header.stamp == models[-1].header.stamp, "its cameras")
    torch.testing.assert_close(messages.decode_gaussians(models[-1]).means, final.means)
    assert len(cameras[-1].poses) == 3
    count = len(models)
    # A second recording with the very same stamps, after a pause, is another recording.
    bench.until(lambda: time.monotonic() - reconstruction.last_image > 1.1)
    send_frames(bench, small_frames)
    bench.until(lambda: len(models) > count, "a model of the second recording")
    assert len(reconstruction.frames) == 12
    assert messages.stamp_to_ns(models[-1].header.stamp) > messages.stamp_to_ns(models[count - 1].header.stamp)


def test_stamps_that_jump_begin_a_new_recording_and_looping_does_not_reconstruct_again(bench, reconstruction, small_frames, monkeypatch):
    # However long the training in between takes, the bag loops without a pause.
    monkeypatch.setattr(sys.modules[type(reconstruction).__module__], "_PAUSE", 60.0)
    long = [f.__class__(f.stamp_ns + i * S, f.image, f.camera, depth=f.depth) for i, f in enumerate(small_frames)]
    send_frames(bench, long)
    send_frames(bench, long[:6])  # the bag starts again
    bench.until(lambda: reconstruction.trained is not None, "training at the end of the loop")
    trained = reconstruction.trained
    assert trained == (long[0].stamp_ns, long[-1].stamp_ns)
    send_frames(bench, long[6:])
    bench.until(lambda: not reconstruction.training)
    send_frames(bench, long[:2])
    bench.until(lambda: len(reconstruction.frames) <= 2)
    assert not reconstruction.training and reconstruction.trained == trained
    send_frames(bench, small_frames[:4], 3600 * S)  # an hour later
    reconstruction.flush()
    assert len(reconstruction.frames) == 4


def test_a_live_camera_is_reconstructed_once_when_enough_views_came(bench, reconstruction, small_frames):
    assert bench.set("reconstruction_node", start_views=6, iterations=5)[0]
    for index, shift in enumerate((0, S, 2 * S)):
        send_frames(bench, small_frames, shift)
        bench.until(lambda: reconstruction.trained is not None and not reconstruction.training)
    assert reconstruction.trained[1] < small_frames[0].stamp_ns + S  # not again with the views after the first six


def test_a_place_that_cannot_be_written_is_told_and_the_model_is_published_all_the_same(bench, reconstruction, small_frames, tmp_path):
    models = bench.hear(messages.GAUSSIANS)
    assert bench.set("reconstruction_node", output_dir="/proc/nowhere", iterations=5)[0]
    send_frames(bench, small_frames)
    assert bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.refused("reconstruction_node", "the model cannot be saved", "/proc/nowhere", "set output_dir")
    bench.until(lambda: models and not reconstruction.training, "the model, and the end of its training")
    assert reconstruction.status()[0] == ERROR  # still
    assert "cannot be saved" in bench.call(Trigger, "/reconstruction_node/save").message
    assert bench.set("reconstruction_node", output_dir=str(tmp_path))[0]
    assert bench.call(Trigger, "/reconstruction_node/save").success
    assert len(list(tmp_path.glob("*/model.ply"))) == len(list(tmp_path.glob("*/checkpoint.pt"))) == 1


def test_a_reconstruction_that_fails_says_so_until_the_next_one(bench, reconstruction, small_frames):
    dark = [f.__class__(f.stamp_ns, f.image, f.camera, mask=np.zeros((80, 96), np.uint8)) for f in small_frames]
    for frame in dark:
        bench.publish(messages.MASK, messages.encode_image(frame.mask, frame.stamp_ns, "endoscope_left"))
    bench.until(lambda: len(reconstruction.synchronizer.streams["mask"].stamps) == 12)
    send_frames(bench, small_frames)
    assert bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.refused("reconstruction_node", "every pixel of every view is masked")
    bench.until(lambda: not reconstruction.training)
    assert reconstruction.status()[0] == ERROR
    views_arrive(bench, small_frames, 100 * S)
    assert bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.status("reconstruction_node", "finished")


def test_services_answer_and_callbacks_stay_quick_while_training(bench, reconstruction, small_frames, caplog):
    send_frames(bench, small_frames)
    assert bench.set("reconstruction_node", iterations=10_000)[0]
    assert bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.until(lambda: reconstruction.progress is not None, "progress")
    again = bench.call(Trigger, "/reconstruction_node/reconstruct")
    assert not again.success and "a reconstruction is running: training, iteration" in again.message
    send_frames(bench, small_frames, 2 * S)
    bench.until(lambda: len(reconstruction.frames) >= 20, "views during training")
    iteration = bench.status("reconstruction_node", "training, iteration", OK)[2]["iteration"]
    assert 0 < int(iteration) < 10_000
    with caplog.at_level(logging.INFO):
        reconstruction.cancel.set()
        bench.until(lambda: not reconstruction.training, "the training to stop")
    assert re.search(r"stopped before its end: .* of 10000 iterations, saved in", caplog.text)
    assert "finished" not in reconstruction.status()[1]


@pytest.mark.thorough
def test_a_node_that_ends_waits_until_a_slow_training_is_saved(bench, reconstruction, small_frames, monkeypatch, tmp_path):
    step = Trainer.step
    monkeypatch.setattr(Trainer, "step", lambda trainer: (time.sleep(0.5), step(trainer))[1])  # five between two looks at the end
    assert bench.set("reconstruction_node", iterations=1000, output_dir=str(tmp_path))[0]
    send_frames(bench, small_frames)
    assert bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.until(lambda: reconstruction.progress is not None, "progress")
    bench.nodes.remove(reconstruction)
    bench.executor.remove_node(reconstruction)
    reconstruction.destroy_node()
    assert not reconstruction.training and len(load_ply(next(tmp_path.glob("*/model.ply")))) > 0


def test_a_model_file_is_published_when_set_and_a_bad_one_is_refused_with_the_reason(bench, reconstruction, tmp_path):
    models = bench.hear(messages.GAUSSIANS)
    ok, reason = bench.set("reconstruction_node", model_file=str(tmp_path / "missing.ply"))
    assert not ok and "missing.ply: no such file" in reason
    save_ply(sheet(5), tmp_path / "model.ply")
    assert bench.set("reconstruction_node", model_file=str(tmp_path / "model.ply"))[0]
    bench.until(lambda: models, "the model of the file")
    assert len(messages.decode_gaussians(models[0])) == 25


def test_the_motion_beside_a_model_file_is_published_unless_it_is_of_another_model(bench, reconstruction, tmp_path):
    model, motions = sheet(5), bench.hear(messages.FOUND_MOTION)
    points, way = model.means.double().numpy(), np.array([[0.002, 0.0, 0.0], [0.0, 0.0, 0.0]])
    found = TissueMotion(3.0, points, (PeriodicMotion("breathing", 1.5, 1.0, 5.0, way, np.ones(len(points))),))
    found.save(tmp_path, model)
    save_ply(model, tmp_path / "model.ply")
    save_ply(sheet(6), tmp_path / "other.ply")
    for name, path in (("model", str(tmp_path / "motion.npz")), ("other", "")):
        assert bench.set("reconstruction_node", model_file=str(tmp_path / f"{name}.ply"))[0]
        bench.until(lambda path=path: motions and motions[-1].data == path, f"the motion of {name}")
    bench.status("reconstruction_node", "the tissue does not move by itself", WARN)


def test_a_model_file_needs_no_image_and_a_recording_may_still_come(bench, reconstruction, small_frames, tmp_path):
    save_ply(sheet(5), tmp_path / "model.ply")
    assert bench.set("reconstruction_node", image_timeout=0.1, model_file=str(tmp_path / "model.ply"))[0]
    bench.until(lambda: time.monotonic() - reconstruction.last_view > 0.2, "a long silence")
    said = len(bench.statuses["reconstruction_node"])
    assert bench.status("reconstruction_node", f"published the model of {tmp_path}/model.ply", OK, said)[2]["gaussians"] == "25"
    send_frames(bench, small_frames, poses=False)
    for _ in range(2):  # images without poses are given up when later ones come
        reconstruction.flush()
        bench.status("reconstruction_node", "images arrive but none is usable", WARN)
    views_arrive(bench, small_frames)


def test_views_wait_in_files_that_go_with_them(bench, reconstruction, small_frames):
    assert bench.set("reconstruction_node", max_views=6)[0]
    last = small_frames[-1].stamp_ns
    send_frames(bench, small_frames)
    bench.until(lambda: (reconstruction.flush(), reconstruction.frames and reconstruction.frames[-1].stamp_ns == last)[1], "all views")
    folder: Path = reconstruction.frames[0].file.parent
    assert len(reconstruction.frames) <= 6
    assert {frame.file for frame in reconstruction.frames} == set(folder.iterdir())
    np.testing.assert_array_equal(reconstruction.frames[0].load().image, small_frames[0].image)
    reconstruction.destroy_node()
    assert not folder.exists()


@pytest.mark.thorough
def test_views_that_a_full_disk_does_not_take_are_told_with_the_model_that_lacks_them(bench, reconstruction, small_frames, monkeypatch):
    whole = store

    def full(frame, file):
        stored = whole(frame, file)
        if len(reconstruction.frames) == 5:
            raise OSError(errno.ENOSPC, "No space left on device")
        return stored

    monkeypatch.setattr(reconstruction_node, "store", full)
    assert bench.set("reconstruction_node", iterations=20)[0]
    send_frames(bench, small_frames)
    bench.until(lambda: (reconstruction.flush(), reconstruction.error_count == 7)[1], "all views")
    folder = reconstruction.frames[0].file.parent
    bench.refused("reconstruction_node", f"{folder}: a view cannot be kept")
    assert {frame.file for frame in reconstruction.frames} == set(folder.iterdir()), "no half views"
    lost = rf"; 7 views could not be kept in {folder} \(No space left on device\); lower max_views, or start the node with TMPDIR on "
    reconstruction.last_view -= 60  # images come, and the topics are right
    assert reconstruction.status()[0] == WARN and re.match(f"collecting views, 5 so far{lost}", reconstruction.status()[1])
    assert bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.until(lambda: not reconstruction.training, "the end of the training")
    monkeypatch.undo()
    send_frames(bench, small_frames, 3600 * S)  # another recording, which is whole
    bench.until(lambda: (reconstruction.flush(), len(reconstruction.frames) == 12)[1], "all views")
    level, text, _ = reconstruction.status()
    assert level == WARN and re.match(rf"finished, model saved in \S+{lost}", text)
    assert bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.until(lambda: not reconstruction.training, "the end of the training")
    assert reconstruction.status()[0] == OK


@pytest.mark.slow
def test_what_the_preparation_warns_of_is_told_with_the_model(bench, reconstruction, small_frames):
    in_millimetres = [rigid_pose(frame.camera.pose[:3, :3], 1e3 * frame.camera.position) for frame in small_frames]
    farther = [dataclasses.replace(frame, camera=frame.camera.at(pose)) for frame, pose in zip(small_frames, in_millimetres)]
    assert bench.set("reconstruction_node", iterations=20)[0]
    send_frames(bench, farther)
    bench.until(lambda: (reconstruction.flush(), len(reconstruction.frames) == 12)[1], "all views")
    assert reconstruction.status()[0] == OK
    assert bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.until(lambda: not reconstruction.training, "the end of the training")
    level, text, _ = reconstruction.status()
    assert level == WARN and re.match(r"finished, model saved in \S+; .*SCENE POINTS ARE \S+ m AWAY: poses are in metres", text)


@pytest.mark.thorough
@pytest.mark.slow
def test_tissue_that_breathes_is_reconstructed_in_its_mean_position(bench, reconstruction, tmp_path):
    """7.5 s of breaths of 3 s, through one lens."""
    patient = PhantomConfig(frames=60, fps=8.0, width=96, height=80, breathing=0.008, breathing_period=3.0, stereo=False)
    assert bench.set("reconstruction_node", output_dir=str(tmp_path), keyframes=3, iterations=5)[0]
    motions = bench.hear(messages.FOUND_MOTION)
    send_frames(bench, list(phantom_sequence(patient)))
    assert bench.call(Trigger, "/reconstruction_node/reconstruct").success
    _, _, values = bench.status("reconstruction_node", "finished, model saved in")
    bench.until(lambda: motions[-1].data == f"{values['saved']}/motion.npz", "the motion of the model")
    assert re.fullmatch(r"the tissue moves by itself: .* mm every (2\.9.|3\.0.) s .*, seen for 7 s", values["motion"])
    found = yaml.safe_load(next(tmp_path.glob("*/motion.yaml")).read_text())["/**/physics_node"]["ros__parameters"]
    assert abs(found["motion.breathing_period"] / 3 - 1) < 0.02 and 0.006 < found["motion.breathing"] < 0.01
    folder = next(tmp_path.glob("*/motion.yaml")).parent
    assert (
        TissueMotion.load(folder / found["motion.file"], load_ply(folder / "model.ply")).parameters["breathing"]
        == found["motion.breathing"]
    )
