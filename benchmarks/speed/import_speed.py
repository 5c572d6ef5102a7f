"""Measure processor time and memory of importing bags of three cameras at 30 Hz.

python -m benchmarks.speed.import_speed

A synthetic video, a textured relief that moves back and forth at 10 cm/s with noise in its depth, is written by rosbags
as a ROS 1 bag of three cameras at 848x480, raw or compressed (JPEG and PNG), and imported in its own process. Neither
the processor time per second of recording nor the peak memory should grow with the length. Takes 10 minutes.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.common import RESULTS, TESTS, table, write_results
from greenhouse_gym.capture import D435_DEPTH, RgbdFrame
from greenhouse_gym.capture.rig import three_camera_rig
from greenhouse_gym.capture.rig_file import Mounting, save_mounting

sys.path.insert(0, str(TESTS))
from bag_writer import ROS1, START, Writer, png

RATE, SPEED, DISTANCE = 30, 0.10, 0.6  # Hz, m/s, m
RIG = three_camera_rig(portrait=False)
FRAMES = 91  # until the motion reverses
BAGS = (("raw", 5), ("raw", 15), ("compressed", 20), ("compressed", 60))  # kind and seconds
K = D435_DEPTH


def main() -> None:
    """Print a table and write ``benchmarks/results/import_speed.json``."""
    rows = []
    for kind, seconds in BAGS:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            rig = save_mounting(Mounting.of(RIG), folder / "rig.yaml")
            write_bag(folder / "walk.bag", kind, seconds)
            size = (folder / "walk.bag").stat().st_size
            command = ["import", str(folder / "walk.bag"), "--rig", str(rig), "--out", str(folder / "out")]
            rows.append({"kind": kind, "seconds": seconds, "gigabytes": size / 1e9, **measured(command, seconds)})
    write_results(RESULTS / "import_speed.json", {"rows": rows})
    heads = ("bag", "seconds", "GB", "processor s per s", "times real time on a core", "peak MB")
    lines = []
    for row in rows:
        speed = f"{row['processor']:.2f}", f"{1 / row['processor']:.1f}", f"{row['peak_mb']:.0f}"
        lines.append((row["kind"], row["seconds"], f"{row['gigabytes']:.2f}", *speed))
    print(table(heads, lines))


def measured(command: list[str], seconds: float) -> dict[str, Any]:
    """Run a command in its own process; return seconds per second of recording, and the peak memory."""
    script = "from greenhouse_gym.cli import main; main()"
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run([sys.executable, "-c", script, *command], check=True, capture_output=True, text=True)
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - began
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(done.stdout)
    return {"processor": used / seconds, "wall": wall / seconds, "peak_mb": after.ru_maxrss / 1024}


def write_bag(path: Path, kind: str, seconds: int) -> None:
    """Write a bag of three cameras with the same images."""
    frames = scenery()
    depths = [np.rint(frame.depth * 1000).astype(np.uint16) for frame in frames]
    jpegs = [cv2.imencode(".jpg", frame.color[..., ::-1])[1].tobytes() for frame in frames]
    pngs = [bytes(12) + png(depth) for depth in depths]
    with Writer(path, ROS1, K) as bag:
        for i in range(RATE * seconds):
            k = FRAMES - 1 - abs(i % (2 * FRAMES - 2) - (FRAMES - 1))  # back and forth
            stamp = START + i * 10**9 // RATE
            for camera in RIG.cameras:
                color, depth = (f"/{camera}/{stream}" for stream in ("color", "aligned_depth_to_color"))
                for stream in (color, depth):
                    bag.info(f"{stream}/camera_info", stamp)
                if kind == "raw":
                    bag.image(f"{color}/image_raw", frames[k].color, "rgb8", stamp)
                    bag.image(f"{depth}/image_raw", depths[k], "16UC1", stamp)
                else:
                    bag.compressed(f"{color}/image_raw/compressed", jpegs[k], "rgb8; jpeg", stamp)
                    bag.compressed(f"{depth}/image_raw/compressedDepth", pngs[k], "16UC1; compressedDepth png", stamp)


def scenery() -> list[RgbdFrame]:
    """Return the frames of a camera that moves along a textured relief."""
    rng = np.random.default_rng(0)
    columns = [round(i * SPEED / RATE * K.fx / DISTANCE) for i in range(FRAMES + 1)]
    size = (K.width + columns[-1] + 1, K.height)
    coarse = rng.uniform(-0.1, 0.1, (K.height // 40, size[0] // 40))
    relief = DISTANCE + cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
    patches = rng.integers(20, 230, (K.height // 6, size[0] // 6, 3)).astype(np.uint8)
    texture = np.asarray(cv2.resize(patches, size, interpolation=cv2.INTER_CUBIC))
    frames = []
    for i, first in enumerate(columns[:FRAMES]):
        view = np.s_[:, first : first + K.width]
        noise = np.random.default_rng(i).normal(0.0, 0.001, (K.height, K.width))
        frames.append(RgbdFrame(np.ascontiguousarray(texture[view]), (relief[view] + noise).astype(np.float32), K))
    return frames


if __name__ == "__main__":
    main()
