"""Open loop: inflate a ring in free space and compare its radius with the analytic one."""

import math

import numpy as np

import turgor

n, r, pressure = 20, 10.0, 20e3
body = turgor.ring(n, r)
steps = 6000
ramp = pressure * np.minimum(np.arange(1, steps + 1) / 3000, 1.0)  # [Pa], slowly, because bending is undamped
rest_length = np.broadcast_to(body.rest_length, (steps, n))
recording = turgor.replay(body, turgor.Scene([]), rest_length, ramp, gravity=0.0)

radius = np.linalg.norm(recording.position[-1] - recording.com[-1], axis=1).mean()
k = 0.5 * 2500 * (16 * math.pi) ** 2  # [N/m], 8 Hz on the reduced mass of two squares
analytic = r / (1 - pressure / math.tan(math.pi / n) / (2 * k))
print(f"radius {radius:.4f} m, analytic {analytic:.4f} m")
assert abs(radius / analytic - 1) < 1e-4
