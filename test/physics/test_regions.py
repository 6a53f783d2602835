"""Painted regions: shapes, masks seen by cameras, their text form and what it refuses."""

import cv2
import numpy as np
import pytest

from endo_sim_ros.core.cameras import Camera, look_at, save_cameras
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.physics.regions import TissueProperties, inside_box, inside_sphere, paint_regions, parse_region, seen_in_mask

CAMERA = Camera(np.array([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]]), 80, 60)  # at the origin, along z
SOFT = TissueProperties.uniform(4, 1e4, 0.3, 1000.0)
POINTS = np.array([[0.0, 0, 0.1], [0.02, 0, 0.1], [0, 0.02, 0.1], [0, 0, 0.2]])


@pytest.fixture
def painted(tmp_path, monkeypatch):
    """A folder with two cameras and a mask painted in the second: the right half of its image."""
    save_cameras([CAMERA.at(look_at([1.0, 0, 0], [2.0, 0, 0])), CAMERA], tmp_path / "cameras.json")
    mask = np.zeros((60, 80), np.uint8)
    mask[:, 45:] = 255
    cv2.imwrite(str(tmp_path / "tumour.png"), mask)
    monkeypatch.chdir(tmp_path)
    return mask


def test_painting_changes_what_is_given_where_it_is_asked_for_and_nothing_else():
    where = np.array([False, True, True, False])
    stiff = SOFT.painted(where, young_modulus=5e4, density=1050)
    assert stiff.young_modulus.tolist() == [1e4, 5e4, 5e4, 1e4]
    assert stiff.density.tolist() == [1000, 1050, 1050, 1000]
    assert stiff.poisson_ratio.tolist() == [0.3] * 4 and SOFT.young_modulus.tolist() == [1e4] * 4
    assert len(stiff) == 4 and stiff.young_modulus.dtype == np.float64


def test_properties_belong_to_nobody_else():
    values = np.full(3, 1e4)
    properties = TissueProperties(values, values * 0, values)
    values[:] = -1
    assert (properties.young_modulus == 1e4).all()
    with pytest.raises(ValueError, match="read-only"):
        properties.young_modulus[0] = -1


@pytest.mark.parametrize(
    "name, value, sentence",
    [
        ("young_modulus", 0.0, "young_modulus of node 2 is 0, but must be finite and above 0 Pa"),
        ("young_modulus", np.inf, "young_modulus of node 2 is inf"),
        ("poisson_ratio", 0.5, "poisson_ratio of node 2 is 0.5, but must be between 0 and 0.49"),
        ("poisson_ratio", -0.1, "poisson_ratio of node 2 is -0.1"),
        ("density", np.nan, "density of node 2 is nan, but must be finite and above 0 kg/m³"),
    ],
)
def test_impossible_tissue_is_refused(name, value, sentence):
    with pytest.raises(ConfigError, match=sentence):
        SOFT.painted(np.array([False, False, True, True]), **{name: value})


def test_properties_of_different_lengths_are_refused():
    with pytest.raises(ConfigError, match=r"poisson_ratio has shape \(3,\), expected one number per node, \(4,\)"):
        TissueProperties(np.ones(4), np.zeros(3), np.ones(4))
    with pytest.raises(ConfigError, match="young_modulus has shape"):
        TissueProperties(1.0, 0.0, 1.0)
    for where in (np.ones(3, bool), np.ones(4, int)):
        with pytest.raises(ConfigError, match=r"expected bool \(4,\)"):
            SOFT.painted(where, density=1)


def test_shapes_include_their_surface():
    points = np.array([[0.0, 0, 0], [1, 1, 1], [1, 1, 1.001], [-0.001, 0.5, 0.5]])
    assert inside_box(points, [0, 0, 0], [1, 1, 1]).tolist() == [True, True, False, False]
    assert inside_sphere(points, [0, 1, 1], 1.0).tolist() == [False, True, False, True]
    assert inside_box(np.zeros((0, 3)), [0, 0, 0], [1, 1, 1]).shape == (0,)


def test_a_mask_paints_what_the_camera_sees_in_it_and_all_behind():
    rng = np.random.default_rng(0)
    camera = CAMERA.at(look_at([0.1, -0.2, 0.3], [0.4, 0.5, 0.6]))
    mask = rng.uniform(size=(60, 80)) < 0.5
    seen = []
    for depth in (0.01, 0.1, 3.0):
        points = camera.backproject(np.full((60, 80), depth)).reshape(-1, 3)
        seen.append(seen_in_mask(points, camera, mask))
        np.testing.assert_array_equal(seen[-1], mask.ravel())
    assert seen_in_mask(points, camera, 3 * mask.astype(np.uint8)).tolist() == mask.ravel().tolist()


def test_points_behind_the_camera_or_outside_its_image_are_not_seen():
    everything = np.ones((60, 80), bool)
    points = np.array([[0, 0, 0.1], [0, 0, -0.1], [0, 0, 0], [0.051, 0, 0.1], [-0.051, 0, 0.1], [0, 0.038, 0.1], [0, -0.038, 0.1]])
    assert seen_in_mask(points, CAMERA, everything).tolist() == [True] + [False] * 6


def test_a_mask_of_another_size_is_scaled_if_its_shape_fits():
    mask = np.zeros((60, 80), np.uint8)
    mask[20:40, 10:30] = 1
    points = CAMERA.backproject(np.full((60, 80), 0.1)).reshape(-1, 3)
    for larger in (mask, np.kron(mask, np.ones((3, 3), np.uint8)), mask[::10, ::10]):
        np.testing.assert_array_equal(seen_in_mask(points, CAMERA, larger), mask.ravel() > 0)
    with pytest.raises(ConfigError, match="the mask has 60×80 pixels and the camera's image 80×60, whose aspect ratio is different"):
        seen_in_mask(points, CAMERA, mask.T)
    with pytest.raises(ConfigError, match=r"the mask has shape \(60, 80, 3\)"):
        seen_in_mask(points, CAMERA, np.ones((60, 80, 3)))


def test_text_becomes_a_region():
    box = parse_region("box -0.01 -0.01 0.05 0.01 0.01 0.14 young_modulus=30000 poisson_ratio=0.4")
    assert box.properties == {"young_modulus": 3e4, "poisson_ratio": 0.4}
    assert box.contains(POINTS).tolist() == [True, False, False, False]
    flipped = parse_region("box 0.01 0.01 0.14 -0.01 -0.01 0.05 density=1")  # any two opposite corners
    assert flipped.contains(POINTS).tolist() == box.contains(POINTS).tolist()
    sphere = parse_region("sphere 0 0.01 0.1 0.015 young_modulus=5e4")
    assert sphere.contains(POINTS).tolist() == [True, False, True, False]


def test_a_mask_image_is_seen_by_the_numbered_camera(painted):
    region = parse_region("mask tumour.png cameras.json 1 young_modulus=3e4")
    assert region.contains(POINTS).tolist() == seen_in_mask(POINTS, CAMERA, painted).tolist() == [False, True, False, False]
    assert not parse_region("mask tumour.png cameras.json 0 young_modulus=3e4").contains(POINTS).any()


def test_labels_of_sixteen_bits_and_paths_with_spaces_are_fine(painted):
    cv2.imwrite("a label.png", (painted > 0).astype(np.uint16))
    region = parse_region("mask 'a label.png' cameras.json 1 density=1100")
    assert region.contains(POINTS).tolist() == [False, True, False, False]


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("", "there is no shape ''; it should look like 'box X Y Z X Y Z PROPERTY=VALUE …' or 'sphere"),
        ("cone 0 0 0 1 density=1", "there is no shape 'cone'"),
        ("box 0 0 0 1 1 density=1", "a box takes 6 values before its properties; it should look like 'box X Y Z X Y Z"),
        ("sphere 0 0 0", "a sphere takes 4 values"),
        ("sphere 0 0 0 1 2 density=1", "'2' is no property, which are young_modulus, poisson_ratio, density"),
        ("sphere 0 0 zero 1 density=1", "'zero' is not a number of metres"),
        ("sphere 0 0 inf 1 density=1", "'inf' is not a number of metres"),
        ("sphere 0 0 0 -1 density=1", "its radius is -1 m, but must be above 0"),
        ("sphere 0 0 0 1", "it changes nothing without one of young_modulus"),
        ("sphere 0 0 0 1 stiffness=1", "'stiffness=1' is no property"),
        ("sphere 0 0 0 1 young_modulus=-3", "young_modulus is '-3', but must be finite and above 0 Pa"),
        ("sphere 0 0 0 1 young_modulus=stiff", "young_modulus is 'stiff', but must be"),
        ("sphere 0 0 0 1 poisson_ratio=0.5", "poisson_ratio is '0.5', but must be between 0 and 0.49"),
        ("sphere 0 0 0 1 density=1 density=2", "density is given twice"),
        ("mask 'tumour.png cameras.json 1 density=1", "no closing quotation"),
        ("mask none.png cameras.json 1 density=1", "mask image none.png cannot be read"),
        ("mask . cameras.json 1 density=1", "mask image . cannot be read"),
        ("mask cameras.json cameras.json 1 density=1", "cameras.json is not an image"),
        ("mask tumour.png tumour.png 1 density=1", "tumour.png: not a readable list of cameras"),
        ("mask tumour.png cameras.json 2 density=1", "cameras.json has cameras 0 to 1, not '2'"),
        ("mask tumour.png cameras.json -1 density=1", "cameras.json has cameras 0 to 1, not '-1'"),
        ("mask tall.png cameras.json 1 density=1", "the mask has 60×80 pixels and the camera's image 80×60"),
    ],
)
def test_what_cannot_be_read_is_refused_in_a_sentence(painted, text, sentence):
    cv2.imwrite("tall.png", painted.T)
    with pytest.raises(ConfigError) as error:
        parse_region(text)
    assert str(error.value).startswith(f"region {text!r}: ") and sentence in str(error.value)
    assert "; it should look like '" in str(error.value) and "\n" not in str(error.value)


def test_later_regions_are_painted_over_earlier_ones(painted):
    regions = [
        "box -1 -1 0 1 1 0.15 young_modulus=2e4 density=1100",
        "mask tumour.png cameras.json 1 young_modulus=5e4",
        "sphere 0 0 0.1 0.001 poisson_ratio=0.45",
    ]
    properties = paint_regions(SOFT, POINTS, regions)
    assert properties.young_modulus.tolist() == [2e4, 5e4, 2e4, 1e4]
    assert properties.poisson_ratio.tolist() == [0.45, 0.3, 0.3, 0.3]
    assert properties.density.tolist() == [1100, 1100, 1100, 1000]
    assert paint_regions(SOFT, POINTS, ()) is SOFT


def test_a_region_without_nodes_says_where_the_tissue_is():
    text = "sphere 0 0 120 8 young_modulus=5e4"  # millimetres
    with pytest.raises(ConfigError, match=f"region '{text}' contains none of the nodes, which lie between 0 0 0.1 and 0.02 0.02 0.2 "):
        paint_regions(SOFT, POINTS, [text])
    with pytest.raises(ConfigError, match=r"points have shape \(3, 3\), expected \(4, 3\)"):
        paint_regions(SOFT, POINTS[:3], [])
