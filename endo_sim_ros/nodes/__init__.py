"""The ROS nodes, a file each: topics and parameters in, library calls, topics and /diagnostics out."""

import gc
import sys

if sys.argv[0] == "-m":  # what Python calls a module that it is about to run: until a node spins, what is imported stays
    gc.disable()  # looking for garbage in it takes a quarter of the time that a node needs to start
