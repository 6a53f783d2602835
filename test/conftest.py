"""Every test process has a graph of its own, on this machine only, and quiet kernels."""

import gc
import os
import shutil

# Set before anything starts ROS; processes that a test starts inherit it.
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
_worker = os.environ.get("PYTEST_XDIST_WORKER")
if _worker:  # each its own: counted from who started them, as numbers of processes may differ by a hundred, or by the fifty to a neighbour
    os.environ["ROS_DOMAIN_ID"] = str(1 + (os.getppid() + int(_worker.removeprefix("gw"))) % 100)
    # Workers fill the cores: a second thread of each kernel only costs its start. Tests of what threads must not change say how many.
    os.environ.setdefault("ENDO_SIM_THREADS", "1")
else:
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "DEFAULT")  # little memory: nodes that tests kill leave theirs behind
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # more tests at a time than cores: threads that wait would take these from others
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np  # noqa: E402
import pytest  # noqa: E402

from endo_sim_ros.nodes.transport import prepare_transport  # noqa: E402

prepare_transport()
gc.disable()  # until all tests are found: what is imported for them stays, and looking through it takes a third of the time


def pytest_collection_finish():
    """Called in each process that runs tests; the one that hands them out starts sooner without torch."""
    import torch

    torch.set_num_threads(1)
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def small_frames():
    """Twelve small views of a synthetic patient with stereo, depth and mask."""
    from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

    return list(phantom_sequence(PhantomConfig(frames=12, width=96, height=80, border=0.05)))


@pytest.fixture(scope="session")
def small_bag(small_frames, tmp_path_factory):
    """The same as a bag."""
    from endo_sim_ros.sequences.bag import write_bag

    path = tmp_path_factory.mktemp("bags") / "small"
    write_bag(path, small_frames)
    return path


@pytest.fixture(scope="session")
def joint_policy(tmp_path_factory):
    """File of a policy that acts by joints, and leaves them where they are; beside it two_arms.npz, which does so with two arms."""
    from endo_sim_ros.learning.policies import NetworkPolicy

    path = tmp_path_factory.mktemp("policies") / "by_joints.npz"
    for task, file in (("retraction", path), ("tension", path.with_name("two_arms.npz"))):
        (size,) = NetworkPolicy.sizes(task, [], "joints")
        NetworkPolicy(task, [np.zeros(size)], "joints").save(file)
    return path


@pytest.fixture(scope="module")  # playwright keeps an event loop running
def chromium():
    """Headless Chromium with software rendering."""
    api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    arguments = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with api.sync_playwright() as playwright:
        found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
        try:
            browser = playwright.chromium.launch(executable_path=found, args=arguments)
        except api.Error as error:
            pytest.skip(f"needs Chromium: {str(error).splitlines()[0]}")
        yield browser
        browser.close()
