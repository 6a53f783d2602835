"""What starts, watches and stops the ROS nodes, each a process of its own."""
