"""The benchmark of environments runs and reports."""

import json

import pytest

from benchmarks.environments import bench_environments


@pytest.mark.thorough
@pytest.mark.slow
def test_bench_gives_a_row_for_each_number_of_environments(tmp_path, capsys):
    bench_environments(tmp_path / "rows.json", "retraction", (1, 2), "cpu", repeats=1)
    rows = json.loads((tmp_path / "rows.json").read_text())
    rows, others = rows[:8], rows[8:]
    assert all(row["value"] > 0 and row["unit"] == "steps/s" for row in rows)
    assert [row["unit"] for row in others] == ["ms", "MB"] * 2 and others[0]["name"] == "reset of each of 1 environment"
    assert others[0]["value"] > 0 and others[2]["value"] > 0
    assert rows[1]["ratio"] > 0 and rows[1]["peer"] == "1 environment"
    assert all(row["peer"] == "without the tool" for row in rows[4:]) and rows[4]["ratio"] == pytest.approx(
        rows[4]["value"] / rows[2]["value"]
    )
    with pytest.raises(ValueError, match="numbers of environments of at least 1, got 4 0"):
        bench_environments(None, "retraction", (4, 0), "cpu")
