"""Print the motion of a camera's patient until 300 frames are measured: python live.py calibration.json [ADDRESS]."""

import sys

import tidegate

calibration, *address = sys.argv[1:]
camera = tidegate.open_camera(address[0] if address else None, calibration)
measured = 0
for frame in tidegate.measure(camera):
    if frame.motion is None:
        print(frame.state.value)
        continue
    print(f"{frame.timestamp_us / 1e6:.3f} s: abdomen {frame.motion.abdomen_mm:+.2f} mm")
    measured += 1
    if measured == 300:
        break
