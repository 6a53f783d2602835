"""Image and depth measures against torchmetrics, the authors' values and by hand."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from endo_sim_ros.evaluation import metrics
from endo_sim_ros.evaluation.lpips import Lpips, WeightsError

SHARED = Path(__file__).parents[3] / "shared/data"


@pytest.fixture
def pair():
    """Two alike RGB images [41, 57, 3] uint8."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(0, 6, 57), np.linspace(0, 5, 41))
    clean = 120 + 80 * np.stack([np.sin(x + y), np.cos(2 * x), np.sin(x * y)], -1)
    return tuple((clean + rng.normal(0, 12, clean.shape)).clip(0, 255).astype(np.uint8) for _ in range(2))


def planes(image):
    return torch.from_numpy(image).permute(2, 0, 1)[None].double() / 255


def test_psnr_is_that_of_torchmetrics(pair):
    expected = peak_signal_noise_ratio(planes(pair[0]), planes(pair[1]), data_range=1.0)
    assert metrics.psnr(*pair) == pytest.approx(float(expected), abs=1e-4)


def test_ssim_is_that_of_torchmetrics(pair):
    expected = structural_similarity_index_measure(planes(pair[0]), planes(pair[1]), data_range=1.0, sigma=1.5)
    assert metrics.ssim(*pair) == pytest.approx(float(expected), abs=1e-4)


def test_equal_images_score_best(pair):
    assert metrics.psnr(pair[0], pair[0]) > 100
    assert metrics.ssim(pair[0], pair[0]) == pytest.approx(1)


def test_masked_pixels_do_not_count(pair):
    image, reference = (x.copy() for x in pair)
    mask = np.full(image.shape[:2], 255, np.uint8)
    mask[:, 20:] = 0
    before = metrics.psnr(image, reference, mask), metrics.ssim(image, reference, mask)
    image[:, 20:] = 0  # also within the window of pixels that count
    assert metrics.psnr(image, reference, mask) == before[0]
    assert metrics.ssim(image, reference, mask) == pytest.approx(before[1], abs=1e-12)
    inside = metrics.psnr(image[:, :20], reference[:, :20])
    assert metrics.psnr(image, reference, mask) == pytest.approx(inside)


def test_ssim_of_an_empty_mask_is_nan(pair):
    assert np.isnan(metrics.ssim(*pair, np.zeros(pair[0].shape[:2], np.uint8)))


def test_gain_fit_undoes_an_exposure_per_channel(pair):
    reference = pair[0].astype(np.float64)
    darker = reference * [0.5, 0.8, 0.9]
    np.testing.assert_allclose(metrics.gain_fitted(darker, reference), reference, atol=1e-9)


def test_depth_rmse_counts_pixels_that_have_both_depths():
    depth, reference = np.full((2, 2), 0.1, np.float32), np.float32([[0.103, 0.0], [0.096, 0.2]])
    mask = np.uint8([[255, 255], [255, 0]])
    assert metrics.depth_rmse(depth, reference, mask) == pytest.approx(np.sqrt((0.003**2 + 0.004**2) / 2), rel=1e-5)
    assert np.isnan(metrics.depth_rmse(depth, np.zeros_like(depth)))


def test_depth_at_points_is_the_usual_difference_where_there_is_depth():
    depth = np.zeros((4, 4), np.float32)
    depth[1, 2], depth[3, 0], depth[0, 3], depth[2, 2] = 0.1, 0.2, 0.3, 0.4
    uv, z = np.array([[2.7, 1.2], [0.5, 3.5], [3.1, 0.0], [2.0, 2.0], [1.0, 1.0]]), np.array([0.101, 0.203, 0.9, 0.5, 0.7])
    assert metrics.depth_at_points(depth, uv[:3], z[:3]) == pytest.approx(0.003, rel=1e-4)  # of 1, 3 and 600 mm
    assert metrics.depth_at_points(depth, uv, z, np.uint8(depth < 0.3)) == pytest.approx(0.002, rel=1e-4)
    assert np.isnan(metrics.depth_at_points(depth, uv[4:], z[4:]))


def test_median_scaling_leaves_the_shape_of_the_error():
    reference = np.float32([[0.10, 0.12, 0.0], [0.14, 0.16, 0.2]])
    depth = np.where(reference > 0, 3 * reference, 5)
    np.testing.assert_allclose(metrics.median_scaled(depth, reference)[reference > 0], reference[reference > 0], rtol=1e-6)
    assert metrics.depth_rmse(metrics.median_scaled(depth, reference), reference) == pytest.approx(0, abs=1e-6)


def test_psnr_of_an_empty_mask_is_nan(pair):
    assert np.isnan(metrics.psnr(*pair, np.zeros(pair[0].shape[:2], np.uint8)))


weights = pytest.mark.skipif(not (SHARED / "weights").is_dir(), reason="the weights of LPIPS are not at ../shared/data/weights")


@pytest.mark.slow
@weights
@pytest.mark.parametrize("backbone, expected", [("alex", (0.722, 0.138)), ("vgg", (0.569, 0.422))])
def test_lpips_is_that_of_its_authors(backbone, expected):
    images = [cv2.imread(str(SHARED / f"lpips_images/ex_{name}.png"))[..., ::-1] for name in ("ref", "p0", "p1")]
    network = Lpips(backbone, SHARED / "weights")
    assert [network(images[0], other)[0] for other in images[1:]] == pytest.approx(expected, abs=6e-4)
    assert network(images[0], images[0]) == (0.0,)


@weights
def test_lpips_over_masks(pair):
    network = Lpips("alex", SHARED / "weights")
    everything, nothing, left = (np.full(pair[0].shape[:2], value, np.uint8) for value in (255, 0, 0))
    left[:, :20] = 255
    whole, same, part, none = network(*pair, None, everything, left, nothing)
    assert whole == same == network(*pair)[0]
    assert part > 0 and part != whole
    assert np.isnan(none)
    changed = pair[0].copy()
    changed[:, 20:] = 0
    assert network(changed, pair[1], left) == network(*pair, left)  # what the first mask leaves out does not count
    assert np.isnan(network(pair[0][:20, :20], pair[1][:20, :20])[0])  # too small for its last layer


def test_weights_that_are_missing_or_damaged_are_named(tmp_path):
    with pytest.raises(WeightsError, match=rf"no vgg16\*.pth \(torchvision's\) in {tmp_path}"):
        Lpips("vgg", tmp_path)
    (tmp_path / "alexnet.pth").write_bytes(b"no weights")
    with pytest.raises(WeightsError, match="alexnet.pth: not readable weights"):
        Lpips("alex", tmp_path)
    torch.save({"features.0.weight": torch.zeros(1)}, tmp_path / "alexnet.pth")
    with pytest.raises(WeightsError, match="no weights of LPIPS alex, '0.bias' is not in them"):
        Lpips("alex", tmp_path)
