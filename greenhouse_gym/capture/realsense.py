"""RealSense cameras through their SDK, live or played back from its recordings, as synchronized moments."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.capture.formats.single_camera import CAMERA, RIG_FROM_CAMERA, Lens, Pair
from greenhouse_gym.capture.rig import Camera, Intrinsics, RgbdFrame, Rig, Station
from greenhouse_gym.common.extras import needs
from greenhouse_gym.errors import CameraError, FileFormatError
from greenhouse_gym.geometry import pose

_WIDTH, _HEIGHT, _RATE = 848, 480, 30
_TIMEOUT = 5000  # ms without a frame after which a camera is lost
_FILE_TIMEOUT, _MAX_STALLS = 1000, 10  # ms without a frame after which a file may have ended, and repetitions
_SAME_MOMENT = 0.025  # s between images of one moment
_MAX_SKIPPED = 300  # images in a row without a partner, after which clocks must differ


@dataclass(frozen=True, eq=False)
class LiveRig:
    """Rig of running cameras and the stream of their images."""

    rig: Rig  # the cameras, all with the same pose: a rig file gives the real ones
    moments: Iterator[Station]  # their images, moment by moment; ends with the files that are played back


@contextmanager
def realsense_cameras(serials: Mapping[str, str] | None = None, playback: Sequence[Path] = ()) -> Iterator[LiveRig]:
    """Start cameras, and stop them at the end.

    Args:
        serials: Serial number of each camera by its name. By default all connected ones, named after their numbers, or
            "camera" if it is only one.
        playback: Recordings of the SDK, played back instead of cameras and named after the files.

    Raises:
        CameraError: No camera is connected, or not the one with a serial number, or one cannot be started.
        FileFormatError: A file cannot be played back.
        MissingDependencyError: The extra ``realsense`` is not installed.
    """
    sdk = realsense_sdk()
    with ExitStack() as running:
        streams = {}
        for name, config in _configs(sdk, serials, playback):
            streams[name] = running.enter_context(_started(sdk, name, config, bool(playback)))
        names = list(streams)
        cameras = {name: Camera(stream.pair.color.intrinsics, RIG_FROM_CAMERA) for name, stream in streams.items()}
        rig = Rig(cameras, names[len(names) // 2])
        together = synchronized({name: stream.frames() for name, stream in streams.items()})
        yield LiveRig(rig, (Station(frames) for frames in together))


@cache
def realsense_sdk() -> Any:
    """Import the SDK at first use; its wheel needs libusb, which the wheel ``libusb-package`` provides."""
    with needs("realsense"):
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        import pyrealsense2
    return pyrealsense2


def synchronized(streams: Mapping[str, Iterator[tuple[float, RgbdFrame]]]) -> Iterator[dict[str, RgbdFrame]]:
    """Yield the images of all cameras at about the same time; images without partners are skipped.

    ``streams`` are times in seconds and images of each camera.

    Raises:
        CameraError: Hundreds of images in a row have no partner.
    """
    newest: dict[str, tuple[float, RgbdFrame]] = {}
    skipped, behind = 0, list(streams)
    while True:
        for name in behind:
            found = next(streams[name], None)
            if found is None:
                return
            newest[name] = found
        times = {name: time for name, (time, _) in newest.items()}
        oldest = min(times, key=times.__getitem__)
        apart = max(times.values()) - times[oldest]
        if apart <= _SAME_MOMENT:
            yield {name: frame for name, (_, frame) in newest.items()}
            skipped, behind = 0, list(streams)
            continue
        skipped, behind = skipped + 1, [oldest]
        if skipped > _MAX_SKIPPED:
            raise CameraError(f"the images of camera {oldest!r} are {apart:.3f} s behind: its clock differs")


def _configs(sdk: Any, serials: Mapping[str, str] | None, playback: Sequence[Path]) -> Iterator[tuple[str, Any]]:
    """Yield a name and the SDK's configuration for each camera, or each file."""
    for file in playback:
        if not file.is_file():
            raise FileFormatError(file, "cannot be read (no such file)")
        config = sdk.config()
        config.enable_device_from_file(str(file), False)
        yield CAMERA if len(playback) == 1 else file.stem, config
    if playback:
        return
    found = sorted(device.get_info(sdk.camera_info.serial_number) for device in sdk.context().query_devices())
    if not found:
        raise CameraError("no RealSense camera is connected: check cables, and the udev rules for RealSense")
    wanted = serials or ({CAMERA: found[0]} if len(found) == 1 else {f"camera_{number}": number for number in found})
    for name, number in wanted.items():
        if number not in found:
            raise CameraError(f"no camera with the serial number {number} for {name!r}; connected are {found}")
        config = sdk.config()
        config.enable_device(number)
        config.enable_stream(sdk.stream.depth, _WIDTH, _HEIGHT, sdk.format.z16, _RATE)
        config.enable_stream(sdk.stream.color, _WIDTH, _HEIGHT, sdk.format.rgb8, _RATE)
        yield name, config


@dataclass(frozen=True, eq=False)
class _Stream:
    """Stream of images of a running camera."""

    name: str
    pipeline: Any
    pair: Pair
    playback: Any = None  # the SDK's playback of a file

    def frames(self) -> Iterator[tuple[float, RgbdFrame]]:
        """Yield times in seconds and images, depth aligned to color, until the camera is stopped."""
        stalls = 0
        while True:
            try:
                both = self.pipeline.wait_for_frames(_TIMEOUT if self.playback is None else _FILE_TIMEOUT)
            except RuntimeError as error:
                if self.playback is None:
                    raise CameraError(f"camera {self.name!r} sends no more images: {error}") from error
                stalls += 1
                if stalls > _MAX_STALLS or self.playback.current_status() != realsense_sdk().playback_status.playing:
                    return
                continue
            stalls = 0
            depth, color = both.get_depth_frame(), both.get_color_frame()
            if depth and color and _of_one_moment(depth, color):
                pair = replace(self.pair, depth_scale=depth.get_units())
                images = np.array(color.get_data()), np.array(depth.get_data())  # the SDK reuses its buffers
                yield color.get_timestamp() / 1000, pair.frame(*images, self.name)


def _of_one_moment(depth: Any, color: Any) -> bool:
    """Return whether two frames were taken together, as far as one clock measured both.

    Where one stream lags, as on a busy machine, the SDK pairs its newest frame with one of the other stream that it has
    given out before.
    """
    if depth.get_frame_timestamp_domain() != color.get_frame_timestamp_domain():
        return True
    return bool(abs(depth.get_timestamp() - color.get_timestamp()) <= 1000 * _SAME_MOMENT)


@contextmanager
def _started(sdk: Any, name: str, config: Any, from_file: bool) -> Iterator[_Stream]:
    pipeline, playback = sdk.pipeline(), None
    try:
        if from_file:  # before the start: in real time, a busy machine would lose frames
            playback = config.resolve(sdk.pipeline_wrapper(pipeline)).get_device().as_playback()
            playback.set_real_time(False)
        profile = pipeline.start(config)
    except RuntimeError as error:
        raise CameraError(f"camera {name!r} cannot be started: {error}") from error
    try:
        yield _Stream(name, pipeline, _pair(sdk, profile), playback)
    finally:
        pipeline.stop()


def _pair(sdk: Any, profile: Any) -> Pair:
    """Return lenses and poses of depth and color. The SDK's own alignment would widen the foreground by a pixel."""
    color, depth = (profile.get_stream(kind).as_video_stream_profile() for kind in (sdk.stream.color, sdk.stream.depth))
    lenses = [_lens(sdk, stream.get_intrinsics()) for stream in (color, depth)]
    extrinsics = depth.get_extrinsics_to(color)
    color_from_depth = pose(np.reshape(extrinsics.rotation, (3, 3)).T, extrinsics.translation)
    return Pair.of(lenses[0], lenses[1], color_from_depth)


def _lens(sdk: Any, found: Any) -> Lens:
    """Convert the SDK's intrinsics; distortion is undone by Brown's and by the fisheye's model, which OpenCV has."""
    intrinsics = Intrinsics(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy)
    fisheye = found.model == sdk.distortion.kannala_brandt4
    known = fisheye or found.model == sdk.distortion.brown_conrady
    return Lens(intrinsics, tuple(found.coeffs)[: 4 if fisheye else 5] if known else (), fisheye)
