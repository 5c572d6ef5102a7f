"""Your own arm: mount the package's gripper on it, rate a bank for it, and train on that bank.

python examples/own_robot.py [ARM.xml]     such as an arm of MuJoCo Menagerie; by default the shipped iiwa 14
"""

import sys
import tempfile
from pathlib import Path

from greenhouse_gym.learning import PpoSettings, train_ppo
from greenhouse_gym.planning.rated_banks import rate_bank
from greenhouse_gym.robots import mount_tool

if __name__ == "__main__":
    folder = Path(tempfile.mkdtemp())
    arm = str(mount_tool(sys.argv[1], folder / "arm.xml")) if len(sys.argv) > 1 else "iiwa14"
    bank = rate_bank("mini", arm, folder / "bank", per_scene=1, on_progress=lambda done: print(f"{done} rated"))
    print({name: [target.difficulty for target in bank.scene(name).targets[-1:]] for name in bank.names()})
    train_ppo(PpoSettings(bank=str(bank.path), robot=arm, total_steps=128, num_envs=4, rollout_steps=8), folder)
