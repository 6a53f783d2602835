"""`endo-sim compress`."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class Command:
    """Write a model in SuperSplat's compressed layout, a quarter of the size; every command reads either."""

    model: Positional[Path]
    """PLY model, compressed or not."""
    out: Positional[Path]
    """File to write; a name that ends in .compressed.ply makes it compressed, any other .ply whole again."""

    def run(self) -> None:
        """Write the model in the layout that the name of the file asks for; raises ModelError for another name."""
        from endo_sim_ros.core.gaussians import ModelError, load_ply, save_ply

        if self.out.suffix != ".ply":
            raise ModelError(f"{self.out}: models are written as .compressed.ply or .ply; give such a name")
        model, before = load_ply(self.model), self.model.stat().st_size  # the two files may be one
        save_ply(model, self.out)
        print(f"{self.out}: {len(model)} Gaussians, {self.out.stat().st_size / 1e6:.1f} MB, was {before / 1e6:.1f} MB")
