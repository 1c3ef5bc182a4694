"""From frames to poses: spikes, camera, pose, calibration, motion, which LEDs to light."""
