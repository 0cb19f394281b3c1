"""The commands of `uwb-slam` that put sources, SLAM and views together."""
