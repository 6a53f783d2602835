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


_OPENCV = "KL: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: [500., 0., 320., 0., 500., 256., 0., 0., 1.]\n"


@pytest.mark.parametrize(
    "text, sentence",
    [
        (
            "%YAML:1.0\n---\n" + _OPENCV,
            "holds matrices of OpenCV, but none by the names camera_matrix, K, K1 or M1; rename these, or give lines as `fx: 907.4` with "
            ".*, with 0.5 added to those cx and cy",
        ),
        ("%YAML:1.0\nCamera.fx: 500.\n" + _OPENCV, "holds settings of ORB-SLAM; give lines"),
        ("500 0 320\n0 500 256\n0 0 1\n", "holds no `name: value` lines; give lines"),
        ("K: [500, 0, 320, 0, 500, 256, 0, 0, 1]\n", "fx is missing; give lines"),
        ("fx: 500\nfy: 500\ncx: 320\n", "cy is missing; give lines"),
    ],
)
def test_a_calibration_in_another_form_is_told_by_its_name(tmp_path, text, sentence):
    path = tmp_path / "calibration.yaml"
    path.write_text(text)
    with pytest.raises(SequenceError, match=f"calibration.yaml: {sentence}"):
        read_calibration(path)


@pytest.mark.parametrize(
    "text", ["%YAML:1.0\n---\nfx: 500.\nfy: 500.\ncx: 320.\ncy: 256.\n", "{fx: 500, fy: 500, cx: 320, cy: 256}  # of an opencv-matrix\n"]
)
def test_what_opencv_writes_beside_the_numbers_does_no_harm(tmp_path, text):
    path = tmp_path / "calibration.yaml"
    path.write_text(text)
    assert read_calibration(path)["cx"] == 320


def test_a_calibration_in_parts_of_the_image_is_refused(tmp_path):
    with pytest.raises(SequenceError, match="cx and cy are 0.5 and 0.5, which are no pixels; multiply them by width and height"):
        check_calibrated_size({"fx": 0.8, "fy": 1.0, "cx": 0.5, "cy": 0.5}, (640, 512), tmp_path / "c.yaml")


@pytest.mark.parametrize("factor", [0.5, 2 / 3, 1.5, 2])
def test_a_calibration_of_another_image_size_is_refused_unless_its_size_is_stated(tmp_path, factor):
    fields = {name: factor * value for name, value in (("fx", 500), ("fy", 500), ("cx", 315), ("cy", 259))}
    size = f"{2 * fields['cx']:.0f}×{2 * fields['cy']:.0f}"
    with pytest.raises(
        SequenceError, match=f"c.yaml: cx and cy would be the centre of images of {size}, but the images are 640×512; scale"
    ):
        check_calibrated_size(fields, (640, 512), tmp_path / "c.yaml")
    if factor < 2:  # else the principal point lies outside of the images
        check_calibrated_size({**fields, "width": 640, "height": 512}, (640, 512), tmp_path / "c.yaml")
        check_calibrated_size({**fields, "cy": 256}, (640, 512), tmp_path / "c.yaml")  # the lens looks aside, not far off both ways


@pytest.mark.parametrize(("across", "down", "told"), [(1.25, 1.25, True), (0.8, 0.8, True), (1.1, 1.1, False), (1.3, 1.2, False)])
def test_a_calibration_that_may_be_of_another_image_size_is_told(tmp_path, caplog, across, down, told):
    check_calibrated_size({"fx": 500, "fy": 500, "cx": 320 * across, "cy": 256 * down}, (640, 512), tmp_path / "c.yaml")
    assert ("would be the centre of images of" in caplog.text) == told


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
