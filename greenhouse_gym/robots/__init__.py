"""Robot arms as MJCF files made of primitives, and the `Robot` that describes one."""

from greenhouse_gym.robots.robot import ROBOTS, Robot, get_robot, load_robot

__all__ = ["ROBOTS", "Robot", "get_robot", "load_robot"]
