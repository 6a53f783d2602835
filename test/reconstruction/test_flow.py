"""Dense optical flow by kernels, as GPUs have it."""

import cv2
import numpy as np
import pytest
import torch

from endo_sim_ros.reconstruction.priors.flow import dense_flow

HEIGHT, WIDTH = 96, 128


@pytest.fixture(scope="module")
def moved():
    """A picture, another one that shows the same elsewhere, and by how many pixels [H, W, 2]."""
    random = np.random.default_rng(0)
    picture = cv2.GaussianBlur(random.normal(0, 1, (HEIGHT, WIDTH)).astype(np.float32), (0, 0), 2)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    flow = np.stack([5 + 0.5 * np.sin(rows / 15), -3 + 0.5 * np.cos(columns / 20)], -1)
    here = there = np.stack([columns, rows], -1)
    for _ in range(20):  # where a pixel of the other picture comes from
        there = here - cv2.remap(flow, *cv2.split(there), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    other = cv2.remap(picture, *cv2.split(there), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return torch.from_numpy(picture), torch.from_numpy(other), flow


def error(found, flow, margin=12):
    inside = np.s_[margin:-margin, margin:-margin]
    return np.linalg.norm(found.cpu().numpy() - flow, axis=-1)[inside]


@pytest.mark.parametrize("finest, off", [(0, 0.05), (1, 0.2)])
def test_it_finds_where_a_picture_has_gone_to_a_twentieth_of_a_pixel(moved, finest, off):
    picture, other, flow = moved
    assert np.median(error(dense_flow(picture, other, finest), flow)) < off


def test_another_brightness_changes_little(moved):
    picture, other, flow = moved
    assert np.median(error(dense_flow(picture, other + 20), flow)) < 0.06


def test_where_there_is_nothing_to_see_nothing_moves():
    flat = torch.full((HEIGHT, WIDTH), 90.0)
    assert not dense_flow(flat, flat + 3).any()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_a_gpu_finds_the_same(moved):
    picture, other, _ = moved
    on_gpu = dense_flow(picture.cuda(), other.cuda()).cpu()
    assert torch.quantile((on_gpu - dense_flow(picture, other)).abs().flatten(), 0.99) < 1e-2
