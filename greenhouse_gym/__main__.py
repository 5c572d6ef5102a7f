"""``python -m greenhouse_gym`` is the command ``greenhouse-gym``."""

from greenhouse_gym.cli import main

main()
