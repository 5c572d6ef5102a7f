"""From episodes to figures: what was reached, hit, and had no plan, per protocol and way to treat unknown space."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from greenhouse_gym.evaluation.records import wilson_interval

AISLE, BEHIND = 0.50, 0.75
"""Metres from the arm's axis: what is nearer hangs in the aisle, what is farther grows behind the stems at 0.60."""

Episode = dict[str, Any]

_CELL = ("source", "protocol", "unknown", "start")


def summaries(episodes: Sequence[Episode]) -> list[dict[str, Any]]:
    """Figures of each source of plants, protocol and mode, in the order in which they first occur."""
    groups: dict[tuple[str, ...], list[Episode]] = {}
    for episode in episodes:
        groups.setdefault(tuple(episode[key] for key in _CELL), []).append(episode)
    result = []
    for cell, group in groups.items():
        source, protocol, _, start = cell
        free = {_task(e) for e in groups.get((source, protocol, "free", start), []) if e["outcome"] != "no plan"}
        refused = sum(e["outcome"] == "no plan" and _task(e) in free for e in group)
        result.append(dict(zip(_CELL, cell, strict=True)) | _summary(refused, group))
    return result


def _task(episode: Episode) -> tuple[Any, ...]:
    return episode["source"], episode["row"], episode["scene"], episode["target"]


def _summary(refused: int, episodes: Sequence[Episode]) -> dict[str, Any]:
    followed = [e for e in episodes if e["outcome"] != "no plan"]
    counts = Counter(e["outcome"] for e in followed)
    scenes = {(e["row"], e["scene"]): e["true_within_reach"] for e in episodes}
    seen = {(e["row"], e["scene"]): e["seen"] for e in episodes if e["seen"] is not None}
    planned_for = {(e["row"], e["scene"], e["match"]) for e in followed if e["match"] is not None}
    return {
        "rows": len({e["row"] for e in episodes}),
        "targets": len(episodes),
        "followed": len(followed),
        "reached": _rate(counts["reached"], len(followed)),
        "collided": _rate(counts["collided"], len(followed)),
        "missed": _rate(counts["missed"], len(followed)),
        "planned_share_of_targets": _rate(len(followed), len(episodes)),
        "planned_share_of_true_tomatoes": round(len(planned_for) / max(1.0, sum(scenes.values())), 4),
        "refused": _rate(refused, len(episodes)),
        "seen_share_of_reach": round(sum(seen.values()) / len(seen), 4) if seen else None,
        "without_plan": dict(Counter(e["status"] for e in episodes if e["outcome"] == "no plan").most_common()),
        "hit": _counted(what_was_hit, followed),
        "hit_where": _counted(lambda e: e.get("space") or "unknown", followed),
        "by_part": _counted(_part, followed),
    }


def _counted(tell: Callable[[Episode], str], followed: Sequence[Episode]) -> dict[str, int]:
    """How often something is told of the episodes that ended in a collision."""
    return dict(Counter(tell(e) for e in followed if e["outcome"] == "collided").most_common())


def _rate(count: int, total: int) -> dict[str, Any]:
    low, high = wilson_interval(count, total)
    return {
        "count": count,
        "rate": round(count / total, 4) if total else None,
        "interval": [round(low, 4), round(high, 4)],
    }


def what_was_hit(episode: Episode) -> str:
    """What a path hit, and whether it hangs in the aisle, stands in the row, or behind it."""
    touched = next((c for c in episode["contact"] if c.startswith(("tomato_", "stem_", "clutter_"))), None)
    if touched is None or episode["at"] is None:
        return "-".join(sorted(episode["contact"]))
    kind = {"tomato": "fruit", "clutter": "leaf"}.get(touched.split("_")[0]) or touched.split("_")[2]
    x = episode["at"][0]
    return f"{kind} {'in the aisle' if x < AISLE else 'behind' if x > BEHIND else 'in the row'}"


def _part(episode: Episode) -> str:
    return next((c for c in episode["contact"] if not c.startswith(("tomato_", "stem_", "clutter_"))), "")


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The figures as Markdown."""
    lines = [
        "| plants | protocol | unknown | start | followed | reached [95 %] | collided [95 %] | refused | planned "
        "| of true fruit | seen | hit |",
        "|---|---|---|---|---:|---:|---:|---:|---:|---:|---:|---|",
    ]
    for row in rows:
        hit = ", ".join(f"{count} {what}" for what, count in row["hit"].items())
        lines.append(
            f"| {row['source']} | {row['protocol']} | {row['unknown']} | {row['start']} | "
            f"{row['followed']} | {_text(row['reached'])} | "
            f"{_text(row['collided'])} | {_text(row['refused'], False)} | "
            f"{_text(row['planned_share_of_targets'], False)} | {row['planned_share_of_true_tomatoes']:.0%} | "
            f"{'-' if row['seen_share_of_reach'] is None else format(row['seen_share_of_reach'], '.0%')} | {hit} |"
        )
    return "\n".join(lines) + "\n"


def _text(rate: dict[str, Any], interval: bool = True) -> str:
    if rate["rate"] is None:
        return "-"
    low, high = rate["interval"]
    return f"{rate['rate']:.1%}" + (f" [{low:.1%}, {high:.1%}]" if interval else "")
