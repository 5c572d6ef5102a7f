"""Hooks of the documentation site: pictures of the benchmarks, generated tables, scenes in 3-D, checks of links."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

from greenhouse_gym.reporting.scene_page import scene_page
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import SceneBank

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "docs"))
from generated import insert_tables  # noqa: E402

RESULTS = "benchmarks/results"
SCENES = {"own": "own-cherry-2002-w10-01", "dense": "helios-dense-2003-w03-01"}
"""Scenes of the bank `mini` that the gallery shows in 3-D, by the name of their page."""

LIGHT_PLOT = re.compile(r"(!\[[^\]]*\]\([^)]*)-light\.svg\)")

FOREIGN = re.compile(r"<(?:script|img|iframe|source|video)[^>]*\ssrc=[\"']?(?:https?:)?//[^\s>]*")
STYLES = re.compile(
    r"<link[^>]*rel=[\"']?(?:stylesheet|preconnect|icon|preload)[\"'\s][^>]*href=[\"']?(?:https?:)?//[^>]*"
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files of benchmark results, to which pages refer by their paths in the repository, and the 3-D scenes."""
    for path in sorted((ROOT / RESULTS).rglob("*")):
        if path.suffix in (".png", ".jpg", ".json"):
            name = path.relative_to(ROOT).as_posix()
            files.append(File(name, str(ROOT), config.site_dir, config.use_directory_urls))
    for name, scene in SCENES.items():
        page = scene_page(SceneBank.open("mini").scene(scene), get_robot("ur5e"))
        files.append(File.generated(config, f"gallery/scene-{name}.html", content=page))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Redirect links to the site's copies of benchmark results, add dark plots, and insert the generated tables."""
    markdown = re.sub(rf"\]\(\.\./((?:\.\./)*{RESULTS}/)", r"](\1", markdown)
    return insert_tables(LIGHT_PLOT.sub(r"\1-light.svg#only-light)\n\1-dark.svg#only-dark)", markdown))


def on_post_build(config: MkDocsConfig) -> None:
    """Raise an error if a page would load anything from the network."""
    for page in Path(config.site_dir).rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        foreign = FOREIGN.search(text) or STYLES.search(text)
        if foreign:
            raise PluginError(f"{page} loads something from the network: {foreign[0][:120]}")
    for sheet in Path(config.site_dir).rglob("*.css"):
        if re.search(r"url\([\"']?(?:https?:)?//|@import", sheet.read_text(encoding="utf-8")):
            raise PluginError(f"{sheet} loads something from the network")
