"""The benchmark of identification runs and reports."""

import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import identification, lung_trials
from benchmarks.identification import Truth, bench_identification
from benchmarks.presses import Plan, press, tabulate
from endo_sim_ros.evaluation.measurement import report
from endo_sim_ros.identification import IdentificationError
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.tasks.palpation import Palpation


@pytest.mark.thorough
@pytest.mark.slow
def test_bench_tells_errors_intervals_and_speed(tmp_path, monkeypatch, capsys):
    small = {"nodes": 150, "layers": 2, "by_nodes": 150, "by_layers": 2, "finer_nodes": 250, "finer_layers": 2}
    monkeypatch.setattr(identification, "TRUTHS", (Truth("of the same model", **small),))
    monkeypatch.setattr(identification, "PRESSES", 1)
    monkeypatch.setattr(identification, "speed_rows", partial(identification.speed_rows, unknowns=(1, 2), steps=12))
    bench_identification(tmp_path / "rows.json", "cpu", cases=1, inclusions=0, searches=0, palpations=0, noises=0, fields=0)
    rows = {row["name"]: row["value"] for row in json.loads((tmp_path / "rows.json").read_text())}
    assert rows["steps of 5 copies"] > 0 and rows["Jacobian of 2 unknowns, one press"] > 0
    assert 0 <= rows["one modulus, truth of the same model: error, median"] < 50
    assert rows["one modulus, truth of the same model: 90 % intervals that hold it"] in (0, 100)
    with pytest.raises(ValueError, match="must be 0 or more"):
        bench_identification(None, "cpu", cases=-1)
    with pytest.raises(ValueError, match="no truth with 'of none' in its name, but: of the same model"):
        bench_identification(None, "cpu", truth="of none")


def test_cases_that_are_refused_are_counted(monkeypatch):
    answers = iter([IdentificationError("no force"), {"young_modulus": SimpleNamespace(low=1e2, estimate=4e3, high=1e6)}])

    class Found(dict):
        findings = ()

    def answer(*_, **__):
        if isinstance(each := next(answers), Exception):
            raise each
        return Found(each)

    monkeypatch.setattr(identification, "measure", lambda *_, **__: None)
    monkeypatch.setattr(identification, "identify", answer)
    truth = Truth("of the same model", nodes=300, layers=2, by_nodes=300, by_layers=2)
    told = {row.name.split(": ")[1]: row.value for row in identification.modulus_rows(load_scene(), "cpu", truth, 2)}
    assert told["cases refused"] == 50 and told["90 % intervals that hold it"] == 100 and told["cases with findings"] == 0


def test_fields_count_the_known_nodes_whose_intervals_hold_the_truth(monkeypatch):
    config, scene = replace(identification.physics("cpu"), node_count=300, layers=2), load_scene()
    nodes = scene.nodes(config)
    monkeypatch.setattr(identification, "measure", lambda press, nodes, physics, rng, factors, *_, **__: factors)

    def found(experiments, *_):
        truth = config.young_modulus * experiments[0]
        held = np.abs(np.log(experiments[0])) < np.log(2)  # of what is like the rest
        return SimpleNamespace(low=truth * np.where(held, 0.9, 1.1), high=truth * 1.2, known=np.arange(len(truth)) % 2 == 0)

    monkeypatch.setattr(identification, "identify", found)
    for kind in identification.FIELDS:
        told = {row.name.split(f"{kind}: ")[1]: row.value for row in identification.field_rows(scene, config, kind, 2, 0.008)}
        assert told["known"] == pytest.approx(50, abs=0.5)
        assert told["90 % intervals that hold it, of those that differ"] == 0 < told["90 % intervals that hold it, of the known"] < 100
        hidden, places = identification.hide(nodes, 0, 0.008)
        factors = identification.field_of(kind, nodes, hidden, places, 0.008)
        assert (factors.min() < 0.5) == (kind != "an inclusion") and factors.max() > 2


@pytest.mark.slow
def test_a_folder_without_presses_is_refused_before_the_long_work(tmp_path, monkeypatch):
    monkeypatch.setattr(identification, "run_stages", lambda stages: pytest.fail("it has begun"))
    with pytest.raises(ValueError, match="there are no CSV files of presses"):
        bench_identification(None, "cpu", folder=tmp_path)


@pytest.mark.thorough
def test_palpation_that_expects_to_learn_needs_fewer_steps_than_its_script(monkeypatch):
    coarse = replace(Palpation.physics("cpu"), node_count=500, layers=2)
    monkeypatch.setattr(Palpation, "physics", staticmethod(lambda *_: coarse))
    rows = {row.name: row.value for row in identification.palpation_rows(load_scene(), "cpu", 1)}
    assert rows["palpation by expected information: solved"] == rows["palpation by its script: solved"] == 100
    assert rows["palpation by expected information: steps, mean of 1"] < rows["palpation by its script: steps, mean of 1"]


@pytest.mark.thorough
@pytest.mark.slow
def test_where_contact_begins_is_no_part_of_what_a_trial_tells_of_the_next(tmp_path):
    _, table = tabulate("fung", Plan().poisson_ratio)[6]
    lines, at = ["trial,time_s,force_N,position_mm"], np.linspace(0, 1, 120)
    for trial, lead in enumerate((0.1, 0.3)):  # how far the press has gone when the first force counts
        force = 30 * press(table, 1.0, 0.6, lead)(at) / press(table, 1.0, 0.6, lead)(0.7)
        force = np.where(at < 0.7, force, np.interp(at, [0.7, 1.0], [20, 50]))  # it ruptures, and is squeezed flat
        lines += [f"{trial},{20 * x:.3f},{each:.4f},{10 * x:.4f}" for x, each in zip(at, force)]
    (tmp_path / "late.csv").write_text("\n".join(lines))
    worst = {row.name.split(", ", 2)[2]: row.value for row in lung_trials.lung_rows(tmp_path) if "greatest error" in row.name}
    assert worst["scale and contact fitted, median"] < 0.5 * worst["scale fitted, median"]
    assert worst["no law, median"] > worst["scale and contact fitted, median"]  # the pieces differ


@pytest.mark.thorough
@pytest.mark.slow
def test_trials_that_are_alike_predict_each_other(tmp_path):
    lines = ["trial,time_s,force_N,position_mm"]
    for trial, (scale, noise) in enumerate(((1.0, 0.0), (1.02, 0.01))):
        for step in range(60):
            x = step / 59
            lines.append(f"{trial},{20 * x:.3f},{50 * scale * (0.02 + 0.3 * x + 0.68 * x**3) + noise:.4f},{10 * x:.4f}")
    (tmp_path / "even.csv").write_text("\n".join(lines))
    rows = lung_trials.lung_rows(tmp_path)
    report("lungs", rows)
    assert [row.value for row in rows if "within 10 %" in row.name] == [100] * 6
    assert all(row.value < 5 for row in rows if "greatest error" in row.name and "first half" not in row.name)
    with pytest.raises(ValueError, match="no CSV files"):
        lung_trials.lung_rows(tmp_path / "nowhere")
