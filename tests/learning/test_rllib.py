"""RLlib on the native vector environment; it pins an older Gymnasium, so `make test-rllib` runs this elsewhere."""

from __future__ import annotations

import pytest

pytest.importorskip("tree")  # of RLlib's own dependencies the one that no other of ours brings

from greenhouse_gym.scene import SceneBank


def test_rllib_trains_by_the_vector_entry_point(bank: SceneBank) -> None:
    from ray.rllib.algorithms.ppo import PPOConfig

    config = (
        PPOConfig()
        .environment("greenhouse_gym:TomatoReach-v0", env_config={"bank": str(bank.path)})
        .env_runners(
            num_env_runners=0,
            num_envs_per_env_runner=8,
            gym_env_vectorize_mode="vector_entry_point",
            rollout_fragment_length=16,
        )
        .training(train_batch_size_per_learner=128, minibatch_size=64, num_epochs=1)
    )
    algorithm = config.build_algo()
    try:
        result = algorithm.train()
    finally:
        algorithm.stop()
    assert result["num_env_steps_sampled_lifetime"] >= 128
