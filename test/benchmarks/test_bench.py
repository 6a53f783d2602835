"""The benchmarks run and report; nothing is asserted about time."""

import json
import math
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from benchmarks import physics
from benchmarks.physics import bench_physics, load_scene, phantom_scene
from benchmarks.raster import Plan, bench_raster, tissue
from endo_sim_ros.core.cameras import look_at, save_cameras
from endo_sim_ros.core.gaussians import save_ply
from endo_sim_ros.evaluation.bars import plot_rows
from endo_sim_ros.evaluation.measurement import Row, machine, median_seconds, report
from endo_sim_ros.splatting import rasterize, render

SMALL = Plan(
    counts=(50,),
    sizes=((32, 24),),
    curve_counts=(20, 1000),
    curve_sizes=((16, 16),),
    overlaps=(2.0,),
    reference=(40, 24, 16),
    training=(300, 48, 40),
    seconds=0.0,
)
SMALL_PHYSICS = physics.Plan(
    gaussians=800,
    width=96,
    printed_nodes=100,
    travel=0.003,
    node_counts=(80,),
    substeps=(3,),
    skin_counts=(500,),
    batch_nodes=(80,),
    peer_grid=16,
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


@pytest.mark.slow
def test_results_of_two_machines_are_drawn_side_by_side(tmp_path):
    matplotlib = pytest.importorskip("matplotlib")
    rows = [Row("step of 2k nodes", 4.13, "ms", 0.1, "plain"), Row("step of 2k nodes", 4.13, "ms", 0.5, "other"), Row("PSNR", 31.7, "dB")]
    for name, factor in (("laptop", 1.0), ("gpu", 0.1)):
        report("", [replace(row, value=row.value * factor) for row in rows], tmp_path / f"{name}.json")
    files, picture = [tmp_path / "laptop.json", tmp_path / "gpu.json"], tmp_path / "both.svg"
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        assert plot_rows(files, picture, title="Speed") == 6
    drawn = picture.read_text()
    for text in ("laptop", "gpu", "step of 2k nodes", "PSNR", "ms", "dB", "Speed", "peer in the same run"):
        assert text in drawn, text
    assert drawn.count("31.7<") == 1 and drawn.count("4.13<") == 1  # once, though it has two peers
    plot_rows(files, tmp_path / "some.png", only="step")
    with pytest.raises(ValueError, match="gpu.json: no row to draw whose name has 'cut'"):
        plot_rows(files, picture, only="cut")
    (tmp_path / "no.json").write_text('{"value": 1}')
    with pytest.raises(ValueError, match="no.json: not the rows that `endo-sim bench … --json` writes"):
        plot_rows([tmp_path / "no.json"], picture)


def test_the_machine_is_named():
    assert "threads" in machine("cpu")


@pytest.mark.parametrize("count", [100, 5000])
def test_the_tissue_of_the_benchmark_fills_the_image(count):
    scene = tissue(count, 64, 48)
    assert rasterize(*scene.gaussians, *scene[1:]).alphas.mean() > 0.7


@pytest.mark.thorough
@pytest.mark.slow
def test_the_rasteriser_bench_reports_every_row(tmp_path, capsys):
    threads = torch.get_num_threads()
    bench_raster("cpu", tmp_path / "rows.json", SMALL)
    assert torch.get_num_threads() == threads
    assert "Rasteriser on" in capsys.readouterr().out
    rows = {row["name"]: row for row in json.loads((tmp_path / "rows.json").read_text())}
    expected = {"50 32x24 forward": "ms", "50 32x24 forward + backward": "ms", "40 24x16 forward": "ms"}
    expected |= {"over Gaussians: 20 32x24": "ms", "over Gaussians: 1k 32x24": "ms", "over pixels: 50 16x16": "ms"}
    expected |= {"1 instrument 32x24": "ms", "2 instruments with shadows 32x24": "ms"}
    expected |= {"whole picture, one eye 32x24": "ms", "whole picture, both eyes 32x24": "ms"}
    expected |= {"over overlap: 50 32x24 overlap x2": "ms", "training 300 48x40": "iterations/s"}
    for name, unit in expected.items():
        assert rows[name]["unit"] == unit and 0 < rows[name]["value"] < math.inf
    for name, peer in {"50 32x24 forward": "plain scalar kernel, one thread", "40 24x16 forward + backward": "torch reference"}.items():
        assert rows[name]["peer"] == peer and rows[name]["ratio"] > 0
    for name in ("50 32x24 mean colour difference", "40 24x16 mean colour difference"):
        assert rows[name]["peer"] and rows[name]["value"] < 1e-5
    errors = {name: row for name, row in rows.items() if name.startswith("error of")}
    assert len(errors) == 22
    assert all(row["unit"] == "relative" and 0 <= row["value"] < 1e-4 for row in errors.values())


def rows_of_physics(tmp_path, **arguments) -> dict[tuple[str, str | None], dict]:
    bench_physics("cpu", tmp_path / "rows.json", environments=(1, 2), plan=SMALL_PHYSICS, **arguments)
    return {(row["name"], row["peer"]): row for row in json.loads((tmp_path / "rows.json").read_text())}


@pytest.mark.slow
def test_the_physics_bench_reports_every_row(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(physics.importlib.util, "find_spec", lambda name: None)  # no peer
    threads = torch.get_num_threads()
    rows = rows_of_physics(tmp_path)
    assert torch.get_num_threads() == threads
    assert "Simulation on" in capsys.readouterr().out
    dense, plain = "dense", "plain Warp kernels"
    expected = {("dense: simulation alone", None): "FPS", ("dense: with images 96x77", None): "FPS"}
    expected |= {(f"{name}: {what}", dense): "FPS" for name in ("printed", "default") for what in ("simulation alone", "with images 96x77")}
    shown = ("at rest", "printed", "printed, compact weights", "default")
    expected |= {(f"{name}: PSNR, {what}", "dense's images"): "dB" for name in shown for what in ("mean", "lowest")}
    expected |= {("over nodes: 80, printed, 80 substeps", plain): "ms", ("over nodes: 80, default", plain): "ms"}
    expected |= {("over substeps: 3, 100 nodes", plain): "ms", ("100 nodes, pressed by a capsule", "no contact"): "ms"}
    expected |= {("100 nodes, pressed by an instrument", peer): "ms" for peer in (plain, "no contact")}
    expected |= {(name, plain): "ms" for name in ("100 nodes, pressed by a capsule", "skin 500", "step and skin 500")}
    expected |= {("step and skin 500", "step, then skin"): "ms", ("1 x 80 nodes: steps of all", None): "1/s"}
    expected |= {("2 x 80 nodes: steps of all", "1 x 80 nodes"): "1/s", ("2 x 80 nodes: steps of each", None): "1/s"}
    expected |= {("state of a node", None): "B", ("solver per node", None): "B"}
    for key, unit in expected.items():
        assert rows[key]["unit"] == unit and 0 < rows[key]["value"] < math.inf, key
        ratio = rows[key]["ratio"]
        assert (ratio is None) == (key[1] in (None, "dense's images")) and (ratio is None or 0 < ratio < math.inf), key
    assert rows["paper: its sparse nodes, RTX 3090", "PhysGaussian, in the paper"]["ratio"] == 57 / 4
    assert 2 < rows["dense: farthest any node went", None]["value"] < 10
    assert rows["state of a node", None]["value"] == 4 * (3 + 3 + 9 + 9 + 9)
    assert not any("PhysGaussian's solver" in name for name, _ in rows)


@pytest.mark.thorough
@pytest.mark.slow
def test_the_papers_comparison_is_the_median_over_scenes_and_may_be_driven_by_a_force(monkeypatch):
    scenes, plan = [phantom_scene(count, SMALL_PHYSICS.width) for count in (2000, 1500)], SMALL_PHYSICS._replace(force=0.01)
    each, paper = [], physics._paper
    monkeypatch.setattr(physics, "_paper", lambda *given: each.append(paper(*given)) or each[-1])
    compared = physics._over_scenes(scenes, "cpu", "force", plan)
    assert all(row.name.endswith(", median of 2 scenes") for row in compared)
    rows = {row.name.removesuffix(", median of 2 scenes"): row for row in compared}
    assert rows["paper: its sparse nodes, RTX 3090"].ratio == 57 / 4 and rows["default: simulation alone"].ratio > 0
    twice = paper(scenes[0], "cpu", "force", plan._replace(force=0.02))
    *one, twice = ({row.name: row.value for row in told} for told in (*each, twice))
    far = "default: farthest any node went"
    np.testing.assert_allclose(rows[far].value, np.mean([numbers[far] for numbers in one]), rtol=1e-5)
    assert twice[far] == pytest.approx(2 * one[0][far], rel=0.1)  # a small force: linear
    assert 1.2 * one[0]["dense: farthest any node went"] < twice["dense: farthest any node went"]


PEER = """
import numpy as np

class MPM_Simulator_WARP:
    def __init__(self, n_particles, n_grid, grid_lim, device):
        assert device == "cpu"
        self.mpm_state, self.grid_lim, self.steps = type("State", (), {})(), grid_lim, 0
        print("loud")

    def set_parameters_dict(self, kwargs, device):
        assert kwargs["density"] == 1000.0

    def finalize_mu_lam(self, device):
        pass

    def p2g2p(self, step, dt, device):
        x = self.mpm_state.particle_x.numpy()
        assert (x > 0.1 * self.grid_lim).all() and (x < 0.9 * self.grid_lim).all() and 0 <= step < 80
"""


@pytest.mark.slow
@pytest.mark.parametrize("working", [True, False])
def test_the_peer_is_measured_where_it_works_and_otherwise_noted(working, tmp_path, capsys, monkeypatch):
    (tmp_path / "mpm_solver_warp.py").write_text(PEER if working else "import warp.no_such_module")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "mpm_solver_warp", raising=False)
    only_the_peer = lambda scenes, device, environments, driven, *rest: [("", partial(physics.beside_peer, scenes[0], device, *rest))]
    monkeypatch.setattr(physics, "stages", only_the_peer)
    rows = rows_of_physics(tmp_path)
    monkeypatch.delitem(sys.modules, "mpm_solver_warp", raising=False)
    out = capsys.readouterr().out
    assert "loud" not in out
    if working:
        assert ("PhysGaussian's solver, 100 nodes, 16³ grid", None) in rows
        for name in ("80 substeps", "default"):
            assert rows[f"100 nodes, {name}", "PhysGaussian's solver, 100 nodes"]["ratio"] > 0
            skinned = [row for (what, _), row in rows.items() if what.startswith("100 nodes and skin of") and what.endswith(name)]
            assert len(skinned) == 1 and skinned[0]["ratio"] > 0 and "dense nodes" in skinned[0]["peer"]
    else:
        assert not rows and "PhysGaussian's solver could not be measured: ModuleNotFoundError: No module named" in out


@pytest.mark.slow
def test_a_model_file_is_seen_by_its_camera_or_from_the_origin(tmp_path):
    scene = phantom_scene(500, 64)
    assert 400 < len(scene.model) < 600
    assert render(scene.model, scene.camera).alphas.mean() > 0.9
    save_ply(scene.model, tmp_path / "model.ply")
    seen = load_scene(tmp_path / "model.ply", 64)
    assert (seen.camera.position == 0).all() and seen.camera.height == 51
    assert abs(seen.tip[2] - scene.tip[2]) < 0.01
    moved = scene.camera.at(look_at(np.array([0.01, 0.0, 0.0]), scene.tip))
    save_cameras([moved], tmp_path / "cameras.json")
    seen = load_scene(tmp_path / "model.ply", 128)
    assert seen.camera.width == 128 and seen.camera.position[0] == 0.01
    assert np.abs(seen.tip - scene.tip).max() < 0.003
