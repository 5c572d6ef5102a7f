"""Commands on policies: export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from greenhouse_gym.common.progress import say

app = typer.Typer(help="Write trained policies for others.", no_args_is_help=True)


@app.callback()
def _policy() -> None:
    """A group, so that its one command keeps its name."""


@app.command()
def export(
    policy: Annotated[str, typer.Argument(help="A shipped policy's name, or a policy's file.")],
    out: Annotated[Path, typer.Option(help="ONNX file to write.")] = Path("policy.onnx"),
) -> None:
    """Write a policy as one ONNX file: observation in, action out, for runtimes without this package."""
    from greenhouse_gym.agents import PolicyAgent
    from greenhouse_gym.common.extras import require_extras
    from greenhouse_gym.export.onnx_model import export_policy

    require_extras("onnx")
    agent = PolicyAgent.load(policy)
    export_policy(agent.policy, out, agent.name)
    say(f"{agent.name} in {out}")
