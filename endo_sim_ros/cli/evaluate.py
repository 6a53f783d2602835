"""`endo-sim evaluate`."""

from dataclasses import dataclass, field
from typing import Annotated

import tyro
from tyro.conf import Positional

from endo_sim_ros.evaluation.config import EvaluationConfig


@dataclass(frozen=True)
class Command:
    """Train methods on few views of sequences, measure each on the views held out, and compare, beside the paper's figures."""

    sequences: Annotated[Positional[tuple[str, ...]], tyro.conf.arg(metavar="SEQ [SEQ ...]")]
    """Bags, recordings as for convert, or phantom:0 (synthetic patients); options of the reader follow as ,name=value:
    phantom:1,frames=100 my_bag,step=2 video.mp4,fx=907."""
    config: Annotated[EvaluationConfig, tyro.conf.arg(name="")] = field(default_factory=EvaluationConfig)

    def run(self) -> None:
        """Run the evaluation; raises RuntimeError at the end if a cell failed."""
        from endo_sim_ros.core.folders import claimed, leaving_none_empty
        from endo_sim_ros.core.words import counted
        from endo_sim_ros.evaluation.evaluate import evaluate

        made = (self.config.out / name for name in ("cells", "pictures", "strips", "plots"))
        with leaving_none_empty(*made), claimed(self.config.out):
            cells = evaluate(self.sequences, self.config)["cells"]
        written = ("table.md", "table.csv", "results.json", "views.csv", "strips/", "plots/")
        print(f"{self.config.out}: " + ", ".join(name for name in written if (self.config.out / name).exists()))
        failed = sum(cell["error"] is not None for cell in cells)
        if failed:
            what = f"{failed} of {counted(len(cells), 'cell')} failed, why is told above"
            raise RuntimeError(f"{what}; with that mended, the same command does those alone")
