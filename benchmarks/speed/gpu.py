"""Test and time the Warp environment on a GPU: equivalence with MuJoCo, steps per second, and PPO.

python -m benchmarks.speed.gpu pack FOLDER          # anywhere: recorded episodes and banks without the true rows
python -m benchmarks.speed.gpu run FOLDER OUT       # on the GPU; takes 10 minutes

``pack`` plays episodes in MuJoCo and records actions, observations and outcomes; with ``--composed 1600`` it also
composes training scenes, which takes about half an hour, and ``run`` trains on them as well. ``run`` plays the episodes
on the GPU, times random actions and a policy as CUDA graphs for several numbers of simulations, trains policies, and
evaluates them on the device. It prints each result and writes OUT/gpu.json and the policies. With ``--device cpu`` it
runs without a GPU, in small.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

EPISODES, STEPS, SCENES = 256, 120, 24
"""Recorded episodes, their steps, and the number of scenes they take place in."""

SIZES = (4096, 16_384, 65_536)
"""Numbers of simulations."""

JOINT, TIP = {"action": "joint"}, {"action": "tip_velocity"}
LARGE: dict[str, Any] = {"hidden": (512, 512, 512), "epochs": 2}
COMPOSED = "composed"
"""Folder of the composed scenes."""

TRAININGS: dict[str, tuple[float, dict[str, Any]]] = {
    **{f"2x256, joint actions, seed {seed}": (55.0, JOINT | {"seed": seed}) for seed in range(3)},
    "3x512, joint actions, seed 0": (84.0, LARGE | JOINT),
    "3x512, tip actions, seed 0": (84.0, LARGE | TIP),
    "3x512, tip actions, composed scenes, seed 0": (84.0, LARGE | TIP | {"bank": COMPOSED}),
}
"""Seconds and settings of the trainings; those on composed scenes need ``pack --composed``."""


def pack(folder: Path, composed: int) -> None:
    """Write a bank without true rows, a number of composed scenes, and recorded episodes."""
    from greenhouse_gym.envs import GreenhouseVectorEnv
    from greenhouse_gym.planning import ComposedBank
    from greenhouse_gym.scene import SceneBank

    if composed:
        ComposedBank("default", composed, targets=12).write(folder / COMPOSED)

    bank = SceneBank.open("default")
    copy_bank(bank, folder / "bank")
    rng = np.random.default_rng(0)
    names = [str(name) for name in rng.permutation(bank.names("train"))]
    options: list[dict[str, Any]] = []
    for name in names:
        targets = [t for t in bank.scene(name).targets if t.robot == "ur5e" and t.witness]
        if targets and len(options) < EPISODES:
            chosen = rng.choice(len(targets), -(-EPISODES // SCENES))
            options += [{"scene": name, "target": targets[k].tomato} for k in chosen]
    options = options[:EPISODES]
    ends = [
        next(t.witness[-1] for t in bank.scene(o["scene"]).targets if t.tomato == o["target"] and t.robot == "ur5e")
        for o in options
    ]
    env = GreenhouseVectorEnv(len(options), bank=folder / "bank", action="joint", threads=1)
    first, _ = env.reset(options=options)
    alive, hold = np.ones(len(options), dtype=bool), rng.uniform(-1, 1, (len(options), 6))
    actions, observations, rewards = [], [first], []
    outcome, ended_at = np.zeros(len(options), dtype=np.int8), np.full(len(options), STEPS)
    for step in range(STEPS):
        action = rng.uniform(-1, 1, hold.shape)
        renewed = rng.random(len(hold)) < 0.1
        hold[renewed] = action[renewed]
        action[1::3] = hold[1::3]
        action[2::3] = np.clip((np.array(ends) - env.simulation.command)[2::3] / 0.08, -1, 1)
        action = action.astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        actions.append(action)
        observations.append(observation)
        rewards.append(reward)
        over = alive & (terminated | truncated)
        outcome[over] = np.where(info["is_success"][over], 1, 2)
        ended_at[over] = step
        alive &= ~over
    np.savez_compressed(
        folder / "episodes.npz", options=json.dumps(options), actions=np.array(actions), outcome=outcome,
        ended_at=ended_at, observations=np.array(observations)[:61], rewards=np.array(rewards)[:60],
    )  # fmt: skip
    print(f"{len(options)} episodes: {np.bincount(outcome, minlength=3).tolist()} unfinished, successes, collisions")


def copy_bank(bank: Any, folder: Path) -> None:
    """Copy a bank without true rows and occupancy grids, which the kernels do not read."""
    folder.mkdir(parents=True, exist_ok=True)
    manifest = json.loads((bank.path / "manifest.json").read_text())
    for entry in manifest["scenes"]:
        scene = json.loads((bank.path / entry["file"]).read_text())
        content = json.dumps({key: value for key, value in scene.items() if key not in ("truth", "occupancy")})
        (folder / entry["file"]).write_text(content)
        entry.update(sha256=hashlib.sha256(content.encode()).hexdigest(), truth=None)
    (folder / "manifest.json").write_text(json.dumps(manifest))


class Run:
    """Results of the script, printed and written as they come.

    Args:
        folder: What `pack` wrote.
        out: Folder for the results.
        device: "cuda" or "cpu".
    """

    def __init__(self, folder: Path, out: Path, device: str):
        import torch

        self.torch, self.folder, self.out, self.device, self.began = torch, folder, out, device, time.monotonic()
        self.results: dict[str, Any] = {}
        out.mkdir(parents=True, exist_ok=True)
        torch.set_float32_matmul_precision("high")
        self.note("device", torch.cuda.get_device_name(0) if device == "cuda" else "cpu")

    def note(self, name: str, result: Any) -> None:
        """Print and write a result."""
        self.results[name] = result
        print(f"{time.monotonic() - self.began:.0f} s, {name}: {json.dumps(result)}", flush=True)
        (self.out / "gpu.json").write_text(json.dumps(self.results, indent=1) + "\n")

    def env(self, count: int, **settings: Any) -> Any:
        """Return an environment that returns tensors."""
        import gymnasium

        import greenhouse_gym  # noqa: F401  registers the environments

        return gymnasium.make_vec(
            "TomatoReach-v0", num_envs=count, backend="warp", device=self.device, arrays="torch",
            **{"bank": str(self.folder / "bank")} | JOINT | settings,
        )  # fmt: skip

    def synchronize(self) -> None:
        """Wait for the device."""
        if self.device == "cuda":
            self.torch.cuda.synchronize()

    def equivalence(self) -> None:
        """Play the recorded episodes."""
        from greenhouse_gym.envs.features import feature_slices

        torch, recorded = self.torch, np.load(self.folder / "episodes.npz")
        began = time.monotonic()
        options = json.loads(str(recorded["options"]))
        env = self.env(len(options))
        observation, _ = env.reset(options=options)
        self.columns = feature_slices(env.unwrapped.simulation.observe.layout)
        self.note("make and reset, kernels not cached", {"seconds": round(time.monotonic() - began, 1)})
        outcome, ended_at = np.zeros(len(options), dtype=np.int8), np.full(len(options), STEPS)
        alive, rewards, deviation = np.ones(len(options), dtype=bool), [], []
        for step, action in enumerate(recorded["actions"]):
            deviation.append(self._deviation(observation, recorded, step, alive & (recorded["ended_at"] >= step)))
            observation, reward, terminated, truncated, info = env.step(torch.from_numpy(action).to(observation.device))
            over = alive & (terminated | truncated).cpu().numpy()
            outcome[over] = np.where(info["is_success"].cpu().numpy()[over], 1, 2)
            ended_at[over] = step
            if step < len(recorded["rewards"]) and alive.any():
                rewards.append(float(np.abs(reward.cpu().numpy() - recorded["rewards"][step])[alive & ~over].max()))
            alive &= ~over
        same = outcome == recorded["outcome"]
        self.note(
            "equivalence", {
                "episodes": len(options), "same outcome": int(same.sum()),
                "same step": int((same & (ended_at == recorded["ended_at"])).sum()),
                "max joint deviation, rad": max(d[0] for d in deviation),
                "max clearance deviation, m": max(d[1] for d in deviation), "max reward deviation": max(rewards),
            },
        )  # fmt: skip
        env.close()

    def _deviation(self, observation: Any, recorded: Any, step: int, rows: Any) -> tuple[float, float]:
        if step >= len(recorded["observations"]) or not rows.any():
            return 0.0, 0.0
        difference = np.abs(observation.cpu().numpy() - recorded["observations"][step])[rows]
        joints, clearances = (difference[:, self.columns[name]] for name in ("joint_position", "clearance"))
        return float(joints.max()), float(clearances.max())

    def table(self, sizes: tuple[int, ...]) -> None:
        """Time random actions and a policy for several numbers of simulations."""
        torch = self.torch
        for count in sizes:
            env = self.env(count)
            observation, _ = env.reset(seed=0)
            action = torch.zeros(env.action_space.shape, device=observation.device)
            layers = [torch.nn.Linear(observation.shape[1], 256), torch.nn.ReLU(), torch.nn.Linear(256, 256)]
            policy = torch.nn.Sequential(*layers, torch.nn.ReLU(), torch.nn.Linear(256, 6)).to(observation.device)

            def act_randomly(env: Any = env, action: Any = action) -> None:
                env.step(action.uniform_(-1, 1))

            @torch.no_grad()  # type: ignore[untyped-decorator]
            def act(env: Any = env, action: Any = action, policy: Any = policy, observation: Any = observation) -> None:
                env.step(action.copy_(policy(observation)).add_(torch.randn_like(action), alpha=0.5))

            for _ in range(100 if self.device == "cuda" else 5):  # into the middle of episodes
                act_randomly()
            row = {
                "eager, random actions": self._rate(act_randomly, count, 50),
                "random actions": self._rate(self._graph(act_randomly), count, 200),
                "policy of 2 x 256": self._rate(self._graph(act), count, 200),
            }
            if self.device == "cuda":
                free, total = torch.cuda.mem_get_info()
                row["GB in use"] = round((total - free) / 1e9, 2)
            self.note(f"steps per second, {count} simulations", row)
            env.close()
            del env, act, act_randomly, observation

    def _graph(self, function: Any) -> Any:
        if self.device != "cuda":
            return function
        torch = self.torch
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):
                function()
        torch.cuda.current_stream().wait_stream(stream)
        self.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            function()
        return graph.replay

    def _rate(self, function: Any, count: int, repeat: int) -> int:
        repeat = repeat if self.device == "cuda" else 5
        for _ in range(3):
            function()
        self.synchronize()
        began = time.monotonic()
        for _ in range(repeat):
            function()
        self.synchronize()
        return round(count * repeat / (time.monotonic() - began))

    def train(self, name: str, seconds: float, count: int, **settings: Any) -> None:
        """Train a policy for some seconds, and evaluate it on all splits."""
        from greenhouse_gym.agents.policy import Policy
        from greenhouse_gym.learning import DevicePpoSettings, train_ppo_on_device
        from greenhouse_gym.scene import SceneBank

        bank = str(self.folder / settings.pop("bank", "bank"))
        chosen = DevicePpoSettings(bank=bank, device=self.device, num_envs=count, total_steps=10**12, **settings)
        rows: list[Any] = []
        began = time.monotonic()
        folder = self.out / name.replace(", ", "-").replace(" ", "-")
        path = train_ppo_on_device(chosen, folder, time_limit=seconds, on_progress=rows.append)
        last = rows[-1]
        self.note(
            f"PPO {name}", {
                "simulations": count, "settings": settings, "steps": last["steps"], "seconds": last["seconds"],
                "steps per second": round(last["steps"] / last["seconds"]),
                "preparation, seconds": round(time.monotonic() - began - last["seconds"], 1),
                "success in training": last["success_rate"],
            },
        )  # fmt: skip
        policy = Policy.load(path)
        count, action = 2048 if self.device == "cuda" else 16, chosen.action
        for split in ("train", "validation", "test"):
            self.note(f"PPO {name}, {split}", self._evaluate(policy, count, split=split, action=action))
        tested = SceneBank.open(self.folder / "bank")
        for source, difficulty in product(("own", "helios"), ("easy", "medium", "hard")):
            where = {"bank": tested.select(source=source), "split": "test", "difficulty": difficulty, "action": action}
            self.note(f"PPO {name}, test, {source} {difficulty}", self._evaluate(policy, count, **where))

    def _evaluate(self, policy: Any, count: int, **settings: Any) -> dict[str, Any]:
        """Play one episode in each simulation with the policy's mean action."""
        from greenhouse_gym.envs.choices import step_limit_of

        torch = self.torch
        env = self.env(count, **settings)
        observation, _ = env.reset(seed=10_000)
        on = observation.device
        weights = [
            (torch.from_numpy(w).to(on), torch.from_numpy(b).to(on))
            for w, b in zip(policy.weights, policy.biases, strict=True)
        ]
        center, scale = torch.from_numpy(policy.center).to(on), torch.from_numpy(policy.scale).to(on)
        alive = torch.ones(count, dtype=torch.bool, device=on)
        success, collision = torch.zeros_like(alive), torch.zeros_like(alive)
        for _ in range(step_limit_of(env.unwrapped.settings)):
            x = (observation - center) / scale
            for weight, bias in weights[:-1]:
                x = torch.relu(x @ weight.T + bias)
            observation, _, terminated, truncated, info = env.step(x @ weights[-1][0].T + weights[-1][1])
            over = alive & (terminated | truncated)
            success |= over & info["is_success"]
            collision |= over & info["collision"]
            alive &= ~over
        env.close()
        return {
            "episodes": count,
            "success": float(success.float().mean()),
            "collision": float(collision.float().mean()),
        }


def main() -> None:
    """Pack or run."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("what", choices=("pack", "run"))
    command.add_argument("folder", type=Path)
    command.add_argument("out", type=Path, nargs="?", default=Path("runs/gpu"))
    command.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    command.add_argument("--composed", type=int, default=0, help="number of composed scenes to pack")
    command.add_argument("--speed-up", type=float, default=1.0, help="divide the time of each training by this")
    a = command.parse_args()
    if a.what == "pack":
        pack(a.folder, a.composed)
        return
    run = Run(a.folder, a.out, a.device)
    run.equivalence()
    run.table(SIZES if a.device == "cuda" else (256,))
    count = 16_384 if a.device == "cuda" else 64
    for name, (seconds, settings) in TRAININGS.items():
        if (a.folder / settings.get("bank", "")).is_dir():
            run.train(name, seconds / a.speed_up, count, **settings)


if __name__ == "__main__":
    main()
