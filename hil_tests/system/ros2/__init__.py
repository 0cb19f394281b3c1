"""Runs whose robot is a program of ROS 2 on another DDS."""
