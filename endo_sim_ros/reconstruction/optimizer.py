"""The tensors of a model that are optimised, and Adam with a rate for each, nothing of whose step waits for a GPU: it can be captured."""

import torch
from torch import Tensor
from torch.optim.adam import adam

from endo_sim_ros.core.gaussians import GaussianModel

PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh_base", "sh_rest", "gloss")
"""Names of the tensors that are optimised, as `LearningRatesConfig` has them."""


def parameters_of(model: GaussianModel) -> dict[str, Tensor]:
    """The tensors of a model that are optimised, by name; none that are empty."""
    tensors = model.tensors() | {"sh_base": model.sh[:, :1], "sh_rest": model.sh[:, 1:]}
    return {name: tensors[name] for name in PARAMETERS if name in tensors and tensors[name].numel()}


def model_of(parameters: dict[str, Tensor]) -> GaussianModel:
    """The model made of such tensors; gradients flow through it."""
    p = parameters
    sh = torch.cat([p["sh_base"], p["sh_rest"]], 1) if "sh_rest" in p else p["sh_base"]
    return GaussianModel(p["means"], p["quats"], p["log_scales"], p["logit_opacities"], sh, gloss=p.get("gloss"))


class Adam:
    """Adam (Kingma and Ba 2015), β = (0.9, 0.999), ε = 1e-15.

    `torch.optim.Adam` is the same, but loads torch's compiler, which takes a second.

    Args:
        parameters: What to optimise, by name, of one device.
        rates: Of each of them, the learning rate.
    """

    def __init__(self, parameters: dict[str, Tensor], rates: dict[str, float]) -> None:
        self.parameters = parameters
        # Where a GPU finds them, a captured step reads what they are by then.
        self.rates = {name: x.new_tensor(rates[name]) if x.is_cuda else rates[name] for name, x in parameters.items()}
        self.state = {
            name: {"step": x.new_zeros(()), "exp_avg": torch.zeros_like(x), "exp_avg_sq": torch.zeros_like(x)}
            for name, x in parameters.items()
        }

    def set_rate(self, name: str, rate: float) -> None:
        """Change the rate of a tensor."""
        held = self.rates[name]
        if isinstance(held, Tensor):
            held.fill_(rate)
        else:
            self.rates[name] = rate

    @torch.no_grad()
    def step(self, gradients: dict[str, Tensor]) -> None:
        """Move each tensor that has a gradient [of its shape]."""
        for name, gradient in gradients.items():
            state = self.state[name]
            adam(
                [self.parameters[name].detach()], [gradient.contiguous()], [state["exp_avg"]], [state["exp_avg_sq"]], [], [state["step"]],
                fused=True, capturable=gradient.is_cuda, amsgrad=False, maximize=False, weight_decay=0.0,
                lr=self.rates[name], beta1=0.9, beta2=0.999, eps=1e-15,
            )  # fmt: skip
