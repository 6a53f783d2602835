"""Nodes as processes that begin where all is imported: each takes 2.5 s of a core less than `python -m` does."""

import ctypes
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
from multiprocessing import forkserver
from unittest import mock

from endo_sim_ros.graph.processes import NodeGroup
from endo_sim_ros.nodes.process import PARENT

_CONTEXT = multiprocessing.get_context("forkserver")
# Not the server of all: who asks first for one has it import what he needs, and evaluations, which may come first, know no ROS.
_SERVER = forkserver.ForkServer()
_NODES = ("physics_node", "policy_node", "reconstruction_node", "recorder_node", "rendering_node", "bag_player_node")
_SERVER.set_forkserver_preload([f"endo_sim_ros.nodes.{name}" for name in _NODES])

HOST = "ENDO_SIM_TEST_HOST"  # environment variable: name of the network namespace that a node lives in


def _run(module, words, environment, log):
    """Become `python -m module words...`."""
    os.setsid()
    os.environ.clear()
    os.environ.update(environment | {PARENT: str(os.getppid())})  # that of all nodes, which ends with the tests
    if HOST in environment:
        with open(f"/run/netns/{environment[HOST]}") as host:
            if ctypes.CDLL(None, use_errno=True).setns(host.fileno(), 0):
                raise OSError(ctypes.get_errno(), f"cannot join {environment[HOST]}")
    with open(log, "ab") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    sys.modules.pop(module, None)
    sys.argv = [module, *words]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


class _Process:
    """What a group of nodes needs of a process."""

    def __init__(self, arguments, environment, output):
        _, _, module, *words = arguments
        self._process = _CONTEXT.Process(target=_run, args=(module, words, environment, output.name), daemon=True)
        with mock.patch.object(forkserver, "connect_to_new_process", _SERVER.connect_to_new_process):
            self._process.start()
        self.pid = self._process.pid

    def poll(self):
        return self._process.exitcode

    def wait(self, timeout=None):
        self._process.join(timeout)
        if self.poll() is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout)
        return self.poll()

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        self.send_signal(signal.SIGKILL)


class ForkedNodes(NodeGroup):
    """A group of nodes for tests of what they do; how they start and end is for those of `NodeGroup` itself."""

    def _launch(self, arguments, environment, output):
        return _Process(arguments, environment, output)
