"""The benchmarks run and report; nothing is asserted about time."""

import json
import math

import pytest
import torch

from endo_sim_ros.evaluation.bench import Row, machine, median_seconds, report
from endo_sim_ros.evaluation.raster_bench import Plan, bench_raster, tissue
from endo_sim_ros.splatting import rasterize

SMALL = Plan(
    counts=(50,),
    sizes=((32, 24),),
    curve_counts=(20, 1000),
    curve_sizes=((16, 16),),
    overlaps=(2.0,),
    reference=(40, 24, 16),
    training=(300, 96, 80),
    seconds=0.0,
)


def test_median_seconds_leaves_out_the_warm_up():
    calls = []
    seconds = median_seconds(lambda: calls.append(0), 3, warm_up=2)
    assert len(calls) == 5 and seconds >= 0


def test_a_report_is_a_table_for_people_and_a_list_for_machines(tmp_path, capsys):
    rows = [Row("a thing", 1.5, "ms", 0.25, "a peer"), Row("another", 3.0, "MB")]
    report("Things", rows, tmp_path / "new" / "rows.json")
    printed = capsys.readouterr().out
    assert all(text in printed for text in ("Things", "a thing", "1.5", "0.25", "a peer", "another"))
    assert [Row(**row) for row in json.loads((tmp_path / "new" / "rows.json").read_text())] == rows


def test_the_machine_is_named():
    assert "threads" in machine("cpu")


@pytest.mark.parametrize("count", [100, 5000])
def test_the_tissue_of_the_benchmark_fills_the_image(count):
    scene = tissue(count, 64, 48)
    assert rasterize(*scene.gaussians, *scene[1:]).alphas.mean() > 0.7


def test_the_rasteriser_bench_reports_every_row(tmp_path, capsys):
    threads = torch.get_num_threads()
    bench_raster("cpu", tmp_path / "rows.json", SMALL)
    assert torch.get_num_threads() == threads
    assert "Rasteriser on" in capsys.readouterr().out
    rows = {row["name"]: row for row in json.loads((tmp_path / "rows.json").read_text())}
    expected = {"50 32x24 forward": "ms", "50 32x24 forward + backward": "ms", "40 24x16 forward": "ms"}
    expected |= {"over Gaussians: 20 32x24": "ms", "over Gaussians: 1k 32x24": "ms", "over pixels: 50 16x16": "ms"}
    expected |= {"over overlap: 50 32x24 overlap x2": "ms", "training 300 96x80": "iterations/s"}
    for name, unit in expected.items():
        assert rows[name]["unit"] == unit and 0 < rows[name]["value"] < math.inf
    for name, peer in {"50 32x24 forward": "plain scalar kernel", "40 24x16 forward + backward": "torch reference"}.items():
        assert rows[name]["peer"] == peer and rows[name]["ratio"] > 0
    for name in ("50 32x24 mean colour difference", "40 24x16 mean colour difference"):
        assert rows[name]["peer"] and rows[name]["value"] < 1e-5
    errors = {name: row for name, row in rows.items() if name.startswith("error of")}
    assert len(errors) == 22
    assert all(row["unit"] == "relative" and 0 <= row["value"] < 1e-4 for row in errors.values())
