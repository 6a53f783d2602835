"""A Gaussian model that follows its control nodes, seen by a camera."""

from typing import TYPE_CHECKING

from endo_sim_ros.core.lazy import lazy_names

if TYPE_CHECKING:
    from endo_sim_ros.rendering.config import RenderingConfig as RenderingConfig
    from endo_sim_ros.rendering.renderer import (
        DeformableRenderer as DeformableRenderer,
        View as View,
        bared_colors as bared_colors,
        middle_depth as middle_depth,
        render_depth as render_depth,
        turned_colors as turned_colors,
    )

__getattr__ = lazy_names(__name__, __file__)
