"""How Gaussians are added, moved and removed in training."""

from endo_sim_ros.reconstruction.strategies.base import Strategy
from endo_sim_ros.reconstruction.strategies.gradient import Gradient
from endo_sim_ros.reconstruction.strategies.mcmc import Mcmc
from endo_sim_ros.reconstruction.strategies.proximity import Proximity

STRATEGIES: dict[str, type[Strategy]] = {"mcmc": Mcmc, "gradient": Gradient, "proximity": Proximity}
"""By the value of `ReconstructionConfig.densification`, which is also the name of the nested options of each."""
