"""A tracked ultrasound probe whose images come as labels: pyigtl's server, in a process of its own,
for it takes signals.

probe_peer.py FILE     says its port; then 30 times a second the next pose (``tracker_from_probe``)
                       and image (``labels``) of the NPZ, there and back, until it is killed
"""

from __future__ import annotations

import itertools
import sys
import time

import numpy as np
import pyigtl

with np.load(sys.argv[1]) as given:
    poses, images = given["tracker_from_probe"], given["labels"]
server = pyigtl.OpenIGTLinkServer(port=0)
print(server.server_address[1], flush=True)
order = [*range(len(poses)), *range(len(poses) - 2, 0, -1)]
for n in itertools.cycle(order):
    now_s = time.time()
    pose = pyigtl.TransformMessage(poses[n], timestamp=now_s, device_name="ProbeToTracker")
    image = pyigtl.ImageMessage(images[n][None], timestamp=now_s, device_name="Labels")
    for message in (pose, image):
        server.send_message(message, wait=False)
    time.sleep(1 / 30)
