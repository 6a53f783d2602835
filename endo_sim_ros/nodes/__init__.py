"""The ROS nodes, a file each: topics and parameters in, library calls, topics and /diagnostics out."""
