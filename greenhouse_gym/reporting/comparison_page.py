"""A comparison of agents on one page that opens anywhere: tables, plots, and episodes to be turned and looked at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from string import Template
from typing import NamedTuple

from greenhouse_gym import __version__
from greenhouse_gym.evaluation.records import Evaluation, comparison_notes, comparison_rows, difficulties_of
from greenhouse_gym.reporting import comparison_figures as drawn
from greenhouse_gym.reporting import pieces
from greenhouse_gym.reporting.scene_page import Episode, scene_page
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene

# Scenes are pages in frames of their own, which take over what this page allows: the scripts are theirs alone.
_PAGE = Template("""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
$style
iframe { width: 100%; height: 38rem; border: 1px solid #ccc; display: block }
@media (max-width: 40rem) {
  body { margin: 1rem auto; padding: 0 1rem }
  iframe { height: 42rem }
  svg { font-size: 14px }
}
</style>
</head>
<body>
<h1>$title</h1>
$figures
$notes
$content
<footer>greenhouse-gym $version</footer>
</body>
</html>
""")

_TOUCHED = {
    "reconstruction": "Agents know the reconstruction, and that is what they touch.",
    "truth": "Agents know the reconstruction; what they touch is the row that was scanned.",
    "moved": "Agents know the reconstruction; what they touch is the row that was scanned, after its plants moved.",
}
_OFTEN = 10  # pairs of agents that a page shows without being asked


class Shown(NamedTuple):
    """An episode of a page.

    Attributes:
        title: Its heading.
        scene: Its scene.
        robot: The arm.
        episode: The agents' ways.
    """

    title: str
    scene: Scene
    robot: Robot
    episode: Episode


def comparison_page(
    title: str,
    tracks: Mapping[str, Sequence[Evaluation]],
    colors: Mapping[str, str],
    notes: Sequence[str] = (),
    rule: str = "",
    episodes: Sequence[Shown] = (),
) -> str:
    """All about agents on the same episodes as one HTML page, which loads nothing.

    Args:
        title: Its heading.
        tracks: Per track, of `greenhouse_gym.evaluation.leaderboard.TRACKS`, the agents' evaluations.
        colors: A color for each agent.
        notes: What else there is to say of it all.
        rule: How the episodes were chosen.
        episodes: Those to look at in three dimensions.
    """
    most = max((len(e.records) for evaluations in tracks.values() for e in evaluations), default=0)
    content = [_by_track(tracks, colors)] if len(tracks) > 1 else []
    content += [_track(name, evaluations, colors) for name, evaluations in tracks.items()]
    if episodes:
        content += [pieces.heading("Episodes"), pieces.paragraph(rule), *map(_shown, episodes)]
    return _PAGE.substitute(
        title=escape(title),
        style=pieces.STYLE,
        figures=pieces.figures({"agents": f"{len(colors)}", "episodes each": f"{most:,}"}),
        notes="".join(map(pieces.paragraph, notes)),
        content="\n".join(content),
        version=__version__,
    )


def _by_track(tracks: Mapping[str, Sequence[Evaluation]], colors: Mapping[str, str]) -> str:
    drawing = drawn.rates_plot("success by track", tracks, colors)
    caption = "Success rates with their 95 % intervals (Wilson)."
    head = pieces.heading("Success by track") + pieces.keys(colors)
    return f'{head}<div class="pair">{_figure(drawing, caption)}</div>\n'


def _track(name: str, evaluations: Sequence[Evaluation], colors: Mapping[str, str]) -> str:
    """Everything about the agents on one track."""
    heads, *rows = [[cell.replace("nan", "") for cell in row] for row in comparison_rows(evaluations)]
    used = {e.agent: colors[e.agent] for e in evaluations}
    difficulties = difficulties_of(evaluations)
    groups = {difficulty: [e.of(difficulty) for e in evaluations] for difficulty in difficulties}
    rates = drawn.rates_plot("success by difficulty", {"all": evaluations, **groups}, used)
    plots = (
        (rates, "Success by difficulty, with 95 % intervals (Wilson)."),
        (drawn.steps_plot(evaluations, used), "The share of all episodes that succeeded within a number of actions."),
        (
            drawn.seconds_plot(evaluations, used),
            "The same over time: thought before the first action, then 20 actions a second, or fewer where they take "
            "longer to think of.",
        ),
        (drawn.motion_plot(evaluations, used), "The share of episodes in which the first action was known."),
    )
    return "".join(
        (
            pieces.heading(f"Track {name}"),
            pieces.paragraph(f"{_TOUCHED[name]} Ways, steps and clearances are medians over successful episodes."),
            pieces.table(heads, rows, {0}),
            pieces.warnings(comparison_notes(evaluations)),
            pieces.keys(used),
            f'<div class="pair">{"".join(_figure(*one) for one in plots)}</div>',
            pieces.heading("Time to the first motion", 3),
            drawn.motion_table(evaluations),
            pieces.heading("Which agents differ", 3),
            pieces.paragraph(
                "McNemar's exact test on the episodes that both played; p is how likely a difference like this is "
                "between equally good agents, not corrected for the number of pairs."
            ),
            _folded(drawn.pairs_table(evaluations), len(evaluations) * (len(evaluations) - 1) // 2),
            pieces.heading("Collisions", 3),
            pieces.paragraph("Episodes that a collision ended, by what was touched and by the part of the arm."),
            drawn.collision_tables(evaluations),
        )
    )


def _folded(table: str, rows: int) -> str:
    return table if rows <= _OFTEN else f"<details><summary>{rows} pairs</summary>{table}</details>\n"


def _figure(content: str, caption: str) -> str:
    return f"<figure>{content}<figcaption>{escape(caption)}</figcaption></figure>\n"


def _shown(one: Shown) -> str:
    page = escape(scene_page(one.scene, one.robot, one.episode))
    frame = f'<iframe loading="lazy" title="{escape(one.title)}" srcdoc="{page}"></iframe>'
    return f"{pieces.heading(one.title, 3)}{frame}\n"
