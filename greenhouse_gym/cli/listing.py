"""The command list: names that commands take, by kind."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import typer

from greenhouse_gym.common.progress import say
from greenhouse_gym.common.tables import Table


def agent_table() -> Table:
    """Return the agents without arguments, with a line on each."""
    from greenhouse_gym.agents.named import SIMPLE

    return Table(("agent", "what it does"), [(name, _summary(kind)) for name, kind in SIMPLE.items()], words=(0, 1))


def policy_table() -> Table:
    """Return the shipped policies, with the arm and the observation that they need."""
    from greenhouse_gym.agents import PolicyAgent
    from greenhouse_gym.agents.policy_agent import shipped_policies

    needs = {name: PolicyAgent.load(name).env_options for name in shipped_policies()}
    rows = [(name, *(str(options.get(key, "")) for key in ("robot", "observation"))) for name, options in needs.items()]
    return Table(("policy", "arm", "observation"), rows, words=(0, 1, 2))


def planner_table() -> Table:
    """Return the planners, with their methods."""
    from greenhouse_gym.planning import PLANNERS

    return Table(("planner", "method"), [(name, PLANNERS[name].description) for name in PLANNERS], words=(0, 1))


def bank_table() -> Table:
    """Return the shipped banks, with the number of scenes in each split."""
    from greenhouse_gym.scene import SceneBank
    from greenhouse_gym.scene.bank import shipped_banks
    from greenhouse_gym.scene.manifest import SPLITS

    banks = {name: SceneBank.open(name) for name in shipped_banks()}
    rows = [(name, str(len(bank)), *(str(len(bank.names(split))) for split in SPLITS)) for name, bank in banks.items()]
    return Table(("bank", "scenes", *SPLITS), rows)


def arm_table() -> Table:
    """Return the arms, with the number of their joints."""
    from greenhouse_gym.robots import ROBOTS, get_robot

    return Table(("arm", "joints"), [(name, str(len(get_robot(name).joints))) for name in ROBOTS])


KINDS: dict[str, Callable[[], Table]] = {
    "agents": agent_table,
    "policies": policy_table,
    "planners": planner_table,
    "banks": bank_table,
    "arms": arm_table,
}


def list_names(
    kind: Annotated[
        str,
        typer.Argument(
            metavar="KIND",
            help=f"{', '.join(KINDS)}; all by default.",
            autocompletion=lambda: list(KINDS),
            show_default=False,
        ),
    ] = "",
) -> None:
    """List the names that commands take: agents, policies, planners, banks and arms.

    Every policy and every planner is an agent as well.
    """
    from greenhouse_gym.errors import MissingDependencyError, require_choice

    for name in [require_choice("kind", kind, KINDS)] if kind else KINDS:
        try:
            KINDS[name]().show()
        except MissingDependencyError as error:
            if kind:
                raise
            say(f"{name}: {error}")
        say("")


def _summary(kind: Callable[[], object]) -> str:
    """Return the first line of a docstring."""
    return (kind.__doc__ or "").strip().splitlines()[0]
