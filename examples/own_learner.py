"""A policy of any library as an agent: a plain function here, and the place for a network of TorchRL or CleanRL."""

import numpy as np

from greenhouse_gym.evaluation import evaluate


class Learned:
    """Agent around a function from observations (n, size) to actions (n, joints)."""

    name = "learned"
    env_options = {"robot": "ur5e", "observation": "state", "action": "tip_velocity"}

    def __init__(self, network=lambda observations: np.tanh(observations[:, 24:30])):
        self.network = network  # CleanRL: lambda x: actor(torch.as_tensor(x)).detach().numpy(); TorchRL: the same

    def reset(self, problem): ...

    def act(self, observation):
        return self.network(observation[None])[0]

    def act_many(self, observations):
        return self.network(observations)


if __name__ == "__main__":
    result = evaluate(Learned(), split="validation", episodes=16, num_envs=16, bank="mini")
    print(f"{result.success_rate:.0%} reached, {result.collision_rate:.0%} collided, of {len(result.records)}")
