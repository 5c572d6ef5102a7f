"""Bags by rosbags' writers, of any container, for tests and benchmarks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from row_helpers import HALF
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture import Intrinsics, Recording, RgbdFrame
from greenhouse_gym.geometry import Array

K = HALF.cameras["middle"].intrinsics
ROS1, MCAP, SQLITE = "ros1", "mcap", "sqlite"
START = 1_700_000_000 * 10**9
FRAME = 33_000_000  # ns from frame to frame


def png(image: np.ndarray) -> bytes:
    """A PNG file of depth, or of color as BGR."""
    return cv2.imencode(".png", image)[1].tobytes()


class Writer:
    """A bag by rosbags' writers, of any of its containers, under one interface."""

    def __init__(self, path: Path, container: str, lens: Intrinsics = K):
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_typestore

        self.ros1, self.lens = container == ROS1, lens
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        plugin = StoragePlugin.MCAP if container == MCAP else StoragePlugin.SQLITE3
        self.writer: Any = Writer1(path) if self.ros1 else Writer2(path, version=9, storage_plugin=plugin)
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> Writer:
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, stamp: int, frame: str = "camera") -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **({"seq": 0} if self.ros1 else {}))

    def put(self, topic: str, kind: str, at: int, **fields: Any) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        message = self.make(kind, **fields)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], at, serialize(message, kind))

    def image(self, topic: str, image: np.ndarray, encoding: str, stamp: int, at: int | None = None) -> None:
        self.put(
            topic, "sensor_msgs/msg/Image", at or stamp, header=self.header(stamp), height=image.shape[0],
            width=image.shape[1], encoding=encoding, is_bigendian=0, step=image.strides[0],
            data=np.frombuffer(np.ascontiguousarray(image).tobytes(), np.uint8),
        )  # fmt: skip

    def compressed(self, topic: str, content: bytes, format: str, stamp: int) -> None:
        self.put(
            topic, "sensor_msgs/msg/CompressedImage", stamp, header=self.header(stamp), format=format,
            data=np.frombuffer(content, np.uint8),
        )  # fmt: skip

    def info(self, topic: str, at: int, frame: str = "camera") -> None:
        region = self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        lower = {"d": np.zeros(5), "k": self.lens.matrix.ravel(), "r": np.eye(3).ravel(), "p": np.zeros(12)}
        self.put(
            topic, "sensor_msgs/msg/CameraInfo", at, header=self.header(at, frame), height=self.lens.height,
            width=self.lens.width,            distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=region,
            **{(name.upper() if self.ros1 else name): value for name, value in lower.items()},
        )  # fmt: skip

    def transform(self, topic: str, parent: str, child: str, parent_from_child: Array, stamp: int) -> None:
        turned = Rotation.from_matrix(parent_from_child[:3, :3]).as_quat()
        place = dict(zip("xyz", parent_from_child[:3, 3].tolist(), strict=True))
        moved = self.make(
            "geometry_msgs/msg/Transform", translation=self.make("geometry_msgs/msg/Vector3", **place),
            rotation=self.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turned.tolist(), strict=True))),
        )  # fmt: skip
        stamped = self.make(
            "geometry_msgs/msg/TransformStamped", header=self.header(stamp, parent), child_frame_id=child,
            transform=moved,
        )  # fmt: skip
        self.put(topic, "tf2_msgs/msg/TFMessage", stamp, transforms=[stamped])

    def pose(self, topic: str, place: Array, stamp: int, frame: str = "odom") -> None:
        turned = Rotation.from_matrix(place[:3, :3]).as_quat()
        point = self.make("geometry_msgs/msg/Point", **dict(zip("xyz", place[:3, 3].tolist(), strict=True)))
        turn = self.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turned.tolist(), strict=True)))
        there = self.make("geometry_msgs/msg/Pose", position=point, orientation=turn)
        self.put(topic, "geometry_msgs/msg/PoseStamped", stamp, header=self.header(stamp, frame), pose=there)

    def camera(self, prefix: str, frames: Sequence[RgbdFrame], late: int = 0) -> None:
        """A camera as ROS drivers name its topics, depth aligned to color in millimetres, ``late`` nanoseconds late."""
        for i, frame in enumerate(frames):
            stamp = START + i * FRAME
            self.info(f"{prefix}/color/camera_info", stamp)
            self.info(f"{prefix}/aligned_depth_to_color/camera_info", stamp)
            self.image(f"{prefix}/color/image_raw", frame.color, "rgb8", stamp)
            depth = np.rint(frame.depth * 1000).astype(np.uint16)
            self.image(f"{prefix}/aligned_depth_to_color/image_raw", depth, "16UC1", stamp + late, stamp + 5_000_000)

    def realsense(self, device: str, frames: Sequence[RgbdFrame], units: float = 0.001) -> None:
        """A camera as RealSense's recorder names its topics."""
        self.put(f"/{device}/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", START, data=units)
        place = {
            "translation": self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0),
            "rotation": self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        }
        for stream in ("sensor_0/Depth_0", "sensor_1/Color_0"):
            self.info(f"/{device}/{stream}/info/camera_info", START)
            self.put(f"/{device}/{stream}/tf/0", "geometry_msgs/msg/Transform", START, **place)
        for i, frame in enumerate(frames):
            depth = np.rint(frame.depth / units).astype(np.uint16)
            self.image(f"/{device}/sensor_0/Depth_0/image/data", depth, "mono16", START + i * FRAME)
            self.image(f"/{device}/sensor_1/Color_0/image/data", frame.color, "rgb8", START + i * FRAME)


def write_rig(path: Path, container: str, recording: Recording) -> None:
    """All cameras of a recording, which share one lens, and where it tells them the poses of the rig."""
    stations = list(recording)
    lens = recording.rig.cameras[recording.rig.reference].intrinsics
    with Writer(path, container, lens) as bag:
        for name in recording.rig.cameras:
            bag.camera(f"/{name}", [station.frames[name] for station in stations])
        for i, station in enumerate(stations):
            if station.world_from_station is not None:
                bag.pose("/odom", station.world_from_station, START + i * FRAME)
