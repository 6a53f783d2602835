"""`endo-sim demonstrate`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import Positional

from endo_sim_ros.core.config import ConfigError, unused_options
from endo_sim_ros.core.words import counted
from endo_sim_ros.learning.config import DemonstrationConfig, Randomisation, SightConfig, without_instrument
from endo_sim_ros.learning.person_config import MastersConfig, PersonConfig
from endo_sim_ros.physics.config import MotionConfig

if TYPE_CHECKING:
    from endo_sim_ros.learning.devices import FoundDevice


@dataclass(frozen=True)
class Command:
    """Let a script, or a person, solve a task many times, and write it as a LeRobot dataset; called again, continue it.

    A person sees the endoscope's picture in a page in the browser, and acts by mouse and keys, a gamepad, a 3D mouse, the controllers of
    OpenXR or masters that speak CRTK, as the options under page say.
    """

    task: Positional[str]
    """Name of the task, such as retraction or palpation; an unknown one is answered with the list."""
    out: Positional[Path]
    """Folder of the dataset. Finished rounds of episodes stay in it when the command is interrupted."""
    scenes: tuple[str, ...] = ("phantom:0",)
    """Synthetic patients, phantom:SEED, or PLY models with their cameras.json, which episodes take in turn."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""
    config: Annotated[DemonstrationConfig, tyro.conf.arg(name="")] = field(default_factory=DemonstrationConfig)
    sight: Annotated[SightConfig, tyro.conf.arg(name="")] = field(default_factory=lambda: SightConfig(image_width=128))
    vary: Randomisation = field(default_factory=Randomisation)
    motion: MotionConfig = field(default_factory=MotionConfig)
    page: PersonConfig = field(default_factory=PersonConfig)

    def run(self) -> None:
        """Write the dataset; raises SequenceError if the folder has other data, ValueError if options cannot be used."""
        for text in (*unused_options(self.config), *without_instrument(self.sight, self.vary)):
            raise ConfigError(text)
        if self.sight.eyes == 1 and self.sight.baseline != SightConfig.baseline:
            raise ConfigError("baseline has no effect while eyes is 1; set eyes to 2")
        if self.config.by == "person":
            self._by_person()
            return
        if self.page != PersonConfig():
            raise ConfigError("page: there is none while by is script; set by to person")
        from endo_sim_ros.learning.demonstrations import demonstrate

        episodes, tried = demonstrate(self.task, self.scenes, self.out, self.config, self.sight, self.vary, self.motion, self.device)
        print(f"{self.out}: {counted(episodes, 'solved episode')}; {tried} tried now")

    def _by_person(self) -> None:
        from endo_sim_ros.learning.by_person import demonstrate_by_person
        from endo_sim_ros.learning.demonstrations import Demonstrations
        from endo_sim_ros.learning.devices import find_devices
        from endo_sim_ros.viewer.demonstration_page import DemonstrationPage

        for text in self.page.without_effect():
            raise ConfigError(f"page: {text}")
        demonstrations = Demonstrations(self.task, self.scenes, self.out, 1, self.config, self.sight, self.vary, self.motion, self.device)
        found = [*find_devices(self.page), *_masters(self.page.masters)]
        try:
            page = DemonstrationPage(self.page)
            heard = f" heard as well: {', '.join(map(str, found))};" if found else ""
            print(f"open {page.url} in a browser;{heard} Ctrl-C ends", flush=True)
            try:
                episodes = demonstrate_by_person(demonstrations, page, [page, *found], self.page)
            finally:
                page.stop()
        finally:
            for device in found:
                device.close()
        print(f"{self.out}: {counted(episodes, 'solved episode')}")


def _masters(config: MastersConfig) -> "Sequence[FoundDevice]":
    """Those that are named, which alone need ROS."""
    if not config.names:
        return ()
    try:
        from endo_sim_ros.graph.masters import find_masters
    except ImportError as error:
        raise ConfigError(f"page.masters needs rclpy ({error}); source /opt/ros/jazzy/setup.sh, or pip install endo_sim_ros") from error
    return find_masters(config)
