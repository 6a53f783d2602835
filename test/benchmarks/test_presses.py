"""The laws of materials on presses: made by a known law, spoilt, and those of a porcine lung."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import presses
from benchmarks.presses import LINE, STRETCHES, Plan, bench_presses, fit, press, read_trials, rows_of, tabulate
from endo_sim_ros.evaluation.measurement import Row
from endo_sim_ros.physics.materials import MATERIALS

REAL = Path(__file__).parents[3] / "shared/data/lung_press"
HEADER = "trial,time_s,force_N,position_mm"


def write_presses(file: Path, table: np.ndarray, **maxwell: float) -> None:
    """Three presses of columns of other widths and thicknesses, which rupture at half of the way and are then squeezed flat."""
    lines = [HEADER]
    for trial, (scale, thickness) in enumerate([(10.0, 40.0), (14.0, 30.0), (8.0, 50.0)]):
        travel = np.linspace(0, 1, 1500)
        force = scale * press(table, 1 / 80, 0.8, 0.15, **maxwell)(travel)
        force = force / force[0] * 0.5  # the first contact
        force = np.where(travel > 0.5, 0.7 * force, force)
        force[-1] = 60.0
        lines += [f"{trial},{80 * t:.3f},{f:.6f},{20 + thickness * t:.5f}" for t, f in zip(travel, force)]
    file.write_text("\n".join([lines[0], *reversed(lines[1:])]))  # rows in any order


@pytest.mark.parametrize("material", MATERIALS)
def test_a_column_has_its_modulus_when_it_is_pressed_a_little(material, monkeypatch):
    monkeypatch.setattr(presses, "RATES", np.array([2.0]))
    ((rate, table),) = tabulate(material, 0.3)
    assert np.interp(0.99, STRETCHES, table) == pytest.approx(0.01, rel=0.03) and np.isnan(rate) == (material != "fung")


@pytest.mark.slow
def test_presses_that_a_law_made_are_predicted_by_it(tmp_path, monkeypatch):
    monkeypatch.setattr(presses, "RATES", np.array([0.5, 2.0, 8.0]))
    laws = {name: tabulate(name, 0.3) for name in MATERIALS}
    write_presses(tmp_path / "organ.csv", laws["fung"][1][1])
    trials = read_trials(tmp_path / "organ.csv", Plan())
    assert len(trials) == 3 and all(0.49 < each.travel[-1] < 0.51 for each in trials), "until it ruptures"
    rows = {(row.name, row.peer): row for row in rows_of("organ", trials, laws)}
    assert rows["organ: stiffening of fung, median", None].value == 2.0
    for what in ("fitted", "held out"):
        assert rows[f"organ: {what}, fung", LINE].value < 0.1
        assert rows[f"organ: {what}, fung", LINE].ratio < 0.05 and rows[f"organ: {what}, fung", "neo_hookean"].ratio < 0.5
        assert rows[f"organ: {what}, {LINE}", None].value > 2


def test_tissue_that_relaxed_while_it_was_pressed_is_told_its_time(tmp_path, monkeypatch):
    monkeypatch.setattr(presses, "RATES", np.array([2.0]))
    tables = tabulate("fung", 0.3)
    write_presses(tmp_path / "organ.csv", tables[0][1], ratio=3.0, log_time=np.log(8.0))
    (rate, ratio, time), _ = fit(read_trials(tmp_path / "organ.csv", Plan())[0], tables, relaxing=True)
    assert (rate, ratio, time) == (2.0, pytest.approx(3.0, rel=0.1), pytest.approx(8.0, rel=0.1))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("trial,time_s,force_N\n1,0,1\n", "there is no column position_mm; a table of presses has"),
        ("", "not a table: "),
        ("a,b\n1,2\n", "there is no column trial"),
        (f"{HEADER}\n1,0,1,2\n1,1,many,3\n", "row 2 has no number for each of"),
        (f"{HEADER}\n1,0,1,2\n1,1,inf,3\n", "row 2 has no number for each of"),
        (f"{HEADER}\n1,0,1\n1,1,2,3\n", "not a table: Some errors were detected"),
        (f"{HEADER}\n1,0,0.1,2\n1,1,0.2,3\n", "0 of 1 trials press the tissue flat; two are needed"),
        (f"{HEADER}\n", "0 of 0 trials press"),
    ],
)
@pytest.mark.filterwarnings("ignore:genfromtxt")
def test_a_table_without_presses_is_one_sentence(tmp_path, text, sentence):
    (tmp_path / "organ.csv").write_text(text)
    with pytest.raises(ValueError, match=f"organ.csv: {sentence}"):
        bench_presses(tmp_path)


def test_a_folder_without_tables_is_one_sentence(tmp_path):
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(ValueError, match="there are no CSV files of presses; name the folder"):
            bench_presses(folder)


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="the presses of a lung are not at ../shared/data/lung_press")
def test_stiffening_tissue_predicts_presses_of_a_lung(monkeypatch):
    monkeypatch.setattr(presses, "RATES", np.geomspace(0.05, 50, 4))
    laws = {name: tabulate(name, Plan().poisson_ratio) for name in MATERIALS}
    for file in sorted(REAL.glob("*.csv")):
        rows: dict[tuple[str, str | None], Row] = {(row.name, row.peer): row for row in rows_of("", read_trials(file, Plan()), laws)}
        assert rows[": fitted, fung", LINE].value < 0.8 and rows[": held out, fung", LINE].value < 3.5
        assert rows[": held out, fung", LINE].ratio < 0.4 and rows[": held out, fung", "neo_hookean"].ratio < 1.05
