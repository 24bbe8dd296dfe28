"""Bags of ROS 1, ROS 2 and MCAP: topics, messages, and images and clouds of them."""
