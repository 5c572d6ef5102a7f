"""Capture protocols: how a row is photographed, as data.

A plan holds in the plants only where the scan saw them. The paper's level beam at 1.1 m sees nothing above 1.5 m and
measures nothing nearer than 0.2 m, so the leaves that hang into the aisle above the fruit stay unknown. The other
protocols raise the beam, step back, pass twice, or let the arm look before it reaches.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from greenhouse_gym.capture.passes import join_passes
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import SEED_RIG, Rig, three_camera_rig
from greenhouse_gym.capture.simulated import WalkSettings, simulate_recording
from greenhouse_gym.crops.plant_row import STEM_LINE, PlantRow
from greenhouse_gym.errors import require_choice


@dataclass(frozen=True, eq=False)
class Protocol:
    """One way to photograph a row.

    Attributes:
        name: Its name in `PROTOCOLS`.
        summary: What is done, in a sentence.
        passes: The rig of each walk along the row; the same cameras, at another height.
        back: How far behind its usual line, half a metre from the stems, the tripod walks, metres.
        looks: Whether the arm then looks with its wrist camera before it reaches: `greenhouse_gym.wrist.look_rig` and
            `greenhouse_gym.reconstruction.add_looks`. A recording holds the tripod's passes alone.
        depth: How far behind the stems the foreground ends, metres; the paper cuts 10 cm behind them.
    """

    name: str
    summary: str
    passes: tuple[Rig, ...] = (SEED_RIG,)
    back: float = 0.0
    depth: float = 0.10
    looks: bool = False

    @property
    def distance(self) -> float:
        """From the cameras to the stems, metres."""
        return STEM_LINE + self.back

    @property
    def foreground(self) -> float:
        """Where the foreground is cut, metres from the reference camera."""
        return round(self.distance + self.depth, 6)


_UPRIGHT = three_camera_rig(beam="upright", spacing=0.45, inward=0.0, height=1.3)

PROTOCOLS: Mapping[str, Protocol] = MappingProxyType(
    {
        protocol.name: protocol
        for protocol in (
            Protocol("paper", "a level beam at 1.1 m, half a metre from the stems, the outer cameras turned inward"),
            Protocol("upright", "an upright beam, cameras at 0.85, 1.3 and 1.75 m, none turned", (_UPRIGHT,)),
            Protocol("back", "the paper's beam 0.8 m from the stems", back=0.3),
            Protocol("upright-back", "the upright beam 0.8 m from the stems", (_UPRIGHT,), back=0.3, depth=0.2),
            Protocol(
                "two-passes",
                "the paper's beam twice, at 1.0 and at 1.5 m, joined into one cloud",
                (three_camera_rig(height=1.0), three_camera_rig(height=1.5)),
            ),
            Protocol("wrist", "the paper's beam, and the arm's wrist camera looks before it reaches", looks=True),
            Protocol(
                "upright-wrist",
                "the upright beam 0.8 m from the stems, and the arm's wrist camera looks before it reaches",
                (_UPRIGHT,),
                back=0.3,
                depth=0.2,
                looks=True,
            ),
        )
    }
)
"""The protocols by name; ``paper`` is the default everywhere."""


def get_protocol(name: str | None) -> Protocol:
    """A protocol by name; None is the paper's.

    Raises:
        UnknownNameError: There is none of that name.
    """
    return PROTOCOLS["paper" if name is None else require_choice("protocol", name, PROTOCOLS)]


def simulate_protocol(
    row: PlantRow,
    seed: int,
    protocol: str | Protocol = "paper",
    stations: int | None = None,
    settings: WalkSettings | None = None,
) -> Recording:
    """Photograph a grown row as a protocol says.

    Args:
        row: The row.
        seed: Seed of the walks, the camera biases and the noise.
        protocol: Name or protocol.
        stations: Number of stops of each pass; by default one every step over the row's length.
        settings: Tripod and sensor errors; the protocol says how far back the tripod walks.

    Returns:
        A recording that names its protocol; its stations carry their true poses, those of the first pass first.

    Raises:
        UnknownNameError: There is no such protocol.
        InvalidValueError: ``stations`` is not positive, or ``seed`` is negative.
    """
    chosen = get_protocol(protocol) if isinstance(protocol, str) else protocol
    walking = replace(settings or WalkSettings(), back=chosen.back)
    # one rig carries one set of cameras, so every pass has the first one's depth errors
    passes = [
        simulate_recording(row, seed, rig, stations, walking, walk_number=k) for k, rig in enumerate(chosen.passes)
    ]
    return replace(join_passes(passes), protocol=chosen.name)
