"""Evaluations: cells that fail or are finished already, tables, the page."""

import csv
import dataclasses
import json
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest

from endo_sim_ros.cli.evaluate import Command
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.drawing import slug
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.evaluation import paper, tables
from endo_sim_ros.evaluation.cells import list_cells, save_record
from endo_sim_ros.evaluation.config import EvaluationConfig
from endo_sim_ros.evaluation.evaluate import evaluate
from endo_sim_ros.evaluation.page import write_page
from endo_sim_ros.evaluation.sources import open_named, parse_values, source_names
from endo_sim_ros.evaluation.workers import Finished
from endo_sim_ros.reconstruction import ReconstructionConfig
from endo_sim_ros.sequences.bag import write_bag

SMALL = "phantom:0,frames=6,width=96,height=80"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Options of a small evaluation, its results, and its folder; one of its two sequences cannot be read."""
    out = tmp_path_factory.mktemp("evaluation")
    (out / "damaged.mcap").write_bytes(b"no bag")
    values = {"out": out, "splits": ("two-views",), "presets": ("default",), "seeds": 2, "device": "cpu", "curve": 3, "lpips": ()}
    settings = ("iterations=20", "max_gaussians=600", "image_width=96", "depth=stereo", "extrapolation=0")
    config = EvaluationConfig(**values, set=settings, json=out / "rows.json")
    sequences = [str(out / "damaged.mcap"), SMALL]
    return sequences, config, evaluate(sequences, config)


@pytest.mark.slow
@pytest.mark.dds
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
        assert any("depth" in sentence for sentence in cell["decisions"]), cell["decisions"]
        assert [moment["iteration"] for moment in cell["curve"]][-1] == 20 and len(cell["curve"]) == 3
        assert all((config.out / path).stat().st_size > 500 for path in cell["pictures"].values())
    assert good[0]["figures"]["psnr"] != good[1]["figures"]["psnr"]
    assert (config.out / f"strips/{slug(SMALL)}-two-views.png").stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.dds
def test_what_cannot_be_read_loses_its_own_cells_only(run):
    sequences, config, results = run
    bad = [cell for cell in results["cells"] if cell["error"] is not None]
    assert [cell["cell"]["sequence"] for cell in bad] == ["damaged.mcap"] * 2
    assert all("the bag cannot be read" in cell["error"] for cell in bad)
    assert "| damaged.mcap | default | failed: " in (config.out / "table.md").read_text()


@pytest.mark.slow
@pytest.mark.dds
def test_a_split_that_a_sequence_has_not_loses_its_own_cells_only(small_frames, tmp_path, capsys, caplog):
    write_bag(tmp_path / "one eye", [dataclasses.replace(frame, right=None, baseline=None) for frame in small_frames[:6]])
    config = EvaluationConfig(
        out=tmp_path / "out", splits=("two-views", "stereo", "9:1"), presets=("paper",), device="cpu", lpips=(),
        set=("iterations=2", "max_gaussians=300", "image_width=96", "mcmc.growth=0.1", "gradient.shrink=2"),
    )  # fmt: skip
    errors = [cell["error"] for cell in evaluate([str(tmp_path / "one eye")], config)["cells"]]
    assert errors[:2] == [None, "split stereo: the sequence has no right images"]
    assert "leaves" in errors[2] and "0 to hold out" in errors[2]
    assert "mcmc.growth has no effect while densification is gradient" in caplog.text and "gradient.shrink has" not in caplog.text
    out = capsys.readouterr().out
    assert out.splitlines()[-2:] == [
        f"one eye, {split}, paper, seed 0 failed: {error}" for split, error in zip(("stereo", "9:1"), errors[1:])
    ]


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.dds
def test_what_a_cell_warns_of_has_its_name(tmp_path):
    words = ["evaluate", SMALL, "--out", str(tmp_path), "--splits", "two-views", "--presets", "paper", "--device", "cpu"]
    settings = ["--set", "iterations=2", "max_gaussians=300", "image_width=96"]
    done = subprocess.run([sys.executable, "-m", "endo_sim_ros.cli", *words, *settings], capture_output=True, text=True)
    assert f"\n{SMALL}, two-views, paper: DEPTH IS NOT AS PUBLISHED: " in done.stdout + "\n" + done.stderr, done


@pytest.mark.dds
def test_a_command_whose_cells_failed_promises_nothing_before_the_cause_is_mended(tmp_path):
    (tmp_path / "damaged.mcap").write_bytes(b"no bag")
    config = EvaluationConfig(out=tmp_path / "out", splits=("two-views",), presets=("3dgs",), device="cpu", lpips=())
    with pytest.raises(RuntimeError, match="1 of 1 cell failed, why is told above; with that mended, the same command does those alone"):
        Command((str(tmp_path / "damaged.mcap"),), config).run()


@pytest.mark.dds
def test_what_is_wrong_with_a_sequence_is_told_once(tmp_path, capfd, caplog):
    (tmp_path / "damaged.mcap").write_bytes(b"no bag")
    config = EvaluationConfig(out=tmp_path, splits=("1:1", "two-views"), presets=("default", "3dgs"), seeds=2, device="cpu", lpips=())
    results = evaluate([str(tmp_path / "damaged.mcap")], config)
    told = capfd.readouterr().out + caplog.text
    assert told.count("the bag cannot be read") == 1 and "\ndamaged.mcap: 8 cells failed: " in told
    for record in results["cells"]:
        record["error"] = "too large" if record["cell"]["method"] == "3dgs" else None
    assert tables.failures(results) == ["damaged.mcap, 3dgs: 4 cells failed: too large"]


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.dds
def test_finished_cells_are_not_done_again(run):
    sequences, config, results = run
    kept, gone = (config.out / f"cells/{slug(SMALL)}-two-views-default-{seed}.json" for seed in (0, 1))
    before = kept.stat().st_mtime_ns
    gone.unlink()
    again = evaluate(sequences, config)
    assert kept.stat().st_mtime_ns == before
    repeatable = lambda cell: {name: value for name, value in cell["figures"].items() if name not in ("seconds", "megabytes")}
    first, second = ([repeatable(cell) for cell in each["cells"] if cell["error"] is None] for each in (results, again))
    assert first == second  # the one that was done again, too, to the last bit


@pytest.mark.slow
@pytest.mark.dds
def test_the_table_tells_means_spreads_and_the_paper(run):
    _, config, results = run
    text = (config.out / "table.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith(f"| {SMALL} | default |"))
    values = [cell["figures"]["psnr"] for cell in results["cells"] if cell["error"] is None]
    assert f"| {np.mean(values):.2f} ± {np.std(values, ddof=1):.2f} |" in row and row.endswith("| 2 |")
    assert "| the paper's, SCARED | paper | 22.94 | – | 0.769 | " in text
    assert "0.184‡" in text and "96×80, over all pixels, unmasked; reference depth: the recorded depth" in text
    rows = list(csv.DictReader((config.out / "table.csv").open()))
    ours = next(row for row in rows if row["sequence"] == SMALL)
    assert float(ours["psnr"]) == pytest.approx(np.mean(values)) and ours["source"] == "measured"
    assert {row["sequence"] for row in rows if row["source"] == "printed in the paper"} == {"SCARED", "StereoMIS"}
    assert len(list(csv.DictReader((config.out / "views.csv").open()))) == 8


@pytest.mark.slow
@pytest.mark.dds
def test_the_table_in_the_terminal_has_whole_names(run, capsys):
    _, config, results = run
    tables.write(results, config.out, None)
    first_column = "".join(line.split("│")[1].strip() for line in capsys.readouterr().out.splitlines() if line.startswith("│"))
    assert SMALL in first_column


@pytest.mark.slow
@pytest.mark.dds
def test_rows_for_machines_have_a_name_value_unit_and_ratio(run):
    _, config, results = run
    rows = json.loads(config.json.read_text())
    assert all(set(row) == {"name", "value", "unit", "ratio", "peer"} for row in rows)
    psnr = next(row for row in rows if row["name"] == f"{SMALL}, two-views, default: PSNR")
    assert psnr["unit"] == "dB" and psnr["ratio"] is None  # no 3dgs in this run
    record = next(cell for cell in results["cells"] if cell["error"] is None)
    peer = {**record, "cell": record["cell"] | {"method": "3dgs"}, "figures": record["figures"] | {"depth_rmse": 0.5}}
    both = tables.machine_rows(tables.summarise({"cells": [record, peer]}))
    depth = next(row for row in both if row.name == f"{SMALL}, two-views, default: depth RMSE")
    assert depth.ratio == pytest.approx(record["figures"]["depth_rmse"] / 0.5) and depth.peer == "3dgs"


def test_a_folder_without_weights_is_refused_before_any_work(tmp_path):
    with pytest.raises(
        ConfigError, match=rf"--weights: LPIPS alex: no alexnet\*.pth \(torchvision's\) in {tmp_path / 'nope'}; put it there"
    ):
        list_cells([SMALL], EvaluationConfig(weights=tmp_path / "nope"))


@pytest.mark.slow
@pytest.mark.dds
def test_lpips_without_weights_says_so_in_its_column(run, tmp_path):
    _, _, results = run
    text = tables.markdown(results | {"missing": {"lpips_vgg": "LPIPS vgg: no weights in here"}}, tables.summarise(results))
    assert "| LPIPS vgg |" in text and "| no weights |" in text and "- LPIPS vgg: no weights in here." in text


@pytest.mark.dds
def test_what_is_not_there_is_told_before_any_work(tmp_path):
    with pytest.raises(SequenceError, match="no/such: no such file or folder"):
        evaluate(["no/such"], EvaluationConfig(out=tmp_path))
    with pytest.raises(SequenceError, match="there is no split 'half'"):
        evaluate([SMALL], EvaluationConfig(out=tmp_path, splits=("half",)))
    with pytest.raises(ConfigError, match=r"has no option iteration \(did you mean iterations\?\); it has .*iterations"):
        evaluate([SMALL], EvaluationConfig(out=tmp_path, set=("iteration=3",)))
    with pytest.raises(ConfigError, match="option growth is now mcmc.growth"):
        evaluate([SMALL], EvaluationConfig(out=tmp_path, set=("growth=0.1",)))
    with pytest.raises(ConfigError, match="methods are named with --presets"):
        evaluate([SMALL], EvaluationConfig(out=tmp_path, set=("preset=paper",)))
    with pytest.raises(ConfigError, match="gsplat is not installed"):
        evaluate([SMALL], EvaluationConfig(out=tmp_path, presets=("gsplat",)))
    with pytest.raises(SequenceError, match="there is no checkpoint of a depth network"):
        evaluate([SMALL], EvaluationConfig(out=tmp_path, set=(f"depth_model={tmp_path}",)))
    with pytest.raises(ValueError, match="unknown device 'tpu'"):
        evaluate([SMALL], EvaluationConfig(out=tmp_path / "out", device="tpu"))
    (tmp_path / "video.mp4").touch()
    with pytest.raises(SequenceError, match="video.mp4: step must be 1 or more, got 0"):
        evaluate([f"{tmp_path / 'video.mp4'},step=0"], EvaluationConfig(out=tmp_path))
    (tmp_path / "video.mp4").unlink()
    with pytest.raises(ConfigError, match="workers must be 1 or more, got 0"):
        EvaluationConfig(workers=0)
    with pytest.raises(ConfigError, match="--held-out must be 1 or more, got 0"):
        EvaluationConfig(held_out=0)
    with pytest.raises(SequenceError, match="the synthetic patients have numbers"):
        evaluate(["phantom:liver"], EvaluationConfig(out=tmp_path))
    with pytest.raises(ConfigError, match=r"PhantomConfig has no option frame \(did you mean frames\?\); it has seed, frames"):
        evaluate([SMALL, "phantom:1,frame=3"], EvaluationConfig(out=tmp_path))
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_a_reader_takes_its_options_from_the_name(small_bag, small_frames, tmp_path):
    assert [f.stamp_ns for f in open_named(f"{small_bag},start=2,step=4")] == [f.stamp_ns for f in small_frames[2::4]]
    with pytest.raises(SequenceError, match="a bag has no option fps"):
        open_named(f"{small_bag},fps=3")
    with pytest.raises(SequenceError, match="step must be a whole number, got 2.5"):
        open_named(f"{small_bag},step=2.5")
    assert len(open_named(SMALL)) == 6
    assert open_named("phantom:2,frames=3,border=0.1") is not None
    assert parse_values(["lambda_depth=1e-3", "depth_model=1e3"], "--set", ReconstructionConfig) == {
        "lambda_depth": 1e-3,
        "depth_model": "1e3",
    }


def test_the_papers_numbers_are_complete():
    assert len(paper.PRINTED) == 48 and len({row[:3] for row in paper.PRINTED}) == 48
    methods = {"EndoGaussian", "EndoGS", "3dgs", "MVSGaussian", "fsgs", "paper"}
    for dataset in ("SCARED", "StereoMIS"):
        assert {row.method for row in tables.printed_rows("1:49", ()) if row.dataset == dataset} == methods
    minutes = {row.method: row.figures["seconds"] / 60 for row in tables.printed_rows("1:99", ()) if "seconds" in row.figures}
    assert minutes == {"EndoGaussian": 3, "EndoGS": 5, "3dgs": 6, "MVSGaussian": 2, "fsgs": 4, "paper": 2}
    assert all(15 < row.psnr < 30 and 0.6 < row.ssim < 0.9 and 0.2 < row.lpips < 0.5 for row in paper.PRINTED)


@pytest.mark.slow
@pytest.mark.dds
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


def test_the_name_of_a_patient_has_what_makes_its_frames(tmp_path):
    config = EvaluationConfig(out=tmp_path, splits=("two-views",), presets=("3dgs",), lpips=())
    named = lambda *sources: [cell.sequence for cell in list_cells(sources, config)[0]]
    moving = "phantom:0,breathing=0.008,width=160,height=128,frames=120,fps=12.5,stereo=false,rounds=0.5"
    assert named("phantom:0", moving) == ["phantom:0", "phantom:0,frames=120,fps=12.5,width=160,height=128,stereo=false,breathing=0.008"]
    assert named("phantom:2,frames=250,seed=1") == ["phantom:1"]
    for twice in ("phantom:0,frames=250", "phantom:0"):
        with pytest.raises(SequenceError, match=f"{twice}: the same sequence twice"):
            named("phantom:0", twice)


def test_names_of_recordings_stay_apart_over_several_commands(tmp_path, monkeypatch):
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "bag.mcap").write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    config = EvaluationConfig(out=tmp_path / "out", splits=("two-views",), presets=("3dgs",), lpips=())
    for folder in ("cells", "pictures"):
        (config.out / folder).mkdir(parents=True)

    def named(*sources):
        cells, _ = list_cells(sources, config)
        for cell in cells:
            save_record(config.out, cell, Finished(0, result={}))
        return [cell.sequence for cell in cells]

    assert named("one/bag.mcap", "one/bag.mcap,stop=9,step=2") == ["bag.mcap", "bag.mcap,step=2,stop=9"]
    assert named("two/bag.mcap") == ["two/bag.mcap"]
    monkeypatch.chdir("two")
    assert named("bag.mcap", "../one/bag.mcap", "../one/bag.mcap,step=3") == ["two/bag.mcap", "bag.mcap", "bag.mcap,step=3"]
    with pytest.raises(SequenceError, match="bag.mcap,stop=9,step=2: the same sequence twice"):
        named("../one/bag.mcap,step=2,stop=9", "../one/bag.mcap,stop=9,step=2")


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.dds
def test_a_run_that_is_extended_keeps_its_rows(small_bag, tmp_path, caplog):
    values = {"out": tmp_path, "splits": ("two-views",), "device": "cpu", "lpips": ()}
    short = ("iterations=2", "max_gaussians=300", "image_width=96", "extrapolation=0", "depth=stereo")
    row = lambda record: tuple(record["cell"][name] for name in ("sequence", "method", "seed"))
    rows = lambda sequence, *presets, extra=(), **options: sorted(
        map(row, evaluate([sequence], EvaluationConfig(presets=presets, set=short + extra, **values, **options))["cells"])
    )
    whole, other = str(small_bag), "small,step=2"
    first = [("small", "3dgs", 0), ("small", "3dgs", 1)]
    assert rows(whole, "3dgs", seeds=2) == first
    caplog.set_level("INFO")
    assert rows(f"{whole},step=2", "3dgs", "default") == sorted([*first, (other, "3dgs", 0), (other, "default", 0)])
    assert "not in the tables" not in caplog.text
    table = list(csv.DictReader((tmp_path / "table.csv").open()))
    measured = [(line["sequence"], line["method"], line["seeds"]) for line in table if line["source"] == "measured"]
    assert measured == [("small", "3dgs", "2"), (other, "3dgs", "1"), (other, "default", "1")]
    assert rows(whole, "3dgs", extra=("sh_degree=1",)) == [("small", "3dgs", 0)]
    assert f"3 cells in {tmp_path} made with other options, or by another version, not in the tables" in caplog.text


def test_options_that_are_files_are_short_in_names():
    _, (short, *_, longest) = source_names("endo.mp4,poses=/some/where/poses.txt,fx=907.4")
    assert short == "endo.mp4,fx=907.4,poses=poses.txt" and longest.endswith("endo.mp4,fx=907.4,poses=/some/where/poses.txt")
