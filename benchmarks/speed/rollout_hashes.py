"""Print checksums of everything that random rollouts of the environment return, to prove that a change left them equal.

python -m benchmarks.speed.rollout_hashes --rename slowed=speed_limited --skip info.new

Compare the lines of before and after, one per variant and returned array (numbers only), on one machine.
"""

from __future__ import annotations

import argparse
import hashlib
from collections import defaultdict
from collections.abc import Iterator
from functools import partial
from typing import Any

import gymnasium
import numpy as np

import greenhouse_gym  # noqa: F401  (registers the environment)

VARIANTS: dict[str, tuple[int, int, dict[str, Any]]] = {  # name: simulations, steps in all, keywords
    "single": (1, 20_000, {"action": "joint"}),
    "vector": (16, 20_000, {"action": "joint"}),
    "goal": (16, 20_000, {"observation": "goal", "action": "joint", "reward": "sparse"}),
    "roadmap": (16, 20_000, {"observation": "roadmap", "action": "joint", "reward": "path"}),
    "tip-truth": (16, 20_000, {"action": "tip_velocity", "physics": "truth"}),
    "depth": (1, 1_000, {"observation": "depth", "action": "joint"}),
}
RETURNED = ("observation", "reward", "terminated", "truncated", "info")
REPEAT = 8  # steps in one direction move the arm far enough to touch plants, itself and its limits


def arrays(value: Any, key: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the numeric arrays of a nested dict with their dotted keys; masks of the vector environment are skipped."""
    if isinstance(value, dict):
        for name, part in value.items():
            if not name.startswith("_"):
                yield from arrays(part, f"{key}.{name}" if key else name)
    elif np.size(value) and np.asarray(value).dtype.kind in "biuf":
        yield key, np.ascontiguousarray(value)


def rollout(count: int, steps: int, options: dict[str, Any], bank: str) -> Iterator[dict[str, Any]]:
    """Yield what `reset` and each `step` return; every action is drawn uniformly and repeated for `REPEAT` steps."""
    rng = np.random.default_rng(0)
    make = gymnasium.make if count == 1 else partial(gymnasium.make_vec, num_envs=count)
    env: Any = make("TomatoReach-v0", bank=bank, **options)  # type: ignore[operator]
    yield dict(zip(("observation", "info"), env.reset(seed=0), strict=True))
    for step in range(steps // count):
        if step % REPEAT == 0:
            action = rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32)
        returned = dict(zip(RETURNED, env.step(action), strict=True))
        yield returned
        if count == 1 and (returned["terminated"] or returned["truncated"]):
            yield dict(zip(("observation", "info"), env.reset(), strict=True))
    env.close()


def main() -> None:
    """Play every variant and print its checksums, sorted by the renamed key."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("variants", nargs="*", help=f"any of {', '.join(VARIANTS)}; all by default")
    parser.add_argument("--bank", default="mini")
    parser.add_argument("--rename", action="append", default=[], metavar="OLD=NEW", help="print a key by another name")
    parser.add_argument("--skip", action="append", default=[], metavar="KEY", help="leave out, as printed")
    arguments = parser.parse_args()
    renamed = dict(pair.split("=") for pair in arguments.rename)
    for variant in arguments.variants or VARIANTS:
        hashes: defaultdict[str, Any] = defaultdict(hashlib.sha256)
        for returned in rollout(*VARIANTS[variant], arguments.bank):
            for key, array in arrays(returned, ""):
                hashes[".".join(renamed.get(part, part) for part in key.split("."))].update(array.tobytes())
        kept = {key: hashes[key].hexdigest() for key in sorted(hashes) if key not in arguments.skip}
        for key, digest in [*kept.items(), ("all", hashlib.sha256(repr(kept).encode()).hexdigest())]:
            print(f"{variant:10s} {key:32s} {digest}", flush=True)


if __name__ == "__main__":
    main()
