"""Count hard targets that a learned policy reaches and a sampled plan does not, and the other way round.

python -m benchmarks.agents.hard_targets

RRTConnect gets a single run of 10,000 collision checks and takes unknown space for free; ratings call targets hard for
which it usually needs more than 5,000. Hard targets of the test rows as scanned, 500 episodes with seeds from 20,000,
from the start `ready`. Takes ten minutes.
"""

from __future__ import annotations

from dataclasses import asdict

from benchmarks.agents.cells import SEED
from benchmarks.common import RESULTS, parser, rate, write_entry
from greenhouse_gym.agents import PlannerAgent, ShieldedAgent, load_policy
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.evaluation.records import pairing
from greenhouse_gym.scene import SceneBank

CHECKS = 10_000


def main() -> None:
    """Play the episodes with both kinds of agents, and pair them."""
    command = parser(__doc__)
    command.add_argument("--policy", default="ppo-warp-ur5e")
    command.add_argument("--episodes", type=int, default=500)
    a = command.parse_args()
    world = {"difficulty": "hard", "num_envs": 16, "threads": 1}
    planner = PlannerAgent("RRTConnect", max_checks=CHECKS, attempts=1, unknown="free", fallback=False)
    sampled = evaluate(planner, "test", a.episodes, SEED, **world)
    policy = load_policy(a.policy)
    for name, agent in ((a.policy, policy), (f"{a.policy} behind the shield", ShieldedAgent(policy))):
        learned = evaluate(agent, "test", a.episodes, SEED, **world)
        wins = sum(r.success for r in learned.records), sum(r.success for r in sampled.records)
        figures = asdict(pairing(learned, sampled)) | {
            "bank_sha256": SceneBank.open("default").sha256,
            "learned": rate(wins[0], a.episodes),
            "sampled": rate(wins[1], a.episodes),
            "learned, collided": learned.collision_rate,
        }
        print(name, figures, flush=True)
        write_entry(RESULTS / "hard_targets.json", name, figures)


if __name__ == "__main__":
    main()
