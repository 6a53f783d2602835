"""Depth priors of views compared with each other: which pixels show each piece of surface best, and its colour in all views."""

from typing import Any

import numpy as np
import torch

from endo_sim_ros.core.kernels import launch, launch_in_shares, load_kernels
from endo_sim_ros.reconstruction import surface_kernels
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import TrainingView


class Surfaces:
    """The depth priors of all views, to be compared with each other.

    Args:
        views: Views with a depth prior.
        device: Where to compare.
    """

    def __init__(self, views: list[TrainingView], device: str) -> None:
        tensor = lambda array, kind: torch.tensor(np.asarray(array), dtype=kind, device=device)
        self.views, self.device = views, device
        self._starts = np.cumsum([0, *(view.surface.size for view in views)])
        self._shared = [
            tensor([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]] for K in (view.camera.K for view in views)], torch.float32),
            tensor([[view.camera.width, view.camera.height] for view in views], torch.int32),
            tensor(self._starts[:-1], torch.int32),
            torch.from_numpy(np.concatenate([view.surface.reshape(-1) for view in views])).to(device),
        ]
        load_kernels((surface_kernels,), device)

    def _compare(self, kernel: Any, index: int, count: int, *arguments: Any) -> None:
        """Launch a kernel of `surface_kernels` over so many pixels of a view, with the arguments that are its own."""
        view, (cameras, sizes, starts, depths) = self.views[index], self._shared
        motions = torch.tensor(np.stack([other.camera.viewmat @ view.camera.pose for other in self.views]), dtype=torch.float32)
        shared = [index, view.camera.width, int(self._starts[index]), cameras, motions.to(self.device), sizes, starts, depths]
        if self.device == "cpu":
            launch_in_shares(kernel, count, [*shared, *arguments])
        else:
            launch(kernel, count, [0, *shared, *arguments], self.device)

    def chosen(self, tolerance: float, progress: StageProgress) -> list[np.ndarray]:
        """Which pixels [H, W] of each view to back-project, so that every piece of surface is there once.

        The view that sees a piece from nearest provides it. A pixel whose point floats in front of the surface that another
        view sees, by more than the relative tolerance, is contradicted and left out.
        """
        fineness = progress.map(lambda view: np.median(view.surface[view.surface > 0]) / view.camera.K[0, 0], self.views)
        factors = torch.full((len(self.views),), 1 - tolerance, device=self.device)
        chosen: list[np.ndarray] = [np.empty(0)] * len(self.views)
        for done, i in enumerate(np.argsort(fineness, kind="stable")):
            progress(done, 2 * len(self.views))
            view = self.views[i]
            kept = torch.from_numpy(((view.surface > 0) & (view.tissue > 0)).astype(np.uint8).reshape(-1)).to(self.device)
            self._compare(surface_kernels.uncontradicted, int(i), len(kept), factors, kept)
            chosen[i] = kept.cpu().numpy().reshape(view.surface.shape) > 0
            factors[i] = 1 + tolerance  # what this view shows well enough is there
        return chosen

    def mean_colors(self, taken: list[np.ndarray], tolerance: float, progress: StageProgress) -> list[np.ndarray]:
        """Colours [N, 3] in [0, 1] of the given pixels [H, W] of each view: the mean of those of all views that see their points.

        The light moves with the endoscope: colours of one view alone would show where the next view's piece begins.
        """
        images = torch.from_numpy(np.concatenate([view.image.reshape(-1, 3) for view in self.views])).to(self.device)
        found = []
        for i, pixels in enumerate(taken):
            progress(len(taken) + i, 2 * len(taken))
            index = torch.from_numpy(np.flatnonzero(pixels).astype(np.int32)).to(self.device)
            colors = torch.empty(len(index), 3, device=self.device)
            self._compare(surface_kernels.mean_colors, i, len(index), images, tolerance, index, colors)
            found.append(colors.cpu().numpy().astype(np.float64))
        return found
