"""Hostile calibration files."""

import pytest

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.calibration_files import read_calibration


def test_a_calibration_file_runs_no_code(tmp_path):
    path, trace = tmp_path / "calibration.yaml", tmp_path / "trace"
    path.write_text(f"fx: !!python/object/apply:builtins.open ['{trace}', 'w']\n")
    with pytest.raises(SequenceError, match="calibration.yaml: not a readable YAML file"):
        read_calibration(path)
    assert not trace.exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    "text, sentence",
    [
        ("fx: true\n", "fx must be a positive number, got True"),
        ("fx: " + "1" * 400, "fx must be a positive number"),
        ("fx: " + "1" * 6000, "not a readable YAML file|must be a positive number"),
        ("fx: " + "[" * 3000, "not a readable YAML file"),
        ("fx: 500\nfy: 500\ncx: 1\ncy: 1\ndistortion: [.nan]\n", "distortion must be finite"),
        ("a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [{f'*a{i - 1}, ' * 9}]\n" for i in range(1, 20)) + "fx: *a19\n", "fx must be"),
        ("# " + "x" * 100_000, "far more than a calibration needs"),
    ],
)
def test_a_calibration_file_beyond_all_bounds_is_one_short_sentence(tmp_path, text, sentence):
    path = tmp_path / "calibration.yaml"
    path.write_text(text)
    with pytest.raises(SequenceError, match=sentence) as error:
        read_calibration(path)
    assert len(str(error.value)) < 1000
