"""Whether an agent's entry on the leaderboard differs from an earlier one by more than chance, on the same episodes.

git show REVISION:benchmarks/leaderboard/watchful.json > before.json
python benchmarks/paired_entries.py before.json benchmarks/leaderboard/watchful.json

Prints McNemar's exact test for each track that both have. Writes nothing.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation.leaderboard import read_entry
from greenhouse_gym.evaluation.records import pairing


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    a = parser.parse_args()
    before, after = read_entry(a.before), read_entry(a.after)
    if before.bank_sha256 != after.bank_sha256:
        raise InvalidValueError(f"{a.before} and {a.after} were played on different banks")
    for track in (track for track in before.tracks if track in after.tracks):
        named = (
            replace(entry.evaluation(track), agent=str(file)) for entry, file in ((after, a.after), (before, a.before))
        )
        print(f"{track}: {pairing(*named)}")


if __name__ == "__main__":
    main()
