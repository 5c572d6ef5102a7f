"""How fast and in how much memory a bag of three cameras at 30 Hz becomes a recording.

A made-up video, a textured relief that goes to and fro at 10 cm a second with noise in its depth, is written by rosbags
as a ROS 1 bag of three cameras at 848x480, raw or compressed (JPEG and PNG), and imported in a process of its own. Told
are the processor time per second of recording and the largest memory, for several lengths: neither should grow.

    python benchmarks/import_speed.py
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
from results_file import RESULTS, write_results

from greenhouse_gym.capture import D435_DEPTH, RgbdFrame
from greenhouse_gym.capture.rig import three_camera_rig
from greenhouse_gym.capture.rig_file import Mounting, save_mounting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))  # the writers are those of the tests
from bag_writer import ROS1, START, Writer, png

RATE, SPEED, DISTANCE = 30, 0.10, 0.6  # Hz, m/s, m
RIG = three_camera_rig(portrait=False)
FRAMES = 91  # until it turns round
BAGS = (("raw", 5), ("raw", 15), ("compressed", 20), ("compressed", 60))  # kind and seconds
K = D435_DEPTH


def main() -> None:
    """Print a table and write it to ``benchmarks/results/import_speed.json``."""
    rows = []
    for kind, seconds in BAGS:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            rig = save_mounting(Mounting.of(RIG), folder / "rig.yaml")
            write_bag(folder / "walk.bag", kind, seconds)
            size = (folder / "walk.bag").stat().st_size
            command = ["import", str(folder / "walk.bag"), "--rig", str(rig), "--out", str(folder / "out")]
            rows.append({"kind": kind, "seconds": seconds, "gigabytes": size / 1e9, **measured(command, seconds)})
    write_results(RESULTS / "import_speed.json", {"rows": rows}, ["opencv-python-headless", "rosbags"])
    print("| bag | seconds | GB | processor s per s | times real time on a core | peak MB |")
    print("|---|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row['kind']} | {row['seconds']} | {row['gigabytes']:.2f} | {row['processor']:.2f} | "
            f"{1 / row['processor']:.1f} | {row['peak_mb']:.0f} |"
        )


def measured(command: list[str], seconds: float) -> dict[str, Any]:
    """Processor seconds per second of recording, and the largest memory of a command in a process of its own."""
    script = "import sys; from greenhouse_gym.cli import main; main()"
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run([sys.executable, "-c", script, *command], check=True, capture_output=True, text=True)
    after, took = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - began
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(done.stdout)
    return {"processor": used / seconds, "wall": took / seconds, "peak_mb": after.ru_maxrss / 1024}


def write_bag(path: Path, kind: str, seconds: int) -> None:
    """Three cameras that see the same."""
    relief, texture = scenery()
    seen_frames = [seen(relief, texture, i) for i in range(FRAMES)]
    depths = [np.rint(frame.depth * 1000).astype(np.uint16) for frame in seen_frames]
    jpegs = [cv2.imencode(".jpg", frame.color[..., ::-1])[1].tobytes() for frame in seen_frames]
    pngs = [bytes(12) + png(depth) for depth in depths]
    with Writer(path, ROS1, K) as bag:
        for i in range(RATE * seconds):
            k = FRAMES - 1 - abs(i % (2 * FRAMES - 2) - (FRAMES - 1))  # to and fro
            stamp = START + i * 10**9 // RATE
            for camera in RIG.cameras:
                color, depth = (f"/{camera}/{stream}" for stream in ("color", "aligned_depth_to_color"))
                for stream in (color, depth):
                    bag.info(f"{stream}/camera_info", stamp)
                if kind == "raw":
                    bag.image(f"{color}/image_raw", seen_frames[k].color, "rgb8", stamp)
                    bag.image(f"{depth}/image_raw", depths[k], "16UC1", stamp)
                else:
                    bag.compressed(f"{color}/image_raw/compressed", jpegs[k], "rgb8; jpeg", stamp)
                    bag.compressed(f"{depth}/image_raw/compressedDepth", pngs[k], "16UC1; compressedDepth png", stamp)


def scenery() -> tuple[np.ndarray, np.ndarray]:
    """Depth (h, w), metres, and color of all that goes by."""
    random = np.random.default_rng(0)
    width = K.width + column(FRAMES) + 1
    coarse = random.uniform(-0.1, 0.1, (K.height // 40, width // 40))
    relief = DISTANCE + cv2.resize(coarse, (width, K.height), interpolation=cv2.INTER_CUBIC)
    patches = random.integers(20, 230, (K.height // 6, width // 6, 3)).astype(np.uint8)
    return relief, np.asarray(cv2.resize(patches, (width, K.height), interpolation=cv2.INTER_CUBIC))


def column(i: int) -> int:
    """The first column of the scenery that frame i shows."""
    return round(i * SPEED / RATE * K.fx / DISTANCE)


def seen(relief: np.ndarray, texture: np.ndarray, i: int) -> RgbdFrame:
    """Frame i."""
    part = slice(column(i), column(i) + K.width)
    noise = np.random.default_rng(i).normal(0.0, 0.001, (K.height, K.width))
    return RgbdFrame(np.ascontiguousarray(texture[:, part]), (relief[:, part] + noise).astype(np.float32), K)


if __name__ == "__main__":
    main()
