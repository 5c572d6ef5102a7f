"""Robot arms as MJCF files: `Robot`, the shipped arms made of primitives, and a tool for other arms."""

from greenhouse_gym.robots.load import ROBOTS, get_robot, load_robot
from greenhouse_gym.robots.rail import mount_on_rail
from greenhouse_gym.robots.robot import Robot
from greenhouse_gym.robots.tool import mount_tool

__all__ = ["ROBOTS", "Robot", "get_robot", "load_robot", "mount_on_rail", "mount_tool"]
