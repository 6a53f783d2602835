"""Triangulated points."""

import cv2
import numpy as np
from short_training import bare

from endo_sim_ros.reconstruction.triangulation import triangulate


def test_triangulated_points_lie_on_the_surface(large):
    points, colors, error = triangulate(list(large))
    assert len(points) > 300
    assert colors.shape == points.shape
    assert 0 <= colors.min() <= colors.max() <= 1
    off = []
    for frame in large:
        uv, z = frame.camera.project(points)
        u, v = np.floor(uv).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < 640) & (v < 512)
        off.append(np.full(len(points), np.inf))
        off[-1][inside] = np.abs(z[inside] / frame.depth[v[inside], u[inside]] - 1)
    off = np.min(off, 0)
    assert np.median(off) < 0.01
    coarse = error > np.median(error)
    assert np.median(off[coarse]) > np.median(off[~coarse])  # rays that meet at a small angle tell less


def test_views_from_one_place_give_no_points(large):
    first = large[0]
    assert len(triangulate([first, first])[0]) == 0
    turned = first.camera.pose.copy()
    turned[:3, :3] = turned[:3, :3] @ cv2.Rodrigues(np.array([0.0, 0.05, 0.0]))[0]
    H = first.camera.K @ turned[:3, :3].T @ first.camera.pose[:3, :3] @ np.linalg.inv(first.camera.K)
    image = cv2.warpPerspective(first.image, H, (640, 512))
    rotated = bare(first, image=image, camera=first.camera.at(turned))
    assert len(triangulate([first, rotated])[0]) == 0
