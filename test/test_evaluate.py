"""Evaluations: what is held out, who saw what, cells that fail or are finished already, tables, and the command."""

import csv
import dataclasses
import json
import os
import re
import signal

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from endo_sim_ros.core.cameras import Camera, look_at
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.evaluation import paper, tables
from endo_sim_ros.evaluation.config import EvaluationConfig
from endo_sim_ros.evaluation.deformed_views import touched_psnr
from endo_sim_ros.evaluation.evaluate import _divided, evaluate, open_named
from endo_sim_ros.evaluation.held_out import FIGURES, measure, seen_pixels
from endo_sim_ros.evaluation.page import write_page
from endo_sim_ros.evaluation.splits import explain_split, right_views, split_views
from endo_sim_ros.evaluation.workers import Finished, News, run_in_processes
from endo_sim_ros.reconstruction import ScenePoints
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

SMALL = "phantom:0,frames=6,width=96,height=80"


# ------------------------------------------------------------------------------------------------------------- splits


@pytest.mark.parametrize(
    "name, count, train, said",
    [
        ("1:49", 250, [0, 50, 100, 150, 200], "Of each 50 views in order the first one trains"),
        ("1:99", 250, [0, 100, 200], "Of each 100 views"),
        ("2:3", 11, [0, 1, 5, 6, 10], "Of each 5 views in order the first 2 train"),
        ("two-views", 7, [0, 6], "The first and the last view train"),
        ("every-12th", 25, [0, 12, 24], "One view in 12 trains"),
        ("every-5", 11, [0, 5, 10], "One view in 5 trains"),
        ("all-but-3rd", 7, [1, 2, 4, 5], "One view in 3 is held out"),
    ],
)
def test_a_split_trains_on_some_views_and_holds_out_the_others(name, count, train, said):
    split = split_views(name, count)
    assert explain_split(name).startswith(said)
    assert split.train == train
    assert sorted(split.train + split.held_out) == list(range(count))
    assert not split.right


def test_in_stereo_the_right_views_are_held_out():
    assert split_views("stereo", 3) == ([0, 1, 2], [0, 1, 2], True)


@pytest.mark.parametrize("name", ["half", "0:5", "5:0", "every-1st", "1-49", ""])
def test_splits_that_there_are_not_are_an_error(name):
    with pytest.raises(SequenceError, match="there is no split .* give 1:49"):
        split_views(name, 10)


def test_a_split_that_leaves_nothing_is_an_error():
    with pytest.raises(SequenceError, match="two-views of 2 views leaves 2 to train on and 0 to hold out"):
        split_views("two-views", 2)


def test_right_views_stand_beside_the_left_ones(small_frames):
    K = small_frames[0].camera.K + [[0, 0, 2], [0, 0, 0], [0, 0, 0]]
    frame = dataclasses.replace(small_frames[0], right_K=K)
    (view,) = right_views([frame, dataclasses.replace(small_frames[1], right=None)])
    assert np.array_equal(view.image, frame.right)
    step = view.camera.position - frame.camera.position
    np.testing.assert_allclose(step @ frame.camera.pose[:3, :3], [frame.baseline, 0, 0], atol=1e-12)
    assert view.camera.K[0, 2] == frame.camera.K[0, 2] + 2
    with pytest.raises(SequenceError, match="no right images"):
        right_views(small_frames[:0])


# --------------------------------------------------------------------------------------------------------- who saw what

CAMERA = Camera(np.array([[50, 0, 32], [0, 50, 24], [0, 0, 1.0]]), 64, 48)


def box_depth(camera):
    """Depth of a wall at z = 0.2 m with a post in front of it, |x| < 1 cm at z = 0.1 m, seen along +z."""
    rays = camera.rays()
    at_post = camera.position[0] + rays[..., 0] * (0.1 - camera.position[2])
    return np.where(np.abs(at_post) < 0.01, 0.1, 0.2).astype(np.float32) - np.float32(camera.position[2])


def test_a_pixel_is_seen_where_another_view_sees_its_surface():
    left = CAMERA.at(look_at([-0.03, 0, 0], [-0.03, 0, 1]))
    here, there = box_depth(CAMERA), box_depth(left)
    seen = seen_pixels(CAMERA, here, [(left, there, None)])
    # By hand: each surface point of this view is in the other's image, and not behind the post.
    x = CAMERA.backproject(here)[..., 0]
    u = (x + 0.03) / here * 50 + 32
    crossing = -0.03 + (x + 0.03) / 2  # of the other view's ray to the wall with the plane of the post
    expected = (u < 64) & ((here < 0.15) | (np.abs(crossing) > 0.01))
    assert expected.any() and not expected.all()
    assert (seen != expected).mean() < 0.03  # pixels on an edge
    assert not seen_pixels(CAMERA, here, [(left, there, np.zeros_like(there))]).any()
    assert not seen_pixels(CAMERA, 0 * here, [(left, there, None)]).any()
    assert seen_pixels(CAMERA, here, [(left, there, None), (CAMERA, here, None)]).all()


def test_measures_of_what_was_seen_count_only_that(small_frames):
    frame, seen = small_frames[0], np.zeros((80, 96), np.uint8)
    seen[:, :48] = 255
    image = frame.image.copy()
    image[:, 60:] = 0
    row = measure(image, frame.depth, frame, seen)
    assert row["seen_psnr"] > 100 > row["psnr"]
    assert row["depth_rmse"] == row["depth_rmse_scaled"] == 0
    assert row["seen_share"] == pytest.approx(100 * (frame.mask[:, :48] > 0).sum() / (frame.mask > 0).sum())
    assert set(row) <= set(FIGURES) and "psnr_unmasked" in row  # the recording has a border


def test_depth_is_judged_by_scene_points_that_no_method_gets(small_frames):
    frame = small_frames[0]
    surface = frame.camera.backproject(frame.depth)[frame.depth > 0][::7]
    repeated = np.concatenate([surface, surface[::2], surface[1::2] + 1e-6])  # as other pairs of views triangulate them again
    points = ScenePoints(repeated, np.zeros_like(repeated), np.linspace(0.001, 0.002, len(repeated)))
    given, judging = _divided(points)
    assert len(judging) == pytest.approx(len(np.unique(repeated, axis=0)) / 10, abs=1) and len(given.positions) == len(given.error)
    assert len(repeated) - 4 * len(judging) < len(given.positions) < len(repeated) - len(judging)
    assert cKDTree(judging).query(given.positions)[0].min() > 2e-6
    few = ScenePoints(surface[:300], np.zeros_like(surface[:300]), 0.001)
    assert _divided(few) == (few, None)
    assert measure(frame.image, frame.depth, frame, points=judging)["points_depth"] < 1e-6
    off = measure(frame.image, frame.depth + np.float32(0.002), frame, points=judging)
    assert off["points_depth"] == pytest.approx(0.002, rel=1e-3)
    assert "points_depth" not in measure(frame.image, frame.depth, frame)


# -------------------------------------------------------------------------------------------------------------- workers


def _temperamental(argument, device, report):
    report(f"begun on {device}")
    if argument == "raise":
        raise ArithmeticError("no sum")
    if argument == "refuse":
        raise SequenceError("not this one")
    if argument == "exit":
        os._exit(3)
    if argument == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    return argument * 2, os.environ["ENDO_SIM_THREADS"]


def test_a_job_that_crashes_loses_only_itself():
    arguments = ["a", "raise", "exit", "b", "kill", "refuse", "c"]
    events = list(run_in_processes(_temperamental, arguments, ["cpu", "cpu"]))
    ends = {event.index: event for event in events if isinstance(event, Finished)}
    assert sorted(ends) == list(range(7))
    assert {ends[i].result[0] for i in (0, 3, 6)} == {"aa", "bb", "cc"}
    assert re.fullmatch(r"ArithmeticError: no sum \(test_evaluate.py:\d+\)", ends[1].error)
    assert ends[2].error == "its process ended with exit code 3"
    assert ends[4].error == "its process was ended by SIGKILL, as when memory runs out"
    assert ends[5].error == "not this one"
    assert News(0, "begun on cpu") in events


# ------------------------------------------------------------------------------------------------------- the whole of it


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Options of a small evaluation, its results, and its folder; one of its two sequences cannot be read."""
    out = tmp_path_factory.mktemp("evaluation")
    (out / "damaged.mcap").write_bytes(b"no bag")
    values = {"out": out, "splits": ("two-views",), "presets": ("default",), "seeds": 2, "device": "cpu", "curve": 3, "lpips": ()}
    settings = ("iterations=20", "max_gaussians=600", "image_width=96", "depth=stereo")
    config = EvaluationConfig(**values, set=settings, json=out / "rows.json")
    sequences = [str(out / "damaged.mcap"), SMALL]
    return sequences, config, evaluate(sequences, config)


def test_every_held_out_view_is_measured_and_shown(run):
    _, config, results = run
    good = [cell for cell in results["cells"] if cell["error"] is None]
    assert [cell["cell"]["seed"] for cell in good] == [0, 1]
    for cell in good:
        assert [row["view"] for row in cell["views"]] == [1, 2, 3, 4]
        assert cell["figures"]["psnr"] == pytest.approx(np.mean([row["psnr"] for row in cell["views"]]))
        assert 12 < cell["figures"]["psnr"] < 45
        assert 50 < cell["figures"]["seen_share"] <= 100 and cell["figures"]["depth_rmse"] < 0.03
        assert 0 < cell["figures"]["gaussians"] <= 600
        assert [moment["iteration"] for moment in cell["curve"]][-1] == 20 and len(cell["curve"]) == 3
        assert all((config.out / path).stat().st_size > 500 for path in cell["pictures"].values())
    assert good[0]["figures"]["psnr"] != good[1]["figures"]["psnr"]
    assert (config.out / "strips/phantom_0-two-views.png").stat().st_size > 1000


def test_what_cannot_be_read_loses_its_own_cells_only(run):
    sequences, config, results = run
    bad = [cell for cell in results["cells"] if cell["error"] is not None]
    assert [cell["cell"]["sequence"] for cell in bad] == ["damaged.mcap"] * 2
    assert all("the bag cannot be read" in cell["error"] for cell in bad)
    assert "| damaged.mcap | default | failed: " in (config.out / "table.md").read_text()


def test_a_split_that_a_sequence_has_not_loses_its_own_cells_only(tmp_path):
    config = EvaluationConfig(
        out=tmp_path, splits=("two-views", "stereo", "9:1"), presets=("default",), device="cpu", lpips=(),
        set=("iterations=2", "max_gaussians=300", "image_width=96"),
    )  # fmt: skip
    errors = [cell["error"] for cell in evaluate([f"{SMALL},stereo=false"], config)["cells"]]
    assert errors[:2] == [None, "split stereo: the sequence has no right images"]
    assert "leaves" in errors[2] and "0 to hold out" in errors[2]


def test_finished_cells_are_not_done_again(run):
    sequences, config, results = run
    kept, gone = (config.out / f"cells/phantom_0-two-views-default-{seed}.json" for seed in (0, 1))
    before = kept.stat().st_mtime_ns
    gone.unlink()
    again = evaluate(sequences, config)
    assert kept.stat().st_mtime_ns == before
    repeatable = lambda cell: {name: value for name, value in cell["figures"].items() if name not in ("seconds", "megabytes")}
    first, second = ([repeatable(cell) for cell in each["cells"] if cell["error"] is None] for each in (results, again))
    assert first == second  # the one that was done again, too, to the last bit


def test_the_table_tells_means_spreads_and_the_paper(run):
    _, config, results = run
    text = (config.out / "table.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith("| phantom:0 | default |"))
    values = [cell["figures"]["psnr"] for cell in results["cells"] if cell["error"] is None]
    assert f"| {np.mean(values):.2f} ± {np.std(values, ddof=1):.2f} |" in row and row.endswith("| 2 |")
    assert "| the paper's, SCARED | paper | 22.94 | – | 0.769 | " in text
    assert "0.184‡" in text and "96×80, over all pixels, unmasked; reference depth: the recorded depth" in text
    rows = list(csv.DictReader((config.out / "table.csv").open()))
    ours = next(row for row in rows if row["sequence"] == "phantom:0")
    assert float(ours["psnr"]) == pytest.approx(np.mean(values)) and ours["source"] == "measured"
    assert {row["sequence"] for row in rows if row["source"] == "printed in the paper"} == {"SCARED", "StereoMIS"}
    assert len(list(csv.DictReader((config.out / "views.csv").open()))) == 8


def test_rows_for_machines_have_a_name_value_unit_and_ratio(run):
    _, config, results = run
    rows = json.loads(config.json.read_text())
    assert all(set(row) == {"name", "value", "unit", "ratio", "peer"} for row in rows)
    psnr = next(row for row in rows if row["name"] == "phantom:0, two-views, default: PSNR")
    assert psnr["unit"] == "dB" and psnr["ratio"] is None  # no 3dgs in this run
    record = next(cell for cell in results["cells"] if cell["error"] is None)
    peer = {**record, "cell": record["cell"] | {"method": "3dgs"}, "figures": record["figures"] | {"depth_rmse": 0.5}}
    both = tables.machine_rows(tables.summarise({"cells": [record, peer]}))
    depth = next(row for row in both if row.name == "phantom:0, two-views, default: depth RMSE")
    assert depth.ratio == pytest.approx(record["figures"]["depth_rmse"] / 0.5) and depth.peer == "3dgs"


def test_lpips_without_weights_says_so_in_its_column(run, tmp_path):
    _, _, results = run
    text = tables.markdown(results | {"missing": {"lpips_vgg": "LPIPS vgg: no weights in here"}}, tables.summarise(results))
    assert "| LPIPS vgg |" in text and "| no weights |" in text and "- LPIPS vgg: no weights in here." in text


def test_what_is_not_there_is_told_before_any_work(tmp_path):
    with pytest.raises(SequenceError, match="no/such: no such file or folder"):
        evaluate(["no/such"], EvaluationConfig(out=tmp_path))
    with pytest.raises(SequenceError, match="there is no split 'half'"):
        evaluate([SMALL], EvaluationConfig(out=tmp_path, splits=("half",)))
    with pytest.raises(ConfigError, match="give name=value with a name of .*iterations"):
        evaluate([SMALL], EvaluationConfig(out=tmp_path, set=("iteration=3",)))
    with pytest.raises(ConfigError, match="methods are named with --presets"):
        evaluate([SMALL], EvaluationConfig(out=tmp_path, set=("preset=paper",)))
    with pytest.raises(ConfigError, match="workers must be 1 or more, got 0"):
        EvaluationConfig(workers=0)
    with pytest.raises(SequenceError, match="the synthetic patients have numbers"):
        open_named("phantom:liver")
    assert not any(tmp_path.iterdir())


def test_a_reader_takes_its_options_from_the_name(small_bag, small_frames, tmp_path):
    assert [f.stamp_ns for f in open_named(f"{small_bag},start=2,step=4")] == [f.stamp_ns for f in small_frames[2::4]]
    with pytest.raises(SequenceError, match="a bag has no option fps"):
        open_named(f"{small_bag},fps=3")
    assert len(open_named(SMALL)) == 6
    assert open_named("phantom:2,frames=3,border=0.1") is not None


def test_the_papers_numbers_are_complete():
    assert len(paper.PRINTED) == 30 and len({row[:3] for row in paper.PRINTED}) == 30
    assert all(15 < row.psnr < 30 and 0.6 < row.ssim < 0.9 and 0.2 < row.lpips < 0.5 for row in paper.PRINTED)


# ------------------------------------------------------------------------------------------------------------- the page


def test_the_page_needs_nothing_else_and_sorts_and_slides(run, chromium):
    pytest.importorskip("matplotlib")
    _, config, _ = run
    page = write_page(config.out)
    tab = chromium.new_page(viewport={"width": 1200, "height": 900})
    asked, errors = [], []
    tab.on("request", lambda request: asked.append(request.url))
    tab.on("pageerror", lambda error: errors.append(error))
    tab.goto(page.as_uri())
    column = tab.locator("thead th", has_text=re.compile(r"^PSNR \[dB\]$"))
    order = lambda: [cells.split("\t")[1] for cells in tab.locator("tbody").all_inner_texts()[0].splitlines() if "StereoMIS" in cells]
    assert order() == ["3dgs", "fsgs", "paper"]
    column.click()
    assert order() == ["fsgs", "3dgs", "paper"]
    column.click()
    assert order() == ["paper", "3dgs", "fsgs"]
    assert tab.get_by_text("The first and the last view train, all others are held out.").is_visible()
    texts = tab.locator("tbody").inner_text()
    assert "failed: " in texts and "22.94" in texts and "0.184‡" in texts

    stage = tab.locator(".stage")
    stage.scroll_into_view_if_needed()
    picture = lambda: cv2.imdecode(np.frombuffer(stage.screenshot(), np.uint8), cv2.IMREAD_COLOR).astype(float)
    tab.locator("select[aria-label=right]").select_option("default, depth")
    at = lambda percent: (tab.locator("input[type=range]").fill(str(percent)), picture())[1]
    depth, half, reference = at(0), at(50), at(100)
    middle = depth.shape[1] // 2
    assert np.abs(depth - reference).mean() > 20  # coloured depth is unlike a picture
    assert np.abs(half - reference)[:, : middle - 5].mean() < 2 and np.abs(half - depth)[:, middle + 5 :].mean() < 2
    tab.locator("summary").click()
    loaded = tab.evaluate("[...document.images].every(image => image.naturalWidth == 96)")
    assert loaded and tab.locator(".plots svg").count() == 2
    assert not errors and all(url.startswith(("file:", "data:")) for url in asked)
    tab.close()


def test_a_folder_without_results_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="no results of an evaluation .* give the --out of"):
        write_page(tmp_path)


def test_layers_of_other_colours_come_apart_when_touched_and_a_surface_does_not():
    (frame,) = phantom_sequence(PhantomConfig(frames=1, width=160, height=128, stereo=False))
    points = torch.from_numpy(frame.camera.backproject(frame.depth).reshape(-1, 3)).float()
    colors, radii = torch.from_numpy(frame.image.reshape(-1, 3) / 255.0).float(), torch.full((len(points),), 4e-4)
    surface = GaussianModel.from_points(points, colors, radii, opacity=0.95)
    ahead = torch.from_numpy(frame.camera.pose[:3, 2]).float()
    striped = torch.sign(torch.sin(4e3 * points[:, :1]))
    front, behind = (
        GaussianModel.from_points(points + step * ahead, colors + shift * striped, radii, opacity=opacity)
        for step, shift, opacity in ((0.0, 0.3, 0.3), (0.003, -0.2, 0.9))
    )
    layers = GaussianModel(**{name: torch.cat([tensor, behind.tensors()[name]]) for name, tensor in front.tensors().items()})
    found = [touched_psnr(model, [frame.camera], "cpu") for model in (surface, layers)]
    assert found[0] > 28 and found[1] < found[0] - 1
    kilometres = dataclasses.replace(surface, means=1000 * surface.means, log_scales=surface.log_scales + np.log(1000))
    pose = frame.camera.pose.copy()
    pose[:3, 3] *= 1000
    assert np.isnan(touched_psnr(kilometres, [frame.camera.at(pose)], "cpu"))
