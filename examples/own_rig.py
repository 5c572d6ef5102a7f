"""A rig and a capture protocol of your own: one camera, in two passes along the row.

`greenhouse_gym.capture.three_camera_rig` makes rigs of three cameras on a beam.
"""

import numpy as np

from greenhouse_gym.capture import Camera, CaptureProtocol, Intrinsics, Rig, simulate_protocol
from greenhouse_gym.crops import grow_row
from greenhouse_gym.geometry import pose

SMALL = Intrinsics(212, 120, 106.0, 106.0, 105.5, 59.5)

# it looks along x into the plants: its axes right, down, forward as columns
AXES = np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
LOW, HIGH = (Rig({"only": Camera(SMALL, pose(AXES, [0.0, 0.0, z]))}, reference="only") for z in (1.1, 1.6))
TWICE = CaptureProtocol("twice", "two passes of one camera, 1 m from the stems", (LOW, HIGH), back=0.5)

if __name__ == "__main__":
    recording = simulate_protocol(grow_row(seed=1, length=0.5), seed=1, protocol=TWICE, stations=2)
    print(len(recording), "stations", recording[0].frames["only"].depth.shape)
