"""The headers of this folder, with the numbers that Python shares with them."""

import warp as wp

from endo_sim_ros.core.native import LANE_COUNT, native
from endo_sim_ros.splatting import constants

_SHARED = (
    "ALPHA_MAX", "ALPHA_MIN", "EXTRAS", "LOG_ALPHA_SLACK", "MEDIAN", "PIXEL_SLACK", "RECORD_SIZE", "SPLAT_SIZE", "TILE", "TRANSMITTANCE_MIN"
)  # fmt: skip


def headers(name: str) -> wp.ModuleBuildOptions:
    """Return `native` of a header of ``native/``."""
    return native(f"splatting/native/{name}", LANE_COUNT=LANE_COUNT, **{constant: getattr(constants, constant) for constant in _SHARED})
