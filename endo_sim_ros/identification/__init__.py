"""What tissue is made of, estimated from how it answers a tool."""

from typing import TYPE_CHECKING

from endo_sim_ros.core.lazy import lazy_names

if TYPE_CHECKING:
    from endo_sim_ros.identification.checks import IdentificationError as IdentificationError
    from endo_sim_ros.identification.config import IdentificationConfig as IdentificationConfig
    from endo_sim_ros.identification.estimate import (
        Estimate as Estimate,
        Identification as Identification,
        excess_force as excess_force,
        identify as identify,
    )
    from endo_sim_ros.identification.experiment import Experiment as Experiment, Tracks as Tracks
    from endo_sim_ros.identification.maps import Inclusion as Inclusion, find_inclusion as find_inclusion

__getattr__ = lazy_names(__name__, __file__)
