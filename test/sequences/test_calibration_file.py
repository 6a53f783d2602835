"""Hostile calibration files."""

import pytest

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.calibration_files import check_calibrated_size, read_calibration


def test_a_calibration_file_runs_no_code(tmp_path):
    path, trace = tmp_path / "calibration.yaml", tmp_path / "trace"
    path.write_text(f"fx: !!python/object/apply:builtins.open ['{trace}', 'w']\n")
    with pytest.raises(SequenceError, match="calibration.yaml: not a readable YAML file"):
        read_calibration(path)
    assert not trace.exists()


def test_numbers_with_an_exponent_are_numbers(tmp_path):
    path = tmp_path / "calibration.yaml"
    path.write_text("fx: 5e2\nfy: 5.0e2\ncx: 1.6e2\ncy: 128\nbaseline_m: 4e-3\n")
    fields = read_calibration(path)
    assert [fields[name] for name in ("fx", "fy", "cx", "cy", "baseline_m")] == [500, 500, 160, 128, 0.004]
    check_calibrated_size(fields, (320, 256), path)
    path.write_text("fx: 1e8\nfy: 500\ncx: 160\ncy: 128\n")
    with pytest.raises(SequenceError, match=r"yaml: no endoscope has focal lengths of 1e\+08 and 500 pixels with images of 320×256; give"):
        check_calibrated_size(read_calibration(path), (320, 256), path)
    path.write_text("fx: 1e9\n")
    with pytest.raises(SequenceError, match=r"fx must be a positive number below 1e9, got 1000000000.0"):
        read_calibration(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "text, sentence",
    [
        ("fx: true\n", "fx must be a positive number below 1e9, got True"),
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
