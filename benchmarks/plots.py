"""Draw the plots of the documentation, in docs/plots/, from the files of results; each for light and for dark pages.

python -m benchmarks.plots
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.common import RESULTS, ROOT, parser
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.evaluation.entry import is_current, read_entry
from greenhouse_gym.evaluation.records import wilson_interval
from greenhouse_gym.scene import SceneBank

PLOTS = ROOT / "docs" / "plots"
LEADERBOARD = ROOT / "benchmarks" / "leaderboard"

THEMES = {"light": ("#24292f", "#d0d7de"), "dark": ("#e6e6e6", "#4a4f57")}
"""Colors of the text and of the grid on light and on dark pages."""

COLORS = ("#2e9e5b", "#e8704a", "#4f8fd9", "#c9a227", "#a56cc1", "#7f8c8d")
"""Colors that are readable on both, and distinct for the color-blind."""

AGENTS = (
    "watchful",
    "watchful-ppo-goals-ur5e",
    "RRTConnect",
    "ppo-roadmap-ur5e",
    "shielded-ppo-goals-ur5e",
    "ppo-goals-ur5e",
    "ppo-warp-ur5e",
    "straight-line",
)
TRACKS = ("reconstruction", "truth", "brush")
DIFFICULTIES = ("easy", "medium", "hard")


def read(name: str) -> dict[str, Any]:
    """Return a file of results."""
    content: dict[str, Any] = json.loads((RESULTS / name).read_text())
    return content


def bars(axes: Axes, groups: tuple[str, ...], series: dict[str, list[tuple[int, int] | None]]) -> None:
    """Draw counts (successes, of) as grouped bars of rates with 95 % intervals; None leaves a gap."""
    width = 0.8 / len(series)
    for k, (name, counts) in enumerate(series.items()):
        shown = [(i, count) for i, count in enumerate(counts) if count]
        x = np.array([i + (k - (len(series) - 1) / 2) * width for i, _ in shown])
        rates = np.array([100 * hits / total for _, (hits, total) in shown])
        bounds = 100 * np.array([wilson_interval(hits, total) for _, (hits, total) in shown])
        axes.bar(x, rates, 0.92 * width, label=name, color=COLORS[k])
        spread = np.abs(bounds - rates[:, None]).T
        axes.errorbar(x, rates, spread, fmt="none", ecolor=mpl.rcParams["text.color"], elinewidth=1)
    axes.set_xticks(range(len(groups)), groups)
    axes.set_ylim(0, 100)
    axes.set_ylabel("reached (%)")


def below(axes: Axes, columns: int) -> None:
    """Put the legend below the axes."""
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=columns, frameon=False)


def counted(entry: dict[str, Any]) -> tuple[int, int]:
    """Return successes and episodes of an entry of results."""
    return round(entry["success"] * entry["episodes"]), entry["episodes"]


def agent_entries() -> dict[str, Any]:
    """Return the agents on the test rows of the bank that is shipped now, by ``agent, track``."""
    shipped = SceneBank.open("default").sha256
    return {name: one for name, one in read("policies.json")["entries"].items() if one["bank_sha256"] == shipped}


def agents() -> Figure:
    """Draw successes by agent and track."""
    figure, axes = plt.subplots(figsize=(8.4, 4))
    entries = agent_entries()
    series = {
        track: [counted(entries[key]) if (key := f"{agent}, {track}") in entries else None for agent in AGENTS]
        for track in TRACKS
    }
    bars(axes, tuple(name.replace("-ur5e", "").replace("-", "-\n", 1) for name in AGENTS), series)
    axes.tick_params(axis="x", labelsize=9)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=3, frameon=False)
    return figure


def choice() -> Figure:
    """Draw successes and collisions against the time to the first motion, by what agents know."""
    figure, panels = plt.subplots(1, 3, figsize=(11, 4), sharey=True)
    entries = [entry for agent in AGENTS if is_current(entry := read_entry(LEADERBOARD / f"{agent}.json"))]
    for axes, track, title in zip(panels, TRACKS, ("row as scanned", "true row", "leaves give way"), strict=True):
        for entry in entries:
            if track not in entry.tracks:
                continue
            e = entry.evaluation(track)
            x = 1000 * (e.median("planning_time") + e.median("action_time"))
            color = COLORS[0 if entry.knows == "observation" else 2]
            axes.plot([x, x], [100 * e.collision_rate, 100 * e.success_rate], color=color, alpha=0.3)
            axes.plot(x, 100 * e.collision_rate, "x", color=color)
            axes.plot(x, 100 * e.success_rate, "o", color=color)
            axes.annotate(
                entry.agent.removesuffix("-ur5e"),
                (x, 100 * e.success_rate),
                (4, 4),
                textcoords="offset points",
                fontsize=7,
            )
        axes.set_xscale("log")
        axes.set_title(title)
        axes.set_xlim(0.5, 2000)
        axes.set_xlabel("ms to the first motion")
        axes.set_ylim(-3, 108)
    panels[0].set_ylabel("reached (o), collided (x), %")
    keys = {"acts on its observation": COLORS[0], "knows the whole scan": COLORS[2]}
    handles = [Line2D([], [], color=color, marker="o", linestyle="") for color in keys.values()]
    figure.legend(handles, list(keys), loc="lower center", ncols=2, frameon=False)
    figure.subplots_adjust(bottom=0.24)
    return figure


def difficulty() -> Figure:
    """Draw successes in the true row by difficulty, of as many agents as there are colors."""
    figure, axes = plt.subplots(figsize=(8, 4))
    entries = agent_entries()
    chosen = [agent for agent in AGENTS[: len(COLORS)] if f"{agent}, truth" in entries]
    series = {
        agent: [counted(entries[f"{agent}, truth"]["by_difficulty"][d]) for d in DIFFICULTIES] for agent in chosen
    }
    bars(axes, DIFFICULTIES, series)
    below(axes, 3)
    return figure


def learning() -> Figure:
    """Draw the learning curves of the ten lines of README, and of half an hour of ``train ppo``."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True)
    for k, (seed, lesson) in enumerate(read("first_lesson.json")["entries"]["ten lines"]["seeds"].items()):
        _, seconds, reached = np.array(lesson["curve"]).T
        left.plot(seconds / 60, 100 * reached, color=COLORS[k], label=f"seed {seed}")
    for k, (seed, lines) in enumerate(read("lesson_lengths.json")["entries"]["30 minutes"]["seeds"].items()):
        minutes, reached = np.array([(line["minutes"], line["success_rate"]) for line in lines]).T
        right.plot(minutes, 100 * reached, color=COLORS[k], label=f"seed {seed}")
    left.set_title("the ten lines of README, easy targets", fontsize=10)
    right.set_title("train ppo, all targets", fontsize=10)
    for axes in (left, right):
        axes.set_xlabel("minutes on one core")
        axes.set_ylim(0, 100)
        axes.legend(frameon=False, loc="upper left")
    left.set_ylabel("reached in training (%)")
    return figure


def gpu() -> Figure:
    """Draw what policies trained on a GPU reach by rows and difficulty."""
    figure, axes = plt.subplots(figsize=(8, 3.8))
    results, rows = read("gpu.json"), ("own", "helios")
    names = {
        "2x256, joint": "PPO 2x256, joint actions, seed 0", "3x512, joint": "PPO 3x512, joint actions, seed 0",
        "3x512, tip": "PPO 3x512, tip actions, seed 0",
    }  # fmt: skip
    cells = [(row, level) for row in rows for level in DIFFICULTIES]
    series = {
        label: [counted(results[f"{name}, test, {row} {level}"]) for row, level in cells]
        for label, name in names.items()
    }
    bars(axes, tuple(f"{row.replace('helios', 'Helios')},\n{level}" for row, level in cells), series)
    axes.legend(loc="upper right", frameon=False)
    return figure


def plans() -> Figure:
    """Draw how often plans hold in the true rows, by rows and caution."""
    figure, axes = plt.subplots(figsize=(8, 3.8))
    entries = read("true_rows.json")["entries"]
    kinds = {
        "unknown space is free": "plans, test rows, unknown=free, folded",
        "at most 15 cm into it": "plans, test rows, unknown=0.15, folded",
        "and avoid unexplained cells": "plans with unexplained, test rows, unknown=0.15, folded",
    }
    rows = ("own, upright-back", "own, paper", "helios, upright-back", "helios, paper")
    series = {
        label: [counted(entries[name]["by_rows"][row]["of_planned"]) for row in rows] for label, name in kinds.items()
    }
    bars(axes, tuple(row.replace("helios", "Helios").replace(", ", ",\n") for row in rows), series)
    axes.set_ylabel("plans that reach in the truth (%)")
    below(axes, 3)
    axes.get_legend().set_bbox_to_anchor((0.5, -0.18))
    return figure


def drift() -> Figure:
    """Draw the drift of reconstructed rows by their length and the method."""
    figure, axes = plt.subplots(figsize=(8, 3.6))
    names = {"package": "this package", "paper_chain": "chain of the paper", "multiway": "multiway registration"}
    measured = [one for one in read("reconstruction.json")["measurements"] if not one["broken"]]
    for k, (method, label) in enumerate(names.items()):
        chosen = [one for one in measured if one["method"] == method]
        x = [one["length"] * (1 + 0.04 * (k - 1)) for one in chosen]
        axes.scatter(x, [100 * one["drift"] for one in chosen], label=label, color=COLORS[k], s=36, alpha=0.85)
    axes.set_xscale("log")
    axes.set_xticks([2, 5, 10, 20], ["2 m", "5 m", "10 m", "20 m"])
    axes.minorticks_off()
    axes.set_xlabel("length of the row")
    axes.set_ylabel("drift (% of the length)")
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False)
    return figure


def waits() -> Figure:
    """Draw the distribution of the computing time of an episode by agent, in the true row."""
    figure, axes = plt.subplots(figsize=(8, 3.6))
    for k, agent in enumerate(("ppo-warp-ur5e", "RRTConnect", "watchful")):
        records = json.loads((LEADERBOARD / f"{agent}.json").read_text())["tracks"]["truth"]
        steps = np.maximum(np.array(records["steps"]), 1)
        seconds = np.array(records["planning_time"]) + steps * np.array(records["action_time"])
        quantiles = np.linspace(0, 100, 101)
        axes.plot(np.percentile(seconds, quantiles), quantiles, color=COLORS[k], label=agent)
    axes.set_xscale("log")
    axes.set_xlabel("seconds of planning and acting in an episode")
    axes.set_ylabel("episodes (%)")
    axes.set_ylim(0, 100)
    axes.legend(frameon=False, loc="lower right")
    return figure


def throughput() -> Figure:
    """Draw steps per second next to peers, and on a GPU."""
    figure, axes = plt.subplots(figsize=(8, 3.4))
    measured, device = read("throughput.json"), read("gpu.json")
    speeds = {
        "FetchReach-v4, 8 processes": measured["per_second"]["FetchReach-v4, AsyncVectorEnv(8)"],
        "one environment": measured["per_second"]["single environment"],
        "64, in the true row": measured["per_second"]["physics truth, 64 simulations"],
        "256 in one vector": measured["per_second"]["vector environment"],
        "bare MuJoCo": measured["per_second"]["bare Batch.step"],
        "16,384 on a GPU": device["steps per second, 16384 simulations"]["random actions"],
    }
    peers = ("FetchReach-v4, 8 processes", "bare MuJoCo")
    axes.barh(list(speeds), list(speeds.values()), color=[COLORS[5] if name in peers else COLORS[0] for name in speeds])
    for k, value in enumerate(speeds.values()):
        axes.text(1.1 * value, k, f"{value:,.0f}", va="center", fontsize=9)
    axes.set_xscale("log")
    axes.set_xlim(right=4e8)
    axes.set_xlabel("environment steps per second")
    axes.grid(visible=False, axis="y")
    return figure


def unknown() -> Figure:
    """Draw slices through the occupancy grids of a row of each source, seen along the row."""
    figure, panels = plt.subplots(1, 2, figsize=(8, 4.2), sharey=True)
    scenes = {
        "own row, upright beam": "own-cluster-2000-w00-02",
        "Helios row, upright beam": "helios-dense-2003-w03-01",
    }
    colors = ListedColormap(["#8b8f94", "#f4f1e8", "#2e9e5b"])
    for axes, (title, name) in zip(panels, scenes.items(), strict=True):
        grid = SceneBank.open("mini").scene(name).occupancy
        assert grid is not None
        middle = grid.shape[1] // 2
        (x0, _, z0), (nx, _, nz) = grid.origin, grid.shape
        extent = (x0, x0 + nx * grid.voxel, z0, z0 + nz * grid.voxel)
        axes.imshow(grid.states[:, middle].T, origin="lower", extent=extent, cmap=colors, vmin=0, vmax=2)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("from the arm into the row (m)")
        axes.grid(visible=False)
    panels[0].set_ylabel("height (m)")
    for color, label in zip(colors.colors, ("unknown", "free", "occupied"), strict=True):
        panels[0].plot([], [], "s", color=color, label=label, markeredgecolor="#888")
    figure.legend(loc="lower center", ncols=3, frameon=False)
    figure.subplots_adjust(bottom=0.22)
    return figure


def tomatoes() -> Figure:
    """Draw the visible tomatoes found in held-out rows."""
    figure, axes = plt.subplots(figsize=(8, 3.4))
    kinds = {"all": "all visible", "whole": "not cut by the image", "whole green": "of these, green"}
    series = {}
    for label, name in {"own rows": "shapes.json", "Helios rows": "shapes_helios.json"}.items():
        found = read(name)["figures"]["noisy"]["tomatoes"]
        series[label] = [(found[kind]["found"], found[kind]["visible"]) for kind in kinds]
    bars(axes, tuple(kinds.values()), series)
    axes.set_ylabel("found (%)")
    axes.legend(frameon=False, loc="lower right")
    return figure


DRAWN: tuple[Callable[[], Figure], ...] = (
    agents,
    choice,
    difficulty,
    learning,
    gpu,
    plans,
    drift,
    waits,
    throughput,
    unknown,
    tomatoes,
)
"""Functions that draw the plots, each named as its files."""


def drawn(theme: str) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of each plot as SVG on a transparent background."""
    text, grid = THEMES[theme]
    style = {
        "text.color": text, "axes.labelcolor": text, "xtick.color": text, "ytick.color": text, "axes.edgecolor": grid,
        "grid.color": grid, "axes.grid": True, "axes.axisbelow": True, "grid.linewidth": 0.6, "font.size": 10,
        "axes.spines.top": False, "axes.spines.right": False, "svg.hashsalt": "plots", "svg.fonttype": "none",
    }  # fmt: skip
    with mpl.rc_context(style):
        for function in DRAWN:
            figure, file = function(), io.BytesIO()
            figure.savefig(file, format="svg", transparent=True, bbox_inches="tight", metadata={"Date": None})
            plt.close(figure)
            yield f"{function.__name__}-{theme}.svg", file.getvalue()


def main() -> None:
    """Draw all plots."""
    parser(__doc__).parse_args()
    for theme in THEMES:
        for name, content in drawn(theme):
            write_atomically(PLOTS / name, content)


if __name__ == "__main__":
    main()
